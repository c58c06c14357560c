"""What all environments have in common: spaces, checks, seeds, who may be stepped, snapshots."""

import hashlib
import operator
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Box, Discrete
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space


class FrameVectorEnv(VectorEnv):
    """N copies of a game that show one frame each; stacking is the caller's business.

    Nothing resets by itself. The caller resets ended environments at once, by mask::

        frames, rewards, terminated, truncated, info = envs.step(actions)
        ended = terminated | truncated
        if ended.any():
            frames, info = envs.reset(options={"reset_mask": ended})

    Then every step that is taken belongs to a game. The arrays returned are the caller's own.

    `snapshot` and `restore` carry a run over to another process: a new environment of the same
    arguments goes on as the old one would have, to the bit.

    The randomness of environment i depends on the seed and on i alone, not on N, on the order of
    resets or on other environments; `numpy.random.SeedSequence` keeps neighbouring seeds apart.

    Attributes:
        single_observation_space: Box(uint8, (H, W, C)); C is 1 for grey, 3 for colour.
        single_action_space: Discrete(A).
        action_meanings: the A names of the actions.
        state_names: of the numbers in `info["state"]`, float [N, V], the game's true state; () where it is
            not known.
        state_problem: why it is not known although it should be; empty where all is well.
    """

    # Not inherited: ale_py writes its own mode into the dict of gymnasium's base class.
    metadata = {"autoreset_mode": AutoresetMode.DISABLED}
    single_observation_space: Box
    single_action_space: Discrete
    state_names: tuple[str, ...] = ()
    state_problem = ""
    _restored_by = ""
    """How `_restore` rebuilds the state, and what it means where that fails: follows the error."""

    def __init__(
        self,
        *,
        num_envs: int,
        seed: int,
        frame_shape: tuple[int, int, int],
        action_meanings: Iterable[str],
    ):
        """Sets up the spaces and the seeds; `frame_shape` is (H, W, C).

        Raises:
            ValueError: num_envs is not positive or seed is negative.
        """
        check_number(num_envs)
        self.num_envs = num_envs
        self.action_meanings = tuple(action_meanings)
        self.single_observation_space = Box(0, 255, frame_shape, np.uint8)
        self.single_action_space = Discrete(len(self.action_meanings))
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._seeds = [check_seed(seed)] * num_envs
        self._started = False
        self._ended = np.zeros(num_envs, bool)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Starts new episodes, in all environments or in those of a mask.

        Args:
            seed: None goes on with the environments' own streams. An int starts the streams of the
                environments that are being reset afresh from it: same seed, same games.
            options: {"reset_mask": bool [N]}; the others keep their state and show it. The first
                reset must be a full one.

        Returns:
            frames: uint8 [N, H, W, C].
            info: as `step`'s.

        Raises:
            ValueError: a bad seed, mask or option.
            gymnasium.error.ResetNeeded: the first reset is partial.
        """
        mask = self._check_mask(options)
        if not (self._started or mask.all()):
            raise ResetNeeded("the first reset must be of all environments")
        if seed is not None:
            seed = check_seed(seed)
            for i in np.flatnonzero(mask):
                self._seeds[i] = seed
        frames, info = self._reset(mask, seed is not None)
        self._started = True
        self._ended[mask] = False
        return frames, info

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, np.ndarray]]:
        """Takes one decision in every environment.

        Args:
            actions: int32 or int64 [N], each in [0, A).

        Returns:
            frames: uint8 [N, H, W, C]; an ended environment's is the last frame of its episode.
            rewards: float32 [N], the game's own score, not clipped.
            terminated: bool [N], the game is over. A lost life is not the end of a game.
            truncated: bool [N], stopped by the limit of frames and not terminated.
            info: arrays with one row per environment, among them `life_lost`, bool [N]: the number
                of lives fell in this step, whether or not the game ended with it. It resets
                nothing.

        Raises:
            ValueError: wrong shape, dtype or range of the actions; nothing was stepped.
            gymnasium.error.ResetNeeded: an environment has ended, or was never reset; nothing was
                stepped.
        """
        actions = self._check_actions(actions)
        if not self._started:
            raise ResetNeeded("step before the first reset")
        if self._ended.any():
            which = np.flatnonzero(self._ended).tolist()
            raise ResetNeeded(f"environments {which} have ended: reset them before stepping on")
        frames, rewards, terminated, truncated, info = self._step(actions)
        np.logical_or(terminated, truncated, out=self._ended)
        return frames, rewards, terminated, truncated, info

    def snapshot(self) -> dict[str, np.ndarray]:
        """Everything that the environments' future depends on, for `restore`; changes nothing.

        Returns:
            Arrays of numbers or bools that nothing else refers to. `seeds` int64 [N]; `ended` bool
            [N], waits for a reset; `frames_sha256` uint8 [N, 32], of each environment's frame as it
            was last seen, which `restore` is checked by; and what the game adds.

        Raises:
            gymnasium.error.ResetNeeded: before the first reset.
        """
        if not self._started:
            raise ResetNeeded("snapshot before the first reset")
        seeds = np.array(self._seeds, np.int64)
        common = {"seeds": seeds, "ended": self._ended.copy(), "frames_sha256": sha256(self._seen())}
        return common | self._snapshot()

    def restore(self, snapshot: Mapping[str, np.ndarray]) -> np.ndarray:
        """Goes on where a snapshot was taken; meant for an environment that was just made.

        Args:
            snapshot: from `snapshot` of an environment that was made with the same arguments.

        Returns:
            The frames as they were last seen, uint8 [N, H, W, C].

        Raises:
            KeyError: an array is missing.
            ValueError: the snapshot is of another number of environments, or what was rebuilt is not what it
                says; the message names the environments, and none can be stepped before a full reset.
        """
        number, found = self.num_envs, len(snapshot["seeds"])
        if found != number:
            raise ValueError(f"the snapshot is of {found} environments, not of {number}")
        self._seeds = snapshot["seeds"].tolist()
        self._started = False
        rebuilt = self._restore(snapshot)
        frames = self._seen()
        rebuilt["frames_sha256"] = sha256(frames)
        for name, array in rebuilt.items():
            differs = (array != snapshot[name]).reshape(number, -1).any(1)
            if differs.any():
                which = np.flatnonzero(differs).tolist()
                raise ValueError(
                    f"environments {which} cannot be rebuilt: not the snapshot's {name}" + self._restored_by
                )
        self._ended = snapshot["ended"].copy()
        self._started = True
        return frames

    def _snapshot(self) -> dict[str, np.ndarray]:
        """The game's own arrays of a snapshot, as copies."""
        raise NotImplementedError

    def _restore(self, arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Brings the game to the state of a snapshot.

        Returns:
            Arrays of the snapshot, `ended` among them, as they follow from the state that was rebuilt:
            the caller compares.
        """
        raise NotImplementedError

    def _seen(self) -> np.ndarray:
        """The frames as they were last seen, uint8 [N, H, W, C], as an array of the caller's."""
        raise NotImplementedError

    def _reset(self, mask: np.ndarray, seeded: bool) -> tuple:
        """Resets the environments of the mask; `seeded` says that their streams start afresh."""
        raise NotImplementedError

    def _step(self, actions: np.ndarray) -> tuple:
        """Steps all environments; the actions have been checked."""
        raise NotImplementedError

    def _stream(self, env: int, *purpose: int) -> np.random.SeedSequence:
        """The randomness of one environment for one purpose, say its k-th episode.

        Counting instead of drawing from one long stream keeps the state of the randomness down to a
        few counters.
        """
        return np.random.SeedSequence(self._seeds[env], spawn_key=(int(env), *purpose))

    def _check_mask(self, options: dict[str, Any] | None) -> np.ndarray:
        options = dict(options or {})
        mask = options.pop("reset_mask", None)
        if options:
            raise ValueError(f"unknown reset options {sorted(options)}; valid: reset_mask")
        if mask is None:
            return np.ones(self.num_envs, bool)
        mask = np.asarray(mask)
        if mask.dtype != bool or mask.shape != (self.num_envs,):
            raise ValueError(
                f"reset_mask must be bool [{self.num_envs}], got {mask.dtype} {list(mask.shape)}"
            )
        return mask

    def _check_actions(self, actions: np.ndarray) -> np.ndarray:
        actions = np.asarray(actions)
        count = int(self.single_action_space.n)
        if actions.dtype not in (np.int32, np.int64) or actions.shape != (self.num_envs,):
            raise ValueError(
                f"actions must be int32 or int64 [{self.num_envs}], got {actions.dtype} {list(actions.shape)}"
            )
        if actions.min() < 0 or actions.max() >= count:
            raise ValueError(f"actions must lie in [0, {count}), got {actions.tolist()}")
        return actions


def check_number(num_envs: int) -> None:
    """Raises ValueError if it is not positive."""
    if num_envs < 1:
        raise ValueError(f"num_envs must be at least 1, got {num_envs}")


def check_seed(seed: int) -> int:
    """Returns the seed as an int.

    Raises:
        ValueError: it is not an integer in [0, 2**63), which snapshots keep as int64.
    """
    try:
        seed = operator.index(seed)
    except TypeError:
        raise ValueError(f"seed must be an integer, got {seed!r}") from None
    if not 0 <= seed < 2**63:
        raise ValueError(f"seed must lie in [0, 2**63), got {seed}")
    return seed


def sha256(frames: np.ndarray) -> np.ndarray:
    """The hash of each row's bytes: uint8 [N, 32]."""
    digests = b"".join(hashlib.sha256(frame.tobytes()).digest() for frame in frames)
    return np.frombuffer(digests, np.uint8).reshape(len(frames), 32).copy()
