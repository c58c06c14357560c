"""The table of several arms that figures and reports show."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from srl_jax import data
from srl_jax.statistics.aggregates import (
    AGGREGATES,
    Scores,
    by_game,
    human_normalised,
    mean,
    probability_of_improvement,
)
from srl_jax.statistics.estimates import estimate, estimate_difference
from srl_jax.statistics.intervals import Interval


def runs_text(scores: Scores) -> str:
    """How many runs: "5 runs", "5 runs of each of 2 games" or "Pong 5 runs, Qbert 3 runs"."""
    numbers = {game: x.shape[-1] for game, x in by_game(scores).items()}
    texts = {game: f"{number} run{'' if number == 1 else 's'}" for game, number in numbers.items()}
    if len(set(numbers.values())) > 1:
        return ", ".join(f"{game} {text}" for game, text in texts.items())
    text = next(iter(texts.values()))
    return f"{text} of each of {len(numbers)} games" if len(numbers) > 1 else text


def summary(
    arms: Mapping[str, Mapping[str, Any]], *, baseline: str | None = None, **how: Any
) -> list[dict[str, Any]]:
    """A table of every arm: each number with its interval and the runs behind it; values are JSON's.

    Args:
        arms: arm -> game -> raw scores [runs].
        baseline: the arm that all others are compared with; None for none.
        **how: repetitions, level and seed, see `estimate`; the draws of every row start from the seed.

    Returns:
        Rows with the keys arm, against (the baseline, or None), game (None: over all games that every arm
        has and that have reference scores), statistic, point, low, high (None: no interval), kind (see
        `Interval`), runs (their number in words). Statistics: "return" of each game, unnormalised;
        `AGGREGATES` of human-normalised scores; against the baseline "return_difference" of each game,
        "mean_difference" and so on, the arm's minus the baseline's, and "probability_of_improvement". There
        is no row for what the arms do not share.

    Raises:
        ValueError: the baseline is no arm, or what `mean` raises.
    """
    if baseline is not None and baseline not in arms:
        raise ValueError(f"baseline {baseline} is not one of the arms: {', '.join(arms)}")
    games = [
        game for game in next(iter(arms.values()), {}) if all(game in scores for scores in arms.values())
    ]
    games = data.with_reference_scores(games)
    normal = {a: {g: human_normalised(g, scores[g]) for g in games} for a, scores in arms.items()}
    rows = []

    def add(name: str, found: Interval, of: str, game: str | None, *scores: Scores) -> None:
        numbers = [None if np.isnan(value) else float(value) for value in found[:3]]
        runs = " against ".join(dict.fromkeys(runs_text(arm) for arm in scores))
        against = baseline if len(scores) > 1 else None
        row = {"arm": of, "against": against, "game": game, "statistic": name}
        values = dict(zip(Interval._fields, [*numbers, found.kind], strict=True))
        rows.append(row | values | {"runs": runs})

    for arm, scores in arms.items():
        theirs = {} if arm == baseline or baseline is None else arms[baseline]
        for game in scores:
            mine = {game: scores[game]}
            add("return", estimate(mean, mine, **how), arm, game, mine)
            if game in theirs:
                base = {game: theirs[game]}
                add("return_difference", estimate_difference(mine, base, **how), arm, game, mine, base)
        if not games:
            continue
        mine = normal[arm]
        for name, statistic in AGGREGATES.items():
            add(name, estimate(statistic, mine, **how), arm, None, mine)
        if baseline is not None and theirs:
            base = normal[baseline]
            for name, statistic in AGGREGATES.items():
                found = estimate_difference(mine, base, statistic, **how)
                add(f"{name}_difference", found, arm, None, mine, base)
            found = estimate(probability_of_improvement, mine, base, **how)
            add("probability_of_improvement", found, arm, None, mine, base)
    return rows
