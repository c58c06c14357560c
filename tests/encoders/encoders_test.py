"""srl_jax/encoders: sizes against the thesis, mirrors, and what goes in."""

import re

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from srl_jax import encoders, specs
from srl_jax.encoders.convolutional import Layer, layer_sides
from srl_jax.encoders.impala import doubled, halved
from srl_jax.encoders.options import ENDS, End, Latent
from srl_jax.layers import Conv, ConvTranspose, sim_norm
from srl_jax.window import to_unit
from tests.helpers import STACK, count, identical, random_params


@pytest.mark.parametrize(
    ("name", "options", "features", "number"),
    [
        # 8*8*4*32 + 32 = 8,224;  4*4*32*64 + 64 = 32,832;  3*3*64*64 + 64 = 36,928.
        ("nature", {}, 3136, 77_984),
        # 3*3*4*32 + 32 = 1,184;  3 * (3*3*32*32 + 32) = 27,744.  84 -> 41 -> 39 -> 37 -> 35 pixels, so
        # 35*35*32 = 39,200 numbers: 39,200 * 256 + 256 = 10,035,456.  LayerNorm 2 * 256 = 512.
        ("sac_ae", {"features": 256}, 256, 10_064_896),
        # 28,928 as above;  39,200 * 50 + 50 = 1,960,050;  LayerNorm 100.
        ("sac_ae", {"features": 50}, 50, 1_989_078),
        ("sac_ae", {"features": 50, "layer_norm": False}, 50, 1_988_978),
        ("sac_ae", {"features": 50, "end": "tanh"}, 50, 1_988_978),
        # Dopamine's: 84 -> 21 -> 11 -> 11 pixels, 11*11*64 numbers, the same kernels.
        ("nature", {"padding": "same"}, 7744, 77_984),
        # 64 + 64 numbers of LayerNorm behind the means of 64 maps, and behind a linear layer 10 + 10.
        ("nature", {"pool": "average", "end": "layer_norm"}, 64, 77_984 + 128),
        ("nature", {"pool": "average", "features": 10, "end": "layer_norm"}, 10, 77_984 + 650 + 20),
        # 5*5*4*32 + 32 = 3,232;  5*5*32*64 + 64 = 51,264.  84 -> 16 -> 3 pixels: 3*3*64 numbers.
        ("der", {}, 576, 54_496),
        # 1,184 + 2 * 9,248 as above.  84 -> 41 -> 39 -> 37 pixels: 37*37*32 = 43,808 numbers.
        ("a_lix", {}, 50, 1_184 + 2 * 9_248 + 43_808 * 50 + 50),
        ("a_lix", {"lix": 1.0}, 50, 1_184 + 2 * 9_248 + 43_808 * 50 + 50 + 1),
        # 84 -> 41 -> 20 -> 9 -> 7 pixels: 7*7*32 = 1,568 numbers, as the authors' code has written down.
        ("mrq", {}, 512, 1_184 + 3 * 9_248 + 1_568 * 512 + 512 + 1_024),
    ],
)
def test_parameter_counts_and_features_at_84_pixels(name, options, features, number):
    encoder = encoders.REGISTRY[name]((84, 84, 4), **options)
    params = jax.eval_shape(encoder.init, jax.random.key(0))
    assert count(params) == number
    assert encoder.features == features
    assert encoder.observation_shape == (84, 84, 4)
    z = jax.eval_shape(encoder.apply, params, jax.ShapeDtypeStruct((2, 84, 84, 4), jnp.uint8))
    assert (z.shape, z.dtype) == ((2, features), jnp.float32)


SHAPES = [(84, 84, 4), (40, 42, 4), (56, 64, 12), (96, 41, 9), (41, 73, 6)]


@pytest.mark.parametrize(
    ("shape", "extra"), [*((shape, 0) for shape in SHAPES), (SHAPES[0], 6), (SHAPES[-1], 6)]
)
@pytest.mark.parametrize("name", encoders.REGISTRY)
def test_decoders_mirror_their_encoder(name, shape, extra):
    encoder = encoders.REGISTRY[name](shape)
    decoder = encoder.make_decoder(extra)
    params = jax.eval_shape(decoder.init, jax.random.key(0))
    z = jax.ShapeDtypeStruct((2, encoder.features + extra), jnp.float32)
    image = jax.eval_shape(decoder.apply, params, z)
    assert (image.shape, image.dtype) == ((2, *shape), jnp.float32)
    # Layers flipped: the encoder's kernels, with their input and output channels changed over.
    encoder_params = jax.eval_shape(encoder.init, jax.random.key(0))
    kernels = [x.shape for x in jax.tree.leaves(encoder_params) if len(x.shape) == 4]
    mirrored = [x.shape for x in jax.tree.leaves(params) if len(x.shape) == 4]
    if extra and name in ("nature", "der"):  # no bottleneck: the extra inputs are maps of the first layer
        side, outputs = {"nature": (3, 64), "der": (5, 32)}[name]
        mirrored.remove((side, side, 64 + extra, outputs))
        mirrored.append((side, side, 64, outputs))
    assert sorted(kernels) == sorted((h, w, o, i) for h, w, i, o in mirrored)


@pytest.mark.parametrize(
    ("name", "options"),
    [("nature", {"padding": "same"}), ("impala", {"features": 0})]
    + [
        (name, o)
        for name in encoders.REGISTRY
        for o in ({"pool": "average", "features": 0}, {"features": 16})
    ],
)
@pytest.mark.parametrize("shape", [(84, 84, 4), (41, 73, 6)])
def test_decoders_mirror_every_option(name, shape, options):
    encoder = encoders.REGISTRY[name](shape, **options)
    decoder = encoder.make_decoder(3)
    z = jax.ShapeDtypeStruct((2, encoder.features + 3), jnp.float32)
    image = jax.eval_shape(decoder.apply, jax.eval_shape(decoder.init, jax.random.key(0)), z)
    assert image.shape == (2, *shape)
    if "pool" in options:
        flat = encoders.REGISTRY[name](shape, features=0)
        assert (encoder.features, encoder.map_shape) == (flat.map_shape[-1], None)


def test_a_same_decoder_is_the_transposed_encoder():
    # Of linear maps <A x, y> = <x, A^T y>. At 9 pixels a kernel of 4 and stride 2 has one zero above and two
    # below (9 -> 5), which the transposed convolution has to cut off on the right sides.
    padding = ((1, 2), (1, 2))
    rng = np.random.default_rng(0)
    kernel = rng.normal(size=(4, 4, 3, 2)).astype(np.float32)
    x, y = (rng.normal(size=shape).astype(np.float32) for shape in ((1, 9, 9, 3), (1, 5, 5, 2)))
    params = {"kernel": kernel, "bias": np.zeros(2)}
    conv = jax.jit(Conv(2, 4, 2, padding="SAME").apply)({"params": params}, x)
    layer = ConvTranspose(3, 4, 2, (9, 9), padding=padding)
    back = jax.jit(layer.apply)({"params": {"kernel": kernel.transpose(0, 1, 3, 2), "bias": np.zeros(3)}}, y)
    assert conv.shape == y.shape and back.shape == x.shape
    assert float(jnp.sum(conv * y)) == pytest.approx(float(jnp.sum(x * back)), rel=1e-4)


@pytest.mark.parametrize("name", ["nature", "tiny"])  # without and with a bottleneck
def test_extra_inputs_reach_every_image(name):
    encoder = encoders.REGISTRY[name]((84, 84, STACK))
    decoder = encoder.make_decoder(2)
    z = np.random.default_rng(0).normal(size=encoder.features).astype(np.float32)
    inputs = np.concatenate([np.stack([z, z]), np.eye(2, dtype=np.float32)], 1)
    first, second = np.asarray(jax.jit(decoder.apply)(random_params(decoder.init), inputs))
    assert (first != second).any(-1).mean() > 0.9
    if name == "nature":  # ends in a sigmoid
        assert first.min() > 0 and first.max() < 1
    else:  # linear at the end
        assert first.min() < 0


def test_pixels_are_divided_by_255():
    np.testing.assert_allclose(to_unit(jnp.array([0, 51, 255], jnp.uint8)), np.float32([0, 51, 255]) / 255)
    encoder = encoders.tiny((18, 18, STACK), features=8)
    image = np.random.default_rng(0).integers(0, 256, (3, 18, 18, STACK), dtype=np.uint8)
    params = random_params(encoder.init)
    from_bytes, from_unit = (
        jax.jit(encoder.apply)(params, x) for x in (image, image.astype(np.float32) / np.float32(255))
    )
    np.testing.assert_allclose(from_bytes, from_unit, rtol=1e-6, atol=1e-6)


def test_latents_can_start_blind_to_a_uniform_background_and_see_a_ball():
    # Two grey fields, and on Pong's grey a ball of 2 x 4 pixels in 30 places. With kernels that sum to 0 and
    # He's biases of 0 a uniform image gives 0; a ball moves latents by tenths, and switches units on that are
    # off elsewhere. Of the textbook's start none of it is true.
    rng = np.random.default_rng(0)
    frames = np.full((32, 84, 84, STACK), 87, np.uint8)
    frames[1] = 200
    for frame, (y, x) in zip(frames[2:], rng.integers(0, 80, (30, 2)), strict=True):
        frame[y : y + 4, x : x + 2] = 236
    for options, started in (({"init": "he", "zero_sum": True, "gain": 32.0}, True), ({}, False)):
        encoder = encoders.nature((84, 84, STACK), **options)
        z = np.asarray(jax.jit(lambda key, x, e=encoder: e.apply(e.init(key), x))(jax.random.key(0), frames))
        assert np.allclose(z[:2], 0, atol=1e-4) == started
        assert (0.05 < z[2:].std(0).mean() < 2) == started
        on = (z[2:] > 0).mean(0)
        assert (np.mean((on > 0) & (on < 1)) > 0.5) == started


@pytest.mark.parametrize(
    "option",
    [{"init": "hee"}, {"gain": 0.0}, {"decoder_scale": 2e3}, {"end": "softmax"}, {"pool": "max"}]
    + [{"features": -1}, {"end": "sim_norm", "features": 12}],
)
def test_a_start_or_an_end_that_cannot_be_is_refused(option):
    with pytest.raises(ValueError, match=next(iter(option))):
        encoders.tiny((42, 42, STACK), **option)


@pytest.mark.parametrize("row", encoders.REGISTRY)
@pytest.mark.parametrize("shape", [(42, 42), (1, 42, 42, 4), (), (84, 0, 4)])
def test_a_shape_that_is_none_of_an_observation_is_refused(row, shape):
    with pytest.raises(
        ValueError, match=rf"^observation_shape must be \(H, W, S \* C\), not {re.escape(str(shape))}$"
    ):
        encoders.REGISTRY[row](shape)


def test_options_of_one_row_that_cannot_be_are_refused():
    with pytest.raises(ValueError, match="padding: did you mean same"):
        encoders.nature((84, 84, 4), padding="SAME")


class Ended(nn.Module):
    """The latent of maps."""

    latent: Latent

    @nn.compact
    def __call__(self, x):
        return self.latent.encode(x)


LATENTS = {
    # Of 1, 3, 2, -4 and four zeros, which are one group of the softmax.
    "none": [1, 3, 2, -4, 0, 0, 0, 0],
    "relu": [1, 3, 2, 0, 0, 0, 0, 0],
    "tanh": np.tanh([1, 3, 2, -4, 0, 0, 0, 0]),
    "elu": [1, 3, 2, np.exp(-4) - 1, 0, 0, 0, 0],
    "min_max": np.array([5, 7, 6, 0, 4, 4, 4, 4]) / 7,
    "sim_norm": np.exp([1, 3, 2, -4, 0, 0, 0, 0]) / np.sum(np.exp([1, 3, 2, -4, 0, 0, 0, 0])),
    # The mean is 0.25; the squares' is 30 / 8.
    "layer_norm": (np.array([1, 3, 2, -4, 0, 0, 0, 0]) - 0.25) / np.sqrt(30 / 8 - 0.25**2 + 1e-5),
}


@pytest.mark.parametrize("end", ENDS)
def test_ends_by_hand(end):
    # One pixel of four maps: the linear layer passes them on, and four zeros.
    latent = End(end).latent((1, 1, 4), 8)
    params = {"Dense_0": {"kernel": np.eye(4, 8), "bias": np.zeros(8)}}
    if "layer_norm" in ENDS[end]:
        params["LayerNorm_0"] = {"scale": np.ones(8), "bias": np.zeros(8)}
    normed = np.asarray(LATENTS["layer_norm"])
    twice = {"layer_norm_tanh": np.tanh(normed)}
    twice["layer_norm_elu"] = np.where(normed > 0, normed, np.expm1(normed))
    wanted = twice[end] if end in twice else LATENTS[end]
    z = Ended(latent).apply({"params": params}, np.array([1.0, 3, 2, -4]).reshape(1, 1, 1, 4))
    np.testing.assert_allclose(z[0], wanted, atol=1e-5)


def test_average_pooling_is_the_mean_of_each_map():
    latent = End(pool="average").latent((2, 2, 3), 0)
    maps = np.arange(12.0).reshape(1, 2, 2, 3)  # of the first map 0, 3, 6, 9
    assert latent.size == 3 and Ended(latent).apply({}, maps).tolist() == [[4.5, 5.5, 6.5]]


def test_groups_of_eight_are_shares_of_one():
    z = np.random.default_rng(0).normal(size=(3, 24)).astype(np.float32)
    shares = np.asarray(sim_norm(z, 8))
    np.testing.assert_allclose(shares.reshape(3, 3, 8).sum(-1), 1, rtol=1e-6)
    np.testing.assert_allclose(shares[1, 8:16], np.exp(z[1, 8:16]) / np.exp(z[1, 8:16]).sum(), rtol=1e-5)


def test_the_default_end_is_the_papers_behind_a_linear_layer():
    def last(name, **options):
        steps = encoders.REGISTRY[name]((84, 84, 4), **options).steps
        names = [step["step"] for step in steps]
        return names[names.index("flatten") + 1 :]

    assert last("nature") == last("der") == last("tiny", features=0) == last("sac_ae", features=0) == []
    assert last("nature", features=9) == last("a_lix") == ["dense"]
    assert last("sac_ae") == last("tiny") == ["dense", "layer_norm", "tanh"]
    assert last("sac_ae", layer_norm=False) == ["dense", "tanh"]
    assert last("mrq") == ["dense", "layer_norm", "elu"]
    assert last("sac_ae", features=0, end="tanh") == ["tanh"]


def test_specifications_from_before_the_end_was_an_option_mean_the_same():
    old = specs.parse("sac_ae:features=256,layer_norm=true,init=he", encoders.REGISTRY)
    assert old.full == (
        "sac_ae:features=256,layer_norm=true,init=he,zero_sum=false,gain=1.0,decoder_scale=1.0,"
        "end=default,pool=none"
    )
    assert specs.parse(old.full, encoders.REGISTRY).resolved == old.resolved


@pytest.mark.parametrize(
    ("name", "least"),
    [("nature", 29), ("sac_ae", 14), ("tiny", 15), ("der", 21), ("a_lix", 10), ("mrq", 24)],
)
def test_frames_below_the_least_size_of_the_layers_are_refused(name, least):
    # nature needs 3 pixels for its last layer, so 5 for the one before and, with zeros below, 8 + 4 * 5 + 1.
    encoders.REGISTRY[name]((84, least, 4))
    for shape in ((84, least - 1, 4), (least - 1, 84, 4)):
        with pytest.raises(ValueError, match=f"frames of {least - 1} pixels are too small: a kernel of"):
            encoders.REGISTRY[name](shape)


def test_sides_of_layers_by_hand():
    layers = [Layer(32, 8, 4), Layer(64, 4, 2), Layer(64, 3, 1)]
    assert layer_sides(84, layers) == [84, 20, 9, 7]  # all fit
    # 96 - 8 is 22 strides. 23 - 4 is 9 and a half, so the last pixel is left out: 4 of the image's, 1 in 24.
    assert layer_sides(96, layers) == [96, 23, 10, 8]
    # 64 -> 15 -> 6 -> 4 would see (13 * 4) + 8 = 60 of 64, less than 19 of 20: a row of zeros for 15 - 4.
    assert layer_sides(64, layers) == [64, 15, 7, 5]
    # The thesis' network sees 40 * 2 + 3 = 83 of 84, Catch's at 84 19 * 4 + 6 = 82.
    assert layer_sides(84, [Layer(32, 3, 2), Layer(32, 3, 1)]) == [84, 41, 39]
    assert layer_sides(84, [Layer(16, 6, 4), Layer(16, 4, 2)]) == [84, 20, 9]
    # With zeros all around, sides are divided and rounded up, whatever the kernel.
    assert layer_sides(84, layers, same=True) == [84, 21, 11, 11]
    # DER's sees 5 * (5 * 2 + 4) + 5 = 75 of 84; of 64 it would see 50.
    der = [Layer(32, 5, 5), Layer(64, 5, 5)]
    assert layer_sides(84, der, least_seen=75 / 84) == [84, 16, 3]
    assert layer_sides(64, der, least_seen=75 / 84) == [64, 13, 3]


# The other three leave out 1 row in 64.
@pytest.mark.parametrize("name", sorted(encoders.REGISTRY.keys() - {"sac_ae", "a_lix", "mrq"}))
def test_every_pixel_of_an_odd_image_counts(name):
    shape = (64, 41, 3)
    encoder = encoders.REGISTRY[name](shape)
    params = random_params(encoder.init)
    images = np.random.default_rng(0).uniform(size=(2, *shape)).astype(np.float32)
    gradient = np.asarray(jax.jit(jax.grad(lambda x: jnp.sum(encoder.apply(params, x) ** 2)))(images))
    assert (gradient != 0).any((0, 3)).all()


def test_impala_at_84_pixels():
    # 3*3*4*16 + 16 = 592;  4 * (3*3*16*16 + 16) = 9,280;  3*3*16*32 + 32 = 4,640;  4 * (3*3*32*32 + 32) =
    # 36,992;  9,248;  36,992.  84 -> 42 -> 21 -> 11: 11*11*32 = 3,872 numbers, 3,872 * 256 + 256 = 991,488.
    encoder = encoders.impala((84, 84, 4))
    params = jax.eval_shape(encoder.init, jax.random.key(0))
    assert count(params) == 592 + 9_280 + 4_640 + 2 * 36_992 + 9_248 + 991_488
    wider = encoders.impala((84, 84, 4), features=10, width=2)
    kernel = jax.eval_shape(wider.init, jax.random.key(0))["Conv_0"]["kernel"]
    assert wider.features == 10 and kernel.shape == (3, 3, 4, 32)
    with pytest.raises(ValueError, match="width"):
        encoders.impala((84, 84, 4), width=0)
    # BBF's has no linear layer: 128 maps of 11 x 11.
    bbf = encoders.impala((84, 84, 4), width=4, features=0, end="min_max")
    assert (bbf.features, bbf.map_shape) == (128 * 11 * 11, (11, 11, 128))


@pytest.mark.parametrize(("height", "width"), [(4, 5), (7, 6), (1, 2)])
def test_halving_is_max_pooling(height, width):
    x = np.random.default_rng(0).permutation(2 * height * width * 3).reshape(2, height, width, 3)
    x = x.astype(np.float32)

    def both(pool):
        y, pull = jax.vjp(pool, x)
        return y, pull(jnp.arange(y.size, dtype=jnp.float32).reshape(y.shape))[0]

    plain = lambda x: nn.max_pool(x, (3, 3), (2, 2), "SAME")  # noqa: E731
    assert identical(*jax.jit(lambda: (both(halved), both(plain)))())


def test_doubling_by_hand():
    x = np.array([[1.0, 2.0], [3.0, 4.0]])[None, :, :, None]
    y = np.asarray(doubled(x, (3, 4)))[0, :, :, 0]
    assert y.tolist() == [[1, 1, 2, 2], [1, 1, 2, 2], [3, 3, 4, 4]]


def test_where_a_map_is_flattened_its_shape_is_known():
    shapes = {"nature": (7, 7, 64), "sac_ae": (35, 35, 32), "tiny": (9, 9, 16), "impala": (11, 11, 32)}
    shapes |= {"der": (3, 3, 64), "a_lix": (37, 37, 32), "mrq": (7, 7, 32)}
    flat = {name: row((84, 84, 4), features=0) for name, row in encoders.REGISTRY.items()}
    assert {name: encoder.map_shape for name, encoder in flat.items()} == shapes
    assert encoders.nature((64, 96, 4)).map_shape == (5, 8, 64)
    # A latent behind a linear layer is none, not even one with as many numbers as its maps have.
    assert encoders.tiny((42, 42, 4), features=0).features == 256
    assert encoders.tiny((42, 42, 4), features=256).map_shape is None
    assert encoders.nature((84, 84, 4), pool="average").map_shape is None


# Any flax module


class Flat(nn.Module):
    """A linear layer of the pixels."""

    features: int = 5

    @nn.compact
    def __call__(self, x):
        return nn.Dense(self.features)(to_unit(x).reshape(len(x), -1))


class Unflat(nn.Module):
    """A linear layer, shaped as an image."""

    shape: tuple

    @nn.compact
    def __call__(self, z):
        return nn.Dense(int(np.prod(self.shape)))(z).reshape(-1, *self.shape)


class Normalised(nn.Module):
    """With statistics that are no parameters."""

    @nn.compact
    def __call__(self, x):
        return nn.BatchNorm(use_running_average=False)(Flat()(x))


def test_any_flax_module_is_an_encoder():
    shape = (6, 4, 3)
    encoder = encoders.flax_encoder(Flat(), Unflat(shape), shape)
    assert (encoder.features, encoder.observation_shape, encoder.map_shape) == (5, shape, None)
    images = np.random.default_rng(0).integers(0, 256, (2, *shape), dtype=np.uint8)
    params = random_params(encoder.init)
    kernel, bias = (np.asarray(params["Dense_0"][name]) for name in ("kernel", "bias"))
    z = encoder.apply(params, images)
    np.testing.assert_allclose(z, images.reshape(2, -1) / 255 @ kernel + bias, rtol=1e-5, atol=1e-5)
    decoder = encoder.make_decoder(2)
    head = random_params(decoder.init)
    assert head["Dense_0"]["kernel"].shape == (5 + 2, 6 * 4 * 3)
    assert decoder.apply(head, np.zeros((2, 7), np.float32)).shape == (2, *shape)


def test_a_module_that_is_no_encoder_or_decoder_is_refused_by_name():
    shape = (6, 4, 3)
    with pytest.raises(ValueError, match=r"Conv must give latents \[B, D\], not \[B, 6, 4, 7\]"):
        encoders.flax_encoder(nn.Conv(7, (3, 3)), None, shape)
    with pytest.raises(ValueError, match="Normalised has variables that are no parameters: batch_stats"):
        encoders.flax_encoder(Normalised(), None, shape)
    with pytest.raises(ValueError, match="the encoder Flat has no decoder"):
        encoders.flax_encoder(Flat(), None, shape).make_decoder()
    encoder = encoders.flax_encoder(Flat(), Unflat((4, 6, 3)), shape)
    with pytest.raises(ValueError, match=r"Unflat must give images \[B, 6, 4, 3\], not \[B, 4, 6, 3\]"):
        encoder.make_decoder()
