"""srl_jax/encoders: sizes against the thesis, mirrors, and what goes in."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from srl_jax import encoders
from srl_jax.window import to_unit
from tests.helpers import STACK, count, jit, random_params


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


@pytest.mark.parametrize("extra", [0, 6])
@pytest.mark.parametrize(
    ("name", "size"),
    # nature at 42 would see 36 pixels and is refused; Catch's 42 is for the others.
    [(name, 84) for name in encoders.REGISTRY] + [("nature", 36), ("sac_ae", 42), ("tiny", 42)],
)
def test_decoders_mirror_their_encoder(name, size, extra):
    shape = (size, size, 4)
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
    if name == "nature" and extra:  # without a bottleneck, the extra inputs are maps of the first layer
        mirrored.remove((3, 3, 64 + extra, 64))
        mirrored.append((3, 3, 64, 64))
    assert sorted(kernels) == sorted((h, w, o, i) for h, w, i, o in mirrored)


@pytest.mark.parametrize("name", ["nature", "tiny"])  # without and with a bottleneck
def test_extra_inputs_reach_every_image(name):
    encoder = encoders.REGISTRY[name]((84, 84, STACK))
    decoder = encoder.make_decoder(2)
    z = np.random.default_rng(0).normal(size=encoder.features).astype(np.float32)
    inputs = np.concatenate([np.stack([z, z]), np.eye(2, dtype=np.float32)], 1)
    first, second = np.asarray(jit(decoder.apply)(random_params(decoder.init), inputs))
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
        jit(encoder.apply)(params, x) for x in (image, image.astype(np.float32) / np.float32(255))
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
        z = np.asarray(jit(lambda key, x, e=encoder: e.apply(e.init(key), x))(jax.random.key(0), frames))
        assert np.allclose(z[:2], 0, atol=1e-4) == started
        assert (0.05 < z[2:].std(0).mean() < 2) == started
        on = (z[2:] > 0).mean(0)
        assert (np.mean((on > 0) & (on < 1)) > 0.5) == started


@pytest.mark.parametrize("option", [{"init": "hee"}, {"gain": 0.0}, {"decoder_scale": 2e3}])
def test_a_start_that_cannot_be_is_refused(option):
    with pytest.raises(ValueError, match=next(iter(option))):
        encoders.tiny((42, 42, STACK), **option)


@pytest.mark.parametrize("layer_norm", [True, False])
def test_bottleneck_is_normalised_before_its_tanh(layer_norm):
    encoder = encoders.sac_ae((17, 17, STACK), features=64, layer_norm=layer_norm)
    image = np.random.default_rng(0).integers(0, 256, (2, 17, 17, STACK), dtype=np.uint8)
    params = random_params(encoder.init)
    params = {name: {**layer, "bias": 0 * layer["bias"]} for name, layer in params.items()}
    z = jit(encoder.apply)(params, image)
    before = np.arctanh(np.asarray(z, np.float64))
    normal = np.allclose(before.mean(1), 0, atol=1e-4) and np.allclose(before.std(1), 1, atol=1e-2)
    assert normal == layer_norm


@pytest.mark.parametrize("name", encoders.REGISTRY)
def test_frames_that_cannot_be_encoded_are_refused(name):
    with pytest.raises(ValueError, match="square"):
        encoders.REGISTRY[name]((84, 80, 4))
    with pytest.raises(ValueError, match="too small"):
        encoders.REGISTRY[name]((8, 8, 4))


def test_frames_that_would_be_cut_are_refused_with_the_size_that_fits():
    # nature at 42: 42 -> 9 -> 3 -> 1. The last one sees 3, they see (3 - 1) * 2 + 4 = 8 of the 9, and these
    # (8 - 1) * 4 + 8 = 36 of the 42.
    with pytest.raises(ValueError, match="36 fits"):
        encoders.nature((42, 42, 4))
    encoders.nature((36, 36, 4))
    # sac_ae at 84 sees 40 * 2 + 3 = 83 of 84: within a twentieth, and the thesis' own network.
    encoders.sac_ae((84, 84, 4))


def test_a_bottleneck_needs_features():
    with pytest.raises(ValueError, match="features"):
        encoders.sac_ae((84, 84, 4), features=0)
    with pytest.raises(ValueError, match="features"):
        encoders.tiny((42, 42, 4), features=-1)


def test_tiny_without_a_bottleneck_gives_its_maps():
    # 42 -> (42 - 6) / 4 + 1 = 10 -> (10 - 4) / 2 + 1 = 4: 16 maps of 4 x 4, none below zero.
    encoder = encoders.tiny((42, 42, 4), features=0)
    assert encoder.features == 256
    observation = np.random.default_rng(0).integers(0, 256, (2, 42, 42, 4), np.uint8)
    z = np.asarray(encoder.apply(encoder.init(jax.random.key(0)), observation))
    assert z.shape == (2, 256) and z.min() == 0 and z.max() > 0
