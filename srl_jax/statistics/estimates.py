"""Which interval is right for what: the one place that decides it.

- A mean over the runs of one game: the t interval, Student's of an arm, Welch's of a difference. Where
  returns are normal it covers what it says from two runs on, and with many it is the bootstrap's.
- A mean over games of such means: the t interval from the spread of runs within games, likewise.
- The interquartile mean of `MANY` games or more with fewer than `FEW` runs of some: the same, of what each
  run adds to it.
- All else (the interquartile mean of few games or of many runs, the median game, the probability of
  improvement, profiles): the stratified bootstrap, which is too narrow with few runs.
- A single run: none.
"""

from collections.abc import Mapping

import numpy as np

from srl_jax.statistics.aggregates import (
    Scores,
    Statistic,
    by_game,
    check_games,
    interquartile_mean,
    interquartile_terms,
    mean,
    median,
    optimality_gap,
)
from srl_jax.statistics.intervals import REPETITIONS, Interval, bootstrap, bootstrap_difference
from srl_jax.statistics.student import contrast, mean_difference, stratified_interval

MEANS = (mean, optimality_gap)
"""Statistics that are the mean over games of the mean of what they are of each run alone."""
FEW, MANY = 10, 5
"""Runs of a game, and games: see above."""


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
    if len(arms) == 1 and (terms := _terms(statistic, by_game(arms[0]))) is not None:
        return stratified_interval(terms, level)
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
    fewest = min(x.shape[-1] for arm in (ours, theirs) for x in arm.values())
    mine, base = (_terms(statistic, arm, fewest) for arm in (ours, theirs))
    if mine is not None and base is not None:
        groups = [*mine.values(), *base.values()]
        if len(mine) == 1:
            return mean_difference(groups[0], groups[1], level)
        return contrast(groups, np.repeat([1 / len(mine), -1 / len(mine)], len(mine)), level)
    return bootstrap_difference(ours, theirs, statistic, level=level, **how)


def _terms(
    statistic: Statistic, games: Mapping[str, np.ndarray], fewest: int | None = None
) -> dict[str, np.ndarray] | None:
    """game -> [..., runs], whose means have the statistic as their mean; None where there are no such.

    Args:
        statistic: of the arm.
        games: its scores.
        fewest: runs that a game of any arm has; None for those of this one.
    """
    if statistic in MEANS or (statistic is median and len(games) == 1):
        return {game: statistic({game: x[..., None]}) for game, x in games.items()}
    if statistic is interquartile_mean and len(games) >= MANY:
        fewest = fewest or min(x.shape[-1] for x in games.values())
        return interquartile_terms(games) if fewest < FEW else None
    return None
