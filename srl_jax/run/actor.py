"""What the loop needs to act: environments, stacks of frames, policies, schedules, seeds, threads."""

import os
import sys
import threading
import zlib
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from srl_jax import envs
from srl_jax.config import Config

Policy = Callable[[np.ndarray, int, float], np.ndarray]
"""(frames uint8 [N, S, H, W, C], step, epsilon) -> actions int32 [N]; its draws depend on the step."""


class FrameStack:
    """The last S frames of N environments; an episode's first frame stands in for those before it.

    Attributes:
        frames: uint8 [N, S, H, W, C], newest last; all the state there is.

    Args:
        num_envs: N.
        stack: S.
        frame_shape: (H, W, C).
    """

    def __init__(self, num_envs: int, stack: int, frame_shape: tuple):
        self.frames = np.zeros((num_envs, stack, *frame_shape), np.uint8)

    def begin(self, frames: np.ndarray, mask: np.ndarray | None = None) -> None:
        """Starts episodes from frames uint8 [N, H, W, C], where mask bool [N] says so (None: everywhere)."""
        mask = np.ones(len(frames), bool) if mask is None else mask
        self.frames[mask] = frames[mask][:, None]

    def push(self, frames: np.ndarray) -> None:
        """Adds the next frame of every environment, uint8 [N, H, W, C]."""
        self.frames[:, :-1] = self.frames[:, 1:]
        self.frames[:, -1] = frames

    def observations(self) -> np.ndarray:
        """uint8 [N, S, H, W, C], newest last: a fresh array, as jax may go on reading what it was handed."""
        return self.frames.copy()


def seed_for(seed: int, *purpose) -> int:
    """A 31-bit seed for one purpose of a run (name and numbers), independent of all others."""
    words = [zlib.crc32(p.encode()) if isinstance(p, str) else int(p) for p in purpose]
    return int(np.random.SeedSequence([seed, *words]).generate_state(1)[0] >> 1)


def make_env(config: Config, purpose: str, num_envs: int, *, seed: int | None = None) -> Any:
    """The environments of a run's game and protocol, see `srl_jax.envs.make`.

    Args:
        config: of the run.
        purpose: a name, whose seeds are its own; unless it is "train", episodes may take `eval_max_steps`.
        num_envs: how many.
        seed: of the environments; None for the run's own of that purpose.
    """
    max_steps = 0 if purpose == "train" else config.eval_max_steps
    return envs.make(
        config.game,
        num_envs=num_envs,
        seed=seed_for(config.seed, purpose, "environments") if seed is None else seed,
        frame_size=config.frame_size,
        sticky_actions=config.sticky_actions,
        full_actions=config.full_actions,
        noop_max=config.noop_max,
        max_frames=max(envs.MAX_FRAMES, envs.FRAME_SKIP * max_steps),
    )


def random_policy(num_actions: int, rng: np.random.Generator) -> Policy:
    """The policy that draws actions uniformly from `rng`; step and epsilon do not matter to it."""

    def policy(frames: np.ndarray, step: int, epsilon: float) -> np.ndarray:
        return rng.integers(0, num_actions, len(frames), dtype=np.int32)

    return policy


def yielding_threads(name: str, number: int) -> ThreadPoolExecutor:
    """Threads for environments; they and those that are started in them have a lower priority."""
    return ThreadPoolExecutor(number, name, _yield_to_others)


def _yield_to_others() -> None:
    """Lowers the priority of this thread and of those that it will start, where threads have one (Linux).

    On a CPU the environments then rather take what an update leaves of it than hold up its threads. By five
    only: a third of an update's share where they compete, and still one beside other programs.
    """
    if sys.platform == "linux":
        thread = threading.get_native_id()
        os.setpriority(os.PRIO_PROCESS, thread, os.getpriority(os.PRIO_PROCESS, thread) + 5)
