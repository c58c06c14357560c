"""The functions of the device that diagnostics need: few, and each compiled for one shape."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax

from srl_jax.modes import Mode
from srl_jax.optim import RL
from srl_jax.types import Array, Encoder, Latents, Objective, Params, TrainState, Window
from srl_jax.update import Hyper, make_losses
from srl_jax.window import stack_last


class Functions(NamedTuple):
    """Jitted.

    Attributes:
        encode: (encoder's parameters, frames uint8 [B, S, H, W, C]) -> float32 [B, D].
        decode: {objective: (head, latents [B, D], Window) -> (errors [B], targets, outputs)}, of those with
            an image that the latent of s_t is enough for. Errors are squared and averaged over the image. Of
            targets and outputs the newest two frames, float32 [B, 2, H, W, C] (of observations of one frame,
            [B, 1, H, W, C]).
        others: names of objectives with an image that need more than that.
        conflict: `make_conflict`'s; None where RL and representation losses do not both run.
    """

    encode: Callable
    decode: Mapping[str, Callable]
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
    augment: str,
) -> Functions:
    """The functions of an agent; C is `channels`, `augment` as of `srl_jax.update.make_update`."""
    images = {name: objective.image for name, objective in objectives.items() if objective.image}
    decode = {name: _decode(image) for name, image in images.items()}
    ready = {n: f for n, f in decode.items() if _enough(f, objectives[n], encoder, channels)}
    conflict = None
    if mode.rl and mode.representation and len(objectives) > 1 and RL in objectives:
        conflict = jax.jit(make_conflict(encoder, objectives, mode, augment=augment))
    return Functions(
        encode=jax.jit(lambda params, frames: encoder.apply(params, stack_last(frames))),
        decode={name: jax.jit(function) for name, function in ready.items()},
        others=tuple(images.keys() - ready.keys()),
        conflict=conflict,
    )


def make_conflict(
    encoder: Encoder,
    objectives: Mapping[str, Objective],
    mode: Mode,
    *,
    augment: str,
) -> Callable:
    """conflict: (TrainState, Window, Hyper) -> {name: (cosine, norm ratio)}, pure; for each but RL.

    The cosine of an objective's gradient on the encoder's parameters with RL's, and its norm over RL's norm,
    both gradients of `weight * mean(losses)`. Every loss's gradient enters the encoder here, whatever the
    mode: in mode decoupled it is the gradient that RL's would be.
    """
    both = mode._replace(rl_trains_encoder=True, representation_trains_encoder=True)

    def conflict(state: TrainState, window: Window, hyper: Hyper):
        def gradient(name: str) -> Params:
            losses_of = make_losses(encoder, {name: objectives[name]}, both, augment=augment)

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


def _decode(image: Callable) -> Callable:
    def decode(head: Params, z: Array, window: Window):
        def known(k):
            if isinstance(k, int) and k == 0:
                return z
            raise MoreLatents

        target, output = image(head, Latents(known, known), window)
        errors = jnp.mean((output - target) ** 2, (1, 2, 3))
        channels = window.frames.shape[-1]
        return errors, _newest(target, channels), _newest(output, channels)

    return decode


def _newest(image: Array, channels: int) -> Array:
    """The newest two frames of an image, or the one where S is 1: [B, H, W, S * C] -> [B, 2, H, W, C]."""
    frames = image.reshape(*image.shape[:3], image.shape[3] // channels, channels)[..., -2:, :]
    return jnp.moveaxis(frames, -2, 1)


def _enough(decode: Callable, objective: Objective, encoder: Encoder, channels: int) -> bool:
    """Whether an image can be made of the latent of s_t; compiles nothing."""
    height, width, depth = encoder.observation_shape
    steps = max(1, objective.horizon)

    def shape(dtype, *of):
        return jax.ShapeDtypeStruct((2, *of), dtype)

    actions, numbers = shape(jnp.int32, steps), shape(jnp.float32, steps)
    frames = shape(jnp.uint8, depth // channels + steps, height, width, channels)
    window = Window(frames, actions, numbers, numbers, numbers, shape(jnp.float32))
    head = jax.eval_shape(objective.init, jax.random.key(0))
    try:
        jax.eval_shape(decode, head, shape(jnp.float32, encoder.features), window)
    except MoreLatents:
        return False
    return True
