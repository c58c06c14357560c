"""What other programs and other runs take from a checkpoint: an agent, its policy, its encoder."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

from srl_jax import checkpoint
from srl_jax.actor import Policy
from srl_jax.agent import Agent, make_agent
from srl_jax.config import Config
from srl_jax.errors import ConfigError
from srl_jax.optim import ENCODER, RL
from srl_jax.types import Encoder, Params


def load_agent(path: str | Path) -> tuple[Agent, Any, checkpoint.Manifest]:
    """An agent, its parameters and the manifest of a checkpoint or of a run's newest one.

    Raises:
        srl_jax.errors.ConfigError: there is none, it is damaged, does not fit this code, or it is an encoder
            that was kept alone, see `load_encoder`.
    """
    manifest = checkpoint.read_manifest(path)
    agent, template = _agent_of(manifest)
    tree = checkpoint.load(manifest)
    if tree.keys() < template.keys():
        raise ConfigError(
            f"{manifest.path}: a kept encoder, without a policy; name the run or one of its checkpoints "
            "(srl_jax.loading.load_encoder and --encoder_from take kept encoders)"
        )
    return agent, checkpoint.load_into(template, tree, str(manifest.path)), manifest


def load_encoder(path: str | Path) -> tuple[Encoder, Params, checkpoint.Manifest]:
    """The encoder of a run, of one of its checkpoints, or one that was kept, `RUN/encoders/ENV_STEPS`.

        encoder, params, manifest = load_encoder("runs/pong/encoders/000002000")
        latents = encoder.apply(params, observations)  # uint8 [B, H, W, S * C] -> float32 [B, D]

    Raises:
        srl_jax.errors.ConfigError: there is none, it is damaged, or does not fit this code.
    """
    manifest = checkpoint.read_manifest(path)
    encoder = _agent_of(manifest)[0].encoder
    template = jax.eval_shape(encoder.init, jax.random.key(0))
    tree = checkpoint.load(manifest)["encoder"]
    return encoder, checkpoint.load_into(template, tree, str(manifest.path)), manifest


def _agent_of(manifest: checkpoint.Manifest) -> tuple[Agent, Any]:
    """The agent of a checkpoint's configuration, and the shapes of its parameters."""
    try:
        agent = make_agent(manifest.config, manifest.frame_shape, manifest.num_actions)
        return agent, agent.shapes().params
    except (ConfigError, TypeError) as error:  # a TypeError is jax's, of shapes that cannot be
        raise ConfigError(f"{manifest.path}: {error}") from None


def greedy_policy(agent: Agent, params: Any, key: jax.Array) -> Policy:
    """The epsilon-greedy policy of an agent's parameters, without noise, as a function of numpy arrays."""

    def policy(frames: np.ndarray, step: int, epsilon: float) -> np.ndarray:
        return np.asarray(agent.act_eval(params, frames, key, np.int32(step), np.float32(epsilon)))

    return policy


def given_policy(
    config: Config, frame_shape: tuple, num_actions: int
) -> Callable[[jax.Array], Policy] | None:
    """The policy of `policy_from` without noise, a function of the key that it draws from; None without one.

    Raises:
        srl_jax.errors.ConfigError: it cannot be loaded, or has other frames or actions than the game.
    """
    if not config.policy_from:
        return None
    agent, params, manifest = load_agent(config.policy_from)
    if manifest.num_actions != num_actions:
        raise ConfigError(
            f"--policy_from={config.policy_from}: its policy has {manifest.num_actions} actions, "
            f"{config.game} has {num_actions}"
        )
    checkpoint.check_frames(manifest, frame_shape, f"--policy_from={config.policy_from}", config.game)
    return lambda key: greedy_policy(agent, params, key)


def initial_params(config: Config, frame_shape: tuple, template: dict[str, Params]) -> dict[str, Params]:
    """{group: tree} of what starts from `encoder_from`: the encoder, and heads as `heads_from` says.

    Args:
        config: of the run.
        frame_shape: (H, W, C) of its environments.
        template: parameters, or their shapes, of its agent.

    Raises:
        srl_jax.errors.ConfigError: it cannot be loaded or does not fit.
    """
    if not config.encoder_from:
        return {}
    manifest = checkpoint.read_manifest(config.encoder_from)
    checkpoint.check_frames(manifest, frame_shape, f"--encoder_from={config.encoder_from}", config.game)
    found = checkpoint.load(manifest)
    wanted = {"representation": template.keys() - {RL}, "all": template.keys(), "none": {ENCODER}}
    names = sorted(wanted[config.heads_from] & found.keys())
    hint = "" if config.heads_from == "none" else " (--heads_from=none starts from the encoder alone)"
    return checkpoint.load_into(
        {name: template[name] for name in names},
        {name: found[name] for name in names},
        f"--encoder_from={config.encoder_from}{hint}",
    )
