"""Layers that flax lacks, or whose gradient XLA's CPU backend computes badly.

Convolutions here are VALID convolutions over explicitly padded inputs. XLA's CPU backend differentiates a
transposed, dilated or internally padded convolution with respect to its kernel on a naive path, ten times
slower than the same layer written as a pad and a VALID convolution.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, TypeAlias

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax.errors import ScopeParamShapeError
from jax import Array
from jax.custom_derivatives import SymbolicZero

Pads: TypeAlias = tuple[tuple[int, int], tuple[int, int]]
"""Zeros around an image: ((above, below), (left, right))."""
Padding: TypeAlias = str | int | Pads
"""See `Conv.padding`."""
MIN_RANGE = 1e-5
"""The least that `min_max` divides by."""
FEW_ROWS = 16
"""A noisy layer of no more rows multiplies by mu and by sigma, and does not write down their noisy sum."""


def functions(network: nn.Module, *shapes: tuple[int, ...]) -> tuple[Callable[[Array], Any], Callable]:
    """A module's functions: key -> params, and (params, *inputs) -> output.

    Args:
        network: of which all variables are parameters.
        shapes: of its inputs, float32, one by one; `apply` may be given more.
    """

    def init(key: Array) -> Any:
        examples = (jnp.zeros(shape, jnp.float32) for shape in shapes)
        return network.init(key, *examples).get("params", {})

    def apply(params: Any, *inputs: Any) -> Any:
        return network.apply({"params": params}, *inputs)

    return init, apply


def uniform_fan_in(fan_in: int):
    """An initialiser: U(-1/sqrt(fan_in), 1/sqrt(fan_in)), for kernels and biases alike.

    PyTorch's default for linear and convolutional layers, which the thesis ran with, and dqn_zoo's.
    """
    bound = 1.0 / math.sqrt(fan_in)

    def init(key, shape, dtype=jnp.float32):
        return jax.random.uniform(key, shape, dtype, -bound, bound)

    return init


def he_normal(fan_in: float):
    """An initialiser: a normal of variance 2 / fan_in, truncated at two deviations; for kernels below a ReLU.

    It keeps the size of a signal through convolutions and ReLU (He et al. 2015, equation 10). PyTorch's
    default shrinks it 2.4 times a layer.
    """
    std = math.sqrt(2.0 / fan_in)

    def init(key, shape, dtype=jnp.float32):
        # 0.88 is the standard deviation of the standard normal truncated at 2.
        return std / 0.8796 * jax.random.truncated_normal(key, -2.0, 2.0, shape, dtype)

    return init


def xavier_uniform(fan_in: float):
    """An initialiser: U(-b, b), b = sqrt(6 / (fan_in + fan_out)), for kernels [..., inputs, features].

    Glorot and Bengio (2010), equation 16; what Dopamine has, as flax computes it: `fan_out` is to `fan_in` as
    features are to inputs.
    """

    def init(key, shape, dtype=jnp.float32):
        bound = math.sqrt(6.0 / (fan_in * (1.0 + shape[-1] / shape[-2])))
        return jax.random.uniform(key, shape, dtype, -bound, bound)

    return init


def orthogonal(fan_in: float):
    """An initialiser: kernels [..., features] whose columns are orthogonal, with he_normal's variance.

    A kernel is a matrix [inputs of a feature, features]; where it has more columns than rows, its rows are
    orthogonal (Saxe et al. 2014). Where all its inputs reach an output, `fan_in` of them, the gain is
    sqrt(2), for kernels below a ReLU.
    """

    def init(key, shape, dtype=jnp.float32):
        gain = math.sqrt(2.0 * math.prod(shape[:-1]) / fan_in)
        return nn.initializers.orthogonal(gain)(key, shape, dtype)

    return init


def zeros(key: Array, shape: tuple, dtype=jnp.float32) -> Array:
    """An initialiser: 0. flax's own is float64 where jax may use 64 bits."""
    return jnp.zeros(shape, dtype)


INITIALISERS = {
    "pytorch": lambda fan_in: (uniform_fan_in(fan_in), uniform_fan_in(fan_in)),
    "he": lambda fan_in: (he_normal(fan_in), zeros),
    "xavier": lambda fan_in: (xavier_uniform(fan_in), zeros),
    "orthogonal": lambda fan_in: (orthogonal(fan_in), zeros),
}
"""{name: fan_in -> (the initialiser of a layer's kernel, that of its bias)}."""


def zero_sum(init):
    """Another initialiser's kernels [k, k, C, features], less the mean of each k x k window.

    A uniform image then gives 0, as with edge detectors. Most of a frame is background; with kernels that
    answer to it, the background alone settles which units are on, and a network whose units do not switch is
    linear. Over 240 frames of Pong, 6 to 9 % of the latents of `nature` are on in some frames and off in
    others without this, 64 to 67 % with it (two seeds).
    """

    def centred(key, shape, dtype=jnp.float32):
        kernel = init(key, shape, dtype)
        return kernel - jnp.mean(kernel, (0, 1), keepdims=True)

    return centred


def scaled(init, factor: float):
    """Another initialiser's values, multiplied."""
    return lambda key, shape, dtype=jnp.float32: factor * init(key, shape, dtype)


def min_max(z: Array) -> Array:
    """Latents moved and scaled into [0, 1], each by its own range: float32 [..., D] -> [..., D] (SPR's code).

    A constant becomes 0.
    """
    low = jnp.min(z, -1, keepdims=True)
    return (z - low) / jnp.maximum(jnp.max(z, -1, keepdims=True) - low, MIN_RANGE)


def sim_norm(z: Array, group: int) -> Array:
    """Softmax over each `group` neighbouring numbers: float32 [..., D] -> [..., D], D a multiple of `group`.

    Simplicial normalisation (Lavoie et al. 2023; Hansen et al. 2024, TD-MPC2, equation 5).
    """
    return nn.softmax(z.reshape(*z.shape[:-1], -1, group)).reshape(z.shape)


class Layer(nn.Module):
    """A layer whose weights are [shape], float32."""

    def weights(self, name: str, init: Callable[..., Array], shape: tuple[int, ...]) -> Array:
        """As `self.param`, which would trace the initialiser wherever the layer is applied, a quarter of what
        tracing an update takes.

        Raises:
            flax.errors.ScopeParamShapeError: the weights that are given have another shape.
        """
        if not self.has_variable("params", name):
            return self.param(name, init, shape)
        value: Array = self.get_variable("params", name)
        if jnp.shape(value) != shape:
            raise ScopeParamShapeError(name, "/".join(self.path), jnp.shape(value), shape)
        return value


class Dense(Layer):
    """A linear layer, float32 [B, inputs] -> [B, features].

    Attributes:
        features: outputs.
        initial: a key of `INITIALISERS`.
    """

    features: int
    initial: str = "pytorch"

    @nn.compact
    def __call__(self, x: Array) -> Array:
        init, bias_init = INITIALISERS[self.initial](x.shape[-1])
        kernel = self.weights("kernel", init, (x.shape[-1], self.features))
        bias = self.weights("bias", bias_init, (self.features,))
        return x @ kernel + bias


class WideDense(Layer):
    """`Dense` for far more outputs than inputs; its kernel is [features, inputs], as PyTorch has it.

    The product that gives the inputs' gradient then runs along the rows of a kernel that may have 10M
    numbers. The bias is added as a product with ones, whose gradient is one, too: as a sum over the batch
    it takes YNNPACK 7 ms with two threads for 32 x 39,200 numbers, and 0.1 ms as a product.
    """

    features: int

    @nn.compact
    def __call__(self, x: Array) -> Array:
        inputs = x.shape[-1]
        init = uniform_fan_in(inputs)
        kernel = self.weights("kernel", init, (self.features, inputs))
        bias = self.weights("bias", init, (self.features,))
        return x @ kernel.T + jnp.ones((x.shape[0], 1), x.dtype) @ bias[None, :]


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


def factorised_noise(key: Array, size: int) -> Array:
    """f(e) = sign(e) sqrt(|e|) of standard normal e, float32 [size] (Fortunato et al. 2018, equation 11)."""
    noise = jax.random.normal(key, (size,), jnp.float32)
    noise = jnp.sign(noise) * jnp.sqrt(jnp.abs(noise))
    if not size:
        return noise
    # A branch, or XLA would compute the noise anew for every weight that it is multiplied with. Always the
    # first one; the other is noise of the same distribution.
    return jax.lax.cond(noise[0] > -100.0, lambda e: e, lambda e: -e, noise)


class NoisyDense(Layer):
    """A linear layer with factorised Gaussian noise on its weights (Fortunato et al. 2018, section 3).

    `y = x (mu + sigma * f(e_in) f(e_out)^T) + mu_b + sigma_b * f(e_out)`. One draw serves the whole batch.
    Without noise the layer acts with its means.

    Attributes:
        features: outputs.
        std: sigma starts as std / sqrt(inputs), the thesis' "noisy std".
        initial: of the means, a key of `INITIALISERS`.
    """

    features: int
    std: float = 0.1
    initial: str = "pytorch"

    @nn.compact
    def __call__(self, x: Array, noise: Array | None) -> Array:
        """float32 [B, inputs], and `factorised_noise` [inputs + features] or None -> [B, features]."""
        inputs = x.shape[-1]
        init, bias_init = INITIALISERS[self.initial](inputs)
        sigma = nn.initializers.constant(self.std / math.sqrt(inputs), jnp.float32)
        kernel = self.weights("kernel", init, (inputs, self.features))
        bias = self.weights("bias", bias_init, (self.features,))
        kernel_sigma = self.weights("kernel_sigma", sigma, (inputs, self.features))
        bias_sigma = self.weights("bias_sigma", sigma, (self.features,))
        if noise is None:
            return x @ kernel + bias
        noise_in, noise_out = noise[:inputs], noise[inputs:]
        bias = bias + bias_sigma * noise_out
        if x.shape[0] <= FEW_ROWS:
            return x @ kernel + ((x * noise_in) @ kernel_sigma) * noise_out + bias
        return x @ (kernel + kernel_sigma * (noise_in[:, None] * noise_out[None, :])) + bias


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
