"""The diagnostics of eval rows, `diag/...`, as small pictures: one number each, a line an arm."""

import fnmatch
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from .. import collect, plots
from ..collect import RunData
from ..colours import Style
from . import pictures
from .numbers import numbers_of
from .pictures import Picture

LISTS_OVER = "diag/drift/steps"
"""The env steps of the kept encoders: what lists are over, and nothing to draw."""


class Form(NamedTuple):
    """How a key is drawn.

    Attributes:
        key: a pattern; what `*` stands for replaces the {} of the title.
        title: of the picture.
        place: which element of a list is drawn; 0: of the oldest encoder kept, -1: of the newest.
        meaning: what a reader has to know.
        first: whether it is shown at once; the others are shown when they are asked for.
    """

    key: str
    title: str
    place: int = 0
    meaning: str = ""
    first: bool = False


FORMS = (
    Form("diag/effective_rank", "effective rank", 0, "how many directions the latent uses", True),
    Form("diag/dormant_share", "dormant units", 0, "share of the latent's units that hardly ever act", True),
    Form("diag/constant_share", "constant units", 0, "share of units that are the same for all inputs"),
    Form(
        "diag/drift/cosine", "cosine to the oldest latents", 0,
        "drift: the same inputs, encoded now and by the oldest encoder kept", True,
    ),
    Form("diag/drift/cosine", "cosine to the last latents", -1, "and by the encoder kept last"),
    Form(
        "diag/drift/cka", "CKA with the oldest latents", 0,
        "likewise, by centred kernel alignment, which no rotation changes", True,
    ),
    Form("diag/drift/cka", "CKA with the last latents", -1),
    Form(
        "diag/decoder_now/*", "{}: old encoder, decoder of now", 0,
        "mean squared error of the decoder of now on latents of the oldest encoder kept", True,
    ),
    Form("diag/decoder_now/*", "{}: encoder and decoder of now", -1, "mean squared error"),
    Form("diag/encoder_now/*", "{}: encoder of now, old decoder", 0, "mean squared error"),
    Form(
        "diag/gradient/*/cosine", "{}: cosine with RL's gradient", 0,
        "of the gradients on the encoder; below 0, they pull it apart", True,
    ),
    Form("diag/gradient/*/norm_ratio", "{}: gradient norm over RL's"),
    Form("diag/error/*/moving", "{}: error on moving pixels"),
    Form("diag/error/*/static", "{}: error on static pixels"),
    Form(
        "diag/error/*/moving_explained", "{}: explained of what moves", 0,
        "does it lose the ball? 1: none of it; 0: it is no better than the mean image", True,
    ),
    Form("diag/moving_share", "share of pixels that move"),
    Form(
        "diag/probe/mean", "linear probe, mean R²", 0,
        "how much of the game's true state can be read from the latent linearly", True,
    ),
    Form("diag/probe/*", "linear probe, {}: R²"),
)  # fmt: skip
"""In the order of the page; keys without a form come last, under their own names."""


class Panel(NamedTuple):
    """One picture."""

    title: str
    meaning: str
    picture: Picture
    first: bool


def keys_of(runs: Sequence[RunData]) -> list[str]:
    """All keys of diagnostics in the runs, sorted."""
    keys = {key for run in runs for row in run.rows if row["kind"] == "eval" for key in row}
    return sorted(key for key in keys if key.startswith("diag/") and key != LISTS_OVER)


def panels(runs: Sequence[RunData], looks: Mapping[str, Style]) -> list[Panel]:
    """The pictures of one game's runs; keys that say nothing anywhere are left out.

    Args:
        runs: those of other arms are left out.
        looks: arm -> its colour and line.

    Raises:
        ConfigError: a value is no number.
    """
    keys = keys_of(runs)
    known = {key for form in FORMS for key in _matching(form, keys)}
    found = []
    for form in [*FORMS, *(Form(key, key.removeprefix("diag/")) for key in keys if key not in known)]:
        for key in _matching(form, keys):
            lines = []
            for arm, style in looks.items():
                members = [_curve(run, key, form.place) for run in runs if run.arm == arm]
                if (curve := pictures.interval_curves(members)) is not None:
                    lines.append((style, curve))
            if lines:
                title = form.title.format(_middle(key, form.key))
                picture = pictures.curves(title, lines, across=plots.steps_label(runs[0].game))
                found.append(Panel(title, form.meaning, picture, form.first))
    return found


def _matching(form: Form, keys: Sequence[str]) -> list[str]:
    """The keys of a form; one that has a form of its own is of no pattern."""
    exact = {form.key for form in FORMS}
    return [
        key for key in keys if key == form.key or (key not in exact and fnmatch.fnmatchcase(key, form.key))
    ]


def missing(runs: Sequence[RunData]) -> list[RunData]:
    """Runs with evaluations and no diagnostics in them: made before there were any."""
    return [run for run in runs if len(collect.steps_and_returns(run)[0]) and not keys_of([run])]


def _middle(key: str, pattern: str) -> str:
    before, _, after = pattern.partition("*")
    return key.removeprefix(before).removesuffix(after)


def _curve(run: RunData, key: str, place: int) -> tuple[np.ndarray, np.ndarray]:
    steps, values = [], []
    for row in run.rows:
        if row["kind"] == "eval" and row.get(key) not in (None, []):
            value = numbers_of(run, row, key)[place]
            if value is not None:
                steps.append(row["env_steps"])
                values.append(value)
    return np.array(steps, np.int64), np.array(values, np.float64)
