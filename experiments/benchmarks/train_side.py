"""Whole runs of experiments.train, for their start and their memory; two sides of `worker`.

`python -m experiments.benchmarks.train_side`, with train's flags, ends after its first update.
"""

import functools
import os
import subprocess
import sys
import tempfile
import time

from .. import flags as config_flags
from .. import runtime, train
from .worker import ROOT


def run(module: str, **flags: object) -> tuple[float, float]:
    """Runs a module to its end, with a run directory that is deleted afterwards.

    Returns:
        Seconds, and the largest resident size in GB.

    Raises:
        ChildProcessError: its exit status was not 0.
    """
    with tempfile.TemporaryDirectory() as folder, open(f"{folder}/log", "w+", encoding="utf-8") as log:
        given = [f"--{name}={value}" for name, value in flags.items()]
        command = [sys.executable, "-m", module, *given, f"--out={folder}/run"]
        start = time.perf_counter()
        process = subprocess.Popen(command, cwd=ROOT, stdin=subprocess.DEVNULL, stdout=log, stderr=log)
        _, status, usage = os.wait4(process.pid, 0)
        seconds = time.perf_counter() - start
        process.returncode = os.waitstatus_to_exitcode(status)
        log.seek(0)
        if process.returncode:
            raise ChildProcessError(f"{module}: {log.read().strip().splitlines()[-1:]}")
    return seconds, usage.ru_maxrss * (1 if sys.platform == "darwin" else 1024) / 1e9


class Startup:
    """Starts of a preset. The first one fills jax' cache."""

    def __init__(self, preset: str):
        self._preset = preset
        self.turn()

    def turn(self) -> dict[str, list[float]]:
        """Starts once. Returns "startup", the seconds until the first update has ended."""
        return {"startup": [run(__name__, preset=self._preset)[0]]}


class Memory:
    """A run of a preset, with fewer updates than usual, so that it takes two minutes."""

    def __init__(self, preset: str):
        self._flags = {"preset": preset, "updates_per_step": 0.005, "eval_games": 2}

    def turn(self, buffer_size: int) -> dict[str, list[float]]:
        """Trains until the buffer is full.

        Args:
            buffer_size: in transitions of 84 x 84 bytes.

        Returns:
            "memory", the largest resident size in GB; "frames", what the frames of a full buffer take alone.
        """
        steps = int(1.05 * buffer_size)
        _, memory = run("experiments.train", steps=steps, buffer_size=buffer_size, **self._flags)
        return {"memory": [memory], "frames": [buffer_size * 84 * 84 / 1e9]}


def prepare(tune: str, encoder: str) -> None:
    """As `runtime.prepare`; the run that follows ends after its first update."""
    runtime.prepare(tune, encoder)
    from srl_jax.loop import Run

    update = Run.update

    def once(self) -> None:
        update(self)
        os._exit(0)

    Run.update = once


if __name__ == "__main__":
    train.define_flags()
    config_flags.run(functools.partial(train.main, prepare=prepare))
