"""Convolutions whose gradients XLA's CPU backend computes well.

They are VALID convolutions over explicitly padded inputs. XLA's CPU backend differentiates a transposed,
dilated or internally padded convolution with respect to its kernel on a naive path, ten times slower than the
same layer written as a pad and a VALID convolution.
"""

from collections.abc import Sequence
from functools import partial
from typing import TypeAlias

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array
from jax.custom_derivatives import SymbolicZero

from srl_jax.layers.dense import Layer
from srl_jax.layers.initialisers import INITIALISERS, scaled, zero_sum

Pads: TypeAlias = tuple[tuple[int, int], tuple[int, int]]
"""Zeros around an image: ((above, below), (left, right))."""
Padding: TypeAlias = str | int | Pads
"""See `Conv.padding`."""


class Conv(Layer):
    """A convolution, float32 or uint8 [B, H, W, C] -> float32 [B, H', W', features].

    Attributes:
        features: output channels.
        kernel, stride: in pixels.
        initial: a key of `INITIALISERS`.
        zero_sum: whether its kernels start with a sum of 0, see `zero_sum`.
        gain: factor of the input.
        init_scale: factor of the kernel's initial values.
        padding: zeros around the image: "VALID", none; "SAME", as many as make H' = ceil(H / stride), the odd
            one below and on the right; an int, so many on every side; or ((above, below), (left, right)).
    """

    features: int
    kernel: int
    stride: int
    initial: str = "pytorch"
    zero_sum: bool = False
    gain: float = 1.0
    init_scale: float = 1.0
    padding: Padding = "VALID"

    @nn.compact
    def __call__(self, x: Array) -> Array:
        init, bias_init = INITIALISERS[self.initial](self.kernel**2 * x.shape[-1])
        if self.zero_sum:
            init = zero_sum(init)
        init = scaled(init, self.init_scale)
        kernel = self.weights("kernel", init, (self.kernel, self.kernel, x.shape[-1], self.features))
        bias = self.weights("bias", bias_init, (self.features,))
        pads = padding_of(self.padding, x.shape[1:3], self.kernel, self.stride)
        if any(map(any, pads)):
            x = jnp.pad(x, [(0, 0), *pads, (0, 0)])
        return _valid_conv(x, kernel * self.gain, self.stride) + bias


def padding_of(padding: Padding, sides: Sequence[int], kernel: int, stride: int) -> Pads:
    """The zeros ((above, below), (left, right)) that a `Conv.padding` means for an image of sides H and W.

    Raises:
        ValueError: the padding is no such thing.
    """
    if padding == "VALID":
        return (0, 0), (0, 0)
    if padding == "SAME":
        height, width = (max(0, (-(-side // stride) - 1) * stride + kernel - side) for side in sides)
        return (height // 2, height - height // 2), (width // 2, width - width // 2)
    pads = ((padding, padding), (padding, padding)) if isinstance(padding, int) else padding
    if isinstance(pads, str) or [len(pair) for pair in pads] != [2, 2] or min(map(min, pads)) < 0:
        raise ValueError(f"padding must be VALID, SAME, a number or two pairs of numbers, not {padding!r}")
    return pads


class ConvTranspose(Layer):
    """A transposed convolution as a VALID one: float32 [B, h, w, C] -> [B, *size, features].

    With stride s, output pixel `y * s + r` is `sum_j x[y - j] @ kernel[j * s + r]`: an ordinary convolution
    with ceil(kernel / s) taps and s * s * features channels, followed by depth-to-space. No zero is ever
    multiplied, and its gradient is that of an ordinary convolution.

    Attributes:
        features: output channels.
        kernel: side of the kernel, in pixels; its parameter is [kernel, kernel, C, features].
        stride: the factor by which the image grows.
        size: height and width of the output, in pixels; each less than `stride` above or below
            `(h - 1) * stride + kernel`, less the padding: what the mirrored layer saw, which may have left
            out the last rows and columns (PyTorch's output padding: the bias alone is there) or have had
            zeros below them (they are cut off).
        initial: a key of `INITIALISERS`.
        init_scale: factor of the kernel's initial values.
        padding: the zeros around the mirrored layer's input, which are cut off.
    """

    features: int
    kernel: int
    stride: int
    size: tuple[int, int]
    initial: str = "pytorch"
    init_scale: float = 1.0
    padding: Pads = ((0, 0), (0, 0))

    @nn.compact
    def __call__(self, x: Array) -> Array:
        k, s, channels = self.kernel, self.stride, x.shape[-1]
        for wanted, given, pads in zip(self.size, x.shape[1:3], self.padding, strict=True):
            if not abs(wanted - ((given - 1) * s + k - sum(pads))) < s:
                raise ValueError(f"a kernel of {k} with stride {s} cannot make {wanted} pixels from {given}")
        fan_in = max(1, k // s) ** 2 * channels  # the inputs that reach an output pixel
        init, bias_init = INITIALISERS[self.initial](fan_in)
        kernel = self.weights("kernel", scaled(init, self.init_scale), (k, k, channels, self.features))
        bias = self.weights("bias", bias_init, (self.features,))
        taps = -(-k // s)
        kernel = jnp.pad(kernel, [(0, taps * s - k)] * 2 + [(0, 0)] * 2)
        kernel = kernel.reshape(taps, s, taps, s, channels, self.features)[::-1, :, ::-1]
        kernel = kernel.transpose(0, 2, 4, 1, 3, 5).reshape(taps, taps, channels, -1)
        x = _full_conv(x, kernel)
        batch, rows, columns, _ = x.shape
        x = x.reshape(batch, rows, columns, s, s, self.features).transpose(0, 1, 3, 2, 4, 5)
        x = x.reshape(batch, rows * s, columns * s, self.features)
        (above, _), (left, _) = self.padding
        return _fitted(x[:, above:, left:], self.size) + bias


def _valid_conv(x: Array, kernel: Array, stride: int) -> Array:
    """A VALID convolution of [B, H, W, C] with [k, k, C, features], as one of stride 1.

    With stride s it is a convolution over blocks of s x s pixels, whose pixels are channels
    (space-to-depth). A kernel that is no multiple of s is padded with zeros. Three times as fast on a CPU,
    and its gradients are those of ordinary convolutions. Windows that neither overlap nor leave pixels out,
    k = s, are a product of their numbers and the kernel; of bytes, a convolution of stride s is as fast.
    """
    k, channels, of_bytes = kernel.shape[0], x.shape[-1], x.dtype == jnp.uint8
    if stride > 1 and k == stride and of_bytes:
        return _conv(x.astype(jnp.float32), kernel, stride=stride)
    if stride > 1:
        taps = -(-k // stride)
        x = _fitted(x, [((side - k) // stride + taps) * stride for side in x.shape[1:3]])
        x = _blocks_of_bytes(x, stride) if of_bytes else _blocks(x, stride)
        kernel = jnp.pad(kernel, [(0, taps * stride - k)] * 2 + [(0, 0)] * 2)
        kernel = kernel.reshape(taps, stride, taps, stride, channels, -1)
        kernel = kernel.transpose((0, 2, 4, 1, 3, 5) if of_bytes else (0, 2, 1, 3, 4, 5))
        kernel = kernel.reshape(taps, taps, stride * stride * channels, -1)
        if taps == 1:
            return x @ kernel[0, 0]
    return _conv(x.astype(jnp.float32), kernel)


def _conv(x: Array, kernel: Array, padding: int = 0, stride: int = 1) -> Array:
    """A convolution of [B, H, W, C] with [k, k, C, features], zeros around the image."""
    pads = [(padding, padding)] * 2
    layout = ("NHWC", "HWIO", "NHWC")
    return jax.lax.conv_general_dilated(x, kernel, (stride, stride), pads, dimension_numbers=layout)


def _padded(x: Array, kernel: Array) -> Array:
    """The image with as many zeros around it as let every tap of the kernel see its every pixel."""
    return jnp.pad(x, [(0, 0)] + [(len(kernel) - 1, len(kernel) - 1)] * 2 + [(0, 0)])


@jax.custom_jvp
def _full_conv(x: Array, kernel: Array) -> Array:
    """The convolution of `_padded`.

    The padding is explicit where the kernel is differentiated, as XLA wants it. It is the convolution's own
    where the image is, whose gradient would otherwise be computed for the zeros as well: 24 % more of it
    for 35 x 35 pixels and a kernel of 3 x 3.
    """
    return _conv(_padded(x, kernel), kernel)


@partial(_full_conv.defjvp, symbolic_zeros=True)
def _full_conv_jvp(primals, tangents):
    (x, kernel), (x_dot, kernel_dot) = primals, tangents
    padded = _padded(x, kernel)
    y = _conv(padded, kernel)
    y_dot = jnp.zeros_like(y)
    if not isinstance(x_dot, SymbolicZero):
        y_dot += _conv(x_dot, kernel, len(kernel) - 1)
    if not isinstance(kernel_dot, SymbolicZero):
        y_dot += _conv(padded, kernel_dot)
    return y, y_dot


def _fitted(x: Array, size: Sequence[int]) -> Array:
    """[B, H, W, C] cut or padded with zeros, below and on the right, to [B, *size, C]."""
    height, width = size
    x = x[:, :height, :width]
    return jnp.pad(x, [(0, 0), (0, height - x.shape[1]), (0, width - x.shape[2]), (0, 0)])


def _blocks(x: Array, s: int) -> Array:
    """[B, H, W, C] -> [B, H / s, W / s, s * s * C]; channels stay together."""
    batch, height, width, channels = x.shape
    x = x.reshape(batch, height // s, s, width // s, s, channels).transpose(0, 1, 3, 2, 4, 5)
    return x.reshape(batch, height // s, width // s, s * s * channels)


def _blocks_of_bytes(x: Array, s: int) -> Array:
    """uint8 [B, H, W, C] -> uint8 [B, H / s, W / s, C * s * s]; the pixels of a row stay together.

    Grey frames come from replay as [B, C, H, W], so those pixels are neighbours there, and moving them as one
    word of 2 or 4 bytes makes XLA's loop over an image ten times as fast on a CPU.
    """
    batch, height, width, channels = x.shape
    x = jnp.moveaxis(x, -1, 1).reshape(batch, channels, height // s, s, width // s, s)
    size = next(n for n in (4, 2, 1) if s % n == 0)
    word = {4: jnp.uint32, 2: jnp.uint16, 1: jnp.uint8}[size]
    if size > 1:
        x = jax.lax.bitcast_convert_type(x.reshape(*x.shape[:-1], s // size, size), word)
    else:
        x = x[..., None]
    x = x.reshape(*x.shape[:5], -1)  # [B, C, rows of blocks, s, blocks of a row, words of a block's row]
    x = x.transpose(0, 2, 4, 1, 3, 5)
    if size > 1:
        x = jax.lax.bitcast_convert_type(x, jnp.uint8)
    return x.reshape(batch, height // s, width // s, channels * s * s)
