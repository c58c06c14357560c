"""What this machine has for runs: cores, each lent to one run at a time, and memory. Imports no jax."""

import contextlib
import fcntl
import os
import random
import sys
import tempfile
from collections import Counter
from pathlib import Path

from srl_jax import envs
from srl_jax.config import Config

from .. import control_groups, runtime

RUN_BYTES = 600 * 2**20
"""Of a process that trains, beside its replay buffer: measured with the thesis' encoders on a CPU."""

SHARE = 0.9
"""Of the memory that is free when a sweep begins that it may fill."""


def run_bytes(config: Config) -> int:
    """About how much memory a run takes once its buffer is full: a byte a pixel and channel, and the rest.

    How large and how colourful frames are only the environment knows, of a game that can be either.
    """
    channels = 3 if envs.known(config.game).own_size else 1
    return RUN_BYTES + config.buffer_size * channels * (config.frame_size or 84) ** 2


def free_bytes(root: Path = control_groups.ROOT) -> int | None:
    """Memory that new processes can have, also under a control group's limit; None where it is not known.

    Args:
        root: of the file system; another one for tests.
    """
    found = [control_groups.free_bytes(root)]
    with contextlib.suppress(OSError, ValueError, IndexError, StopIteration):
        lines = (root / "proc/meminfo").read_text().splitlines()
        found.append(next(int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:")))
    return min((size for size in found if size is not None), default=None)


def has_gpu() -> bool:
    """Whether runs will take an NVIDIA GPU."""
    return runtime.has_gpu(os.environ)


def cores() -> list[int]:
    """Numbers of the cores that this process may use; none where they have no numbers."""
    return sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []


def most_workers() -> int:
    """Runs at once on this machine: one a core, or one in all on a GPU."""
    return 1 if has_gpu() else runtime.cores()


_lent: Counter[int] = Counter()  # how many runs of this process are on a core


class Lent:
    """Cores that are a run's until they are given back, or the process that took them ends.

    All sweeps of a user on a machine share them: a locked file each in the folder for temporary files.
    """

    def __init__(self, numbers: tuple[int, ...], descriptors: list[int]):
        self.numbers, self._descriptors, self._given_back = numbers, descriptors, False
        _lent.update(numbers)

    def give_back(self) -> None:
        """A second call does nothing."""
        if not self._given_back:
            _lent.subtract(self.numbers)
        self._given_back = True
        while self._descriptors:
            os.close(self._descriptors.pop())


def lend(count: int, folder: Path | None = None) -> Lent:
    """So many cores that no run has, and where there are too few, those with the fewest runs of this process.

    None at all where there is nothing to choose: on a GPU, or on a system without affinity.

    Args:
        count: how many; at least 1.
        folder: of the locks; None: the user's own.
    """
    free = cores()
    if not free or sys.platform != "linux" or has_gpu():
        return Lent((), [])
    folder = folder or Path(tempfile.gettempdir()) / f"srl_jax-cores-{os.getuid()}"
    taken: list[int] = []
    descriptors: list[int] = []
    with contextlib.suppress(OSError):
        folder.mkdir(mode=0o700, exist_ok=True)
    for core in free:
        if len(taken) == min(count, len(free)):
            break
        try:
            descriptor = os.open(
                folder / str(core), os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600
            )
        except OSError:
            continue
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(descriptor)
            continue
        taken.append(core)
        descriptors.append(descriptor)
    # More runs than cores: they share, but each with as many as it has alone, so that XLA computes alike.
    others = sorted((core for core in free if core not in taken), key=lambda x: (_lent[x], random.random()))
    taken += others[: min(count, len(free)) - len(taken)]
    return Lent(tuple(sorted(taken)), descriptors)
