"""Intervals; the percentile interval of the stratified bootstrap, which draws runs again within each game."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from srl_jax.statistics.aggregates import Scores, Statistic, by_game, check_games, mean

REPETITIONS = 10_000
"""How often the bootstrap draws again where nothing else is asked for: its limits then vary by about a
hundredth of their distance with the seed of the draws."""

STUDENT, WELCH, STRATIFIED, BOOTSTRAP = "Student's t", "Welch's t", "stratified t", "stratified bootstrap"
NARROW, NONE = "stratified bootstrap, too narrow", "none"
ENOUGH = 5
"""Runs of each game from which the bootstrap's interval is not called too narrow."""


class Interval(NamedTuple):
    """An estimate and its interval.

    Attributes:
        point: float64, the statistic of the scores themselves.
        low: float64 of the same shape, the interval's lower limit; NaN where there is none: with a game that
            has a single run, and where no game of any arm has runs that differ.
        high: float64 of the same shape, the upper limit, likewise.
        kind: how it was made: STUDENT, WELCH, STRATIFIED (t, of several groups of runs), BOOTSTRAP, NARROW (a
            bootstrap of fewer than `ENOUGH` runs of some game) or NONE (of a single run).
    """

    point: np.ndarray
    low: np.ndarray
    high: np.ndarray
    kind: str


def bootstrap(
    statistic: Statistic, *arms: Scores, repetitions: int = REPETITIONS, level: float = 0.95, seed: int = 0
) -> Interval:
    """A statistic of one or several arms and its percentile interval.

    The order of runs does not matter: they are sorted first.

    Args:
        statistic: takes a mapping from a game to scores [..., runs] for each arm; gives [..., *shape].
        *arms: scores [runs, games], or game -> [runs]; each arm is drawn again independently.
        repetitions: how many times.
        level: of the interval.
        seed: of the draws.

    Returns:
        An Interval of arrays [*shape].

    Raises:
        ValueError: level or repetitions are out of range, or what `mean` raises.
    """
    given = [by_game(arm) for arm in arms]
    if any(x.ndim != 1 for arm in given for x in arm.values()):
        raise ValueError("bootstrap takes scores [runs, games], or game -> [runs]")
    given = [{game: np.sort(x) for game, x in arm.items()} for arm in given]
    rng = np.random.default_rng(seed)
    drawn = [
        {game: x[draw] for (game, x), draw in zip(arm.items(), _draw(arm, repetitions, rng), strict=True)}
        for arm in given
    ]
    low, high = percentile_interval(statistic(*drawn), level)
    return _interval(statistic(*given), low, high, *given)


def bootstrap_difference(x: Scores, y: Scores, statistic: Statistic = mean, **how: Any) -> Interval:
    """The statistic of x minus that of y; the arms are drawn again independently.

    Args:
        x: scores of one arm.
        y: scores of the other one; the games must be the same.
        statistic: of one arm.
        **how: see `bootstrap`.
    """
    check_games(by_game(x), by_game(y))
    return bootstrap(difference(statistic), x, y, **how)


def percentile_interval(values: np.ndarray, level: float = 0.95) -> tuple[np.ndarray, np.ndarray]:
    """The limits between which the middle of the values [repetitions, ...] lies, linearly interpolated.

    Args:
        values: a statistic of each repetition.
        level: the share of them in the middle.

    Returns:
        low and high, float64 [...].
    """
    check_level(level)
    tail = (1 - level) / 2
    low, high = np.percentile(values, [100 * tail, 100 * (1 - tail)], axis=0)
    return low, high


def check_level(level: float) -> None:
    """Raises ValueError if it is not between 0 and 1."""
    if not 0 < level < 1:
        raise ValueError(f"level={level}: must be between 0 and 1")


def difference(statistic: Statistic) -> Statistic:
    """(x, y) -> the statistic of x minus that of y."""
    return lambda x, y: statistic(x) - statistic(y)


def _draw(games: Mapping[str, np.ndarray], repetitions: int, rng: np.random.Generator) -> list[np.ndarray]:
    """Indices of runs for each game, [repetitions, runs]."""
    if repetitions < 1:
        raise ValueError(f"repetitions={repetitions}: must be at least 1")
    return [rng.integers(x.shape[-1], size=(repetitions, x.shape[-1])) for x in games.values()]


def _interval(point, low, high, *arms: Mapping[str, np.ndarray]) -> Interval:
    fewest = min(x.shape[-1] for arm in arms for x in arm.values())
    kind = NONE if fewest < 2 else NARROW if fewest < ENOUGH else BOOTSTRAP
    if kind == NONE or all((x == x[0]).all() for arm in arms for x in arm.values()):
        low, high = np.full_like(low, np.nan), np.full_like(high, np.nan)
    point, low, high = (np.asarray(x, np.float64) for x in (point, low, high))
    return Interval(point, low, high, kind)
