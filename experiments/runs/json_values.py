"""Numbers as JSON has them, which knows no NaN, and as a file has them that is written again elsewhere."""

import json
from typing import Any

import numpy as np

from srl_jax.statistics import Interval

DIGITS = 8
"""Of a number in a file. Processors differ in the sixteenth, and a file is the same whichever wrote it."""


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
    """Lists and dicts of numbers that were computed, floats with `DIGITS` significant digits."""
    if isinstance(values, float):
        return float(f"{values:.{DIGITS}g}")
    if isinstance(values, dict):
        return {key: rounded(value) for key, value in values.items()}
    return [rounded(value) for value in values] if isinstance(values, list | tuple) else values


def json_text(values: Any, indent: int | None = 1) -> str:
    """The JSON of numbers that were computed, see `rounded`."""
    return json.dumps(rounded(values), indent=indent)
