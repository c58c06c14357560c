"""How far a run is, from its directory; and what its launcher knows beside that. Imports no jax.

ROOT/state/NAME.json says where a run was last started, by which process, and how it ended; ROOT/logs/NAME.log
has what it printed. Neither decides what is left to do: the run's directory does.
"""

import json
import os
import platform
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from srl_jax import checkpoint, resuming, rundir
from srl_jax.checkpoint import NUMBERS, PARAMS
from srl_jax.config import INFOS, Config, another_run, difference
from srl_jax.errors import ConfigError
from srl_jax.metrics import Mark
from srl_jax.reading import SETTINGS, parse_json, read_bytes

from . import manifest as manifests


class State(NamedTuple):
    """How far a run is.

    Attributes:
        kind: "missing", "resumable", "done", "busy" (a process writes there) or "broken".
        env_steps: of its last checkpoint.
        reason: why it is busy or broken.
    """

    kind: str
    env_steps: int = 0
    reason: str = ""


class Record(NamedTuple):
    """What a launcher knows of a run; times are seconds since 1970.

    Attributes:
        host, pid, cores: where it was last started; the process is the run's own.
        attempts: how often it was started.
        started, ended: the last attempt; `ended` is None until it has.
        status: its exit status, negative for a signal; None until it has ended.
        reason: why it did not end well.
    """

    host: str
    pid: int
    cores: tuple[int, ...] = ()
    attempts: int = 1
    started: float = 0.0
    ended: float | None = None
    status: int | None = None
    reason: str = ""


def look(path: Path, config: Config) -> State:
    """How far a run is; reads a few small files and writes nothing.

    A run is done if its last checkpoint is of a run that has ended and its rows are there. What has to be
    read in whole to be sure of is left to `prepare`.

    Args:
        path: of the run directory.
        config: that the run has to have, resolved.

    Raises:
        ConfigError: a run of another configuration lies there, or one that this version cannot read.
    """
    try:
        blank = resuming.blank(path)
        problem = "" if blank else _config_problem(path, config)
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from None
    try:
        rundir.check_free(path)
    except ConfigError as error:
        return State("busy", reason=_without_flag(error))
    if blank:
        return State("resumable" if (path / "config.json").exists() else "missing")
    if problem:
        return State("broken", reason=problem)
    try:
        found = checkpoint.read_manifest(path)
    except ConfigError:
        return State("resumable")  # from an older one, or not begun: `prepare` finds out
    if NUMBERS in found.files or another_run(found.config, config):
        return State("resumable", found.env_steps)
    if (problem := _incomplete(path, found)) is not None:
        return State("broken", found.env_steps, problem)
    return State("done", found.env_steps)


def _config_problem(path: Path, config: Config) -> str:
    """Why config.json cannot be read, or "".

    Raises:
        ConfigError: it can, and is another configuration's or another version's.
    """
    try:
        if not isinstance(parse_json(read_bytes(path / "config.json", SETTINGS)), dict):
            return "config.json: not a JSON object"
    except (OSError, ValueError) as error:
        return f"config.json: {getattr(error, 'strerror', None) or error}"
    names = [name for name in INFOS if name != "imports"]  # which may lie elsewhere by now
    if differing := difference(Config.load(path), config, names):
        raise ConfigError(
            f"{path}: the run there has another configuration: {differing}; give the flags that it was run "
            "with, another --out, or move it away"
        )
    return ""


def _incomplete(path: Path, found: checkpoint.Manifest) -> str | None:
    """What is missing of a run that has ended."""
    try:
        if (found.path / PARAMS).stat().st_size != found.files[PARAMS].bytes:
            return f"{PARAMS} has not the size that the manifest knows"
        with open(path / "metrics.jsonl", "rb") as file:
            file.seek(-1, os.SEEK_END)
            if file.read(1) != b"\n":
                return "the last row of metrics.jsonl is cut short"
    except OSError as error:
        return f"{os.path.basename(error.filename or 'metrics.jsonl')}: {error.strerror}"
    return None


def prepare(path: Path, config: Config, say: Callable[[str], None]) -> State:
    """`look`, then everything that resuming needs is read and compared; what is broken is moved aside.

    Args:
        path, config: see `look`.
        say: gets a line about what was moved aside.

    Returns:
        "done", "busy", or where a run can be started: "missing" or "resumable".

    Raises:
        ConfigError: see `look`.
    """
    state = look(path, config)
    if state.kind not in ("resumable", "broken"):
        return state
    try:
        with rundir.held(path):
            reason = state.reason if state.kind == "broken" else _broken(path, config)
            if not reason:
                return state
            aside = _aside(path)
            path.rename(aside)
            (aside / rundir.LOCK).unlink(missing_ok=True)
    except ConfigError as error:  # from `held`
        return State("busy", reason=_without_flag(error))
    except OSError as error:
        raise ConfigError(f"{path}: broken ({reason}) and not moved aside: {error.strerror}") from None
    say(f"{path}: broken: {reason}; moved aside to {aside.name}, and run anew")
    return State("missing")


def _broken(path: Path, config: Config) -> str:
    """Why a run cannot be resumed from any of its checkpoints, or ""."""
    try:
        found = checkpoint.newest_good(path, lambda line: None)
        if found is None:
            if (steps := resuming.reached(path)) >= resuming.first_checkpoint(config):
                return f"got to {steps} env steps, and there is no checkpoint"
            return ""
        if differing := another_run(found.config, config):
            return f"{found.path.name} is of another configuration: {differing}"
        mark = Mark(**checkpoint.load_numbers(found)["report"]["metrics"])
        if (path / "metrics.jsonl").stat().st_size < mark.bytes:
            return f"metrics.jsonl has fewer rows than {found.path.name} knows"
    except (ConfigError, KeyError, TypeError) as error:
        return str(error)
    except OSError as error:
        return f"metrics.jsonl: {error.strerror}"
    return ""


def _aside(path: Path) -> Path:
    number = 1
    while os.path.lexists(aside := path.with_name(f"{path.name}.broken-{number}")):
        number += 1
    return aside


def _without_flag(error: Exception) -> str:
    """The holder of a directory, from the line that refuses it."""
    return str(error).partition(": ")[2].partition(";")[0]


def record_path(root: Path, name: str) -> Path:
    """Where a run's record lies."""
    return root / "state" / f"{name}.json"


def log_path(root: Path, name: str) -> Path:
    """Where a run's output lies."""
    return root / "logs" / f"{name}.log"


def read_record(root: Path, name: str) -> Record | None:
    """What a launcher last wrote of a run; None where there is nothing that can be read."""
    try:
        values = parse_json(read_bytes(record_path(root, name), SETTINGS))
        record = Record(**{**values, "cores": tuple(values["cores"])})
        numbers = (record.pid, record.attempts, *record.cores)
        times = (record.started, record.ended or 0.0)
        texts = (record.host, record.reason)
        fine = all(type(x) is int for x in numbers) and all(type(x) in (int, float) for x in times)
        return record if fine and all(type(x) is str for x in texts) else None
    except (OSError, ValueError, TypeError, KeyError):
        return None


def write_record(root: Path, name: str, record: Record) -> None:
    """Writes a run's record.

    Raises:
        SaveError: it could not be written.
    """
    manifests.replace(record_path(root, name), json.dumps(record._asdict()) + "\n")


def last_line(root: Path, name: str) -> str:
    """The last line of a run's log that is not blank, "" where there is none; without `error: ` before it."""
    try:
        with open(log_path(root, name), "rb") as file:
            file.seek(0, os.SEEK_END)
            file.seek(max(file.tell() - 8192, 0))
            lines = file.read().decode("utf-8", "replace").replace("\r", "\n").split("\n")
    except OSError:
        return ""
    line = next((line.strip() for line in reversed(lines) if line.strip()), "")
    return "".join(c for c in line.removeprefix("error: ") if c.isprintable())


def alive(record: Record) -> bool:
    """Whether the process of a run is still there; False, too, where it is another machine's."""
    if record.ended is not None or record.host != host():
        return False
    try:
        os.kill(record.pid, 0)
    except (OSError, OverflowError):
        return False
    return True


def host() -> str:
    """The name of this machine."""
    return platform.node()
