"""srl_jax/run/actor.py: stacks of frames, seeds, schedules."""

import itertools
import os
import sys
import threading

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from srl_jax.run.actor import FrameStack, random_policy, seed_for, yielding_threads
from srl_jax.specs import linear

STEP, BEGIN = "step", "begin"


EVENTS = st.tuples(st.sampled_from([STEP, STEP, BEGIN]), st.lists(st.booleans(), min_size=2, max_size=2))


@given(st.integers(1, 4), st.lists(EVENTS))
def test_frame_stack_is_the_end_of_the_episode_so_far(stack, events):
    # Every frame has a number of its own; the reference keeps whole episodes.
    numbers = itertools.count(1)
    new = lambda: np.array([[[[next(numbers)]]], [[[next(numbers)]]]], np.uint8)  # noqa: E731
    stacks = FrameStack(2, stack, (1, 1, 1))
    frames = new()
    stacks.begin(frames)
    episodes = [[int(frame)] for frame in frames.ravel()]
    for what, mask in events[:60]:
        frames = new()
        if what == STEP:
            stacks.push(frames)
            mask = [False, False]
        else:
            stacks.begin(frames, np.array(mask))
        for i, begins in enumerate(mask):
            if begins:
                episodes[i] = [int(frames[i, 0, 0, 0])]
            elif what == STEP:
                episodes[i].append(int(frames[i, 0, 0, 0]))
        expected = [([e[0]] * stack + e[1:])[-stack:] for e in episodes]
        assert stacks.observations()[:, :, 0, 0, 0].tolist() == expected


def test_observations_are_the_callers_own():
    stacks = FrameStack(1, 2, (1, 1, 3))
    stacks.begin(np.full((1, 1, 1, 3), 7, np.uint8))
    before = stacks.observations()
    stacks.push(np.full((1, 1, 1, 3), 8, np.uint8))
    assert before.shape == (1, 2, 1, 1, 3) and before.dtype == np.uint8
    assert before[0, :, 0, 0].tolist() == [[7] * 3, [7] * 3]
    assert stacks.observations()[0, :, 0, 0].tolist() == [[7] * 3, [8] * 3]


def test_seeds_are_31_bits_and_differ_by_run_name_number_and_order():
    purposes = [("replay",), ("random policy",), ("train", "environments"), ("eval", "environments")]
    purposes += [("environments", "train")]
    purposes += [("eval", step) for step in range(100, 20_000, 100)]
    seeds = [seed_for(run, *purpose) for run in (0, 1, 2, 2**31 - 1) for purpose in purposes]
    assert all(type(seed) is int and 0 <= seed < 2**31 for seed in seeds)
    assert len(set(seeds)) == len(seeds)  # 812 of 2^31: chance alone would repeat one in 6,500 times
    assert seed_for(3, "eval", 500) == seed_for(3, "eval", 500)


def test_linear_schedule_by_hand():
    # From 1 to 0.05 over 1,000 steps: half-way 0.525, then constant.
    values = [linear(1.0, 0.05, 1000, now) for now in (0, 500, 1000, 5000)]
    assert values[2:] == [0.05, 0.05]  # to the bit
    assert values == pytest.approx([1.0, 0.525, 0.05, 0.05])


def test_random_policy_is_uniform_and_repeats_with_its_seed():
    frames = np.zeros((1000, 1, 1, 1, 1), np.uint8)
    drawn = lambda seed: random_policy(4, np.random.default_rng(seed))  # noqa: E731
    actions = drawn(7)(frames, 0, 0.0)
    assert actions.dtype == np.int32
    counts = np.bincount(actions, minlength=4)
    assert len(counts) == 4 and counts.min() > 200  # 250 expected, standard deviation 14
    np.testing.assert_array_equal(actions, drawn(7)(frames, 9, 1.0))
    assert not np.array_equal(actions, drawn(8)(frames, 0, 0.0))


@pytest.mark.skipif(sys.platform != "linux", reason="threads have no priority of their own")
def test_threads_of_environments_yield_to_their_own_process_alone():
    def priority():
        return os.getpriority(os.PRIO_PROCESS, threading.get_native_id())

    with yielding_threads("environments", 1) as threads:
        assert threads.submit(priority).result() == min(priority() + 5, 19)
