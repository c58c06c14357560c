"""srl_jax/window.py: which frames make up an observation, and in which order."""

import numpy as np

from srl_jax.window import image, observation, stack_last
from tests.helpers import STACK, jit, make_window


def numbered(batch=2, horizon=3):
    """A window whose frame i of row b is filled with 10 * b + i."""
    window = make_window(batch=batch, horizon=horizon, size=2)
    numbers = 10 * np.arange(batch)[:, None] + np.arange(STACK + horizon)
    frames = np.broadcast_to(numbers[:, :, None, None], window.frames.shape)
    return window._replace(frames=frames.astype(np.uint8))


def test_observation_at_an_offset_by_hand():
    # Frame i belongs to time t - 3 + i, so s_t is frames 0..3 and s_{t+2} is frames 2..5, newest last.
    seen = observation(numbered(), 0)
    assert seen.shape == (2, 2, 2, STACK) and seen.dtype == np.uint8
    np.testing.assert_array_equal(seen[0, 1, 0], [0, 1, 2, 3])
    np.testing.assert_array_equal(observation(numbered(), 2)[1, 0, 1], [12, 13, 14, 15])


def test_observation_at_an_offset_of_its_own_for_each_row():
    seen = jit(observation)(numbered(), np.array([3, 1], np.int32))
    np.testing.assert_array_equal(seen[:, 0, 0], [[3, 4, 5, 6], [11, 12, 13, 14]])


def test_traced_and_whole_offsets_agree():
    window = make_window(1, size=5)
    for k in range(4):
        traced = jit(observation)(window, np.full(4, k, np.int32))
        np.testing.assert_array_equal(traced, observation(window, k))


def test_image_is_the_observation_in_the_unit_interval():
    window = make_window(2, size=5)
    seen = np.asarray(image(window, 1))
    assert seen.dtype == np.float32 and seen.min() >= 0 and seen.max() <= 1
    np.testing.assert_array_equal(np.rint(seen * 255), observation(window, 1))


def test_stack_last_moves_the_frames_to_the_end():
    frames = np.arange(2 * 3 * 4 * 5).reshape(2, 3, 4, 5)
    stacked = np.asarray(stack_last(frames))
    assert stacked.shape == (2, 4, 5, 3)
    assert stacked[1, 2, 3, 0] == frames[1, 0, 2, 3]
