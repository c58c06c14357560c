"""Data augmentation: randomly shifted views of a sequence of frames."""

import jax
import jax.numpy as jnp

from srl_jax.types import Array


def random_shift(frames: Array, key: Array, pad: int = 4) -> Array:
    """Shifts a sequence of frames by up to `pad` pixels each way, repeating the border.

    Pads by replication and crops back (Yarats et al. 2021, DrQ, section 4.1). One shift serves the whole
    sequence, so that what moves in it is what moved in the game.

    Args:
        frames: any dtype, [T, H, W, C], one row's frames.
        key: a jax key.
        pad: the largest shift, in pixels.

    Returns:
        The same shape and dtype.
    """
    height, width = frames.shape[1:3]
    dy, dx = jax.random.randint(key, (2,), -pad, pad + 1)
    rows = jnp.clip(jnp.arange(height) + dy, 0, height - 1)
    columns = jnp.clip(jnp.arange(width) + dx, 0, width - 1)
    return frames[:, rows][:, :, columns]
