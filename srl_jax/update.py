"""make_init, make_update, make_conflict and make_act: the one place where losses are summed."""

import math
import zlib
from collections.abc import Callable, Collection
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax

from srl_jax.augment import random_shift
from srl_jax.modes import Mode
from srl_jax.optim import RL, Optimizer, real_copy
from srl_jax.types import Array, Encoder, Latents, Objective, Params, TrainState, Window
from srl_jax.window import observation, stack_last

NORM_EVERY = 10
"""The norm of the encoder's gradient, a pass over it, is a metric of every so many updates."""


class Hyper(NamedTuple):
    """The numbers of an update that may change without compiling it again: traced float32 scalars.

    Attributes:
        weights: {objective: factor of its mean loss}.
        learning_rates: {"encoder", "rl", "representation"}.
    """

    weights: dict[str, Array]
    learning_rates: dict[str, Array]


def named_key(key: Array, name: str) -> Array:
    """A key that depends on a name alone, so that enabling one objective never changes another's noise."""
    return jax.random.fold_in(key, zlib.crc32(name.encode()))


def periodic(every: int) -> Callable:
    """The rule of a slow copy that is replaced by the original every so many updates."""

    def follow(new: Params, old: Params, step: Array) -> Params:
        return jax.lax.cond(step % every == 0, lambda: new, lambda: old)

    follow.every = every
    return follow


def follow_every(objectives: dict[str, Objective]) -> int:
    """Updates after which a slow copy may change, in other words how often `make_follow` must be called.

    A rule that has no attribute `every`, as `periodic` has, changes its copy in every update.
    """
    rules = [objective.slow for objective in objectives.values() if objective.slow]
    return math.gcd(*(getattr(rule, "every", 1) for rule in rules))


def make_follow(objectives: dict[str, Objective]) -> Callable:
    """follow: TrainState, after an update -> TrainState, its slow copies moved by their rules; pure."""

    def follow_all(state: TrainState) -> TrainState:
        return state._replace(slow=follow(objectives, state.params, state.slow, state.step))

    return follow_all


def make_init(
    encoder: Encoder,
    objectives: dict[str, Objective],
    mode: Mode,
    optimizer: Optimizer,
    *,
    target_encoder: str = "slow",
) -> Callable:
    """init: (key, encoder_params | None) -> TrainState.

    The encoder has a slow copy where an objective's head has one, unless `target_encoder` is "online".
    `encoder_params`, where given, is where the encoder starts. Each tree's initial values depend on the key
    and its own name alone.
    """

    def init(key: Array, encoder_params: Params | None = None) -> TrainState:
        start = named_key(key, "init")
        if encoder_params is None:
            encoder_params = encoder.init(named_key(start, "encoder"))
        heads = {n: o.init(named_key(start, f"head {n}")) for n, o in objectives.items()}
        params = {"encoder": real_copy(encoder_params), "heads": heads}
        slow = {"heads": {n: heads[n] for n, o in objectives.items() if o.slow}}
        slow["encoder"] = params["encoder"] if slow["heads"] and target_encoder == "slow" else {}
        trainable, _ = split(params, mode, objectives)
        return TrainState(
            params=params,
            slow=real_copy(slow),
            opt_state=optimizer.init(trainable),
            step=jnp.zeros((), jnp.int32),
            key=real_copy(key),
        )

    return init


def split(groups: Params, mode: Mode, active: Collection[str]) -> tuple[Params, Params]:
    """The groups that move where these objectives run in this mode, and those that do not; see `join`.

    Args:
        groups: {"encoder": tree, "heads": {name: tree}}: parameters, or an optimizer's state.
    """
    moves = mode.rl_trains_encoder and RL in active
    moves |= mode.representation_trains_encoder and any(name != RL for name in active)
    trainable, still = {"heads": {}}, {"heads": {}}
    if "encoder" in groups:
        (trainable if moves else still)["encoder"] = groups["encoder"]
    for name, head in groups["heads"].items():
        (trainable if name in active else still)["heads"][name] = head
    return trainable, still


def join(trainable: Params, still: Params) -> Params:
    """The groups that `split` took apart."""
    return {**trainable, **still, "heads": {**trainable["heads"], **still["heads"]}}


class Moving(NamedTuple):
    """What an update changes of a `TrainState`: of the groups that move, and the number of updates.

    jax gives the buffers of donated arguments to the results of their shape, in the results' order. With the
    optimizer's state first, moments are written over the old moments, and not parameters.
    """

    opt_state: Params
    params: Params
    step: Array


def take_apart(state: TrainState, mode: Mode, active: Collection[str]) -> tuple[Moving, TrainState]:
    """What an update of these objectives changes of a state, and the rest; see `put_together`."""
    opt_state, still_opt_state = split(state.opt_state, mode, active)
    params, still_params = split(state.params, mode, active)
    still = state._replace(opt_state=still_opt_state, params=still_params, step=None)
    return Moving(opt_state, params, state.step), still


def put_together(moving: Moving, still: TrainState) -> TrainState:
    """The state that `take_apart` took apart."""
    opt_state = join(moving.opt_state, still.opt_state)
    return still._replace(opt_state=opt_state, params=join(moving.params, still.params), step=moving.step)


def make_update(
    encoder: Encoder,
    objectives: dict[str, Objective],
    mode: Mode,
    optimizer: Optimizer,
    *,
    augment: str = "none",
    target_encoder: str = "slow",
    only: Collection[str] | None = None,
    slow_follows: bool = True,
) -> Callable:
    """update: (TrainState, Window, Hyper) -> (TrainState, td_error [B] | None, metrics), pure; jit it once.

    Sums `weight * mean(losses)` over the objectives, RL among them under the name "rl", takes one gradient
    and one optimizer step. Objectives share the encoder's forward and backward pass: an offset is encoded
    at most once for each view. Whether an objective's gradient enters the encoder is the mode's to say, and
    is decided at the latent, so that nothing is differentiated for nothing.

    Args:
        encoder: the shared encoder.
        objectives: by name; RL's is called "rl".
        mode: a row of `srl_jax.modes`.
        optimizer: from `srl_jax.optim`.
        augment: "none"; "srl": the representation losses see a randomly shifted window; "all": every loss
            does.
        target_encoder: "slow": the slow latents come from the encoder's slow copy; "online": from the
            online encoder, as in the thesis' code (without gradient either way).
        only: the objectives that this update computes; None for all. The heads of the others do not move.
        slow_follows: whether the slow copies move by their rules; False leaves that to `make_follow`, which
            then must be called after every `follow_every` updates: an update that never writes to the slow
            copies needs no copy of them.

    Returns:
        The update. Metrics are scalars on the device: `loss/NAME` (before its weight; RL's with its
        importance weights), `loss/total`, `grad_norm/encoder` (where it moves; NaN but in every
        `NORM_EVERY`th update), `grad_norm/all` (where gradients are clipped; before that), `NAME/...` of
        each objective's own.
    """

    if augment not in ("none", "srl", "all"):
        raise ValueError(f"augment must be none, srl or all, not {augment}")
    if target_encoder not in ("slow", "online"):
        raise ValueError(f"target_encoder must be slow or online, not {target_encoder}")

    active = {n: o for n, o in objectives.items() if only is None or n in only}
    losses_of = make_losses(encoder, active, mode, augment=augment, target_encoder=target_encoder)

    def update(state: TrainState, window: Window, hyper: Hyper):
        if set(hyper.weights) != set(objectives):
            raise ValueError(f"weights {sorted(hyper.weights)} for losses {sorted(objectives)}")
        trainable, still = split(state.params, mode, active)

        def summed(trainable: Params):
            losses, metrics = losses_of(join(trainable, still), state, window)
            total = sum(hyper.weights[name] * jnp.mean(losses[name]) for name in losses)
            return total, (losses, metrics)

        (total, (losses, extra)), grads = jax.value_and_grad(summed, has_aux=True)(trainable)
        moved, opt_state, norms = optimizer.update(
            grads, state.opt_state, trainable, hyper.learning_rates, state.step % NORM_EVERY == 0
        )
        params = join(moved, still)
        step = state.step + 1
        td_error = extra.get(RL, {}).pop("td_error", None)
        metrics = {f"loss/{name}": jnp.mean(x) for name, x in losses.items()}
        metrics |= {"loss/total": total} | {f"grad_norm/{group}": norm for group, norm in norms.items()}
        metrics |= {f"{name}/{k}": x for name, values in extra.items() for k, x in values.items()}
        slow = follow(objectives, params, state.slow, step) if slow_follows else state.slow
        return TrainState(params, slow, opt_state, step, state.key), td_error, metrics

    return update


def make_losses(
    encoder: Encoder,
    objectives: dict[str, Objective],
    mode: Mode,
    *,
    augment: str,
    target_encoder: str,
) -> Callable:
    """losses: (params, TrainState, Window) -> ({name: losses [B]}, {name: metrics}), pure; see `make_update`.

    Everything but the parameters comes from the state: slow copies, and the key of the update that is next.
    """

    def losses_of(params: Params, state: TrainState, window: Window):
        key = jax.random.fold_in(state.key, state.step)
        shifted = window if augment == "none" else shift(window, named_key(key, "augment"))
        rl_view = window if augment == "srl" else shifted
        slow = state.slow["encoder"] if target_encoder == "slow" else params["encoder"]
        seen = make_latents(encoder, params["encoder"], slow, shifted)
        rl_seen = seen if rl_view is shifted else make_latents(encoder, params["encoder"], slow, rl_view)
        losses, metrics = {}, {}
        for name, objective in objectives.items():
            view, latents, opens = shifted, seen, mode.representation_trains_encoder
            if name == RL:
                view, latents, opens = rl_view, rl_seen, mode.rl_trains_encoder
            losses[name], metrics[name] = objective.loss(
                params["heads"][name],
                state.slow["heads"].get(name),
                latents if opens else shut(latents),
                view,
                named_key(key, name),
            )
        return losses, metrics

    return losses_of


def make_conflict(
    encoder: Encoder,
    objectives: dict[str, Objective],
    mode: Mode,
    *,
    augment: str,
    target_encoder: str,
) -> Callable:
    """conflict: (TrainState, Window, Hyper) -> {name: (cosine, norm ratio)}, pure; for each but RL.

    The cosine of an objective's gradient on the encoder's parameters with RL's, and its norm over RL's norm,
    both gradients of `weight * mean(losses)`. Every loss's gradient enters the encoder here, whatever the
    mode: in mode decoupled it is the gradient that RL's would be.
    """
    both = mode._replace(rl_trains_encoder=True, representation_trains_encoder=True)

    def conflict(state: TrainState, window: Window, hyper: Hyper):
        def gradient(name: str) -> Params:
            losses_of = make_losses(
                encoder, {name: objectives[name]}, both, augment=augment, target_encoder=target_encoder
            )

            def loss(tree: Params) -> Array:
                losses, _ = losses_of({**state.params, "encoder": tree}, state, window)
                return hyper.weights[name] * jnp.mean(losses[name])

            return jax.grad(loss)(state.params["encoder"])

        of_rl = gradient(RL)
        norm = optax.tree.norm(of_rl)
        found = {}
        for name in sorted(objectives.keys() - {RL}):
            other = gradient(name)
            other_norm = optax.tree.norm(other)
            found[name] = optax.tree.vdot(of_rl, other) / (norm * other_norm), other_norm / norm
        return found

    return conflict


def follow(objectives: dict[str, Objective], params: Params, slow: Params, step: Array) -> Params:
    """The slow copies after an update, each by its objective's rule; the encoder's goes with RL's."""
    heads = {
        name: objectives[name].slow(params["heads"][name], old, step) for name, old in slow["heads"].items()
    }
    encoder = slow["encoder"]
    if RL in objectives and encoder:
        encoder = objectives[RL].slow(params["encoder"], encoder, step)
    return {"heads": heads, "encoder": encoder}


def shift(window: Window, key: Array) -> Window:
    """The window, each row shifted by its own draw."""
    keys = jax.random.split(key, window.frames.shape[0])
    return window._replace(frames=jax.vmap(random_shift)(window.frames, keys))


def make_latents(encoder: Encoder, params: Params, slow: Params, window: Window) -> Latents:
    """Latents that encode an offset at most once for each object given as offset."""
    known = {}

    def at(which: str, tree: Params) -> Callable:
        def latent(k: int | Array) -> Array:
            index = (which, k if isinstance(k, int) else id(k))
            if index not in known:  # the offset is kept too, so that its id stays its own
                known[index] = (encoder.apply(tree, observation(window, k)), k)
            return known[index][0]

        return latent

    frozen = at("slow", slow)
    return Latents(at("online", params), lambda k: jax.lax.stop_gradient(frozen(k)))


def shut(latents: Latents) -> Latents:
    """The same latents without gradient: an objective that does not train the encoder."""
    return Latents(lambda k: jax.lax.stop_gradient(latents.online(k)), latents.slow)


def make_act(encoder: Encoder, q_values: Callable, *, noisy: bool) -> Callable:
    """act: (params, head, frames, key, step, epsilon) -> actions, pure; jit it.

    Args:
        encoder: the shared encoder.
        q_values: (head, latents, key | None) -> [N, A], an algorithm's.
        noisy: whether noisy layers act with noise (training) or with their means (evaluation).

    Returns:
        The function. It takes the encoder's and the RL head's parameters, frames uint8 [N, S, H, W], a key,
        a step (its draws come from fold_in(key, step)) and epsilon, a float32 scalar in [0, 1], and gives
        int32 [N]: the greedy action, or with probability epsilon a uniformly random one.
    """

    def act(params: Params, head: Params, frames: Array, key: Array, step: Array, epsilon: Array) -> Array:
        noise_key, coin_key, action_key = jax.random.split(jax.random.fold_in(key, step), 3)
        z = encoder.apply(params, stack_last(frames))
        q = q_values(head, z, noise_key if noisy else None)
        number, num_actions = q.shape
        random = jax.random.randint(action_key, (number,), 0, num_actions)
        explore = jax.random.uniform(coin_key, (number,)) < epsilon
        return jnp.where(explore, random, jnp.argmax(q, -1)).astype(jnp.int32)

    return act
