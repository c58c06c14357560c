"""Convolutional encoders and the decoders that mirror them, as tables of layers."""

import itertools
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array

from srl_jax.encoders.adapter import flax_encoder
from srl_jax.encoders.lix import Mixing, mixed, tuned
from srl_jax.encoders.options import End, Latent, Start
from srl_jax.layers import Conv, ConvTranspose, Pads, padding_of
from srl_jax.learning.optim import ENCODER
from srl_jax.specs import check_choice
from srl_jax.types import Array as AnyArray
from srl_jax.types import Decoder, Encoder, Params

ACTIVATIONS = {"relu": nn.relu, "elu": nn.elu}

RADIUS = "lix_radius"
"""The name of the radius of local signal mixing among an encoder's parameters."""

PADDINGS = ("valid", "same")
"""See `convolutional_encoder`."""

LEAST_SEEN = 0.95
"""The share of an image's side that the layers must see: a ball or a paddle may lie in what they do not."""


class Layer(NamedTuple):
    """One convolution: output channels, side of the kernel and stride, both in pixels."""

    channels: int
    kernel: int
    stride: int


class EncoderNetwork(nn.Module):
    """Convolutions with an activation each, and what makes a latent of their maps.

    Attributes:
        layers: the convolutions, from the image on.
        start: of the convolutions.
        pads: the zeros around each layer's input.
        latent: of the last layer's maps.
        activation: a key of `ACTIVATIONS`.
        lix: local signal mixing, see `srl_jax.encoders.lix`, of the maps of each layer; None for none.
    """

    layers: Sequence[Layer]
    start: Start
    pads: Sequence[Pads]
    latent: Latent
    activation: str = "relu"
    lix: Mixing | None = None

    @nn.compact
    def __call__(self, observation: Array, key: Array | None = None) -> Array:
        x = observation
        if self.lix:
            radius = self.param(RADIUS, nn.initializers.constant(self.lix.radius, jnp.float32), ())
        init, zero_sum, gain, _ = self.start
        if x.dtype == jnp.uint8:
            gain /= 255.0
        for i, layer in enumerate(self.layers):
            # The first kernel is multiplied by the gain, not the image: the same, with fewer bytes.
            first = i == 0
            conv = Conv(*layer, init, zero_sum and first, gain if first else 1.0, padding=self.pads[i])
            x = ACTIVATIONS[self.activation](conv(x))
            if self.lix and key is not None:
                x = mixed(x, radius, jax.random.fold_in(key, i))
        if self.lix and key is not None:
            x = tuned(x, radius, self.lix.goal)
        return self.latent.encode(x)


class DecoderNetwork(nn.Module):
    """The mirror of `EncoderNetwork`: layers flipped, convolutions transposed.

    Attributes:
        layers: the encoder's.
        start: the encoder's.
        pads: the encoder's.
        latent: the encoder's.
        sizes: (height, width) of each layer's input in the encoder, image first.
        channels: the image's channels.
        sigmoid: whether the last layer's output goes through a sigmoid.
        activation: the encoder's.
    """

    layers: Sequence[Layer]
    start: Start
    pads: Sequence[Pads]
    latent: Latent
    sizes: Sequence[tuple[int, int]]
    channels: int
    sigmoid: bool
    activation: str = "relu"

    @nn.compact
    def __call__(self, x: Array) -> Array:
        x = self.latent.decode(x)
        outputs = [self.channels] + [layer.channels for layer in self.layers[:-1]]
        for i in reversed(range(len(self.layers))):
            _, kernel, stride = self.layers[i]
            scale = 1.0 if i else self.start.decoder_scale
            layer = ConvTranspose(
                outputs[i], kernel, stride, self.sizes[i], self.start.init, scale, self.pads[i]
            )
            x = layer(x)
            if i:
                x = ACTIVATIONS[self.activation](x)
        return nn.sigmoid(x) if self.sigmoid else x


def convolutional_encoder(
    observation_shape: tuple[int, int, int],
    layers: Sequence[Layer],
    start: Start,
    end: End,
    *,
    features: int = 0,
    own_end: str = "none",
    sigmoid: bool = False,
    padding: str = "valid",
    least_seen: float = LEAST_SEEN,
    activation: str = "relu",
    lix: Mixing | None = None,
) -> Encoder:
    """An `Encoder` from a table of layers.

    Args:
        observation_shape: (H, W, S * C).
        layers: its convolutions.
        start: how it starts.
        end: how it ends.
        features: size of the bottleneck, a linear layer; 0 for none.
        own_end: what `end=default` means behind a bottleneck.
        sigmoid: whether the decoder ends in a sigmoid (in (0, 1)) or is linear at the end.
        padding: "valid", no zeros where the strides fit, see `layer_sides`; "same", as many on all sides as
            give sides / stride, rounded up: flax's and TensorFlow's SAME.
        least_seen: see `layer_sides`.
        activation, lix: see `EncoderNetwork`.

    Raises:
        ValueError: where the image is too small for the layers, or an option is out of range.
    """
    check_choice("padding", padding, PADDINGS)
    *sides, channels = observation_shape
    layers = tuple(layers)
    same = padding == "same"
    sizes = tuple(zip(*(layer_sides(side, layers, same, least_seen) for side in sides), strict=True))
    if same:
        pads = tuple(padding_of("SAME", x, y.kernel, y.stride) for x, y in zip(sizes, layers, strict=False))
    else:
        pads = tuple(map(padding_between, sizes, sizes[1:], layers))
    latent = end.latent((*sizes[-1], layers[-1].channels), features, own_end)
    network = EncoderNetwork(layers, start, pads, latent, activation, lix)
    decoder = DecoderNetwork(layers, start, pads, latent, sizes[:-1], channels, sigmoid, activation)
    encoder = flax_encoder(network, decoder, observation_shape, map_shape=latent.maps, noisy=lix is not None)
    make_decoder = encoder.make_decoder
    assert make_decoder
    return encoder._replace(
        steps=tuple(steps(network)), make_tied_decoder=lambda: tied(make_decoder(), len(layers))
    )


def tied(decoder: Decoder, layers: int) -> Decoder:
    """The decoder with the transposes of the encoder's kernels, which it reads, in the place of its own."""
    mirrored = {f"ConvTranspose_{layers - 1 - i}": f"Conv_{i}" for i in range(layers)}

    def transposed(encoder: Params) -> Params:
        return {to: {"kernel": jnp.swapaxes(encoder[of]["kernel"], 2, 3)} for to, of in mirrored.items()}

    def init(key: Array) -> Params:
        drawn = decoder.init(key)
        return drawn | {name: {"bias": drawn[name]["bias"]} for name in mirrored}

    def apply(params: Params, x: AnyArray) -> Array:
        return decoder.apply({name: tree | params[ENCODER].get(name, {}) for name, tree in params.items()}, x)

    return Decoder(init, apply, {ENCODER: transposed})


def padding_between(before: tuple[int, int], after: tuple[int, int], layer: Layer) -> Pads:
    """The zeros ((above, below), (left, right)) of a layer between two sizes, below and on the right."""
    below, right = (
        max(0, (y - 1) * layer.stride + layer.kernel - x) for x, y in zip(before, after, strict=True)
    )
    return (0, below), (0, right)


def steps(network: EncoderNetwork) -> Iterator[dict[str, Any]]:
    """What a network computes of bytes, as `Encoder.steps`."""
    yield {"step": "multiply", "by": network.start.gain / 255}
    for i, layer in enumerate(network.layers):
        padding = network.pads[i]
        yield {"step": "conv", "parameters": f"Conv_{i}", "stride": layer.stride, "padding": padding}
        yield {"step": network.activation}
    yield from network.latent.steps()


def layer_sides(
    side: int, layers: Sequence[Layer], same: bool = False, least_seen: float = LEAST_SEEN
) -> list[int]:
    """The side, in pixels, of each layer's input and of the last one's output.

    Strides that do not fit leave out the last rows and columns, as they do in other projects, where the
    layers still see the share `least_seen` of the image. Where it is less, every layer whose strides do not
    fit gets zeros below and on the right: no layer leaves anything out.

    Args:
        side: of the image.
        layers: the convolutions.
        same: whether each layer divides the side by its stride and rounds up, with zeros all around.
        least_seen: a share of 1.

    Raises:
        ValueError: the image is too small for the layers.
    """
    if same:
        return list(itertools.accumulate(layers, lambda n, layer: -(-n // layer.stride), initial=side))

    def through(up: bool) -> list[int]:
        sides = [side]
        for _, kernel, stride in layers:
            sides.append((sides[-1] - kernel + up * (stride - 1)) // stride + 1)
        return sides

    down, up = through(False), through(True)
    seen = down[-1]
    for _, kernel, stride in reversed(layers):
        seen = (seen - 1) * stride + kernel
    sides = down if down[-1] > 0 and seen >= least_seen * side else up
    for before, layer in zip(sides, layers, strict=False):
        if before < layer.kernel:
            kernel = layer.kernel
            raise ValueError(
                f"frames of {side} pixels are too small: a kernel of {kernel} would see {before}"
            )
    return sides
