"""Reconstruction of the observation from its latent: the thesis' deterministic autoencoder."""

import jax
import jax.numpy as jnp

from srl_jax.objectives.networks import mean_squared_error, unit
from srl_jax.specs import check_size, needs
from srl_jax.types import Array, Context, Latents, Objective, Params, Window
from srl_jax.window import image, to_unit

POWER_ITERATIONS = 5
"""Of `largest_singular_value`."""


def weighted_squared_error(output: Array, target: Array, weights: Array) -> jax.Array:
    """The squared error of an image, averaged with weights: float32 [H, W, C] each -> float32 []."""
    return jnp.sum(weights * (output - target) ** 2) / jnp.sum(weights)


def change_weights(before: Array, now: Array, moving: float) -> jax.Array:
    """Weights of pixels, 1 where nothing moved and `1 + moving` where something did: [H, W, C] -> [H, W, C].

    Something moved where a pixel of the two images differs by two of 255 levels of brightness or more, also
    where an intensity view has scaled both.
    """
    return 1.0 + moving * (jnp.abs(now - before) > 1.5 / 255).astype(jnp.float32)


def patch_mask(key: Array, height: int, width: int, share: float, side: int) -> jax.Array:
    """1 where an image is kept and 0 in patches that are hidden: float32 [H, W, 1].

    The image is cut into squares of `side` pixels, each of which is hidden with probability `share`.
    """
    side = min(side, max(height, width))
    kept = jax.random.uniform(key, (-(-height // side), -(-width // side)), jnp.float32) >= share
    return jnp.repeat(jnp.repeat(kept, side, 0), side, 1)[:height, :width, None].astype(jnp.float32)


def corrupted(window: Window, key: Array, noise: float, masked: float, side: int) -> Window:
    """The window with noisy pixels and hidden patches, frames float32; each row has a draw of its own.

    Args:
        window: what is corrupted.
        key: a jax key.
        noise: standard deviation of normal noise, in units of full brightness.
        masked, side: see `patch_mask`; the same patches are hidden in all frames of a row, and are black.
    """
    frames = to_unit(window.frames)
    first, second = jax.random.split(key)
    if noise:
        frames = jnp.clip(frames + noise * jax.random.normal(first, frames.shape, jnp.float32), 0.0, 1.0)
    if masked:
        rows, _, height, width, _ = frames.shape
        mask = jax.vmap(lambda k: patch_mask(k, height, width, masked, side))
        frames = frames * mask(jax.random.split(second, rows))[:, None]
    return window._replace(frames=frames)


def largest_singular_value(matrix: Array) -> jax.Array:
    """The spectral norm of a matrix by a few power iterations: float32 [n, m] -> float32 [].

    They begin with the same random vector every time. What they give is never too large; for a matrix of
    normal numbers it is about a twentieth too small, at worst a seventh. The gradient is that of
    `u^T W v` with u and v constant, which is exact where they have converged (Miyato et al. 2018, equations
    10 to 12).
    """
    constant = jax.lax.stop_gradient(matrix)
    v = jax.random.normal(jax.random.key(0), (matrix.shape[1],), jnp.float32)
    u = jnp.zeros(matrix.shape[0], jnp.float32)
    for _ in range(POWER_ITERATIONS):
        u = unit(constant @ v)
        v = unit(constant.T @ u)
    return u @ matrix @ v


def spectrally_normalised(params: Params) -> Params:
    """A network's parameters, each kernel divided by its largest singular value; biases as they are.

    A kernel is what has two dimensions or more; all but the last are the rows of its matrix (Miyato et al.
    2018, section 2.1).
    """

    def normalised(x: Array) -> Array:
        if x.ndim < 2:
            return x
        return x / jnp.maximum(largest_singular_value(x.reshape(-1, x.shape[-1])), 1e-12)

    return jax.tree.map(normalised, params)


@needs(patch="masked!=0", moving="frame_stack!=1")
def reconstruction(
    context: Context,
    *,
    weight: float = 1.0,
    moving: float = 0.0,
    noise: float = 0.0,
    masked: float = 0.0,
    patch: int = 12,
    gradient_penalty: float = 0.0,
    spectral_norm: bool = False,
    tied: bool = False,
) -> Objective:
    """Decodes z_t into s_t, by mean squared error on pixels in [0, 1] (thesis, sections 3.1 and 5.4).

    The gradient flows into the decoder and, through z_t, into the encoder.

    Args:
        moving: how much more pixels count that differ between a frame and the one before it, which keeps a
            small ball from being lost among what stands still; 0 for the thesis' plain mean.
        noise, masked, patch: a denoising autoencoder (Vincent et al. 2008; thesis, section 3.1.3): z_t comes
            from a corrupted observation, see `corrupted`, and the target is the clean one.
        gradient_penalty: the factor of `|d D(z) / d z|^2` per pixel, which smooths the decoder D (Ghosh et
            al. 2020, section 3.1), estimated with one random direction of the pixels.
        spectral_norm: whether the decoder computes with `spectrally_normalised` parameters, which bounds how
            much it stretches latents (Ghosh et al. 2020, section 3.1). `decoder_scale` of the encoder then
            has no effect, and sizes have to come from biases and from the number of kernels.
        tied: whether the decoder's convolutions have the transposes of the encoder's kernels and biases of
            their own (Vincent et al. 2010, section 2.1, W' = W^T; thesis, section 3.1.3). The gradient flows
            into these kernels through both uses, where the mode and the gate let it into the encoder.
            `decoder_scale` then has no effect, and decoder weight decay is of the rest of the decoder.

    Raises:
        ValueError: where the encoder has no decoder, or with `tied` none whose convolutions mirror its own.
    """
    if not 0 <= masked < 1:
        raise ValueError("masked must be at least 0 and below 1")
    for name, value in (("moving", moving), ("noise", noise), ("gradient_penalty", gradient_penalty)):
        if value < 0:
            raise ValueError(f"{name} must be at least 0")
    check_size("patch", patch)
    if tied and context.make_tied_decoder is None:
        raise ValueError(
            "tied=true needs an encoder of plain convolutions, whose decoder mirrors each of them; give one, "
            "say nature, or tied=false"
        )
    decoder = context.make_tied_decoder() if tied and context.make_tied_decoder else context.make_decoder()

    def decode(head: Params, z: Array) -> jax.Array:
        return decoder.apply(spectrally_normalised(head) if spectral_norm else head, z)

    def picture(head, latents: Latents, window: Window):
        return image(window, 0), decode(head, latents.online(0))

    def loss(head, slow_head, latents: Latents, window: Window, key):
        draws = jax.random.split(key)
        seen = latents
        if noise or masked:
            seen = latents.of(corrupted(window, draws[0], noise, masked, patch))
        target, output = picture(head, seen, window)
        if moving:
            weights = change_weights(shifted_stack(target, window), target, moving)
            losses = jax.vmap(weighted_squared_error)(output, target, weights)
        else:
            losses = jax.vmap(mean_squared_error)(output, target)
        if gradient_penalty:
            direction = jax.random.normal(draws[1], target.shape, jnp.float32)
            _, pull = jax.vjp(lambda z: decode(head, z), seen.online(0))
            (slope,) = pull(direction)
            losses += gradient_penalty * jnp.sum(slope**2, -1) / target[0].size
        return losses, {}

    return Objective(decoder.init, loss, weight, is_decoder=True, image=picture, reads=decoder.reads)


def shifted_stack(observation: Array, window: Window) -> jax.Array:
    """[B, H, W, S * C] with each frame replaced by the one before it, and the oldest by itself."""
    channels = window.frames.shape[-1]
    return jnp.concatenate([observation[..., :channels], observation[..., :-channels]], -1)
