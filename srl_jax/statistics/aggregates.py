"""Statistics of scores: games reduced to one number."""

from collections.abc import Callable, Mapping, Sequence
from math import lcm
from typing import Any

import numpy as np

from srl_jax import data

Scores = np.ndarray | Mapping[str, Any]
"""float64 [..., runs, games], or game -> [..., runs]."""
Statistic = Callable[..., np.ndarray]
"""Of scores, one argument an arm; the axes before runs and games are kept."""

_EXACT = 1 << 53
"""Whole numbers up to this one are floats, and sums of them exact."""


def human_normalised(game: str, scores: Any) -> np.ndarray:
    """Scores on a scale where 0 is a random policy's and 1 a human's, float64 of the same shape.

    Catch has neither: there 0 is a missed ball and 1 a caught one.

    Raises:
        ValueError: the game is not known.
    """
    low, high = data.reference_scores(game)
    return (np.asarray(scores, np.float64) - low) / (high - low)


def mean(scores: Scores) -> np.ndarray:
    """The mean over games of each game's mean, float64 [...].

    Raises:
        ValueError: there are no scores, or some are not finite; so for every statistic here.
    """
    return _game_means(scores).mean(-1)


def median(scores: Scores) -> np.ndarray:
    """The median over games of each game's mean, float64 [...]."""
    return np.median(_game_means(scores), axis=-1)


def interquartile_mean(scores: Scores) -> np.ndarray:
    """The mean of all runs of all games without the lowest and the highest quarter, float64 [...].

    A quarter is rounded down to whole runs. Where games have different numbers of runs, each run counts as
    many times as makes all games equal.
    """
    values, kept, _ = _middle(scores)
    return (kept * values).sum(-1)


def interquartile_terms(scores: Scores) -> dict[str, np.ndarray]:
    """What each run adds to the interquartile mean, so that the mean over games of their means is that.

    It is the run's score, no further out than the outermost one that is kept, over the share that is kept,
    less a constant. How these vary says how much the interquartile mean varies: they are its influence
    function (Huber, "Robust Statistics", 1981, section 3.3).

    Returns:
        game -> float64 [..., runs].
    """
    values, kept, share = _middle(scores)
    inside = np.where(kept > 0, values, np.nan)
    low, high = np.nanmin(inside, -1)[..., None], np.nanmax(inside, -1)[..., None]
    terms = {game: np.clip(x, low, high) / share for game, x in by_game(scores).items()}
    shift = (kept * values).sum(-1) - mean(terms)
    return {game: x + shift[..., None] for game, x in terms.items()}


def _middle(scores: Scores) -> tuple[np.ndarray, np.ndarray, float]:
    """What is left without the lowest and the highest quarter.

    Returns:
        The runs of all games from the lowest to the highest, float64 [..., runs of all games]; the weight of
        each in the interquartile mean, likewise; and which share of all weight that is of.
    """
    games = list(by_game(scores).values())
    common = lcm(*(game.shape[-1] for game in games))  # of many different numbers, larger than any float
    unit = min(common, _EXACT)
    counts = np.concatenate([np.full(game.shape[-1], unit / game.shape[-1]) for game in games])
    values = np.concatenate(games, axis=-1)
    order = np.argsort(values, axis=-1)
    upto = np.cumsum(counts[order], axis=-1)
    total = unit * len(games)
    cut = common * len(games) // 4 * unit / common
    kept = np.diff(np.clip(upto, cut, total - cut), axis=-1, prepend=cut)
    return np.take_along_axis(values, order, -1), kept / (total - 2 * cut), (total - 2 * cut) / total


def optimality_gap(scores: Scores, threshold: float = 1.0) -> np.ndarray:
    """How much scores fall short of the threshold on average, none by less than 0; float64 [...]."""
    return threshold - _game_means({g: np.minimum(x, threshold) for g, x in by_game(scores).items()}).mean(-1)


def probability_of_improvement(x: Scores, y: Scores) -> np.ndarray:
    """How likely a run of x is to have a higher score than one of y, the mean over games; ties count half.

    Args:
        x: scores of one arm.
        y: scores of another one, of the same games; its numbers of runs may differ.

    Returns:
        float64 [...].

    Raises:
        ValueError: the games differ.
    """
    ours, theirs = by_game(x), by_game(y)
    check_games(ours, theirs)
    wins = []
    for game, mine in ours.items():
        other = theirs[game]
        runs = (mine[..., [i]] for i in range(mine.shape[-1]))
        shares = [((run > other).mean(-1) + (run >= other).mean(-1)) / 2 for run in runs]
        wins.append(np.mean(shares, axis=0))
    return np.mean(wins, axis=0)


def performance_profile(scores: Scores, thresholds: Sequence[float]) -> np.ndarray:
    """The run-score distribution: the share of runs above each threshold [T], averaged over games.

    Returns:
        float64 [..., T].
    """
    games = by_game(scores)
    shares = ((x[..., None] > np.asarray(thresholds)).mean(-2) for x in games.values())
    return sum(shares, np.zeros(())) / len(games)


AGGREGATES: dict[str, Statistic] = {
    "mean": mean,
    "median": median,
    "interquartile_mean": interquartile_mean,
    "optimality_gap": optimality_gap,
}
"""What `summary` gives of each arm's human-normalised scores."""


def by_game(scores: Scores) -> dict[str, np.ndarray]:
    """The scores as a mapping from a game to float64 [..., runs]; columns of an array are games "0", "1", ...

    Raises:
        ValueError: there are no scores, or some are not finite.
    """
    if not isinstance(scores, Mapping):
        scores = np.asarray(scores, np.float64)
        if scores.ndim < 2:
            raise ValueError(f"scores are [runs, games], or game -> [runs]; got the shape {scores.shape}")
        scores = {str(i): scores[..., i] for i in range(scores.shape[-1])}
    games = {game: np.asarray(x, np.float64) for game, x in scores.items()}
    if not games or not all(x.size for x in games.values()):
        raise ValueError("no scores, or a game without any")
    for game, x in games.items():
        if not np.isfinite(x).all():
            raise ValueError(f"the scores of game {game} are not all finite")
    return games


def check_games(x: Mapping[str, Any], y: Mapping[str, Any]) -> None:
    """Raises ValueError if the games are not the same."""
    if x.keys() != y.keys():
        raise ValueError(f"the games differ: {', '.join(x)} and {', '.join(y)}")


def _game_means(scores: Scores) -> np.ndarray:
    return np.stack([x.mean(-1) for x in by_game(scores).values()], axis=-1)
