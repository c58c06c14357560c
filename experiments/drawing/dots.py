"""A picture of scores game by game: a dot an arm, on the spread of published runs. See `runs.scores`."""

import itertools
import os
import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..runs.scores import FAR
from .colours import LINES
from .plots import head, new_figure, plain, save

GREY = "#8c8c8c"
MARKERS = tuple(itertools.product(("white", GREY, "black"), ("D", "s", "^", "v", "P", "<", ">")))
"""Of published methods, in their order: what they are filled with, and what form they have."""
FORMS = dict(zip(LINES, ("o", "h", "*", "X"), strict=True))
"""Of arms, whose styles are a colour and a line."""
LINEAR = 0.2
"""Human-normalised scores up to which the axis is linear, in both directions; beyond, it is logarithmic."""


def draw(numbers: Mapping[str, Any], path: str | os.PathLike) -> Path:
    """Draws what `runs.scores.evaluated` gave: games below each other, human-normalised scores across.

    A bar is a published mean and one standard deviation over runs to either side, a mark with a grey edge a
    published mean; one in colour is an arm's mean, a tick each of its seeds. A ring marks a mean that is
    above or below all published ones. Games are sorted by the first method that has them all, or else by the
    first arm.

    Args:
        numbers: at least one game.
        path: of the PNG file.
    """
    games = _order(numbers)
    arms, published = numbers["arms"], numbers["published"]
    height = 0.3 + 0.06 * max(len(arms) - 1, 0)
    figure = new_figure(7.2, 1.9 + height * len(games) + 0.22 * (len(arms) + len(published)))
    axes = figure.add_subplot()
    at = {game: i for i, game in enumerate(games)}
    handles: dict[str, Any] = {}
    shown: list[float] = [0.0, 1.0]
    places = np.linspace(-0.22, 0.22, len(published)) if len(published) > 1 else np.zeros(1)
    markers = itertools.cycle(MARKERS)
    for (name, entry), (filled, marker), place in zip(published.items(), markers, places, strict=False):
        known = {game: x for game, x in entry["games"].items() if game in at}
        rows = [at[game] + place for game in known]
        means = [x["normalised"] for x in known.values()]
        spread = [x["normalised_sd"] or np.nan for x in known.values()]
        if np.isfinite(spread).any():
            low, high = np.subtract(means, spread), np.add(means, spread)
            axes.hlines(rows, low, high, color="#cfcfcf", linewidth=5, zorder=1)
            shown += [*low[np.isfinite(low)], *high[np.isfinite(high)]]
        look = {"markerfacecolor": filled, "color": GREY, "markersize": 5, "zorder": 2}
        (drawn,) = axes.plot(means, rows, linestyle="none", marker=marker, **look)
        text = ", mean ± standard deviation over runs" if np.isfinite(spread).any() else ""
        handles[f"{name}{text}"] = drawn
        shown += means
    beside = np.linspace(-0.16, 0.16, len(arms)) if len(arms) > 1 else np.zeros(1)
    for (arm, entry), place in zip(arms.items(), beside, strict=True):
        colour, line = numbers["styles"].get(arm, ("#0072b2", "-"))
        for game, x in entry["games"].items():
            row, value = at[game] + place, x["normalised"]["mean"]
            seeds = x["normalised_scores"]
            axes.plot(
                seeds, [row] * len(seeds), "|", color=colour, markersize=8, markeredgewidth=1.1, zorder=3
            )
            (drawn,) = axes.plot([value], [row], FORMS[line], color=colour, markersize=6, zorder=4)
            if x["verdict"] in ("above", "below"):
                axes.plot([value], [row], "o", color="black", fillstyle="none", markersize=10, zorder=5)
            shown += seeds
        counts = sorted({len(x["seeds"]) for x in entry["games"].values()})
        seeds = " to ".join(str(n) for n in dict.fromkeys((counts[0], counts[-1])))
        handles[f"{arm}, mean of {seeds} seed{'' if counts == [1] else 's'} (ticks: each)"] = drawn
    _axes(axes, games, shown)
    notes = [line for text in _notes(numbers) for line in textwrap.wrap(text, 104, subsequent_indent="    ")]
    legend = figure.legend(
        handles.values(), handles.keys(), loc="outside lower center", fontsize=8, title="\n".join(notes),
        title_fontsize=7, alignment="left", frameon=False,
    )  # fmt: skip
    for text in (legend.get_title(), *legend.get_texts()):
        text.set_parse_math(False)
    head(figure, numbers["title"])
    return save(figure, path)


def _axes(axes, games: list[str], shown: list[float]) -> None:
    plain(axes)
    axes.grid(True, axis="y", alpha=0.15)
    axes.axvline(0, color="#555555", linewidth=0.8)
    axes.axvline(1, color="#555555", linewidth=0.8, linestyle="--")
    axes.set_yticks(range(len(games)), games, fontsize=8.5, parse_math=False)
    axes.set_ylim(len(games) - 0.4, -0.6)
    axes.tick_params(axis="y", length=0)
    axes.spines["left"].set_visible(False)
    axes.set_xscale("symlog", linthresh=LINEAR)
    low, high = min(shown), max(shown)
    ends = axes.transData.transform([(low, 0), (high, 0)])[:, 0]
    room = 0.03 * (ends[1] - ends[0])
    edges = axes.transData.inverted().transform([(ends[0] - room, 0), (ends[1] + room, 0)])[:, 0]
    axes.set_xlim(*edges)
    ticks = [x for size in (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100) for x in (-size, size)]
    axes.set_xticks([0, *(x for x in ticks if edges[0] <= x <= edges[1])])
    axes.xaxis.set_major_formatter("{x:g}")
    axes.minorticks_off()
    axes.set_xlabel("human-normalised score (0: random policy, 1: human), linear up to 0.2", fontsize=9)


def _order(numbers: Mapping[str, Any]) -> list[str]:
    games = numbers["games"]
    for entry in numbers["published"].values():
        if all(game in entry["games"] for game in games):
            return sorted(games, key=lambda game: -entry["games"][game]["normalised"])
    first = next(iter(numbers["arms"].values()))["games"]
    return sorted(games, key=lambda game: -first[game]["normalised"]["mean"] if game in first else 0.0)


def _notes(numbers: Mapping[str, Any]) -> list[str]:
    found = []
    for arm, entry in numbers["arms"].items():
        found.append(f"{arm}: {entry['steps']:,} env steps; {'; '.join(entry['of'])}")
        verdicts = [x["verdict"] for x in entry["games"].values() if x["verdict"]]
        far = len([verdict for verdict in verdicts if verdict != "within"])
        if verdicts:
            found[-1] += f"; {far} of {len(verdicts)} games ringed"
        found += [f"{name} differs: {text}" for name, text in entry["differs"].items() if text]
    for name in ("without_runs", "left_out"):
        if numbers[name]:
            found.append(f"{name.replace('_', ' ')}: {len(numbers[name])}")
    if any(x["verdict"] for arm in numbers["arms"].values() for x in arm["games"].values()):
        away = f"more than {FAR:g} standard deviations over published runs"
        found.append(f"ring: {away} above or below all published means")
    return found + (["PROTOCOLS DIFFER between runs"] if numbers["forced"] else [])
