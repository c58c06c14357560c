"""The figures of a run, as small PNG files, and its GIFs.

matplotlib and Pillow are the extra `plots` and are imported where they are used; `available()` says
whether they can be. Figures are built as objects, without pyplot: no global state and no display.
"""

import importlib.util
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from srl_jax import envs

STEPS_LABEL = "env steps"
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7f7f7f")
"""Okabe and Ito's palette: distinguishable to colour-blind readers."""
MAX_EXAMPLES = 6
CHANNELS = (1, 3)  # of an image that can be shown: grey, or red, green and blue
NEAR = 0.02
"""Of an axis: reference policies that are as near to each other as that share a line."""


def steps_label(game: str) -> str:
    """Of an axis of env steps, which may have several frames of an emulator in one; "" is no game."""
    frames = envs.known(game).frames_per_step if game else 1
    return f"{STEPS_LABEL} ({frames} frames each)" if frames > 1 else STEPS_LABEL


def available() -> bool:
    """Whether the extra `plots` is installed: matplotlib and Pillow."""
    return all(importlib.util.find_spec(name) for name in ("matplotlib", "PIL"))


def learning_curve(
    rows: Iterable[Mapping[str, Any]],
    path: str | os.PathLike,
    title: str,
    reference: Sequence[tuple[str, Sequence[float], Sequence[float]]] | None = None,
    policies: Mapping[str, float] | None = None,
    game: str = "",
) -> Path | None:
    """Draws the mean evaluation return, and the worst to the best game, against env steps.

    Args:
        rows: of metrics.jsonl; those of kind "eval" with `eval/return_mean` count.
        path: of the PNG file.
        title: of the figure.
        reference: other curves, (label, env steps, mean returns) each, drawn dashed and only as far
            as the run goes: curves are compared at equal steps.
        policies: see `levels`.
        game: the run's, for what an env step is.

    Returns:
        The path, or None if there is no evaluation to draw (then nothing is written).
    """
    evals = [row for row in rows if row["kind"] == "eval" and "eval/return_mean" in row]
    if not evals:
        return None
    steps = np.array([row["env_steps"] for row in evals], float)
    means = np.array([row["eval/return_mean"] for row in evals], float)
    games = [np.array(row.get("eval/returns") or [np.nan], float) for row in evals]
    counts = sorted({len(game) for game in games if np.isfinite(game).all()})

    figure = new_figure(6.4, 4.0)
    axes = figure.add_subplot(xlabel=steps_label(game))
    axes.set_title(title, parse_math=False)
    over = f" over {' or '.join(map(str, counts))} games" if counts else ""
    axes.set_ylabel("mean return" + over)
    line = {"marker": "o", "markersize": 3.5} if len(evals) <= 60 else {}
    if counts:
        axes.fill_between(
            steps,
            [game.min() for game in games],
            [game.max() for game in games],
            color=COLOURS[0],
            alpha=0.15,
            linewidth=0,
            label="worst to best game",
        )
    axes.plot(steps, means, color=COLOURS[0], linewidth=1.8, label="this run", **line)
    end = steps.max()
    for i, (label, theirs, returns) in enumerate(reference or ()):
        theirs, returns = np.asarray(theirs, float), np.asarray(returns, float)
        # The run's last step may cut the curve between two of its points.
        at = np.unique(np.minimum(theirs, end))
        colour = COLOURS[1 + i % (len(COLOURS) - 1)]
        axes.plot(at, np.interp(at, theirs, returns), "--", color=colour, linewidth=1.4, label=label)
    count_axis(axes)
    if end == 0:  # evaluated before training only: keep the axis from counting in thousandths
        axes.set_xlim(-1, 1)
    levels(axes, policies or {})
    axes.legend(loc="best", fontsize=8, framealpha=0.8)
    return save(figure, path)


def losses(rows: Iterable[Mapping[str, Any]], path: str | os.PathLike, game: str = "") -> Path | None:
    """Draws every `loss/NAME` of the train rows in a panel of its own, and the gradient norm.

    The vertical axis is logarithmic where all values are positive and span a factor of 5 or more.
    Where there are many rows, a running mean lies over the pale single values.

    Returns:
        The path, or None if there is nothing to draw (then nothing is written).
    """
    train = [row for row in rows if row["kind"] == "train"]
    keys = sorted({key for row in train for key in row if key.startswith("loss/")})
    keys += sorted({key for row in train for key in row if key.split("/")[0] == "grad_norm"})
    curves = []
    for key in keys:
        at = np.array([row["env_steps"] for row in train if row.get(key) is not None], float)
        values = np.array([row[key] for row in train if row.get(key) is not None], float)
        if len(at):
            curves.append((key, at, values))
    if not curves:
        return None
    columns = min(len(curves), 3 if len(curves) != 4 else 2)
    lines = -(-len(curves) // columns)
    figure = new_figure(3.2 * columns + 0.4, 2.3 * lines + 0.3)
    for i, (key, at, values) in enumerate(curves):
        axes = figure.add_subplot(lines, columns, i + 1)
        span = len(at) // 25
        axes.plot(
            at,
            values,
            color=COLOURS[0],
            linewidth=0.8 if span > 1 else 1.2,
            alpha=0.35 if span > 1 else 1.0,
            marker="." if len(at) < 10 else "",
        )
        if span > 1:
            kernel = np.full(span, 1 / span)
            smooth = [np.convolve(curve, kernel, mode="valid") for curve in (at, values)]
            axes.plot(*smooth, color=COLOURS[0], linewidth=1.4)
        name = key.replace("grad_norm", "gradient norm").replace("norm/", "norm, ")
        axes.set_title(name, fontsize=9, parse_math=False)
        if values.min() > 0 and values.max() >= 5 * values.min():
            log_axis(axes, values.max() / values.min())
        count_axis(axes)
        axes.tick_params(labelsize=7)
        if i + columns >= len(curves):
            axes.set_xlabel(steps_label(game), fontsize=8)
    return save(figure, path)


def image_panel(
    inputs: np.ndarray,
    targets: np.ndarray,
    outputs: np.ndarray,
    path: str | os.PathLike,
    title: str,
) -> Path:
    """Draws examples in rows: input, target, output, and how far the output is from the target.

    Three channels are shown in colour; the difference is then the largest of the three.

    Args:
        inputs: float [B, H, W, C] in [0, 1], C of 1 or 3; the newest frame that the encoder saw. The first 6
            examples are drawn.
        targets: likewise; what the output should be.
        outputs: likewise; may leave [0, 1], which is shown clipped; the difference is not clipped.
        path: of the PNG file.
        title: of the figure.

    Returns:
        The path.

    Raises:
        ValueError: if the shapes differ or the images are not float.
    """
    given = [np.asarray(images) for images in (inputs, targets, outputs)]
    alike = len({images.shape for images in given}) == 1
    if not alike or given[0].ndim != 4 or given[0].shape[3] not in CHANNELS or not given[0].size:
        shapes = ", ".join(str(images.shape) for images in given)
        raise ValueError(f"images must be [B, H, W, 1] or [B, H, W, 3], all of one shape; got {shapes}")
    if not all(np.issubdtype(images.dtype, np.floating) for images in given):
        raise ValueError("images must be float in [0, 1]")
    shown = [images[:MAX_EXAMPLES].astype(np.float32) for images in given]
    difference = np.abs(shown[2] - shown[1]).max(-1, keepdims=True)
    top = float(difference.max()) or 1.0

    count = len(difference)
    figure = new_figure(1.15 * 4 + 0.9, 1.15 * count + 0.75)
    axes = figure.subplots(count, 4, squeeze=False)
    names = ("input", "target", "output", "|output - target|")
    for column, (name, images) in enumerate(zip(names, [*shown, difference], strict=True)):
        last = column == 3
        for i, image in enumerate(images):
            drawn = axes[i, column].imshow(
                image[..., 0] if image.shape[-1] == 1 else image.clip(0, 1),
                cmap="inferno" if last else "gray",
                vmin=0,
                vmax=top if last else 1,
            )
            axes[i, column].set_axis_off()
        axes[0, column].set_title(name, fontsize=9)
    bar = figure.colorbar(drawn, ax=axes, fraction=0.04, pad=0.02, aspect=12 * count)
    bar.set_label("absolute difference", fontsize=8)
    bar.ax.tick_params(labelsize=7)
    figure.suptitle(title, fontsize=10).set_parse_math(False)
    return save(figure, path)


def gif(frames: np.ndarray, path: str | os.PathLike, fps: float = 15, scale: int = 3) -> Path:
    """Writes frames as a GIF that repeats for ever.

    Args:
        frames: uint8 [T, H, W, C], C of 1 (grey) or 3 (RGB), T at least 1.
        path: of the file.
        fps: frames a second; a GIF counts in hundredths of a second, and is rounded to them.
        scale: every pixel becomes a square of this many pixels a side.

    Returns:
        The path.

    Raises:
        ValueError: for another shape or dtype.
    """
    from PIL import Image

    frames = np.asarray(frames)
    if frames.dtype != np.uint8 or frames.ndim != 4 or frames.shape[3] not in CHANNELS:
        got = f"{frames.dtype} {frames.shape}"
        raise ValueError(f"frames must be uint8 [T, H, W, 1] or [T, H, W, 3]; got {got}")
    if not len(frames):
        raise ValueError("a GIF needs at least one frame")
    images = [
        Image.fromarray(frame[..., 0] if frame.shape[-1] == 1 else frame).resize(
            (frame.shape[1] * scale, frame.shape[0] * scale), Image.Resampling.NEAREST
        )
        for frame in frames
    ]
    path = _folder(path)
    hundredths = max(round(100 / fps), 2)  # browsers slow down a GIF with shorter frames
    images[0].save(
        path,
        format="GIF",
        save_all=True,
        append_images=images[1:],
        duration=hundredths * 10,
        loop=0,
    )
    return path


def new_figure(width: float, height: float):
    """An empty figure of that size in inches, laid out tightly."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def heights(lines: Any, bands: Any = ()) -> tuple[float, float]:
    """Limits of a vertical axis that show all of the lines, and of bands what does not make the lines flat.

    The t interval of two runs is nine standard deviations wide to either side; what is further from the lines
    than they are high, all together, is cut off.

    Args:
        lines: values [N], some of them finite.
        bands: limits of intervals [M]; those that are not finite do not count.
    """
    lines, bands = (np.asarray(values, float) for values in (lines, bands))
    low, high = np.nanmin(lines), np.nanmax(lines)
    room = high - low or 0.5
    shown = np.clip(np.append(bands[np.isfinite(bands)], [low, high]), low - room, high + room)
    edge = 0.05 * np.ptp(shown) or room
    return float(shown.min() - edge), float(shown.max() + edge)


def count_axis(axes) -> None:
    """Env steps as 200k or 1.5M, a light grid, no box."""
    from matplotlib.ticker import EngFormatter, MaxNLocator

    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.xaxis.set_major_locator(MaxNLocator(6, integer=True))
    plain(axes)


def plain(axes) -> None:
    """A light grid, no box."""
    axes.grid(alpha=0.25, linewidth=0.6)
    axes.spines[["top", "right"]].set_visible(False)


def levels(axes, policies: Mapping[str, float], others: Sequence[tuple[str, float]] = ()) -> None:
    """Draws horizontal lines, their names side by side along them, so that near ones can be told apart.

    Args:
        axes: with everything else in it.
        policies: name -> mean return of policies that learn nothing, dash-dotted.
        others: (name, height), dotted.
    """
    from matplotlib.patheffects import Normal, Stroke

    lines = [(name, height, {"linestyle": ":", "linewidth": 1}) for name, height in others]
    heights = [*axes.get_ylim(), *policies.values(), *(height for _, height in others)]
    thin = {"linestyle": "-.", "linewidth": 0.8}
    if len(policies) > 1 and np.ptp(list(policies.values())) <= NEAR * np.ptp(heights):
        lines.append((", ".join(policies), float(np.mean(list(policies.values()))), thin))
    else:
        lines += [(f"{name} policy", height, thin) for name, height in policies.items()]
    for i, (name, height, form) in enumerate(lines):
        axes.axhline(height, color="#888888", **form)
        text = axes.annotate(
            name,
            ((i + 1) / len(lines) - 0.01, height),  # the last one at the right, where curves have left it
            xycoords=axes.get_yaxis_transform(),
            horizontalalignment="right",
            path_effects=[Stroke(linewidth=1.5, foreground="white"), Normal()],
            xytext=(0, 1.5),
            textcoords="offset points",
            fontsize=6.5,
            color="#555555",
            parse_math=False,
        )
        text.set_in_layout(False)


def log_axis(axes, span: float) -> None:
    """A logarithmic axis of values; the largest is `span` times the smallest."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axes.set_yscale("log")
    if span < 100:  # too narrow for powers of ten alone to say much
        axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.yaxis.set_minor_formatter(NullFormatter())


def _folder(path: str | os.PathLike) -> Path:
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def save(figure, path: str | os.PathLike) -> Path:
    """Writes a figure as a small PNG file, making its directory where there is none; returns the path."""
    from PIL import Image

    path = _folder(path)
    # A palette makes the file a third as large, and nobody sees the difference.
    figure.canvas.draw()
    image = Image.fromarray(np.asarray(figure.canvas.buffer_rgba())).convert("RGB")
    image.quantize(256).save(path, format="PNG", optimize=True)
    return path
