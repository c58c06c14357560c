"""Pictures of curves: panels of lines with their bands, and the differences of arms from a baseline.

matplotlib and Pillow are the extra `plots` and are imported where they are used; `available()` says
whether they can be. Figures are built as objects, without pyplot: no global state and no display.
"""

import importlib.util
import io
import os
import textwrap
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from srl_jax import envs, statistics
from srl_jax.config import Config
from srl_jax.data import reference_policies
from srl_jax.files.reading import replace_bytes

from ..runs import collect
from .colours import Style, styles

STEPS_LABEL = "env steps"
NEAR = 0.02
"""Of an axis: reference policies that are as near to each other as that share a line."""


class Curve(NamedTuple):
    """A number against env steps, or against another number: [N] each.

    `low` and `high` are the limits of an interval, or of another band; NaN where there is none.
    """

    at: Sequence[float]
    point: Sequence[float]
    low: Sequence[float]
    high: Sequence[float]


class Line(NamedTuple):
    """A line of a panel.

    Attributes:
        label: in the legend; the same arm has the same one in all panels.
        curve: may have no points.
        seeds: whose mean it is; 0 is not told. The band of fewer than two is no interval: it is shown whole.
        thesis: (env steps, returns) of the thesis' own curve, or None.
        runs: values of single runs at the curve's steps, thin lines in place of its band; none for the band.
    """

    label: str
    curve: Curve
    seeds: int = 0
    thesis: tuple | None = None
    runs: Sequence[Sequence[float]] = ()


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
    """What one pair of axes shows.

    Attributes:
        game: what an env step is of; "" for none.
        lines: see `Line`.
        levels, policies: published results, dotted, and policies that learn nothing, dash-dotted.
        title, across: above it and below; empty for the game and its env steps.
        limits: of the vertical axis; None for what `heights` gives.
        log: whether that is logarithmic, where all values are positive and span a factor of 5 or more.
        ticks: {where on the horizontal axis: what stands there}; none for numbers.
    """

    game: str
    lines: Sequence[Line]
    levels: Sequence[Level] = ()
    policies: Sequence[Level] = ()
    title: str = ""
    across: str = ""
    limits: tuple[float, float] | None = None
    log: bool = False
    ticks: Mapping[float, str] = MappingProxyType({})


def interval_curve(runs: Sequence[tuple[np.ndarray, np.ndarray]]) -> Curve | None:
    """The mean of several runs' curves and its interval, at steps that all have; None without such.

    A run with one value is left out where others have more.

    Args:
        runs: env steps [N], ascending, and values [N] of each; N may differ.
    """
    kept = [run for run in runs if len(run[0]) > 1] or [run for run in runs if len(run[0])]
    try:
        steps, values = statistics.at_equal_steps(kept)
    except ValueError:
        return None
    return Curve(steps, *statistics.mean_interval(values.T)[:3])


def draw_panels(
    panels: Sequence[Panel],
    path: str | os.PathLike,
    title: str,
    note: str = "",
    looks: Mapping[str, Style] | None = None,
    label: str = "mean return",
    size: tuple[float, float] | None = None,
) -> Path:
    """Draws panels, up to three in a row, with a legend and notes below.

    The thesis' curves are dashed, in their arm's colour, and end where the panel's longest line does.

    Args:
        panels: at least one, with at least one line.
        path: of the PNG file.
        title: of the figure, or empty.
        note: below it; lines.
        looks: label -> colour and line; None for those that the labels have by themselves.
        label: of the vertical axes.
        size: width and height in inches of a single panel, which is drawn alone: which line is whose is said
            beside it.
    """
    columns = min(len(panels), 3)
    rows = -(-len(panels) // columns)
    labels = dict.fromkeys(line.label for panel in panels for line in panel.lines)
    looks = looks or styles(list(labels))
    width = 4.6 if columns > 1 else 6.4
    figure = new_figure(*(size or (width * columns, 3.5 * rows + 0.24 * len(labels) + 0.7)))
    handles: dict[str, Any] = {}
    for i, panel in enumerate(panels):
        axes = figure.add_subplot(rows, columns, i + 1, ylabel=label)
        handles |= _draw_panel(axes, panel, looks)
    if not size:
        _below(figure, int(17 * width * columns), handles, panels, note)
    if title:
        head(figure, title)
    return save(figure, path)


def _draw_panel(axes, panel: Panel, looks: Mapping[str, Style]) -> dict[str, Any]:
    """Draws one panel; returns {text of the legend: its line}."""
    axes.set_title(textwrap.fill(panel.title or panel.game, 36), fontsize=10, parse_math=False)
    axes.set_xlabel(across := panel.across or steps_label(panel.game))
    lines = [line for line in panel.lines if len(line.curve.at)]
    end = max((max(line.curve.at) for line in lines), default=1) or 1
    handles = {}
    for label, curve, seeds, thesis, runs in lines:
        colour, pattern = looks[label]
        marker = "o" if len(curve.at) == 1 else ""  # of a single evaluation there is no line, nor a band
        if runs:
            axes.plot(curve.at, np.transpose(runs), color=colour, linewidth=0.8, alpha=0.5, marker=marker)
        elif marker:
            axes.vlines(curve.at, curve.low, curve.high, color=colour, alpha=0.5)
        else:
            axes.fill_between(curve.at, curve.low, curve.high, color=colour, alpha=0.18, linewidth=0)
        (drawn,) = axes.plot(curve.at, curve.point, pattern, color=colour, linewidth=1.8, marker=marker)
        handles[f"{label} ({seeds} seed{'' if seeds == 1 else 's'})" if seeds else label] = drawn
        if thesis is not None:
            steps, returns = (np.asarray(x, float) for x in thesis)
            at = np.unique(np.minimum(steps, end))
            returns = np.interp(at, steps, returns)
            axes.plot(at, returns, "--", color=colour, linewidth=1.2, alpha=0.8)
    if across.startswith(STEPS_LABEL):
        count_axis(axes)
        axes.set_xlim(0, end)
    else:
        plain(axes)
    if panel.ticks:
        axes.set_xticks([*panel.ticks], [*panel.ticks.values()])
    shown = [line.get_ydata() for line in axes.lines]
    shown += [x for line in lines if line.seeds < 2 for x in (line.curve.low, line.curve.high)]
    shown = np.concatenate([*shown, [x.score for x in (*panel.levels, *panel.policies)]])
    if panel.log and len(shown) and 0 < 5 * np.nanmin(shown) <= np.nanmax(shown):
        axes.set_yscale("log")
    elif np.isfinite(shown).any():
        curves = [line.curve._replace(low=(), high=()) if line.runs else line.curve for line in lines]
        axes.set_ylim(*(panel.limits or heights(curves, shown)))
    levels(axes, {x.method: x.score for x in panel.policies}, panel.levels)
    return handles


def _below(figure, width: int, handles: dict[str, Any], panels: Sequence[Panel], note: str) -> None:
    """The legend and the notes, which are `width` characters wide."""
    from matplotlib.lines import Line2D

    notes = note.splitlines()
    for panel in panels:
        told = [x._replace(method=f"{x.method} policy") for x in panel.policies] + list(panel.levels)
        notes += [f"{panel.game}, {x.method}, {x.score:g}: {x.differs}" for x in told if x.differs]
    notes = [line for text in notes for line in textwrap.wrap(text, width, subsequent_indent="    ")]
    if any(line.thesis is not None for panel in panels for line in panel.lines):  # in no arm's colour
        grey = Line2D([], [], color="#555555", linestyle="--", linewidth=1.2)
        handles = {**handles, "the thesis' own, one run each": grey}
    columns = 1 if len(panels) == 1 else 2
    legend = figure.legend(
        handles.values(),
        [wrapped(label, figure.get_figwidth() / columns - 0.6, 8) for label in handles],
        loc="outside lower center",
        ncols=columns,
        fontsize=8,
        title="\n".join(notes),
        title_fontsize=7,
        alignment="left",
        frameon=False,
    )
    for text in (legend.get_title(), *legend.get_texts()):
        text.set_parse_math(False)


def policy_levels(config: Config) -> list[Level]:
    """What policies that learn nothing score on a run's game."""
    found = reference_policies(config.game).items()
    return [Level(name, row.return_mean, collect.differs(row, config)) for name, row in found]


def differences(
    title: str,
    baseline: str,
    panels: Mapping[str, Mapping[str, statistics.Interval]],
    looks: Mapping[str, Sequence[Style]],
    path: str | os.PathLike,
) -> Path:
    """Draws how arms differ from the baseline: a point and an interval each, beside 0.

    Args:
        title: above it.
        baseline: its name.
        panels: what differs -> arm -> the difference; the same arms in each.
        looks: what differs -> those of the arms.
        path: of the PNG file.
    """
    arms = [wrapped(arm, 2, 8) for arm in next(iter(panels.values()))]
    more = sum(arm.count("\n") for arm in arms)
    figure = new_figure(5.4, 1.1 + 0.3 * len(arms) + 0.15 * more)
    head(figure, title)
    grid = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
    for axes, (name, found) in zip(grid, panels.items(), strict=True):
        plain(axes)
        axes.grid(False, axis="y")
        axes.axvline(0, color="#555555", linewidth=1)
        for i, (interval, (colour, _)) in enumerate(zip(found.values(), looks[name], strict=True)):
            axes.plot([interval.low, interval.high], [i, i], color=colour, linewidth=2.2)
            axes.plot([interval.point], [i], "o", color=colour, markersize=5)
        axes.set_yticks(range(len(arms)), arms, fontsize=8, parse_math=False)
        axes.set_ylim(len(arms) - 0.4, -0.6)
        axes.set_title(name, fontsize=8.5, parse_math=False)
        axes.spines["left"].set_visible(False)
        axes.tick_params(axis="y", length=0)
        axes.tick_params(axis="x", labelsize=8)
        axes.margins(x=0.08)
    below = wrapped(f"difference from {baseline}", figure.get_figwidth(), 8)
    figure.supxlabel(below, fontsize=8).set_parse_math(False)
    return save(figure, path)


def available() -> bool:
    """Whether the extra `plots` is installed: matplotlib and Pillow."""
    return all(importlib.util.find_spec(name) for name in ("matplotlib", "PIL"))


def steps_label(game: str) -> str:
    """Of an axis of env steps, which may have several frames of an emulator in one; "" is no game."""
    frames = envs.known(game).frames_per_step if game else 1
    return f"{STEPS_LABEL} ({frames} frames each)" if frames > 1 else STEPS_LABEL


def new_figure(width: float, height: float):
    """An empty figure of that size in inches, laid out tightly."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def wrapped(text: str, width: float, size: int) -> str:
    """A text in as many lines as it needs.

    Args:
        text: plain.
        width: that there is, in inches.
        size: of the letters, in points, whose mean width is taken as 0.58 of that.
    """
    return textwrap.fill(text, max(int(72 * width / (0.58 * size)), 1))


def head(figure: Any, title: str, size: int = 11) -> None:
    """Writes a title above a figure, whose width in inches is what it will be, see `wrapped`."""
    figure.suptitle(wrapped(title, figure.get_figwidth(), size), fontsize=size).set_parse_math(False)


def heights(curves: Collection[Curve], levels: Collection[float] = ()) -> tuple[float, float]:
    """Limits of a vertical axis that show all of the lines, and of bands what does not make the lines flat.

    The t interval of two runs is nine standard deviations wide to either side; what is further from the lines
    than they are high, all together, is cut off.

    Args:
        curves: lines and their bands.
        levels: what else has to be shown; those that are not finite do not count, but one is, or a line.
    """
    lines = np.concatenate([*(curve.point for curve in curves), [*levels]]).astype(float)
    bands = np.concatenate([[], *(limit for curve in curves for limit in curve[2:])]).astype(float)
    low, high = np.nanmin(lines), np.nanmax(lines)
    room = high - low or 0.5
    shown = np.clip(np.append(bands[np.isfinite(bands)], [low, high]), low - room, high + room)
    edge = 0.05 * np.ptp(shown) or room
    return float(shown.min() - edge), float(shown.max() + edge)


def count_axis(axes) -> None:
    """Env steps as 200k or 1.5M, a light grid, no box."""
    from matplotlib.ticker import EngFormatter, MaxNLocator

    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.xaxis.set_major_locator(MaxNLocator(6, integer=True))
    plain(axes)


def plain(axes) -> None:
    """A light grid, no box."""
    axes.grid(alpha=0.25, linewidth=0.6)
    axes.spines[["top", "right"]].set_visible(False)


def levels(axes, policies: Mapping[str, float], others: Sequence[Level] = ()) -> None:
    """Draws horizontal lines, their names side by side along them, so that near ones can be told apart.

    Args:
        axes: with everything else in it.
        policies: name -> mean return of policies that learn nothing, dash-dotted.
        others: dotted.
    """
    from matplotlib.patheffects import Normal, Stroke

    lines = [(x.method, x.score, {"linestyle": ":", "linewidth": 1}) for x in others]
    heights = [*axes.get_ylim(), *policies.values(), *(x.score for x in others)]
    thin = {"linestyle": "-.", "linewidth": 0.8}
    if len(policies) > 1 and np.ptp(list(policies.values())) <= NEAR * np.ptp(heights):
        lines.append((", ".join(policies), float(np.mean(list(policies.values()))), thin))
    else:
        lines += [(f"{name} policy", height, thin) for name, height in policies.items()]
    for i, (name, height, form) in enumerate(lines):
        axes.axhline(height, color="#888888", **form)
        text = axes.annotate(
            name,
            ((i + 1) / len(lines) - 0.01, height),  # the last one at the right, where curves have left it
            xycoords=axes.get_yaxis_transform(),
            horizontalalignment="right",
            path_effects=[Stroke(linewidth=1.5, foreground="white"), Normal()],
            xytext=(0, 1.5),
            textcoords="offset points",
            fontsize=6.5,
            color="#555555",
            parse_math=False,
        )
        text.set_in_layout(False)


def save(figure, path: str | os.PathLike) -> Path:
    """Writes a figure as a small PNG file, making its directory where there is none; returns the path."""
    from PIL import Image

    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    # A palette makes the file a third as large, and nobody sees the difference.
    figure.canvas.draw()
    image = Image.fromarray(np.asarray(figure.canvas.buffer_rgba())).convert("RGB")
    content = io.BytesIO()
    image.quantize(256).save(content, format="PNG", optimize=True)
    replace_bytes(path, content.getvalue())
    return path
