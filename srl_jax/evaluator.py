"""Evaluations of a run, in a thread of their own while it trains on."""

import time
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any, NamedTuple

import numpy as np

from srl_jax.actor import Policy, seed_for, yielding_thread
from srl_jax.config import Config
from srl_jax.evaluate import Evaluation, evaluate
from srl_jax.types import Params

RECORDED = 501
"""Frames of the last evaluation that are kept: of 500 env steps."""


class Moment(NamedTuple):
    """What an evaluation is of.

    Attributes:
        params: of the policy; nothing changes them.
        env_steps, updates: when the run had them.
        diagnosed: what `srl_jax.diagnostics` says of that moment; JSON values.
    """

    params: Params
    env_steps: int
    updates: int
    diagnosed: dict[str, Any]


class Evaluator:
    """Plays a run's evaluations, one at a time; a context manager that ends one which nobody waits for.

    Args:
        config: of the run.
        policy: parameters -> the policy that is evaluated.
        make_env: number of environments -> environments, made when there is something to play.

    Attributes:
        moment: of the evaluation under way, or None.
        recording: uint8 [T, H, W, C], the first games of the last evaluation; None before there is one.
    """

    def __init__(self, config: Config, policy: Callable[[Params], Policy], make_env: Callable[[int], Any]):
        self._config, self._policy, self._make_env = config, policy, make_env
        self._thread = yielding_thread("evaluation")
        self._env = None
        self._future: Future | None = None
        self._left = False  # nobody waits for the games
        self.moment: Moment | None = None
        self.recording: np.ndarray | None = None

    def __enter__(self) -> "Evaluator":
        return self

    def __exit__(self, *exception) -> None:
        self.leave()
        self._thread.shutdown()
        if self._env is not None:
            self._env.close()

    def start(self, moment: Moment) -> None:
        """Starts one; the one before must have been waited for."""
        self.moment = moment
        policy = self._policy(moment.params)
        self._future = self._thread.submit(self._play, policy, moment.env_steps)

    def finish(self) -> tuple[Moment, Evaluation, float] | None:
        """Waits for the one under way: what it was of, what came of it, and seconds; None without one."""
        if self.moment is None:
            return None
        moment, self.moment = self.moment, None
        played, seconds = self._future.result()
        self.recording = played.frames
        return moment, played, seconds

    def leave(self) -> None:
        """Ends the games under way, and those to come, at their next step."""
        self._left = True

    def _play(self, policy: Policy, env_steps: int) -> tuple[Evaluation | None, float]:
        config, began = self._config, time.perf_counter()
        if self._env is None:
            self._env = self._make_env(min(config.num_envs, config.eval_games))
        played = evaluate(
            policy,
            self._env,
            games=config.eval_games,
            seed=seed_for(config.seed, "eval", env_steps),
            epsilon=config.eps_eval,
            stack=config.frame_stack,
            max_steps=config.eval_max_steps,
            record=RECORDED,
            stop=lambda: self._left,
        )
        return played, time.perf_counter() - began
