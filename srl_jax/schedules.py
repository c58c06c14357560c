"""The numbers of a run that change with its env steps: pure functions of a configuration and a count."""

import numpy as np

from srl_jax.actor import linear
from srl_jax.config import Config
from srl_jax.modes import MODES


def epsilon(config: Config, env_steps: int) -> float:
    """The behaviour policy's epsilon; without RL, 1 or, of a given policy, `pretrain_epsilon`."""
    if not MODES[config.mode].rl:
        return config.pretrain_epsilon if config.policy_from else 1.0
    return linear(config.eps_train, config.eps_final, config.eps_anneal_steps, env_steps)


def beta(config: Config, env_steps: int) -> float:
    """The exponent of the importance weights (Schaul et al. 2016, section 3.4)."""
    return linear(config.beta, config.beta_final, config.beta_anneal_steps, env_steps)


def learning_rates(config: Config, rates: dict[str, float], env_steps: int) -> dict[str, np.float32]:
    """Learning rates on their way to `lr_final_share` of what they are in `rates`."""
    left = linear(1.0, config.lr_final_share, config.steps, env_steps)
    return {name: np.float32(rate * left) for name, rate in rates.items()}


def updates_due(config: Config, env_steps: int) -> int:
    """Updates that are due by the end of the step that starts now, since the start of the run.

    There are `updates_per_step` for each env step since learning began; the first comes with the first step
    after `learn_start`.
    """
    if env_steps < config.learn_start:
        return 0
    return int((env_steps - config.learn_start + config.num_envs) * config.updates_per_step + 1e-9)


def passed(before: int, now: int, every: int) -> bool:
    """Whether a multiple of `every` env steps lies in (before, now]."""
    return now // every > before // every
