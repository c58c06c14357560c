"""Convolutional encoders and the decoders that mirror them, as tables of layers."""

import functools
import inspect
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import flax.linen as nn
import jax.numpy as jnp
from jax import Array

from srl_jax.encoders.adapter import flax_encoder
from srl_jax.layers import INITIALISERS, Conv, ConvTranspose, Dense, Pads, WideDense
from srl_jax.specs import choices_text
from srl_jax.types import Encoder

LEAST_SEEN = 0.95
"""The share of an image's side that the layers must see: a ball or a paddle may lie in what they do not."""


EPSILON = 1e-5
"""What LayerNorm adds to the variance."""


class Layer(NamedTuple):
    """One convolution: output channels, side of the kernel and stride, both in pixels."""

    channels: int
    kernel: int
    stride: int


class Start(NamedTuple):
    """How an encoder and its decoder start, and what the encoder sees; the defaults are the textbook's.

    Attributes:
        init: how convolutions start, a key of `srl_jax.layers.INITIALISERS`.
        zero_sum: whether the first layer's kernels start with a sum of 0, see `srl_jax.layers.zero_sum`.
        gain: factor of the pixels, which are in [0, 1] before it. Between the frames of a game only a ball
            and two paddles may move, a hundredth of the pixels; with a gain of 32 latents then differ by
            tenths.
        decoder_scale: factor of the initial kernel of the decoder's last layer. At full size the first
            images are all contrast; a tenth starts near black.
    """

    init: str = "pytorch"
    zero_sum: bool = False
    gain: float = 1.0
    decoder_scale: float = 1.0


def starting(factory: Callable[..., Encoder]) -> Callable[..., Encoder]:
    """A row of encoders: a factory of one from a `Start`, whose fields become options behind its own.

    Args:
        factory: (observation_shape, start, **options) -> Encoder.

    Raises:
        ValueError: from the row, where a value of `Start` is out of range.
    """
    shape, _, *own = inspect.signature(factory).parameters.values()

    @functools.wraps(factory)
    def row(observation_shape: tuple[int, int, int], **options: Any) -> Encoder:
        start = Start(**{name: options.pop(name) for name in Start._fields if name in options})
        if start.init not in INITIALISERS:
            raise ValueError(f"init: {choices_text(start.init, INITIALISERS)}")
        for name in ("gain", "decoder_scale"):
            if not 1e-3 <= getattr(start, name) <= 1e3:
                raise ValueError(f"{name} must be at least 0.001 and at most 1000")
        return factory(observation_shape, start, **options)

    of_start = list(inspect.signature(Start).parameters.values())
    options = [*own, *(p.replace(kind=inspect.Parameter.KEYWORD_ONLY) for p in of_start)]
    row.__dict__["__signature__"] = inspect.Signature([shape, *options])
    return row


class EncoderNetwork(nn.Module):
    """Convolutions with ReLU, flatten, and an optional bottleneck: linear, LayerNorm, tanh.

    Attributes:
        layers: the convolutions, from the image on.
        start: of the convolutions.
        sizes: (height, width) of each layer's input, image first, and of the last layer's output. A layer has
            zeros below and on the right of its input where its strides reach beyond it.
        features: the bottleneck's size; 0 leaves it out, and the flattened maps are the latent.
        layer_norm: LayerNorm between the bottleneck's linear layer and its tanh, as in SAC-AE.
    """

    layers: Sequence[Layer]
    start: Start
    sizes: Sequence[tuple[int, int]]
    features: int = 0
    layer_norm: bool = True

    @nn.compact
    def __call__(self, observation: Array) -> Array:
        x = observation
        init, zero_sum, gain, _ = self.start
        if x.dtype == jnp.uint8:
            gain /= 255.0
        for i, layer in enumerate(self.layers):
            # The first kernel is multiplied by the gain, not the image: the same, with fewer bytes.
            first = i == 0
            padding = padding_between(self.sizes[i], self.sizes[i + 1], layer)
            conv = Conv(*layer, init, zero_sum and first, gain if first else 1.0, padding=padding)
            x = nn.relu(conv(x))
        x = x.reshape(x.shape[0], -1)
        if not self.features:
            return x
        x = Dense(self.features)(x)
        if self.layer_norm:
            x = nn.LayerNorm(epsilon=EPSILON)(x)
        return jnp.tanh(x)


class DecoderNetwork(nn.Module):
    """The mirror of `EncoderNetwork`: layers flipped, convolutions transposed.

    An encoder with a bottleneck gives it [B, features + extra], which a linear layer and ReLU turn into
    maps. Without one the latent is reshaped, and the extra inputs become constant maps beside it.

    Attributes:
        layers: the encoder's.
        start: the encoder's.
        sizes: the encoder's.
        channels: the image's channels.
        latent: the latent's size, without the extra inputs.
        bottleneck: whether the encoder ends in one.
        sigmoid: whether the last layer's output goes through a sigmoid.
    """

    layers: Sequence[Layer]
    start: Start
    sizes: Sequence[tuple[int, int]]
    channels: int
    latent: int
    bottleneck: bool
    sigmoid: bool

    @nn.compact
    def __call__(self, x: Array) -> Array:
        (height, width), maps = self.sizes[-1], self.layers[-1].channels
        if self.bottleneck:
            x = nn.relu(WideDense(height * width * maps)(x)).reshape(-1, height, width, maps)
        else:
            extra = x[:, None, None, self.latent :]
            x = x[:, : self.latent].reshape(-1, height, width, maps)
            extra = jnp.broadcast_to(extra, (*x.shape[:3], extra.shape[-1]))
            x = jnp.concatenate([x, extra], -1)
        outputs = [self.channels] + [layer.channels for layer in self.layers[:-1]]
        for i in reversed(range(len(self.layers))):
            _, kernel, stride = self.layers[i]
            scale = 1.0 if i else self.start.decoder_scale
            x = ConvTranspose(outputs[i], kernel, stride, self.sizes[i], self.start.init, scale)(x)
            if i:
                x = nn.relu(x)
        return nn.sigmoid(x) if self.sigmoid else x


def convolutional_encoder(
    observation_shape: tuple[int, int, int],
    layers: Sequence[Layer],
    start: Start,
    *,
    features: int = 0,
    layer_norm: bool = True,
    sigmoid: bool = False,
) -> Encoder:
    """An `Encoder` from a table of layers.

    Args:
        observation_shape: (H, W, S * C).
        layers: its convolutions.
        start: how it starts.
        features: size of the bottleneck; 0 for none.
        layer_norm: see `EncoderNetwork`.
        sigmoid: whether the decoder ends in a sigmoid (in (0, 1)) or is linear at the end.

    Raises:
        ValueError: where the image is too small for the layers.
    """
    *sides, channels = observation_shape
    layers = tuple(layers)
    sizes = tuple(zip(*(layer_sides(side, layers) for side in sides), strict=True))
    map_shape = *sizes[-1], layers[-1].channels
    network = EncoderNetwork(layers, start, sizes, features, layer_norm)
    latent = features or math.prod(map_shape)
    decoder = DecoderNetwork(layers, start, sizes, channels, latent, bool(features), sigmoid)
    encoder = flax_encoder(network, decoder, observation_shape, map_shape=map_shape)
    return encoder._replace(steps=tuple(steps(network)))


def padding_between(before: tuple[int, int], after: tuple[int, int], layer: Layer) -> Pads:
    """The zeros ((above, below), (left, right)) of a layer between two sizes (height, width)."""
    below, right = (
        max(0, (y - 1) * layer.stride + layer.kernel - x) for x, y in zip(before, after, strict=True)
    )
    return (0, below), (0, right)


def steps(network: EncoderNetwork) -> Iterator[dict[str, Any]]:
    """What a network computes of bytes, as `Encoder.steps`."""
    yield {"step": "multiply", "by": network.start.gain / 255}
    for i, layer in enumerate(network.layers):
        padding = padding_between(network.sizes[i], network.sizes[i + 1], layer)
        yield {"step": "conv", "parameters": f"Conv_{i}", "stride": layer.stride, "padding": padding}
        yield {"step": "relu"}
    yield {"step": "flatten"}
    if network.features:
        yield {"step": "dense", "parameters": "Dense_0"}
        if network.layer_norm:
            yield {"step": "layer_norm", "parameters": "LayerNorm_0", "epsilon": EPSILON}
        yield {"step": "tanh"}


def layer_sides(side: int, layers: Sequence[Layer]) -> list[int]:
    """The side, in pixels, of each layer's input and of the last one's output.

    Strides that do not fit leave out the last rows and columns, as they do in other projects, where that is
    less than 1 in 20 of the image (`LEAST_SEEN`). Where it is more, every layer whose strides do not fit gets
    zeros below and on the right: no layer leaves anything out.

    Raises:
        ValueError: the image is too small for the layers.
    """

    def through(up: bool) -> list[int]:
        sides = [side]
        for _, kernel, stride in layers:
            sides.append((sides[-1] - kernel + up * (stride - 1)) // stride + 1)
        return sides

    down, up = through(False), through(True)
    seen = down[-1]
    for _, kernel, stride in reversed(layers):
        seen = (seen - 1) * stride + kernel
    sides = down if down[-1] > 0 and seen >= LEAST_SEEN * side else up
    for before, layer in zip(sides, layers, strict=False):
        if before < layer.kernel:
            kernel = layer.kernel
            raise ValueError(
                f"frames of {side} pixels are too small: a kernel of {kernel} would see {before}"
            )
    return sides
