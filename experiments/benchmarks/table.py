"""From repetitions to figures: medians, quartiles, ratios, goals, and the table. numpy only.

A series is a list of rounds, a round a list of repetitions. What counts of a round is its median.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

Series = Sequence[Sequence[float]]


class Goal(NamedTuple):
    """A limit for the ratio, or for this project's own figure.

    Attributes:
        of: "ratio" or "ours".
        sign: ">=", "<=" or "<".
        limit: in the row's unit where it is for "ours".
    """

    of: str
    sign: str
    limit: float

    def met(self, value: float) -> bool:
        """Whether the value keeps to it."""
        if self.sign == ">=":
            return value >= self.limit
        return value < self.limit if self.sign == "<" else value <= self.limit


class Spread(NamedTuple):
    """A median over rounds and its quartiles."""

    median: float
    low: float
    high: float


class Figures(NamedTuple):
    """What a row shows.

    Attributes:
        ours, theirs, ratio: over rounds; theirs and the ratio are None where there is no other side.
        label: which of the other side's candidates counts.
        met: whether all goals are.
    """

    ours: Spread
    theirs: Spread | None
    ratio: Spread | None
    label: str
    met: bool


def spread(values: Sequence[float]) -> Spread:
    """The median and the quartiles (linearly interpolated) of one figure a round."""
    low, median, high = np.percentile(values, (25, 50, 75)).tolist()
    return Spread(median, low, high)


def medians(series: Series) -> list[float]:
    """Each round's median."""
    return [float(np.median(repetitions)) for repetitions in series]


def figures(ours: Series, theirs: dict[str, Series], speedup: bool, goals: Sequence[Goal]) -> Figures:
    """A row's figures.

    Args:
        ours: this project's repetitions, round by round.
        theirs: {label: the other side's}, with as many rounds; where there are several, the one with the
            least median counts, so they must be times. May be empty.
        speedup: the ratio is theirs to ours; else ours to theirs. It is formed round by round.
        goals: all must be met; may be empty.
    """
    own = medians(ours)
    found = {"ours": spread(own)}
    label, other = "", None
    if theirs:
        label = min(theirs, key=lambda name: spread(medians(theirs[name])).median)
        other = medians(theirs[label])
        pairs = zip(other, own, strict=True) if speedup else zip(own, other, strict=True)
        found["ratio"] = spread([a / b for a, b in pairs])
    met = all(goal.met(found[goal.of].median) for goal in goals)
    return Figures(found["ours"], spread(other) if other else None, found.get("ratio"), label, met)


def number(value: float) -> str:
    """Three significant digits, without an exponent."""
    if not value or not math.isfinite(value):
        return str(value)
    return f"{value:.{max(0, 2 - math.floor(math.log10(abs(value))))}f}"


def spread_text(found: Spread | None, unit: str = "") -> str:
    """`median unit (low to high)`."""
    if found is None:
        return "-"
    middle = f"{number(found.median)} {unit}".strip()
    if found.low == found.high:
        return middle
    return f"{middle} ({number(found.low)} to {number(found.high)})"


def goals_text(goals: Sequence[Goal], unit: str) -> str:
    """Goals in words; a ratio has no unit."""
    return ", ".join(
        f"{goal.sign} {goal.limit:g}" + (f" {unit}" if goal.of == "ours" else "") for goal in goals
    )


def cells(title: str, unit: str, found: Figures, goals: Sequence[Goal]) -> list[str]:
    """One line of the table."""
    theirs = spread_text(found.theirs, unit)
    return [
        title,
        spread_text(found.ours, unit),
        f"{theirs}, {found.label}" if found.label else theirs,
        spread_text(found.ratio),
        goals_text(goals, unit) or "-",
        ("yes" if found.met else "no") if goals else "-",
    ]


def skipped_cells(title: str, unit: str, goals: Sequence[Goal]) -> list[str]:
    """The line of a row that was not measured."""
    return [title, "skipped", "not installed", "-", goals_text(goals, unit), "-"]


def markdown(rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table with columns that line up in a terminal too; ends with a newline."""
    head = ["name", "this project", "the other side", "ratio", "goal", "met?"]
    widths = [max(len(row[i]) for row in (head, *rows)) for i in range(len(head))]
    rule = ["-" * width for width in widths]
    lines = [
        "| " + " | ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) + " |"
        for row in (head, rule, *rows)
    ]
    return "\n".join(lines) + "\n"


def as_json(found: Figures, goals: Sequence[Goal]) -> dict[str, Any]:
    """Figures and goals as JSON holds them."""
    values: dict[str, Any] = {
        name: value._asdict() if isinstance(value, Spread) else value
        for name, value in found._asdict().items()
    }
    return values | {"goals": [goal._asdict() for goal in goals]}
