"""Bisimulation: latents as far apart as what follows from them differs."""

import functools

import jax
import jax.numpy as jnp

from srl_jax.objectives.networks import over_others
from srl_jax.types import Array, Context, Latents, Objective, Params, Window


def bisimulation_error(
    z: Array, r: Array, z_t: Array, z_other: Array, r_other: Array, z_t_other: Array, discount: float
) -> jax.Array:
    """`(|z - z'|_1 / D - |r - r'| - discount |z_t - z'_t|_2 / sqrt(D))^2`, of a pair of transitions.

    Zhang et al. (2021), equation 4, with the distance of the next latents that were seen in place of the
    Wasserstein distance of two Gaussians (for deterministic transitions they are the same). Both norms are
    per element, so that the rewards' part does not depend on D.

    Args:
        z, r, z_t: float32 [D], [], [D], the latent of a state, and the reward and the latent that followed.
        z_other, r_other, z_t_other: those of another one.
        discount: the factor of the distance of what followed.

    Returns:
        float32 []. The gradient flows into z and z_other.
    """
    size = z.shape[-1]
    apart = jnp.sum(jnp.abs(z - z_other)) / size
    next_apart = jnp.sqrt(jnp.sum((z_t - z_t_other) ** 2) / size)
    target = jax.lax.stop_gradient(jnp.abs(r - r_other) + discount * next_apart)
    return (apart - target) ** 2


def bisimulation(context: Context, *, weight: float = 1.0, discount: float = 0.99) -> Objective:
    """Makes distances of latents those of rewards and of next latents.

    Zhang et al. (2021), thesis section 4.3.3. Each row is compared with all others of the batch. The gradient
    flows through both z_t into the encoder; there is no head. Where all rewards are the same, so are the
    latents that it asks for.

    Args:
        discount: the factor of the distance of the next latents, in [0, 1).
    """
    if not 0 <= discount < 1:
        raise ValueError("discount must be at least 0 and below 1")

    def loss(head: Params, slow_head: Params, latents: Latents, window: Window, key: jax.Array):
        error = functools.partial(bisimulation_error, discount=discount)
        arrays = latents.online(0), window.rewards[:, 0], latents.online(1)
        return over_others(error, window.valid[:, 0], *arrays), {}

    return Objective(lambda key: {}, loss, weight, horizon=1)
