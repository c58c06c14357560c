"""Local signal mixing, the LIX layer of A-LIX.

Cetin et al. (2022), Stabilizing Off-Policy Deep Reinforcement Learning from Pixels, section 4.
In an update the maps of a layer are moved by a random fraction of a pixel, up to a radius S. Gradients that
reach a pixel of the maps are thereby those of its neighbours as well: they change smoothly over the maps,
which keeps a critic from fitting its targets by patterns of single pixels. S is tuned so that the
discontinuity of the gradients is what it is meant to be.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

MOST = 2.0
"""The largest S, as in the authors' code."""


class Mixing(NamedTuple):
    """The numbers of the layers.

    Attributes:
        radius: S at the start, in pixels of the maps.
        goal: the discontinuity of the gradient that S is tuned to, see `discontinuity`; 0: S stays.
    """

    radius: float
    goal: float


def moved(x: Array, shift: Array) -> Array:
    """Maps moved by fractions of a pixel: out[i, j] is x at (i, j) + shift, between pixels by their distance.

    Args:
        x: float32 [B, H, W, C].
        shift: float32 [2], in pixels, down and right. Behind the border its pixels are repeated.
    """

    def weights(side: int, by: Array) -> Array:
        pixels = jnp.arange(side, dtype=jnp.float32)
        places = jnp.clip(pixels + by, 0.0, side - 1.0)
        return jnp.maximum(1.0 - jnp.abs(places[:, None] - pixels), 0.0)

    rows, columns = (weights(side, by) for side, by in zip(x.shape[1:3], shift, strict=True))
    return jnp.einsum("ik,bklc,jl->bijc", rows, x, columns)


def mixed(x: Array, radius: Array, key: Array) -> Array:
    """Maps [B, H, W, C] moved by shifts that are uniform in [-S, S], one draw for the batch.

    No gradient flows into the radius S, float32 [], which is taken to be in [0, `MOST`].
    """
    radius = jnp.clip(jax.lax.stop_gradient(radius), 0.0, MOST)
    return moved(x, radius * jax.random.uniform(key, (2,), jnp.float32, -1.0, 1.0))


def discontinuity(gradient: Array) -> Array:
    """The normalised discontinuity of a gradient on maps: float32 [B, H, W, C] -> float32 [].

    Of the batch's mean gradient, `log(1 + E (g' - g)^2 / E g'^2)`, over the eight neighbours g' of each
    pixel g, a mean over pixels and maps: what the authors' code computes for the paper's ND score. Behind
    the border its pixels are repeated. 0 where there is no gradient.
    """
    g = jnp.mean(gradient, 0)
    g = g / jnp.maximum(jnp.max(jnp.abs(g)), 1e-30)  # squares of small gradients are 0 in float32
    height, width, _ = g.shape
    padded = jnp.pad(g, [(1, 1), (1, 1), (0, 0)], mode="edge")
    around = [padded[i : i + height, j : j + width] for i in range(3) for j in range(3) if (i, j) != (1, 1)]
    signal = sum(other**2 for other in around)
    noise = sum((other - g) ** 2 for other in around)
    return jnp.mean(jnp.log1p(noise / jnp.maximum(signal, 1e-20)))


@partial(jax.custom_vjp, nondiff_argnums=(2,))
def tuned(x: Array, radius: Array, goal: float) -> Array:
    """The maps as they are; the radius' gradient is `goal - discontinuity` of the gradient that they get.

    An optimizer that goes down this gradient raises S where gradients are less smooth than the goal, the
    paper's dual objective. It is 0 with a goal of 0, where there is no gradient on the maps, and where S
    would leave [0, `MOST`].
    """
    return x


def _forward(x: Array, radius: Array, goal: float) -> tuple[Array, Array]:
    return x, radius


def _backward(goal: float, radius: Array, gradient: Array) -> tuple[Array, Array]:
    if not goal:
        return gradient, jnp.zeros_like(radius)
    slope = goal - discontinuity(gradient)
    leaves = jnp.where(slope > 0, radius <= 0, radius >= MOST)
    return gradient, jnp.where(leaves | jnp.all(gradient == 0), 0.0, slope)


tuned.defvjp(_forward, _backward)
