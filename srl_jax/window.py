"""Views of a `Window` on the device: the stacked observation at an offset; what an observation has to be."""

import jax
import jax.numpy as jnp
import numpy as np

from srl_jax.types import Array, Window


def observation(window: Window, k: int | Array) -> jax.Array:
    """The stack of frames s_{t+k}, newest last: uint8 [B, H, W, S * C].

    Args:
        window: its frames are [B, S + K, H, W, C].
        k: an offset in 0..K, an int for all rows or int32 [B], one for each.

    Raises:
        ValueError: an int is no offset of the window.
    """
    horizon = window.actions.shape[1]
    size = window.frames.shape[1] - horizon
    if isinstance(k, int):
        if not 0 <= k <= horizon:
            raise ValueError(f"offset {k} is not in 0..{horizon}, where {horizon} is the horizon")
        frames = window.frames[:, k : k + size]
    else:
        take = lambda row, start: jax.lax.dynamic_slice_in_dim(row, start, size)  # noqa: E731
        frames = jax.vmap(take)(window.frames, k)
    return stack_last(frames)


def only(window: Window, k: int) -> Window:
    """The window of s_{t+k} alone, which is its offset 0: the frames of one observation, and no horizon."""
    size = window.frames.shape[1] - window.actions.shape[1]
    ahead = {name: getattr(window, name)[:, :0] for name in ("actions", "rewards", "discounts", "valid")}
    return window._replace(frames=window.frames[:, k : k + size], **ahead)


def image(window: Window, k: int) -> Array:
    """The observation at offset k as a regression target: float32 [B, H, W, S * C] in [0, 1]."""
    return to_unit(observation(window, k))


def to_unit(pixels: Array) -> Array:
    """uint8 0..255 -> float32 in [0, 1]; float32 passes as it is.

    Raises:
        ValueError: another dtype: nobody knows what its numbers mean.
    """
    if pixels.dtype not in (jnp.uint8, jnp.float32):
        raise ValueError(f"observations must be uint8, or float32 in [0, 1], not {pixels.dtype}")
    return pixels.astype(jnp.float32) / 255.0 if pixels.dtype == jnp.uint8 else pixels


def check_observations(observations: Array, shape: tuple[int, ...], *, ahead: str = "...") -> None:
    """Whether these are observations; of values only where there are some, and not while jax traces.

    Args:
        observations: uint8, or float32 in [0, 1], [..., H, W, S * C].
        shape: (H, W, S * C).
        ahead: the axes in front, "B" for one and "..." for any.

    Raises:
        ValueError: they are not; a line with what they are.
    """
    axes = observations.ndim if ahead == "..." else len(shape) + 1
    if (observations.ndim, *observations.shape[-3:]) != (axes, *shape) or observations.dtype not in (
        np.uint8,
        np.float32,
    ):
        raise ValueError(
            f"observations must be uint8, or float32 in [0, 1], [{ahead}, {', '.join(map(str, shape))}], not "
            f"{observations.dtype} {list(observations.shape)}"
        )
    traced = isinstance(observations, jax.core.Tracer)
    if not traced and observations.dtype == np.float32 and observations.size:
        low, high = float(observations.min()), float(observations.max())
        if not 0 <= low <= high <= 1:
            raise ValueError(
                f"observations of float32 must be in [0, 1], not [{low:g}, {high:g}]; give bytes as uint8"
            )


def stack_last(frames: Array) -> jax.Array:
    """[B, S, H, W, C], as replay and the actor keep it, -> [B, H, W, S * C], as networks read it."""
    batch, stack, height, width, channels = frames.shape
    planes = jnp.moveaxis(frames, -1, 2).reshape(batch, stack * channels, height, width)
    return jnp.moveaxis(planes, 1, -1)
