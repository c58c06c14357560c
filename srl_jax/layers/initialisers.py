"""How weights start; `INITIALISERS` by name."""

import math

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array


def uniform_fan_in(fan_in: int):
    """An initialiser: U(-1/sqrt(fan_in), 1/sqrt(fan_in)), for kernels and biases alike.

    PyTorch's default for linear and convolutional layers, which the thesis ran with, and dqn_zoo's.
    """
    bound = 1.0 / math.sqrt(fan_in)

    def init(key, shape, dtype=jnp.float32):
        return jax.random.uniform(key, shape, dtype, -bound, bound)

    return init


def he_normal(fan_in: float):
    """An initialiser: a normal of variance 2 / fan_in, truncated at two deviations; for kernels below a ReLU.

    It keeps the size of a signal through convolutions and ReLU (He et al. 2015, equation 10). PyTorch's
    default shrinks it 2.4 times a layer.
    """
    std = math.sqrt(2.0 / fan_in)

    def init(key, shape, dtype=jnp.float32):
        # 0.88 is the standard deviation of the standard normal truncated at 2.
        return std / 0.8796 * jax.random.truncated_normal(key, -2.0, 2.0, shape, dtype)

    return init


def xavier_uniform(fan_in: float):
    """An initialiser: U(-b, b), b = sqrt(6 / (fan_in + fan_out)), for kernels [..., inputs, features].

    Glorot and Bengio (2010), equation 16; what Dopamine has, as flax computes it: `fan_out` is to `fan_in` as
    features are to inputs.
    """

    def init(key, shape, dtype=jnp.float32):
        bound = math.sqrt(6.0 / (fan_in * (1.0 + shape[-1] / shape[-2])))
        return jax.random.uniform(key, shape, dtype, -bound, bound)

    return init


def orthogonal(fan_in: float):
    """An initialiser: kernels [..., features] whose columns are orthogonal, with he_normal's variance.

    A kernel is a matrix [inputs of a feature, features]; where it has more columns than rows, its rows are
    orthogonal (Saxe et al. 2014). Where all its inputs reach an output, `fan_in` of them, the gain is
    sqrt(2), for kernels below a ReLU.
    """

    def init(key, shape, dtype=jnp.float32):
        gain = math.sqrt(2.0 * math.prod(shape[:-1]) / fan_in)
        return nn.initializers.orthogonal(gain)(key, shape, dtype)

    return init


def zeros(key: Array, shape: tuple, dtype=jnp.float32) -> Array:
    """An initialiser: 0. flax's own is float64 where jax may use 64 bits."""
    return jnp.zeros(shape, dtype)


INITIALISERS = {
    "pytorch": lambda fan_in: (uniform_fan_in(fan_in), uniform_fan_in(fan_in)),
    "he": lambda fan_in: (he_normal(fan_in), zeros),
    "xavier": lambda fan_in: (xavier_uniform(fan_in), zeros),
    "orthogonal": lambda fan_in: (orthogonal(fan_in), zeros),
}
"""{name: fan_in -> (the initialiser of a layer's kernel, that of its bias)}."""


def zero_sum(init):
    """Another initialiser's kernels [k, k, C, features], less the mean of each k x k window.

    A uniform image then gives 0, as with edge detectors. Most of a frame is background; with kernels that
    answer to it, the background alone settles which units are on, and a network whose units do not switch is
    linear. Over 240 frames of Pong, 6 to 9 % of the latents of `nature` are on in some frames and off in
    others without this, 64 to 67 % with it (two seeds).
    """

    def centred(key, shape, dtype=jnp.float32):
        kernel = init(key, shape, dtype)
        return kernel - jnp.mean(kernel, (0, 1), keepdims=True)

    return centred


def scaled(init, factor: float):
    """Another initialiser's values, multiplied."""
    return lambda key, shape, dtype=jnp.float32: factor * init(key, shape, dtype)
