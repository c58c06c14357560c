"""Reconstruction of the observation from its latent: the thesis' deterministic autoencoder."""

import jax
import jax.numpy as jnp

from srl_jax.types import Array, Context, Latents, Objective, Window
from srl_jax.window import image


def mean_squared_error(output: Array, target: Array) -> jax.Array:
    """The squared error of an image, averaged over all its pixels and channels.

    Args:
        output, target: float32 [H, W, S * C], in units of full brightness; a target is in [0, 1].

    Returns:
        float32 []. A mean, not a sum: at 84 x 84 x 4 the two differ by a factor of 28,224.
    """
    return jnp.mean((output - target) ** 2)


def reconstruction(context: Context, *, weight: float = 1.0) -> Objective:
    """Decodes z_t into s_t, by mean squared error on pixels in [0, 1] (thesis, sections 3.1 and 5.4).

    The gradient flows into the decoder and, through z_t, into the encoder.
    """
    decoder = context.make_decoder()

    def picture(head, latents: Latents, window: Window):
        return image(window, 0), decoder.apply(head, latents.online(0))

    def loss(head, slow_head, latents: Latents, window: Window, key):
        target, output = picture(head, latents, window)
        return jax.vmap(mean_squared_error)(output, target), {}

    return Objective(decoder.init, loss, weight, is_decoder=True, image=picture)
