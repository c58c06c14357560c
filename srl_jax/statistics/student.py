"""Intervals of means from few runs: Student's t for one arm, Welch's t for the difference of two.

Both are exact, or nearly so, where returns are normal, from two runs on: they pay for the spread that is not
known with a width that grows as runs get fewer. experiments/results/coverage has what they cover.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from srl_jax.statistics.intervals import NONE, STRATIFIED, STUDENT, WELCH, Interval, check_level

_AT = np.linspace(-3.2, 3.2, 81)
_NODES = np.tanh(np.pi / 2 * np.sinh(_AT))
_WEIGHTS = 0.08 * np.pi / 2 * np.cosh(_AT) / np.cosh(np.pi / 2 * np.sinh(_AT)) ** 2
"""Tanh-sinh quadrature from -1 to 1 (Takahasi and Mori 1974), for a root of the integrand near a limit."""
_lgamma = np.vectorize(math.lgamma, otypes=[np.float64])


def mean_interval(x: Any, level: float = 0.95) -> Interval:
    """The mean of an arm's runs and Student's t interval (Student, "The probable error of a mean", 1908).

    Args:
        x: float64 [..., runs].
        level: of each interval.

    Returns:
        An Interval of arrays [...]; its limits are NaN for a single run, and for runs that are all equal:
        they do not say how much others would differ.

    Raises:
        ValueError: there are no runs, some are not finite, or level is out of range.
    """
    point, variance, freedom = _moments(x)
    return _interval(point, variance, freedom or np.nan, level, STUDENT if freedom else NONE)


def stratified_interval(scores: Mapping[str, Any], level: float = 0.95) -> Interval:
    """The mean over games of their means, and its t interval from the variances of runs within each game.

    Runs are independent; each game weighs the same, whatever its spread and number of runs. Degrees of
    freedom are those of Welch and Satterthwaite: many of many games, even with two runs each, of which a
    bootstrap is too narrow.

    Args:
        scores: game -> float64 [..., runs].
        level: of each interval.

    Returns:
        An Interval of arrays [...]; its limits are NaN where a game has a single run, or no run differs from
        another.

    Raises:
        ValueError: see `mean_interval`.
    """
    if len(scores) == 1:
        return mean_interval(next(iter(scores.values())), level)
    return contrast(list(scores.values()), np.full(len(scores), 1 / len(scores)), level)


def contrast(groups: Sequence[Any], weights: Any, level: float = 0.95) -> Interval:
    """A weighted sum of means of groups of runs, and its t interval; `mean_difference` is that of 1 and -1.

    So a difference of two differences has weights 1, -1, -1 and 1. Runs are independent; numbers of runs and
    spreads may differ. Degrees of freedom are those of Satterthwaite (Biometrics Bulletin 2, 1946).

    Args:
        groups: float64 [..., runs] each.
        weights: float64 [groups].
        level: of each interval.

    Returns:
        An Interval of arrays [...]; its limits are NaN where a group has a single run, or no run differs from
        another.

    Raises:
        ValueError: see `mean_interval`.
    """
    point, variance, freedom, kind = _contrast(groups, weights)
    return _interval(point, variance, freedom, level, kind)


def contrast_p(groups: Sequence[Any], weights: Any) -> np.ndarray:
    """The two-sided p value of the test that a weighted sum of means is 0, float64 [...].

    Takes what `contrast` takes, whose interval leaves out 0 where this is below 1 - level; NaN where that has
    no interval.
    """
    return _p(*_contrast(groups, weights)[:3])


def mean_difference(x: Any, y: Any, level: float = 0.95) -> Interval:
    """The mean of x less that of y and Welch's t interval (Welch, Biometrika 34, 1947).

    Numbers of runs and spreads may differ. The interval leaves out 0 where `welch_p` is below 1 - level.

    Args:
        x: float64 [..., runs] of one arm.
        y: float64 [..., runs] of the other one.
        level: of each interval.

    Returns:
        An Interval of arrays [...]; its limits are NaN where an arm has a single run, and where neither has
        runs that differ.

    Raises:
        ValueError: see `mean_interval`.
    """
    point, variance, freedom, kind = _welch(x, y)
    return _interval(point, variance, freedom, level, kind)


def welch_p(x: Any, y: Any) -> np.ndarray:
    """The two-sided p value of Welch's test that the means of x and y are equal, float64 [...].

    Takes what `mean_difference` takes; NaN where that has no interval.
    """
    return _p(*_welch(x, y)[:3])


def holm(p: Any) -> np.ndarray:
    """The p values of several tests, corrected for their number (Holm, Scand. J. Statistics 6, 1979).

    Where those below the level are taken as differences, the chance that any of them is none is at most the
    level. NaN counts as a test and stays.

    Args:
        p: float64 [tests].

    Returns:
        float64 [tests], at most 1, in the order of p.
    """
    p = np.asarray(p, np.float64)
    order = np.argsort(p)
    found = np.empty_like(p)
    found[order] = np.minimum(np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1)), 1)
    return found


def t_probability(t: Any, freedom: Any) -> np.ndarray:
    """How likely a t variable is between -t and t, float64 [...], within 1e-7.

    Args:
        t: not negative.
        freedom: degrees of freedom, from 1 to 1,000, not necessarily whole.
    """
    t, freedom = np.asarray(t, np.float64), np.asarray(freedom, np.float64)
    return np.minimum(2 * _factor(freedom) * _integral(np.arctan(t / np.sqrt(freedom)), freedom), 1.0)


def t_quantile(level: float, freedom: Any) -> np.ndarray:
    """The t below which `t_probability` is the level, float64 [...].

    Args:
        level: between 0 and 1.
        freedom: degrees of freedom, at least 1, not necessarily whole; NaN gives NaN.

    Raises:
        ValueError: level is out of range.
    """
    check_level(level)
    freedom = np.asarray(freedom, np.float64)
    goal = level / (2 * _factor(freedom))
    angle = np.zeros_like(freedom)
    for _ in range(100):  # Newton's steps from 0 never go too far: the integrand falls
        step = (goal - _integral(angle, freedom)) / np.cos(angle) ** (freedom - 1)
        angle = angle + step
        if not (np.abs(step) > 1e-13 * angle).any():
            break
    return np.sqrt(freedom) * np.tan(angle)


def _integral(angle: np.ndarray, freedom: np.ndarray) -> np.ndarray:
    """Of cos^(freedom - 1) from 0 to an angle. With t = sqrt(freedom) tan(angle), t's density is that."""
    half = np.asarray(angle / 2)[..., None]
    return (half * _WEIGHTS * np.cos(half * (1 + _NODES)) ** (freedom[..., None] - 1)).sum(-1)


def _factor(freedom: np.ndarray) -> np.ndarray:
    return np.exp(_lgamma((freedom + 1) / 2) - _lgamma(freedom / 2)) / math.sqrt(math.pi)


def _moments(x: Any) -> tuple[np.ndarray, np.ndarray, int]:
    """The mean, its variance (NaN for one run), degrees of freedom; the order of runs changes no bit."""
    x = np.sort(np.asarray(x, np.float64), axis=-1) if np.ndim(x) else np.zeros(0)
    if not x.shape[-1]:
        raise ValueError("no runs: a mean is of scores [..., runs]")
    if not np.isfinite(x).all():
        raise ValueError("the scores are not all finite")
    freedom = x.shape[-1] - 1
    if not freedom:
        return x.mean(-1), np.full(x.shape[:-1], np.nan), 0
    # From the first: runs that are all equal have a variance of 0, and not of a rounding.
    return x.mean(-1), (x - x[..., :1]).var(-1, ddof=1) / x.shape[-1], freedom


def _welch(x: Any, y: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray, str]:
    """The difference of means, its variance, the degrees of freedom (Welch and Satterthwaite), the kind."""
    (mine, v, m), (theirs, w, n) = _moments(x), _moments(y)
    share = v / _spread(v + w)
    freedom = 1 / (share**2 / max(m, 1) + (1 - share) ** 2 / max(n, 1))
    return mine - theirs, v + w, freedom, WELCH if m and n else NONE


def _contrast(groups: Sequence[Any], weights: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray, str]:
    """The weighted sum of means, its variance, the degrees of freedom (Satterthwaite), the kind."""
    means, variances, freedoms = zip(*map(_moments, groups), strict=True)
    parts = [weight**2 * variance for weight, variance in zip(weights, variances, strict=True)]
    total = _spread(np.sum(parts, axis=0))
    lost = [part**2 / max(freedom, 1) for part, freedom in zip(parts, freedoms, strict=True)]
    point = np.sum([weight * x for weight, x in zip(weights, means, strict=True)], axis=0)
    return point, total, total**2 / np.sum(lost, axis=0), STRATIFIED if min(freedoms) else NONE


def _p(point, variance, freedom) -> np.ndarray:
    return 1 - t_probability(np.abs(point) / np.sqrt(_spread(variance)), freedom)


def _spread(variance: np.ndarray) -> np.ndarray:
    return np.where(variance > 0, variance, np.nan)


def _interval(point, variance, freedom, level: float, kind: str) -> Interval:
    margin = t_quantile(level, freedom) * np.sqrt(_spread(variance))
    return Interval(point, point - margin, point + margin, kind)
