"""The observations that every run of a game is measured on: the same for all arms and seeds."""

import functools
from typing import Any, NamedTuple

import numpy as np

from srl_jax import envs
from srl_jax.config import Config
from srl_jax.replay import Replay
from srl_jax.run.actor import seed_for
from srl_jax.types import Window

SEED = 0
"""Of the held-out observations: not the run's."""
WINDOWS = 512
ENVS = 4
STRIDE = 4
"""Env steps between two observations that are kept, on average: neighbours look alike."""
LONGEST = 80
"""Env steps after which an episode is left for another one: a probe is fitted on some, scored on others."""


class HeldOut(NamedTuple):
    """N windows in an order of no meaning, and what is known of them.

    Attributes:
        windows: N of them, of uniform weight.
        states: float64 [N, V], of s_t.
        variables: the V names; none where the game's state is not known.
        episodes: int64 [N], which one a window is of.
        problem: why the state is not known although it should be; empty where all is well.
    """

    windows: Window
    states: np.ndarray
    variables: tuple[str, ...]
    episodes: np.ndarray
    problem: str

    @property
    def observations(self) -> np.ndarray:
        """s_t: uint8 [N, S, H, W, C]."""
        frames, horizon = np.asarray(self.windows.frames), self.windows.actions.shape[1]
        return frames[:, : frames.shape[1] - horizon]


def collect(config: Config, horizon: int) -> HeldOut:
    """Plays a random policy in environments of their own, and keeps some of what it saw.

    Which observations these are depends on the game and its protocol (sticky actions, set of actions, no-ops,
    size and number of frames), and on nothing else.

    Args:
        config: a run's.
        horizon: steps in a window, K.

    Returns:
        Arrays that nobody may write to: seeds of one process share them.
    """
    names = ("game", "frame_size", "sticky_actions", "full_actions", "noop_max")
    options = {name: getattr(config, name) for name in names}
    return _collect(config.frame_stack, horizon, WINDOWS, **options)


@functools.lru_cache(maxsize=1)
def _collect(stack: int, horizon: int, number: int, **options: Any) -> HeldOut:
    steps = number * STRIDE // ENVS
    env = envs.make(
        num_envs=ENVS, seed=seed_for(SEED, "held out", "environments"), with_state=True, **options
    )
    rng = np.random.default_rng(seed_for(SEED, "held out", "policy"))
    # In each environment one of every STRIDE steps, but none in the last ones.
    wanted = np.arange(0, steps, STRIDE) + rng.integers(0, STRIDE, (ENVS, steps // STRIDE))
    actions = rng.integers(0, env.single_action_space.n, (steps + STRIDE, ENVS), dtype=np.int32)
    order = rng.permutation(number)
    # Drawn last: the observations of a game are the same however far its windows reach.
    actions = np.concatenate([actions, rng.integers(0, env.single_action_space.n, (horizon, ENVS), np.int32)])

    replay = Replay(
        # As many slots as observations: every episode has one more of them than it has steps.
        capacity=ENVS * (2 * len(actions) + stack + horizon),
        num_streams=ENVS,
        frame_shape=env.single_observation_space.shape,
        stack=stack,
        horizon=horizon,
        alpha=0.0,
    )
    everyone = np.arange(ENVS)
    episodes, next_episode = np.arange(ENVS), ENVS
    length = np.zeros(ENVS, int)
    due = np.zeros(ENVS, int)  # the index in `wanted` of the next one of each environment
    rows: list[tuple[int, np.ndarray | None, int]] = []
    frames, info = env.reset()
    replay.begin(frames)
    for step, action in enumerate(actions):
        # An observation that is followed by a step of its episode: it always is, here.
        take = [i for i in everyone if due[i] < wanted.shape[1] and step >= wanted[i, due[i]]]
        for i in take:
            index = (replay.next_position[i] - 1) * ENVS + i
            rows.append((int(index), info["state"][i] if env.state_names else None, int(episodes[i])))
            due[i] += 1
        frames, rewards, terminated, truncated, info = env.step(action)
        length += 1
        truncated |= (length >= LONGEST) & ~terminated
        replay.add(action, np.sign(rewards), terminated, truncated, info["life_lost"], frames)
        over = terminated | truncated
        if over.any():
            frames, info = env.reset(options={"reset_mask": over})
            replay.begin(frames[over], np.flatnonzero(over))
            episodes[over] = next_episode + np.arange(over.sum())
            next_episode += int(over.sum())
            length[over] = 0
    env.close()
    indices, states, of_episode = zip(*[rows[i] for i in order], strict=True)
    held_out = HeldOut(
        replay.gather(np.array(indices)),
        np.array(states, np.float64)
        if env.state_names
        else np.zeros((number, 0)),  # it may be lost on the way
        env.state_names,
        np.array(of_episode),
        env.state_problem,
    )
    for array in map(np.asarray, (*held_out.windows[:-1], held_out.states, held_out.episodes)):
        array.setflags(write=False)
    return held_out
