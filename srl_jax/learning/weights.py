"""Weights of the losses: numbers, schedules over env steps, and ratios to RL's gradient on the encoder.

`weight=ratio:0.1` (`srl_jax.specs.Weight`) holds the norm of an objective's gradient on the encoder at a
tenth of the norm of RL's. Norms of single batches are noisy, so both are running means, of the norms in every
k-th update, k being `srl_jax.learning.update.NORM_EVERY`. They start at 0, and as much is always missing of
one as of the other: their ratio has no bias to be corrected.

Adam does not see the scale of a loss. Where the objectives' gradients have an Adam of their own on the
encoder, the ratios therefore rule its learning rate as well: the length of its step is held at the sum of the
ratios times the length of RL's step, both again by running means.
"""

from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import optax

from srl_jax.augment import UNCHANGED, Views
from srl_jax.latents import make_encoder_gradient
from srl_jax.learning.modes import Mode
from srl_jax.learning.optim import ENCODER, ENCODER_SRL, RL, Optimizer
from srl_jax.types import Array, Encoder, Objective, TrainState, Window

DECAY = 0.9
"""The share of a running mean that stays when a norm is added."""


def ratios(objectives: Mapping[str, Objective]) -> list[str]:
    """The names of the objectives whose weight is a ratio."""
    return [name for name, objective in objectives.items() if getattr(objective.weight, "ratio", False)]


def start(objectives: Mapping[str, Objective], two_adams: bool) -> dict[str, dict[str, jax.Array]] | None:
    """Running means before the first norm: {"gradient": {RL and each ratio: 0}, "step": {each Adam: 0}}.

    Args:
        objectives: by name.
        two_adams: whether the encoder has two; there is no "step" otherwise.

    Returns:
        float32 scalars; None where no weight is a ratio.
    """
    names = ratios(objectives)
    if not names:
        return None
    of = {"gradient": [RL, *names]} | ({"step": [ENCODER, ENCODER_SRL]} if two_adams else {})
    return {kind: {name: jnp.zeros((), jnp.float32) for name in names} for kind, names in of.items()}


def make_norms(
    encoder: Encoder,
    objectives: Mapping[str, Objective],
    mode: Mode,
    optimizer: Optimizer,
    *,
    views: Views = UNCHANGED,
) -> Callable | None:
    """norms: (TrainState, Window, Hyper) -> `TrainState.norms`, pure; None where no weight is a ratio.

    To be called before every k-th update, k being `srl_jax.learning.update.NORM_EVERY`, from the first on,
    with its window and its `Hyper`. It takes the gradient on the encoder of the mean loss of each ratio's
    objective, and of RL's, at the parameters from before the update, and, of two Adams, the lengths of the
    steps that they took last.
    """
    names = ratios(objectives)
    if not names:
        return None
    gradient = make_encoder_gradient(encoder, objectives, mode, views=views)

    def norms(state: TrainState, window: Window, hyper: Any):
        once = dict.fromkeys(names, 1.0) | {RL: hyper.weights[RL]}
        new = {"gradient": {n: optax.tree.norm(gradient(n, once[n], state, window)) for n in once}}
        if "step" in state.norms:
            new["step"] = {name: optimizer.length(state.opt_state[name]) for name in state.norms["step"]}
        return moved(state.norms, new)

    return norms


def moved(norms: Any, new: Any) -> Any:
    """The running means with one more of each norm."""
    return jax.tree.map(lambda old, x: DECAY * old + (1 - DECAY) * x, norms, new)


def factors(objectives: Mapping[str, Objective], numbers: Mapping[str, Any], norms: Any) -> dict[str, Any]:
    """{objective: factor of its mean loss}.

    Args:
        objectives: by name.
        numbers: of `Hyper.weights`: a ratio's is the ratio.
        norms: `TrainState.norms`. A ratio of a gradient that has never been measured, or was always 0, is a
            weight like any other.
    """
    of_ratios = ratios(objectives) if norms else []
    return {
        name: number * _over(norms["gradient"], RL, name) if name in of_ratios else number
        for name, number in numbers.items()
    }


def second_rate(numbers: Mapping[str, Any], norms: Any, rate: Any) -> Any:
    """The learning rate of the encoder's second Adam with which its step has the length that ratios ask for.

    Args:
        numbers: the ratios now, by name.
        norms: `TrainState.norms`, with "step": lengths of both Adams' steps at a learning rate of 1.
        rate: the learning rate of the first one.
    """
    return sum(numbers.values()) * _over(norms["step"], ENCODER, ENCODER_SRL) * rate


def _over(means: Mapping[str, Array], above: str, below: str) -> jax.Array:
    """One running mean over another one; 1 where the latter is 0."""
    return jnp.where(means[below] > 0, means[above] / jnp.maximum(means[below], 1e-30), 1.0)
