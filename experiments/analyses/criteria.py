"""The tests that a campaign's criteria.json asks for: `python -m experiments.analyses.criteria`.

A campaign (--campaign) writes down before its runs what will decide, as data:

    game       of the runs
    seeds      that decide, of each of which every arm has one run; others, as of a search, do not count
    measures   what is tested of each run, of `MEASURES`
    families   {family: {test: {arm: weight}}}: weighted sums of the means of arms, each with a two-sided
               t test of 0 (`srl_jax.statistics.contrast`); Holm's correction is over a family, for each
               measure on its own. An arm less its baseline has weights 1 and -1.
    doses      optional: {"across": what varies, "reference": an arm, "panels": {panel: {line: {dose: arm}}}},
               drawn over the logarithm of the dose; of each line it is said how often which dose is best,
               when the runs of each arm are drawn again with replacement; it needs the measure area

`--out` writes DIRECTORY/tests.json and .md, and doses.png where there are doses. Imports no jax.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from absl import flags

from srl_jax import statistics
from srl_jax.diagnostics.drift import STEPS
from srl_jax.errors import ConfigError
from srl_jax.files import display
from srl_jax.files.reading import read_json

from .. import packing
from ..command_line import flags as config_flags
from ..command_line import paths
from ..drawing import plots
from ..runs import collect
from ..runs.json_values import json_text, limits, plain
from ..runs.run_data import RunData
from . import output
from .populations import LEVEL

CRITERIA = "criteria.json"
WRITTEN = "tests.json", "tests.md", "doses.png"
REPETITIONS = 10_000

Arms = Mapping[str, Sequence[RunData]]


def areas(arms: Arms) -> dict[str, np.ndarray]:
    """{arm: area under the learning curve of each run}."""
    curves = {arm: [collect.steps_and_returns(run) for run in runs] for arm, runs in arms.items()}
    return {arm: ends["area_under_curve"] for arm, ends in collect.ends(curves)[1].items()}


def drifts(arms: Arms, key: str = "diag/drift/cosine") -> dict[str, np.ndarray]:
    """{arm: 1 less the cosine of latents with those of the encoder kept last before, mean over a run's rows}.

    The first row that has one is left out: it compares with the encoder from before any update.
    """
    return {arm: np.array([_drift(run, key) for run in runs]) for arm, runs in arms.items()}


def _drift(run: RunData, key: str) -> float:
    rows = [row for row in run.rows if row.get(STEPS)][1:]
    if not rows or not all(row.get(key) for row in rows):
        raise ConfigError(f"{run.path}: has no {key}, which --diagnostics of this version gives")
    cosines = [row[key][-1] for row in rows]
    if None in cosines:
        raise ConfigError(f"{run.path}: {key} is null at an evaluation: the latents were constant")
    return 1.0 - float(np.mean(cosines))


MEASURES: dict[str, Callable[[Arms], dict[str, np.ndarray]]] = {
    "area": areas,
    "drift": drifts,
    "centred_drift": partial(drifts, key="diag/drift/centred_cosine"),
}


def analyse(campaign: Path, asked: Mapping[str, Any]) -> dict[str, Any]:
    """The tests of a campaign, as JSON values.

    Args:
        campaign: the folder.
        asked: its criteria, see `read`.

    Returns:
        {"arms": {measure: {arm: its mean and interval}}, "tests": {measure: {family: {test: the weighted
        sum, its interval, "p", "holm": p after the correction}}}, "best": {panel: {line: {dose: share}}}}.

    Raises:
        ConfigError: a run is not there, is not over, or cannot be compared.
    """
    arms = runs_of(campaign, asked)
    found: dict[str, Any] = {"arms": {}, "tests": {}}
    measured = {measure: MEASURES[measure](arms) for measure in asked["measures"]}
    for measure, values in measured.items():
        found["arms"][measure] = {arm: limits(statistics.mean_interval(x)) for arm, x in values.items()}
        found["tests"][measure] = {
            family: tested(tests, values) for family, tests in asked["families"].items()
        }
    if doses := asked.get("doses"):
        found["best"] = {
            panel: {line: best(its, measured["area"]) for line, its in lines.items()}
            for panel, lines in doses["panels"].items()
        }
    return found


def read(campaign: Path) -> dict[str, Any]:
    """A campaign's criteria.

    Raises:
        ConfigError: they are none.
    """
    path = campaign / CRITERIA
    asked = read_json(path)
    try:
        unknown = set(asked["measures"]) - MEASURES.keys()
        tests = [weights for family in asked["families"].values() for weights in family.values()]
        if not all(weights and all(type(x) in (int, float) for x in weights.values()) for weights in tests):
            raise ValueError
        seeds = asked["seeds"]
        if unknown or not tests or not isinstance(asked["game"], str) or not isinstance(seeds, list):
            raise ValueError
        if len(set(seeds)) < len(seeds) or len(seeds) < 2 or not all(type(seed) is int for seed in seeds):
            raise ValueError
        if doses := asked.get("doses"):
            lines = [its for of_panel in doses["panels"].values() for its in of_panel.values()]
            named = doses.keys() >= {"across", "reference"} and "area" in asked["measures"]
            arms = [doses.get("reference"), *(arm for its in lines for arm in its.values())]
            if not named or not all(float(dose) > 0 for its in lines for dose in its):
                raise ValueError
            if not all(isinstance(arm, str) for arm in arms):
                raise ValueError
    except (TypeError, KeyError, ValueError, AttributeError):
        wanted = (
            f'"game", two "seeds" or more, "measures" out of {", ".join(MEASURES)}, "families" of tests '
            f'{{arm: weight}}, and perhaps "doses" above 0, see experiments/analyses/criteria.py'
        )
        raise ConfigError(f"{path}: expected {wanted}") from None
    return asked


def runs_of(campaign: Path, asked: Mapping[str, Any]) -> dict[str, list[RunData]]:
    """The runs of each arm that the criteria name."""
    there = collect.grouped(packing.read(campaign)).get(asked["game"], {})
    named = [arm for family in asked["families"].values() for weights in family.values() for arm in weights]
    if doses := asked.get("doses"):
        named += [arm for lines in doses["panels"].values() for its in lines.values() for arm in its.values()]
        named.append(doses["reference"])
    wanted = asked["seeds"]
    arms = {arm: [run for run in there.get(arm, []) if run.seed in wanted] for arm in dict.fromkeys(named)}
    for arm, runs in arms.items():
        over = {run.seed for run in runs if run.over and not run.failed}
        if missing := [seed for seed in wanted if seed not in over]:
            seeds = ", ".join(map(str, missing))
            raise ConfigError(f"{campaign}: {arm} on {asked['game']} has no run that is over of seed {seeds}")
    every = [run for runs in arms.values() for run in runs]
    collect.check_arms(every)
    collect.check_protocols(every)
    return arms


def tested(
    tests: Mapping[str, Mapping[str, float]], values: Mapping[str, np.ndarray]
) -> dict[str, dict[str, Any]]:
    """The tests of a family on one measure."""
    found = {}
    for name, weights in tests.items():
        groups = [values[arm] for arm in weights], list(weights.values())
        found[name] = limits(statistics.contrast(*groups)) | {"p": plain(statistics.contrast_p(*groups))}
    ps = [np.nan if row["p"] is None else row["p"] for row in found.values()]
    for row, p in zip(found.values(), statistics.holm(ps), strict=True):
        row["holm"] = plain(p)
    return found


def best(doses: Mapping[str, str], values: Mapping[str, np.ndarray]) -> dict[str, float]:
    """{dose: how often its arm has the highest mean}, of `REPETITIONS` in which runs are drawn again."""
    rng = np.random.default_rng(0)
    means = [
        x[rng.integers(len(x), size=(REPETITIONS, len(x)))].mean(-1)
        for x in (values[arm] for arm in doses.values())
    ]
    counts = np.bincount(np.argmax(means, 0), minlength=len(doses))
    return {dose: float(count / REPETITIONS) for dose, count in zip(doses, counts, strict=True)}


def tables(found: Mapping[str, Any]) -> str:
    """The tests as tables in Markdown; bold is what is told from 0 after Holm's correction."""
    parts = []
    for measure, families in found["tests"].items():
        for family, tests in families.items():
            body = [[name, *_cells(row)] for name, row in tests.items()]
            title = f"**{family}** ({measure})"
            parts.append(f"{title}\n\n{output.markdown(['test', 'found', 'p', 'after Holm'], body)}")
        arms = [[arm, output.interval(row, ".3f")] for arm, row in found["arms"][measure].items()]
        parts.append(f"**Arms** ({measure})\n\n{output.markdown(['arm', 'mean'], arms)}")
    for panel, lines in found.get("best", {}).items():
        doses = dict.fromkeys(dose for its in lines.values() for dose in its)
        body = [
            [line, *(f"{100 * its[dose]:.0f} %" if dose in its else "-" for dose in doses)]
            for line, its in lines.items()
        ]
        table = output.markdown(["best of", *doses], body)
        parts.append(f"**How often which dose is best, {panel}**\n\n{table}")
    return "\n\n".join(parts)


def _cells(row: Mapping[str, Any]) -> list[str]:
    text = output.interval(row, "+.3f")
    told = row["holm"] is not None and row["holm"] <= LEVEL
    return [f"**{text}**" if told else text] + [
        "-" if row[key] is None else f"{row[key]:.4f}" for key in ("p", "holm")
    ]


def draw(asked: Mapping[str, Any], found: Mapping[str, Any], path: Path) -> Path:
    """Draws the mean area of each dose, with the reference as a horizontal line.

    Args:
        asked: criteria that ask for doses.
        found: of `analyse`.
        path: of the PNG file.
    """
    doses, areas = asked["doses"], found["arms"]["area"]
    reference, panels = doses["reference"], []
    for title, lines in doses["panels"].items():
        drawn = []
        for name, its in lines.items():
            at = [float(np.log10(float(dose))) for dose in its]
            band = (
                np.array([areas[arm][key] for arm in its.values()], float) for key in ("mean", "low", "high")
            )
            drawn.append(plots.Line(name, plots.Curve(at, *band), len(asked["seeds"])))
        level = plots.Level(reference, areas[reference]["mean"])
        ticks = {float(np.log10(float(dose))): dose for its in lines.values() for dose in its}
        panels.append(plots.Panel("", drawn, [level], title=title, across=doses["across"], ticks=ticks))
    return plots.draw_panels(panels, path, "", label="area under the learning curve")


def define_flags(values: flags.FlagValues) -> None:
    """Defines this entry point's flags."""
    flags.DEFINE_string("campaign", "", f"packed campaign with a {CRITERIA}", values)
    output.define_out("tests.json and .md, and doses.png where doses are asked for", values)


def main(values: flags.FlagValues) -> None:
    """The entry point."""
    campaign = paths.given("campaign", values.campaign)
    asked = read(campaign)
    out = output.place(values.out, drawn="doses" in asked)
    found = analyse(campaign, asked)
    display.result(tables(found))
    if out is not None:
        output.write(out, {"tests.json": json_text(found), "tests.md": tables(found)})
        if "doses" in asked:
            draw(asked, found, out / "doses.png")


if __name__ == "__main__":
    config_flags.program(main, define_flags)()
