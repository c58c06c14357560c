"""srl_jax/learning/agent.py: a loss that is wrong is named before anything is compiled."""

import jax.numpy as jnp
import pytest

from srl_jax import objectives, rl
from srl_jax.config import Config
from srl_jax.errors import ConfigError
from srl_jax.learning.agent import check_losses, make_agent
from srl_jax.types import Objective
from tests.helpers import NUM_ACTIONS, SMALL, agent_of

WRONG = {
    "a metric of each row": (
        lambda head, slow, latents, window, key: (window.rewards[:, 0], {"share": window.rewards[:, 0]}),
        r'its metric "share" has shape \(8,\); a metric is a scalar$',
    ),
    "td_error, which is RL's": (
        lambda head, slow, latents, window, key: (window.rewards[:, 0], {"td_error": window.rewards[:, 0]}),
        r'its metric "td_error" has shape \(8,\)',
    ),
    "no metrics": (
        lambda head, slow, latents, window, key: window.rewards[:, 0],
        r"its loss must give two things: losses \[B\], and a dict of metrics, {} for none$",
    ),
    "metrics that are no dict": (
        lambda head, slow, latents, window, key: (window.rewards[:, 0], jnp.zeros(())),
        "its loss must give two things",
    ),
    "the mean over the batch": (
        lambda head, slow, latents, window, key: (jnp.mean(window.rewards), {}),
        r"its losses have shape \(\); there is one of each row of the batch, \(8,\)$",
    ),
    "an offset beyond its horizon": (  # RL's is 3
        lambda head, slow, latents, window, key: (jnp.sum(latents.online(2), -1), {}),
        r"line \d+: ValueError: offset 2 is not in 0\.\.1, where 1 is the horizon$",
    ),
    "offsets beyond its horizon": (
        lambda head, slow, latents, window, key: (jnp.sum(latents.slow([0, 7])[1], -1), {}),
        r"line \d+: ValueError: offset 7 is not in 0\.\.1",
    ),
    "an error of its own": (
        lambda head, slow, latents, window, key: (head["gone"], {}),
        r"line \d+: KeyError: 'gone'$",
    ),
}


@pytest.mark.parametrize("mode", ["joint", "pretrain"])
@pytest.mark.parametrize("name", WRONG)
def test_a_loss_that_is_wrong_is_named(name, mode, monkeypatch):
    loss, message = WRONG[name]
    row = lambda context, *, weight: Objective(lambda key: {}, loss, weight, horizon=1)  # noqa: E731
    row.__kwdefaults__ = {"weight": 1.0}
    monkeypatch.setitem(objectives.REGISTRY, "mine", row)
    config = Config(**{**SMALL, "mode": mode, "objectives": ("inverse", "mine")})
    with pytest.raises(ConfigError, match=f"^--objective=mine: {message}"):
        make_agent(config, (42, 42, 1), NUM_ACTIONS)
    make_agent(config, (42, 42, 1), NUM_ACTIONS, trained=False)  # its encoder and policy are what they are


def test_a_loss_of_rl_that_is_wrong_is_named(monkeypatch):
    def mine(context):
        found = rl.REGISTRY["rainbow"](context)
        loss = lambda *given: (found.objective.loss(*given)[0].sum(), {})  # noqa: E731
        return found._replace(objective=found.objective._replace(loss=loss))

    monkeypatch.setitem(rl.REGISTRY, "mine", mine)
    with pytest.raises(ConfigError, match=r"^--rl=mine: its losses have shape \(\)"):
        make_agent(Config(**{**SMALL, "mode": "joint", "rl": "mine"}), (42, 42, 1), NUM_ACTIONS)


@pytest.mark.parametrize("name", objectives.REGISTRY)
def test_no_loss_of_the_package_reads_beyond_its_horizon(name):
    views = {"rl_view": "shift@each", "target_view": "intensity"}
    config = Config(**{**SMALL, "mode": "joint", "objectives": (name,), **views})
    agent = agent_of(config)
    check_losses(agent, agent.objectives, config, (42, 42, 1))
