"""srl_jax.layers against plain jax, and numbers worked by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax.errors import ScopeParamShapeError

from srl_jax import layers
from srl_jax.layers import Conv, ConvTranspose, Dense, NoisyDense, WideDense, dense, initialisers


def transposed(x, kernel, bias, stride, size):
    """The textbook: zeros between the pixels, a flipped kernel, and padding up to the wanted size."""
    k = kernel.shape[0]
    pads = [(k - 1, k - 1 + to - ((n - 1) * stride + k)) for n, to in zip(x.shape[1:3], size, strict=True)]
    return bias + jax.lax.conv_general_dilated(
        x, kernel[::-1, ::-1], (1, 1), pads, lhs_dilation=(stride, stride),
        dimension_numbers=("NHWC", "HWIO", "NHWC"), precision="highest",
    )  # fmt: skip


@pytest.mark.parametrize("dtype", [np.float32, np.uint8])
@pytest.mark.parametrize(
    ("kernel", "stride", "height"),
    [
        (3, 1, 7),
        (4, 2, 8),
        (8, 4, 84 // 4),  # 21 pixels, of which the last is not seen
        (3, 2, 9),  # a kernel that is no multiple of its stride
        (3, 2, 10),
        (6, 4, 14),
        (3, 3, 9),  # no word of 2 or 4 bytes fits a row of 3
        (2, 3, 8),  # a kernel smaller than its stride
        (8, 8, 16),
    ],
)
def test_conv_is_the_plain_convolution_in_values_and_gradients(kernel, stride, height, dtype):
    rng = np.random.default_rng(0)
    x = rng.integers(0, 256, (2, height, height, 3)).astype(dtype)
    layer = Conv(5, kernel, stride, gain=0.5)
    params = {
        "kernel": rng.normal(size=(kernel, kernel, 3, 5)).astype(np.float32),
        "bias": rng.normal(size=5).astype(np.float32),
    }
    side = (height - kernel) // stride + 1
    cotangent = rng.normal(size=(2, side, side, 5)).astype(np.float32)

    def plain(params, x):
        return params["bias"] + jax.lax.conv_general_dilated(
            0.5 * x, params["kernel"], (stride, stride), "VALID",
            dimension_numbers=("NHWC", "HWIO", "NHWC"), precision="highest",
        )  # fmt: skip

    @jax.jit
    def both(params, x):
        def of(f):
            if dtype == np.uint8:
                y, pull = jax.vjp(lambda p: f(p, x), params)
            else:
                y, pull = jax.vjp(f, params, x)
            return y, pull(cotangent)

        ours = of(lambda p, x: layer.apply({"params": p}, x))
        return ours, of(lambda p, x: plain(p, x.astype(jnp.float32)))

    ours, theirs = both(params, x)
    assert ours[0].shape == cotangent.shape
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=2e-2), ours, theirs)


@pytest.mark.parametrize("dtype", [np.float32, np.uint8])
@pytest.mark.parametrize(
    ("kernel", "stride", "shape", "padding"),
    [
        (3, 1, (5, 6), "SAME"),
        (3, 2, (6, 7), "SAME"),  # the odd zero is below and on the right
        (4, 2, (7, 6), "SAME"),
        (8, 4, (16, 21), "SAME"),
        (2, 3, (6, 8), "SAME"),  # nothing is missing
        (3, 2, (6, 9), 2),
        (4, 2, (7, 9), ((0, 1), (2, 0))),
        (4, 2, (8, 11), "VALID"),
    ],
)
def test_conv_pads_as_jax_does(kernel, stride, shape, padding, dtype):
    rng = np.random.default_rng(0)
    x = rng.integers(0, 256, (2, *shape, 3)).astype(dtype)
    params = {
        "kernel": rng.normal(size=(kernel, kernel, 3, 5)).astype(np.float32),
        "bias": rng.normal(size=5).astype(np.float32),
    }

    pads = [(2, 2)] * 2 if padding == 2 else padding

    @jax.jit
    def both(params, x):
        theirs = params["bias"] + jax.lax.conv_general_dilated(
            x.astype(np.float32), params["kernel"], (stride, stride), pads,
            dimension_numbers=("NHWC", "HWIO", "NHWC"), precision="highest",
        )  # fmt: skip
        return Conv(5, kernel, stride, padding=padding).apply({"params": params}, x), theirs

    np.testing.assert_allclose(*both(params, x), rtol=1e-4, atol=2e-2)


@pytest.mark.parametrize("padding", ["same", -1, ((0, 1),), ((0, 1), (0, -1))])
def test_conv_refuses_other_padding(padding):
    with pytest.raises(ValueError, match="padding must be VALID, SAME,"):
        layers.padding_of(padding, (7, 7), 3, 2)


@pytest.mark.parametrize(
    ("kernel", "stride", "shape", "size"),
    [
        (3, 1, (5, 5), (7, 7)),
        (4, 2, (3, 3), (8, 8)),
        (3, 2, (4, 4), (9, 9)),
        (3, 2, (4, 4), (10, 10)),  # one row and column that no kernel reaches: the bias alone
        (8, 4, (3, 3), (19, 19)),
        (6, 4, (4, 4), (20, 20)),
        (6, 4, (4, 3), (15, 17)),  # rows that are cut off, columns that no kernel reaches
        (2, 3, (3, 3), (9, 9)),  # a kernel smaller than its stride: gaps
        (1, 1, (4, 4), (4, 4)),
    ],
)
def test_conv_transpose_is_the_dilated_convolution_in_values_and_gradients(kernel, stride, shape, size):
    layer = ConvTranspose(5, kernel, stride, size)
    rng = np.random.default_rng(0)
    x = rng.normal(size=(2, *shape, 3)).astype(np.float32)
    cotangent = rng.normal(size=(2, *size, 5)).astype(np.float32)
    params = {
        "kernel": rng.normal(size=(kernel, kernel, 3, 5)).astype(np.float32),
        "bias": rng.normal(size=5).astype(np.float32),
    }

    @jax.jit
    def both(params, x):
        ours, pull = jax.vjp(lambda p, x: layer.apply({"params": p}, x), params, x)
        reference = lambda p, x: transposed(x, p["kernel"], p["bias"], stride, size)  # noqa: E731
        theirs, reference_pull = jax.vjp(reference, params, x)
        return (ours, pull(cotangent)), (theirs, reference_pull(cotangent))

    ours, theirs = both(params, x)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4), ours, theirs)


def test_conv_transpose_in_forward_mode():
    # Its rule is written by hand, so that either tangent alone and both together need a look.
    layer = ConvTranspose(5, 3, 1, (7, 7))
    rng = np.random.default_rng(0)
    x, x_dot = rng.normal(size=(2, 2, 5, 5, 3)).astype(np.float32)
    kernel, kernel_dot = rng.normal(size=(2, 3, 3, 3, 5)).astype(np.float32)
    bias = np.zeros(5, np.float32)

    @jax.jit
    def tangents(x, x_dot, kernel, kernel_dot):
        def of(f):
            both = jax.jvp(f, (kernel, x), (kernel_dot, x_dot))[1]
            of_kernel = jax.jvp(lambda k: f(k, x), (kernel,), (kernel_dot,))[1]
            return both, of_kernel, jax.jvp(lambda x: f(kernel, x), (x,), (x_dot,))[1]

        ours = of(lambda kernel, x: layer.apply({"params": {"kernel": kernel, "bias": bias}}, x))
        return ours, of(lambda kernel, x: transposed(x, kernel, bias, 1, (7, 7)))

    ours, theirs = tangents(x, x_dot, kernel, kernel_dot)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4), ours, theirs)


def test_wide_dense_is_dense_with_a_transposed_kernel_in_values_and_gradients():
    rng = np.random.default_rng(0)
    x, cotangent = rng.normal(size=(6, 3)).astype(np.float32), rng.normal(size=(6, 40)).astype(np.float32)
    params = {
        "kernel": rng.normal(size=(40, 3)).astype(np.float32),
        "bias": rng.normal(size=40).astype(np.float32),
    }

    @jax.jit
    def both(params, x):
        def of(f):
            y, pull = jax.vjp(f, params, x)
            return y, pull(cotangent)

        plain = lambda p, x: Dense(40).apply({"params": {**p, "kernel": p["kernel"].T}}, x)  # noqa: E731
        return of(lambda p, x: WideDense(40).apply({"params": p}, x)), of(plain)

    ours, theirs = both(params, x)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5), ours, theirs)


def test_conv_transpose_by_hand():
    # Stride 2 and a 2 x 2 kernel: each pixel is multiplied into a block of its own. Size 5 leaves a last
    # row and column that no kernel reaches. The bias, 0.5, is everywhere.
    x = np.array([[1.0, 2.0], [3.0, 4.0]], np.float32)[None, :, :, None]
    kernel = np.array([[1.0, 10.0], [100.0, 1000.0]], np.float32)[:, :, None, None]
    layer = ConvTranspose(1, 2, 2, (5, 5))
    y = jax.jit(layer.apply)({"params": {"kernel": kernel, "bias": np.array([0.5], np.float32)}}, x)
    expected = [
        [1, 10, 2, 20, 0],
        [100, 1000, 200, 2000, 0],
        [3, 30, 4, 40, 0],
        [300, 3000, 400, 4000, 0],
        [0, 0, 0, 0, 0],
    ]
    np.testing.assert_array_equal(y[0, :, :, 0], np.array(expected) + 0.5)


@pytest.mark.parametrize("size", [5, 9])
def test_conv_transpose_refuses_sizes_that_its_mirror_could_not_have_seen(size):
    # (3 - 1) * 2 + 3 = 7; 8 with the pixel that stride 2 drops, 6 with a row of zeros; nothing else.
    layer = ConvTranspose(1, 3, 2, (7, size))
    with pytest.raises(ValueError, match=f"cannot make {size} pixels from 3"):
        jax.eval_shape(layer.init, jax.random.key(0), jnp.zeros((1, 3, 3, 1)))


def test_initialisation_is_uniform_within_one_over_the_root_of_fan_in():
    x = np.asarray(initialisers.uniform_fan_in(25)(jax.random.key(0), (100, 100)))
    assert np.abs(x).max() <= 0.2
    assert np.abs(x).max() > 0.199
    # A uniform distribution on [-b, b] has mean 0 and standard deviation b / sqrt(3).
    assert abs(x.mean()) < 0.01
    np.testing.assert_allclose(x.std(), 0.2 / np.sqrt(3), rtol=0.02)


def test_he_normal_keeps_the_size_of_a_signal():
    # Variance 2 / 50 = 0.2 ** 2; truncated at two deviations of the normal that is cut: 2 * 0.2 / 0.8796.
    x = np.asarray(initialisers.he_normal(50)(jax.random.key(0), (100, 100)))
    np.testing.assert_allclose(x.std(), 0.2, rtol=0.02)
    assert abs(x.mean()) < 0.01 and 0.45 < np.abs(x).max() <= 0.4548


def test_xavier_uniform_is_flaxs():
    # 3 * 3 * 4 = 36 inputs and 3 * 3 * 20 = 180 outputs: b = sqrt(6 / 216) = 1/6.
    x = np.asarray(initialisers.xavier_uniform(36)(jax.random.key(0), (3, 3, 4, 20)))
    assert 0.16 < np.abs(x).max() <= 1 / 6
    assert x.std() == pytest.approx(1 / 6 / np.sqrt(3), rel=0.1)
    flaxs = jax.nn.initializers.xavier_uniform()(jax.random.key(0), (3, 3, 4, 20), np.float32)
    np.testing.assert_allclose(x, flaxs, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("shape", [(3, 3, 4, 20), (2, 2, 3, 30)])  # more rows than columns, and fewer
def test_orthogonal_kernels_are_orthogonal(shape):
    inputs, outputs = int(np.prod(shape[:-1])), shape[-1]
    x = np.asarray(initialisers.orthogonal(inputs)(jax.random.key(0), shape)).reshape(inputs, outputs)
    product = x.T @ x if inputs > outputs else x @ x.T
    np.testing.assert_allclose(product, 2 * np.eye(min(inputs, outputs)), atol=1e-5)
    # Where a quarter of the inputs reaches an output, as through strides of 2, a signal keeps its size, too.
    y = np.asarray(initialisers.orthogonal(inputs / 4)(jax.random.key(0), shape)).reshape(inputs, outputs)
    np.testing.assert_allclose(y, 2 * x, rtol=1e-5, atol=1e-7)


def test_every_layer_knows_its_fan_in(monkeypatch):
    fans = []
    record = lambda n: fans.append(n) or initialisers.zeros  # noqa: E731
    monkeypatch.setattr(dense, "uniform_fan_in", record)
    monkeypatch.setitem(layers.INITIALISERS, "pytorch", lambda n: (record(n), initialisers.zeros))
    cases = [
        (Dense(7), (1, 25), 25),
        (WideDense(7), (1, 25), 25),
        (NoisyDense(7), (1, 25), 25),
        (Conv(6, 3, 1), (1, 5, 5, 4), 3 * 3 * 4),
        (ConvTranspose(6, 3, 1, (7, 7)), (1, 5, 5, 4), 3 * 3 * 4),
        (ConvTranspose(6, 8, 4, (24, 24)), (1, 5, 5, 4), 2 * 2 * 4),  # an output pixel sees 8 / 4 = 2 a side
    ]
    for layer, shape, fan_in in cases:
        arguments = [None] if isinstance(layer, NoisyDense) else []
        jax.eval_shape(layer.init, jax.random.key(0), jnp.zeros(shape), *arguments)
        assert fans.pop() == fan_in and not fans


def test_a_convolution_starts_as_asked():
    def start(**options):
        return jax.jit(Conv(64, 5, 1, **options).init)(jax.random.key(0), jnp.zeros((1, 5, 5, 4)))["params"]

    # PyTorch's default, U(-1/sqrt(fan_in), 1/sqrt(fan_in)), with 5 * 5 * 4 = 100 inputs.
    textbook, he, centred = start(), start(initial="he"), start(zero_sum=True)
    for leaf in (textbook["kernel"], textbook["bias"]):
        assert 0.09 < np.abs(leaf).max() <= 0.1
    np.testing.assert_allclose(textbook["kernel"].std(), 0.1 / 3**0.5, rtol=0.03)
    np.testing.assert_allclose(he["kernel"].std(), (2 / 100) ** 0.5, rtol=0.03)
    assert not he["bias"].any() and np.abs(textbook["kernel"].sum((0, 1))).max() > 0.1
    assert np.abs(centred["kernel"].sum((0, 1))).max() < 1e-6


@pytest.mark.parametrize("layer", [Dense, NoisyDense])
def test_a_linear_layer_starts_as_asked(layer):
    more = [None] if layer is NoisyDense else []
    init = jax.jit(layer(20, initial="xavier").init)
    params = init(jax.random.key(0), jnp.zeros((1, 30)), *more)["params"]
    bound = (6 / (30 + 20)) ** 0.5
    assert 0.98 * bound < np.abs(params["kernel"]).max() <= bound and not params["bias"].any()


def test_init_scale_multiplies_the_kernel():
    x = jnp.zeros((1, 3, 3, 2))
    whole, tenth = (
        jax.jit(ConvTranspose(4, 4, 2, (8, 8), "he", scale).init)(jax.random.key(0), x)["params"]
        for scale in (1.0, 0.1)
    )
    np.testing.assert_allclose(tenth["kernel"], 0.1 * whole["kernel"], rtol=1e-5)
    assert np.abs(whole["kernel"]).max() > 0.3


def test_zero_sum_takes_each_windows_mean():
    def init(key, shape, dtype):
        return jnp.arange(8.0, dtype=dtype).reshape(shape)

    # Values 0..7 in order [2, 2, 2, 1]: channel 0 has 0, 2, 4, 6 (mean 3), channel 1 has 1, 3, 5, 7 (mean 4).
    kernel = initialisers.zero_sum(init)(None, (2, 2, 2, 1))
    np.testing.assert_array_equal(kernel.reshape(4, 2), [[-3, -3], [-1, -1], [1, 1], [3, 3]])


def test_noisy_dense_by_hand():
    # Two inputs, one output; f(e_in) = (2, -3) and f(e_out) = 0.5.
    # Weights 1 + 0.1 * 2 * 0.5 = 1.1 and 2 + 0.2 * -3 * 0.5 = 1.7; bias 3 + 0.4 * 0.5 = 3.2.
    params = {
        "kernel": np.array([[1.0], [2.0]]), "kernel_sigma": np.array([[0.1], [0.2]]),
        "bias": np.array([3.0]), "bias_sigma": np.array([0.4]),
    }  # fmt: skip
    params = jax.tree.map(np.float32, params)
    apply = jax.jit(lambda x, noise: NoisyDense(1).apply({"params": params}, x, noise))
    x = np.array([[1, 0], [0, 1], [10, 1]], np.float32)
    y = apply(x, np.array([2, -3, 0.5], np.float32))
    np.testing.assert_allclose(y[:, 0], [1.1 + 3.2, 1.7 + 3.2, 11 + 1.7 + 3.2], rtol=1e-6)
    # Without noise the means.
    np.testing.assert_allclose(apply(x, None)[:, 0], [4, 5, 15], rtol=1e-6)


def test_noisy_dense_is_the_same_for_few_and_for_many_rows():
    # Two forms of one sum: few rows are multiplied by mu and by sigma, many by their noisy sum.
    rng = np.random.default_rng(0)
    few, many = (rng.normal(size=(n, 30)).astype(np.float32) for n in (dense.FEW_ROWS, dense.FEW_ROWS + 1))
    many[:-1] = few
    f = rng.normal(size=50).astype(np.float32)
    layer = NoisyDense(20, 2.0)
    params = layer.init(jax.random.key(0), few, None)["params"]

    @jax.jit
    def run(x, cotangent):
        y, pull = jax.vjp(lambda p, x: layer.apply({"params": p}, x, f), params, x)
        return y, pull(cotangent)

    cotangent = rng.normal(size=(len(many), 20)).astype(np.float32)
    cotangent[-1] = 0
    (y, (grads, dx)), (z, (other_grads, dz)) = run(few, cotangent[:-1]), run(many, cotangent)
    close = dict(rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(y, z[:-1], **close)
    np.testing.assert_allclose(dx, dz[:-1], **close)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, **close), grads, other_grads)


def test_factorised_noise_by_definition():
    key = jax.random.key(2)
    e = np.asarray(jax.random.normal(key, (1000,)))
    f = np.asarray(jax.jit(layers.factorised_noise, static_argnums=1)(key, 1000))
    np.testing.assert_allclose(f, np.sign(e) * np.sqrt(np.abs(e)), rtol=1e-5)
    assert jax.jit(layers.factorised_noise, static_argnums=1)(key, 0).shape == (0,)


def test_noisy_dense_noise_is_one_outer_product_in_the_size_of_its_sigmas():
    inputs, outputs, std = 30, 20, 0.4
    layer = NoisyDense(outputs, std)
    params = layer.init(jax.random.key(1), jnp.zeros((1, inputs)), None)["params"]
    sigma = std / np.sqrt(inputs)
    np.testing.assert_allclose(params["kernel_sigma"], np.full((inputs, outputs), sigma), rtol=1e-6)
    np.testing.assert_allclose(params["bias_sigma"], np.full(outputs, sigma), rtol=1e-6)

    # The weights that act, read off by probing: zero shows the bias, the unit vectors the kernel.
    probe = np.concatenate([np.zeros((1, inputs)), np.eye(inputs)]).astype(np.float32)
    e = np.random.default_rng(0).normal(size=inputs + outputs).astype(np.float32)
    f = np.sign(e) * np.sqrt(np.abs(e))
    y = np.asarray(jax.jit(layer.apply)({"params": params}, probe, f), np.float64)
    np.testing.assert_allclose((y[0] - params["bias"]) / sigma, f[inputs:], atol=1e-4)
    noise = (y[1:] - y[0] - params["kernel"]) / sigma
    np.testing.assert_allclose(noise, np.outer(f[:inputs], f[inputs:]), atol=1e-4)


def test_a_layer_is_applied_without_its_initialiser_and_refuses_weights_of_another_shape(monkeypatch):
    init, apply = layers.functions(Dense(2), (1, 3))
    params = init(jax.random.key(0))

    def initialiser(fan_in):
        return lambda *_: pytest.fail("the initialiser is traced though there are weights")

    monkeypatch.setattr(initialisers, "uniform_fan_in", initialiser)
    expected = np.ones((1, 3)) @ params["kernel"] + params["bias"]
    np.testing.assert_allclose(apply(params, jnp.ones((1, 3))), expected, rtol=1e-6)
    with pytest.raises(ScopeParamShapeError, match="kernel"):
        apply(params, jnp.ones((1, 4)))
