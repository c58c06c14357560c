"""An objective of your own: latents that change slowly (Wiskott and Sejnowski 2002, slow feature analysis).

    srl-jax train --import=examples/own_objective.py --preset=catch/joint \
        --objective=+continuity:weight=0.01 --out=runs/slow

The run's config.json keeps the import, so that `srl-jax evaluate runs/slow` and `srl_jax.load` know the
objective. Its loss is in every row, and `diag/gradient/continuity/cosine` compares its gradient with RL's.
Alone it is least where all latents are the same: RL or reconstruction beside it keep them apart.
"""

import jax
import jax.numpy as jnp

import srl_jax.objectives
from srl_jax.types import Array, Context, Latents, Objective, Params, Window


def squared_step(z_tm1: Array, z_t: Array) -> jax.Array:
    """The squared distance of two successive latents: float32 [D], [D] -> float32 []."""
    return jnp.sum((z_t - z_tm1) ** 2)


@srl_jax.objectives.register("continuity")
def continuity(context: Context, *, weight: float = 1.0) -> Objective:
    """Pulls z_{t+1} and z_t together; the gradient flows through both into the encoder."""

    def loss(head: Params, slow_head: Params, latents: Latents, window: Window, key: jax.Array):
        losses = jax.vmap(squared_step)(latents.online(0), latents.online(1))
        return window.valid[:, 0] * losses, {}

    return Objective(lambda key: {}, loss, weight, horizon=1)
