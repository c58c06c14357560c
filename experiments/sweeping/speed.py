"""How fast runs are, how far they have got, and how long what is left will take. Imports no jax.

A speed is env steps over seconds of whole runs, evaluations and compilation included, as metrics.jsonl has
them.
"""

import json
import os
from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from srl_jax import envs
from srl_jax.config import Config
from srl_jax.errors import ConfigError

from .. import packing
from .manifest import Entry

RESULTS = Path(__file__).resolve().parents[1] / "results"
"""Runs that the project has published."""

TAIL = 1 << 18
"""Bytes at the end of a metrics.jsonl that are read."""


class Progress(NamedTuple):
    """How far a run is.

    Attributes:
        env_steps: of its last row.
        seconds: that it has run.
        per_s: env steps a second of late; None while unknown.
        evaluation: the last mean return, None where there is none.
    """

    env_steps: int = 0
    seconds: float = 0.0
    per_s: float | None = None
    evaluation: float | None = None


class Speed(NamedTuple):
    """Env steps a second, and where that was measured."""

    per_s: float
    source: str


def last_rows(path: Path, tail: int = TAIL) -> list[dict[str, Any]]:
    """The rows in the last so many bytes of a metrics.jsonl; none where there is none."""
    try:
        with open(path, "rb") as file:
            size = file.seek(0, os.SEEK_END)
            file.seek(max(size - tail, 0))
            lines = file.read().split(b"\n")
    except OSError:
        return []
    rows = []
    for line in lines[int(size > tail) : -1]:
        try:
            row = json.loads(line)
            if isinstance(row, dict) and type(row["env_steps"]) is int and row["wall_s"] >= 0:
                rows.append(row)
        except (ValueError, KeyError, TypeError, RecursionError):
            continue
    return rows


def progress(run: Path, tail: int = TAIL) -> Progress:
    """How far the run in a directory is, from its last rows: those in so many bytes."""
    return progress_of(last_rows(run / "metrics.jsonl", tail))


def progress_of(rows: Sequence[Mapping[str, Any]]) -> Progress:
    """How far a run is, from its last rows."""
    if not rows:
        return Progress()
    returns = [row.get("eval/return_mean") for row in rows if row.get("kind") == "eval"]
    train = [row for row in rows if row.get("kind") == "train"][-10:]
    per_s = None
    if len(train) > 1:
        steps, seconds = (train[-1][key] - train[0][key] for key in ("env_steps", "wall_s"))
        per_s = steps / seconds if steps > 0 and seconds > 0 else None
    evaluation = returns[-1] if returns and isinstance(returns[-1], int | float) else None
    return Progress(rows[-1]["env_steps"], float(rows[-1]["wall_s"]), per_s, evaluation)


def keys(config: Config) -> tuple[tuple, tuple]:
    """What makes runs about as fast as each other: strictly, and where there is nothing better."""
    loose = envs.known(config.game).kind, config.encoder, config.mode
    return (*loose, config.batch_size, config.updates_per_step, config.srl_every, config.frame_size), loose


class Speeds:
    """Speeds that were measured, with runs of a sweep and, for what these do not know, with published ones.

    Args:
        root: of the sweep.
        entries: of its manifest.
        results: a directory with packed runs below it.
    """

    def __init__(self, root: Path, entries: Iterable[Entry], results: Path = RESULTS):
        self.tables = [
            (
                self._table((progress(root / run.name, 1 << 15), config) for run, config in entries),
                "runs of this sweep",
            )
        ]
        self.results = results

    def of(self, config: Config) -> Speed | None:
        """How fast a run will be; None where nothing like it was measured."""
        if len(self.tables) == 1 and not any(key in self.tables[0][0] for key in keys(config)):
            self.tables.append((self._table(_published(self.results)), "published runs, on their machine"))
        for which, note in zip((0, 1), ("", ", of other settings"), strict=True):
            for table, source in self.tables:
                if found := table.get(keys(config)[which]):
                    return Speed(found[0] / found[1], source + note)
        return None

    @staticmethod
    def _table(runs: Iterable[tuple[Progress, Config]]) -> dict[tuple, tuple[float, float]]:
        """{key: (env steps, seconds)}, summed over the runs."""
        table: dict[tuple, tuple[float, float]] = defaultdict(lambda: (0.0, 0.0))
        for got, config in runs:
            if got.seconds <= 0 or got.env_steps <= 2 * config.learn_start:
                continue
            for key in keys(config):
                steps, seconds = table[key]
                table[key] = steps + got.env_steps, seconds + got.seconds
        return dict(table)


def _published(results: Path) -> Iterable[tuple[Progress, Config]]:
    for folder in packing.folders_below(results):
        try:
            yield from ((progress_of(run.rows), run.config) for run in packing.read(folder, only_last=True))
        except ConfigError:
            continue


def seconds_left(
    entries: Mapping[str, Entry],
    reached: Mapping[str, int],
    per_s: Mapping[str, float | None],
    workers: int,
    done: Collection[str] = (),
) -> tuple[float, int]:
    """The time until all runs are complete, if none stops early.

    It is the work over the number of workers, and at least that of the longest chain of runs that start from
    each other.

    Args:
        entries: {name: Entry}.
        reached: {name: env steps}; missing ones have none.
        per_s: {name: env steps a second}; None where unknown.
        workers: runs at once.
        done: names of runs that are complete.

    Returns:
        Seconds, and the number of runs that it does not count because their speed is not known.
    """
    left: dict[str, float] = {}
    unknown = 0
    for name, (_, config) in entries.items():
        steps = 0 if name in done else max(config.steps - reached.get(name, 0), 0)
        if steps and not per_s.get(name):
            unknown += 1
            steps = 0
        left[name] = steps / per_s[name] if steps else 0.0
    chains: dict[str, float] = {}
    for name, (run, _) in entries.items():  # each comes after those that it starts from
        chains[name] = left[name] + max((chains.get(source, 0.0) for source in run.sources), default=0.0)
    return max(sum(left.values()) / max(workers, 1), max(chains.values(), default=0.0)), unknown
