"""The pictures of a report: of what is measured over env steps, and of what the runs' directories hold."""

import csv
import fnmatch
import functools
import importlib.resources
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from srl_jax import statistics
from srl_jax.data import reference_policies
from srl_jax.errors import ConfigError
from srl_jax.reading import SETTINGS, parse_json, read_bytes
from srl_jax.statistics import Interval

from .. import diagnostic_plots, plots
from ..collect import RunData
from ..colours import Style
from . import numbers, pictures
from .pictures import Curve, Picture

MEDIA_BYTES = 600_000
"""Of pictures taken from the runs, in all; base64 adds a third."""
LARGEST_PICTURE, SMALLEST_PICTURE = 120_000, 8_000
"""Bytes that one of them may have where there are few, and may always have."""
OWN = ("learning_curve", "losses", "diagnostics", "drift")
"""Pictures of a run that a report draws itself."""
SIZE = (4.4, 3.1)
"""Inches of a picture of a whole section: wide enough for many lines, and legible on a phone."""
FAINT = "50"
"""The opacity of a single seed's line, in hexadecimal."""
Looks = Mapping[str, Style]
"""arm -> how it is drawn, on the whole page."""


class Shown(NamedTuple):
    """A picture on the page.

    Attributes:
        alt: what a reader who does not see it is told.
        title, caption: below it.
        arms: {arm: how many runs} of its legend, where it has one.
        first: whether it is shown at once; others are shown when they are asked for.
    """

    picture: Picture
    alt: str
    title: str = ""
    caption: str = ""
    arms: Mapping[str, int] = {}
    first: bool = True


def beside(path: Path) -> dict[str, Any]:
    """The numbers of a figure, which lie beside its picture; empty where there are none.

    Raises:
        ConfigError: they cannot be read, or are no JSON object.
    """
    path = path.with_suffix(".json")
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


def figure(path: Path, looks: Looks) -> Shown:
    """What experiments.figures has drawn, with its title and the question that it asks."""
    about = beside(path)
    title, question = (str(about.get(key) or "") for key in ("title", "question"))
    name = f"Figure {about['figure']}. {title}" if about.get("figure") else title or path.stem
    drawn = about.get("styles")
    if isinstance(drawn, dict) and any(list(looks[arm]) != drawn[arm] for arm in drawn.keys() & looks):
        question += " Its colours are not this page's: it was drawn of other arms."
    return Shown(pictures.taken(path, pictures.LARGEST), name, name, question.strip())


def learning_curves(
    game: str, comparison: numbers.Comparison, looks: Looks, baseline: str | None
) -> tuple[list[Shown], list[Shown]]:
    """The means with their intervals, the baseline and a few arms in each; and each arm with all its seeds."""
    none = np.full(len(comparison.steps), np.nan)
    means, seeds = {}, {}
    for arm, returns in comparison.returns.items():
        means[arm] = Curve(comparison.steps, *statistics.curve_interval(returns)[:3])
        seeds[arm] = [Curve(comparison.steps, one, none, none) for one in returns]
    policies = {name: row.return_mean for name, row in reference_policies(game).items()}
    every = [*means.values(), *(curve for curves in seeds.values() for curve in curves)]
    how = {"policies": policies, "limits": pictures.heights(every, policies.values())}
    how["across"] = plots.steps_label(game)
    counts = {arm: len(curves) for arm, curves in seeds.items()}
    together = _in_groups(game, means, counts, looks, baseline, label="mean return", **how)
    apart = []
    for arm, curves in seeds.items():
        colour, line = looks[arm]
        lines = [((colour + FAINT, "-"), curve) for curve in curves]
        lines.append(((colour, line), means[arm]._replace(low=none, high=none)))
        apart.append(Shown(pictures.curves(arm, lines, **how), f"{game}: {arm}, each seed"))
    return together, apart


def profiles(found: numbers.Profiles, looks: Looks, baseline: str | None) -> list[Shown]:
    """Performance profiles; none of a single seed an arm."""
    if all(np.isnan(interval.low).all() for interval in found.shares.values()):
        return []
    curves = {arm: Curve(found.thresholds, *interval[:3]) for arm, interval in found.shares.items()}
    how = {"label": "share of runs above it", "across": "normalised return at the end"}
    return _in_groups(", ".join(found.games), curves, found.runs, looks, baseline, limits=(-0.03, 1.03), **how)


def _in_groups(
    title: str,
    curves: Mapping[str, Curve],
    counts: Mapping[str, int],
    looks: Looks,
    baseline: str | None,
    **how: Any,
) -> list[Shown]:
    shown = []
    for group in groups(list(curves), baseline):
        picture = pictures.curves(title, [(looks[arm], curves[arm]) for arm in group], size=SIZE, **how)
        arms = {arm: counts[arm] for arm in group}
        shown.append(Shown(picture, f"{title}: {how['label']}", arms=arms))
    return shown


def groups(arms: Sequence[str], baseline: str | None) -> list[list[str]]:
    """The arms in groups of at most `pictures.ARMS_A_PICTURE`, about as large as each other, the baseline in each."""
    others = [arm for arm in arms if arm != baseline]
    first = [arm for arm in arms if arm == baseline]
    count = -(-len(others) // (pictures.ARMS_A_PICTURE - len(first))) or 1
    size = -(-len(others) // count) or 1
    return [first + others[i : i + size] for i in range(0, max(len(others), 1), size)]


def differences(
    game: str, final: Mapping[str, Interval], area: Mapping[str, Interval], looks: Looks, baseline: str | None
) -> Shown | None:
    """How arms differ from the baseline, arm -> interval; None where no arm has one."""
    if all(np.isnan(interval.low) for interval in final.values()):
        return None
    panels = {"at the end": final, "averaged over env steps": area}
    picture = pictures.differences(game, str(baseline), panels, [looks[arm] for arm in final])
    return Shown(picture, f"{game}: differences from {baseline}")


def measured(runs: Sequence[RunData], prefixes: Sequence[str], looks: Looks) -> list[Shown]:
    """Pictures of the numbers in the rows of a game's runs: a line an arm, with its 95 % t interval.

    Args:
        runs: of one game.
        prefixes: of the keys, "loss/", say. Those that measures.csv does not have come last.
        looks: arm -> its colour and line.
    """
    text = importlib.resources.files(__package__).joinpath("measures.csv").read_text(encoding="utf-8")
    forms = list(csv.DictReader(text.splitlines()))
    keys = sorted({key for run in runs for row in run.rows for key in row if key.startswith(tuple(prefixes))})
    exact = {form["key"] for form in forms}
    known = {key for key in keys for form in forms if fnmatch.fnmatchcase(key, form["key"])}
    new = [key for key in keys if key not in known and key != "diag/drift/steps"]
    forms += [{"key": key, "place": 0, "title": key, "meaning": "", "first": ""} for key in new]
    shown = []
    for form in forms:
        before, _, after = form["key"].partition("*")
        for key in keys:
            if key != form["key"] and (key in exact or not fnmatch.fnmatchcase(key, form["key"])):
                continue
            members = {
                arm: [_curve(run, key, int(form["place"])) for run in runs if run.arm == arm] for arm in looks
            }
            curves = {arm: pictures.interval_curves(its) for arm, its in members.items()}
            if lines := [(looks[arm], curve) for arm, curve in curves.items() if curve is not None]:
                title = form["title"].format(key.removeprefix(before).removesuffix(after))
                picture = pictures.curves(title, lines, across=plots.steps_label(runs[0].game))
                alt = f"{runs[0].game}: {title}"
                shown.append(Shown(picture, alt, caption=form["meaning"], first=bool(form["first"])))
    return shown


def _curve(run: RunData, key: str, place: int) -> tuple[np.ndarray, np.ndarray]:
    points = []
    for row in run.rows:
        if row.get(key) not in (None, []):
            value = row[key][place] if isinstance(row[key], list) else numbers.value_of(run, row, key)
            points += [(row["env_steps"], value)] if value is not None else []
    return np.array([p[0] for p in points], np.int64), np.array([p[1] for p in points], np.float64)


def drift(runs: Iterable[RunData]) -> list[Shown]:
    """The error of each epoch's decoder on each epoch's encoder, a picture a run."""
    shown = []
    for run in runs:
        picture = pictures.drawn(functools.partial(diagnostic_plots.drift_matrix, run.rows, title=""))
        if picture is not None:
            caption = f"seed {run.seed}: each epoch's decoder on each epoch's encoder"
            shown.append(Shown(picture, f"{run.game} / {run.arm}: drift", run.arm, caption))
    return shown


def own_pictures(runs: Sequence[RunData]) -> list[tuple[RunData, Path]]:
    """The pictures in the directories of runs that a report cannot draw: games, inputs and outputs."""
    paths = ((run, path) for run in runs for path in sorted((run.path / "figures").glob("*")))
    return [(r, p) for r, p in paths if p.suffix in (".gif", ".png") and p.stem not in OWN]


def taken(found: Sequence[tuple[RunData, Path]], suffix: str) -> list[Shown]:
    """Those of one kind, made smaller where all of them would be too much for a page."""
    limit = min(max(MEDIA_BYTES // max(len(found), 1), SMALLEST_PICTURE), LARGEST_PICTURE)
    shown = []
    for run, path in found:
        if path.suffix == suffix:
            alt = f"{run.game} / {run.arm} / seed {run.seed}: {path.stem}"
            caption = f"seed {run.seed}: {path.stem}"
            shown.append(Shown(pictures.taken(path, limit), alt, run.arm, caption))
    return shown
