"""Parameter groups and the optimizer: decoder weight decay, clipping, Adam, a learning rate per group."""

from collections.abc import Callable, Collection
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax

from srl_jax.types import Array, Objective, Params

RL = "rl"
"""The name of the RL objective among the objectives, and of its group of parameters."""
ENCODER = "encoder"
"""The name of the encoder's group, and of the state of the Adam that steps it."""
SECOND = "_srl"
"""Ends the name of the state of a group's second Adam, the representation's own."""
ENCODER_SRL = ENCODER + SECOND
"""The name of the state of the encoder's second Adam."""
RL_SRL = RL + SECOND
"""The name of the state of the second Adam of RL's head, which it has where an objective reads it."""
BETA_1, BETA_2 = 0.9, 0.999
"""Adam's decays of the means of gradients and of their squares."""
NOT_MEASURED = -1.0
"""In place of a norm in the updates that do not measure it."""


class Optimizer(NamedTuple):
    """Adam over groups of parameters, {"encoder": tree, OBJECTIVE: its head's tree}.

    Attributes:
        init: {group: tree} -> {group: Adam's state}.
        update: (grads, state, params, learning_rates, measure, others) -> (params, state, norms). All are by
            group; learning rates are traced scalars. `others` are groups that do not decay: RL's head in the
            second pass. Norms are {"encoder": of its gradient, `NOT_MEASURED` where `measure`, a traced bool,
            is false; "all": of the whole gradient before clipping, where there is clipping}: each is a pass
            over the gradient.
        length: (a group's state) -> float32 scalar, the length of the step that left it, at a learning rate
            of 1; of a state that no step has left, of the first one, which is 1 for each number.
    """

    init: Callable
    update: Callable
    length: Callable


def make_optimizer(
    objectives: dict[str, Objective],
    *,
    decoder_weight_decay: float = 0.0,
    weight_decay: float = 0.0,
    max_grad_norm: float = 0.0,
    adam_eps: float = 1e-8,
) -> Optimizer:
    """The optimizer of a weighted sum of losses.

    Decoder weight decay is added to the gradient before Adam scales it, as PyTorch's Adam does and hence
    SAC-AE (Yarats et al. 2021) and the thesis; it is not part of any loss. `weight_decay` is AdamW's
    (Loshchilov and Hutter 2019, algorithm 2), which Adam does not scale: each step takes
    `learning rate * weight_decay` of a parameter away. Biases and scales, which have one axis, do not decay.

    Args:
        objectives: by name; those with `is_decoder` decay.
        decoder_weight_decay: the factor of a decoder's parameters in its gradient.
        weight_decay: the share per learning rate, of every group that moves, but for `others` of an update:
            groups of another pass, of which this one moves a part.
        max_grad_norm: the global norm that gradients are clipped to; 0 for no clipping.
        adam_eps: Adam's epsilon.
    """
    adam = optax.scale_by_adam(BETA_1, BETA_2, adam_eps)
    decays = {name for name, objective in objectives.items() if objective.is_decoder and decoder_weight_decay}

    def update(
        grads,
        state,
        params,
        learning_rates: dict[str, Array],
        measure: Array | bool = True,
        others: Collection[str] = (),
    ):
        norms = {}
        if ENCODER in grads:
            norms[ENCODER] = measured(measure, optax.tree.norm, grads[ENCODER])
        if max_grad_norm:
            norms["all"] = optax.tree.norm(grads)
            factor = jnp.minimum(1.0, max_grad_norm / norms["all"])
            grads = jax.tree.map(lambda g: g * factor, grads)
        moved, new_state = {}, {}
        for group, tree in params.items():
            gradient = grads[group]
            if group in decays:
                gradient = jax.tree.map(lambda g, p: g + decoder_weight_decay * p, gradient, tree)
            steps, new_state[group] = adam.update(gradient, state[group])
            if weight_decay and group not in others:
                steps = jax.tree.map(lambda u, p: u + weight_decay * p if p.ndim > 1 else u, steps, tree)
            rate = learning_rates[group]
            moved[group] = jax.tree.map(lambda p, u: p - rate * u, tree, steps)  # noqa: B023
        return moved, new_state, norms

    def init(params):
        return {group: adam.init(tree) for group, tree in params.items()}

    def length(state) -> Array:
        count = jnp.maximum(state.count, 1)
        mean = optax.tree.bias_correction(state.mu, BETA_1, count)
        square = optax.tree.bias_correction(state.nu, BETA_2, count)
        steps = jax.tree.map(lambda m, v: m / (jnp.sqrt(v) + adam_eps), mean, square)
        numbers = sum(x.size for x in jax.tree.leaves(state.mu))
        return jnp.where(state.count > 0, optax.tree.norm(steps), numbers**0.5)

    return Optimizer(init, update, length)


def pcgrad(rl: Params, srl: Params) -> tuple[Params, Params]:
    """Both gradients, where their product is negative each less its component along the other.

    Yu et al. (2020), Gradient Surgery for Multi-Task Learning, algorithm 1, with two tasks: RL, and the sum
    of the weighted objectives. Each is projected off the other as it was, so that no order is to be drawn.
    """
    product = jnp.minimum(optax.tree.vdot(rl, srl), 0.0)
    return _less(rl, product, srl), _less(srl, product, rl)


def orthogonal(rl: Params, srl: Params) -> tuple[Params, Params]:
    """RL's gradient as it is, and the objectives' less its component along RL's, whichever way it points."""
    return rl, _less(srl, optax.tree.vdot(rl, srl), rl)


def _less(gradient: Params, product: Array, other: Params) -> Params:
    """A gradient less `product / |other|^2` times another one."""
    share = product / jnp.maximum(optax.tree.vdot(other, other), 1e-30)
    return jax.tree.map(lambda g, o: g - share * o, gradient, other)


PROJECTIONS = {"pcgrad": pcgrad, "orthogonal": orthogonal}
"""{gate: (RL's gradient on the encoder, the objectives') -> both, as the encoder's Adams see them}."""


def measured(measure: Array | bool, function: Callable, *trees: Params) -> Array:
    """`function(*trees)`, a float32 scalar, where `measure` is true; else `NOT_MEASURED`."""
    return jax.lax.cond(measure, function, lambda *_: jnp.float32(NOT_MEASURED), *trees)


def real_copy(params: Params) -> Params:
    """New buffers of the same values: two trees that share a buffer cannot both be donated."""
    return jax.tree.map(lambda x: jnp.array(x, copy=True), params)
