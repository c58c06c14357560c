"""srl_jax/replay/__init__.py against lists of whole episodes, and numbers worked by hand."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from srl_jax.replay import Replay
from tests.replay.reference import (
    EVENTS,
    RESET,
    STEP,
    TERMINATED,
    TRUNCATED,
    Driver,
    same_state,
)


@st.composite
def experience(draw):
    """A driver of a small ring, and events for a few laps of it."""
    num_streams = draw(st.integers(1, 3))
    stack, horizon = draw(st.integers(1, 4)), draw(st.integers(1, 5))
    slots = stack + horizon + 2 + draw(st.integers(0, 6))
    driver = Driver(
        num_streams=num_streams,
        slots=slots,
        stack=stack,
        horizon=horizon,
        spare=draw(st.integers(0, num_streams - 1)),
    )
    event = st.sampled_from([STEP] * draw(st.integers(1, 8)) + list(EVENTS))
    row = st.lists(event, min_size=num_streams, max_size=num_streams)
    length = draw(st.integers(1, 3 * slots))
    return driver, draw(st.lists(row, min_size=length, max_size=length))


@given(experience())
@settings(deadline=None, max_examples=150)
def test_windows_equal_those_cut_from_whole_episodes(case):
    driver, events = case
    for i, row in enumerate(events):
        driver.step(row)
        driver.check_windows() if i % 5 == 0 else driver.check_indices()
    driver.check_windows()


@given(experience(), st.integers(1, 5))
@settings(deadline=None, max_examples=60)
def test_n_step_returns_equal_those_of_whole_episodes(case, n):
    driver, events = case
    n, stack = min(n, driver.replay.horizon), driver.replay.stack
    for row in events:
        driver.step(row)
    expected = driver.reference.sampleable()
    window = driver.replay.gather(np.array(list(expected), np.int64))
    for row, (episode, t) in enumerate(expected.values()):
        rewards, discounts = window.rewards[row, :n], window.discounts[row, :n]
        steps = int(window.valid[row, :n].sum())
        factors = np.concatenate([[1.0], np.cumprod(discounts[:steps])])
        total, factor, observation = driver.reference.n_step(episode, t, n)
        assert float(factors[:steps] @ rewards[:steps]) == total
        assert factors[steps] == factor
        if observation is not None:
            np.testing.assert_array_equal(window.frames[row, steps : steps + stack], observation)


@given(experience(), st.integers(1, 9))
@settings(deadline=None, max_examples=30)
def test_a_sample_is_made_of_sampleable_windows(case, batch_size):
    driver, events = case
    for row in events:
        driver.step(row)
    if len(driver.replay):
        window, indices = driver.replay.sample(batch_size, 0.4)
        assert set(indices.tolist()) <= set(driver.reference.sampleable())
        for drawn, gathered in zip(window[:-1], driver.replay.gather(indices)[:-1], strict=True):
            np.testing.assert_array_equal(drawn, gathered)


@given(experience(), st.integers(0, 2**32 - 1))
@settings(deadline=None, max_examples=60)
def test_a_restored_replay_goes_on_bit_for_bit(case, seed):
    driver, events = case
    rng = np.random.default_rng(seed)
    for row in events:
        if rng.random() < 0.2:
            driver.restore()  # compares all state; from here on both have to give the same results
        driver.step(row)
        if len(driver.replay):
            indices = driver.sample(3, 0.4)
            driver.set_priorities(indices, rng.normal(size=3).tolist())
        driver.check()
    driver.restore()
    driver.check_windows()


def test_a_snapshot_survives_json_to_the_bit():
    driver = filled(seed=2**31 + 5)
    driver.replay.set_priorities(driver.replay.sample(3, 0.4)[1], np.array([1 / 3, 1e300, 0.1]))
    _, numbers = driver.replay.snapshot()
    assert numbers["rng"]["state"]["inc"] > 2**64  # beyond what a float holds, or an int64
    assert json.loads(json.dumps(numbers)) == numbers


def test_a_restored_replay_keeps_its_own_arrays():
    replay = filled().replay
    arrays, numbers = replay.snapshot()
    copy = Driver().replay
    copy.restore(arrays, numbers)
    copy.add(*step_of_one())
    copy.sample(4, 0.4)
    same_state(filled().replay, replay)


def step_of_one():
    return (np.zeros(1, int), np.zeros(1), *np.zeros((3, 1), bool), np.zeros((1, 2, 1, 2), np.uint8))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"slots": 13}, r"actions must be int32 \(2, 13\), got int32 \(2, 12\)"),
        ({"num_streams": 3}, r"actions must be int32 \(3, 12\), got int32 \(2, 12\)"),
    ],
)
def test_a_snapshot_of_another_replay_is_refused_in_one_line(options, message):
    arrays, numbers = filled(20, num_streams=2, slots=12).replay.snapshot()
    with pytest.raises(ValueError, match=message) as error:
        Driver(**{"num_streams": 2, "slots": 12, **options}).replay.restore(arrays, numbers)
    assert "\n" not in str(error.value)


@given(experience(), st.data())
@settings(deadline=None, max_examples=60)
def test_changed_slots_are_those_whose_frames_differ(case, data):
    driver, events = case
    moment = data.draw(st.integers(0, len(events) - 1))
    start = driver.replay.next_position.copy()
    for i, row in enumerate(events):
        if i == moment:
            since, before = driver.replay.next_position.copy(), driver.replay.frames.copy()
        driver.step(row)
    frames = driver.replay.frames
    # No two frames are alike, and none is 0.
    changed = (frames != before).any(axis=(0, 2, 3, 4))
    np.testing.assert_array_equal(driver.replay.changed_slots(since), changed)
    ever = frames.any(axis=(0, 2, 3, 4))
    np.testing.assert_array_equal(driver.replay.changed_slots(start), ever)
    written = int(driver.replay.next_position.max())
    assert ever.tolist() == [i < written for i in range(driver.replay.slots)]


@pytest.mark.parametrize(
    ("before", "after", "slots"),
    [
        (0, 3, [0, 1, 2, 3]),  # steps; there is an observation more, the first
        (3, 3, []),
        (9, 12, [0, 10, 11]),  # around the end
        (9, 20, [*range(12)][:9] + [10, 11]),  # eleven of twelve
        (9, 21, [*range(12)]),
        (9, 30, [*range(12)]),
    ],
)
def test_changed_slots_by_hand(before, after, slots):
    driver = filled(before)
    since = driver.replay.next_position.copy()
    for _ in range(after - before):
        driver.step([STEP])
    assert np.flatnonzero(driver.replay.changed_slots(since)).tolist() == slots


def filled(steps=30, **options):
    driver = Driver(**options)
    for _ in range(steps):
        driver.step([STEP] * driver.replay.num_streams)
    return driver


def test_shapes_and_dtypes_are_the_contract():
    window, indices = filled(num_streams=2, stack=4, horizon=3).replay.sample(5, 0.4)
    assert (window.frames.shape, window.frames.dtype) == ((5, 7, 2, 1, 2), np.uint8)
    assert (window.actions.shape, window.actions.dtype) == ((5, 3), np.int32)
    for array in (window.rewards, window.discounts, window.valid):
        assert (array.shape, array.dtype) == ((5, 3), np.float32)
    assert (window.weight.shape, window.weight.dtype) == ((5,), np.float32)
    assert (indices.shape, indices.dtype) == ((5,), np.int64)


def test_arrays_are_fresh_each_call():
    # On a CPU jax may use numpy's memory as it is: a buffer used twice would change a batch in use.
    replay = filled().replay
    first, second = replay.sample(4, 0.4)[0], replay.sample(4, 0.4)[0]
    state = [value for value in vars(replay).values() if isinstance(value, np.ndarray)]
    for array in first:
        assert not any(np.shares_memory(array, other) for other in (*second, *state))


def two_transitions(alpha=1.0, **options):
    """A replay with exactly two sampleable transitions, at positions 0 and 1."""
    driver = Driver(alpha=alpha, horizon=1, **options)
    for _ in range(2):
        driver.step([STEP])
    assert driver.replay.sampleable().tolist() == [0, 1]
    return driver.replay


def test_samples_in_proportion_to_priorities():
    replay = two_transitions()
    replay.set_priorities(np.array([0, 1]), np.array([-(1 - 1e-6), 3 - 1e-6]))
    _, indices = replay.sample(400, 0.4)
    assert abs(int((indices == 0).sum()) - 100) <= 1


def test_importance_weights_by_hand():
    # Priorities 1 and 3 of a total of 4, N = 2: N * P = 1/2 and 3/2; to the power -1: 2 and 2/3;
    # over their maximum: 1 and 1/3. To the power -1/2: sqrt(2) and sqrt(2/3): 1 and sqrt(1/3).
    replay = two_transitions()
    replay.set_priorities(np.array([0, 1]), np.array([1 - 1e-6, 3 - 1e-6]))
    for beta, expected in ((1.0, 1 / 3), (0.5, 0.5773503), (0.0, 1.0)):
        window, indices = replay.sample(8, beta)
        np.testing.assert_allclose(window.weight[indices == 0], 1.0, rtol=1e-6)
        np.testing.assert_allclose(window.weight[indices == 1], expected, rtol=1e-6)


def test_weights_are_divided_by_the_maximum_of_the_batch():
    replay = two_transitions()
    replay.set_priorities(np.array([0, 1]), np.array([1e-9, 1e9]))  # 0 is never in the batch
    window, indices = replay.sample(4, 1.0)
    assert indices.tolist() == [1] * 4
    assert window.weight.tolist() == [1.0] * 4


def test_alpha_and_epsilon_shape_the_priority():
    # (|-8.999999| + 1e-6) ** 0.5 = 3, and an error of 0 keeps (1e-6) ** 0.5 = 1e-3.
    replay = two_transitions(alpha=0.5)
    replay.set_priorities(np.array([0, 1]), np.array([-8.999999, 0.0]))
    np.testing.assert_allclose(replay.tree.get(np.arange(2)), [3.0, 1e-3], rtol=1e-9)


def test_alpha_zero_is_uniform():
    replay = two_transitions(alpha=0.0)
    replay.set_priorities(np.array([0, 1]), np.array([0.0, 1e6]))
    window, indices = replay.sample(100, 1.0)
    assert (indices == 0).sum() == 50
    assert (window.weight == 1).all()


def test_new_transitions_get_the_largest_priority_so_far():
    driver = Driver(alpha=1.0)
    driver.step([STEP])
    assert driver.replay.tree.get([0]) == [1.0]
    driver.replay.set_priorities(np.array([0]), np.array([7 - 1e-6]))
    driver.replay.set_priorities(np.array([0]), np.array([2.0]))  # the maximum stays
    driver.step([STEP])
    np.testing.assert_allclose(driver.replay.tree.get([1]), [7.0])


def test_a_reset_keeps_learnt_priorities():
    driver = Driver(alpha=1.0, horizon=2)
    driver.step([STEP])
    driver.step([STEP])  # opens position 0
    driver.replay.set_priorities(np.array([0]), np.array([5 - 1e-6]))
    driver.step([RESET])  # opens position 1, whose episode turns out to have ended
    driver.check_windows()
    np.testing.assert_allclose(driver.replay.tree.get(np.arange(4)), [5, 5, 0, 0])


def test_begin_twice_drops_the_observation_without_a_step():
    driver = filled(steps=3, stack=3, horizon=2)
    for _ in range(2):
        frame = driver.new_frames(1)
        driver.replay.begin(frame)
        driver.reference.begin(0, frame[0].copy())
        driver.check_windows()
    for _ in range(20):
        driver.step([STEP])
        driver.check_windows()


def test_stale_priorities_are_ignored():
    driver = filled(steps=8, slots=10, stack=3, horizon=2)
    replay = driver.replay
    _, indices = replay.sample(50, 0.4)
    for _ in range(20):  # two laps: the same slots, other transitions
        driver.step([STEP])
    before = replay.tree.leaves.copy()
    replay.set_priorities(indices, np.full(50, 100.0))
    np.testing.assert_array_equal(replay.tree.leaves, before)
    assert replay.max_priority == 1.0


def test_priorities_of_what_cannot_be_sampled_are_ignored():
    driver = filled(steps=15, slots=10, stack=3, horizon=2)
    replay, legal = driver.replay, driver.reference.sampleable()
    others = np.array([i for i in range(-20, 60) if i not in legal])
    before = replay.tree.leaves.copy()
    replay.set_priorities(others, np.full(len(others), 100.0))
    np.testing.assert_array_equal(replay.tree.leaves, before)
    with pytest.raises(ValueError, match="not sampleable"):
        replay.gather(others[:1])


def test_fresh_and_stale_indices_may_be_mixed():
    replay = two_transitions()
    replay.set_priorities(np.array([99, 1, 1]), np.array([50.0, 4.0, 2 - 1e-6]))  # the last 1 wins
    np.testing.assert_allclose(replay.tree.get(np.arange(2)), [1.0, 2.0])


@pytest.mark.parametrize("errors", [[np.nan, 1.0], [1.0, np.inf], [1.0]])
def test_bad_td_errors_are_refused_and_change_nothing(errors):
    replay = two_transitions()
    with pytest.raises(ValueError, match="td_errors"):
        replay.set_priorities(np.array([0, 1]), np.array(errors))
    assert replay.tree.get(np.arange(2)).tolist() == [1.0, 1.0]


def test_the_seed_decides_the_samples():
    draws = [filled(seed=seed).replay.sample(16, 0.4)[1].tolist() for seed in (0, 0, 1)]
    assert draws[0] == draws[1]
    assert draws[0] != draws[2]


def test_an_ended_stream_must_begin():
    driver = Driver(num_streams=2)
    step = (np.zeros(2, int), np.zeros(2), *np.zeros((3, 2), bool), np.zeros((2, 2, 1, 2), np.uint8))
    with pytest.raises(RuntimeError, match=r"begin an episode before the next add.*\[0, 1\]"):
        driver.replay.add(*step)
    driver.step([STEP, TRUNCATED])
    with pytest.raises(RuntimeError, match=r"streams \[1\]"):
        driver.replay.add(*step)
    driver.step([STEP, STEP])
    driver.check_windows()
    assert driver.replay.num_transitions == 4


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("actions", np.zeros(2)),  # not whole numbers
        ("rewards", np.zeros(3)),
        ("terminated", np.zeros(2, int)),
        ("truncated", np.zeros((2, 1), bool)),
        ("life_lost", None),
        ("frames", np.zeros((2, 2, 1, 2))),  # not uint8
        ("frames", np.zeros((2, 2, 2), np.uint8)),
        ("frames", np.zeros((2, 1, 2, 2), np.uint8)),
    ],
)
def test_a_bad_step_is_refused_and_changes_nothing(field, value):
    driver = Driver(num_streams=2)
    driver.step([STEP, STEP])
    step = {
        "actions": np.zeros(2, int),
        "rewards": np.zeros(2),
        "terminated": np.zeros(2, bool),
        "truncated": np.zeros(2, bool),
        "life_lost": np.zeros(2, bool),
        "frames": np.zeros((2, 2, 1, 2), np.uint8),
    }
    with pytest.raises(ValueError, match=f"{field} must be"):
        driver.replay.add(**(step | {field: value}))
    driver.check_windows()


@pytest.mark.parametrize("streams", [[0, 0], [0, 2], [-1, 0], [[0, 1]], [True, False], [0.0, 1.0]])
def test_bad_streams_are_refused(streams):
    with pytest.raises(ValueError, match="streams|frames"):
        Driver(num_streams=2).replay.begin(np.zeros((2, 2, 1, 2), np.uint8), np.array(streams))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"capacity": 17, "num_streams": 2}, "capacity must be at least 18"),
        ({"num_streams": 0}, "num_streams must be at least 1"),
        ({"stack": 0}, "stack must lie in"),
        ({"horizon": 0}, "horizon must be at least 1"),
        ({"gamma": 1.5}, "gamma must lie in"),
        ({"alpha": -0.1}, "alpha must lie in"),
    ],
)
def test_bad_arguments_are_refused_in_one_line(options, message):
    with pytest.raises(ValueError, match=message) as error:
        Replay(**({"capacity": 100, "num_streams": 1} | options))
    assert "\n" not in str(error.value)


def test_nothing_to_sample():
    driver = Driver(horizon=2)
    with pytest.raises(ValueError, match="cannot draw 3 of 0"):
        driver.replay.sample(3, 0.4)
    driver.step([STEP])
    assert len(driver.replay) == 0  # the horizon is 2
    driver.step([TERMINATED])
    assert len(driver.replay) == 2
    with pytest.raises(ValueError, match="cannot draw 0 of 2"):
        driver.replay.sample(0, 0.4)
    for n_step in (0, 3):
        with pytest.raises(ValueError, match=rf"n_step must be in 1..2, the horizon, not {n_step}"):
            driver.replay.sample(2, 0.4, n_step=n_step)


def test_memory_of_a_slot():
    # 84 * 84 = 7056 bytes of frame, at most 7200 with everything else. Memory is taken only as it
    # fills up, so this costs none.
    replay = Replay(capacity=100_000, num_streams=10)
    assert replay.slots == 10_000
    assert replay.frames.nbytes == 100_000 * 7056
    values = [*vars(replay).values(), *vars(replay.tree).values()]
    assert sum(x.nbytes for x in values if isinstance(x, np.ndarray)) <= 100_000 * 7200


def test_gamma_and_n_of_one_batch():
    replay, same = (filled(num_streams=2, stack=4, horizon=3, seed=3).replay for _ in range(2))
    window, indices = replay.sample(40, 0.4, gamma=0.25, n_step=2)
    plain, same_indices = same.sample(40, 0.4)
    np.testing.assert_array_equal(indices, same_indices)
    assert plain.n_step is None and window.n_step.dtype == np.int32
    np.testing.assert_array_equal(window.n_step, np.full(40, 2))
    np.testing.assert_array_equal(window.discounts, np.where(plain.discounts, np.float32(0.25), 0))
    assert (
        window.discounts.max() == 0.25 and replay.sample(9, 0.4)[0].discounts.max() == plain.discounts.max()
    )
