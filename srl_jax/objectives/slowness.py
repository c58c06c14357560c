"""Slowness: latents of neighbouring moments stay close, and those of others apart."""

import jax
import jax.numpy as jnp

from srl_jax.objectives.networks import over_others
from srl_jax.types import Array, Context, Latents, Objective, Params, Window


def squared_step(z_tm1: Array, z_t: Array) -> jax.Array:
    """The squared distance of two latents: float32 [D], [D] -> float32 []; a sum over D."""
    return jnp.sum((z_t - z_tm1) ** 2)


def similarity(z: Array, other: Array) -> jax.Array:
    """`exp(-|z - other|)`: float32 [D], [D] -> float32 [], 1 where they are the same.

    Where they are the same its gradient is 0.
    """
    square = jnp.sum((z - other) ** 2)
    same = square == 0
    return jnp.where(same, 1.0, jnp.exp(-jnp.sqrt(jnp.where(same, 1.0, square))))


def slowness(context: Context, *, weight: float = 1.0, variability: float = 1.0) -> Objective:
    """Pulls z_{t+1} to z_t, and z_t away from all other rows' (Jonschkowski et al. 2017, section III).

    `|z_{t+1} - z_t|^2 + variability E exp(-|z_t - z'_t|)`, the mean over the other rows of the batch: their
    priors of slowness and variation, the former being the temporal coherence of Jonschkowski and Brock (2015)
    and the slowness principle (thesis, section 3.2.4). The first term alone is least where all latents are
    the same; `variability=0` shows that. The gradient flows into the encoder through all of them; there is no
    head.
    """

    def loss(head: Params, slow_head: Params, latents: Latents, window: Window, key: jax.Array):
        z, valid = latents.online(0), window.valid[:, 0]
        losses = valid * jax.vmap(squared_step)(z, latents.online(1))
        return losses + variability * over_others(similarity, valid, z), {}

    return Objective(lambda key: {}, loss, weight, horizon=1)
