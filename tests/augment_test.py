"""srl_jax/augment.py against numpy's padding, a shift drawn by hand, and the spread of an intensity."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from srl_jax import training
from srl_jax.augment import VIEWS, intensity, make_view, random_shift
from srl_jax.config import Config
from srl_jax.errors import ConfigError


def shifts(frames, pad):
    """{(dy, dx): the frames padded by repetition and cropped there}: all that may come out."""
    padded = np.pad(frames, [(0, 0), (pad, pad), (pad, pad), (0, 0)], mode="edge")
    height, width = frames.shape[1:3]
    return {
        (y - pad, x - pad): padded[:, y : y + height, x : x + width]
        for y in range(2 * pad + 1)
        for x in range(2 * pad + 1)
    }


def draw(frames, pad, number, seed=0):
    keys = jax.random.split(jax.random.key(seed), number)
    return np.asarray(jax.jit(jax.vmap(lambda key: random_shift(jnp.asarray(frames), key, pad)))(keys))


def test_a_shift_by_hand():
    # Down by one in the crop (so the picture moves up and its last row repeats), and left by one (so it
    # moves right and its first column repeats).
    frames = np.array([[[1, 2, 3], [4, 5, 6], [7, 8, 9]]], np.uint8)[..., None]
    expected = [[4, 4, 5], [7, 7, 8], [7, 7, 8]]
    np.testing.assert_array_equal(shifts(frames, 1)[1, -1][0, :, :, 0], expected)
    assert any(np.array_equal(shifted[0, :, :, 0], expected) for shifted in draw(frames, 1, 100))


@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_every_draw_is_one_shift_of_the_whole_sequence_and_all_shifts_come_up(dtype):
    # 25 shifts of 3 frames of 6 x 7 pixels of 2 channels; all numbers differ, so a result names its shift.
    frames = np.random.default_rng(0).permutation(3 * 6 * 7 * 2).reshape(3, 6, 7, 2).astype(dtype)
    names = {shifted.tobytes(): offset for offset, shifted in shifts(frames, 2).items()}
    assert len(names) == 25
    results = draw(frames, 2, 1000)
    assert results.dtype == dtype
    found = [names[np.ascontiguousarray(shifted).tobytes()] for shifted in results]
    counts = [found.count(offset) for offset in names.values()]
    # Uniform: 40 expected of each, with standard deviation 6.2.
    assert min(counts) > 15 and max(counts) < 70


@pytest.mark.parametrize("text", ["shift@each", "shift@each+intensity"])
def test_a_draw_for_each_observation_is_of_the_views_of_a_run_alone(text):
    plain = text.replace("@each", "").replace("+", r"\+")
    with pytest.raises(ValueError, match=rf"^@each ends a view, and --rl_view, .* take it; give {plain}$"):
        make_view(text)


@pytest.mark.parametrize(
    ("view", "text", "says"),
    [
        (
            lambda frames, key: frames.astype(jnp.int16) + 20,
            "own",
            "own: gives int16 of shape [2, 84, 84, 1]",
        ),
        (lambda frames, key: frames[:, ::2], "shift+own@each", "gives uint8 of shape [2, 42, 84, 1]"),
        (lambda frames, key: 0.9 * frames, "own", "own: makes 229.5 of a white pixel"),
        (lambda frames, key: frames.nothing, "own", "AttributeError: "),
        (lambda frames, key: frames / jnp.float32(255), "own+shift", ""),
        (lambda frames, key: frames[..., jnp.array([2, 1, 0])].reshape(2, -1, 84, 3), "own", ""),
    ],
)
def test_a_view_of_ones_own_gives_what_views_give(view, text, says, monkeypatch):
    monkeypatch.setitem(VIEWS, "own", view)
    for options in ({"rl_view": text}, {"mode": "joint", "objectives": ("vae",), "srl_view": text}):
        if not says:
            training.resolved(Config(game="Catch", **options))
            continue
        with pytest.raises(ConfigError) as raised:
            training.resolved(Config(game="Catch", **options))
        assert str(raised.value).startswith("--") and says in str(raised.value)


def test_a_view_that_does_not_fit_the_frames_is_refused_before_a_run():
    own = {"game": "gymnasium:id=Any-v0", "encoder": "impala", "mode": "joint", "objectives": ("infonce",)}
    training.resolved(Config(**own, frame_size=6))
    says = "--objective=infonce:view=crop_pad_crop: crop_pad_crop cuts 4 pixels off each side"
    with pytest.raises(ConfigError, match=f"^{says}, and the frames have 5$"):
        training.resolved(Config(**own, frame_size=5))


def test_four_pixels_is_the_default_and_none_the_identity():
    frames = np.random.default_rng(0).integers(0, 256, (1, 20, 20, 1), dtype=np.uint8)
    keys = jax.random.split(jax.random.key(0), 200)
    allowed = {shifted.tobytes() for shifted in shifts(frames, 4).values()}
    results = np.asarray(jax.jit(jax.vmap(lambda key: random_shift(jnp.asarray(frames), key)))(keys))
    found = {np.ascontiguousarray(shifted).tobytes() for shifted in results}
    assert found <= allowed
    assert len(found) > 60  # 81 shifts; 3 pixels would have 49
    np.testing.assert_array_equal(draw(frames, 0, 1)[0], frames)


@pytest.mark.parametrize("options", [{}, {"scale": 0.2}])
def test_an_intensity_is_one_normal_factor_for_a_sequence_within_two_deviations(options):
    frames = np.random.default_rng(0).integers(1, 256, (2, 3, 4, 1), dtype=np.uint8)
    keys = jax.random.split(jax.random.key(0), 1000)
    seen = np.asarray(jax.jit(jax.vmap(lambda key: intensity(frames, key, **options)))(keys))
    factors = (seen / (frames / 255)).reshape(1000, -1)
    np.testing.assert_allclose(factors, np.broadcast_to(factors[:, :1], factors.shape), rtol=1e-5)
    e = (factors[:, 0] - 1) / options.get("scale", 0.05)
    assert [e.min(), e.max()] == pytest.approx([-2, 2], abs=1e-4)
    # 46 of the 1000 are expected to be cut off, and the others' deviation makes it 0.96; its error is 0.02.
    assert abs(e.mean()) < 0.1 and e.std() == pytest.approx(0.96, abs=0.06)
