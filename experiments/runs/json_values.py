"""Numbers as JSON has them, which knows no NaN."""

from typing import Any

import numpy as np

from srl_jax.statistics import Interval


def limits(interval: Interval) -> dict[str, Any]:
    """An interval: its point is "mean", what has no limits has None there."""
    point, low, high = (plain(values) for values in interval[:3])
    return {"mean": point, "low": low, "high": high, "kind": interval.kind}


def plain(values: Any) -> Any:
    """Floats or nested lists of floats; None for what is not a number."""
    array = np.asarray(values, float)
    if array.ndim:
        return [plain(element) for element in array]
    return float(array) if np.isfinite(array) else None
