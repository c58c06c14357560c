"""Output for whoever watches. A stream that is closed, vanishes or lacks characters ends no run."""

import errno
import io
import os
import sys
from collections.abc import Callable
from typing import Any, TextIO

from srl_jax.errors import SaveError


class Display:
    """A text stream that raises no error: once it cannot be written to, nothing is shown any more.

    Characters that it cannot encode are written as Python would escape them.

    Args:
        stream: where to write; None for nowhere, as Python has it where a process begins without.

    Attributes:
        lost: why nothing is shown, or None.
    """

    def __init__(self, stream: "TextIO | Display | None"):
        self._stream = stream
        self.lost: Exception | None = None
        if stream is None:
            self.lost = OSError(errno.EBADF, os.strerror(errno.EBADF))

    def write(self, text: str) -> int:
        """Writes what can be written; the number of characters, all the same."""
        try:
            self._try(lambda stream: stream.write(text))
        except UnicodeEncodeError:
            escaped = text.encode("ascii", "backslashreplace").decode()
            self._try(lambda stream: stream.write(escaped))
        return len(text)

    def flush(self) -> None:
        """Flushes the stream."""
        self._try(lambda stream: stream.flush())

    def isatty(self) -> bool:
        """Whether somebody sees it in a terminal."""
        return bool(self._try(lambda stream: getattr(stream, "isatty", lambda: False)()))

    def fileno(self) -> int:
        """The stream's descriptor.

        Raises:
            OSError: it has none.
        """
        if self._stream is None:
            raise io.UnsupportedOperation("fileno")
        return self._stream.fileno()

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):  # before there is a stream
            raise AttributeError(name)
        return getattr(self._stream, name)

    def _try(self, do: Callable[[Any], Any]) -> Any:
        if self.lost is None:
            try:
                return do(self._stream)
            except UnicodeEncodeError:
                raise
            except (OSError, ValueError) as error:  # ValueError: somebody has closed it
                self.lost = error
        return None


def say(line: str) -> None:
    """A line for whoever watches, on stderr."""
    display = Display(sys.stderr)
    display.write(line + "\n")
    display.flush()


def secure() -> None:
    """Makes stdout and stderr of this process `Display`s; for entry points, before anything is printed.

    Descriptors 0 to 2 are opened where they are closed: a file of the run that got one of them would be sent
    what libraries written in C print.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)  # the lowest that is free
    sys.stdout, sys.stderr = Display(sys.stdout), Display(sys.stderr)


def result(text: str) -> None:
    """Prints what a program was asked for, on stdout. A reader that has seen enough may go.

    Raises:
        SaveError: it could not be written, say on a full disk.
    """
    display = Display(sys.stdout)
    display.write(text + "\n")
    display.flush()
    lost = getattr(sys.stdout, "lost", None) or display.lost
    if lost is not None and not isinstance(lost, BrokenPipeError):
        raise SaveError(f"standard output: {getattr(lost, 'strerror', None) or lost}") from lost
