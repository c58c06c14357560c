"""Learning curves: compared at equal env steps, and what they amount to.

A curve is env steps int64 [N], strictly ascending, with returns float64 [N]: straight lines between
evaluations, and nothing before the first or after the last.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np


def at_equal_steps(curves: Sequence[tuple[Any, Any]]) -> tuple[np.ndarray, np.ndarray]:
    """Learning curves on steps that all of them have: none is extrapolated.

    Args:
        curves: (env steps [N], ascending; returns [N]) of each run, N may differ.

    Returns:
        env steps, int64 [points], from the latest beginning to the earliest end: where evaluations differ,
        those of the curve that has the fewest, at least one; returns, float64 [runs, points], linearly
        interpolated in between.

    Raises:
        ValueError: no curves, one that is not ascending or not finite, or no step that all have.
    """
    if not curves:
        raise ValueError("no curves")
    checked = [_curve(steps, returns) for steps, returns in curves]
    start, end = max(s[0] for s, _ in checked), min(s[-1] for s, _ in checked)
    within = [steps[(steps >= start) & (steps <= end)] for steps, _ in checked]
    grid = min(filter(len, within), key=len, default=None)
    if grid is None:
        raise ValueError(f"no evaluation at a step that all {len(checked)} curves have")
    return grid, np.stack([np.interp(grid, steps, returns) for steps, returns in checked])


def area_under_curve(steps: Any, returns: Any, until: float | None = None) -> np.ndarray:
    """The return averaged over the env steps of a piecewise linear learning curve.

    Args:
        steps: env steps [N], ascending.
        returns: [..., N].
        until: env step at which to end; by default the last one.

    Returns:
        float64 [...]; a curve of a single point is as high as that point.

    Raises:
        ValueError: `until` is not on the curve, or `at_equal_steps` would raise it.
    """
    steps, returns = _curve(steps, returns)
    until = steps[-1] if until is None else until
    if not steps[0] <= until <= steps[-1]:
        raise ValueError(f"until={until}: the curve is from {steps[0]} to {steps[-1]} env steps")
    if until == steps[0]:
        return returns[..., 0]
    last = np.searchsorted(steps, until)  # the first step at or after it
    share = (until - steps[last - 1]) / (steps[last] - steps[last - 1])
    end = returns[..., last - 1] + share * (returns[..., last] - returns[..., last - 1])
    x = np.append(steps[:last], until).astype(np.float64)
    y = np.concatenate([returns[..., :last], end[..., None]], axis=-1)
    return np.trapezoid(y, x, axis=-1) / (until - steps[0])


def steps_to(steps: Any, returns: Any, score: float) -> np.ndarray:
    """The first env step at which a piecewise linear learning curve reaches a score.

    Args:
        steps: env steps [N], ascending.
        returns: [..., N].
        score: to be reached.

    Returns:
        float64 [...]; NaN: never, as far as the curve goes.
    """
    steps, returns = _curve(steps, returns)
    above = returns >= score
    first = above.argmax(-1)[..., None]
    before = np.maximum(first - 1, 0)
    low, high = np.take_along_axis(returns, before, -1), np.take_along_axis(returns, first, -1)
    rise = np.where(high > low, high - low, 1.0)
    share = np.where(first > 0, (score - low) / rise, 0.0)
    at = steps[before] + share * (steps[first] - steps[before])
    return np.where(above.any(-1), at[..., 0], np.nan)


def _curve(steps: Any, returns: Any) -> tuple[np.ndarray, np.ndarray]:
    """int64 [N] and float64 [..., N], checked."""
    given, returns = np.asarray(steps), np.asarray(returns, np.float64)
    steps = given.astype(np.int64)
    if steps.ndim != 1 or not steps.size or returns.shape[-1:] != steps.shape:
        raise ValueError(f"a curve is steps [N] and returns [..., N], got {steps.shape} and {returns.shape}")
    if (steps != given).any() or (np.diff(steps) <= 0).any():
        raise ValueError("the env steps of a curve must be whole and ascending")
    if not np.isfinite(returns).all():
        raise ValueError("the returns of a curve must be finite")
    return steps, returns
