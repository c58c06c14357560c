"""Parameter groups and the optimizer: decoder weight decay, clipping, Adam, a learning rate per group."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax

from srl_jax.types import Array, Objective, Params

RL = "rl"
"""The name of the RL objective among the objectives, and of its head."""


class Optimizer(NamedTuple):
    """Adam over groups of parameters: the encoder and each head, those of them that move.

    Attributes:
        init: trainable params -> state, {"encoder": Adam's, "heads": {name: Adam's}} with the groups that
            the params have.
        update: (grads, state, params, learning_rates, measure) -> (params, state, norms). Grads and params
            may leave out groups that the state has: those keep their moments and their count of steps.
            `learning_rates` is {"encoder": [], "rl": [], "representation": []}, traced scalars. Norms are
            {"encoder": of its gradient, NaN where `measure`, a traced bool, is false; "all": of the whole
            gradient before clipping, where there is clipping}: each is a pass over the gradient.
    """

    init: object
    update: object


def make_optimizer(
    objectives: dict[str, Objective],
    *,
    decoder_weight_decay: float = 0.0,
    max_grad_norm: float = 0.0,
    adam_eps: float = 1e-8,
) -> Optimizer:
    """The optimizer of the one summed loss.

    Decoder weight decay is added to the gradient before Adam scales it, as PyTorch's Adam does and hence
    SAC-AE (Yarats et al. 2021) and the thesis; it is not part of any loss.

    Args:
        objectives: by name; those with `is_decoder` decay.
        decoder_weight_decay: the factor of a decoder's parameters in its gradient.
        max_grad_norm: the global norm that gradients are clipped to; 0 for no clipping.
        adam_eps: Adam's epsilon.
    """

    adam = optax.scale_by_adam(eps=adam_eps)

    def init(params: Params):
        return _nested({path: adam.init(tree) for path, tree in _groups(params).items()})

    def update(grads, state, params, learning_rates: dict[str, Array], measure: Array | bool = True):
        norms = {}
        if "encoder" in grads:
            unknown = lambda _: jnp.float32(jnp.nan)  # noqa: E731
            norms["encoder"] = jax.lax.cond(measure, optax.tree.norm, unknown, grads["encoder"])
        if max_grad_norm:
            norms["all"] = optax.tree.norm(grads)
            factor = jnp.minimum(1.0, max_grad_norm / norms["all"])
            grads = jax.tree.map(lambda g: g * factor, grads)
        grads, states, trees = _groups(grads), _groups(state), _groups(params)
        for path, tree in trees.items():
            rate = learning_rates[_rate_of(path)]
            if decoder_weight_decay and path[0] == "heads" and objectives[path[1]].is_decoder:
                grads[path] = jax.tree.map(lambda g, p: g + decoder_weight_decay * p, grads[path], tree)
            steps, states[path] = adam.update(grads[path], states[path])
            trees[path] = jax.tree.map(lambda p, u: p - rate * u, tree, steps)  # noqa: B023
        return _nested(trees), _nested(states), norms

    return Optimizer(init, update)


def real_copy(params: Params) -> Params:
    """New buffers of the same values: two trees that share a buffer cannot both be donated."""
    return jax.tree.map(lambda x: jnp.array(x, copy=True), params)


def _groups(params: Params) -> dict[tuple[str, ...], Params]:
    """{("encoder",): tree, ("heads", NAME): tree} of what {"encoder": tree, "heads": {NAME: tree}} has."""
    groups = {("heads", name): tree for name, tree in params.get("heads", {}).items()}
    return {("encoder",): params["encoder"], **groups} if "encoder" in params else groups


def _nested(groups: dict[tuple[str, ...], Params]) -> Params:
    """The inverse of `_groups`."""
    heads = {path[1]: tree for path, tree in groups.items() if path[0] == "heads"}
    encoder = {"encoder": groups[("encoder",)]} if ("encoder",) in groups else {}
    return {**encoder, "heads": heads}


def _rate_of(path: tuple[str, ...]) -> str:
    """The name of a group's learning rate."""
    if path[0] == "encoder":
        return "encoder"
    return RL if path[1] == RL else "representation"
