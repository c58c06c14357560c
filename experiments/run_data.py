"""A run read from disk, as figures and reports use it. Imports no jax."""

import os
import re
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from srl_jax import ending
from srl_jax.config import Config
from srl_jax.ending import Ending
from srl_jax.reading import SETTINGS, parse_json, read_bytes

from .directories import runs_below
from .draw import read_rows


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
