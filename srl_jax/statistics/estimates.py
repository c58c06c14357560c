"""Which interval is right for what: the one place that decides it.

- A mean over the runs of one game: the t interval, Student's of an arm, Welch's of a difference. Where
  returns are normal it covers what it says from two runs on, and with many it is the bootstrap's.
- All else, that is aggregates over several games and what is no mean (the interquartile mean, the median run,
  the probability of improvement, profiles): the stratified bootstrap, which is too narrow with few runs.
- A single run: none.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from srl_jax.statistics.aggregates import (
    Scores,
    Statistic,
    by_game,
    check_games,
    mean,
    median,
    optimality_gap,
)
from srl_jax.statistics.intervals import (
    REPETITIONS,
    Interval,
    bootstrap,
    bootstrap_curve,
    bootstrap_difference,
    curves_by_game,
)
from srl_jax.statistics.student import mean_difference, mean_interval

MEANS = (mean, median, optimality_gap)
"""Statistics that, of one game, are the mean of what they are of each run alone."""


def estimate(
    statistic: Statistic, *arms: Scores, repetitions: int = REPETITIONS, level: float = 0.95, seed: int = 0
) -> Interval:
    """A statistic of one or several arms, and the interval that is right for it.

    Args:
        statistic: see `bootstrap`.
        *arms: scores [runs, games], or game -> [runs].
        repetitions: of the bootstrap.
        level: of the interval.
        seed: of the bootstrap's draws.

    Raises:
        ValueError: see `bootstrap`.
    """
    if len(arms) == 1 and (runs := _runs(statistic, by_game(arms[0]))) is not None:
        return mean_interval(runs, level)
    return bootstrap(statistic, *arms, repetitions=repetitions, level=level, seed=seed)


def estimate_difference(
    x: Scores,
    y: Scores,
    statistic: Statistic = mean,
    *,
    level: float = 0.95,
    **how: int,
) -> Interval:
    """The statistic of x less that of y, and the interval that is right for it.

    Args:
        x: scores of one arm.
        y: scores of another one, of the same games; its numbers of runs may differ.
        statistic: of one arm.
        level: of the interval.
        **how: repetitions and seed, see `estimate`.

    Raises:
        ValueError: the games differ, or see `bootstrap`.
    """
    ours, theirs = by_game(x), by_game(y)
    check_games(ours, theirs)
    if (runs := _runs(statistic, ours)) is not None:
        return mean_difference(runs, _runs(statistic, theirs), level)
    return bootstrap_difference(ours, theirs, statistic, level=level, **how)


def curve_interval(returns: Any, statistic: Statistic = mean, *, level: float = 0.95, **how: int) -> Interval:
    """A statistic of learning curves, and at each point the interval that is right for it.

    Args:
        returns: float64 [runs, points] of one game, [runs, games, points], or game -> [runs, points].
        statistic: of one arm's scores.
        level: of the interval at one point; not of the whole curve.
        **how: repetitions and seed, see `estimate`.

    Returns:
        An Interval of arrays [points].

    Raises:
        ValueError: the curves have another form, or see `bootstrap`.
    """
    games = curves_by_game(returns)
    if (runs := _runs(statistic, games)) is not None:
        return mean_interval(runs, level)
    return bootstrap_curve(returns, statistic, level=level, **how)


def _runs(statistic: Statistic, games: Mapping[str, np.ndarray]) -> np.ndarray | None:
    """The values of runs, [..., runs], that the statistic is the mean of; None where it is no such mean."""
    if len(games) != 1 or statistic not in MEANS:
        return None
    return statistic({game: x[..., None] for game, x in games.items()})
