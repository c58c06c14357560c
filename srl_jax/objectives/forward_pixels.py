"""One-step forward prediction in pixel space: the next observation from the latent and the action."""

import jax
import jax.numpy as jnp

from srl_jax.objectives.reconstruction import mean_squared_error
from srl_jax.types import Context, Latents, Objective, Window
from srl_jax.window import image


def forward_pixels(context: Context, *, weight: float = 1.0) -> Objective:
    """Decodes z_t and a_t into s_{t+1}, by mean squared error on pixels in [0, 1] (thesis, section 5.4).

    The action is not known when the encoder acts, so it is joined to the latent at the decoder's input, as
    a one-hot vector (the thesis' code appends its number). The gradient flows into the decoder and, through
    z_t, into the encoder.
    """
    decoder = context.make_decoder(context.num_actions)

    def picture(head, latents: Latents, window: Window):
        action = jax.nn.one_hot(window.actions[:, 0], context.num_actions, dtype=jnp.float32)
        inputs = jnp.concatenate([latents.online(0), action], -1)
        return image(window, 1), decoder.apply(head, inputs)

    def loss(head, slow_head, latents: Latents, window: Window, key):
        target, output = picture(head, latents, window)
        return window.valid[:, 0] * jax.vmap(mean_squared_error)(output, target), {}

    return Objective(decoder.init, loss, weight, horizon=1, is_decoder=True, image=picture)
