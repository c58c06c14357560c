"""How many runs a difference takes to be found: the power of Welch's t test.

Of two normal arms with n runs each, the test looks at t, their means' difference over its standard error, and
rejects where |t| is beyond a quantile that depends on the two sample variances (Welch and Satterthwaite).
Given the variances the difference is normal, so power is an integral over them, which is taken numerically:
their ratio gives the quantile, and is independent of their sum (a beta and a chi-square variable). With equal
spreads this is the noncentral t test's power (Cohen 1988) less what not knowing that costs.
"""

import functools
import math
from collections.abc import Sequence

import numpy as np

from srl_jax.statistics.intervals import check_level
from srl_jax.statistics.student import t_quantile

MOST = 100_000
"""Runs of an arm that `runs_needed` goes up to."""
_erf = np.vectorize(math.erf, otypes=[np.float64])


def welch_power(effect: float, spreads: Sequence[float], runs: Sequence[int], level: float = 0.95) -> float:
    """How likely Welch's two-sided test finds a difference, to about 1e-6.

    Args:
        effect: the true difference of the two means; 0 gives how often the test is wrong.
        spreads: standard deviation over runs of each of the two arms, positive.
        runs: of each of the two arms, at least 2.
        level: of the interval that has to leave out 0.

    Raises:
        ValueError: an argument is out of range.
    """
    error, bounds, weights = _integral(spreads, runs, level)
    return _power(effect / error, bounds, weights)


def smallest_effect(
    spreads: Sequence[float], runs: Sequence[int], power: float = 0.8, level: float = 0.95
) -> float:
    """The difference that Welch's test finds with a probability, to four digits.

    Args:
        spreads: see `welch_power`.
        runs: likewise.
        power: the probability.
        level: see `welch_power`.

    Raises:
        ValueError: an argument is out of range, or power is not between 1 - level and 1.
    """
    _check_power(power, level)
    error, bounds, weights = _integral(spreads, runs, level)
    low, high = 0.0, 1.0
    while _power(high, bounds, weights) < power:
        low, high = high, 2 * high
    while high - low > 1e-5 * high:
        middle = (low + high) / 2
        low, high = (middle, high) if _power(middle, bounds, weights) < power else (low, middle)
    return high * error


def runs_needed(
    effect: float, spreads: Sequence[float], power: float = 0.8, level: float = 0.95
) -> int | None:
    """The runs of each arm with which Welch's test finds a difference with a probability.

    Args:
        effect: the true difference, not 0.
        spreads: see `welch_power`.
        power: the probability.
        level: see `welch_power`.

    Returns:
        At least 2; None where `MOST` are too few.

    Raises:
        ValueError: see `smallest_effect`; or the effect is 0.
    """
    _check_power(power, level)
    if not effect:
        raise ValueError("effect=0: no number of runs finds it")

    def enough(n: int) -> bool:
        return welch_power(effect, spreads, (n, n), level) >= power

    low, high = 1, 2
    while not enough(high):
        if high >= MOST:
            return None
        low, high = high, min(2 * high, MOST)
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if enough(middle) else (middle, high)
    return high


def _power(shift: float, bounds: np.ndarray, weights: np.ndarray) -> float:
    """Of |normal + shift| beyond bounds, averaged; weights sum to 1."""
    inside = _erf((bounds - shift) / math.sqrt(2)) + _erf((bounds + shift) / math.sqrt(2))
    return float(1 - (weights * inside).sum() / 2)


def _integral(
    spreads: Sequence[float], runs: Sequence[int], level: float
) -> tuple[float, np.ndarray, np.ndarray]:
    """The difference's true standard error; the test's bounds in units of it, and how likely each is."""
    check_level(level)
    if len(spreads) != 2 or not all(0 < spread < math.inf for spread in spreads):
        raise ValueError(f"spreads={tuple(spreads)}: must be two positive standard deviations")
    if len(runs) != 2 or not all(n >= 2 for n in runs):
        raise ValueError(f"runs={tuple(runs)}: must be two numbers of runs, at least 2 each")
    m, n = (int(count) - 1 for count in runs)
    largest = max(spreads)  # the unit, so that no square is out of range
    mine, theirs = ((spread / largest) ** 2 / count for spread, count in zip(spreads, runs, strict=True))
    # The variances over their expectations are r^2 sin^2 / m and r^2 cos^2 / n of an angle and a radius.
    width = 8 / math.sqrt(m + n)
    angle, of_angle = _nodes(64, math.atan(math.sqrt(m / n)), width, math.pi / 2)
    radius, of_radius = _nodes(144, math.sqrt(m + n - 1), 5.0, math.inf)
    with np.errstate(divide="ignore"):
        likely = (m - 1) * np.log(np.sin(angle)) + (n - 1) * np.log(np.cos(angle))
        of_angle = of_angle * np.exp(likely - likely.max())
        likely = (m + n - 1) * np.log(radius) - radius**2 / 2
    of_radius = of_radius * np.exp(likely - likely.max())
    v, w = mine * np.sin(angle) ** 2 / m, theirs * np.cos(angle) ** 2 / n
    share = v / (v + w)
    freedom = 1 / (share**2 / m + (1 - share) ** 2 / n)
    bounds = (t_quantile(level, freedom) * np.sqrt((v + w) / (mine + theirs)))[:, None] * radius
    weights = of_angle[:, None] * of_radius
    return largest * math.sqrt(mine + theirs), bounds, weights / weights.sum()


def _nodes(count: int, middle: float, width: float, most: float) -> tuple[np.ndarray, np.ndarray]:
    """Gauss and Legendre's nodes and weights around a middle, between 0 and most."""
    at, weights = _legendre(count)
    low, high = max(middle - width, 0.0), min(middle + width, most)
    return low + (high - low) * (at + 1) / 2, weights * (high - low) / 2


@functools.cache
def _legendre(count: int) -> tuple[np.ndarray, np.ndarray]:
    return np.polynomial.legendre.leggauss(count)


def _check_power(power: float, level: float) -> None:
    check_level(level)
    if not 1 - level < power < 1:
        raise ValueError(f"power={power}: must be between {1 - level:g} and 1")
