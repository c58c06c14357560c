"""Output for whoever watches. A stream that is closed, vanishes or lacks characters ends no run."""

import errno
import io
import os
import sys
import threading
from collections.abc import Callable
from typing import Any, TextIO

from tqdm import tqdm

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


class _Lines:
    """A stream for a bar where nothing can be drawn over: each state that is drawn becomes a line.

    Args:
        write: takes a line, with its end.
    """

    def __init__(self, write: Callable[[str], Any]):
        self._write = write

    def write(self, text: str) -> None:
        """Writes a line, less what moves the cursor and what wipes the line before."""
        if text.strip():
            self._write(text.strip() + "\n")


class Progress:
    """A bar of tqdm: drawn in place on a terminal, a line every ten seconds elsewhere.

    Args:
        total: what `done` will be at the end.
        unit: what `done` counts.
        stream: where to draw; None for stderr.
    """

    def __init__(self, total: int, unit: str = "env steps", stream: TextIO | Display | None = None):
        self._total, self._unit = total, unit
        self._stream = Display(sys.stderr if stream is None else stream)
        self._tty = self._stream.isatty()
        self._bar: _Bar | None = None
        self._fields: dict[str, Any] = {}

    def update(self, done: int, **fields: Any) -> None:
        """Says how far it is; draws if the last drawing is old enough.

        Args:
            done: counted from the start of the run.
            **fields: numbers or strings to show, kept until given again; None takes one away.
        """
        if self._bar is None:
            interval = 0.25 if self._tty else 10.0
            self._bar = _Bar(
                total=self._total,
                unit=f" {self._unit}",
                initial=done,
                file=self._stream if self._tty else _Lines(self._write),
                mininterval=interval,
                miniters=0,  # ask the clock at each update: their rate is not steady
                smoothing=interval / 30,  # the rate is of about the last 30 seconds
                dynamic_ncols=self._tty,
                ascii=None if self._tty else True,
                position=0,
            )
        if fields:
            self._fields |= fields
            shown = {name: x for name, x in self._fields.items() if x is not None}
            self._bar.set_postfix(shown, refresh=False)
        self._bar.update(done - self._bar.n)

    def note(self, text: str) -> None:
        """Prints a line of its own above the bar."""
        drawn = self._bar if self._tty else None
        if drawn is not None:
            drawn.clear()
        self._write(text + "\n")
        if drawn is not None:
            drawn.refresh()

    def close(self) -> None:
        """Draws the last state and ends the line. A second call does nothing."""
        if self._bar is not None:
            self._bar.close()

    def __enter__(self) -> "Progress":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _write(self, text: str) -> None:
        self._stream.write(text)
        self._stream.flush()


class _Bar(tqdm):
    monitor_interval = 0  # else it has a thread that draws


_Bar.set_lock(threading.RLock())  # else one for other processes, too, which takes a semaphore


def hms(seconds: float) -> str:
    """A duration in seconds as h:mm:ss."""
    whole = max(int(round(seconds)), 0)
    return f"{whole // 3600}:{whole // 60 % 60:02d}:{whole % 60:02d}"


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
