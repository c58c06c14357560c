"""An encoder of your own, with the decoder that losses on pixels need.

    srl-jax train --import=examples/own_encoder.py --preset=catch/joint \
        --encoder=two_layers:features=32 --out=runs/two_layers

The run's config.json keeps the import. Without a decoder (None) the encoder serves all objectives but those
that decode.
"""

import flax.linen as nn
import jax

import srl_jax.encoders
from srl_jax.types import Array, Encoder


class Network(nn.Module):
    """Observations [B, H, W, S * C], uint8 or float32 in [0, 1] -> latents [B, features]."""

    features: int

    @nn.compact
    def __call__(self, x: Array) -> jax.Array:
        x = x / 255.0 if x.dtype == "uint8" else x
        for channels in (16, 32):
            x = nn.relu(nn.Conv(channels, (4, 4), strides=4)(x))
        return nn.Dense(self.features)(x.reshape(len(x), -1))


class Mirror(nn.Module):
    """Latents [B, D] -> observations [B, *shape] in [0, 1]."""

    shape: tuple[int, int, int]

    @nn.compact
    def __call__(self, z: Array) -> jax.Array:
        rows, columns = (-(-side // 16) for side in self.shape[:2])
        x = nn.relu(nn.Dense(rows * columns * 32)(z)).reshape(-1, rows, columns, 32)
        x = nn.relu(nn.ConvTranspose(16, (4, 4), (4, 4))(x))
        x = nn.ConvTranspose(self.shape[2], (4, 4), (4, 4))(x)
        return x[:, : self.shape[0], : self.shape[1]]


@srl_jax.encoders.register("two_layers")
def two_layers(observation_shape: tuple[int, int, int], *, features: int = 64) -> Encoder:
    """Two convolutions of stride 4 and a linear layer."""
    decoder = Mirror(observation_shape)
    return srl_jax.encoders.flax_encoder(Network(features), decoder, observation_shape)
