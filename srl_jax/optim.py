"""Parameter groups and the optimizer: decoder weight decay, clipping, Adam, a learning rate per group."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax

from srl_jax.types import Array, Objective, Params

RL = "rl"
"""The name of the RL objective among the objectives, and of its head."""


class Optimizer(NamedTuple):
    """Adam over the groups that move.

    Attributes:
        init: trainable params -> state.
        update: (grads, state, params, learning_rates) -> (params, state, gradient norm before clipping).
            `learning_rates` is {"encoder": [], "rl": [], "representation": []}, traced scalars.
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

    def decays(params: Params) -> Params:
        return {
            group: (
                {name: _fill(head, objectives[name].is_decoder) for name, head in tree.items()}
                if group == "heads"
                else _fill(tree, False)
            )
            for group, tree in params.items()
        }

    chain = []
    if max_grad_norm:
        chain.append(optax.clip_by_global_norm(max_grad_norm))
    if decoder_weight_decay:
        chain.append(optax.add_decayed_weights(decoder_weight_decay, decays))
    transform = optax.chain(*chain, optax.scale_by_adam(eps=adam_eps))

    def update(grads, state, params, learning_rates: dict[str, Array]):
        norm = optax.tree.norm(grads)
        updates, state = transform.update(grads, state, params)
        rates = {}
        for group, tree in params.items():
            if group == "heads":
                kind = {n: RL if n == RL else "representation" for n in tree}
                rates[group] = {n: _fill(t, learning_rates[kind[n]]) for n, t in tree.items()}
            else:
                rates[group] = _fill(tree, learning_rates[group])
        params = jax.tree.map(lambda p, u, rate: p - rate * u, params, updates, rates)
        return params, state, norm

    return Optimizer(transform.init, update)


def real_copy(params: Params) -> Params:
    """New buffers of the same values: two trees that share a buffer cannot both be donated."""
    return jax.tree.map(lambda x: jnp.array(x, copy=True), params)


def _fill(tree: Params, value) -> Params:
    return jax.tree.map(lambda _: value, tree)
