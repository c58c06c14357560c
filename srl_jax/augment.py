"""Data augmentation: random views of a sequence of frames, and of a window; who sees which."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp

from srl_jax import plugins
from srl_jax.config import Config
from srl_jax.errors import ConfigError
from srl_jax.learning import modes
from srl_jax.plugins import Registry
from srl_jax.specs import choices_text, split
from srl_jax.types import Array, Window
from srl_jax.window import observation, to_unit


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

    Raises:
        ValueError: the first crop would have no two pixels a side, and every image one colour.
    """
    if (least := min(frames.shape[1:3])) < cut + 2:
        raise ValueError(f"crop_pad_crop cuts {cut} pixels off each side, and the frames have {least}")
    first, second = jax.random.split(key)
    corner = jax.random.randint(first, (2,), 0, cut + 1)
    moved = jax.random.randint(second, (2,), 0, 2 * pad - cut + 1)
    for axis, (start, move) in enumerate(zip(corner, moved, strict=True)):
        side = frames.shape[1 + axis]
        places = start + jnp.clip(jnp.arange(side) + move - pad, 0, side - cut - 1)
        frames = jnp.take(frames, places, axis=1 + axis)
    return frames


VIEWS = Registry(
    "augment",
    {"shift": random_shift, "intensity": intensity, "crop_pad_crop": crop_pad_crop},
    reserved=("none", "same"),
)
"""{name: (frames [T, H, W, C], key) -> frames}: the parts of a view, as in `shift+intensity`.

Frames are uint8, or float32 in [0, 1] behind a part that makes them so, and stay one of the two; their shape
stays what it was. `check_views` asks for that.
"""
register = VIEWS.register

EACH = "@each"
"""Ends a view in which every observation has a draw of its own."""


def _make_row_view(parts: str) -> Callable[[Array, Array], Array]:
    """view: (frames [T, H, W, C], key) -> frames, of one row; `parts` as of `make_view`."""
    names = [] if parts == "none" else parts.split("+")
    for name in names:
        if name.endswith(EACH):
            raise ValueError(
                f"{EACH} ends a view, and --rl_view, --srl_view and --target_view alone take it; give "
                f"{parts.replace(EACH, '')}"
            )
        if name not in VIEWS:
            raise ValueError(f"no view {name!r}; {choices_text(name, [*VIEWS, 'none'])}, or several with +")

    def view(frames: Array, key: Array) -> Array:
        for i, name in enumerate(names):
            frames = VIEWS[name](frames, jax.random.fold_in(key, i) if i else key)
        return frames

    return view


def make_view(parts: str) -> Callable[[Window, Array], Window]:
    """view: (window, key) -> the window with new frames, pure; each row has a draw of its own.

    Args:
        parts: keys of `VIEWS` with + between them, applied from left to right; "none" for the window itself.

    Raises:
        ValueError: there is no such part.
    """
    row = _make_row_view(parts)

    def view(window: Window, key: Array) -> Window:
        if parts == "none":
            return window
        keys = jax.random.split(key, window.frames.shape[0])
        return window._replace(frames=jax.vmap(row)(window.frames, keys))

    return view


class Seen(NamedTuple):
    """A view of a window that has been drawn.

    Attributes:
        window: what an objective is handed.
        observe: (window, offset) -> the observations that are encoded, [B, H, W, S * C].
    """

    window: Window
    observe: Callable[[Window, int | Array], jax.Array] = observation


def make_seen(text: str) -> Callable[[Window, Array], Seen]:
    """see: (window, key) -> Seen, pure.

    Args:
        text: `PARTS` for one draw a sequence, of a row's whole window, which the objective is handed as well
            (an image that it predicts is a view, too); or `PARTS@each` for a draw for each observation that
            is encoded, s_t and s_{t+n}, while the objective is handed the window as it was. An observation
            has the same draw however often it is asked for.

    Raises:
        ValueError: there is no such part.
    """
    if not text.endswith(EACH):
        view = make_view(text)
        return lambda window, key: Seen(view(window, key))
    row = _make_row_view(text.removesuffix(EACH))

    def see(window: Window, key: Array) -> Seen:
        def observe(window: Window, k: int | Array) -> jax.Array:
            stacks = observation(window, k)
            keys = jax.random.split(key, len(stacks))
            keys = jax.vmap(jax.random.fold_in)(keys, jnp.broadcast_to(jnp.asarray(k), len(stacks)))
            return jax.vmap(lambda stack, key: row(stack[None], key)[0])(stacks, keys)

        return Seen(window, observe)

    return see


class Views(NamedTuple):
    """What each loss sees, as texts of `make_seen`.

    Where RL and the objectives see the same text, they see the same draw; otherwise draws of their own.

    Attributes:
        rl: what RL sees.
        srl: what the representation objectives see.
        target: under the slow encoders, or the online one where it stands for them (`target=stopped`), and
            what RL sees of s_{t+n}: "same" for the view of the loss itself, by the same draw, or a view with
            a draw of its own that all losses share.
    """

    rl: str = "none"
    srl: str = "none"
    target: str = "same"

    @classmethod
    def of(cls, config: Config) -> "Views":
        """The views of a run: see `modes.views`.

        Raises:
            ConfigError: there is no such view; one line that names the flag.
        """
        for flag in ("rl_view", "srl_view", "target_view"):
            text = getattr(config, flag)
            try:
                if text and (flag, text) != ("target_view", "same"):
                    make_seen(text)
            except ValueError as error:
                raise ConfigError(f"--{flag}={text}: {error}") from None
        return cls(*modes.views(config), config.target_view or "same")


UNCHANGED = Views()
"""Every loss sees the window as replay has it."""


def check_views(config: Config, size: int) -> None:
    """Whether all views of a run can be drawn of its frames, and give what `VIEWS` says.

    Args:
        config: with every option of its specs.
        size: height and width of a frame; its channels are 1 or 3, whichever a view takes.

    Raises:
        ConfigError: there is no such view, or it does not; one line that names the flag.
    """
    texts = {f"{flag}_view": text for flag, text in Views.of(config)._asdict().items()}
    for flag, specs_of in {"rl": [config.rl], "objective": config.objectives}.items():
        for text in specs_of:
            name, options = split(text)
            texts[f"{flag}={name}:view"] = str(options.get("view", "none"))
    for flag, text in texts.items():
        if text in ("none", "same"):
            continue
        for part in text.removesuffix(EACH).split("+"):
            problems = [_problem(VIEWS[part], size, channels) for channels in (1, 3)]
            if all(problems):
                raise ConfigError(f"--{flag}={text}: {problems[0]}")


def _problem(view: Callable[[Array, Array], Array], size: int, channels: int) -> str:
    """What is wrong with a part of a view, or ""."""
    key, foreign = jax.random.key(0), plugins.foreign(view)
    white = jnp.full((2, size, size, channels), 255, jnp.uint8)
    try:
        # To run it takes longer than to look at its shapes, and those of the package give what they should.
        seen = view(white, key) if foreign else jax.eval_shape(view, white, key)
        shape, dtype = seen.shape, seen.dtype
    except Exception as error:
        return plugins.reason(error, Path(plugins.origin(view))) if foreign else str(error)
    if shape != white.shape or dtype not in (jnp.uint8, jnp.float32):
        wanted = f"uint8 or float32 of shape {list(white.shape)}"
        return f"gives {dtype} of shape {list(shape)}; it must give {wanted}"
    most = float(jnp.max(jnp.abs(seen))) if foreign and dtype == jnp.float32 else 0.0
    return "" if most <= 2.0 else f"makes {most:g} of a white pixel; float32 must be in [0, 1], or nearly so"
