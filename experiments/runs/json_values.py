"""Numbers as JSON has them, which knows no NaN, and as a file has them that is written again elsewhere."""

import json
from typing import Any

import numpy as np

from srl_jax.statistics import Interval

DIGITS, PLACES = 8, 12
"""Of a number in a file, significant and behind the point at most. Processors differ in the sixteenth digit,
and of a difference in earlier ones: a file is the same whichever wrote it."""


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


def rounded(values: Any) -> Any:
    """Lists and dicts of numbers that were computed, floats with `DIGITS` and no more than `PLACES`."""
    if isinstance(values, float):
        return float(f"{round(values, PLACES):.{DIGITS}g}") + 0.0  # which has no -0.0
    if isinstance(values, dict):
        return {key: rounded(value) for key, value in values.items()}
    return [rounded(value) for value in values] if isinstance(values, list | tuple) else values


def json_text(values: Any, indent: int | None = 1) -> str:
    """The JSON of numbers that were computed, see `rounded`."""
    return json.dumps(rounded(values), indent=indent)
