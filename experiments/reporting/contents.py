"""What all sections of a report start from, and how they show intervals."""

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


class Report(NamedTuple):
    """What all sections start from.

    Attributes:
        root: where the runs are.
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

    root: Path
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


def run_name(run: RunData) -> str:
    """A run as a reader finds it."""
    return f"{run.game} / {run.arm} / seed {run.seed}"


def limits(interval: Interval) -> str:
    """[low, high], or that there is none."""
    if np.isnan(interval.low):
        return "(no interval)"
    return f"[{number(float(interval.low))}, {number(float(interval.high))}]"


def side(interval: Interval) -> int:
    """1 or -1 where the interval is above or below 0, else 0."""
    return int(interval.low > 0) - int(interval.high < 0)
