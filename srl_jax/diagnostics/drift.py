"""The diagnostics of a run out of its rows of metrics.jsonl. numpy only."""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

DECODER_NOW, ENCODER_NOW, STEPS = "diag/decoder_now/", "diag/encoder_now/", "diag/drift/steps"


def drift_names(rows: Iterable[Mapping[str, Any]]) -> list[str]:
    """The objectives whose decoders were measured on earlier encoders' latents."""
    return sorted(
        {key.removeprefix(DECODER_NOW) for row in rows for key in row if key.startswith(DECODER_NOW)}
    )


def drift_matrix(rows: Iterable[Mapping[str, Any]], name: str) -> tuple[np.ndarray, np.ndarray]:
    """The error of each epoch's decoder on each epoch's encoder (thesis, section 6.4).

    Args:
        rows: of metrics.jsonl.
        name: an objective's with a decoder, see `drift_names`.

    Returns:
        steps: int64 [E], env steps of the epochs: of those that were kept, and of the last row.
        matrix: float64 [E, E], mean squared error of decoder i on latents of encoder j; NaN where unknown.

    Raises:
        ValueError: lists of a row are not as long as its `diag/drift/steps`.
    """
    rows = [row for row in rows if DECODER_NOW + name in row and STEPS in row]
    known: dict[tuple[int, int], float] = {}
    kept: set[int] = set()
    for row in rows:
        now, steps = row["env_steps"], row[STEPS]
        decoder_now, encoder_now = row[DECODER_NOW + name], row.get(ENCODER_NOW + name, [])
        if not isinstance(decoder_now, list) or not isinstance(encoder_now, list):
            raise ValueError(f"drift of {name} after {now} env steps is no list")
        if (len(decoder_now), len(encoder_now)) != (len(steps) + 1, len(steps)):
            raise ValueError(
                f"drift of {name} after {now} env steps is not over its {len(steps)} kept epochs"
            )
        kept |= set(steps)
        known |= {(now, then): error for then, error in zip([*steps, now], decoder_now, strict=True)}
        known |= {(then, now): error for then, error in zip(steps, encoder_now, strict=True)}
    epochs = sorted(kept | {row["env_steps"] for row in rows[-1:]})
    matrix = [[known.get((i, j)) for j in epochs] for i in epochs]
    return np.array(epochs, np.int64), np.array(matrix, np.float64).reshape(len(epochs), len(epochs))
