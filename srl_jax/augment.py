"""Data augmentation: random views of a sequence of frames, and of a window."""

from collections.abc import Callable

import jax
import jax.numpy as jnp

from srl_jax.specs import check_choice
from srl_jax.types import Array, Window
from srl_jax.window import to_unit


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


def intensity(frames: Array, key: Array, scale: float = 0.05) -> Array:
    """Multiplies a sequence of frames by `1 + scale e`, e normal within two deviations.

    Schwarzer et al. (2021), appendix; one draw for the whole sequence.

    Args:
        frames: uint8 [T, H, W, C], or float32 in [0, 1].
        key: a jax key.
        scale: the deviation of the factor.

    Returns:
        float32, the same shape; bright pixels may be a little above 1.
    """
    factor = 1.0 + scale * jnp.clip(jax.random.normal(key, (), jnp.float32), -2.0, 2.0)
    return to_unit(frames) * factor


def crop_pad_crop(frames: Array, key: Array, cut: int = 4, pad: int = 4) -> Array:
    """A random crop, padded by repeating its border, and cropped to the old size.

    CURL's code for Atari (Laskin et al. 2020). At 84 pixels: 80 x 80 from anywhere, 4 pixels around it, 84 x
    84 of that. One draw for the sequence.

    Args:
        frames: any dtype, [T, H, W, C].
        key: a jax key.
        cut: by how many pixels the first crop is smaller, of each side.
        pad: the border, in pixels; at least half of `cut`.

    Returns:
        The same shape and dtype.
    """
    first, second = jax.random.split(key)
    corner = jax.random.randint(first, (2,), 0, cut + 1)
    moved = jax.random.randint(second, (2,), 0, 2 * pad - cut + 1)
    for axis, (start, move) in enumerate(zip(corner, moved, strict=True)):
        side = frames.shape[1 + axis]
        places = start + jnp.clip(jnp.arange(side) + move - pad, 0, side - cut - 1)
        frames = jnp.take(frames, places, axis=1 + axis)
    return frames


VIEWS: dict[str, Callable[[Array, Array], Array]] = {
    "shift": random_shift,
    "intensity": intensity,
    "crop_pad_crop": crop_pad_crop,
}
"""{name: (frames [T, H, W, C], key) -> frames}: the parts of a view, as in `shift+intensity`."""


def make_view(parts: str) -> Callable[[Window, Array], Window]:
    """view: (window, key) -> the window with new frames, pure; each row has a draw of its own.

    Args:
        parts: keys of `VIEWS` with + between them, applied from left to right; "none" for the window itself.

    Raises:
        ValueError: there is no such part.
    """
    names = [] if parts == "none" else parts.split("+")
    for name in names:
        check_choice("view", name, [*VIEWS, "none"])

    def view(window: Window, key: Array) -> Window:
        frames = window.frames
        for i, name in enumerate(names):
            keys = jax.random.split(jax.random.fold_in(key, i), frames.shape[0])
            frames = jax.vmap(VIEWS[name])(frames, keys)
        return window._replace(frames=frames)

    return view
