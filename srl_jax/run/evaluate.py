"""Evaluation of a policy: full games, with unclipped scores."""

import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from srl_jax.files.display import Progress, hms
from srl_jax.run.actor import FrameStack, Policy


class Evaluation(NamedTuple):
    """What came of the games, in the order in which they were dealt out.

    Attributes:
        returns: the raw score of each game, undiscounted.
        lengths: env steps of each game.
        frames: uint8 [T, H, W, C], the first environment's games as they were seen, one after the other;
            empty unless asked for.
        cut: how many were cut after `max_steps`, before they had terminated; by the environment, too.
    """

    returns: list[float]
    lengths: list[int]
    frames: np.ndarray
    cut: int


def evaluate(
    policy: Policy,
    env,
    *,
    games: int,
    seed: int,
    epsilon: float,
    stack: int = 4,
    max_steps: int = 27_000,
    record: int = 0,
    stop: Callable[[], bool] = lambda: False,
    told: Callable[[int, int], None] = lambda steps, games: None,
) -> Evaluation | None:
    """Plays full games: a lost life ends nothing, rewards are the game's own.

    Each environment plays its share, game i in environment i mod N, so that short games are not favoured.

    Args:
        policy: acts for all N environments at once.
        env: a vector environment of `srl_jax.envs`.
        games: how many.
        seed: same seed, same policy: same games.
        epsilon: given to the policy.
        stack: frames in an observation.
        max_steps: env steps after which a game is cut, its score counted as it stands.
        record: frames of the first environment to keep at most.
        stop: asked before every step; once it says so, the games are left and there is no result.
        told: after every step, how many each environment has taken and how many games have been played.
    """
    number, shape = env.num_envs, env.single_observation_space.shape
    stacks = FrameStack(number, stack, shape)
    frames, _ = env.reset(seed=seed)
    stacks.begin(frames)
    returns, lengths = np.zeros(games), np.zeros(games, int)
    score, length = np.zeros(number), np.zeros(number, int)
    game = np.arange(number)  # that each environment plays; from `games` on they do not count
    recorded = [frames[0].copy()][:record]  # a view would keep the frames of all environments
    step = played = cut = 0
    while played < games:
        if stop():
            return None
        frames, rewards, terminated, truncated, _ = env.step(policy(stacks.observations(), step, epsilon))
        step += 1
        score += rewards
        length += 1
        stacks.push(frames)
        if len(recorded) < record and game[0] < games:
            recorded.append(frames[0].copy())
        over = terminated | truncated | (length >= max_steps)
        if over.any():
            counts = over & (game < games)
            cut += int((counts & ~terminated & (length >= max_steps)).sum())
            returns[game[counts]], lengths[game[counts]] = score[counts], length[counts]
            played += int(counts.sum())
            game[over] += number
            score[over], length[over] = 0.0, 0
            frames, _ = env.reset(options={"reset_mask": over})
            stacks.begin(frames, over)
            if over[0] and len(recorded) < record and game[0] < games:
                recorded.append(frames[0].copy())
        told(step, played)
    seen = np.stack(recorded) if recorded else np.zeros((0, *shape), np.uint8)
    return Evaluation(returns.tolist(), lengths.tolist(), seen, cut)


def telling(progress: Progress, games: int, at_once: int, max_steps: int) -> Callable[[int, int], None]:
    """What `evaluate` tells, shown: games, their rate and the time left, and env steps a second.

    Until games have ended nobody knows how long they are, only how long they can be; that is shown then.

    Args:
        progress: counts games.
        games: how many are played.
        at_once: in how many environments.
        max_steps: env steps after which a game is cut.
    """
    began, longest = time.monotonic(), -(-games // at_once) * max_steps

    def told(steps: int, played: int) -> None:
        seconds = time.monotonic() - began
        unknown = steps >= 50 and played < games and (not played or games <= at_once)
        at_most = f"{hms(seconds / steps * (longest - steps))} left" if unknown else None
        fields = {"env steps": f"{steps * at_once:,}", "steps/s": f"{steps * at_once / seconds:,.0f}"}
        progress.update(played, **fields, **{"at most": at_most})

    return told
