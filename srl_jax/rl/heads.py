"""The network on top of the latent: Q values or their distributions, dueling or not, noisy or not."""

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from srl_jax.layers import Dense, NoisyDense
from srl_jax.types import Array


class QNetwork(nn.Module):
    """Linear, ReLU, linear; two such streams where dueling: `q - mean_a q + v` (Wang et al. 2016, eq. 9).

    Attributes:
        num_actions: A.
        atoms: M, of the value distribution; 1 for plain values.
        hidden: width of each stream.
        dueling, noisy: the parts of Rainbow; noise_std only matters where noisy.
        prior: M constants added to the logits of every action: what the distribution starts near; none: 0.
    """

    num_actions: int
    atoms: int
    hidden: int
    dueling: bool
    noisy: bool
    noisy_std: float
    prior: tuple[float, ...] | None = None

    @nn.compact
    def __call__(self, z: Array, key: Array | None) -> Array:
        """float32 [B, D] -> float32 [B, A, M]: logits, or values where M is 1. No key, no noise."""
        outputs = {"q": self.num_actions * self.atoms}
        if self.dueling:
            outputs["v"] = self.atoms
        sizes = [(z.shape[-1], self.hidden, out) for out in outputs.values()]
        noise = self._noise(key, sizes) if self.noisy and key is not None else [None] * 2 * len(sizes)

        def layer(name: str, features: int, x: Array) -> Array:
            if self.noisy:
                return NoisyDense(features, self.noisy_std, name=name)(x, noise.pop(0))
            return Dense(features, name=name)(x)

        def stream(name: str) -> Array:
            x = nn.relu(layer(f"{name}_hidden", self.hidden, z))
            return layer(f"{name}_out", outputs[name], x).reshape(z.shape[0], -1, self.atoms)

        prior = 0.0 if self.prior is None else jnp.asarray(self.prior, jnp.float32)
        q = stream("q")
        if not self.dueling:
            return q + prior
        return q - jnp.mean(q, 1, keepdims=True) + (stream("v") + prior)

    def _noise(self, key: Array, sizes: list[tuple]) -> list[Array]:
        """Each layer's noise, cut from one draw: every draw more costs compilation time."""
        lengths = [n for inputs, hidden, out in sizes for n in (inputs + hidden, hidden + out)]
        ends = np.cumsum(lengths)
        # Meant to keep XLA from fusing the draw into the loop over weights; its gain is not measured.
        noise = jax.lax.optimization_barrier(jax.random.normal(key, (int(ends[-1]),)))
        return jnp.split(noise, ends[:-1].tolist())
