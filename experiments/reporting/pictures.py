"""Pictures as data URIs: drawn here, or taken from the runs and made smaller where need be."""

import base64
import io
import struct
import tempfile
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from srl_jax import statistics
from srl_jax.errors import ConfigError
from srl_jax.reading import read_bytes

from .. import plots
from ..colours import Style

LARGEST = 1 << 24
"""Bytes that a picture on disk may have."""
ARMS_A_PICTURE = 6
"""Lines of arms that can be told apart in one picture of learning curves."""


class Picture(NamedTuple):
    """A picture within a page.

    Attributes:
        source: a data URI.
        size: width and height in pixels.
        bytes: of the file.
    """

    source: str
    size: tuple[int, int]
    bytes: int


class Curve(NamedTuple):
    """One line of a small picture: float64 [points] each; low and high are NaN where there is no interval.

    `at` is env steps, but where a picture's label says something else.
    """

    at: np.ndarray
    point: np.ndarray
    low: np.ndarray
    high: np.ndarray


def drawn(draw: Callable[[Path], object]) -> Picture | None:
    """What a function of the path of a PNG file draws; None where it writes nothing."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "picture.png"
        draw(path)
        return picture(path.read_bytes(), str(path)) if path.exists() else None


def picture(data: bytes, name: str) -> Picture:
    """A PNG, JPEG or GIF as it is.

    Raises:
        ConfigError: it is none; `name` is the file's.
    """
    kind, size = _form(data)
    if kind is None:
        raise ConfigError(f"{name}: neither a PNG nor a GIF")
    return Picture(f"data:image/{kind};base64,{base64.b64encode(data).decode()}", size, len(data))


def _form(data: bytes) -> tuple[str | None, tuple[int, int] | None]:
    if data[:8] == b"\x89PNG\r\n\x1a\n" and len(data) >= 24:
        return "png", struct.unpack(">II", data[16:24])
    if data[:6] in (b"GIF87a", b"GIF89a") and len(data) >= 10:
        return "gif", struct.unpack("<HH", data[6:10])
    return None, None


def taken(path: Path, limit: int) -> Picture | None:
    """A picture of a run, made smaller where it has more bytes than the limit; None where there is none.

    A GIF loses frames, and plays as fast as before; a PNG becomes a JPEG.

    Raises:
        ConfigError: it cannot be read, or is no picture.
    """
    try:
        data = read_bytes(path, LARGEST)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from None
    found = picture(data, str(path))
    if found.bytes <= limit:
        return found
    from PIL import Image

    try:
        with Image.open(io.BytesIO(data), formats=("PNG", "GIF")) as image:
            if image.format == "GIF":
                return picture(_smaller_gif(image, limit), str(path))
            return _as_jpeg(image, found.size)
    except (OSError, ValueError, SyntaxError, EOFError, Image.DecompressionBombError) as error:
        raise ConfigError(f"{path}: not a picture: {error}") from None


def _smaller_gif(image, limit: int) -> bytes:
    """Without what scaling up has added, then with every second frame, then without the last ones."""
    frames, durations = [], []
    for i in range(image.n_frames):
        image.seek(i)
        frames.append(np.asarray(image.convert("L")))
        durations.append(image.info.get("duration", 70))
    stack = np.stack(frames)
    while not any(n % 2 for n in stack.shape[1:]) and _doubled(stack):
        stack = stack[:, ::2, ::2]
    data = _gif(stack, durations)
    if len(data) > limit and len(stack) > 1:
        durations = [sum(durations[i : i + 2]) for i in range(0, len(stack), 2)]
        stack = stack[::2]
        data = _gif(stack, durations)
    while len(data) > limit and len(stack) > 1:
        kept = max(1, min(len(stack) - 1, int(len(stack) * limit / len(data))))
        stack, durations = stack[:kept], durations[:kept]
        data = _gif(stack, durations)
    return data


def _doubled(stack: np.ndarray) -> bool:
    half = stack[:, ::2, ::2]
    return np.array_equal(stack, half.repeat(2, axis=1).repeat(2, axis=2))


def _gif(stack: np.ndarray, durations: list[int]) -> bytes:
    from PIL import Image

    first, *others = [Image.fromarray(frame) for frame in stack]
    file = io.BytesIO()
    first.save(file, format="GIF", save_all=True, append_images=others, loop=0, duration=durations)
    return file.getvalue()


def _as_jpeg(image, size: tuple[int, int]) -> Picture:
    file = io.BytesIO()
    image.convert("RGB").save(file, format="JPEG", quality=75, optimize=True)
    data = file.getvalue()
    return Picture(f"data:image/jpeg;base64,{base64.b64encode(data).decode()}", size, len(data))


def interval_curves(runs: Sequence[tuple[np.ndarray, np.ndarray]]) -> Curve | None:
    """The mean of several runs' curves and its interval, at steps that all have; None without such.

    A run with one value is left out where others have more.
    """
    kept = [(steps, values) for steps, values in runs if len(steps)]
    kept = [run for run in kept if len(run[0]) > 1] or kept
    if not kept:
        return None
    try:
        steps, values = statistics.at_equal_steps(kept)
    except ValueError:
        return None
    return Curve(steps, *statistics.curve_interval(values)[:3])


def heights(curves: Collection[Curve], levels: Collection[float] = ()) -> tuple[float, float]:
    """Limits of a vertical axis, see `plots.heights`, that also show the levels."""
    lines = np.concatenate([*(curve.point for curve in curves), [*levels]])
    return plots.heights(lines, np.concatenate([limit for curve in curves for limit in curve[2:]]))


def curves(
    title: str,
    lines: Sequence[tuple[Style, Curve]],
    *,
    size: tuple[float, float] = (3.4, 2.3),
    label: str = "",
    across: str = plots.STEPS_LABEL,
    policies: Mapping[str, float] | None = None,
    limits: tuple[float, float] | None = None,
) -> Picture:
    """A picture of one number against another, mostly env steps; which line is whose is said beside it.

    Args:
        title: above it.
        lines: an arm's style and its curve.
        size: width and height in inches.
        label: of the vertical axis.
        across: of the horizontal axis; numbers are abbreviated where it is env steps.
        policies: of reference policies, see `plots.levels`.
        limits: of the vertical axis; None for what `heights` gives.
    """
    small = size[0] < 4

    def draw(path: Path) -> None:
        figure = plots.new_figure(*size)
        axes = figure.add_subplot()
        for (colour, line), curve in lines:
            if np.isfinite(curve.low).any():
                axes.fill_between(curve.at, curve.low, curve.high, color=colour, alpha=0.15, linewidth=0)
            width, marker = 1.5 if small else 1.8, "o" if len(curve.at) == 1 else ""
            axes.plot(curve.at, curve.point, line, color=colour, linewidth=width, marker=marker, markersize=3)
        axes.set_title(title, fontsize=9 if small else 11, parse_math=False)
        (plots.count_axis if across.startswith(plots.STEPS_LABEL) else plots.plain)(axes)
        axes.tick_params(labelsize=7 if small else 9)
        axes.set_xlabel(across, fontsize=7.5 if small else 9)
        axes.set_ylabel(label, fontsize=9)
        levels = policies or {}
        axes.set_ylim(*(limits or heights([curve for _, curve in lines], levels.values())))
        plots.levels(axes, levels)
        plots.save(figure, path)

    return drawn(draw)


def differences(
    title: str, baseline: str, panels: Mapping[str, Mapping[str, statistics.Interval]], looks: Sequence[Style]
) -> Picture:
    """A picture of how arms differ from the baseline: a point and an interval each, beside 0.

    Args:
        title: above it.
        baseline: its name.
        panels: what differs -> arm -> the difference; the same arms in each.
        looks: of the arms.
    """

    def draw(path: Path) -> None:
        arms = list(next(iter(panels.values())))
        figure = plots.new_figure(5.4, 1.1 + 0.3 * len(arms))
        figure.suptitle(title, fontsize=11).set_parse_math(False)
        grid = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
        for axes, (name, found) in zip(grid, panels.items(), strict=True):
            axes.axvline(0, color="#555555", linewidth=1)
            for i, (interval, (colour, _)) in enumerate(zip(found.values(), looks, strict=True)):
                axes.plot([interval.low, interval.high], [i, i], color=colour, linewidth=2.2)
                axes.plot([interval.point], [i], "o", color=colour, markersize=5)
            axes.set_yticks(range(len(arms)), arms, fontsize=8, parse_math=False)
            axes.set_ylim(len(arms) - 0.4, -0.6)
            axes.set_title(name, fontsize=8.5, parse_math=False)
            axes.grid(axis="x", alpha=0.25, linewidth=0.6)
            axes.spines[["top", "right", "left"]].set_visible(False)
            axes.tick_params(axis="y", length=0)
            axes.tick_params(axis="x", labelsize=8)
            axes.margins(x=0.08)
        figure.supxlabel(f"difference from {baseline}", fontsize=8).set_parse_math(False)
        plots.save(figure, path)

    return drawn(draw)
