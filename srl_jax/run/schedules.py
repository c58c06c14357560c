"""Schedules: numbers that change with env steps, as functions of a configuration and a count."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from srl_jax.config import Config
from srl_jax.modes import MODES
from srl_jax.run.actor import linear
from srl_jax.specs import Weight
from srl_jax.types import Objective
from srl_jax.update import Hyper


class Now(NamedTuple):
    """The numbers of one moment.

    Attributes:
        epsilon: of the behaviour policy.
        beta: the exponent of the importance weights (Schaul et al. 2016, section 3.4).
        hyper: the numbers of an update.
    """

    epsilon: float
    beta: float
    hyper: Hyper


class Schedules:
    """The schedules of a run.

    Args:
        config: of the run.
        hyper: the numbers of an update, with learning rates as they are at the start.
        objectives: by name; of those with a weight that changes.
    """

    def __init__(self, config: Config, hyper: Hyper, objectives: Mapping[str, Objective] = {}):
        self._config, self._hyper = config, hyper
        weights = {name: objective.weight for name, objective in objectives.items()}
        self._weights = {name: x for name, x in weights.items() if isinstance(x, Weight) and x.steps}
        self._rates = {name: float(rate) for name, rate in hyper.learning_rates.items()}

    def at(self, env_steps: int) -> Now:
        """The numbers at an env step.

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
        return Now(epsilon, linear(c.beta, c.beta_final, c.beta_anneal_steps, env_steps), hyper)

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
        return int((env_steps - c.learn_start + c.num_envs) * c.updates_per_step + 1e-9)


def passed(before: int, now: int, every: int) -> bool:
    """Whether a multiple of `every` env steps lies in (before, now]."""
    return now // every > before // every
