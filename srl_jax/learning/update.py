"""The update of an agent: where losses are summed and the encoder is stepped; also how it starts and acts."""

import dataclasses
import itertools
import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.typing import ArrayLike

from srl_jax.augment import UNCHANGED, Views
from srl_jax.latents import make_losses, named_key
from srl_jax.learning import weights
from srl_jax.learning.modes import ENCODER_OPTIMIZERS, GATES, Mode, both_train
from srl_jax.learning.optim import (
    ENCODER,
    ENCODER_SRL,
    PROJECTIONS,
    RL,
    RL_SRL,
    SECOND,
    Optimizer,
    measured,
    real_copy,
)
from srl_jax.types import Array, Encoder, Objective, Params, TrainState, Window
from srl_jax.window import stack_last

NORM_EVERY = 10
"""k: norms of the encoder's gradients and steps, each a pass over them, are metrics of every k-th update."""


Scalar: TypeAlias = Array | np.floating | float
"""One number: an array without axes counts."""


class Hyper(NamedTuple):
    """The numbers of an update that may change without compiling it again: traced float32 scalars.

    Attributes:
        weights: {objective: factor of its mean loss, or the ratio where its weight is one}.
        learning_rates: {"encoder", "encoder_srl", "rl", "representation"}.
    """

    weights: Mapping[str, Scalar]
    learning_rates: Mapping[str, Scalar]


@dataclasses.dataclass(frozen=True)
class periodic:
    """The rule of a slow copy that the original replaces in every k-th update; k is `every`."""

    every: int

    def __call__(self, new: Params, old: Params, step: Array) -> Params:
        return jax.lax.cond(step % self.every == 0, lambda: new, lambda: old)


def ema(tau: float) -> Callable[[Params, Params, Array], Params]:
    """The rule of a slow copy that is an exponential moving average, moved in every update.

    `slow = tau * slow + (1 - tau) * online`: tau is the share of the copy that stays. Near 1 it follows
    slowly, at 0 it is the original as the same update left it. BYOL (Grill et al. 2020, equation 1) and SPR
    (Schwarzer et al. 2021, section 2.2) mean this by tau; soft actor-critic means 1 - tau.

    Raises:
        ValueError: tau is not in [0, 1); at 1 the copy would stand still.
    """
    if not 0 <= tau < 1:
        raise ValueError(f"tau must be at least 0 and below 1, not {tau}")

    def follow(new: Params, old: Params, step: Array) -> Params:
        return jax.tree.map(lambda n, o: tau * o + (1 - tau) * n, new, old)

    return follow


def follow_every(objectives: Mapping[str, Objective]) -> int:
    """Updates after which a slow copy may change, in other words how often `make_follow` must be called.

    A rule that has no attribute `every`, as `periodic` has, changes its copy in every update.
    """
    rules = [objective.slow for objective in objectives.values() if objective.slow]
    return math.gcd(*(getattr(rule, "every", 1) for rule in rules))


def make_follow(objectives: Mapping[str, Objective]) -> Callable:
    """follow: TrainState, after an update -> TrainState, its slow copies moved by their rules; pure."""

    def follow_all(state: TrainState) -> TrainState:
        return state._replace(slow=follow(objectives, state.params, state.slow, state.step))

    return follow_all


class Pass(NamedTuple):
    """One gradient and one optimizer step of an update.

    Attributes:
        objectives: names of the losses whose weighted sum is differentiated.
        groups: {group of parameters that moves: group of the optimizer's state that moves it}.
        at_start: whether the gradient is taken at the parameters from before the update, and not at those
            that the pass before has left.
    """

    objectives: tuple[str, ...]
    groups: dict[str, str]
    at_start: bool = False


def passes(
    mode: Mode,
    active: Collection[str] | Mapping[str, Objective],
    encoder_optimizer: str = "separate",
) -> tuple[Pass, ...]:
    """The passes of an update that computes these objectives in this mode, in their order.

    One, of the sum of all losses, unless both kinds of loss train the encoder.

    Args:
        mode: a row of `srl_jax.learning.modes`.
        active: names of the objectives, RL's is "rl"; where one of them reads another group
            (`Objective.reads`), the objectives themselves by name. A pass that lets its objectives train the
            encoder moves what they read, too, in the second pass by a second Adam of that group's.
        encoder_optimizer: how both kinds of loss step the encoder. "separate": RL's Adam steps, then the
            representation's own Adam steps on the same batch, encoded anew by the encoder that RL's step
            left, as in the thesis' code. Adam does not see the scale of a loss, so the two steps are about as
            long whatever the losses' weights. "simultaneous": likewise, but both gradients are taken at the
            same parameters. "summed": one Adam on the gradient of the sum.

    Raises:
        ValueError: an objective has the name of one of the encoder's groups, or there is no such
            `encoder_optimizer`.
    """
    if encoder_optimizer not in ENCODER_OPTIMIZERS:
        valid = ", ".join(ENCODER_OPTIMIZERS)
        raise ValueError(f"encoder_optimizer must be one of {valid}, not {encoder_optimizer}")
    for name in (ENCODER, ENCODER_SRL, RL_SRL):
        if name in active:
            raise ValueError(f"an objective cannot be called {name}: an optimizer's state has that name")

    def one(names: tuple[str, ...], suffix: str = "") -> Pass:
        shared = [ENCODER] if mode.rl_trains_encoder and RL in names else []
        if mode.representation_trains_encoder and set(names) - {RL}:
            shared = [ENCODER, *(_read_by(active, names) if isinstance(active, Mapping) else ())]
        groups = {name: name for name in names}
        groups |= {group: group + suffix for group in shared if group not in names}
        return Pass(names, groups, at_start=encoder_optimizer == "simultaneous")

    others = tuple(name for name in active if name != RL)
    if encoder_optimizer == "summed" or not (both_train(mode) and RL in active and others):
        return (one(tuple(active)),)
    return one((RL,)), one(others, SECOND)


def make_init(
    encoder: Encoder,
    objectives: Mapping[str, Objective],
    mode: Mode,
    optimizer: Optimizer,
    *,
    plan: Sequence[Pass] | None = None,
    target_encoder: str = "slow",
) -> Callable:
    """init: (key, given | None) -> TrainState.

    `given`, {group: tree}, is where some groups of the parameters start. Each other tree's initial values
    depend on the key and its own name alone.

    Args:
        encoder, objectives, mode, optimizer, plan: see `make_update`.
        target_encoder: "slow": an objective with a rule has a slow copy of its head and one of the encoder,
            which gives the slow latents; "online": of its head alone, and the slow latents are the online
            encoder's without gradient, as in the thesis' code.
    """
    if target_encoder not in ("slow", "online"):
        raise ValueError(f"target_encoder must be slow or online, not {target_encoder}")
    plan = passes(mode, objectives) if plan is None else plan

    def init(key: jax.Array, given: Params | None = None) -> TrainState:
        start = named_key(key, "init")
        given = given or {}
        params = {n: o.init(named_key(start, f"head {n}")) for n, o in objectives.items() if n not in given}
        if ENCODER not in given:
            params[ENCODER] = encoder.init(named_key(start, "encoder"))
        params |= real_copy(given)
        lagged = params[ENCODER] if target_encoder == "slow" else {}
        slow = {n: _copied(o, n, lagged, params) for n, o in objectives.items() if o.slow}
        groups = [pair for one in plan for pair in one.groups.items()]
        return TrainState(
            params=params,
            slow=real_copy(slow),
            opt_state=optimizer.init({moments: params[group] for group, moments in groups}),
            step=jnp.zeros((), jnp.int32),
            key=real_copy(key),
            norms=weights.start(objectives, two_adams=len(plan) > 1),
        )

    return init


def make_update(
    encoder: Encoder,
    objectives: Mapping[str, Objective],
    mode: Mode,
    optimizer: Optimizer,
    *,
    plan: Sequence[Pass] | None = None,
    gate: str = "sum",
    views: Views = UNCHANGED,
    slow_follows: bool = True,
) -> Callable:
    """update: (TrainState, Window, Hyper) -> (TrainState, td_error [B] | None, metrics), pure; jit it once.

    In each pass it sums `weight * mean(losses)` over the pass' objectives, RL among them under the name
    "rl", takes one gradient and one optimizer step. Objectives of a pass share the encoder's forward and
    backward pass: an offset is encoded at most once for each view. Whether an objective's gradient enters the
    encoder is the mode's to say, and is decided at the latent, so that nothing is differentiated for nothing.

    Args:
        encoder: the shared encoder.
        objectives: by name; RL's is called "rl".
        mode: a row of `srl_jax.learning.modes`.
        optimizer: from `srl_jax.learning.optim`.
        plan: the passes, see `passes`; None for those of all objectives. The heads of others do not move.
        gate: a key of `srl_jax.learning.modes.GATES`: how the gradients of RL and of the objectives meet in
            the encoder where the plan has both. "pcgrad" and "orthogonal", see
            `srl_jax.learning.optim.PROJECTIONS`, take both at the same parameters; heads do not notice. What
            stops at the latent is the mode's to say.
        views: what each loss sees.
        slow_follows: whether the slow copies move by their rules; False leaves that to `make_follow`, which
            then must be called after every `follow_every` updates: an update that never writes to the slow
            copies needs no copy of them.

    Returns:
        The update. Metrics are scalars on the device: `loss/NAME` (before its weight; RL's with its
        importance weights), `loss/total`, `NAME/...` of each objective's own; `grad_norm/encoder` (where it
        moves) and `grad_norm/all` (where gradients are clipped; before that), with `_srl` behind them in the
        second of two passes, and `step_ratio/encoder`, the length of the second pass' step of the encoder
        over the first's. Those of the encoder are `srl_jax.learning.optim.NOT_MEASURED` but in every k-th
        update, k being `NORM_EVERY`.
    """
    if gate not in GATES:
        raise ValueError(f"gate must be one of {', '.join(GATES)}, not {gate}")
    plan = passes(mode, objectives) if plan is None else plan
    kinds = _kinds(name for one in plan for name in one.objectives)
    project = PROJECTIONS.get(gate) if len(kinds) > 1 else None
    if project and len(plan) > 1 and not plan[1].at_start:
        raise ValueError(f"gate {gate} takes both gradients at the same parameters: not after RL's step")
    parts = kinds if project else [one.objectives for one in plan]
    losses_of = {
        names: make_losses(encoder, {name: objectives[name] for name in names}, mode, views=views)
        for names in parts
    }
    of_ratios = [name for name in weights.ratios(objectives) if any(name in names for names in parts)]

    def update(state: TrainState, window: Window, hyper: Hyper):
        if set(hyper.weights) != set(objectives):
            raise ValueError(f"weights {sorted(hyper.weights)} for losses {sorted(objectives)}")
        measure = state.step % NORM_EVERY == 0
        factors = weights.factors(objectives, hyper.weights, state.norms)
        rates = hyper.learning_rates
        if of_ratios and len(plan) > 1:
            ratios = {name: hyper.weights[name] for name in of_ratios}
            rates = {**rates, ENCODER_SRL: weights.second_rate(ratios, state.norms, rates[ENCODER])}

        def differentiated(names: tuple[str, ...], groups: Collection[str], at: Params) -> tuple:
            """((weighted sum, (losses, metrics)), gradients) of the losses of these names."""

            def total(moving: Params):
                losses, extra = losses_of[names](at | moving, state, window)
                return sum(factors[name] * jnp.mean(losses[name]) for name in losses), (losses, extra)

            return jax.value_and_grad(total, has_aux=True)({group: at[group] for group in groups})

        ahead = {}
        if project:
            ahead = {
                names: differentiated(names, {*names, ENCODER, *_read_by(objectives, names)}, state.params)
                for names in kinds
            }
            of_rl, of_srl = (gradients for _, gradients in ahead.values())
            of_rl[ENCODER], of_srl[ENCODER] = project(of_rl[ENCODER], of_srl[ENCODER])
        params, opt_state = state.params, state.opt_state
        losses: dict[str, Array] = {}
        extra: dict[str, dict[str, Array]] = {}
        metrics: dict[str, Any] = {"loss/total": 0.0}
        lengths: list[tuple[Params, Params]] = []
        for one in plan:
            if project:
                found = [ahead[names] for names in kinds if names[0] in one.objectives]
            else:
                found = [differentiated(one.objectives, one.groups, state.params if one.at_start else params)]
            (value, (own, own_extra)), grads = _added(*found)
            before = {group: params[group] for group in one.groups}
            moved, moments, norms = optimizer.update(
                grads,
                {group: opt_state[name] for group, name in one.groups.items()},
                before,
                {group: rates[rate_of(name)] for group, name in one.groups.items()},
                measure,
                [group for group, name in one.groups.items() if name == RL_SRL],
            )
            params = params | moved
            opt_state = opt_state | {one.groups[group]: x for group, x in moments.items()}
            suffix = "_srl" if lengths else ""
            metrics |= {f"grad_norm/{group}{suffix}": norm for group, norm in norms.items()}
            metrics["loss/total"] += value
            losses, extra = losses | own, extra | own_extra
            if len(plan) > 1:
                lengths.append((moved[ENCODER], before[ENCODER]))
        if lengths:
            metrics["step_ratio/encoder"] = measured(measure, _length_ratio, *lengths)
        step = state.step + 1
        td_error = extra.get(RL, {}).pop("td_error", None)
        metrics |= {f"weight/{name}": factors[name] for name in of_ratios}
        for kind, means in (state.norms or {}).items() if of_ratios else ():
            metrics |= {f"running_{kind}/{name}": mean for name, mean in means.items()}
        metrics |= {f"loss/{name}": jnp.mean(x) for name, x in losses.items()}
        metrics |= {f"{name}/{k}": x for name, values in extra.items() for k, x in values.items()}
        slow = follow(objectives, params, state.slow, step) if slow_follows else state.slow
        return TrainState(params, slow, opt_state, step, state.key, state.norms), td_error, metrics

    return update


def rate_of(moments: str) -> str:
    """The name of the learning rate of a group of the optimizer's state."""
    return moments if moments in (ENCODER, ENCODER_SRL, RL) else "representation"


def _added(first: tuple, *others: tuple) -> tuple:
    """What `jax.value_and_grad` gives of a sum, from what it gives of its parts."""
    (value, (losses, extra)), gradients = first
    for (more, (own, own_extra)), own_gradients in others:
        value, losses, extra = value + more, losses | own, extra | own_extra
        both = gradients.keys() & own_gradients.keys()
        sums = {group: jax.tree.map(jnp.add, gradients[group], own_gradients[group]) for group in both}
        gradients = gradients | own_gradients | sums
    return (value, (losses, extra)), gradients


def _length_ratio(first: tuple[Params, Params], second: tuple[Params, Params]) -> Array:
    """The length of the second step, (parameters after, before), over the first's."""
    before, now = (optax.tree.norm(optax.tree.sub(*step)) for step in (first, second))
    return now / jnp.maximum(before, 1e-30)


def _read_by(objectives: Mapping[str, Objective], names: Iterable[str]) -> list[str]:
    """The groups that objectives of these names read, see `Objective.reads`."""
    return [group for name in names for group in objectives[name].reads]


def _copied(objective: Objective, name: str, encoder: Params, params: Params) -> Params:
    """What an objective has a slow copy of, `TrainState.slow`."""
    read = objective.read(params)
    return {"encoder": encoder, "head": params[name]} | ({"read": read} if read else {})


def _kinds(names: Iterable[str]) -> list[tuple[str, ...]]:
    """The names of the two kinds of loss, RL's and the objectives', each that there is, RL first."""
    rl_first = sorted(names, key=lambda name: name != RL)
    return [tuple(kind) for _, kind in itertools.groupby(rl_first, key=lambda name: name == RL)]


def follow(objectives: Mapping[str, Objective], params: Params, slow: Params, step: Array) -> Params:
    """The slow copies after an update, as `TrainState.slow`, each by its objective's rule."""
    rules = {name: objective.slow for name, objective in objectives.items() if objective.slow}
    moved = {}
    for name, old in slow.items():
        lagged = params["encoder"] if jax.tree.leaves(old["encoder"]) else {}
        moved[name] = rules[name](_copied(objectives[name], name, lagged, params), old, step)
    return moved


def make_act(encoder: Encoder, q_values: Callable, *, noisy: bool) -> Callable:
    """act: (params, head, frames, key, step, epsilon) -> actions, pure; jit it.

    Args:
        encoder: the shared encoder.
        q_values: (head, latents, key | None) -> [N, A], an algorithm's.
        noisy: whether noisy layers act with noise (training) or with their means (evaluation).

    Returns:
        The function. It takes the encoder's and the RL head's parameters, frames uint8 [N, S, H, W, C], a
        key, a step (its draws come from fold_in(key, step)) and epsilon, a float32 scalar in [0, 1], and
        gives int32 [N]: the greedy action, or with probability epsilon a uniformly random one.
    """

    def act(params: Params, head: Params, frames: Array, key: Array, step: Array, epsilon: Array) -> Array:
        noise_key, coin_key, action_key = jax.random.split(jax.random.fold_in(key, step), 3)
        z = encoder.apply(params, stack_last(frames))
        q = q_values(head, z, noise_key if noisy else None)
        return epsilon_greedy(q, coin_key, action_key, epsilon)

    return act


def epsilon_greedy(q: Array, coin_key: Array, action_key: Array, epsilon: ArrayLike) -> jax.Array:
    """int32 [...]: the greedy action of values [..., A], or with probability epsilon one drawn uniformly."""
    random = jax.random.randint(action_key, q.shape[:-1], 0, q.shape[-1])
    explore = jax.random.uniform(coin_key, q.shape[:-1]) < epsilon
    return jnp.where(explore, random, jnp.argmax(q, -1)).astype(jnp.int32)
