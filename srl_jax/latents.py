"""What each loss sees of a window: views, and latents under the online and the slow encoders."""

import itertools
import zlib
from collections.abc import Callable, Hashable, Mapping, Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from srl_jax.augment import Seen, Views, make_seen
from srl_jax.learning.modes import Mode
from srl_jax.learning.optim import ENCODER, RL
from srl_jax.types import Array, Encoder, Latents, Objective, Offsets, Params, TrainState, Window


def named_key(key: jax.Array, name: str) -> jax.Array:
    """A key that depends on a name alone, so that enabling one objective never changes another's noise."""
    return jax.random.fold_in(key, zlib.crc32(name.encode()))


def make_losses(
    encoder: Encoder,
    objectives: Mapping[str, Objective],
    mode: Mode,
    *,
    views: Views,
) -> Callable:
    """losses: (params, TrainState, Window) -> ({name: losses [B]}, {name: metrics}), pure; see `make_update`.

    Everything but the parameters comes from the state: slow copies, and the key of the update that is next.
    """

    see_rl, see_srl = make_seen(views.rl), make_seen(views.srl)
    see_target = None if views.target == "same" else make_seen(views.target)

    def losses_of(params: Params, state: TrainState, window: Window):
        key = jax.random.fold_in(state.key, state.step)
        noise = partial(named_key, key) if encoder.train else lambda name: None
        srl_seen = see_srl(window, named_key(key, "augment"))
        alike = views.rl == views.srl
        rl_seen = srl_seen if alike else see_rl(window, named_key(key, "rl_view"))
        srl_online = encoded(encoder, params["encoder"], srl_seen, noise("online"))
        rl_online = srl_online if alike else encoded(encoder, params["encoder"], rl_seen, noise("rl online"))
        target = see_target and see_target(window, named_key(key, "target_view"))
        losses, metrics = {}, {}
        for name, objective in objectives.items():
            seen, online, opens = srl_seen, srl_online, mode.representation_trains_encoder
            if name == RL:
                seen, online, opens = rl_seen, rl_online, mode.rl_trains_encoder
                if target:
                    then = encoded(encoder, params["encoder"], target, noise("rl target"))
                    online = _later(online, then)
            read = objective.read(params)
            own = state.slow.get(name, {"encoder": {}, "head": None})
            lagged = own["encoder"] if jax.tree.leaves(own["encoder"]) else params["encoder"]
            of = _of_others(encoder, params["encoder"], lagged, noise(f"others {name}"))
            slow = encoded(encoder, lagged, target or seen, noise(f"slow {name}"))
            latents = Latents(online, frozen(slow), of)
            losses[name], metrics[name] = objective.loss(
                objective.head(params[name], read if opens else jax.lax.stop_gradient(read)),
                objective.head(own["head"], own.get("read", {})),
                latents if opens else shut(latents),
                window if objective.own_views else seen.window,
                named_key(key, name),
            )
        return losses, metrics

    return losses_of


def make_encoder_gradient(
    encoder: Encoder, objectives: Mapping[str, Objective], mode: Mode, *, views: Views
) -> Callable:
    """gradient: (name, weight, TrainState, Window) -> an objective's gradient on the encoder, pure.

    It is that of `weight * mean(losses)`, whatever the mode lets into the encoder.
    """
    opened = mode._replace(rl_trains_encoder=True, representation_trains_encoder=True)

    def gradient(name: str, weight: Array | float, state: TrainState, window: Window) -> Params:
        losses_of = make_losses(encoder, {name: objectives[name]}, opened, views=views)

        def loss(tree: Params) -> Array:
            losses, _ = losses_of({**state.params, ENCODER: tree}, state, window)
            return weight * jnp.mean(losses[name])

        return jax.grad(loss)(state.params[ENCODER])

    return gradient


def _later(now: Callable[[Offsets], jax.Array], then: Callable[[Offsets], jax.Array]) -> Callable:
    """The latents of s_t from `now`, those of any other offset from `then`."""
    return lambda k: now(k) if isinstance(k, int) and k == 0 else then(k)


def make_latents(
    encoder: Encoder, params: Params, slow: Params, window: Window, key: jax.Array | None = None
) -> Latents:
    """Latents of a window under two encoders' parameters; none with gradient under the slow ones.

    With a key they have the encoder's noise, where it has some; see `encoded`.
    """
    online, lagged, others = (None,) * 3 if key is None else jax.random.split(key, 3)
    of, seen = _of_others(encoder, params, slow, others), Seen(window)
    return Latents(encoded(encoder, params, seen, online), frozen(encoded(encoder, slow, seen, lagged)), of)


def _of_others(
    encoder: Encoder, params: Params, slow: Params, key: jax.Array | None
) -> Callable[[Window], Latents]:
    """`Latents.of`, each window with a draw of noise of its own."""
    number = itertools.count()

    def of(window: Window) -> Latents:
        own = None if key is None else jax.random.fold_in(key, next(number))
        return make_latents(encoder, params, slow, window, own)

    return of


def encoded(
    encoder: Encoder, params: Params, seen: Seen, key: jax.Array | None = None
) -> Callable[[Offsets], jax.Array]:
    """offset -> latents, list of offsets -> latents of each: what `Latents` says of one encoder.

    With a key they are those of `Encoder.train`, where there is one. What the noise of an offset, or of a
    list of offsets, is does not depend on what else is asked for; an offset that is asked for alone and the
    same one in a list have draws of their own, and offsets that are not known when they are traced share one.
    """

    def apply(observations: jax.Array, asked: Sequence[int | Array]) -> jax.Array:
        if key is None or encoder.train is None:
            return encoder.apply(params, observations)
        names = [str(offset) if isinstance(offset, int) else "array" for offset in asked]
        return encoder.train(params, observations, named_key(key, " ".join(names)))

    known: dict[Hashable, tuple[jax.Array, Mapping[Hashable, int | Array]]] = {}

    def latent(k: Offsets) -> jax.Array:
        several = isinstance(k, Sequence)
        asked = k if isinstance(k, Sequence) else (k,)
        identities = [_identity(offset) for offset in asked]
        offsets = dict(zip(identities, asked, strict=True))
        index = several, *offsets
        if index not in known:  # the offsets are kept too, so that their ids stay their own
            stacks = [seen.observe(seen.window, offset) for offset in offsets.values()]
            z = apply(jnp.concatenate(stacks) if several else stacks[0], list(offsets.values()))
            known[index] = z, offsets
        z, _ = known[index]
        if not several:
            return z
        z = z.reshape(len(offsets), -1, *z.shape[1:])
        if len(offsets) == len(identities):
            return z
        places = list(offsets)
        return z[np.array([places.index(identity) for identity in identities])]

    return latent


def _identity(offset: int | Array) -> Hashable:
    """What two offsets that are known to be equal have in common."""
    if isinstance(offset, int):
        return offset
    if isinstance(offset, jax.core.Tracer):
        return "tracer", id(offset)
    return np.shape(offset), np.asarray(offset).tobytes()


def frozen(latent: Callable[[Offsets], jax.Array]) -> Callable[[Offsets], jax.Array]:
    """The same latents without gradient."""
    return lambda k: jax.lax.stop_gradient(latent(k))


def shut(latents: Latents) -> Latents:
    """The same latents without gradient: an objective that does not train the encoder."""
    return Latents(frozen(latents.online), latents.slow, lambda window: shut(latents.of(window)))
