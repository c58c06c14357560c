"""Whole runs of experiments.train, for their start and their memory; two sides of `worker`.

`python -m experiments.benchmarks.train_side`, with train's flags, ends after its first update.
"""

import functools
import os
import resource
import subprocess
import sys
import tempfile
import time

from .. import train
from ..command_line import flags as config_flags
from ..command_line import runtime
from .worker import ROOT


def run(module: str, **flags: object) -> float:
    """Runs a module to its end, with a run directory that is deleted afterwards. Returns seconds.

    Raises:
        ChildProcessError: its exit status was not 0.
    """
    with tempfile.TemporaryDirectory() as folder:
        given = [f"--{name}={value}" for name, value in flags.items()]
        command = [sys.executable, "-m", module, *given, f"--out={folder}/run"]
        start = time.perf_counter()
        done = subprocess.run(command, cwd=ROOT, stdin=subprocess.DEVNULL, capture_output=True, text=True)
        seconds = time.perf_counter() - start
    if done.returncode:
        raise ChildProcessError(f"{module}: {done.stderr.strip().splitlines()[-1:]}")
    return seconds


class Startup:
    """Starts of a preset. The first one fills jax' cache."""

    def __init__(self, preset: str):
        self._preset = preset
        self.turn()

    def turn(self) -> dict[str, list[float]]:
        """Starts once. Returns "seconds" until the first update has ended."""
        return {"seconds": [run(__name__, preset=self._preset)]}


class Memory:
    """A run of a preset, with fewer updates than usual, so that it takes two minutes."""

    def __init__(self, preset: str):
        self._flags = {"preset": preset, "updates_per_step": 0.005, "eval_games": 2}

    def turn(self, buffer_size: int) -> dict[str, list[float]]:
        """Trains until the buffer is full.

        Args:
            buffer_size: in transitions of 84 x 84 bytes.

        Returns:
            "peak", the largest resident size in GB; "frames", what the frames of a full buffer take alone.
        """
        run("experiments.train", steps=int(1.05 * buffer_size), buffer_size=buffer_size, **self._flags)
        unit = 1 if sys.platform == "darwin" else 1024  # bytes
        memory = unit * resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
        return {"peak": [memory / 1e9], "frames": [buffer_size * 84 * 84 / 1e9]}


def prepare(tune: str, encoder: str) -> None:
    """As `runtime.prepare`; the run that follows ends after its first update."""
    runtime.prepare(tune, encoder)
    from srl_jax.run.loop import Run

    update = Run.update

    def once(self) -> None:
        update(self)
        os._exit(0)

    Run.update = once


if __name__ == "__main__":
    config_flags.program(functools.partial(train.train, prepare=prepare), train.define_flags)()
