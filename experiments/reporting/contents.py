"""What all sections of a report start from, and how they show intervals."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from srl_jax.statistics import NARROW, Interval

from .. import collect
from ..collect import RunData
from ..colours import Style, styles
from .markup import Markup, number
from .numbers import Comparison, Row

Content = Markup | list | None
"""Of a section; None for none."""


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

    @property
    def styles(self) -> dict[str, Style]:
        """How each arm is drawn, in all pictures of the page."""
        return styles(self.arms)

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


def name_of(root: Path) -> Path:
    """The name of a directory, also of "." and "..": what lies above is nobody's business."""
    return Path(os.path.basename(os.path.abspath(root)))


def run_name(run: RunData) -> str:
    """A run as a reader finds it."""
    return f"{run.game} / {run.arm} / seed {run.seed}"


def limits(interval: Interval, shown: Callable[[float], str] = number) -> str:
    """[low, high], and a word where few runs make it too narrow; or that there is none."""
    if np.isnan(interval.low):
        return "(no interval)"
    narrow = " too narrow" if interval.kind == NARROW else ""
    return f"[{shown(float(interval.low))}, {shown(float(interval.high))}]{narrow}"


def signed(value: float) -> str:
    """A difference: +0.24, −0.24 or 0.00."""
    text = number(value)
    return f"+{text}" if value > 0 and text.strip("0.,") else text


def difference_text(interval: Interval) -> str:
    """A difference and its limits, all with their signs."""
    return f"{signed(float(interval.point))} {limits(interval, signed)}"


def side(interval: Interval) -> int:
    """1 or -1 where the interval of a difference is above or below 0; else 0, as where it is too narrow."""
    if interval.kind == NARROW:
        return 0
    return int(interval.low > 0) - int(interval.high < 0)
