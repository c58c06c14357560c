"""The errors that may end a run: each has one line, and an exit status of its own."""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path


class ConfigError(ValueError):
    """A setting that cannot be run; one line that names the flag and the valid choices. Exit status 2."""


class SaveError(Exception):
    """A checkpoint or a row could not be written, say on a full disk; one line. Exit status 3."""


class Diverged(Exception):
    """A loss is NaN or infinite; one line with the step and its name. Exit status 4.

    Attributes:
        run: the directory of the run whose loss it is; None where nobody said.
    """

    def __init__(self, message: str, run: Path | None = None):
        super().__init__(message)
        self.run = run


@contextlib.contextmanager
def saving(path: str | os.PathLike, problem: str = "not written") -> Iterator[None]:
    """Turns an OSError into a SaveError, `PATH: PROBLEM: reason`."""
    try:
        yield
    except OSError as error:
        raise SaveError(f"{path}: {problem}: {error.strerror or error}") from error


EXIT_STATUS = {ConfigError: 2, SaveError: 3, Diverged: 4}
