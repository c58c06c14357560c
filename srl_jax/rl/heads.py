"""The network on top of the latent: Q values or their distributions, dueling or not, noisy or not."""

import flax.linen as nn
import jax
import jax.numpy as jnp

from srl_jax.layers import Dense, NoisyDense
from srl_jax.types import Array


class QNetwork(nn.Module):
    """Linear, ReLU, linear; two such streams where dueling: `q - mean_a q + v` (Wang et al. 2016, eq. 9).

    Attributes:
        num_actions: A.
        atoms: M, of the value distribution; 1 for plain values.
        hidden: width of each stream.
        dueling, noisy: the parts of Rainbow; noise_std only matters where noisy.
    """

    num_actions: int
    atoms: int
    hidden: int
    dueling: bool
    noisy: bool
    noisy_std: float

    @nn.compact
    def __call__(self, z: Array, key: Array | None) -> Array:
        """float32 [B, D] -> float32 [B, A, M]: logits, or values where M is 1. No key, no noise."""
        keys = iter([None] * 4 if key is None else jax.random.split(key, 4))

        def layer(name: str, features: int, x: Array) -> Array:
            noise = next(keys)
            if self.noisy:
                return NoisyDense(features, self.noisy_std, name=name)(x, noise)
            return Dense(features, name=name)(x)

        def stream(name: str, outputs: int) -> Array:
            x = nn.relu(layer(f"{name}_hidden", self.hidden, z))
            return layer(f"{name}_out", outputs * self.atoms, x).reshape(-1, outputs, self.atoms)

        q = stream("q", self.num_actions)
        if self.dueling:
            q = q - jnp.mean(q, 1, keepdims=True) + stream("v", 1)
        return q
