"""srl_jax/window.py: which frames make up an observation, and in which order."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from srl_jax.window import image, observation, only, stack_last, to_unit
from tests.helpers import STACK, make_window


def numbered(batch=2, horizon=3):
    """A window whose frame i of row b is filled with 10 * b + i."""
    window = make_window(batch=batch, horizon=horizon, size=2)
    numbers = 10 * np.arange(batch)[:, None] + np.arange(STACK + horizon)
    frames = np.broadcast_to(numbers[:, :, None, None, None], window.frames.shape)
    return window._replace(frames=frames.astype(np.uint8))


def test_a_window_of_one_observation_has_the_frames_of_its_offset_and_no_horizon():
    for k in (0, 2):
        alone = only(numbered(), k)
        np.testing.assert_array_equal(observation(alone, 0), observation(numbered(), k))
        assert alone.frames.shape[1] == STACK and alone.actions.shape == alone.valid.shape == (2, 0)


def test_observation_at_an_offset_by_hand():
    # Frame i belongs to time t - 3 + i, so s_t is frames 0..3 and s_{t+2} is frames 2..5, newest last.
    seen = observation(numbered(), 0)
    assert seen.shape == (2, 2, 2, STACK) and seen.dtype == np.uint8
    np.testing.assert_array_equal(seen[0, 1, 0], [0, 1, 2, 3])
    np.testing.assert_array_equal(observation(numbered(), 2)[1, 0, 1], [12, 13, 14, 15])


@pytest.mark.parametrize("k", [-1, 4])
def test_an_offset_beyond_the_window_is_refused(k):
    with pytest.raises(ValueError, match=rf"^offset {k} is not in 0\.\.3, where 3 is the horizon$"):
        observation(numbered(), k)


def test_observation_at_an_offset_of_its_own_for_each_row():
    seen = jax.jit(observation)(numbered(), np.array([3, 1], np.int32))
    np.testing.assert_array_equal(seen[:, 0, 0], [[3, 4, 5, 6], [11, 12, 13, 14]])


def test_traced_and_whole_offsets_agree():
    window = make_window(1, size=5)
    for k in range(4):
        traced = jax.jit(observation)(window, np.full(4, k, np.int32))
        np.testing.assert_array_equal(traced, observation(window, k))


def test_image_is_the_observation_in_the_unit_interval():
    window = make_window(2, size=5)
    seen = np.asarray(image(window, 1))
    assert seen.dtype == np.float32 and seen.min() >= 0 and seen.max() <= 1
    np.testing.assert_array_equal(np.rint(seen * 255), observation(window, 1))


@pytest.mark.parametrize("dtype", [np.int32, np.int8, np.float16, bool])
def test_pixels_of_another_dtype_are_refused(dtype):
    with pytest.raises(ValueError, match=rf"must be uint8, or float32 in \[0, 1\], not {np.dtype(dtype)}"):
        to_unit(jnp.zeros((1, 2, 2, 1), dtype))


def test_stack_last_moves_frames_and_their_channels_to_the_end():
    frames = np.arange(2 * 3 * 4 * 5 * 2).reshape(2, 3, 4, 5, 2)
    stacked = np.asarray(stack_last(frames))
    assert stacked.shape == (2, 4, 5, 6)
    # Channel s * C + c is c of frame s: the newest frame is the last two channels.
    assert stacked[1, 2, 3].tolist() == [frames[1, s, 2, 3, c] for s in range(3) for c in range(2)]


def test_colour_of_any_shape_stays_together():
    # Frame i of row b has the colour (i, 10 + i, 20 + i) + 100 * b everywhere; 3 x 5 pixels.
    number = 100 * np.arange(2)[:, None, None] + np.arange(STACK + 1)[:, None] + 10 * np.arange(3)
    frames = np.broadcast_to(number[:, :, None, None], (2, STACK + 1, 3, 5, 3)).astype(np.uint8)
    window = make_window(batch=2, horizon=1)._replace(frames=frames)
    seen = observation(window, 1)
    assert seen.shape == (2, 3, 5, 3 * STACK)
    expected = [101, 111, 121, 102, 112, 122, 103, 113, 123, 104, 114, 124]
    np.testing.assert_array_equal(seen[1, 2, 4], expected)
    np.testing.assert_array_equal(jax.jit(observation)(window, np.array([0, 1]))[1], seen[1])
