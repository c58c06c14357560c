"""The network on top of the latent: the numbers of a kind of value, dueling or not, noisy or not."""

import flax.linen as nn
import jax.numpy as jnp
import numpy as np
from jax import Array

from srl_jax.layers import Dense, NoisyDense, factorised_noise
from srl_jax.learning.optim import RL
from srl_jax.types import Array as AnyArray
from srl_jax.types import Layer, Params


class QNetwork(nn.Module):
    """Linear, ReLU, linear; two such streams where dueling: `q - mean_a q + v` (Wang et al. 2016, eq. 9).

    Attributes:
        num_actions: A.
        outputs: M, numbers for each action, as the kind of value has it: see `srl_jax.rl.values`.
        hidden: width of each stream.
        dueling, noisy: the parts of Rainbow; noisy_std only matters where noisy.
        prior: M constants added to the outputs of every action: what they start near; None: 0.
        shared_hidden: whether the two streams of a dueling network have one hidden layer, as Dopamine's.
        cosines: where above 0, latents are multiplied by an embedding of shares of probability, taus, in so
            many cosines: `z * ReLU(linear(cos(pi i tau)))`, i from 0 (Dabney et al. 2018b, equation 4).
        initial: how its layers start, a key of `srl_jax.layers.INITIALISERS`.
    """

    num_actions: int
    outputs: int
    hidden: int
    dueling: bool
    noisy: bool
    noisy_std: float
    prior: tuple[float, ...] | None = None
    shared_hidden: bool = False
    cosines: int = 0
    initial: str = "pytorch"

    @nn.compact
    def __call__(self, z: Array, noise: Array | None, taus: Array | None = None) -> Array:
        """float32 [B, D] -> float32 [B, A, M].

        Args:
            z: latents.
            noise: a row of what `draw_noise` draws; None acts with the means.
            taus: float32 [B, N] in [0, 1], where there are cosines; the result is [B, A, N * M] then.
        """
        if taus is not None:
            angles = jnp.pi * taus[..., None] * jnp.arange(self.cosines, dtype=jnp.float32)
            embedded = nn.relu(Dense(z.shape[-1], self.initial, name="embedding")(jnp.cos(angles)))
            z = (z[:, None] * embedded).reshape(-1, z.shape[-1])
        q = self._outputs(z, noise)
        if taus is None:
            return q
        return jnp.moveaxis(q.reshape(*taus.shape, *q.shape[1:]), 1, 2).reshape(len(taus), q.shape[1], -1)

    def _outputs(self, z: Array, noise: Array | None) -> Array:
        """float32 [B, D] -> float32 [B, A, M]."""
        lengths = self._noise_lengths(z.shape[-1])
        parts: list = [None] * len(lengths)
        if self.noisy and noise is not None:
            parts = jnp.split(noise, np.cumsum(lengths)[:-1].tolist())

        def layer(name: str, features: int, x: Array) -> Array:
            if self.noisy:
                return NoisyDense(features, self.noisy_std, self.initial, name=name)(x, parts.pop(0))
            return Dense(features, self.initial, name=name)(x)

        shared = nn.relu(layer("hidden", self.hidden, z)) if self.shared_hidden else None

        def stream(name: str) -> Array:
            x = nn.relu(layer(f"{name}_hidden", self.hidden, z)) if shared is None else shared
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

    def first_layer(self) -> Layer | None:
        """The head's first layer or layers side by side, by the means of their weights, without ReLU.

        None where something else sees the latent first, an embedding of taus.
        """
        if self.cosines:
            return None
        names = ["hidden"] if self.shared_hidden else [f"{stream}_hidden" for stream in self._sizes]

        def apply(part: Params, z: AnyArray) -> Array:
            return jnp.concatenate([z @ part[name]["kernel"] + part[name]["bias"] for name in names], -1)

        def means(head: Params) -> Params:
            return {name: {which: head[name][which] for which in ("kernel", "bias")} for name in names}

        return Layer(RL, self.hidden * len(names), means, apply)

    @property
    def _sizes(self) -> dict[str, int]:
        """How many numbers each stream gives."""
        sizes = {"q": self.num_actions * self.outputs}
        return sizes | {"v": self.outputs} if self.dueling else sizes

    def _noise_lengths(self, features: int) -> list[int]:
        """The noise of each layer, in the order in which they are called."""
        first, sizes = features + self.hidden, self._sizes.values()
        if self.shared_hidden:
            return [first, *(self.hidden + size for size in sizes)]
        return [n for size in sizes for n in (first, self.hidden + size)]
