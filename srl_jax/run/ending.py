"""How a run ended: the file ended.json in its directory. Imports no jax.

The process that ends writes the file, and a resumed run removes it. A run without one is under way, or was
killed.
"""

import json
from pathlib import Path
from typing import NamedTuple

from srl_jax.errors import ConfigError, Diverged, SaveError, saving
from srl_jax.files.reading import read_json, replace_text

FILE = "ended.json"
STATUSES = ("finished", "stopped", "diverged", "failed")
"""What `Ending.status` may be: at its end, by somebody, by a loss that is not finite, by another error."""


class Ending(NamedTuple):
    """How a run ended.

    Attributes:
        status: one of `STATUSES`.
        env_steps: when.
        reason: why it did not end well, a line; empty where it did.
    """

    status: str
    env_steps: int
    reason: str = ""

    @property
    def failed(self) -> bool:
        """Whether it ended with an error; "stopped" is none."""
        return self.status in ("diverged", "failed")


def of(error: BaseException, env_steps: int) -> Ending:
    """The ending of a run that an exception has ended.

    Args:
        error: whatever it was.
        env_steps: that the run had done.
    """
    if isinstance(error, KeyboardInterrupt):
        return Ending("stopped", env_steps)
    line = " ".join(str(error).split())
    if isinstance(error, Diverged):  # what follows is advice for whoever watches
        return Ending("diverged", env_steps, line.partition(";")[0])
    return Ending(
        "failed", env_steps, line if isinstance(error, SaveError) else f"{type(error).__name__}: {line}"
    )


def write(run: Path, ending: Ending) -> None:
    """Writes ended.json of a run directory at once, flushed to disk.

    Raises:
        SaveError: it could not be written.
    """
    with saving(run / FILE):
        replace_text(run / FILE, json.dumps(ending._asdict()) + "\n")


def read(run: Path) -> Ending | None:
    """How the run in a directory ended; None where it is under way, was killed, or is older than this file.

    Raises:
        ConfigError: the file cannot be read, or says something else.
    """
    path = run / FILE
    try:
        values = read_json(path)
    except ConfigError as error:
        if isinstance(error.__cause__, FileNotFoundError):
            return None
        raise
    try:
        ending = Ending(**values)
        if (
            ending.status not in STATUSES
            or type(ending.env_steps) is not int
            or type(ending.reason) is not str
        ):
            raise ValueError("not an ending")
    except (ValueError, TypeError) as error:
        raise ConfigError(f"{path}: not what training writes ({str(error)[:100]})") from None
    return ending


def clear(run: Path) -> None:
    """Removes ended.json: the run is under way.

    Raises:
        SaveError: it cannot be removed.
    """
    with saving(run / FILE, "not removed"):
        (run / FILE).unlink(missing_ok=True)
