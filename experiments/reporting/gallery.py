"""The pictures of a report: of what is measured over env steps, and of what the runs' directories hold."""

import csv
import fnmatch
import functools
import importlib.resources
import itertools
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from srl_jax import specs, statistics
from srl_jax.data import reference_policies
from srl_jax.errors import ConfigError
from srl_jax.files.reading import parse_json

from ..drawing import plots, run_figures
from ..drawing.colours import Style
from ..runs.collect import RunData
from ..runs.run_data import natural
from . import numbers, pictures, readme
from .pictures import Curve, Picture

MEDIA_BYTES = 600_000
"""Of pictures taken from the runs, in all; base64 adds a third."""
LARGEST_PICTURE, SMALLEST_PICTURE = 120_000, 8_000
"""Bytes that one of them may have where there are few, and may always have."""
OWN = ("learning_curve", "losses", "diagnostics", "drift")
"""Pictures of a run that a report draws itself."""
MANY = pictures.ARMS_A_PICTURE
"""Arms up to which a picture of all of them can be read."""
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
        arms: of its legend, where it has one: an arm for each of its runs.
        first: whether it is shown at once; others are shown when they are asked for.
    """

    picture: Picture
    alt: str
    title: str = ""
    caption: str = ""
    arms: Sequence[str] = ()
    first: bool = True


def beside(path: Path) -> dict[str, Any]:
    """The numbers of a figure, which lie beside its picture; empty where there are none.

    Raises:
        ConfigError: they cannot be read, or are no JSON object.
    """
    path = path.with_suffix(".json")
    try:
        values = parse_json(readme.text_of(path) or "{}")
    except ValueError as error:
        raise ConfigError(f"{path}: not JSON: {error}") from None
    if not isinstance(values, dict):
        raise ConfigError(f"{path}: not a JSON object")
    return values


def figures(folders: Iterable[Path], seen: Collection[Path], looks: Looks) -> list[Shown]:
    """What experiments.figures has drawn, with its title and question; not what a README has shown."""
    shown = []
    for path in itertools.chain(
        *(sorted(x.glob("figures/*.png"), key=lambda p: natural(p.name)) for x in folders)
    ):
        about = beside(path)
        title, question = (str(about.get(key) or "") for key in ("title", "question"))
        name = f"Figure {about['figure']}. {title}" if about.get("figure") else title or path.stem
        drawn = about["styles"] if isinstance(about.get("styles"), dict) else {}
        if any(looks[arm][0] not in str(drawn[arm]) for arm in drawn.keys() & looks):
            question += " Its colours are not this page's: it was drawn of other arms."
        if path.resolve() not in seen:
            shown.append(Shown(pictures.taken(path, pictures.LARGEST), name, name, question.strip()))
    return shown


def learning_curves(
    game: str, comparison: numbers.Comparison, looks: Looks, baseline: str | None
) -> dict[str, list[Shown]]:
    """ "means": all arms, the baseline and a few in each picture; "seeds": each arm with all of its seeds."""
    means, seeds = {}, {}
    for arm, its in comparison.curves.items():
        means[arm] = pictures.interval_curves(its)
        seeds[arm] = [pictures.interval_curves([one]) for one in its]
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
        none = np.full(len(means[arm].at), np.nan)
        lines.append(((colour, line), means[arm]._replace(low=none, high=none)))
        picture = pictures.curves(arm, lines, size=(3.0, 2.1), **how)
        apart.append(Shown(picture, f"{game}: {arm}, each seed"))
    return {"means": together, "seeds": apart}


def profiles(
    comparisons: Mapping[str, numbers.Comparison], looks: Looks, baseline: str | None
) -> list[Shown]:
    """Performance profiles; none of a single seed an arm."""
    games, thresholds, found = numbers.profiles(comparisons)
    if all(np.isnan(interval.low).all() for interval in found.values()):
        return []
    curves = {arm: Curve(thresholds, *interval[:3]) for arm, interval in found.items()}
    counts = {arm: sum(len(comparisons[game].ends[arm]["at_the_end"]) for game in games) for arm in found}
    across = "normalised return at the end"
    if any(interval.kind == statistics.NARROW for interval in found.values()):
        across += f"\nbands of fewer than {statistics.ENOUGH} runs are too narrow"
    how = {"label": "share of runs above it", "across": across}
    return _in_groups(", ".join(games), curves, counts, looks, baseline, limits=(-0.03, 1.03), **how)


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
        arms = [arm for arm in group for _ in range(counts[arm])]
        shown.append(Shown(picture, f"{title}: {how['label']}", arms=arms))
    return shown


def groups(arms: Sequence[str], baseline: str | None) -> list[list[str]]:
    """The arms in groups of at most `MANY` and about the same size, the baseline in each."""
    others = [arm for arm in arms if arm != baseline]
    first = [arm for arm in arms if arm == baseline]
    count = -(-len(others) // (MANY - len(first))) or 1
    size = -(-len(others) // count) or 1
    return [first + others[i : i + size] for i in range(0, max(len(others), 1), size)]


def differences(game: str, tables: Sequence[Mapping[str, Any]], looks: Looks, baseline: str) -> list[Shown]:
    """How arms differ from the baseline, from the two `numbers.table` of a game; none without intervals."""
    names = ("at the end", "averaged over env steps")
    panels = {
        name: {arm: row["return_difference"] for arm, row in table.items() if "return_difference" in row}
        for name, table in zip(names, tables, strict=True)
    }
    arms = panels[names[0]]
    if all(np.isnan(interval.low) for interval in arms.values()):
        return []
    styles = [looks[arm] for arm in arms]
    picture = pictures.drawn(
        lambda path: plots.differences(game, baseline, panels, dict.fromkeys(panels, styles), path)
    )
    return [Shown(picture, f"{game}: differences from {baseline}")]


def measured(runs: Sequence[RunData], prefixes: Sequence[str], looks: Looks) -> list[Shown]:
    """Pictures of the numbers in the rows of a game's runs: a line an arm, with its 95 % t interval.

    Args:
        runs: of one game.
        prefixes: of the keys, "loss/", say. Those that measures.csv does not have come last.
        looks: arm -> its colour and line. With more arms than `MANY`, intervals are left out, and so is what
            matters less.
    """
    many = len(looks) > MANY
    text = importlib.resources.files(__package__).joinpath("measures.csv").read_text(encoding="utf-8")
    forms = list(csv.DictReader(text.splitlines()))
    keys = sorted({key for run in runs for row in run.rows for key in row if key.startswith(tuple(prefixes))})
    exact = {form["key"] for form in forms}
    known = {key for key in keys for form in forms if fnmatch.fnmatchcase(key, form["key"])}
    new = [key for key in keys if key not in known and key != "diag/drift/steps"]
    forms += [{"key": key, "place": 0, "title": key, "meaning": "", "first": ""} for key in new]
    shown = []
    for form in [form for form in forms if form["first"] or not many]:
        before, _, after = form["key"].partition("*")
        for key in keys:
            if key != form["key"] and (key in exact or not fnmatch.fnmatchcase(key, form["key"])):
                continue
            members = {
                arm: [_curve(run, key, int(form["place"])) for run in runs if run.arm == arm] for arm in looks
            }
            curves = {arm: pictures.interval_curves(its) for arm, its in members.items()}
            if lines := [(looks[arm], curve) for arm, curve in curves.items() if curve is not None]:
                if many:  # bands would hide the lines
                    lines = [
                        (x, curve._replace(low=np.nan * curve.low, high=np.nan * curve.high))
                        for x, curve in lines
                    ]
                title = form["title"].replace("{}", key.removeprefix(before).removesuffix(after))
                picture = pictures.curves(title, lines, across=plots.steps_label(runs[0].game))
                alt = f"{runs[0].game}: {title}"
                shown.append(Shown(picture, alt, caption=form["meaning"], first=bool(form["first"])))
    return shown


def of_losses(runs: Iterable[RunData]) -> list[str]:
    """The prefixes of what losses say beside their values: "rl/", and "NAME/" of each objective."""
    return sorted({"rl/", *(f"{specs.split(text)[0]}/" for run in runs for text in run.config.objectives)})


def _curve(run: RunData, key: str, place: int) -> tuple[np.ndarray, np.ndarray]:
    points = []
    for row in run.rows:
        if row.get(key) not in (None, []):
            value = row[key][place] if isinstance(row[key], list) else row[key]
            value = numbers.value_of(run, {key: value}, key)
            points += [(row["env_steps"], value)] if value is not None else []
    return np.array([p[0] for p in points], np.int64), np.array([p[1] for p in points], np.float64)


def drift(runs: Iterable[RunData]) -> list[Shown]:
    """The error of each epoch's decoder on each epoch's encoder, a picture a run."""
    shown = []
    for run in runs:
        picture = pictures.drawn(functools.partial(run_figures.drift_matrix, run.rows, title=""))
        if picture is not None:
            caption = f"seed {run.seed}: each epoch's decoder on each epoch's encoder"
            shown.append(Shown(picture, f"{run.game} / {run.arm}: drift", run.arm, caption))
    return shown


def own_pictures(games: Iterable[numbers.Game]) -> dict[str, dict[str, list[Shown]]]:
    """Game -> "gif" and "png" -> what lies with the first seed of each arm, and a report cannot draw.

    These are games that were played, and inputs and outputs of objectives. They are made smaller where all of
    them would be too much for a page.
    """
    found = [
        (run, path)
        for game in games
        for run in game.first
        for path in sorted((run.path / "figures").glob("*.*"))
        if path.suffix in (".gif", ".png") and path.stem not in OWN
    ]
    limit = min(max(MEDIA_BYTES // max(len(found), 1), SMALLEST_PICTURE), LARGEST_PICTURE)
    shown: dict[str, dict[str, list[Shown]]] = {}
    for run, path in found:
        name, kinds = f"seed {run.seed}: {path.stem}", shown.setdefault(run.game, {"gif": [], "png": []})
        picture = pictures.taken(path, limit)
        kinds[path.suffix[1:]].append(Shown(picture, f"{run.game} / {run.arm} / {name}", run.arm, name))
    return shown
