"""The residual encoder of IMPALA (Espeholt et al. 2018, figure 3, right), and a decoder that mirrors it."""

from collections.abc import Sequence

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array

from srl_jax.encoders.adapter import flax_encoder
from srl_jax.encoders.options import End, Latent, Start, with_options
from srl_jax.layers import Conv
from srl_jax.specs import check_size
from srl_jax.types import Encoder

CHANNELS = (16, 32, 32)
"""Of the three stages, at a width of 1."""


class Residual(nn.Module):
    """Two blocks, each of ReLU, convolution, ReLU, convolution, beside the identity; no size changes."""

    initial: str

    @nn.compact
    def __call__(self, x: Array) -> Array:
        for _ in range(2):
            y = x
            for _ in range(2):
                y = Conv(x.shape[-1], 3, 1, self.initial, padding="SAME")(nn.relu(y))
            x = x + y
        return x


class ImpalaEncoder(nn.Module):
    """Stages of a convolution, a pooling that halves, and `Residual`; then ReLU, and what makes a latent.

    Attributes:
        channels: of the stages.
        start: of the convolutions.
        latent: of the last stage's maps.
    """

    channels: Sequence[int]
    start: Start
    latent: Latent

    @nn.compact
    def __call__(self, observation: Array) -> Array:
        x, (initial, zero_sum, gain, _) = observation, self.start
        if x.dtype == jnp.uint8:
            gain /= 255.0
        for i, channels in enumerate(self.channels):
            first = i == 0
            x = Conv(channels, 3, 1, initial, zero_sum and first, gain if first else 1.0, padding="SAME")(x)
            x = Residual(initial)(halved(x))
        return self.latent.encode(nn.relu(x))


class ImpalaDecoder(nn.Module):
    """The encoder's stages in reverse: `Residual`, an enlargement to the size before, a convolution.

    Attributes:
        channels: of the encoder's stages.
        start: the encoder's.
        latent: the encoder's.
        sizes: (height, width) of each stage's input in the encoder, image first.
        depth: the image's channels.
    """

    channels: Sequence[int]
    start: Start
    latent: Latent
    sizes: Sequence[tuple[int, int]]
    depth: int

    @nn.compact
    def __call__(self, z: Array) -> Array:
        x = self.latent.decode(z)
        outputs = self.depth, *self.channels[:-1]
        for i in reversed(range(len(outputs))):
            x = doubled(nn.relu(Residual(self.start.init)(x)), self.sizes[i])
            scale = 1.0 if i else self.start.decoder_scale
            x = Conv(outputs[i], 3, 1, self.start.init, init_scale=scale, padding="SAME")(x)
        return x


def halved(x: Array) -> Array:
    """The maximum of 3 x 3 pixels around every second one: [B, H, W, C] -> [B, ceil(H / 2), ceil(W / 2), C].

    As `flax.linen.max_pool(x, (3, 3), (2, 2), "SAME")`, whose gradient takes XLA on a CPU 5 to 27 times as
    long. Pixels that share a maximum share its gradient.
    """
    for axis in (1, 2):
        number = -(-x.shape[axis] // 2)
        pads = [(0, 0)] * 4
        pads[axis] = x.shape[axis] % 2, 2
        x = jnp.pad(x, pads, constant_values=-jnp.inf)
        pairs = x.reshape(*x.shape[:axis], number + 1, 2, *x.shape[axis + 1 :])
        even, odd = jnp.moveaxis(pairs, axis + 1, 0)
        ends = (jax.lax.slice_in_dim(even, i, number + i, axis=axis) for i in (0, 1))
        x = jnp.maximum(jax.lax.slice_in_dim(odd, 0, number, axis=axis), jnp.maximum(*ends))
    return x


def doubled(x: Array, size: tuple[int, int]) -> Array:
    """Every pixel as 2 x 2 of them, cut to `size`, (H, W): [B, ceil(H / 2), ceil(W / 2), C] -> [B, H, W, C].

    Nearest neighbours before a convolution leave no checkerboard, as transposed convolutions do (Odena et al.
    2016).
    """
    batch, height, width, channels = x.shape
    x = jnp.broadcast_to(x[:, :, None, :, None], (batch, height, 2, width, 2, channels))
    return x.reshape(batch, 2 * height, 2 * width, channels)[:, : size[0], : size[1]]


@with_options
def impala(
    observation_shape: tuple[int, int, int], start: Start, end: End, *, features: int = 256, width: int = 1
) -> Encoder:
    """IMPALA's larger encoder: 15 convolutions of 3 x 3 and a linear layer; for frames of any size.

    Its decoder is linear at the end. The paper has none. `width=4,features=0,end=min_max` is the encoder of
    BBF (Schwarzer et al. 2023).

    Args:
        features: size of the linear layer, behind which the default end is ReLU; 0 leaves it out.
        width: factor of the paper's 16, 32 and 32 channels.
    """
    check_size("width", width)
    rows, columns, depth = observation_shape
    channels, sizes = tuple(width * n for n in CHANNELS), [(rows, columns)]
    for _ in channels:
        rows, columns = -(-rows // 2), -(-columns // 2)
        sizes.append((rows, columns))
    latent = end.latent((*sizes[-1], channels[-1]), features, "relu")
    network = ImpalaEncoder(channels, start, latent)
    decoder = ImpalaDecoder(channels, start, latent, tuple(sizes[:-1]), depth)
    return flax_encoder(network, decoder, observation_shape, map_shape=latent.maps)
