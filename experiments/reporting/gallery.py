"""The pictures of a report, in their sections."""

import functools
import itertools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from srl_jax import statistics
from srl_jax.data import reference_policies
from srl_jax.errors import ConfigError
from srl_jax.reading import SETTINGS, parse_json, read_bytes

from .. import collect, diagnostic_plots, plots
from ..collect import RunData
from ..run_data import natural
from . import diagnostics, numbers, pictures
from .contents import Content, Report, run_name
from .markup import Markup, breakable, details, figure, listed, plural, tag

MEDIA_BYTES = 5_000_000
"""Of pictures taken from the runs, in all; base64 adds a third."""
LARGEST_PICTURE, SMALLEST_PICTURE = 400_000, 30_000
"""Bytes that one of them may have where there are few, and may always have."""
OWN = ("learning_curve", "losses", "diagnostics", "drift")
"""Pictures of a run that a report draws itself."""


def figures(report: Report) -> Content:
    """What experiments.figures has drawn, with the title and the question beside it."""
    found = []
    paths = [sorted((x / "figures").glob("*.png"), key=lambda p: natural(p.name)) for x in report.roots]
    for path in itertools.chain(*paths):
        picture = pictures.taken(path, pictures.LARGEST)
        about = _beside(path.with_suffix(".json"))
        title, question = (str(about.get(key) or "") for key in ("title", "question"))
        name = f"Figure {about['figure']}. {title}" if about.get("figure") else title or path.stem
        caption = [tag("strong", name), f" {question}"]
        found.append(figure(picture.source, caption, name, picture.size))
    return tag("div", found, class_="grid wide") if found else None


def _beside(path: Path) -> dict[str, Any]:
    try:
        values = parse_json(read_bytes(path, SETTINGS))
    except FileNotFoundError:
        return {}
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from None
    except ValueError as error:
        raise ConfigError(f"{path}: not JSON: {error}") from None
    if not isinstance(values, dict):
        raise ConfigError(f"{path}: not a JSON object")
    return values


def learning_curves(report: Report) -> Content:
    """A picture a game; of the baseline and a few arms each, where there are many."""
    drawn = []
    for game, comparison in report.comparisons.items():
        if comparison is None:
            continue
        policies = {name: row.return_mean for name, row in reference_policies(game).items()}
        arms = [arm for arm in report.arms if arm in comparison.returns]
        curves = {}
        for arm in arms:
            interval = statistics.curve_interval(comparison.returns[arm])
            curves[arm] = pictures.Curve(comparison.steps, *interval[:3])
        limits = pictures.heights(curves.values(), policies.values())  # the same in all pictures of a game
        for group in groups(arms, report.baseline):
            lines = [(report.styles[arm], curves[arm]) for arm in group]
            how = {"label": "mean return", "across": plots.steps_label(game), "size": (5.4, 3.5)}
            picture = pictures.curves(game, lines, policies=policies, limits=limits, **how)
            caption = _legend(report, {arm: len(comparison.returns[arm]) for arm in group})
            drawn.append(figure(picture.source, caption, f"{game}: learning curves", picture.size))
    if not drawn:
        return None
    left_out = [f" {game}, {line}." for game in report.games for line in report.left_out(game)]
    note = (
        "Mean evaluation return, and its 95 % t interval over seeds at each env step that all runs of a game "
        "have. Lines across: policies that learn nothing."
    )
    return [tag("p", note, *left_out, class_="note"), tag("div", drawn, class_="grid wide")]


def profiles(report: Report) -> Content:
    """Performance profiles; the baseline and a few arms in each picture, where there are many."""
    games, thresholds, found = numbers.profiles(report.comparisons, report.arms)
    if all(np.isnan(interval.low).all() for interval in found.values()):  # a single seed has no distribution
        return None
    curves = {arm: pictures.Curve(thresholds, *interval[:3]) for arm, interval in found.items()}
    seeds = {arm: sum(len(report.comparisons[game].returns[arm]) for game in games) for arm in found}
    drawn = []
    for group in groups(list(found), report.baseline):
        picture = pictures.curves(
            listed(games),
            [(report.styles[arm], curves[arm]) for arm in group],
            size=(5.4, 3.5),
            label="share of runs above it",
            across="human-normalised return at the end",
            limits=(-0.03, 1.03),
        )
        caption = _legend(report, {arm: seeds[arm] for arm in group}, "run")
        drawn.append(figure(picture.source, caption, "Performance profiles", picture.size))
    kinds = dict.fromkeys(interval.kind for interval in found.values() if interval.kind != statistics.NONE)
    note = (
        "The share of an arm's runs that end above a score, averaged over games, and its 95 % interval, "
        f"{listed(kinds)}. A curve that is higher everywhere is better; where it falls steeply, runs end "
        "alike. 0 is a random policy, 1 a human; in Catch, a miss and a catch."
    )
    return [tag("p", note, class_="note"), tag("div", drawn, class_="grid wide")]


def groups(arms: Sequence[str], baseline: str | None) -> list[list[str]]:
    """The arms in groups of at most `pictures.ARMS_A_PICTURE`, the baseline in each."""
    size = pictures.ARMS_A_PICTURE
    if len(arms) <= size:
        return [list(arms)]
    first = [arm for arm in arms if arm == baseline]
    others = [arm for arm in arms if arm != baseline]
    number = -(-len(others) // (size - 1))
    size = -(-len(others) // number)
    return [first + others[i : i + size] for i in range(0, len(others), size)]


def _legend(report: Report, counts: dict[str, int], of: str = "seed") -> Markup:
    """Which line is whose; arm -> how many seeds, or what `of` says, it has."""
    words = {"-": "solid", "--": "dashed", ":": "dotted"}
    items = []
    for arm, number in counts.items():
        colour, line = report.styles[arm]
        mark = tag("span", style=f"border-top-color: {colour}; border-top-style: {words[line]}")
        items.append(tag("li", mark, f"{arm} ({plural(number, of)})"))
    return tag("ul", items, class_="legend")


def playing(report: Report) -> Content:
    """The last evaluation of each arm's first seed."""
    limit = _limit(report)

    def cells(run: RunData) -> list[Markup]:
        picture = pictures.taken(run.path / "figures" / "play.gif", limit)
        caption = [tag("strong", breakable(run.arm)), f", seed {run.seed}"]
        return [figure(picture.source, caption, f"{run_name(run)}, playing")] if picture else []

    return _by_game(report, cells, "play", "The first games of the last evaluation, as the agent sees them.")


def panels(report: Report) -> Content:
    """What the objectives make of observations, of each arm's first seed."""
    limit = _limit(report)

    def cell(run: RunData, path: Path) -> Markup:
        picture = pictures.taken(path, limit)
        caption = [tag("strong", breakable(run.arm)), f", seed {run.seed}: {path.stem}"]
        return figure(picture.source, caption, f"{run_name(run)}: {path.stem}", picture.size)

    note = (
        "Observations from replay: what went in, what should come out, what came out, and how far off it is."
    )
    return _by_game(report, lambda run: [cell(run, path) for path in _panels(run)], "media", note)


def _by_game(report: Report, cells: Callable[[RunData], list[Markup]], kind: str, note: str) -> Content:
    """A grid a game of what each arm's first seed has to show; None where none has anything."""
    if not report.media:
        return tag("p", "Left out (--nomedia).", class_="note")
    parts: list = []
    for game in report.games:
        if shown := [cell for run in _first_runs(report, game) for cell in cells(run)]:
            parts += [tag("h3", game), tag("div", shown, class_=f"grid {kind}")]
    return [tag("p", note, class_="note"), parts] if parts else None


def _first_runs(report: Report, game: str) -> list[RunData]:
    """The first seed of each arm that has not failed."""
    return [runs[0] for arm in report.arms if (runs := _sound(report, game, arm))]


def _sound(report: Report, game: str, arm: str | None = None) -> list[RunData]:
    """The runs of a game, or of one arm on it, that have not failed: others would cut all curves."""
    return [run for run in report.of(game, arm) if not run.failed]


def _panels(run: RunData) -> list[Path]:
    found = sorted((run.path / "figures").glob("*.png"), key=lambda path: natural(path.name))
    return [path for path in found if path.stem not in OWN]


def _limit(report: Report) -> int:
    """Bytes that a picture of a run may have, so that all of them are not too large together."""
    runs = [run for game in report.games for run in _first_runs(report, game)]
    count = sum(1 + len(_panels(run)) for run in runs)
    return min(max(MEDIA_BYTES // max(count, 1), SMALLEST_PICTURE), LARGEST_PICTURE)


def diagnostic_pictures(report: Report) -> Content:
    """A small picture for each number, a line an arm; drift as a picture of the first seed."""
    without = diagnostics.missing(report.runs)
    evaluated = [run for run in report.runs if len(collect.steps_and_returns(run)[0])]
    if not any(diagnostics.keys_of([run]) for run in report.runs):
        return (
            tag("p", "These runs have no diagnostics: they are of before there were any.")
            if evaluated
            else None
        )
    parts: list = []
    for game in report.games:
        found = diagnostics.panels(_sound(report, game), report.styles)
        if not found:
            continue
        first, others = (
            [_panel(game, panel) for panel in found if panel.first == at_once] for at_once in (True, False)
        )
        having = {run.arm for run in _sound(report, game) if diagnostics.keys_of([run])}
        seeds = {arm: len(_sound(report, game, arm)) for arm in report.arms if arm in having}
        parts += [tag("h3", game), _legend(report, seeds), tag("div", first, class_="grid small")]
        if others:
            more = f"{plural(len(others), 'more picture')} of {game}"
            parts.append(details(more, tag("div", others, class_="grid small")))
        parts.append(_drift(report, game))
    if without:
        parts.append(tag("p", f"Without diagnostics: {listed(map(run_name, without))}.", class_="note"))
    note = (
        "Measured at every evaluation; means over seeds that have not failed and their 95 % t intervals at "
        "each point."
    )
    return [tag("p", note, class_="note"), *parts]


def _panel(game: str, panel: diagnostics.Panel) -> Markup:
    return figure(panel.picture.source, panel.meaning, f"{game}: {panel.title}", panel.picture.size)


def _drift(report: Report, game: str) -> Content:
    """The error of each epoch's decoder on each epoch's encoder, of each arm's first seed."""
    found = []
    for run in _first_runs(report, game):
        picture = pictures.drawn(functools.partial(diagnostic_plots.drift_matrix, run.rows, title=""))
        if picture is not None:
            caption = [
                tag("strong", breakable(run.arm)),
                f", seed {run.seed}: each epoch's decoder on each epoch's encoder",
            ]
            found.append(figure(picture.source, caption, f"{run_name(run)}: drift", picture.size))
    return tag("div", found, class_="grid media") if found else None
