"""A variational autoencoder whose mean is the latent that reinforcement learning sees."""

import jax
import jax.numpy as jnp

from srl_jax.layers import Dense
from srl_jax.objectives.networks import functions, mean_squared_error
from srl_jax.types import Array, Context, Latents, Objective, Params, Window
from srl_jax.window import image


def gaussian_divergence(mean: Array, log_variance: Array) -> jax.Array:
    """KL(N(mean, exp(log_variance)) || N(0, 1)): float32 [D], [D] -> float32 [], in nats; a sum over D."""
    return 0.5 * jnp.sum(mean**2 + jnp.exp(log_variance) - 1 - log_variance)


def vae(context: Context, *, weight: float = 1.0, beta: float = 1.0) -> Objective:
    """Reconstruction from a noisy latent, and its divergence from a normal (Kingma and Welling 2014, eq. 7).

    z_t is the mean of the latent's distribution; a linear layer on it gives the logarithm of its variance.
    The loss is the mean squared error of a pixel plus `beta / pixels` times the divergence: at beta = 1 it is
    the evidence bound of pixels with variance 1/2, divided by their number (thesis, section 3.1.3.2; Higgins
    et al. 2017 for other betas). The gradient flows into the decoder, the variance's layer and, through z_t,
    into the encoder. An encoder that ends in tanh cannot move means beyond 1.
    """
    decoder = context.make_decoder()
    init_variance, log_variance_of = functions(Dense(context.features), context.features)

    def init(key: jax.Array) -> Params:
        first, second = jax.random.split(key)
        return {"decoder": decoder.init(first), "log_variance": init_variance(second)}

    def picture(head: Params, latents: Latents, window: Window):
        return image(window, 0), decoder.apply(head["decoder"], latents.online(0))

    def loss(head: Params, slow_head: Params, latents: Latents, window: Window, key: jax.Array):
        mean = latents.online(0)
        log_variance = jnp.clip(log_variance_of(head["log_variance"], mean), -10.0, 10.0)
        noise = jax.random.normal(key, mean.shape, jnp.float32)
        output = decoder.apply(head["decoder"], mean + jnp.exp(0.5 * log_variance) * noise)
        target = image(window, 0)
        divergence = jax.vmap(gaussian_divergence)(mean, log_variance)
        error = jax.vmap(mean_squared_error)(output, target)
        pixels = target[0].size
        metrics = {"divergence": jnp.mean(divergence), "squared_error": jnp.mean(error)}
        return error + beta / pixels * divergence, jax.lax.stop_gradient(metrics)

    return Objective(init, loss, weight, is_decoder=True, image=picture)
