"""Prioritized replay of single frames, kept once each, sampled as windows. numpy only.

Every stream (one environment) writes a ring of slots. A slot holds one observation's newest frame
and the step that followed it: action, reward, flags. The final observation of an episode takes a
slot too, for the losses that look at it, but no step follows it, so it is never sampled.

A position counts the observations of a stream, from 0, for ever; its slot is position % slots. A
slot can be sampled from the moment its whole horizon is known (the `horizon` observations after it
are stored, or the episode ended within them) until fewer than `stack - 1` older slots are left.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from srl_jax.replay.sumtree import SumTree
from srl_jax.types import Window

_ALL = slice(None)  # streams
_ENDED = 1  # the next observation is the episode's last one
_TERMINAL = 2  # the discount of this step is 0

_ARRAYS = ("actions", "rewards", "flags", "age", "next_position", "episode_start", "active")
_NUMBERS = ("max_priority", "num_transitions", "num_sampleable")

CHUNK_BYTES = 1 << 25
"""Size of the chunks of frames in a snapshot: what a checkpoint writes anew where a frame has changed."""
PRIORITY_EPSILON = 1e-6
"""Added to |TD error|, so that every transition keeps a chance (Schaul et al. 2016, sec. 3.3)."""


def least_capacity(num_streams: int, stack: int, horizon: int) -> int:
    """The fewest transitions that a `Replay` can have room for; a stream has to hold a window."""
    return num_streams * (stack + horizon + 2)  # a window, the slot being written, one spare


def _check(name, array, shape, dtype):
    """The array, if it has this shape and its numbers all fit this dtype."""
    array = np.asarray(array)
    if array.shape != shape or not (array.dtype == dtype or np.can_cast(array.dtype, dtype)):
        expected = f"{np.dtype(dtype)} {shape}"
        raise ValueError(f"{name} must be {expected}, got {array.dtype} {array.shape}")
    return array


def fitting(arrays: Mapping[str, np.ndarray], name: str, own: np.ndarray) -> np.ndarray:
    """An array of a snapshot that is to take the place of one's own.

    Raises:
        ValueError: it has another shape or dtype, in one line.
    """
    found = arrays[name]
    if (found.shape, found.dtype) != (own.shape, own.dtype):
        message = f"must be {own.dtype} {own.shape}, got {found.dtype} {found.shape}"
        raise ValueError(f"snapshot: {name} {message}")
    return found


class Replay:
    """Prioritized replay (Schaul et al. 2016, the proportional variant, stratified).

    Attributes, which together are all the state there is (N streams of L slots):
        frames: uint8 [N, L, H, W, C].
        actions, rewards, flags: int32, float32, uint8 [N, L], of the step after the frame. Flags:
            bit 0, the next observation is the episode's last; bit 1, the discount is 0.
        age: uint8 [N, L]; steps since the episode's first observation, at most stack - 1.
        next_position: int64 [N]; observations ever stored.
        episode_start: int64 [N]; position of the first observation of the newest episode.
        active: bool [N]; whether the newest episode goes on.
        tree: SumTree of N * L leaves, leaf stream * L + slot; 0 where it cannot be sampled.
        max_priority: float, the largest priority so far, at least 1; new transitions get it.
        num_transitions: int, transitions ever added.
        num_sampleable: int, leaves that are not 0; also `len`.
        rng: np.random.Generator, used by `sample` alone.
    """

    def __init__(
        self,
        *,
        capacity: int,
        num_streams: int,
        frame_shape: tuple[int, int, int] = (84, 84, 1),
        stack: int = 4,
        horizon: int = 3,
        gamma: float = 0.99,
        alpha: float = 0.5,
        seed: int = 0,
    ):
        """Makes an empty buffer. Its memory is reserved now, but taken only as it fills up.

        Args:
            capacity: transitions in all; each stream gets capacity // num_streams slots.
            num_streams: environments, N.
            frame_shape: (H, W, C), in pixels and channels.
            stack: frames in an observation, S.
            horizon: steps in a window, K.
            gamma: the discount of one step.
            alpha: exponent of the priorities, in [0, 1]; 0 samples uniformly.
            seed: of the sampling.

        Raises:
            ValueError: an argument is out of range, or there are too few slots for a window.
        """
        least = least_capacity(num_streams, stack, horizon)
        for holds, message in (
            (num_streams >= 1, f"num_streams must be at least 1, got {num_streams}"),
            (1 <= stack <= 256, f"stack must lie in [1, 256], got {stack}"),
            (horizon >= 1, f"horizon must be at least 1, got {horizon}"),
            (0 <= gamma <= 1, f"gamma must lie in [0, 1], got {gamma}"),
            (0 <= alpha <= 1, f"alpha must lie in [0, 1], got {alpha}"),
            (capacity >= least, f"capacity must be at least {least}, got {capacity}"),
        ):
            if not holds:
                raise ValueError(message)
        self.num_streams, self.slots = num_streams, capacity // num_streams
        self.frame_shape, self.stack, self.horizon = frame_shape, stack, horizon
        self.gamma, self.alpha = float(gamma), float(alpha)

        ring = (num_streams, self.slots)
        self.frames = np.zeros((*ring, *self.frame_shape), np.uint8)
        self.actions = np.zeros(ring, np.int32)
        self.rewards = np.zeros(ring, np.float32)
        self.flags = np.zeros(ring, np.uint8)
        self.age = np.zeros(ring, np.uint8)
        self.next_position = np.zeros(num_streams, np.int64)
        self.episode_start = np.zeros(num_streams, np.int64)
        self.active = np.zeros(num_streams, bool)
        self.tree = SumTree(num_streams * self.slots)
        self.max_priority = 1.0
        self.num_transitions = self.num_sampleable = 0
        self.rng = np.random.default_rng(seed)

        self._streams = np.arange(num_streams)
        self._steps_back = np.arange(horizon, 0, -1)
        self._steps = np.arange(horizon)
        self._window_offsets = np.arange(1 - stack, horizon + 1)

    def __len__(self) -> int:
        """Transitions that can be sampled now."""
        return self.num_sampleable

    def begin(self, frames: np.ndarray, streams: np.ndarray | None = None) -> None:
        """Stores the first frames of new episodes.

        A stream in the middle of an episode (its environment was reset early) is truncated at the
        newest observation stored.

        Args:
            frames: uint8 [M, H, W, C].
            streams: int [M], no stream twice; None for all, in order.

        Raises:
            ValueError: a shape, a dtype or a stream is wrong; nothing is stored then.
        """
        streams = self._streams if streams is None else np.asarray(streams)
        if streams.size and streams.dtype.kind not in "iu":
            raise ValueError(f"streams must be indices, not {streams.dtype}")
        streams = streams.astype(np.int64, copy=False)
        if len(set(streams.ravel().tolist()) & set(range(self.num_streams))) != streams.size:
            raise ValueError(f"streams must be distinct and below {self.num_streams}: {streams}")
        frames = _check("frames", frames, (len(streams), *self.frame_shape), np.uint8)
        cut = streams[self.active[streams]]
        if cut.size:
            # The step before the newest observation; where there is none, no window reads the flag.
            self._flat(self.flags)[self._leaf(cut, self.next_position[cut] - 2)] |= _ENDED
            # The slot `horizon` steps back could be sampled before, and keeps its priority.
            self._update_tree(cut, np.ones(len(cut), bool), self._steps_back[1:])
        self.active[streams] = True
        self.episode_start[streams] = self.next_position[streams]
        self._store(streams, frames)
        self._update_tree(streams, np.zeros(len(streams), bool), self._steps_back)

    def add(
        self,
        actions: np.ndarray,
        rewards: np.ndarray,
        terminated: np.ndarray,
        truncated: np.ndarray,
        life_lost: np.ndarray,
        frames: np.ndarray,
    ) -> None:
        """Stores one step of every stream.

        Args:
            actions: int [N].
            rewards: float [N], as they are to be learnt from.
            terminated: bool [N]; the game is over: discount 0, the episode ends.
            truncated: bool [N]; a time limit: the episode ends with discount gamma (unless another
                flag says 0), so that a learner bootstraps from the final observation.
            life_lost: bool [N]; discount 0, but the episode and its frame stack go on.
            frames: uint8 [N, H, W, C], after the actions; the episode's final frame where it ended.

        Raises:
            RuntimeError: a stream has not begun an episode since its last one ended.
            ValueError: a shape or a dtype is wrong. Nothing is stored in either case.
        """
        if not self.active.all():
            waiting = self._streams[~self.active].tolist()
            raise RuntimeError(f"begin an episode before the next add: streams {waiting}")
        shape = (self.num_streams,)
        actions = _check("actions", actions, shape, np.int64)
        rewards = _check("rewards", rewards, shape, np.float64)
        terminated = _check("terminated", terminated, shape, bool)
        truncated = _check("truncated", truncated, shape, bool)
        life_lost = _check("life_lost", life_lost, shape, bool)
        frames = _check("frames", frames, (*shape, *self.frame_shape), np.uint8)

        ended = terminated | truncated
        leaves = self._leaf(self._streams, self.next_position - 1)
        self._flat(self.actions)[leaves] = actions
        self._flat(self.rewards)[leaves] = rewards
        self._flat(self.flags)[leaves] = ended + (terminated | life_lost).view(np.uint8) * _TERMINAL
        self._store(_ALL, frames)
        self._update_tree(_ALL, ended, self._steps_back)
        self.active &= ~ended
        self.num_transitions += self.num_streams

    def sample(
        self,
        batch_size: int,
        beta: float,
        rng: np.random.Generator | None = None,
        *,
        gamma: float | None = None,
        n_step: int | None = None,
    ) -> tuple[Window, np.ndarray]:
        """Draws windows in proportion to their priorities, stratified.

        Args:
            batch_size: B.
            beta: exponent of the importance weights (N_sampleable * p_i / sum p) ** -beta, divided by the
                batch's largest.
            rng: draws in place of the replay's own, which is then left as it is.
            gamma: in place of the replay's own.
            n_step: every row's n of RL's return; None: the window has none.

        Returns:
            The Window, of arrays that nothing else refers to, and int64 [B] indices, one a row, for
            `set_priorities`: position * N + stream.

        Raises:
            ValueError: nothing can be sampled yet, or batch_size is below 1, or n_step is not in
                1..horizon.
        """
        if n_step is not None and not 1 <= n_step <= self.horizon:
            raise ValueError(f"n_step must be in 1..{self.horizon}, the horizon, not {n_step}")
        if batch_size < 1 or not self.num_sampleable:
            raise ValueError(f"cannot draw {batch_size} of {self.num_sampleable} transitions")
        leaves = self.tree.sample_stratified(batch_size, self.rng if rng is None else rng)
        priority = self.tree.get(leaves)
        # The number of transitions and the sum of priorities cancel when divided by the largest weight.
        weight = ((priority.min() / priority) ** beta).astype(np.float32)
        streams, positions = self._locate(leaves)
        window = self._window(streams, positions, weight, self.gamma if gamma is None else gamma)
        if n_step is not None:
            window = window._replace(n_step=np.full(batch_size, n_step, np.int32))
        return window, positions * self.num_streams + streams

    def sampleable(self) -> np.ndarray:
        """The indices, int64 [len(self)], of all transitions that can be sampled now."""
        streams, positions = self._locate(np.flatnonzero(self.tree.leaves))
        return positions * self.num_streams + streams

    def gather(self, indices: np.ndarray) -> Window:
        """The Window of given indices, int64 [B], with weights of 1.

        Raises:
            ValueError: an index can no longer be sampled.
        """
        indices = np.asarray(indices, np.int64)
        if not self._find(indices)[1].all():
            raise ValueError("an index is not sampleable (any more)")
        positions, streams = np.divmod(indices, self.num_streams)
        return self._window(streams, positions, np.ones(len(indices), np.float32), self.gamma)

    def set_priorities(self, indices: np.ndarray, td_errors: np.ndarray) -> None:
        """Sets priorities to (|td_error| + 1e-6) ** alpha.

        Indices whose slot has been overwritten, or can no longer be sampled, are ignored.

        Args:
            indices: int64 [B], from `sample`. Where one is repeated, its last error counts.
            td_errors: float [B].

        Raises:
            ValueError: the shapes differ, or a TD error is not finite; nothing is changed then.
        """
        indices = np.asarray(indices, np.int64)
        td_errors = _check("td_errors", td_errors, indices.shape, np.float64)
        if not np.isfinite(td_errors).all():
            raise ValueError("td_errors must be finite")
        leaves, keep = self._find(indices)
        priorities = (np.abs(td_errors, dtype=np.float64) + PRIORITY_EPSILON) ** self.alpha
        if not keep.all():
            leaves, priorities = leaves[keep], priorities[keep]
        self.tree.put(leaves, priorities)
        self.max_priority = float(priorities.max(initial=self.max_priority))

    def snapshot(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """All state: arrays, some of them views, and numbers that JSON can hold.

        They are for `restore`. A view shows later changes: write it, or copy it, before the next call. Frames
        come in chunks of `CHUNK_BYTES`, "frames_00000" and so on, of the slots that were ever written.
        """
        arrays = {name: getattr(self, name) for name in _ARRAYS} | {"priorities": self.tree.leaves}
        numbers = {name: getattr(self, name) for name in _NUMBERS} | {"rng": self.rng.bit_generator.state}
        return arrays | {name: self.frames[:, slots] for name, slots in self._chunks()}, numbers

    def _chunks(self) -> list[tuple[str, slice]]:
        """Names and slots of the chunks of frames."""
        size = max(1, CHUNK_BYTES // (self.num_streams * int(np.prod(self.frame_shape))))
        filled = min(int(self.next_position.max()), self.slots)
        return [
            (f"frames_{start // size:05d}", slice(start, min(start + size, self.slots)))
            for start in range(0, filled, size)
        ]

    def unchanged_chunks(self, since: np.ndarray) -> list[str]:
        """Names of the chunks of a snapshot that hold what they held at an earlier moment.

        Args:
            since: int64 [N], a copy of `next_position` of that moment; zeros for the very start.
        """
        changed = self.changed_slots(since)
        return [name for name, slots in self._chunks() if not changed[slots].any()]

    def restore(self, arrays: Mapping[str, np.ndarray], numbers: Mapping[str, Any]) -> None:
        """Takes over the state of a `snapshot`; whatever is done next then has the same results to the bit.

        Args:
            arrays, numbers: from a replay that was made with the same arguments. Each chunk of frames is
                asked for once, so that arrays may be read from disk then.

        Raises:
            ValueError: an array has another shape or dtype, in one line; the replay is of no use then.
        """

        for name in _ARRAYS:
            own = getattr(self, name)
            own[...] = fitting(arrays, name, own)
        for name in _NUMBERS:
            setattr(self, name, numbers[name])
        self.tree.fill(fitting(arrays, "priorities", self.tree.leaves))
        self.rng.bit_generator.state = numbers["rng"]
        for name, slots in self._chunks():
            own = self.frames[:, slots]
            own[:] = fitting(arrays, name, own)

    def changed_slots(self, since: np.ndarray) -> np.ndarray:
        """Which slots, bool [L], had a frame written in any stream since an earlier moment.

        Args:
            since: int64 [N], a copy of `next_position` of that moment; zeros for the very start.
        """
        laps_behind = (np.arange(self.slots) - since[:, None]) % self.slots
        return (laps_behind < (self.next_position - since)[:, None]).any(axis=0)

    def _flat(self, array):
        """A view of [N, L, ...] as [N * L, ...], so that leaves index it."""
        return array.reshape(-1, *array.shape[2:])

    def _leaf(self, streams, positions):
        return streams * self.slots + positions % self.slots

    def _locate(self, leaves):
        """Streams and positions of leaves: the newest position that has that slot."""
        streams, slot = np.divmod(leaves, self.slots)
        newest = self.next_position[streams] - 1
        return streams, newest - (newest - slot) % self.slots

    def _find(self, indices):
        """The leaves of indices, and whether they can be sampled."""
        positions, streams = np.divmod(indices, self.num_streams)
        leaves = self._leaf(streams, positions)
        # Not overwritten: no newer position has that slot.
        newest = self.next_position.take(streams) - 1
        return leaves, (positions > newest - self.slots) & (positions <= newest) & (self.tree.get(leaves) > 0)

    def _store(self, streams, frames):
        """Stores the next observations, of int [M] streams or of a slice: frame and age."""
        positions = self.next_position[streams]
        steps = positions - self.episode_start[streams]
        leaves = self._leaf(self._streams[streams], positions)
        self._flat(self.frames)[leaves] = frames
        self._flat(self.age)[leaves] = np.minimum(steps, self.stack - 1)
        self.next_position[streams] += 1

    def _update_tree(self, streams, ended, steps_back):
        """Opens the slots whose horizon the newest observation completes, closes the oldest one.

        Where it is its episode's last one (ended, bool [M]), every slot of the episode among those
        `steps_back`, int [J], is complete, else only the one `horizon` steps back.
        """
        newest, start = self.next_position[streams] - 1, self.episode_start[streams]
        base = self._streams[streams] * self.slots
        # Slots from newest - slots + 1 on are intact; the first stack - 1 of them may lack frames.
        oldest = newest - (self.slots - self.stack + 1)
        closed = (base + oldest % self.slots)[oldest >= 0]
        if ended.any():
            positions = newest[:, None] - steps_back
            opens = ended[:, None] | (steps_back == self.horizon)
            opens &= positions >= start[:, None]
            opened = (base[:, None] + positions % self.slots)[opens]
        else:
            positions = newest - self.horizon
            opened = (base + positions % self.slots)[positions >= start]
        self.num_sampleable += len(opened) - int(np.count_nonzero(self.tree.get(closed)))
        values = np.zeros(len(closed) + len(opened))
        values[len(closed) :] = self.max_priority
        self.tree.put(np.concatenate((closed, opened)), values)

    def _window(self, streams, positions, weight, gamma):
        """The Window of sampleable positions: see types.Window."""
        base = (streams * self.slots)[:, None]
        steps = base + (positions[:, None] + self._steps) % self.slots
        actions, rewards = self._flat(self.actions).take(steps), self._flat(self.rewards).take(steps)
        times = positions[:, None] + self._window_offsets
        age = self._flat(self.age).take(steps[:, 0])
        if age.min(initial=self.stack) < self.stack - 1:
            times = np.maximum(times, (positions - age)[:, None])
        flags = self._flat(self.flags).take(steps)
        if flags.any():
            valid = np.ones(steps.shape, bool)
            # Slots after the end hold other episodes: a step counts only if no step before it ended.
            np.logical_and.accumulate((flags[:, :-1] & _ENDED) == 0, axis=1, out=valid[:, 1:])
            goes_on = valid & ((flags & _TERMINAL) == 0)
            times = np.minimum(times, (positions + np.add.reduce(valid, axis=1))[:, None])
            actions, rewards = np.where(valid, actions, np.int32(0)), np.where(valid, rewards, np.float32(0))
            discounts = np.where(goes_on, np.float32(gamma), np.float32(0))
            valid = valid.astype(np.float32)
        else:
            discounts = np.full(steps.shape, gamma, np.float32)
            valid = np.ones(steps.shape, np.float32)
        frames = self._flat(self.frames).take(base + times % self.slots, axis=0)
        return Window(frames, actions, rewards, discounts, valid, weight)
