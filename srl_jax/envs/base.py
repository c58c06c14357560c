"""What Atari and Catch have in common: spaces, checks, seeds, and who may be stepped."""

import operator
from typing import Any

import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Box, Discrete
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space


class FrameVectorEnv(VectorEnv):
    """N copies of a game that show one greyscale frame each; stacking is the caller's business.

    Nothing resets by itself. The caller resets ended environments at once, by mask::

        frames, rewards, terminated, truncated, info = envs.step(actions)
        ended = terminated | truncated
        if ended.any():
            frames, info = envs.reset(options={"reset_mask": ended})

    Then every step that is taken belongs to a game. The arrays returned are the caller's own.

    The randomness of environment i depends on the seed and on i alone, not on N, on the order of
    resets or on other environments; `numpy.random.SeedSequence` keeps neighbouring seeds apart.

    Attributes:
        single_observation_space: Box(uint8, (H, W)).
        single_action_space: Discrete(A).
        action_meanings: the A names of the actions.
    """

    # Not inherited: ale_py writes its own mode into the dict of gymnasium's base class.
    metadata = {"autoreset_mode": AutoresetMode.DISABLED}

    def __init__(self, *, num_envs: int, seed: int, frame_size: int, action_meanings: tuple):
        """Sets up the spaces and the seeds.

        Raises:
            ValueError: num_envs is not positive or seed is negative.
        """
        if num_envs < 1:
            raise ValueError(f"num_envs must be at least 1, got {num_envs}")
        self.num_envs = num_envs
        self.action_meanings = tuple(action_meanings)
        self.single_observation_space = Box(0, 255, (frame_size, frame_size), np.uint8)
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
            frames: uint8 [N, H, W].
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
            frames: uint8 [N, H, W]; an ended environment's is the last frame of its episode.
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


def check_seed(seed: int) -> int:
    """Returns the seed as an int.

    Raises:
        ValueError: it is not a non-negative integer.
    """
    try:
        seed = operator.index(seed)
    except TypeError:
        raise ValueError(f"seed must be an integer, got {seed!r}") from None
    if seed < 0:
        raise ValueError(f"seed must not be negative, got {seed}")
    return seed
