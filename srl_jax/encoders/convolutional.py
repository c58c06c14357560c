"""Convolutional encoders and the decoders that mirror them, as tables of layers."""

from collections.abc import Sequence
from typing import NamedTuple

import flax.linen as nn
import jax.numpy as jnp

from srl_jax.layers import Conv, ConvTranspose, Dense, WideDense
from srl_jax.types import Array, Decoder, Encoder

LEAST_SEEN = 0.95
"""The share of an image's side that the layers must see: a ball or a paddle may lie in what they do not."""

INPUT_GAIN = 32.0
"""Pixels in [0, 1] are multiplied by it, so that latents are of the order of 1 and differ from frame to
frame by tenths: between frames only a ball and two paddles may change, a hundredth of the pixels."""

OUTPUT_SCALE = 0.1
"""Of the initial kernel of a decoder's last layer. At full size the first images are all contrast, and
unlearning it leaves a decoder that ignores the latent: on frames of Catch, `tiny` gives the same black image
(squared error 0.0051) for thousands of updates; with this the error is 0.0018 after 500."""


class Layer(NamedTuple):
    """One convolution: output channels, side of the kernel and stride, both in pixels."""

    channels: int
    kernel: int
    stride: int


class EncoderNetwork(nn.Module):
    """Convolutions with ReLU, flatten, and an optional bottleneck: linear, LayerNorm, tanh.

    Attributes:
        layers: the convolutions, from the image on.
        features: the bottleneck's size; 0 leaves it out, and the flattened maps are the latent.
        layer_norm: LayerNorm between the bottleneck's linear layer and its tanh, as in SAC-AE.
    """

    layers: Sequence[Layer]
    features: int = 0
    layer_norm: bool = True

    @nn.compact
    def __call__(self, observation: Array) -> Array:
        x = observation
        gain = INPUT_GAIN / 255.0 if x.dtype == jnp.uint8 else INPUT_GAIN
        for i, layer in enumerate(self.layers):
            # The first kernel is multiplied by the gain, not the image: the same, with fewer bytes.
            x = nn.relu(Conv(*layer, on_image=i == 0, gain=1.0 if i else gain)(x))
        x = x.reshape(x.shape[0], -1)
        if not self.features:
            return x
        x = Dense(self.features)(x)
        if self.layer_norm:
            x = nn.LayerNorm(epsilon=1e-5)(x)
        return jnp.tanh(x)


class DecoderNetwork(nn.Module):
    """The mirror of `EncoderNetwork`: layers flipped, convolutions transposed.

    An encoder with a bottleneck gives it [B, features + extra], which a linear layer and ReLU turn into
    maps. Without one the latent is reshaped, and the extra inputs become constant maps beside it.

    Attributes:
        layers: the encoder's.
        sizes: side of each layer's input in the encoder, image first, and the last layer's output's.
        channels: the image's channels.
        latent: the latent's size, without the extra inputs.
        bottleneck: whether the encoder ends in one.
        sigmoid: whether the last layer's output goes through a sigmoid.
    """

    layers: Sequence[Layer]
    sizes: Sequence[int]
    channels: int
    latent: int
    bottleneck: bool
    sigmoid: bool

    @nn.compact
    def __call__(self, x: Array) -> Array:
        side, maps = self.sizes[-1], self.layers[-1].channels
        if self.bottleneck:
            x = nn.relu(WideDense(side * side * maps)(x)).reshape(-1, side, side, maps)
        else:
            extra = x[:, None, None, self.latent :]
            x = x[:, : self.latent].reshape(-1, side, side, maps)
            extra = jnp.broadcast_to(extra, (*x.shape[:3], extra.shape[-1]))
            x = jnp.concatenate([x, extra], -1)
        outputs = [self.channels] + [layer.channels for layer in self.layers[:-1]]
        for i in reversed(range(len(self.layers))):
            _, kernel, stride = self.layers[i]
            scale = 1.0 if i else OUTPUT_SCALE
            x = ConvTranspose(outputs[i], kernel, stride, self.sizes[i], scale)(x)
            if i:
                x = nn.relu(x)
        return nn.sigmoid(x) if self.sigmoid else x


def convolutional_encoder(
    observation_shape: tuple,
    layers: Sequence[Layer],
    *,
    features: int = 0,
    layer_norm: bool = True,
    sigmoid: bool = False,
) -> Encoder:
    """An `Encoder` from a table of layers.

    Args:
        observation_shape: (H, W, S), with H = W.
        layers: its convolutions.
        features: size of the bottleneck; 0 for none.
        layer_norm: see `EncoderNetwork`.
        sigmoid: whether the decoder ends in a sigmoid (in (0, 1)) or is linear at the end.

    Raises:
        ValueError: where the image is not square, too small for the layers, or the layers' strides leave
            out more of its last rows and columns than 1 in 20.
    """
    height, width, channels = observation_shape
    if height != width:
        raise ValueError(f"frames must be square, not {height} x {width}")
    sizes = [height]
    for layer in layers:
        if sizes[-1] < layer.kernel:
            raise ValueError(
                f"frames of {height} pixels are too small: a kernel of {layer.kernel} would see {sizes[-1]}"
            )
        sizes.append((sizes[-1] - layer.kernel) // layer.stride + 1)
    seen = sizes[-1]
    for layer in reversed(layers):
        seen = (seen - 1) * layer.stride + layer.kernel
    if seen < LEAST_SEEN * height:
        raise ValueError(
            f"of frames of {height} pixels these layers see {seen} x {seen} and leave out the rest; "
            f"{seen} fits"
        )
    layers, sizes = tuple(layers), tuple(sizes)
    network = EncoderNetwork(layers, features, layer_norm)
    latent = features or sizes[-1] ** 2 * layers[-1].channels
    image = jnp.zeros((1, *observation_shape))

    def make_decoder(extra_inputs: int = 0) -> Decoder:
        decoder = DecoderNetwork(layers, sizes, channels, latent, bool(features), sigmoid)
        z = jnp.zeros((1, latent + extra_inputs))
        return Decoder(
            init=lambda key: decoder.init(key, z)["params"],
            apply=lambda params, x: decoder.apply({"params": params}, x),
        )

    return Encoder(
        init=lambda key: network.init(key, image)["params"],
        apply=lambda params, x: network.apply({"params": params}, x),
        features=latent,
        observation_shape=(height, width, channels),
        make_decoder=make_decoder,
    )
