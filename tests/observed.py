"""What options and flags change: functions are traced, not run, and what no result comes of is left out."""

import inspect
import re
from functools import cache, partial

import jax
import numpy as np

from srl_jax.config import Config
from srl_jax.latents import make_latents
from srl_jax.learning.agent import make_agent
from srl_jax.learning.optim import ENCODER, RL
from srl_jax.learning.resets import reset
from srl_jax.rl import REGISTRY, Algorithm
from srl_jax.run.schedules import Schedules
from srl_jax.types import Context, Encoder, Objective
from tests.helpers import NUM_ACTIONS, make_window

KEY = jax.eval_shape(lambda: jax.random.key(0))
BESIDE = REGISTRY["dqn"](Context(8, NUM_ACTIONS), hidden=8)
"""The RL algorithm beside an objective, whose head that may read."""


class Observed:
    """What is seen, in parts: those that take longer to see behind others, and each once it is asked for."""

    def __init__(self, **parts):
        self.parts = {name: cache(part) for name, part in parts.items()}

    def __eq__(self, other) -> bool:
        same = self.parts.keys() == other.parts.keys()
        return same and all(part() == other.parts[name]() for name, part in self.parts.items())


def computed(function, *arguments) -> str:
    """What a function computes of arguments of these shapes: equations, constants, and the tree of results.

    Two functions that it says the same of give the same numbers.
    """
    closed, out = jax.make_jaxpr(function, return_shape=True)(*arguments)
    jaxpr = closed.jaxpr
    needed = {id(x) for x in jaxpr.outvars}
    equations = []
    for equation in reversed(jaxpr.eqns):
        if any(id(x) in needed for x in equation.outvars):
            needed |= {id(x) for x in equation.invars}
            equations.append(equation)
    constants = {v: x for v, x in zip(jaxpr.constvars, closed.consts, strict=True) if id(v) in needed}
    lesser = jaxpr.replace(eqns=equations[::-1], constvars=list(constants))
    text = re.sub(r"0x[0-9a-f]+|\bat \S+>", "", str(lesser))
    results = jax.tree.map(lambda x: (x.shape, str(x.dtype)), out)
    return f"{text} {[np.asarray(x).tobytes() for x in constants.values()]} {results}"


def of_encoder(encoder: Encoder) -> Observed:
    """What an encoder and its decoder compute."""
    params, decoder = jax.eval_shape(encoder.init, KEY), encoder.make_decoder()
    image = jax.ShapeDtypeStruct((2, *encoder.observation_shape), np.uint8)
    latent = jax.ShapeDtypeStruct((2, encoder.features), np.float32)
    parts = {
        "init": lambda: computed(encoder.init, KEY),
        "apply": lambda: computed(encoder.apply, params, image),
        "decoder": lambda: computed(decoder.init, KEY),
        "decoded": lambda: computed(decoder.apply, jax.eval_shape(decoder.init, KEY), latent),
    }
    if train := encoder.train:
        parts["train"] = lambda: computed(jax.grad(lambda *x: train(*x).sum()), params, image, KEY)
    return Observed(**parts)


def of_objective(objective: Objective, encoder: Encoder, read=lambda metrics: metrics, **parts) -> Observed:
    """What an objective computes, its schedule, how its slow copy moves, and its picture.

    Args:
        objective: built for the encoder.
        encoder: below it.
        read: metrics -> those that somebody reads.
        **parts: what else is seen.
    """
    own, params = jax.eval_shape(objective.init, KEY), jax.eval_shape(encoder.init, KEY)
    groups = {ENCODER: params, RL: jax.eval_shape(BESIDE.objective.init, KEY)}
    head = objective.head(own, jax.eval_shape(objective.read, groups))
    window = make_window(horizon=max(1, objective.horizon), size=encoder.observation_shape[0])

    def loss(head, slow_head, params, slow, window, key):
        latents = make_latents(encoder, params, slow, window)
        losses, metrics = objective.loss(head, slow_head, latents, window, key)
        return losses, read(metrics)

    parts = {
        "rest": lambda: (repr(objective.weight), objective.horizon, objective.is_decoder),
        **parts,
        "init": lambda: computed(objective.init, KEY),
    }
    if objective.slow:
        copies = {"encoder": params, "head": head}
        parts["slow"] = lambda: computed(objective.slow, copies, copies, np.int32(1))
    parts["loss"] = lambda: computed(loss, head, head, params, params, window, KEY)
    if objective.image:
        picture = lambda head, params, window: objective.image(  # noqa: E731
            head, make_latents(encoder, params, params, window), window
        )
        parts["image"] = lambda: computed(picture, head, params, window)
    return Observed(**parts)


def of_algorithm(algorithm: Algorithm, encoder: Encoder) -> Observed:
    """What an algorithm computes, and what it asks of replay; priorities count where there are some."""
    prioritized = algorithm.alpha > 0
    objective = algorithm.objective._replace(slow=algorithm.slow(7))
    head = jax.eval_shape(objective.init, KEY)
    latent = jax.ShapeDtypeStruct((2, encoder.features), np.float32)
    return of_objective(
        objective,
        encoder,
        lambda metrics: {k: x for k, x in metrics.items() if prioritized or k != "td_error"},
        asks=lambda: (algorithm.alpha, algorithm.acts_slow),
        act=lambda: computed(algorithm.q_values, head, latent, KEY),
        evaluate=lambda: computed(algorithm.q_values, head, latent),
    )


def of_agent(config: Config) -> Observed:
    """What an agent on Catch computes in the middle of a run of this configuration, and what it asks for.

    The numbers of schedules are constants of what is traced: what nothing computes with is left out.
    """
    agent = make_agent(config, (config.frame_size, config.frame_size, 1), NUM_ACTIONS)
    state, schedules = agent.shapes(), Schedules(config, agent.hyper, agent.objectives)
    env_steps = config.steps // 2
    updates = schedules.updates_due(env_steps)
    now = schedules.at(env_steps, updates)
    alpha = agent.algorithm.alpha if agent.mode.rl else 0.0

    window = make_window(horizon=agent.horizon, size=config.frame_size)
    window = window._replace(frames=window.frames[:, : config.frame_stack + agent.horizon])
    if agent.mode.rl and "n_step" in now.gamma_and_n:
        window = window._replace(n_step=np.full(4, now.gamma_and_n["n_step"], np.int32))

    @cache
    def computed_by(update):
        def updated(state, window):
            state, td_error, metrics = update.pure(state, window, now.hyper)
            return state, td_error if alpha else None, metrics

        return computed(updated, state, window)

    def update_rl():
        """Of the updates that are RL's alone."""
        alone = computed_by(agent.update_rl or agent.update)
        return alone != computed_by(agent.update) and (config.srl_every, alone)

    asks = agent.horizon, alpha, updates, schedules.resets(env_steps)
    parts: dict = {"asks": lambda: asks, "epsilon": lambda: config.policy_from and now.epsilon}
    if agent.mode.rl:
        act = lambda state, *rest: inspect.unwrap(agent.act)(agent.acting(state), *rest)  # noqa: E731
        frames = window.frames[:, : config.frame_stack]
        replay = now.gamma_and_n.get("gamma", config.gamma), now.beta if alpha else None
        parts["replay"] = lambda: (now.epsilon, *replay)
        parts["act"] = lambda: computed(act, state, frames, KEY, np.int32(0), np.float32(0))
    if config.reset != "none":
        whole = partial(reset, kind=config.reset, shrink=config.shrink)
        parts["reset"] = lambda: computed(whole, state, state)
    if agent.follow_every:
        parts["follow"] = lambda: (agent.follow_every, computed(inspect.unwrap(agent.follow), state))
    if agent.norms:
        norms = lambda *x: inspect.unwrap(agent.norms)(*x, now.hyper)  # noqa: E731
        parts["norms"] = lambda: computed(norms, state, window)
    init = inspect.unwrap(agent.init)
    parts |= {"init": lambda: computed(init, KEY), "update": lambda: computed_by(agent.update)}
    return Observed(**parts, update_rl=update_rl)
