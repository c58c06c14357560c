"""A run read from disk, as figures and reports use it. Imports no jax."""

import os
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from srl_jax import config
from srl_jax.config import Config
from srl_jax.diagnostics.drift import STEPS, drift_matrix, drift_names
from srl_jax.errors import ConfigError
from srl_jax.files.metrics import KINDS, read_metrics
from srl_jax.files.rundir import ASIDE
from srl_jax.run import ending
from srl_jax.run.ending import Ending
from srl_jax.specs import LIMITS


class RunData(NamedTuple):
    """One run, finished or not.

    Attributes:
        path: of the run directory; of a run that is packed, where its pictures would lie.
        game, arm, seed: what it is a run of.
        config: its config.json.
        rows: of its metrics.jsonl; none if it has not begun.
        ended: how, or None: it is under way, or was killed, or is of before that was written.
        about: all that its config.json holds: the settings, and what made the run.
    """

    path: Path
    game: str
    arm: str
    seed: int
    config: Config
    rows: list[dict]
    ended: Ending | None = None
    about: Mapping[str, Any] = MappingProxyType({})

    @property
    def key(self) -> tuple[str, str, int]:
        """What it is a run of: (game, arm, seed)."""
        return self.game, self.arm, self.seed

    @property
    def failed(self) -> bool:
        """Whether it ended with an error, and is not under way."""
        return self.ended is not None and self.ended.failed

    @property
    def over(self) -> bool:
        """Whether it has ended and was not stopped, or has all its env steps: earlier versions did not say.

        These had no final games, which a run with all its env steps may still be playing.
        """
        if self.ended is not None or self.config.final_games:
            return self.ended is not None and self.ended.status != "stopped"
        return bool(self.rows) and self.rows[-1]["env_steps"] >= self.config.steps


def in_order(runs: Iterable[RunData]) -> list[RunData]:
    """Runs by game, arm and seed."""
    return sorted(runs, key=lambda run: (run.game, natural(run.arm), run.seed))


def is_seed(name: str) -> bool:
    """Whether a run directory of this name, seedN, has its arm's name in its parent's."""
    return bool(re.fullmatch(r"seed\d+", name))


def arm_name(path: Path) -> str:
    """The arm of a run directory: its parent's name if it is called seedN, else its own without _seedN."""
    path = Path(os.path.abspath(path))  # of ".", too
    if is_seed(path.name):
        return path.parent.name
    return re.sub(r"_seed\d+$", "", path.name)


def check_arm(arm: str, path: Path) -> str:
    """The name of an arm, as it is.

    Raises:
        ConfigError: it has a character that tables and figures cannot show.
    """
    if odd := next((character for character in arm if not character.isprintable()), ""):
        raise ConfigError(f"{path}: {arm!a} has the character {odd!a}; name the arm with printable ones")
    return arm


def load_run(path: Path) -> RunData:
    """Reads a run directory.

    Raises:
        ConfigError: it is none, or what it holds is not what training writes.
    """
    its, about = config.read(path)
    metrics = path / "metrics.jsonl"
    rows = read_rows(metrics) if metrics.exists() else []
    arm = check_arm(arm_name(path), path)
    return RunData(path, its.game, arm, its.seed, its, rows, ending.read(path), about)


def runs_below(root: Path, file: str = "config.json") -> list[Path]:
    """Directories with a config.json, or another file, in or below a directory.

    Links are followed: a run may lie elsewhere.

    Each is found once: by its own path where that is below, else by the first link to it. A link to what the
    link or the root lies in is not followed.

    Returns:
        As `natural` sorts them.

    Raises:
        ConfigError: a directory cannot be read.
    """

    def refuse(error: OSError) -> None:
        if not isinstance(error, FileNotFoundError):  # removed meanwhile, by a run that is under way
            raise ConfigError(f"{error.filename}: {error.strerror}")

    found: list[str] = []
    seen: set[str] = set()
    waiting = [os.fspath(root)]
    while waiting:
        links: list[str] = []
        for top in waiting:
            for folder, folders, files in os.walk(top, onerror=refuse):
                real = os.path.realpath(folder)
                if real in seen:
                    folders.clear()
                    continue
                seen.add(real)
                if file in files and os.path.isfile(os.path.join(folder, file)):
                    found.append(folder)
                paths = [os.path.join(folder, name) for name in folders]
                links += [path for path in paths if os.path.islink(path) and not _around(path, real, root)]
        waiting = sorted(links, key=natural)
    return [Path(folder) for folder in sorted(found, key=natural)]


def _around(link: str, *places: str | Path) -> bool:
    """Whether a link leads to a directory in which one of the places lies."""
    return any(Path(os.path.realpath(place)).is_relative_to(os.path.realpath(link)) for place in places)


def natural(text: str) -> list:
    """A key for sorting names with numbers in them by these: seed2 before seed10, x03 (0.3) before x1."""
    parts = re.split(r"(\d+)", text)
    return [float(re.sub(r"^0(?=\d)", "0.", part)) if i % 2 else part for i, part in enumerate(parts)]


def run_directories(root: Path) -> list[Path]:
    """The run directories in or below another, without what was moved aside as broken or to be overwritten.

    Raises:
        ConfigError: a directory cannot be read.
    """
    below = runs_below(root)
    aside = re.compile(rf"\.broken-|^{re.escape(ASIDE)}")
    return [path for path in below if not any(map(aside.search, path.relative_to(root).parts))]


def read_rows(path: Path) -> list[dict]:
    """`srl_jax.files.metrics.read_metrics`, with what is drawn of each row checked.

    Raises:
        ConfigError: it cannot be read, or holds something else than training writes; one line.
    """
    try:
        rows = read_metrics(path)
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from None
    except ValueError as error:
        raise ConfigError(str(error)) from None
    check_rows(rows, str(path))
    return rows


def check_rows(rows: list[dict], name: str) -> None:
    """Whether what is drawn of rows is what training writes.

    Args:
        rows: as `read_metrics` gives them.
        name: what they are the rows of, for errors.

    Raises:
        ConfigError: it is something else; one line.
    """
    for number, row in enumerate(rows, 1):
        if row.get("kind") not in KINDS:
            raise ConfigError(f"{name}, line {number}: kind is none of {', '.join(KINDS)}")
        if not _is_count(row.get("env_steps")):
            raise ConfigError(f"{name}, line {number}: env_steps is no count")
        for key, value in row.items():
            kind = key.partition("/")[0]
            if key == "final/games":
                good = _is_count(value)
            elif key == STEPS:
                good = isinstance(value, list) and all(map(_is_count, value))
            elif key in ("eval/returns", "final/returns"):
                good = isinstance(value, list) and _are_numbers(value)
            elif kind == "diag" and isinstance(value, list):
                good = _are_numbers(value)
            else:
                means = ("eval/return_mean", "final/return_mean")
                drawn = kind in ("loss", "grad_norm", "diag") or key in means
                good = not drawn or _are_numbers([value])
            if not good:
                raise ConfigError(f"{name}, line {number}: {key} is not made of numbers of single precision")
    for kind in drift_names(rows):
        try:
            drift_matrix(rows, kind)
        except ValueError as error:
            raise ConfigError(f"{name}: {error}") from None


def _is_count(value: Any) -> bool:
    return type(value) is int and 0 <= value <= LIMITS[int]


def _are_numbers(values: list) -> bool:
    """Whether all values are numbers that single precision holds, or null."""
    most = LIMITS[float]
    if not {*map(type, values)} <= {int, float, type(None)}:
        return False
    return all(-most <= value <= most for value in values if value is not None)
