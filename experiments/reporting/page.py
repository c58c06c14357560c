"""The page as a whole: what its templates are given. The same runs give the same bytes."""

import math
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

from srl_jax import envs, statistics
from srl_jax.data import POLICIES, published, reference_policies
from srl_jax.errors import ConfigError
from srl_jax.statistics import Interval

from ..drawing.colours import styles
from ..runs import collect
from ..runs.collect import RunData
from . import configs, gallery, numbers, readme

SECTIONS = {
    "question": "Question and answer",
    "numbers": "What the numbers say",
    "curves": "Learning curves",
    "figures": "Figures",
    "training": "Training",
    "diagnostics": "Diagnostics",
    "playing": "The agents playing",
    "panels": "Inputs and outputs",
    "profiles": "Performance profiles",
    "cost": "Time and cost",
    "settings": "Settings and protocol",
    "runs": "Every run",
}
"""Their templates, and titles; one that says nothing is left out."""


def build(
    *roots: str | Path,
    baseline: str | None = None,
    reach: Mapping[str, float] | None = None,
    force: bool = False,
    finished_only: bool = False,
    media: bool = True,
    data: str = "",
) -> tuple[str, str]:
    """The page of all runs in or below directories, as HTML, and their rows as CSV.

    Args:
        *roots: the directories; their README.md and figures/*.png are shown, too.
        baseline: the arm that the others are compared with, or None for what `numbers.baseline_of` says.
        reach: game -> score, where the env steps to reach it are asked for; by default what the baseline ends
            with on average.
        force: compare what differs in its protocol.
        finished_only: compare runs that have ended only.
        media: show the runs' own pictures.
        data: the name of the CSV's file, which lies beside the page.

    Raises:
        ConfigError: there is no run, something is not what training writes, protocols differ and it is not
            forced, or there is no such baseline or game.
    """
    places, reach = [Path(root) for root in roots], reach or {}
    runs = collect.load_runs(*places)
    forced = collect.check_protocols(runs, force=force)
    try:
        collect.check_arms(runs)
    except ConfigError as error:
        if not force:
            raise ConfigError(f"{error}; --force compares them all the same") from None
        forced.append(str(error))
    by_game = collect.grouped(runs)
    if unknown := [game for game in reach if game not in by_game]:
        raise ConfigError(f"--reach={unknown[0]}: no run of that game; valid: {', '.join(by_game)}")
    arms = numbers.arms_of(runs)
    baseline = numbers.baseline_of(runs, arms, baseline)
    arms = sorted(arms, key=lambda arm: arm != baseline)  # it first, the others as they were
    games = []
    for name, members in by_game.items():
        ordered = {arm: members[arm] for arm in arms if arm in members}
        taken = [x for those in ordered.values() for x in those if not finished_only or numbers.finished(x)]
        comparable = collect.comparable(taken)
        comparison = numbers.compare(comparable) if comparable else None
        games.append(numbers.Game(name, ordered, taken, bool(comparable), comparison))
    comparisons = {game.name: game.comparison for game in games if game.comparison}
    differing, shared = configs.settings(runs, arms)
    looks = styles(arms)
    readmes = [found for place in places if (found := readme.read(place)) is not None]
    context = {
        "gallery": gallery,
        "numbers": numbers,
        "game_record": envs.known,
        "policies": reference_policies,
        "differs": collect.differs,
        "published": published,
        "readmes": readmes,
        "title": readmes[0].title if len(readmes) == len(places) == 1 else "",
        "roots": [_name_of(place) for place in places],
        "figures": gallery.figures(places, [path for x in readmes for path in x.pictures], looks),
        "own": gallery.own_pictures(games) if media else {},
        "runs": [_run(run, places) for run in runs],
        "forced": forced,
        "finished_only": finished_only,
        "data": data,
        "reach": reach,
        "baseline": baseline,
        "looks": looks,
        "glossary": configs.glossary(sorted(runs, key=lambda run: arms.index(run.arm)), differing, baseline),
        "games": games,
        "comparisons": comparisons,
        "final": numbers.table(comparisons, "at_the_end", baseline),
        "area": numbers.table(comparisons, "area_under_curve", baseline),
        "over_policies": _policies(numbers.profiles(comparisons)[0]),
        "differing": differing,
        "shared": shared,
    }
    environment = _environment()
    sections = {name: environment.get_template(f"{name}.html.j2").render(context) for name in SECTIONS}
    written = {name: Markup(text) for name, text in sections.items() if text.strip()}
    html = environment.get_template("page.html.j2").render(context, sections=written, titles=SECTIONS)
    return html, numbers.as_csv(runs)


def _policies(games: Sequence[str]) -> dict[str, dict[str, float]]:
    """What policies that learn nothing have over games, where each of these has them: statistic -> value."""
    found = {}
    for name in POLICIES:
        rows = {game: reference_policies(game).get(name) for game in games}
        if rows and all(rows.values()):
            normal = {
                game: statistics.human_normalised(game, [row.return_mean]) for game, row in rows.items()
            }
            found[name] = {of: float(statistic(normal)) for of, statistic in statistics.AGGREGATES.items()}
    return found


def _run(run: RunData, places: Sequence[Path]) -> dict[str, Any]:
    """What the page says of one run; where it lies is said below the directories that were named alone."""
    steps, returns = collect.steps_and_returns(run)
    root = next(root for root in places if run.path.is_relative_to(root))
    below = run.path.relative_to(root)
    return {
        "name": f"{run.game} / {run.arm} / seed {run.seed}",
        "data": run,
        "about": configs.about(run),
        "steps": numbers.reached_step(run),
        "finished": numbers.finished(run),
        "evaluations": len(steps),
        "undiagnosed": len(steps) and not any(key.startswith("diag/") for row in run.rows for key in row),
        "last": f"{number(float(returns[-1]))} at {steps[-1]:,}" if len(steps) else "–",
        "place": below if len(places) == 1 else _name_of(root) / below,
    }


def _name_of(root: Path) -> Path:
    """The name of a directory, also of "." and "..": what lies above is nobody's business."""
    return Path(os.path.basename(os.path.abspath(root)))


def _environment() -> Environment:
    found = Environment(
        loader=PackageLoader(__package__),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    filters = (number, signed, interval, duration, plural, listed, breakable, numbers.verdict)
    found.filters |= {function.__name__: function for function in filters}
    found.filters["protocol"] = configs.protocol_text
    return found


def number(value: float | None, digits: int = 2) -> str:
    """A number with its thousands set apart: 12,345 or 0.53; a dash for none."""
    if value is None or math.isnan(value):
        return "–"
    places = 0 if abs(value) >= 1_000 else min(digits, 1) if abs(value) >= 100 else digits
    shown = f"{value:,.{places}f}"
    return (shown if shown.strip("-0.,") else shown.lstrip("-")).replace("-", "−")  # no minus before 0.00


def signed(value: float) -> str:
    """A difference: +0.24, −0.24 or 0.00."""
    text = number(value)
    return f"+{text}" if value > 0 and text.strip("0.,") else text


def interval(found: Interval, signs: bool = False) -> str:
    """[low, high], with signs if it is of a difference, and a word where few runs make it too narrow."""
    if np.isnan(found.low):
        return "(no interval)"
    narrow = " too narrow" if found.kind == statistics.NARROW else ""
    low, high = (signed(float(x)) if signs else number(float(x)) for x in found[1:3])
    return f"[{low}, {high}]{narrow}"


def duration(hours: float) -> str:
    """Hours, minutes or seconds, whichever is easy to read."""
    if hours >= 1:
        return f"{number(hours, 1)} h"
    return f"{number(60 * hours, 1)} min" if 60 * hours >= 1 else f"{number(3600 * hours, 0)} s"


def plural(count: int, noun: str) -> str:
    """ "1 run", "2 runs"."""
    return f"{count:,} {noun}{'' if count == 1 else 's'}"


def listed(items: Iterable[Any]) -> str:
    """ "a", "a and b", "a, b and c"."""
    *first, last = [str(item) for item in items] or ["none"]
    return f"{', '.join(first)} and {last}" if first else last


def breakable(name: Any) -> Markup:
    """A name that a narrow column may break behind its underscores and slashes."""
    return escape(name).replace("_", Markup("_<wbr>")).replace("/ ", Markup("/ <wbr>"))
