"""The statistics of a report, each with its interval."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from srl_jax import statistics
from srl_jax.data import (
    POLICIES,
    Published,
    ReferencePolicy,
    published,
    reference_policies,
    with_reference_scores,
)
from srl_jax.statistics import NARROW, Interval

from .. import collect
from . import numbers
from .contents import Content, Report, limits, side, signed
from .markup import Markup, details, number, plural, table, tag
from .numbers import Comparison, Row

NEAR = 2.5
"""Published results of up to so many times as many env steps, or as few, are shown at once."""

AGGREGATES = {
    "mean": "mean",
    "median": "median",
    "interquartile_mean": "interquartile mean",
    "optimality_gap": "optimality gap",
    "probability_of_improvement": "probability of improvement",
}
"""Statistics over games, and what they are called."""


def statistics_of(report: Report) -> Content:
    """Per game, over games, and what others have published."""
    if not report.rows:
        nothing = tag("p", "No run has a policy that was evaluated, so there is nothing to compare.")
        return [nothing, *(_left_out(report, game) for game in report.games)]
    parts: list = [
        tag(
            "p",
            "Runs of a game are compared at env steps that all of them have. In brackets: 95 % intervals "
            "over seeds. Those of a mean on one game are Student's t, of a difference Welch's t, all others "
            "of the stratified bootstrap; a single seed has none. Differences are from ",
            tag("strong", report.baseline),
            "; ▲ and ▼ mark those that Welch's test at 5 % finds.",
        )
    ]
    for game in report.games:
        comparison, left_out = report.comparisons.get(game), _left_out(report, game)
        if game in report.comparisons or left_out:
            parts.append(tag("h3", game))
        if comparison is not None:
            parts += _of_game(report, game, comparison)
        elif game in report.comparisons:
            parts.append(tag("p", "There is no env step that all runs of this game have."))
        parts.append(left_out)
    parts += _over_games(report)
    for game, comparison in report.comparisons.items():
        if comparison is not None:
            parts += _published(report, game, comparison)
    return parts


def _left_out(report: Report, game: str) -> Content:
    """Which seeds of a game are not compared, and why; None where all are."""
    if not (lines := report.left_out(game)):
        return None
    items = tag("ul", [tag("li", line) for line in lines])
    return tag("div", tag("strong", "Not compared:"), items, class_="warn")


def _of_game(report: Report, game: str, comparison: Comparison) -> list:
    end, score = int(comparison.steps[-1]), report.targets.get(game)
    head = ["arm", "seeds", f"return at {end:,}", "difference", f"mean return up to {end:,}", "difference"]
    head += [f"env steps to reach {number(score)}"] if score is not None else []
    body = []
    for row in report.rows:
        if row.game == game:
            cells = [row.arm, row.seeds, _cell(row.final), _difference(row.final_difference)]
            cells += [_cell(row.area), _difference(row.area_difference)]
            body.append(cells + ([_reaching(row, end)] if score is not None else []))
    notes = []
    config = numbers.config_of(report.of(game))
    for name, policy in reference_policies(game).items():
        cell = _policy(policy)
        body.append([f"{name} policy", "–", cell, "–", cell, "–"] + (["–"] if score is not None else []))
        if differs := collect.differs(policy, config):
            notes.append(f"Of the {name} policy differs: {differs}. ")
    if (cut := comparison.cut_by) is not None:
        state = "ended" if numbers.finished(cut) else "has got to and is not finished"
        notes.append(f"Compared up to {end:,} env steps, where {cut.arm}, seed {cut.seed}, {state}. ")
    notes.append(f"The mean return up to {end:,} is the area under the learning curve over the env steps. ")
    if score is not None:
        whose = ""
        own = comparison.returns.get(report.baseline)
        if own is not None and float(np.mean(own[:, -1])) == score:
            whose = f", {number(score)}, is what {report.baseline} ends with on average"
        else:
            whose = f" is {number(score)}"
        notes.append(
            f"The score to be reached{whose}; the median over seeds, never being more than any number."
        )
    return [table(head, body, f"Statistics of {game}"), tag("p", notes, class_="note")]


def _policy(policy: ReferencePolicy) -> list:
    """What a policy that learns nothing scores, at every env step."""
    told = "published" if policy.episodes is None else plural(policy.episodes, "game")
    return [number(policy.return_mean), " ", tag("span", f"({told})", class_="ci")]


def _reaching(row: Row, end: int) -> list:
    shown = [f"> {end:,}" if value > end else f"{value:,.0f}" for value in row.reaching[:3]]
    narrow = " too narrow" if row.reaching.kind == NARROW else ""
    span = "" if np.isnan(row.reaching.low) else f"[{shown[1]}, {shown[2]}]{narrow}, "
    return [shown[0], " ", tag("span", f"{span}{row.reached} of {row.seeds} did", class_="ci")]


def _cell(interval: Interval) -> list:
    return [number(float(interval.point)), " ", tag("span", limits(interval), class_="ci")]


def _difference(interval: Interval | None) -> Content:
    if interval is None:
        return Markup("–")
    shown = signed(float(interval.point))
    if (direction := side(interval)) > 0:
        shown = tag("span", f"{shown} ▲", class_="up")
    elif direction < 0:
        shown = tag("span", f"{shown} ▼", class_="down")
    return [shown, " ", tag("span", limits(interval, signed), class_="ci")]


def interval_of(row: Mapping[str, Any]) -> Interval:
    """The interval of a row of `summary_of`."""
    values = (row[name] for name in ("point", "low", "high"))
    return Interval(*(np.float64(np.nan if value is None else value) for value in values), row["kind"])


def summary_of(report: Report, of: str) -> list[dict]:
    """`srl_jax.statistics.summary` of the last returns, "final", or of those averaged, "area"."""
    given = numbers.scores(report.comparisons, of, report.arms)
    return statistics.summary(given, baseline=report.baseline if report.baseline in given else None)


def _over_games(report: Report) -> list:
    parts: list = [tag("h3", "Over games")]
    titles = {"final": "The return at the end", "area": "The return averaged over env steps"}
    for of, title in titles.items():
        rows = [row for row in summary_of(report, of) if row["game"] is None]
        found = {(row["arm"], row["statistic"]): row for row in rows}
        body = []
        for arm in dict.fromkeys(row["arm"] for row in rows):
            values = [found.get((arm, name)) for name in AGGREGATES]
            cells = [_cell(interval_of(row)) if row else "–" for row in values]
            body.append([arm, found[arm, "mean"]["runs"], *cells])
        if not body:
            continue
        body += _policies_over_games(report, of)
        head, runs = ["arm", "runs", *AGGREGATES.values()], ""
        if len({row[1] for row in body} - {"–"}) == 1:  # said once
            runs = f" ({body[0][1]})"
            head, body = [head[0], *head[2:]], [[row[0], *row[2:]] for row in body]
        parts.append(tag("p", f"{title}, human-normalised{runs}:"))
        parts.append(table(head, body, f"{title}, over games"))
    if len(parts) == 1:
        return [
            *parts,
            tag("p", "No game with reference scores has runs of every arm, so nothing is aggregated."),
        ]
    note = (
        "Human-normalised: 0 is a random policy, 1 a human; in Catch, a miss and a catch. The optimality gap "
        "is what is missing to 1. The probability of improvement is that of a run over one of "
        f"{report.baseline}; 0.5 is no difference. Only games with runs of every arm count."
    )
    return [*parts, tag("p", note, class_="note")]


def _policies_over_games(report: Report, of: str) -> list:
    """Rows of policies that learn nothing, where each game with runs of every arm has them."""
    given = list(numbers.scores(report.comparisons, of, report.arms).values())
    shared = [game for game in report.comparisons if all(game in mine for mine in given)]
    games = with_reference_scores(shared)
    body = []
    for name in POLICIES:
        found = {game: reference_policies(game).get(name) for game in games}
        if all(found.values()):
            normal = {game: statistics.human_normalised(game, [x.return_mean]) for game, x in found.items()}
            values = [statistics.AGGREGATES.get(key) for key in AGGREGATES]
            cells = [number(float(statistic(normal))) if statistic else "–" for statistic in values]
            body.append([f"{name} policy", "–", *cells])
    return body


def _published(report: Report, game: str, comparison: Comparison) -> list:
    results = published(game)
    if not results:
        return []
    end = int(comparison.steps[-1])
    config = numbers.config_of(report.of(game))
    seeds = max(len(x) for x in comparison.returns.values())

    def cells(result: Published) -> list:
        spread = f" ± {number(result.spread)}" if result.spread is not None else ""
        steps = "–" if result.env_steps is None else f"{result.env_steps:,}"
        differs = collect.differs(result, config, end, seeds)
        return [result.method, number(result.score) + spread, steps, differs, result.protocol, result.source]

    near = [x for x in results if x.env_steps is None or end / NEAR <= x.env_steps <= NEAR * end]
    far = [x for x in results if x not in near]
    head = ("method", "score", "env steps", "what differs", "protocol", "source")
    parts = [tag("h3", f"{game}: published results")]
    if near:
        words = f"Of up to {NEAR:g} times as many env steps as here, or as few; what differs is said:"
        parts.append(tag("p", words, class_="note"))
        parts.append(table(head, map(cells, near), f"Published results of {game}", "published"))
    if far:
        more = table(head, map(cells, far), f"More published results of {game}", "published")
        parts.append(details(f"{plural(len(far), 'result')} at other numbers of env steps", more))
    return parts
