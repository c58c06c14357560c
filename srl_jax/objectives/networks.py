"""Small networks that several objectives have above the latent."""

from collections.abc import Callable
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

from srl_jax import layers
from srl_jax.layers import Dense
from srl_jax.types import Array, Params


class MLP(nn.Module):
    """Linear layers with ReLU between them: float32 [B, inputs] -> [B, outputs].

    Attributes:
        hidden: width of the one hidden layer; 0 leaves it out, and the network is linear.
        outputs: its outputs.
        layer_norm: LayerNorm before the ReLU (CURL's head).
    """

    hidden: int
    outputs: int
    layer_norm: bool = False

    @nn.compact
    def __call__(self, x: Any) -> Array:
        if self.hidden:
            x = Dense(self.hidden, name="hidden")(x)
            if self.layer_norm:
                x = nn.LayerNorm(epsilon=1e-5, name="norm")(x)
            x = nn.relu(x)
        return Dense(self.outputs, name="out")(x)


def functions(network: nn.Module, *inputs: int) -> tuple[Callable[[jax.Array], Params], Callable]:
    """`srl_jax.layers.functions` of a network over arrays [B, input]."""
    return layers.functions(network, *((1, size) for size in inputs))


def join(*arrays: Array) -> jax.Array:
    """Arrays [B, ...] side by side, along their last axis."""
    return jnp.concatenate(arrays, -1)


def one_hot(actions: Array, num_actions: int) -> jax.Array:
    """int32 [...] -> float32 [..., A]."""
    return jax.nn.one_hot(actions, num_actions, dtype=jnp.float32)


def mean_squared_error(x: Array, y: Array) -> jax.Array:
    """The squared difference of two vectors or images, float32 of one shape, averaged over it: float32 [].

    A mean, not a sum: of images of 84 x 84 x 4 the two differ by a factor of 28,224.
    """
    return jnp.mean((x - y) ** 2)


def cosine_distance(x: Array, y: Array) -> jax.Array:
    """`2 - 2 cos(x, y)`, the squared distance of the two made unit vectors: float32 [D], [D] -> float32 [].

    BYOL (Grill et al. 2020, equation 2). In [0, 4]; its gradient is 0 where a vector is 0.
    """
    return 2 - 2 * jnp.dot(unit(x), unit(y))


def unit(x: Array) -> jax.Array:
    """The vector divided by its length, along the last axis; 0 stays 0, with a gradient of 0."""
    square = jnp.sum(x**2, -1, keepdims=True)
    zero = square < 1e-24
    return jnp.where(zero, 0.0, x * jax.lax.rsqrt(jnp.where(zero, 1.0, square)))


DISTANCES = {"squared": mean_squared_error, "cosine": cosine_distance}
"""{name: (prediction [D], target [D]) -> float32 []}, the options `distance`."""


def masked_mean(values: Array, mask: Array, axis: int | None = None) -> jax.Array:
    """The mean of `values` where `mask` is 1; 0 where it is 1 nowhere."""
    return jnp.sum(values * mask, axis) / jnp.maximum(jnp.sum(mask, axis), 1.0)


def over_others(function: Callable, valid: Array, *arrays: Array) -> Array:
    """The mean of `function(x_i..., x_j...)` over the valid rows j other than i: float32 [B].

    Rows that are not valid give 0.

    Args:
        function: (arrays of one row, then arrays of another) -> float32 [].
        valid: float32 [B], 1 or 0.
        arrays: each [B, ...].
    """
    rows = len(arrays) * (0,)
    against = jax.vmap(function, (None,) * len(arrays) + rows)
    pairs = jax.vmap(against, rows + (None,) * len(arrays))(*arrays, *arrays)
    others = valid * (1 - jnp.eye(len(valid), dtype=jnp.float32))
    return valid * masked_mean(pairs, others, axis=1)
