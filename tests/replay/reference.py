"""What a replay should hold, as lists of whole episodes; and a driver that compares the two.

The reference shares no code with srl_jax/replay/__init__.py: it keeps every observation for ever and looks
everything up slowly. Nothing here is an `assert`, so that `python -O` checks as much.
"""

import itertools
import json
from bisect import bisect_right
from unittest import mock

import numpy as np

from srl_jax import replay
from srl_jax.replay import Replay

GAMMA = 0.5  # powers of it are exact
STEP, TERMINATED, TRUNCATED, LIFE_LOST, BOTH, LIFE_AND_TRUNCATED, RESET = EVENTS = range(7)


class Episode:
    """Every observation of an episode, and the step (action, reward, is_terminal) after each."""

    def __init__(self, start, frame):
        self.start, self.frames, self.steps, self.over = start, [frame], [], False


class Reference:
    """What a replay should hold: keeps everything for ever, looks everything up slowly."""

    def __init__(self, num_streams, slots, stack, horizon, alpha=0.5, seed=0):
        self.slots, self.stack, self.horizon, self.alpha = slots, stack, horizon, alpha
        self.episodes = [[] for _ in range(num_streams)]
        self.learnt = {}  # {index: priority}, of everything that could ever be sampled
        self.max_priority = 1.0
        self.rng = np.random.default_rng(seed)

    def observations(self, stream):
        episodes = self.episodes[stream]
        return episodes[-1].start + len(episodes[-1].frames) if episodes else 0

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
            for episode in reversed(episodes):
                if episode.start + len(episode.frames) <= oldest:
                    break
                for t in range(max(oldest - episode.start, 0), len(episode.steps)):
                    if episode.over or t + self.horizon <= len(episode.steps):
                        result[(episode.start + t) * len(self.episodes) + stream] = (episode, t)
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

    def priorities(self):
        """{index: priority} of what can be sampled. The maximum has not changed since they came."""
        return {index: self.learnt.setdefault(index, self.max_priority) for index in self.sampleable()}

    def set_priorities(self, indices, td_errors):
        can = self.priorities()
        for index, error in zip(indices, td_errors, strict=True):
            if index in can:
                self.learnt[index] = (abs(error) + 1e-6) ** self.alpha
                self.max_priority = max(self.max_priority, self.learnt[index])

    def leaf(self, index):
        position, stream = divmod(index, len(self.episodes))
        return stream * self.slots + position % self.slots

    def draw(self, n):
        """The indices that a stratified sample finds, each as a pair: rounding may choose between the two."""
        priorities = sorted((self.leaf(index), p, index) for index, p in self.priorities().items())
        ends = list(itertools.accumulate(p for _, p, _ in priorities))
        uniforms = self.rng.random(n).tolist()
        for i, uniform in enumerate(uniforms):
            point = (i + uniform) / n * ends[-1]
            yield tuple(
                priorities[min(bisect_right(ends, point * nearly), len(ends) - 1)][2]
                for nearly in (1 - 1e-12, 1 + 1e-12)
            )


class Driver:
    """Sends the same experience to a Replay and to the Reference; no two frames are alike.

    After `restore` it sends it to the restored replay and to the one before, which have to agree to the bit.

    Attributes:
        replay: the Replay under test.
        reference: the Reference.
        twin: the Replay that `replay` was restored from, or None.
        waiting: streams that have to begin an episode.
    """

    def __init__(self, *, num_streams=1, slots=12, stack=2, horizon=1, alpha=0.5, spare=0, seed=0):
        self.options = {
            "capacity": num_streams * slots + spare,
            "num_streams": num_streams,
            "frame_shape": (2, 1, 2),
            "stack": stack,
            "horizon": horizon,
            "gamma": GAMMA,
            "alpha": alpha,
            "seed": seed,
        }
        self.replay, self.twin = Replay(**self.options), None
        self.reference = Reference(num_streams, slots, stack, horizon, alpha, seed)
        self.waiting = set(range(num_streams))
        self.count = itertools.count(1)
        self.disk = {}
        self.written = self.replay.next_position.copy()  # what `disk` is of

    def new_frames(self, n):
        ids = np.array([next(self.count) for _ in range(n)], np.uint32)
        return ids.view(np.uint8).reshape(n, 2, 1, 2).copy()

    def both(self, method, *arguments):
        """The result of a call; its twin's has to be the same to the bit."""
        result = getattr(self.replay, method)(*arguments)
        if self.twin is not None:
            same_bits(f"{method} after a restore", result, getattr(self.twin, method)(*arguments))
        return result

    def begin(self, streams):
        """New episodes, begun or reset."""
        frames = self.new_frames(len(streams))
        everyone = len(streams) == self.replay.num_streams
        self.both("begin", frames, None if everyone else np.array(streams))
        for stream, frame in zip(streams, frames, strict=True):
            self.reference.begin(stream, frame.copy())
        self.waiting -= set(streams)

    def step(self, events):
        """One step of every stream, after `begin` for those that wait for it or are to be reset."""
        events = np.array(events)
        streams = sorted(self.waiting | set(np.flatnonzero(events == RESET).tolist()))
        if streams:
            self.begin(streams)
        frames = self.new_frames(len(events))
        numbers = frames.reshape(-1, 4).copy().view(np.uint32)[:, 0].astype(np.int64)
        terminated = np.isin(events, [TERMINATED, BOTH])
        truncated = np.isin(events, [TRUNCATED, BOTH, LIFE_AND_TRUNCATED])
        life_lost = np.isin(events, [LIFE_LOST, LIFE_AND_TRUNCATED])
        actions, rewards = numbers % 18, (numbers % 7 - 3).astype(np.float32)
        self.both("add", actions, rewards, terminated, truncated, life_lost, frames)
        over = terminated | truncated
        for i in range(len(events)):
            is_terminal = bool(terminated[i] or life_lost[i])
            frame = frames[i].copy()
            self.reference.add(i, actions[i], rewards[i], is_terminal, bool(over[i]), frame)
        self.waiting = set(np.flatnonzero(over).tolist())
        frames[:] = 255  # the caller may reuse its buffer

    def sample(self, batch_size, beta):
        """A sample, compared in every index, weight and window; returns the indices."""
        window, indices = self.both("sample", batch_size, beta)
        indices = indices.tolist()
        for index, expected in zip(indices, self.reference.draw(batch_size), strict=True):
            if index not in expected:
                raise AssertionError(f"sample: drew index {index}, not {expected[0]}")
        can, priorities = self.reference.sampleable(), self.reference.priorities()
        self._check_rows(window, [can[index] for index in indices])
        drawn = np.array([priorities[index] for index in indices])
        weight = (drawn.min() / drawn) ** beta
        if not (np.abs(window.weight - weight) <= 1e-6 * weight).all():
            raise AssertionError(f"weights: {window.weight.tolist()} are not {weight.tolist()}")
        return indices

    def set_priorities(self, indices, td_errors):
        self.both("set_priorities", np.array(indices, np.int64), np.array(td_errors, np.float64))
        self.reference.set_priorities(indices, td_errors)

    def restore(self):
        """Goes on with a new replay, made from bytes and JSON; frames are kept as a checkpoint keeps them."""
        with mock.patch.object(replay, "CHUNK_BYTES", 60):  # so that there are several
            arrays, numbers = self.replay.snapshot()
            unchanged = self.replay.unchanged_chunks(self.written)
            self._restore(arrays, numbers, unchanged)

    def _restore(self, arrays, numbers, unchanged):
        for name, array in arrays.items():
            if name not in unchanged:
                self.disk[name] = array.tobytes(), array.dtype.str, array.shape
        self.written = self.replay.next_position.copy()
        data = {name: self.disk[name] for name in arrays}
        text = json.dumps(numbers)
        self.twin, self.replay = self.replay, Replay(**self.options)
        self.replay.restore(
            {name: np.frombuffer(d, dtype).reshape(shape) for name, (d, dtype, shape) in data.items()},
            json.loads(text),
        )
        same_state(self.replay, self.twin)

    def check(self):
        """Compares everything that is cheap to compare: what can be sampled, every priority, the counts."""
        replay, priorities = self.replay, self.reference.priorities()
        expected = np.zeros(replay.num_streams * replay.slots)
        for index, priority in priorities.items():
            expected[self.reference.leaf(index)] = priority
        leaves = replay.tree.leaves
        if not (np.abs(leaves - expected) <= 1e-12 * expected).all():  # pow may differ in the last bit
            raise AssertionError(f"priorities: {leaves.tolist()} are not {expected.tolist()}")
        steps = sum(len(episode.steps) for episode in self.reference.episodes[0])
        for what, number, right in (
            ("len", len(replay), len(priorities)),
            ("num_transitions", replay.num_transitions, steps * replay.num_streams),
        ):
            if number != right:
                raise AssertionError(f"{what} is {number}, not {right}")
        for what, number, right in (
            ("max_priority", replay.max_priority, self.reference.max_priority),
            ("the total", replay.tree.total, sum(priorities.values())),
        ):
            if abs(number - right) > 1e-12 * right:
                raise AssertionError(f"{what} is {number}, not {right}")

    def check_indices(self):
        """Compares which transitions can be sampled, and returns them as the reference does."""
        expected = self.reference.sampleable()
        found = sorted(self.replay.sampleable().tolist())
        if found != sorted(expected) or len(self.replay) != len(expected):
            raise AssertionError(f"sampleable: {len(self.replay)}, {found}, not {sorted(expected)}")
        return expected

    def check_windows(self):
        """Compares the windows of everything that can be sampled."""
        expected = self.check_indices()
        self._check_rows(self.replay.gather(np.array(list(expected), np.int64)), list(expected.values()))

    def _check_rows(self, window, transitions):
        if not transitions:
            return
        rows = zip(*(self.reference.window(*transition) for transition in transitions), strict=True)
        for name, column in zip(window._fields, rows, strict=False):
            found, expected = getattr(window, name), np.stack(column)
            wrong = np.flatnonzero((found != expected).reshape(len(found), -1).any(axis=1))
            if wrong.size:
                i = wrong[0]
                text = f"{found[i].tolist()} are not {expected[i].tolist()}"
                raise AssertionError(f"windows: {name} of step {transitions[i][1]} of an episode: {text}")


def same_bits(what, first, second):
    """Raises AssertionError if two results, arrays or tuples of them, differ in a bit, a shape or a dtype."""
    if isinstance(first, tuple):
        for a, b in zip(first, second, strict=True):
            same_bits(what, a, b)
    elif isinstance(first, np.ndarray):
        if (first.shape, first.dtype, first.tobytes()) != (second.shape, second.dtype, second.tobytes()):
            raise AssertionError(f"{what}: {first.tolist()} is not {second.tolist()} to the bit")
    elif first != second:
        raise AssertionError(f"{what}: {first} is not {second}")


def same_state(first, second):
    """Raises AssertionError if two replays differ in anything that they hold, sums and generator included."""
    for name, value in vars(first).items():
        other = getattr(second, name)
        if name == "tree":
            for part in vars(value):
                same_bits(f"restored tree.{part}", getattr(value, part), getattr(other, part))
        elif name == "rng":
            same_bits("restored rng", value.bit_generator.state, other.bit_generator.state)
        else:
            same_bits(f"restored {name}", value, other)
