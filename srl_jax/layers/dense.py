"""Linear layers, with noise on their weights and without, and what all layers are."""

import math
from collections.abc import Callable

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax.errors import ScopeParamShapeError
from jax import Array

from srl_jax.layers.initialisers import INITIALISERS, uniform_fan_in

FEW_ROWS = 16
"""A noisy layer of no more rows multiplies by mu and by sigma, and does not write down their noisy sum."""


class Layer(nn.Module):
    """A layer whose weights are [shape], float32."""

    def weights(self, name: str, init: Callable[..., Array], shape: tuple[int, ...]) -> Array:
        """As `self.param`, which would trace the initialiser wherever the layer is applied, a quarter of what
        tracing an update takes.

        Raises:
            flax.errors.ScopeParamShapeError: the weights that are given have another shape.
        """
        if not self.has_variable("params", name):
            return self.param(name, init, shape)
        value: Array = self.get_variable("params", name)
        if jnp.shape(value) != shape:
            raise ScopeParamShapeError(name, "/".join(self.path), jnp.shape(value), shape)
        return value


class Dense(Layer):
    """A linear layer, float32 [B, inputs] -> [B, features].

    Attributes:
        features: outputs.
        initial: a key of `INITIALISERS`.
    """

    features: int
    initial: str = "pytorch"

    @nn.compact
    def __call__(self, x: Array) -> Array:
        init, bias_init = INITIALISERS[self.initial](x.shape[-1])
        kernel = self.weights("kernel", init, (x.shape[-1], self.features))
        bias = self.weights("bias", bias_init, (self.features,))
        return x @ kernel + bias


class WideDense(Layer):
    """`Dense` for far more outputs than inputs; its kernel is [features, inputs], as PyTorch has it.

    The product that gives the inputs' gradient then runs along the rows of a kernel that may have 10M
    numbers. The bias is added as a product with ones, whose gradient is one, too: as a sum over the batch
    it takes YNNPACK 7 ms with two threads for 32 x 39,200 numbers, and 0.1 ms as a product.
    """

    features: int

    @nn.compact
    def __call__(self, x: Array) -> Array:
        inputs = x.shape[-1]
        init = uniform_fan_in(inputs)
        kernel = self.weights("kernel", init, (self.features, inputs))
        bias = self.weights("bias", init, (self.features,))
        return x @ kernel.T + jnp.ones((x.shape[0], 1), x.dtype) @ bias[None, :]


def factorised_noise(key: Array, size: int) -> Array:
    """f(e) = sign(e) sqrt(|e|) of standard normal e, float32 [size] (Fortunato et al. 2018, equation 11)."""
    noise = jax.random.normal(key, (size,), jnp.float32)
    noise = jnp.sign(noise) * jnp.sqrt(jnp.abs(noise))
    if not size:
        return noise
    # A branch, or XLA would compute the noise anew for every weight that it is multiplied with. Always the
    # first one; the other is noise of the same distribution.
    return jax.lax.cond(noise[0] > -100.0, lambda e: e, lambda e: -e, noise)


class NoisyDense(Layer):
    """A linear layer with factorised Gaussian noise on its weights (Fortunato et al. 2018, section 3).

    `y = x (mu + sigma * f(e_in) f(e_out)^T) + mu_b + sigma_b * f(e_out)`. One draw serves the whole batch.
    Without noise the layer acts with its means.

    Attributes:
        features: outputs.
        std: sigma starts as std / sqrt(inputs), the thesis' "noisy std".
        initial: of the means, a key of `INITIALISERS`.
    """

    features: int
    std: float = 0.1
    initial: str = "pytorch"

    @nn.compact
    def __call__(self, x: Array, noise: Array | None) -> Array:
        """float32 [B, inputs], and `factorised_noise` [inputs + features] or None -> [B, features]."""
        inputs = x.shape[-1]
        init, bias_init = INITIALISERS[self.initial](inputs)
        sigma = nn.initializers.constant(self.std / math.sqrt(inputs), jnp.float32)
        kernel = self.weights("kernel", init, (inputs, self.features))
        bias = self.weights("bias", bias_init, (self.features,))
        kernel_sigma = self.weights("kernel_sigma", sigma, (inputs, self.features))
        bias_sigma = self.weights("bias_sigma", sigma, (self.features,))
        if noise is None:
            return x @ kernel + bias
        noise_in, noise_out = noise[:inputs], noise[inputs:]
        bias = bias + bias_sigma * noise_out
        if x.shape[0] <= FEW_ROWS:
            return x @ kernel + ((x * noise_in) @ kernel_sigma) * noise_out + bias
        return x @ (kernel + kernel_sigma * (noise_in[:, None] * noise_out[None, :])) + bias
