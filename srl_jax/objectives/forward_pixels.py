"""Forward prediction in pixel space: a later observation from the latent and the actions until then."""

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

from srl_jax.layers import Dense
from srl_jax.objectives.networks import functions, mean_squared_error, one_hot
from srl_jax.specs import check_choice, check_size
from srl_jax.types import Array, Context, Latents, Objective, Params, Window
from srl_jax.window import image

ACTIONS = ("joined", "multiplied")
TARGETS = ("observation", "difference")


class ActionGate(nn.Module):
    """The latent multiplied by the actions: `V ((W z) * (U a))`, float32 [B, D], [B, A'] -> [B, D].

    Oh et al. (2015), equation 5: a factored three-way product, whose inner size is D.
    """

    @nn.compact
    def __call__(self, z: Any, actions: Any) -> Array:
        size = z.shape[-1]
        inner = Dense(size, name="latent")(z) * Dense(size, name="action")(actions)
        return Dense(size, name="out")(inner)


def forward_pixels(
    context: Context,
    *,
    weight: float = 1.0,
    steps: int = 1,
    target: str = "observation",
    action: str = "joined",
) -> Objective:
    """Decodes z_t and the actions into s_{t+steps}, by mean squared error on pixels in [0, 1].

    Thesis, section 5.4. The actions are not known when the encoder acts, so they meet the latent at the
    decoder's input. The gradient flows into the decoder and, through z_t, into the encoder. Rows whose
    episode ends before count 0.

    Args:
        steps: how far ahead the observation lies; the decoder has all actions until then (thesis, section
            7.3).
        target: "observation", or "difference": half of `1 + s_{t+steps} - s_t`, which is in [0, 1] too and
            the same grey wherever nothing moves.
        action: "joined" to the latent as one-hot vectors (the thesis' code appends its number), or
            "multiplied" with it, see `ActionGate`.
    """
    check_size("steps", steps)
    check_choice("target", target, TARGETS)
    check_choice("action", action, ACTIONS)
    inputs = steps * context.num_actions
    multiplied = action == "multiplied"
    decoder = context.make_decoder(0 if multiplied else inputs)
    init_gate, gate = functions(ActionGate(), context.features, inputs)

    def init(key: jax.Array) -> Params:
        if not multiplied:
            return decoder.init(key)
        first, second = jax.random.split(key)
        return {"decoder": decoder.init(first), "gate": init_gate(second)}

    def predicted(head: Params, latents: Latents, window: Window):
        actions = one_hot(window.actions[:, :steps], context.num_actions).reshape(-1, inputs)
        wanted = image(window, steps)
        if target == "difference":
            wanted = (1.0 + wanted - image(window, 0)) / 2
        if multiplied:
            return wanted, decoder.apply(head["decoder"], gate(head["gate"], latents.online(0), actions))
        return wanted, decoder.apply(head, jnp.concatenate([latents.online(0), actions], -1))

    def picture(head: Params, latents: Latents, window: Window):
        wanted, output = predicted(head, latents, window)
        if target == "difference":  # as observations, which can be told from what stood still
            wanted, output = (image(window, 0) + 2.0 * x - 1.0 for x in (wanted, output))
        return wanted, output

    def loss(head: Params, slow_head: Params, latents: Latents, window: Window, key: jax.Array):
        wanted, output = predicted(head, latents, window)
        return window.valid[:, steps - 1] * jax.vmap(mean_squared_error)(output, wanted), {}

    return Objective(init, loss, weight, horizon=steps, is_decoder=True, image=picture)
