"""The diagnostics of eval rows, `diag/...`, as small pictures: one number each, a line an arm."""

import fnmatch
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from experiments import collect
from experiments.collect import RunData
from experiments.reporting import pictures
from experiments.reporting.numbers import numbers_of
from experiments.reporting.pictures import Picture

LISTS_OVER = "diag/drift/steps"
"""The env steps of the kept encoders: what lists are over, and nothing to draw."""


class Form(NamedTuple):
    """How a key is drawn.

    Attributes:
        key: a pattern; what `*` stands for replaces the {} of the title.
        title: of the picture.
        place: which element of a list is drawn; 0: of the oldest encoder kept, -1: of the newest.
        meaning: what a reader has to know.
    """

    key: str
    title: str
    place: int = 0
    meaning: str = ""


FORMS = (
    Form("diag/effective_rank", "effective rank", meaning="how many directions the latent uses"),
    Form("diag/dormant_share", "dormant units", meaning="share of the latent's units that hardly ever act"),
    Form("diag/constant_share", "constant units", meaning="share of units that are the same for all inputs"),
    Form("diag/drift/cosine", "cosine to the oldest latents", 0, "the same inputs, encoded then and now"),
    Form("diag/drift/cosine", "cosine to the last latents", -1, "likewise, the newest encoder kept"),
    Form("diag/drift/cka", "CKA with the oldest latents", 0, "likewise, by centred kernel alignment"),
    Form("diag/drift/cka", "CKA with the last latents", -1),
    Form(
        "diag/decoder_now/*", "{}: decoder now, oldest encoder", 0,
        "mean squared error of today's decoder on an old encoder's latents",
    ),
    Form("diag/decoder_now/*", "{}: decoder now, encoder now", -1),
    Form("diag/encoder_now/*", "{}: oldest decoder, encoder now", 0, "and the other way round"),
    Form(
        "diag/gradient/*/cosine", "{}: cosine with RL's gradient",
        meaning="below 0: the losses pull the encoder apart",
    ),
    Form("diag/gradient/*/norm_ratio", "{}: gradient norm over RL's"),
    Form("diag/error/*/moving", "{}: error on moving pixels", meaning="does it lose the ball?"),
    Form("diag/error/*/static", "{}: error on static pixels"),
    Form("diag/error/*/moving_explained", "{}: explained, moving pixels", meaning="0: as the mean image"),
    Form("diag/moving_share", "share of pixels that move"),
    Form("diag/probe/mean", "linear probe, mean R²", meaning="the true state from the latent, linearly"),
    Form("diag/probe/*", "linear probe, {}: R²"),
)  # fmt: skip
"""In the order of the page; keys without a form come last, under their own names."""


class Panel(NamedTuple):
    """One picture."""

    title: str
    meaning: str
    picture: Picture


def keys_of(runs: Sequence[RunData]) -> list[str]:
    """All keys of diagnostics in the runs, sorted."""
    keys = {key for run in runs for row in run.rows if row["kind"] == "eval" for key in row}
    return sorted(key for key in keys if key.startswith("diag/") and key != LISTS_OVER)


def panels(runs: Sequence[RunData], arms: Sequence[str]) -> list[Panel]:
    """The pictures of one game's runs; keys that say nothing anywhere are left out.

    Raises:
        ConfigError: a value is no number.
    """
    keys = keys_of(runs)
    known = {key for form in FORMS for key in _matching(form, keys)}
    found = []
    for form in [*FORMS, *(Form(key, key.removeprefix("diag/")) for key in keys if key not in known)]:
        for key in _matching(form, keys):
            lines = {}
            for place, arm in enumerate(arms):
                members = [_curve(run, key, form.place) for run in runs if run.arm == arm]
                if (curve := pictures.interval_curves(members)) is not None:
                    lines[place] = curve
            if lines:
                title = form.title.format(_middle(key, form.key))
                found.append(Panel(title, form.meaning, pictures.curves(title, lines)))
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
