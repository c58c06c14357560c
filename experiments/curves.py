"""The picture that compares arms: a panel a game, mean evaluation return against env steps."""

import os
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from . import plots
from .colours import Style, styles


class Line(NamedTuple):
    """One arm on one game.

    Attributes:
        label: in the legend; the same arm has the same one in all panels.
        steps: env steps [N].
        mean: [N] over seeds.
        low, high: [N], limits of its interval; NaN where there is none.
        seeds: how many.
        thesis: (env steps, returns) of the thesis' own curve, or None.
    """

    label: str
    steps: Sequence[float]
    mean: Sequence[float]
    low: Sequence[float]
    high: Sequence[float]
    seeds: int
    thesis: tuple | None = None


class Level(NamedTuple):
    """A published result, or what a reference policy scores: a horizontal line.

    Attributes:
        method: whose, at the line; of a policy "random" or "no-op".
        score: where it is.
        differs: what differs from the runs that are drawn, below the figure; may be empty.
    """

    method: str
    score: float
    differs: str = ""


class Panel(NamedTuple):
    """One game."""

    title: str
    lines: Sequence[Line]
    levels: Sequence[Level] = ()
    policies: Sequence[Level] = ()


def comparison(
    panels: Sequence[Panel],
    path: str | os.PathLike,
    title: str,
    note: str = "",
    looks: Mapping[str, Style] | None = None,
) -> Path:
    """Draws a panel a game; bands are intervals over seeds.

    The thesis' curves are dashed, in their arm's colour, and end where the panel's longest line does.

    Args:
        panels: at least one, with at least one line.
        path: of the PNG file.
        title: of the figure.
        note: below it; lines.
        looks: label -> colour and line; None for those that the labels have by themselves.
    """
    columns = min(len(panels), 3)
    rows = -(-len(panels) // columns)
    labels = list(dict.fromkeys(line.label for panel in panels for line in panel.lines))
    looks = looks or styles(labels)
    width = 4.6 if columns > 1 else 6.4
    figure = plots.new_figure(width * columns, 3.5 * rows + 0.24 * len(labels) + 0.7)
    handles: dict[str, object] = {}
    for i, panel in enumerate(panels):
        axes = figure.add_subplot(
            rows, columns, i + 1, xlabel=plots.steps_label(panel.title), ylabel="mean return"
        )
        axes.set_title(panel.title, fontsize=10, parse_math=False)
        end = max((max(line.steps) for line in panel.lines if len(line.steps)), default=1)
        for line in panel.lines:
            if not len(line.steps):
                continue
            colour, pattern = looks[line.label]
            axes.fill_between(line.steps, line.low, line.high, color=colour, alpha=0.18, linewidth=0)
            (handle,) = axes.plot(line.steps, line.mean, pattern, color=colour, linewidth=1.8)
            handles.setdefault(f"{line.label} ({_seeds(panels, line.label)})", handle)
            if line.thesis is not None:
                steps, returns = (np.asarray(x, float) for x in line.thesis)
                at = np.unique(np.minimum(steps, end))
                (dashed,) = axes.plot(
                    at, np.interp(at, steps, returns), "--", color=colour, linewidth=1.2, alpha=0.8
                )
                handles["the thesis' own, one run each"] = dashed
        plots.count_axis(axes)
        axes.set_xlim(0, end)
        levels = [x.score for x in (*panel.levels, *panel.policies)]
        shown = np.concatenate([*(line.get_ydata() for line in axes.lines), levels])
        if len(shown):
            bands = np.concatenate([limit for line in panel.lines for limit in (line.low, line.high)])
            axes.set_ylim(*plots.heights(shown, bands))
        others = [(x.method, x.score) for x in panel.levels]
        plots.levels(axes, {x.method: x.score for x in panel.policies}, others)
    known = "the thesis' own, one run each"
    if known in handles:  # last, and in no arm's colour
        from matplotlib.lines import Line2D

        del handles[known]
        handles[known] = Line2D([], [], color="#555555", linestyle="--", linewidth=1.2)
    notes = note.splitlines()
    for panel in panels:
        shown = [x._replace(method=f"{x.method} policy") for x in panel.policies] + list(panel.levels)
        notes += [f"{panel.title}, {x.method}, {x.score:g}: {x.differs}" for x in shown if x.differs]
    characters = int(17 * width * columns)
    notes = [line for text in notes for line in textwrap.wrap(text, characters, subsequent_indent="    ")]
    legend = figure.legend(
        handles.values(),
        handles.keys(),
        loc="outside lower center",
        ncols=1 if columns == 1 else 2,
        fontsize=8,
        title="\n".join(notes),
        title_fontsize=7,
        alignment="left",
        frameon=False,
    )
    legend.get_title().set_parse_math(False)
    figure.suptitle(title, fontsize=11).set_parse_math(False)
    return plots.save(figure, path)


def _seeds(panels: Sequence[Panel], label: str) -> str:
    counts = sorted({line.seeds for panel in panels for line in panel.lines if line.label == label})
    number = " or ".join(map(str, counts))
    return f"{number} seed{'' if counts == [1] else 's'}"
