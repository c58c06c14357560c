"""A long run whose rows are far apart: resident memory must not grow once the replay buffer is full.

Kept for each update or episode since the last row, anything would show: 50,000 updates lie between two rows.
"""

import os
import time
from pathlib import Path

import numpy as np

from . import Count, Say
from .small import config

ALLOWED = 6e6
"""Bytes that resident memory may have grown by, from a third of the run to its end: malloc wanders."""


def resident() -> int:
    """Bytes of this process in memory."""
    with open("/proc/self/statm", encoding="utf-8") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def soak(short: bool, folder: Path, say: Say) -> list[Count]:
    """See the module."""
    from srl_jax.loop import Run

    steps = 2_000 if short else 60_000
    folder = folder / "run"
    folder.mkdir()
    values = {"steps": steps, "log_every": steps, "checkpoint_every": steps // 6, "eval_every": steps // 5}
    run = Run([config(updates_per_step=0.9, **values)], [folder])
    seen: list[tuple[int, int]] = []
    step = run.step
    began = time.monotonic()

    def watched() -> None:
        step()
        if run.env_steps % 300 < run.config.num_envs:
            seen.append((run.env_steps, resident()))
            if len(seen) % 40 == 0:
                left = (time.monotonic() - began) / run.env_steps * (steps - run.env_steps)
                done = f"{run.env_steps} of {steps} env steps, {seen[-1][1] / 1e6:.0f} MB"
                say(f"memory: {done}; {left:.0f} s left")

    run.step = watched
    run.train()
    at, bytes_ = np.array(seen).T
    first = bytes_[(at > steps // 3) & (at < steps // 2)]
    grown = float(np.median(bytes_[at > steps * 5 // 6]) - np.median(first))
    told = f"{grown / 1e6:+.1f} MB of {first[0] / 1e6:.0f}"
    detail = f"{steps:,} env steps, {run.updates:,} updates between two rows: {told}"
    return [Count("memory after the buffer is full", 1, int(grown > ALLOWED), detail)]
