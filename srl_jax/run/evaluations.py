"""The evaluations of one seed of a run: policies of its moments play full games in a thread of their own."""

import contextlib
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from typing import Any, NamedTuple

import jax
import numpy as np

from srl_jax.config import Config
from srl_jax.latents import named_key
from srl_jax.learning.agent import Agent
from srl_jax.loading import greedy_policy
from srl_jax.run.actor import make_env, seed_for, yielding_threads
from srl_jax.run.evaluate import Evaluation, evaluate, telling
from srl_jax.run.reporting import Report
from srl_jax.types import Params

RECORDED = 501
"""Frames of the last evaluation that are kept: of 500 env steps."""
FINAL = "final"
"""The kind of the evaluation after the last env step; those of the learning curve are of kind "eval"."""


class Evaluating(NamedTuple):
    """An evaluation that is under way.

    Attributes:
        params: of the policy.
        env_steps, updates: when these were the run's.
        values: what the diagnostics of that moment say.
        kind: "eval" or `FINAL`, as its row.
    """

    params: Params
    env_steps: int
    updates: int
    values: dict[str, Any]
    kind: str = "eval"


class Games(NamedTuple):
    """The games of an evaluation, which are a function of these and of the policy's parameters.

    Attributes:
        number: how many.
        at_once: how many environments play them.
        seed: of the environments.
        key: that the policy draws from.
    """

    number: int
    at_once: int
    seed: int
    key: jax.Array


def games(config: Config, kind: str, env_steps: int) -> Games:
    """The games of a run's evaluation.

    Args:
        config: of the run, with its seed.
        kind: "eval" or `FINAL`.
        env_steps: after which the policy is evaluated.
    """
    number = config.final_games if kind == FINAL else config.eval_games
    at_once = config.eval_envs or config.num_envs
    seed, key = seed_for(config.seed, kind, env_steps), named_key(jax.random.key(config.seed), kind)
    return Games(number, min(number, at_once), seed, key)


class Evaluations:
    """The evaluations of one seed, one at a time.

    Args:
        config: of the seed.
        agent: of its configuration.
        report: where rows go.
        keep: is given the parameters, env steps and updates of an evaluation that was better than all before.

    Attributes:
        under_way: the evaluation that is; None where none is.
        games: the future of its games, and seconds.
        best, last: the largest mean return so far, and that of the last evaluation, -inf where none has been;
            the final evaluation does not count.
        recording: uint8 [T, H, W, C], the first games of the last evaluation; None before there is one.
    """

    def __init__(
        self, config: Config, agent: Agent, report: Report, keep: Callable[[Params, int, int], None]
    ):
        self._config, self._agent, self._report, self._keep = config, agent, report, keep
        self.under_way: Evaluating | None = None
        self.games: Future[tuple[Evaluation | None, float]] | None = None
        self.best = self.last = -np.inf
        self.recording: np.ndarray | None = None
        self.thread = yielding_threads("evaluation", 1)
        self._envs: dict[str, Any] = {}  # {kind: made when there is something to play}

    @property
    def final(self) -> bool:
        """Whether the final evaluation is under way."""
        return self.under_way is not None and self.under_way.kind == FINAL

    def start(self, evaluating: Evaluating) -> None:
        """Begins an evaluation; nobody else is under way."""
        self.under_way = evaluating
        self.play()

    def play(self) -> None:
        """Begins with the games of the evaluation under way, if there is one."""
        if self.under_way:
            self.games = self.thread.submit(self._play, self.under_way)

    def _play(self, evaluating: Evaluating) -> tuple[Evaluation | None, float]:
        began, config, kind = time.perf_counter(), self._config, evaluating.kind
        number, at_once, seed, key = games(config, kind, evaluating.env_steps)
        if kind not in self._envs:
            self._envs[kind] = make_env(config, kind, at_once)
        with contextlib.ExitStack() as stack:
            told: dict[str, Any] = {}
            if kind == FINAL:
                progress = stack.enter_context(self._report.bar(number, "games"))
                told["told"] = telling(progress, number, at_once, config.eval_max_steps)
            played = evaluate(
                greedy_policy(self._agent, evaluating.params, key),
                self._envs[kind],
                games=number,
                seed=seed,
                epsilon=config.eps_eval,
                stack=config.frame_stack,
                max_steps=config.eval_max_steps,
                record=RECORDED,
                stop=lambda: self.under_way is None,
                **told,
            )
        return played, time.perf_counter() - began

    def finish(self, env_steps: int) -> None:
        """Waits for the evaluation under way, if one is, and writes its row; keeps the best parameters.

        Args:
            env_steps: of now, where the progress bar stands.
        """
        if self.under_way is None or self.games is None:
            return
        played, seconds = self.games.result()
        assert played is not None  # only `leave` has them left
        (params, then, updates, values, kind), self.under_way = self.under_way, None
        self.recording = played.frames
        mean = self._report.evaluation(kind, then, updates, played, seconds, values)
        if kind != FINAL:
            self._report.progress.update(env_steps, evaluation=mean)
            self.last = mean
            if mean > self.best:
                self.best = mean
                self._keep(params, then, updates)

    def leave(self) -> None:
        """Has nobody wait for the games that are under way: they are left at their next step."""
        self.under_way = None

    def close(self) -> None:
        """Closes the environments."""
        for env in self._envs.values():
            env.close()

    def snapshot(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """What `restore` takes, as arrays and JSON values; less the parameters of the one under way."""
        arrays = {} if self.recording is None else {"recording": self.recording}
        best, last = (mean if np.isfinite(mean) else None for mean in (self.best, self.last))
        return arrays, {"best": best, "last": last, "evaluating": self.under_way and self.under_way[1:]}

    def restore(self, arrays: Mapping[str, np.ndarray], numbers: Mapping[str, Any]) -> None:
        """Goes on from there; none is under way."""
        self.recording = arrays["recording"] if "recording" in arrays else None
        best, last = numbers["best"], numbers.get("last")  # which earlier versions did not keep
        self.best, self.last = (-np.inf if mean is None else float(mean) for mean in (best, last))
