"""Becomes a run that ends with the launcher that started it, on cores of its own.

`python -m experiments.sweeping.child PARENT CORES COMMAND...`: PARENT is the launcher's process id, CORES
numbers with commas between them, or empty. On Linux the kernel sends SIGTERM to the run when the launcher
is gone, however it ended, so that a checkpoint is written and nobody writes on unknown; and the run keeps to
its cores.
"""

import ctypes
import os
import signal
import sys

_PR_SET_PDEATHSIG = 1


def main(argv: list[str]) -> None:
    """Does not return."""
    parent, cores, command = int(argv[1]), argv[2], argv[3:]
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)
        if cores:
            os.sched_setaffinity(0, {int(core) for core in cores.split(",")})
    if os.getppid() != parent:  # it has ended before it could be watched
        sys.exit(128 + signal.SIGTERM)
    os.execv(command[0], command)


if __name__ == "__main__":
    main(sys.argv)
