"""The network on top of the latent: the numbers of a kind of value, dueling or not, noisy or not."""

import flax.linen as nn
import jax.numpy as jnp
import numpy as np
from jax import Array

from srl_jax.layers import Dense, NoisyDense, factorised_noise


class QNetwork(nn.Module):
    """Linear, ReLU, linear; two such streams where dueling: `q - mean_a q + v` (Wang et al. 2016, eq. 9).

    Attributes:
        num_actions: A.
        outputs: M, numbers for each action, as the kind of value has it: see `srl_jax.rl.values`.
        hidden: width of each stream.
        dueling, noisy: the parts of Rainbow; noise_std only matters where noisy.
        prior: M constants added to the outputs of every action: what they start near; None: 0.
    """

    num_actions: int
    outputs: int
    hidden: int
    dueling: bool
    noisy: bool
    noisy_std: float
    prior: tuple[float, ...] | None = None

    @nn.compact
    def __call__(self, z: Array, noise: Array | None) -> Array:
        """float32 [B, D] -> float32 [B, A, M].

        Args:
            z: latents.
            noise: a row of what `noise` draws; None acts with the means.
        """
        lengths = self._noise_lengths(z.shape[-1])
        parts: list = [None] * len(lengths)
        if self.noisy and noise is not None:
            parts = jnp.split(noise, np.cumsum(lengths)[:-1].tolist())

        def layer(name: str, features: int, x: Array) -> Array:
            if self.noisy:
                return NoisyDense(features, self.noisy_std, name=name)(x, parts.pop(0))
            return Dense(features, name=name)(x)

        def stream(name: str) -> Array:
            x = nn.relu(layer(f"{name}_hidden", self.hidden, z))
            return layer(f"{name}_out", self._sizes[name], x).reshape(z.shape[0], -1, self.outputs)

        prior = 0.0 if self.prior is None else jnp.asarray(self.prior, jnp.float32)
        q = stream("q")
        if not self.dueling:
            return q + prior
        return q - jnp.mean(q, 1, keepdims=True) + (stream("v") + prior)

    def draw_noise(self, key: Array, rows: int, features: int) -> Array:
        """Noise for so many networks over latents of that size: float32 [rows, ...], independent rows.

        One draw for all: each draw more costs time, and more to compile.
        """
        size = sum(self._noise_lengths(features)) if self.noisy else 0
        return factorised_noise(key, rows * size).reshape(rows, size)

    @property
    def _sizes(self) -> dict[str, int]:
        """How many numbers each stream gives."""
        sizes = {"q": self.num_actions * self.outputs}
        return sizes | {"v": self.outputs} if self.dueling else sizes

    def _noise_lengths(self, features: int) -> list[int]:
        """The noise of each layer, in the order in which they are called."""
        hidden = self.hidden
        return [n for size in self._sizes.values() for n in (features + hidden, hidden + size)]
