"""The functions of the device that diagnostics need: few, and each compiled for one shape."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax

from srl_jax.augment import UNCHANGED, Views
from srl_jax.latents import make_encoder_gradient
from srl_jax.learning import weights
from srl_jax.learning.modes import Mode
from srl_jax.learning.optim import ENCODER, RL
from srl_jax.learning.update import Hyper
from srl_jax.types import Array, Encoder, Latents, Objective, Params, TrainState, Window
from srl_jax.window import stack_last


class Functions(NamedTuple):
    """Jitted.

    Attributes:
        encode: (encoder's parameters, frames uint8 [B, S, H, W, C]) -> float32 [B, D].
        decode: {objective: (params, latents [B, D], Window) -> (valid [B], errors [B], targets, outputs)}, of
            those with an image that the latent of s_t is enough for. A row is valid whose episode goes on as
            far as the objective looks ahead. Errors are squared and averaged over the image. Of targets and
            outputs the newest two frames, float32 [B, 2, H, W, C] (of observations of one frame, [B, 1, H, W,
            C]).
        groups: of the parameters, which `encode` and `decode` read.
        others: names of objectives with an image that need more than that.
        conflict: `make_conflict`'s; None where RL and representation losses do not both run.
    """

    encode: Callable
    decode: Mapping[str, Callable]
    groups: tuple[str, ...]
    others: tuple[str, ...]
    conflict: Callable | None


class MoreLatents(Exception):
    """An image asks for more than the latent of s_t."""


def make_functions(
    encoder: Encoder,
    objectives: Mapping[str, Objective],
    mode: Mode,
    *,
    channels: int,
    views: Views = UNCHANGED,
) -> Functions:
    """The functions of an agent; C is `channels`, `views` as of `srl_jax.learning.update.make_update`."""
    decode = {name: _decode(name, objective) for name, objective in objectives.items() if objective.image}
    ready = {n: f for n, f in decode.items() if _enough(f, n, objectives, encoder, channels)}
    groups = {ENCODER, *ready, *(group for name in ready for group in objectives[name].reads)}
    conflict = None
    if mode.rl and mode.representation and len(objectives) > 1 and RL in objectives:
        conflict = jax.jit(make_conflict(encoder, objectives, mode, views=views))
    return Functions(
        encode=jax.jit(lambda params, frames: encoder.apply(params, stack_last(frames))),
        decode={name: jax.jit(function) for name, function in ready.items()},
        groups=tuple(sorted(groups)),
        others=tuple(decode.keys() - ready.keys()),
        conflict=conflict,
    )


def make_conflict(
    encoder: Encoder,
    objectives: Mapping[str, Objective],
    mode: Mode,
    *,
    views: Views = UNCHANGED,
) -> Callable:
    """conflict: (TrainState, Window, Hyper) -> {name: (cosine, norm ratio)}, pure; for each but RL.

    The cosine of an objective's gradient on the encoder's parameters with RL's, and its norm over RL's norm,
    both gradients of `weight * mean(losses)`, with the weight that a ratio is at that moment. Every
    loss's gradient enters the encoder here, whatever the mode: in mode decoupled it is the gradient that RL's
    would be. The cosine is NaN where a gradient is 0, as that of an objective of weight 0.
    """
    gradient = make_encoder_gradient(encoder, objectives, mode, views=views)

    def conflict(state: TrainState, window: Window, hyper: Hyper):
        factors = weights.factors(objectives, hyper.weights, state.norms)
        of_rl = gradient(RL, factors[RL], state, window)
        norm = optax.tree.norm(of_rl)
        found = {}
        for name in sorted(objectives.keys() - {RL}):
            other = gradient(name, factors[name], state, window)
            other_norm = optax.tree.norm(other)
            found[name] = optax.tree.vdot(of_rl, other) / (norm * other_norm), other_norm / norm
        return found

    return conflict


def _decode(name: str, objective: Objective) -> Callable:
    image = objective.image
    assert image

    def decode(params: Mapping[str, Params], z: Array, window: Window):
        def known(k):
            if isinstance(k, int) and k == 0:
                return z
            raise MoreLatents

        head = objective.head(params[name], objective.read(params))
        target, output = image(head, Latents(known, known), window)
        errors = jnp.mean((output - target) ** 2, (1, 2, 3))
        ahead = objective.horizon
        valid = window.valid[:, ahead - 1] > 0 if ahead else jnp.ones(len(errors), bool)
        channels = window.frames.shape[-1]
        return valid, errors, _newest(target, channels), _newest(output, channels)

    return decode


def _newest(image: Array, channels: int) -> Array:
    """The newest two frames of an image, or the one where S is 1: [B, H, W, S * C] -> [B, 2, H, W, C]."""
    frames = image.reshape(*image.shape[:3], image.shape[3] // channels, channels)[..., -2:, :]
    return jnp.moveaxis(frames, -2, 1)


def _enough(
    decode: Callable, name: str, objectives: Mapping[str, Objective], encoder: Encoder, channels: int
) -> bool:
    """Whether an image can be made of the latent of s_t; compiles nothing."""
    height, width, depth = encoder.observation_shape
    steps = max(1, objectives[name].horizon)

    def shape(dtype, *of):
        return jax.ShapeDtypeStruct((2, *of), dtype)

    actions, numbers = shape(jnp.int32, steps), shape(jnp.float32, steps)
    frames = shape(jnp.uint8, depth // channels + steps, height, width, channels)
    window = Window(frames, actions, numbers, numbers, numbers, shape(jnp.float32))
    inits = {ENCODER: encoder.init} | {n: objective.init for n, objective in objectives.items()}
    needed = [name, *objectives[name].reads]
    params = {group: jax.eval_shape(inits[group], jax.random.key(0)) for group in needed}
    try:
        jax.eval_shape(decode, params, shape(jnp.float32, encoder.features), window)
    except MoreLatents:
        return False
    return True
