"""srl_jax/replay.py against lists of whole episodes, and numbers worked by hand."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from srl_jax.replay import Replay

GAMMA = 0.5  # powers of it are exact
STEP, TERMINATED, TRUNCATED, LIFE_LOST, BOTH, LIFE_AND_TRUNCATED, RESET = range(7)


class Episode:
    """Every observation of an episode, and the step (action, reward, is_terminal) after each."""

    def __init__(self, start, frame):
        self.start, self.frames, self.steps, self.over = start, [frame], [], False


class Reference:
    """What a replay should hold: keeps everything for ever, looks everything up slowly."""

    def __init__(self, num_streams, slots, stack, horizon):
        self.slots, self.stack, self.horizon = slots, stack, horizon
        self.episodes = [[] for _ in range(num_streams)]

    def observations(self, stream):
        return sum(len(episode.frames) for episode in self.episodes[stream])

    def begin(self, stream, frame):
        if self.episodes[stream]:
            self.episodes[stream][-1].over = True
        self.episodes[stream].append(Episode(self.observations(stream), frame))

    def add(self, stream, action, reward, is_terminal, over, frame):
        episode = self.episodes[stream][-1]
        episode.steps.append((action, reward, is_terminal))
        episode.frames.append(frame)
        episode.over = over

    def sampleable(self):
        """{index: (episode, t)}."""
        result = {}
        for stream, episodes in enumerate(self.episodes):
            oldest = self.observations(stream) - 1 - self.slots + self.stack
            for episode in episodes:
                for t in range(len(episode.steps)):
                    known = episode.over or t + self.horizon <= len(episode.steps)
                    if known and episode.start + t >= oldest:
                        index = (episode.start + t) * len(self.episodes) + stream
                        result[index] = (episode, t)
        return result

    def window(self, episode, t):
        last = len(episode.frames) - 1
        frames = [
            episode.frames[min(max(t - self.stack + 1 + i, 0), last)]
            for i in range(self.stack + self.horizon)
        ]
        rows = []
        for k in range(self.horizon):
            if t + k < len(episode.steps):
                action, reward, is_terminal = episode.steps[t + k]
                rows.append((action, reward, 0.0 if is_terminal else GAMMA, 1.0))
            else:
                rows.append((0, 0.0, 0.0, 0.0))
        return np.stack(frames), *(np.array(column) for column in zip(*rows, strict=True))

    def n_step(self, episode, t, n):
        """(the return up to there, the factor of the bootstrap value, the observation it is of)."""
        total, factor = 0.0, 1.0
        for k in range(n):
            if t + k == len(episode.steps):
                return total, factor, self.observation(episode, t + k)
            _, reward, is_terminal = episode.steps[t + k]
            total += factor * reward
            if is_terminal:
                return total, 0.0, None
            factor *= GAMMA
        return total, factor, self.observation(episode, t + n)

    def observation(self, episode, t):
        return np.stack([episode.frames[max(t - i, 0)] for i in range(self.stack - 1, -1, -1)])


class Driver:
    """Sends the same experience to a Replay and to the Reference; no two frames are alike."""

    def __init__(self, *, num_streams=1, slots=12, stack=2, horizon=1, alpha=0.5, spare=0, seed=0):
        self.replay = Replay(
            capacity=num_streams * slots + spare,
            num_streams=num_streams,
            frame_shape=(2, 2),
            stack=stack,
            horizon=horizon,
            gamma=GAMMA,
            alpha=alpha,
            seed=seed,
        )
        self.reference = Reference(num_streams, slots, stack, horizon)
        self.waiting = set(range(num_streams))
        self.count = itertools.count(1)

    def new_frames(self, n):
        ids = np.array([next(self.count) for _ in range(n)], np.uint32)
        return ids.view(np.uint8).reshape(n, 2, 2).copy()

    def step(self, events):
        """One step of every stream, after `begin` for those that wait for it or are to be reset."""
        events = np.array(events)
        streams = sorted(self.waiting | set(np.flatnonzero(events == RESET).tolist()))
        if streams:
            frames = self.new_frames(len(streams))
            everyone = len(streams) == len(events)
            self.replay.begin(frames, None if everyone else np.array(streams))
            for stream, frame in zip(streams, frames, strict=True):
                self.reference.begin(stream, frame.copy())
        frames = self.new_frames(len(events))
        numbers = frames.reshape(-1, 4).copy().view(np.uint32)[:, 0].astype(np.int64)
        terminated = np.isin(events, [TERMINATED, BOTH])
        truncated = np.isin(events, [TRUNCATED, BOTH, LIFE_AND_TRUNCATED])
        life_lost = np.isin(events, [LIFE_LOST, LIFE_AND_TRUNCATED])
        actions, rewards = numbers % 18, (numbers % 7 - 3).astype(np.float32)
        self.replay.add(actions, rewards, terminated, truncated, life_lost, frames)
        over = terminated | truncated
        for i in range(len(events)):
            is_terminal = bool(terminated[i] or life_lost[i])
            frame = frames[i].copy()
            self.reference.add(i, actions[i], rewards[i], is_terminal, bool(over[i]), frame)
        self.waiting = set(np.flatnonzero(over).tolist())
        frames[:] = 255  # the caller may reuse its buffer

    def check_indices(self):
        expected = self.reference.sampleable()
        assert sorted(self.replay.sampleable().tolist()) == sorted(expected)
        assert len(self.replay) == len(expected)
        return expected

    def check_windows(self):
        expected = self.check_indices()
        window = self.replay.gather(np.array(list(expected), np.int64))
        for row, (episode, t) in enumerate(expected.values()):
            frames, actions, rewards, discounts, valid = self.reference.window(episode, t)
            np.testing.assert_array_equal(window.frames[row], frames)
            np.testing.assert_array_equal(window.actions[row], actions)
            np.testing.assert_array_equal(window.rewards[row], rewards)
            np.testing.assert_array_equal(window.discounts[row], discounts)
            np.testing.assert_array_equal(window.valid[row], valid)


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
    event = st.sampled_from([STEP] * draw(st.integers(1, 8)) + list(range(7)))
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


def filled(steps=30, **options):
    driver = Driver(**options)
    for _ in range(steps):
        driver.step([STEP] * driver.replay.num_streams)
    return driver


def test_shapes_and_dtypes_are_the_contract():
    window, indices = filled(num_streams=2, stack=4, horizon=3).replay.sample(5, 0.4)
    assert (window.frames.shape, window.frames.dtype) == ((5, 7, 2, 2), np.uint8)
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
    step = (np.zeros(2, int), np.zeros(2), *np.zeros((3, 2), bool), np.zeros((2, 2, 2), np.uint8))
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
        ("frames", np.zeros((2, 2, 2))),  # not uint8
        ("frames", np.zeros((2, 2, 3), np.uint8)),
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
        "frames": np.zeros((2, 2, 2), np.uint8),
    }
    with pytest.raises(ValueError, match=f"{field} must be"):
        driver.replay.add(**(step | {field: value}))
    driver.check_windows()


@pytest.mark.parametrize("streams", [[0, 0], [0, 2], [-1, 0], [[0, 1]]])
def test_bad_streams_are_refused(streams):
    with pytest.raises(ValueError, match="streams|frames"):
        Driver(num_streams=2).replay.begin(np.zeros((2, 2, 2), np.uint8), np.array(streams))


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


def test_memory_of_a_slot():
    # 84 * 84 = 7056 bytes of frame, at most 7200 with everything else. Memory is taken only as it
    # fills up, so this costs none.
    replay = Replay(capacity=100_000, num_streams=10)
    assert replay.slots == 10_000
    assert replay.frames.nbytes == 100_000 * 7056
    assert replay.frames.nbytes < replay.nbytes <= 100_000 * 7200
    arrays = [value for value in vars(replay).values() if isinstance(value, np.ndarray)]
    assert replay.nbytes == sum(array.nbytes for array in arrays) + replay.tree.nbytes
