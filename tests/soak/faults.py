"""Faults in the operations with which this process writes below a directory."""

import math
import os
import sys
from collections.abc import Callable
from pathlib import Path

EVENTS = {
    "open": "opening",
    "os.mkdir": "making a directory",
    "os.link": "linking",
    "os.rename": "renaming",
    "os.remove": "removing",
    "shutil.rmtree": "removing a directory",
}
"""{Python's audit event: the operation's name}; flushing a file is one more, which has no event."""


class Faults:
    """A context in which operations on what lies below a directory fail, from one of them on.

    A file that fails to be flushed has lost half of what was written to it since it was opened or last
    flushed, as after a write that was not finished.

    Args:
        root: the directory.
        first: the number of the operation that fails first, from 0; None: none does.
        fault: called with the name of each operation that fails, before it is done; it raises, or ends the
            process.
        begun: called before the first operation.

    Attributes:
        number: of operations so far.
        reached: the name of the one that failed first, or "".
    """

    _active: "Faults | None" = None
    _fsync = staticmethod(os.fsync)
    _hooked = False

    def __init__(
        self,
        root: Path,
        first: int | None,
        fault: Callable[[str], None],
        begun: Callable[[], None] = lambda: None,
    ):
        self._prefix, self._first = f"{root}{os.sep}", math.inf if first is None else first
        self._fault, self._begun = fault, begun
        self._safe: dict[str, int] = {}  # bytes of each file that were there before, or are flushed
        self.number, self.reached = 0, ""

    def __enter__(self) -> "Faults":
        if not Faults._hooked:  # a hook stays for good
            sys.addaudithook(_on_event)
            os.fsync = _on_flush
            Faults._hooked = True
        Faults._active = self
        return self

    def __exit__(self, *_: object) -> None:
        Faults._active = None

    def operation(self, name: str, path: object, file: int | None = None, anew: bool = False) -> None:
        """One is about to be done; `anew`: it opens a file that it empties."""
        if not str(path).startswith(self._prefix):
            return
        if not self.number:
            self._begun()
        self.number += 1
        if self.number > self._first:
            self.reached = self.reached or name
            if file is not None and not os.path.isdir(path):
                size = os.fstat(file).st_size
                safe = min(self._safe.get(str(path), 0), size)
                os.truncate(path, safe + (size - safe) // 2)
            self._fault(name)
        if name in ("opening", "flushing"):
            self._safe[str(path)] = os.path.getsize(path) if os.path.exists(path) and not anew else 0


def _on_event(event: str, arguments: tuple) -> None:
    if Faults._active is not None and event in EVENTS:
        if event != "open" or arguments[2] & (os.O_WRONLY | os.O_RDWR):
            anew = event == "open" and bool(arguments[2] & os.O_TRUNC)
            Faults._active.operation(EVENTS[event], arguments[0], anew=anew)


def _on_flush(file: int) -> None:
    if Faults._active is not None:
        Faults._active.operation("flushing", os.readlink(f"/proc/self/fd/{file}"), file)
    Faults._fsync(file)
