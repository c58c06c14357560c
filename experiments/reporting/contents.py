"""What all sections of a report start from, and how they show intervals."""

import os
from pathlib import Path
from typing import NamedTuple

import numpy as np

from experiments import collect
from experiments.collect import RunData
from experiments.reporting.markup import Markup, number
from experiments.reporting.numbers import Comparison, Row
from srl_jax.statistics import Interval

Content = Markup | list | None
"""Of a section; None for none."""
TELLING = 3
"""Seeds of both arms from which a difference is said to have a side: the interval of two is their range."""


class Report(NamedTuple):
    """What all sections start from.

    Attributes:
        roots: where the runs are.
        runs: all of them.
        arms: in their order.
        baseline: what others are compared with, or None.
        forced: lines on protocols and arms that do not fit together, and were compared all the same.
        finished_only: whether runs that have not ended were left out of the comparison.
        comparisons: game -> learning curves at equal steps.
        rows: the table of each game.
        targets: game -> the score to be reached.
        media: whether pictures of the runs are shown.
    """

    roots: list[Path]
    runs: list[RunData]
    arms: list[str]
    baseline: str | None
    forced: list[str]
    finished_only: bool
    comparisons: dict[str, Comparison | None]
    rows: list[Row]
    targets: dict[str, float]
    media: bool

    @property
    def games(self) -> list[str]:
        """All of them."""
        return list(collect.grouped(self.runs))

    def of(self, game: str, arm: str | None = None) -> list[RunData]:
        """The runs of a game, or of one arm on it."""
        return [run for run in self.runs if run.game == game and arm in (None, run.arm)]

    def place(self, run: RunData) -> Path:
        """Where a run lies, below the directory that was named; with its name where there are several."""
        root = next(root for root in self.roots if run.path.is_relative_to(root))
        below = run.path.relative_to(root)
        return below if len(self.roots) == 1 else name_of(root) / below

    def left_out(self, game: str) -> list[str]:
        """A line for each arm of a game of which seeds cannot be compared."""
        whys: dict[str, dict[int, str]] = {arm: {} for arm in self.arms}
        for run, why in collect.left_out(self.of(game)):
            whys[run.arm][run.seed] = why
        return [
            collect.left_out_text(arm, seeds, len(self.of(game, arm))) for arm, seeds in whys.items() if seeds
        ]

    def seeds_behind(self, arm: str, game: str | None = None) -> int:
        """Of a difference from the baseline: the fewest that it or the arm has, on the game or on any."""
        games = [game] if game is not None else self.comparisons
        counts = [
            len(comparison.returns.get(name, ()))
            for name in (arm, self.baseline)
            for comparison in (self.comparisons[game] for game in games)
            if comparison is not None
        ]
        return min(counts, default=0)


def name_of(root: Path) -> Path:
    """The name of a directory, also of "." and "..": what lies above is nobody's business."""
    return Path(os.path.basename(os.path.abspath(root)))


def run_name(run: RunData) -> str:
    """A run as a reader finds it."""
    return f"{run.game} / {run.arm} / seed {run.seed}"


def limits(interval: Interval) -> str:
    """[low, high], or that there is none."""
    if np.isnan(interval.low):
        return "(no interval)"
    return f"[{number(float(interval.low))}, {number(float(interval.high))}]"


def side(interval: Interval, seeds: int) -> int:
    """1 or -1 where the interval of a difference is above or below 0, else 0, as for fewer than `TELLING`."""
    if seeds < TELLING:
        return 0
    return int(interval.low > 0) - int(interval.high < 0)
