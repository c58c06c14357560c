"""The head of a report: what was run, and what its numbers say."""

from collections.abc import Sequence

import numpy as np

from srl_jax.data import reference_policies
from srl_jax.statistics import BOOTSTRAP, ENOUGH, NARROW, WELCH, Interval

from .. import collect
from . import configs, numbers, pictures
from .configs import About
from .contents import (
    Content,
    Report,
    difference_text,
    limits,
    name_of,
    run_name,
    side,
)
from .markup import Markup, details, figure, listed, number, plural, table, tag
from .numbers import Row
from .tables import interval_of, summary_of

TESTS = {WELCH: "Welch's t test at 5 %", BOOTSTRAP: "a 95 % bootstrap interval that leaves out 0"}
"""What it is that an interval of this kind leaves out 0."""
FEW_ARMS = 3
"""Arms whose differences are said in the text; more are in the tables alone."""


def what_was_run(report: Report) -> Content:
    """Games, arms, seeds, env steps, revisions, when, on what; runs that have not ended, by name."""
    abouts = [configs.about(run) for run in report.runs]
    ended = [numbers.finished(run) for run in report.runs]
    planned = sorted({run.config.steps for run in report.runs})
    total = sum(numbers.reached_step(run) for run in report.runs)
    began = sorted({about.started for about in abouts if about.started})
    revisions = sorted({_short(about) for about in abouts})
    facts = [
        ("Games", ", ".join(report.games)),
        ("Arms", [[", " if i else "", tag("span", arm, class_="name")] for i, arm in enumerate(report.arms)]),
        ("Seeds", _seeds(report)),
        ("Env steps", f"{listed(f'{n:,}' for n in planned)} a run; {total:,} in all"),
        ("Complete", f"{sum(ended)} of {plural(len(ended), 'run')}"),
        ("Compared with", report.baseline or "nothing: no arm has a policy"),
        ("Begun (UTC)", " to ".join(dict.fromkeys([began[0], began[-1]])) if began else "not recorded"),
        ("Revisions", [[", " if i else "", tag("code", name)] for i, name in enumerate(revisions)]),
        ("Machine", _machine(abouts)),
        ("Directory", [[", " if i else "", tag("code", name_of(x))] for i, x in enumerate(report.roots)]),
    ]
    parts: list = [tag("dl", [[tag("dt", name), tag("dd", value)] for name, value in facts])]
    if failed := [run for run in report.runs if run.failed]:
        items = [tag("li", f"{run_name(run)}: {run.ended.reason}") for run in failed]
        parts.append(tag("div", tag("strong", "Failed, not compared:"), tag("ul", items), class_="warn"))
    if left := [r for r, done in zip(report.runs, ended, strict=True) if not (done or r.failed)]:
        items = [
            tag("li", f"{run_name(run)}: {numbers.reached_step(run):,} of {run.config.steps:,} env steps")
            for run in left
        ]
        how = "not compared" if report.finished_only else "compared as far as they have been evaluated"
        parts.append(tag("div", tag("strong", f"Not finished, {how}:"), tag("ul", items), class_="warn"))
    if len(revisions) > 1:
        parts.append(tag("p", "The runs are of several revisions of the code.", class_="note"))
    parts.append(details("Every run", _all_runs(report, abouts)))
    versions = sorted({f"{name} {version}" for about in abouts for name, version in about.versions})
    if versions:
        parts.append(details("Versions", tag("p", ", ".join(versions), class_="note")))
    return parts


def _short(about: About) -> str:
    parts = [revision.partition("-") for revision in about.revision.split(configs.THEN)]
    short = [name[:10] + ("-dirty" if dirty else "") for name, _, dirty in parts]
    return configs.THEN.join(short) or "not recorded"


def _seeds(report: Report) -> str:
    counts = {len(report.of(game, arm)) for game in report.games for arm in report.arms} - {0}
    seeds = sorted({run.seed for run in report.runs})
    each = " to ".join(map(str, sorted({min(counts), max(counts)})))
    return f"{each} of each arm on a game ({', '.join(map(str, seeds))})"


def _machine(abouts: Sequence[About]) -> str:
    found = set()
    for about in abouts:
        versions = dict(about.versions)
        parts = [versions.get("platform", ""), f"{about.cpus} CPUs" if about.cpus else ""]
        parts += [f"{name} {versions[name]}" for name in ("python", "jax") if name in versions]
        found.add(", ".join(filter(None, parts)))
    return "; ".join(sorted(found - {""})) or "not recorded"


def _all_runs(report: Report, abouts: Sequence[About]) -> Markup:
    rows = []
    for run, about in zip(report.runs, abouts, strict=True):
        steps, returns = collect.steps_and_returns(run)
        last = f"{number(float(returns[-1]))} at {steps[-1]:,}" if len(steps) else "–"
        cells = [run_name(run), f"{numbers.reached_step(run):,} of {run.config.steps:,}"]
        how = "failed" if run.failed else "yes" if numbers.finished(run) else "no"
        cells += [how, len(steps), last, _short(about)]
        cells += [about.started or "–", tag("code", report.place(run))]
        rows.append(cells)
    head = ("run", "env steps", "finished", "evaluations", "last return", "revision", "begun", "directory")
    return table(head, rows, "Every run")


def what_it_says(report: Report) -> Content:
    """The comparison in sentences, only what follows from an interval, and as a picture of each game."""
    parts: list = []
    pictured: list = []
    for game, comparison in report.comparisons.items():
        rows = {row.arm: row for row in report.rows if row.game == game}
        base = rows.pop(report.baseline, None)
        if comparison is None or base is None or not rows:
            continue
        counts = sorted({row.seeds for row in [base, *rows.values()]})
        many = f"{listed(counts)} seed{'' if counts == [1] else 's'} an arm"
        parts.append(tag("p", tag("strong", game), f", {int(comparison.steps[-1]):,} env steps, {many}:"))
        items = []
        for what, of in (("Return at the end", "final"), ("Return averaged over env steps", "area")):
            found = {arm: getattr(row, f"{of}_difference") for arm, row in rows.items()}
            items.append(_sentence(report, what, getattr(base, of), found))
        if policies := reference_policies(game):
            told = [f"a {name} policy has {number(x.return_mean)}" for name, x in policies.items()]
            items.append(tag("li", f"For comparison, {listed(told)}."))
        parts.append(tag("ul", items))
        pictured += _picture(report, game, rows)
    parts += _over_games(report)
    parts.append(tag("div", pictured, class_="grid wide") if pictured else None)
    if not any(parts):
        return None
    note = (
        "Intervals are 95 % intervals over seeds: on one game Student's t of a mean and Welch's t of a "
        "difference, over games the stratified bootstrap. That a Welch interval leaves out 0 is a two-sided "
        "test at 5 %: of twenty comparisons of like arms, one does so by chance on average. Read a "
        "difference that only just does as a hint. The bootstrap's is such a test only roughly."
    )
    parts.append(tag("p", note, class_="note"))
    return parts


def _picture(report: Report, game: str, rows: dict[str, Row]) -> list:
    """The differences from the baseline; none where no arm has an interval."""
    rows = {arm: row for arm, row in rows.items() if row.final_difference is not None}
    if all(np.isnan(row.final_difference.low) for row in rows.values()):
        return []
    panels = {
        "at the end": {arm: row.final_difference for arm, row in rows.items()},
        "averaged over env steps": {arm: row.area_difference for arm, row in rows.items()},
    }
    looks = [report.styles[arm] for arm in rows]
    picture = pictures.differences(game, report.baseline, panels, looks)
    caption = f"{game}: returns less those of {report.baseline}, and their 95 % intervals, Welch's t"
    return [figure(picture.source, caption, f"{game}: differences from {report.baseline}", picture.size)]


def _over_games(report: Report) -> list:
    """The interquartile mean of human-normalised scores, where there are several games."""
    if sum(comparison is not None for comparison in report.comparisons.values()) < 2:
        return []
    items = []
    for what, of in (("At the end", "final"), ("Averaged over env steps", "area")):
        rows = [row for row in summary_of(report, of) if row["game"] is None]
        own = [row for row in rows if row["statistic"] == "interquartile_mean"]
        base = [interval_of(row) for row in own if row["arm"] == report.baseline]
        found = {
            row["arm"]: interval_of(row)
            for row in rows
            if row["statistic"] == "interquartile_mean_difference"
        }
        if base and found:
            items.append(_sentence(report, what, base[0], found))
    title = tag("p", tag("strong", "Over games"), ", interquartile mean of human-normalised returns:")
    return [title, tag("ul", items)] if items else []


def _sentence(
    report: Report,
    what: str,
    base: Interval,
    differences: dict[str, Interval | None],
) -> Markup:
    """What the baseline has, and the arms whose difference from it has an interval without 0.

    On one game that is Welch's test at 5 %. Over games it is the bootstrap's, of which nothing is concluded
    where it is too narrow.

    Args:
        report: with the baseline.
        what: that is compared.
        base: what the baseline has.
        differences: arm -> its difference from it.
    """
    known = {arm: x for arm, x in differences.items() if x is not None and not np.isnan(x.low)}
    few = [arm for arm, x in known.items() if x.kind == NARROW]
    sides = {arm: side(x) for arm, x in known.items()}
    how = next((TESTS[x.kind] for x in known.values() if x.kind in TESTS), "")
    clear = {arm: x for arm, x in known.items() if sides[arm]}
    text = f"{what}: {report.baseline} has {number(float(base.point))} {limits(base)}. "
    for word, sign, than in (("Above", 1, "over it"), ("Below", -1, "against it")):
        items = [arm for arm, x in clear.items() if sides[arm] == sign]
        if FEW_ARMS < len(items) == len(differences):
            items = ["all other arms"]
        elif len(items) <= FEW_ARMS:
            items = [f"{arm} ({difference_text(clear[arm])} {than})" for arm in items]
        if items:
            text += f"{word} it, by {how}: {listed(items)}. "
    if others := [arm for arm in known if arm not in clear and arm not in few]:
        if clear:
            text += f"Not told apart from it: {listed(others)}. "
        else:
            text += f"No arm differs from it by {how}. "
    if few:
        text += (
            f"Too few seeds to say whether they differ from it: {listed(few)}; with fewer than {ENOUGH} of a "
            "game, the bootstrap's interval is too narrow. "
        )
    if unknown := len(differences) - len(known):
        text += (
            f"{plural(unknown, 'arm')} without an interval: one seed, or seeds that are all alike, cannot "
            "tell a difference from chance."
        )
    return tag("li", text.strip())
