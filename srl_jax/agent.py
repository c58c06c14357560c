"""From a configuration to the functions that it means: encoder, objectives, update, act."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from srl_jax import encoders, objectives, rl, specs
from srl_jax.config import Config
from srl_jax.modes import MODES, Mode, encoder_learning_rate
from srl_jax.optim import RL, make_optimizer
from srl_jax.rl import Algorithm
from srl_jax.types import Context, Encoder, Objective
from srl_jax.update import Hyper, make_act, make_init, make_update, periodic


class Agent(NamedTuple):
    """What a configuration means, as pure functions; init, update and the two acts are jitted.

    Attributes:
        mode: the row of the table of modes.
        encoder: the shared encoder.
        algorithm: the RL algorithm; in mode pretrain it acts (if it acts at all) but is not trained.
        objectives: the terms of the loss by name, RL's among them where the mode runs it.
        horizon: K of the windows it asks for.
        init, update: see `srl_jax.update`.
        act, act_eval: with noise, and without.
        hyper: the numbers of an update.
    """

    mode: Mode
    encoder: Encoder
    algorithm: Algorithm
    objectives: dict[str, Objective]
    horizon: int
    init: Callable
    update: Callable
    act: Callable
    act_eval: Callable
    hyper: Hyper


def make_agent(config: Config, num_actions: int) -> Agent:
    """Builds an `Agent`.

    Args:
        config: a run's.
        num_actions: of its game.

    Raises:
        srl_jax.specs.SpecError: where a spec does not fit.
    """
    mode = MODES[config.mode]
    shape = (config.frame_size, config.frame_size, config.frame_stack)
    encoder = specs.build(specs.parse(config.encoder, encoders.REGISTRY, "encoder"), encoders.REGISTRY, shape)
    context = Context(encoder, num_actions)
    algorithm = specs.build(specs.parse(config.rl, rl.REGISTRY, "rl"), rl.REGISTRY, context)
    terms: dict[str, Objective] = {}
    if mode.rl:
        slow = periodic(config.slow_update_every)
        terms[RL] = algorithm.objective._replace(slow=slow)
    if mode.representation:
        for text in config.objectives:
            spec = specs.parse(text, objectives.REGISTRY, "objective")
            terms[spec.name] = specs.build(spec, objectives.REGISTRY, context)
    optimizer = make_optimizer(
        terms,
        decoder_weight_decay=config.decoder_weight_decay,
        max_grad_norm=config.max_grad_norm,
        adam_eps=config.adam_eps,
    )
    rates = {
        "encoder": encoder_learning_rate(config),
        "rl": config.lr_rl,
        "representation": config.lr_srl,
    }
    return Agent(
        mode=mode,
        encoder=encoder,
        algorithm=algorithm,
        objectives=terms,
        horizon=max(1, *(o.horizon for o in terms.values())),
        init=jax.jit(
            make_init(encoder, terms, mode, optimizer, target_encoder=config.target_encoder),
            compiler_options={"xla_backend_optimization_level": 0},  # it runs once: compile it fast
        ),
        update=jax.jit(
            make_update(
                encoder,
                terms,
                mode,
                optimizer,
                augment=config.augment,
                target_encoder=config.target_encoder,
            ),
            donate_argnums=0,
        ),
        act=jax.jit(make_act(encoder, algorithm.q_values, noisy=True)),
        act_eval=jax.jit(make_act(encoder, algorithm.q_values, noisy=False)),
        hyper=Hyper(
            weights={name: jnp.float32(term.weight) for name, term in terms.items()},
            learning_rates={group: jnp.float32(rate) for group, rate in rates.items()},
        ),
    )
