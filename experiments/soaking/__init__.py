"""`python -m experiments.soaking`; its parts: each tries to break one promise, and counts."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple


class Count(NamedTuple):
    """One line of the table.

    Attributes:
        what: was tried.
        number: how often.
        failed: how often the promise did not hold.
        detail: what else belongs in the table, or "".
    """

    what: str
    number: int
    failed: int
    detail: str = ""


Say = Callable[[str], None]
"""Takes a line of progress."""

Part = Callable[[bool, Path, Say], list[Count]]
"""(short, an empty folder to work in, say) -> counts; `short` is the version for the test suite, seconds."""
