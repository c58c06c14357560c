"""A run read from disk, as figures and reports use it. Imports no jax."""

import os
import re
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from srl_jax import ending
from srl_jax.config import Config
from srl_jax.diagnostics.rows import STEPS, drift_matrix, drift_names
from srl_jax.ending import Ending
from srl_jax.errors import ConfigError
from srl_jax.metrics import KINDS, read_metrics
from srl_jax.reading import SETTINGS, parse_json, read_bytes
from srl_jax.specs import LIMITS

from .directories import runs_below


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
    def failed(self) -> bool:
        """Whether it ended with an error, and is not under way."""
        return self.ended is not None and self.ended.failed


def arm_name(path: Path) -> str:
    """The arm of a run directory: its parent's name if it is called seedN, else its own without _seedN."""
    path = Path(os.path.abspath(path))  # of ".", too
    if re.fullmatch(r"seed\d+", path.name):
        return path.parent.name
    return re.sub(r"_seed\d+$", "", path.name)


def load_run(path: Path) -> RunData:
    """Reads a run directory.

    Raises:
        ConfigError: it is none, or what it holds is not what training writes.
    """
    config = Config.load(path)
    metrics = path / "metrics.jsonl"
    rows = read_rows(metrics) if metrics.exists() else []
    about = parse_json(read_bytes(path / "config.json", SETTINGS))
    return RunData(path, config.game, arm_name(path), config.seed, config, rows, ending.read(path), about)


def run_directories(root: Path) -> list[Path]:
    """The run directories in or below another, without what was moved aside as broken.

    Raises:
        ConfigError: a directory cannot be read.
    """
    below = runs_below(root)
    return [path for path in below if not any(".broken-" in part for part in path.relative_to(root).parts)]


def read_rows(path: Path) -> list[dict]:
    """`srl_jax.metrics.read_metrics`, with what is drawn of each row checked.

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
            if key in ("eval/returns", STEPS):
                good = isinstance(value, list) and all(map(_is_count if key == STEPS else _is_number, value))
            elif kind == "diag" and isinstance(value, list):
                good = all(map(_is_number, value))
            else:
                drawn = kind in ("loss", "grad_norm", "diag") or key == "eval/return_mean"
                good = not drawn or _is_number(value)
            if not good:
                raise ConfigError(f"{name}, line {number}: {key} is not made of numbers of single precision")
    for kind in drift_names(rows):
        try:
            drift_matrix(rows, kind)
        except ValueError as error:
            raise ConfigError(f"{name}: {error}") from None


def _is_count(value: Any) -> bool:
    return type(value) is int and 0 <= value <= LIMITS[int]


def _is_number(value: Any) -> bool:
    """Whether a value is a number that single precision holds, or null."""
    return value is None or (type(value) in (int, float) and abs(value) <= LIMITS[float])
