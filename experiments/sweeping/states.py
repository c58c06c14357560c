"""How far a run is, as its directory says, and whether it failed, as its log does.

Imports no jax, but where a run is of an earlier version, to see what its configuration means.

ROOT/logs/NAME.log has what the run's processes printed, and lines of the sweep. It decides nothing: what is
left to do, the run's directory says.
"""

import os
import re
import time
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from srl_jax.config import INFOS, Config
from srl_jax.errors import ConfigError, saving
from srl_jax.files import checkpoint, resuming, rundir
from srl_jax.files.checkpoint import NUMBERS
from srl_jax.run import ending

from ..runs.collect import difference_in_meaning
from .manifest import Entry


class State(NamedTuple):
    """How far a run is.

    Attributes:
        kind: "missing", "resumable", "done" or "busy" (a process writes there).
        env_steps: of its last checkpoint.
        reason: which process writes there, or what a run that has ended lacks.
    """

    kind: str
    env_steps: int = 0
    reason: str = ""


def look(path: Path, config: Config) -> State:
    """How far a run is; reads a few small files and writes nothing.

    A run is done if its last checkpoint is of a run that has ended and its rows are there. One that was
    packed and unpacked has no checkpoints; it is done if it had finished.

    Args:
        path: of the run directory.
        config: that the run has to have, resolved.

    Raises:
        ConfigError: something else lies there: a run of another configuration, or one that this version
            cannot read.
    """
    try:
        blank = resuming.blank(path)
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from None
    if not blank:
        names = [name for name in INFOS if name not in ("imports", "loggers")]  # may be others by now
        if differing := difference_in_meaning(Config.load(path), config, names):
            raise ConfigError(
                f"{path}: the run there has another configuration: {differing}; give the flags that it was "
                "run with, another --out, or move it away"
            )
    try:
        rundir.check_free(path)
    except ConfigError as error:
        return State("busy", reason=holder(error))
    if blank:
        return State("missing")
    ended = ending.read(path)
    finished = ended is not None and ended.status == "finished"
    if finished and not (path / "checkpoints").exists():
        return State("done", ended.env_steps)
    try:
        found = checkpoint.read_manifest(path)
    except ConfigError:
        return State("resumable")  # from an older one, or not begun: the run itself finds out
    over = NUMBERS not in found.files or finished  # of --keep_replay
    if not over or _another_run(found.config, config):
        return State("resumable", found.env_steps)
    lacks = resuming.lacks(path, found) or ("" if finished else f"{ending.FILE}, which says that it is over")
    return State("resumable" if lacks else "done", found.env_steps, lacks)


def _another_run(there: Config, here: Config) -> str:
    return difference_in_meaning(there, here, (), lambda a, b, _: resuming.another_run(a, b))


def holder(error: ConfigError) -> str:
    """Which process holds a directory, from the line of `rundir.check_free`."""
    return str(error).partition(": ")[2].partition(" is writing")[0]


def look_at_all(root: Path, entries: Mapping[str, Entry]) -> dict[str, State]:
    """{name: how far it is} of runs that are to be run in a directory.

    Raises:
        ConfigError: they cannot be run there.
    """
    if (root / "config.json").exists():
        raise ConfigError(f"--out={root}: a run directory; name another one, the sweep's runs are made in it")
    return {name: look(root / name, entry.config) for name, entry in entries.items()}


def log_path(root: Path, name: str) -> Path:
    """Where a run's output lies."""
    return root / "logs" / f"{name}.log"


def note(root: Path, name: str, text: str) -> None:
    """Adds a line of the sweep's own to a run's log.

    Raises:
        SaveError: it could not be written.
    """
    path = log_path(root, name)
    with saving(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(path, "a", encoding="utf-8", errors="backslashreplace") as log:
            log.write(f"--- {time.strftime('%Y-%m-%d %H:%M:%S')} {text}\n")


def last_line(root: Path, name: str) -> str:
    """The last line of a run's log that is not blank, "" where there is none."""
    try:
        with open(log_path(root, name), "rb") as file:
            file.seek(max(file.seek(0, os.SEEK_END) - 8192, 0))
            lines = file.read().decode("utf-8", "replace").replace("\r", "\n").split("\n")
    except OSError:
        return ""
    line = next((line.strip() for line in reversed(lines) if line.strip()), "")
    return "".join(c for c in line if c.isprintable())


def failure(root: Path, name: str) -> str:
    """Why a run failed, by the last line of its log; "" where it did not, or was started again since.

    A run that no sweep has run says so in its directory, ended.json.
    """
    if line := last_line(root, name):
        told = re.fullmatch(r"--- \S+ \S+ failed: (.+)", line)
        return told[1] if told else ""
    try:
        ended = ending.read(root / name)
    except ConfigError as error:
        return str(error)
    return ended.reason if ended is not None and ended.failed else ""
