"""Whole runs of experiments.train, for their start and their memory; answers `worker` requests.

`python -m experiments.benchmarks.train_side`. Each request runs processes of its own.
"""

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from typing import Any

from .startup import MARK
from .worker import ROOT, serve

STEPS = 105_000
"""Env steps of the run whose memory is measured; its buffer is then full."""

FRAMES_BYTES = 100_000 * 84 * 84
"""What the frames of a full buffer take by themselves."""


class Ended(RuntimeError):
    """A run that went wrong."""


def run(module: str, flags: Sequence[str]) -> tuple[float, int, str]:
    """Runs a module of this project to its end, with a run directory that is deleted afterwards.

    Returns:
        Seconds, the largest resident size in bytes, and the last line that it printed.

    Raises:
        Ended: its exit status was not 0.
    """
    with tempfile.TemporaryDirectory() as folder, tempfile.TemporaryFile("w+", encoding="utf-8") as log:
        command = [sys.executable, "-m", module, *flags, f"--out={folder}/run"]
        start = time.perf_counter()
        process = subprocess.Popen(
            command, cwd=ROOT, stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT
        )
        _, status, usage = os.wait4(process.pid, 0)
        seconds = time.perf_counter() - start
        process.returncode = os.waitstatus_to_exitcode(status)
        log.seek(0)
        lines = [line.strip() for line in log.read().splitlines() if line.strip()] or [""]
        if process.returncode:
            raise Ended(f"{module}: exit status {process.returncode}: {lines[-1]}")
        kilobyte = 1 if sys.platform == "darwin" else 1024
        return seconds, usage.ru_maxrss * kilobyte, lines[-1]


def startup(preset: str) -> dict[str, Any]:
    """Starts training a preset. Replies with "seconds" until the first update has ended."""
    seconds, _, line = run("experiments.benchmarks.startup", [f"--preset={preset}"])
    if line != MARK:
        raise Ended(f"no update was reached: {line}")
    return {"seconds": [seconds]}


def memory(preset: str, updates_per_step: float) -> dict[str, Any]:
    """Trains a preset until its buffer is full.

    Args:
        preset: a key of `experiments.presets.PRESETS`.
        updates_per_step: fewer than usual, so that it takes a minute or two.

    Returns:
        "bytes", the largest resident size; "frames", FRAMES_BYTES.
    """
    flags = [
        f"--preset={preset}",
        f"--steps={STEPS}",
        f"--updates_per_step={updates_per_step}",
        "--eval_games=2",
    ]
    return {"bytes": [run("experiments.train", flags)[1]], "frames": [FRAMES_BYTES]}


if __name__ == "__main__":
    serve({"startup": startup, "memory": memory})
