"""Schedules: what changes with env steps and updates, as functions of a configuration and these counts."""

from collections.abc import Iterator, Mapping
from fractions import Fraction
from typing import Any, NamedTuple

import numpy as np

from srl_jax.config import Config
from srl_jax.learning import annealing
from srl_jax.learning.modes import MODES
from srl_jax.learning.update import Hyper
from srl_jax.specs import Weight, linear
from srl_jax.types import Objective


class Now(NamedTuple):
    """The numbers of one moment.

    Attributes:
        epsilon: of the behaviour policy.
        beta: the exponent of the importance weights (Schaul et al. 2016, section 3.4).
        hyper: the numbers of an update.
        gamma_and_n: those of `Replay.sample`'s options "gamma" and "n_step" that are annealed.
    """

    epsilon: float
    beta: float
    hyper: Hyper
    gamma_and_n: dict[str, Any]


class Schedules:
    """The schedules of a run.

    Args:
        config: of the run.
        hyper: the numbers of an update, with learning rates as they are at the start.
        objectives: by name; of those with a weight that changes.
    """

    def __init__(self, config: Config, hyper: Hyper, objectives: Mapping[str, Objective] = {}):
        self._config, self._hyper = config, hyper
        # Exact at any length: of 0.7, the float nearest to it, an update would come too late some day.
        self._per_step = Fraction(config.updates_per_step).limit_denominator(10**6)
        weights = {name: objective.weight for name, objective in objectives.items()}
        self._weights = {name: x for name, x in weights.items() if isinstance(x, Weight) and x.steps}
        self._rates = {name: float(rate) for name, rate in hyper.learning_rates.items()}
        self._n = annealing.parse(config.n_anneal, int) if config.n_anneal else None
        self._gamma = annealing.parse(config.gamma_anneal, float) if config.gamma_anneal else None

    def at(self, env_steps: int, updates: int = 0) -> Now:
        """The numbers at an env step, of the update that comes after so many.

        Without RL, epsilon is 1 or, of a given policy, `pretrain_epsilon`. Learning rates fall linearly to
        `lr_final_share` of what they were, and weights that change to where they go.
        """
        c, hyper = self._config, self._hyper
        epsilon = linear(c.eps_train, c.eps_final, c.eps_anneal_steps, env_steps)
        if not MODES[c.mode].rl:
            epsilon = c.pretrain_epsilon if c.policy_from else 1.0
        if c.lr_final_share != 1.0:
            left = linear(1.0, c.lr_final_share, c.steps, env_steps)
            rates = {name: np.float32(rate * left) for name, rate in self._rates.items()}
            hyper = hyper._replace(learning_rates=rates)
        if self._weights:
            changed = {name: np.float32(x.at(env_steps)) for name, x in self._weights.items()}
            hyper = hyper._replace(weights={**hyper.weights, **changed})
        beta = linear(c.beta, c.beta_final, c.beta_anneal_steps, env_steps)
        return Now(epsilon, beta, hyper, self._annealed(env_steps, updates))

    def _annealed(self, env_steps: int, updates: int) -> dict[str, Any]:
        since, found = self.since_reset(env_steps, updates), {}
        if self._gamma:
            found["gamma"] = self._gamma.gamma(since)
        if self._n:
            found["n_step"] = self._n.n(since)
        return found

    def resets(self, env_steps: int) -> int:
        """How many resets have been made once the step that begins at `env_steps` has begun."""
        c = self._config
        if c.reset == "none":
            return 0
        return max(0, min(env_steps, c.reset_last or env_steps)) // c.reset_every

    def since_reset(self, env_steps: int, updates: int) -> int:
        """How many of the updates came after the newest reset, or after the start of the run."""
        c, number = self._config, self.resets(env_steps)
        if not number:
            return updates
        begins = c.whole_rounds(number * c.reset_every)  # the step that started with it
        return max(0, updates - self.updates_due(begins - c.num_envs))

    def row(self, env_steps: int, updates: int) -> dict[str, Any]:
        """What a "train" row says of resets, n and gamma, of the step that ended then."""
        found, began = self.ended(env_steps, updates), env_steps - self._config.num_envs
        return found if self._config.reset == "none" else found | {"resets": self.resets(began)}

    def ended(self, env_steps: int, updates: int) -> dict[str, Any]:
        """`Now.gamma_and_n` of the step that ended then, before a reset that the next one begins with."""
        return self._annealed(env_steps - self._config.num_envs, updates)

    def weights(self, env_steps: int) -> dict[str, float]:
        """The factors of the losses whose weight changes; an update says what a ratio's is."""
        return {name: x.at(env_steps) for name, x in self._weights.items() if not x.ratio}

    def updates_due(self, env_steps: int) -> int:
        """Updates that are due by the end of the step that starts then, since the start of the run.

        There are `updates_per_step` for each env step since learning began; the first comes with the first
        step after `learn_start`.
        """
        c = self._config
        if env_steps < c.learn_start:
            return 0
        return int((env_steps - c.learn_start + c.num_envs) * self._per_step)


def passed(before: int, now: int, every: int) -> bool:
    """Whether a multiple of `every` env steps lies in (before, now]."""
    return now // every > before // every


def printed(config: Config, every: int) -> Iterator[str]:
    """The lines of a table of resets, n and gamma over a run's first `steps` env steps.

    Args:
        config: resolved.
        every: env steps between two lines; of these, the line says what holds for the step that begins then.
    """
    schedules = Schedules(config, Hyper({}, {}))
    yield "env_steps  updates  resets  since_reset  n_step   gamma"
    for env_steps in range(0, config.steps + 1, every):
        updates = schedules.updates_due(env_steps - config.num_envs)
        now = schedules.at(env_steps, updates).gamma_and_n
        n, gamma = now.get("n_step", "-"), now.get("gamma", config.gamma)
        resets, since = schedules.resets(env_steps), schedules.since_reset(env_steps, updates)
        yield f"{env_steps:9}  {updates:7}  {resets:6}  {since:11}  {n:>6}  {gamma:.5f}"
