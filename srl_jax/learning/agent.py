"""Builds an agent from a configuration: encoder, objectives, jitted functions that init, update and act."""

import inspect
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from srl_jax import encoders, objectives, plugins, rl, specs
from srl_jax.augment import Views
from srl_jax.config import Config
from srl_jax.diagnostics.functions import Functions, make_functions
from srl_jax.errors import ConfigError
from srl_jax.latents import make_losses
from srl_jax.learning import modes
from srl_jax.learning.modes import Mode, encoder_learning_rate, second_learning_rate
from srl_jax.learning.optim import ENCODER, RL, make_optimizer
from srl_jax.learning.update import (
    Hyper,
    Pass,
    follow_every,
    make_act,
    make_follow,
    make_init,
    make_update,
    passes,
)
from srl_jax.learning.weights import make_norms
from srl_jax.rl import Algorithm
from srl_jax.types import Array, Context, Encoder, Latents, Objective, Params, TrainState, Window


class Init(Protocol):
    """The type of `Agent.init`: see `srl_jax.learning.update.make_init`."""

    def __call__(self, key: jax.Array, given: Mapping[str, Params] | None = None, /) -> TrainState: ...


class Act(Protocol):
    """The type of `Agent.act`: (params, frames uint8 [N, S, H, W, C], key, step, epsilon) -> int32 [N]."""

    def __call__(
        self,
        params: Mapping[str, Params],
        frames: Array,
        key: jax.Array,
        step: ArrayLike,
        epsilon: ArrayLike,
        /,
    ) -> jax.Array: ...


class Update:
    """A jitted update, (state, window, hyper) -> (state, td_error, metrics), that copies nothing.

    The optimizer's state of the groups that move is taken over. Parameters are not: they may still act. What
    does not change is no result of the compiled function, for XLA would copy it.

    Args:
        pure: from `make_update`.
        plan: its passes.
        lift: from the function that is jitted, (opt_state, params, rest, window, hyper) -> (what moved,
            td_error, metrics), to another one: see `over_seeds`.

    Attributes:
        pure: as given.
        compiled: the jitted function.
    """

    def __init__(
        self,
        pure: Callable,
        plan: Sequence[Pass],
        lift: Callable[[Callable], Callable] = lambda change: change,
    ):
        self.pure, self._plan = pure, plan
        self._params = {group for one in plan for group in one.groups}
        self._opt_state = {moments for one in plan for moments in one.groups.values()}
        self.compiled = jax.jit(lift(self._change), donate_argnums=0)

    def lifted(self, lift: Callable[[Callable], Callable]) -> "Update":
        """The same update with another `lift`."""
        return Update(self.pure, self._plan, lift)

    def __call__(
        self, state: TrainState, window: Window, hyper: Hyper, /
    ) -> tuple[TrainState, jax.Array | None, dict[str, jax.Array]]:
        opt_state, params = self._part(state, False)
        rest = state._replace(opt_state=opt_state, params=params)
        (*moved, step), td_error, metrics = self.compiled(*self._part(state, True), rest, window, hyper)
        return _put(state, *moved)._replace(step=step), td_error, metrics

    def _change(self, opt_state: dict, params: dict, rest: TrainState, window: Window, hyper: Hyper):
        new, td_error, metrics = self.pure(_put(rest, opt_state, params), window, hyper)
        return (*self._part(new, True), new.step), td_error, metrics

    def _part(self, state: TrainState, moves: bool) -> tuple[dict, dict]:
        """Of the optimizer's state and the parameters, the groups that move, or those that do not."""
        return (
            {group: x for group, x in state.opt_state.items() if (group in self._opt_state) == moves},
            {group: x for group, x in state.params.items() if (group in self._params) == moves},
        )


def _put(state: TrainState, opt_state: dict, params: dict) -> TrainState:
    return state._replace(opt_state=state.opt_state | opt_state, params=state.params | params)


class Agent(NamedTuple):
    """What a configuration means, as pure functions; init, update and the two acts are jitted.

    Attributes:
        mode: the row of the table of modes.
        encoder: the shared encoder.
        algorithm: the RL algorithm; in mode pretrain it acts (if it acts at all) but is not trained.
        objectives: the terms of the loss by name, RL's among them where the mode runs it.
        horizon: K of the windows it asks for.
        init: see `srl_jax.learning.update.make_init`.
        update: `srl_jax.learning.update.make_update`'s, without moving slow copies. Takes over the buffers
            of the optimizer's state, and no others: the parameters may still act while it runs.
        update_rl: the update that computes RL's loss alone, where `srl_every` asks for one; else None.
        norms: `srl_jax.learning.weights.make_norms`'s, to be called before every k-th update, k being
            `srl_jax.learning.update.NORM_EVERY`; None where no weight is a ratio.
        follow: `srl_jax.learning.update.make_follow`'s, to be called after every `follow_every` updates.
        acting: TrainState -> the parameters that act: its own, or with the slow copies of RL's head and the
            encoder in their place, as the algorithm says.
        act: (params, frames, key, step, epsilon) -> actions, with noise; otherwise `make_act`'s.
        act_eval: the same without noise.
        shapes: () -> the `TrainState` that `init` gives, in shapes and dtypes.
        hyper: the numbers of an update.
        measures: what `srl_jax.diagnostics` asks of the device.
    """

    mode: Mode
    encoder: Encoder
    algorithm: Algorithm
    objectives: dict[str, Objective]
    horizon: int
    init: Init
    update: Update
    update_rl: Update | None
    norms: Callable | None
    follow: Callable[[TrainState], TrainState]
    follow_every: int
    acting: Callable[[TrainState], Params]
    act: Act
    act_eval: Act
    shapes: Callable[[], TrainState]
    hyper: Hyper
    measures: Functions


def components(
    config: Config, frame_shape: tuple[int, int, int], num_actions: int
) -> tuple[Encoder, Algorithm, dict[str, Objective]]:
    """The encoder, the RL algorithm and the representation objectives that a configuration names.

    Args:
        config, frame_shape, num_actions: see `make_agent`.

    Raises:
        srl_jax.specs.SpecError: where a spec does not fit.
    """
    height, width, channels = frame_shape
    shape = (height, width, config.frame_stack * channels)
    spec = specs.parse(config.encoder, encoders.REGISTRY, "encoder")
    encoder = plugins.build(spec, encoders.REGISTRY, shape, gives=Encoder)
    context = Context.of(encoder, num_actions)
    spec = specs.parse(config.rl, rl.REGISTRY, "rl")
    algorithm = plugins.build(spec, rl.REGISTRY, context, gives=Algorithm)
    if modes.of(config).rl:
        context = context._replace(rl_layer=algorithm.first_layer)
    parsed = [specs.parse(text, objectives.REGISTRY, "objective") for text in config.objectives]
    terms = {spec.name: plugins.build(spec, objectives.REGISTRY, context, gives=Objective) for spec in parsed}
    for spec in parsed:
        given = spec.options.get(specs.WEIGHT)
        if isinstance(given, specs.Weight) and terms[spec.name].weight is not given:
            raise specs.SpecError(f"--objective={spec}: {spec.name} changes its weight; give a number")
    return encoder, algorithm, terms


def trained_terms(
    config: Config, algorithm: Algorithm, terms: Mapping[str, Objective]
) -> tuple[dict[str, Objective], int]:
    """What a run trains by name, RL first, and the horizon of the windows that all of it reads, in steps.

    Args:
        config: the run's.
        algorithm, terms: its `components`.
    """
    mode = modes.of(config)
    found = dict(terms) if mode.representation else {}
    if mode.rl:
        found = {RL: algorithm.objective._replace(slow=algorithm.slow(config.slow_update_every)), **found}
    return found, max(1, *(term.horizon for term in found.values()))


def check_losses(
    agent: Agent, terms: Mapping[str, Objective], config: Config, frame_shape: tuple[int, int, int]
) -> None:
    """Whether losses can be computed and give what `Objective.loss` says. Compiles nothing; 0.1 s a loss.

    Each one sees a window of its own horizon, though another objective may make the run's windows longer.

    Args:
        agent: of the configuration.
        terms: those of its objectives that are looked at.
        config, frame_shape: see `make_agent`.

    Raises:
        ConfigError: one does not; a line that names the objective, and the line of its file where it raises.
    """
    state, views = agent.shapes(), Views.of(config)

    def rows(dtype: Any, *shape: int) -> Any:
        return jax.ShapeDtypeStruct((config.batch_size, *shape), dtype)

    for name, term in terms.items():
        ahead = max(1, term.horizon)
        numbers = rows(np.float32, ahead)
        window = Window(
            frames=rows(np.uint8, config.frame_stack + ahead, *frame_shape),
            actions=rows(np.int32, ahead),
            rewards=numbers,
            discounts=numbers,
            valid=numbers,
            weight=rows(np.float32),
        )
        checked = term._replace(loss=_checked(term.loss, {"td_error"} if name == RL else set()))
        losses_of = make_losses(agent.encoder, {name: checked}, agent.mode, views=views)
        try:
            jax.eval_shape(losses_of, state.params, state, window)
        except Exception as error:
            flag = f"rl={specs.split(config.rl)[0]}" if name == RL else f"objective={name}"
            why = plugins.reason(error, Path(plugins.origin(term.loss)))
            raise ConfigError(f"--{flag}: {why}") from error


def _checked(loss: Callable, of_rows: Collection[str]) -> Callable:
    """The same loss, which raises ConfigError where its results have other shapes than it may give.

    Args:
        loss: of an `Objective`.
        of_rows: the metrics that may have more axes than a scalar.
    """

    def checked(head: Params, slow_head: Params, latents: Latents, window: Window, key: jax.Array):
        found = loss(head, slow_head, latents, window, key)
        if not (isinstance(found, tuple) and len(found) == 2 and isinstance(found[1], Mapping)):
            raise ConfigError("its loss must give two things: losses [B], and a dict of metrics, {} for none")
        losses, metrics = found
        batch = window.actions.shape[:1]
        if np.shape(losses) != batch:
            raise ConfigError(
                f"its losses have shape {np.shape(losses)}; there is one of each row of the batch, {batch}"
            )
        for name, value in metrics.items():
            if np.shape(value) and name not in of_rows:
                raise ConfigError(f'its metric "{name}" has shape {np.shape(value)}; a metric is a scalar')
        return found

    return checked


def make_agent(
    config: Config, frame_shape: tuple[int, int, int], num_actions: int, *, trained: bool = True
) -> Agent:
    """Builds an `Agent`.

    Args:
        config: a run's.
        frame_shape: (H, W, C) of its environments' frames.
        num_actions: of its game.
        trained: whether it is to be trained, so that `check_losses` looks at losses of outside the package.

    Raises:
        srl_jax.specs.SpecError: where a spec does not fit.
        ConfigError: a loss is wrong, see `check_losses`.
    """
    mode, views = modes.of(config), Views.of(config)
    encoder, algorithm, terms = components(config, frame_shape, num_actions)
    terms, horizon = trained_terms(config, algorithm, terms)
    optimizer = make_optimizer(
        terms,
        decoder_weight_decay=config.decoder_weight_decay,
        weight_decay=config.weight_decay,
        max_grad_norm=config.max_grad_norm,
        adam_eps=config.adam_eps,
    )
    rates = {
        "encoder": encoder_learning_rate(config),
        "encoder_srl": second_learning_rate(config),
        "rl": config.lr_rl,
        "representation": config.lr_srl,
    }

    def jitted_update(plan: Sequence[Pass]) -> Update:
        how = partial(make_update, plan=plan, gate=config.gate, views=views, slow_follows=False)
        return Update(how(encoder, terms, mode, optimizer), plan)

    def jitted_act(noisy: bool) -> Act:
        act = make_act(encoder, algorithm.q_values, noisy=noisy)
        return jax.jit(lambda params, *rest: act(params["encoder"], params[RL], *rest))

    plan = passes(mode, terms, config.encoder_optimizer)
    norms = make_norms(encoder, terms, mode, optimizer, views=views)
    init = make_init(encoder, terms, mode, optimizer, plan=plan, target_encoder=config.target_encoder)
    agent = Agent(
        mode=mode,
        encoder=encoder,
        algorithm=algorithm,
        objectives=terms,
        horizon=horizon,
        # It runs once: compile it fast.
        init=jax.jit(init, compiler_options={"xla_backend_optimization_level": 0}),
        update=jitted_update(plan),
        update_rl=jitted_update(passes(mode, [RL])) if config.srl_every > 1 else None,
        norms=norms and jax.jit(norms),
        follow=jax.jit(make_follow(terms)),
        follow_every=follow_every(terms),
        acting=slow_params if algorithm.acts_slow and mode.rl else lambda state: state.params,
        act=jitted_act(noisy=True),
        act_eval=jitted_act(noisy=False),
        shapes=lambda: jax.eval_shape(init, jax.random.key(0)),
        hyper=Hyper(
            weights={name: jnp.float32(term.weight) for name, term in terms.items()},
            learning_rates={group: jnp.float32(rate) for group, rate in rates.items()},
        ),
        measures=make_functions(encoder, terms, mode, channels=frame_shape[-1], views=views),
    )
    if trained:
        foreign = {name: term for name, term in terms.items() if plugins.foreign(term.loss)}
        check_losses(agent, foreign, config, frame_shape)
    return agent


def slow_params(state: TrainState) -> Params:
    """The parameters with RL's slow copies of head and encoder (where there is one) in their place."""
    slow = state.slow[RL]
    encoder = {ENCODER: slow["encoder"]} if jax.tree.leaves(slow["encoder"]) else {}
    return state.params | encoder | {RL: slow["head"]}


class Seeds(NamedTuple):
    """An agent's functions for S seeds in one process. On the device these have an axis [S] in front.

    Of one seed it has none, so that nothing differs from the agent's own functions.

    Attributes:
        update, update_rl: (TrainState, [Window] of the seeds, Hyper) -> (TrainState, td_error, metrics).
        norms: (TrainState, [Window], Hyper) -> `TrainState.norms`, or None; as the agent's.
        follow: TrainState -> TrainState.
        act: (params, [frames uint8 [N, S, H, W, C]], [key], step, epsilon) -> actions.
        stack: [tree of each seed] -> tree.
        parts: tree -> the tree of each seed in turn, on the device.
        rows: tree -> [tree of each seed], on the host; waits for the device.
    """

    update: Callable
    update_rl: Callable | None
    norms: Callable | None
    follow: Callable
    act: Callable
    stack: Callable
    parts: Callable[[Any], Iterable[Any]]
    rows: Callable


def over_seeds(agent: Agent, number: int) -> Seeds:
    """Lifts an agent's functions to an axis of seeds by `jax.vmap`; worth it on an accelerator.

    A seed in company is the same run as alone but for the order of sums in products, where learning starts
    behind the first whole window of replay: before it, updates wait until every seed has one.
    """
    if number == 1:

        def alone(update: Callable) -> Callable:
            return lambda state, windows, hyper: update(state, windows[0], hyper)

        return Seeds(
            update=alone(agent.update),
            update_rl=agent.update_rl and alone(agent.update_rl),
            norms=agent.norms and alone(agent.norms),
            follow=agent.follow,
            act=lambda params, frames, keys, *now: agent.act(params, frames[0], keys[0], *now),
            stack=lambda trees: trees[0],
            parts=lambda tree: [tree],
            rows=lambda tree: [jax.device_get(tree)],
        )

    def stacked(trees: Sequence[Any]) -> Any:
        return jax.tree.map(lambda *x: jnp.stack(x), *trees)

    def lift(change: Callable) -> Callable:
        several = jax.vmap(change, in_axes=(0, 0, 0, 0, None))
        # Windows are stacked on the device, not on the host.
        return lambda opt_state, params, rest, windows, hyper: several(
            opt_state, params, rest, stacked(windows), hyper
        )

    def norms(state: TrainState, windows: Sequence[Window], hyper: Hyper) -> Any:
        assert agent.norms
        return jax.vmap(inspect.unwrap(agent.norms), (0, 0, None))(state, stacked(windows), hyper)

    act = jax.vmap(inspect.unwrap(agent.act), in_axes=(0, 0, 0, None, None))

    part = jax.jit(lambda tree, i: jax.tree.map(lambda x: x[i], tree))

    def rows(tree: Any) -> list[Any]:
        tree = jax.device_get(tree)
        return [jax.tree.map(lambda x: x[i], tree) for i in range(number)]  # noqa: B023

    return Seeds(
        update=agent.update.lifted(lift),
        update_rl=agent.update_rl and agent.update_rl.lifted(lift),
        norms=agent.norms and jax.jit(norms),
        follow=jax.jit(jax.vmap(inspect.unwrap(agent.follow))),
        act=jax.jit(lambda params, frames, keys, *now: act(params, jnp.stack(frames), jnp.stack(keys), *now)),
        stack=jax.jit(stacked),
        parts=lambda tree: (part(tree, i) for i in range(number)),
        rows=rows,
    )
