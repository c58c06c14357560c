"""L2 regularisation of the latent."""

import jax
import jax.numpy as jnp

from srl_jax.types import Array, Context, Latents, Objective, Window


def half_squared_norm(z: Array) -> jax.Array:
    """`0.5 * sum(z ** 2)` of one latent: float32 [D] -> float32 []. A sum over D, as in SAC-AE."""
    return 0.5 * jnp.sum(z**2)


def latent_l2(context: Context, *, weight: float = 1e-6) -> Objective:
    """Pulls z_t towards 0 (thesis, section 5.4; Ghosh et al. 2020, section 3). No parameters of its own."""

    def loss(head, slow_head, latents: Latents, window: Window, key):
        return jax.vmap(half_squared_norm)(latents.online(0)), {}

    return Objective(lambda key: {}, loss, weight)
