"""Pictures of frames: what objectives make of observations, and games as GIFs.

Pillow and matplotlib are imported where they are used, see `plots.available`.
"""

import io
import os
from pathlib import Path

import numpy as np

from srl_jax.files.reading import replace_bytes

from . import plots

MAX_EXAMPLES = 6
CHANNELS = (1, 3)  # of an image that can be shown: grey, or red, green and blue


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

    Raises:
        ValueError: if the shapes differ or the images are not float.
    """
    given = [np.asarray(images) for images in (inputs, targets, outputs)]
    forms = {(images.shape, np.issubdtype(images.dtype, np.floating)) for images in given}
    shape, floating = next(iter(forms))
    if len(forms) > 1 or not floating or len(shape) != 4 or shape[3] not in CHANNELS or 0 in shape:
        got = ", ".join(f"{images.dtype} {images.shape}" for images in given)
        raise ValueError(f"images must be float [B, H, W, 1] or [B, H, W, 3], all of one shape; got {got}")
    shown = [images[:MAX_EXAMPLES].astype(np.float32) for images in given]
    shown.append(np.abs(shown[2] - shown[1]).max(-1, keepdims=True))
    top = float(shown[3].max()) or 1.0

    count = len(shown[0])
    figure = plots.new_figure(1.15 * 4 + 0.9, 1.15 * count + 0.75)
    axes = figure.subplots(count, 4, squeeze=False)
    names = ("input", "target", "output", "|output - target|")
    for column, (name, images) in enumerate(zip(names, shown, strict=True)):
        colours, most = ("inferno", top) if column == 3 else ("gray", 1)
        for cell, image in zip(axes[:, column], images, strict=True):
            pixels = image[..., 0] if image.shape[-1] == 1 else image.clip(0, 1)
            drawn = cell.imshow(pixels, cmap=colours, vmin=0, vmax=most)
            cell.set_axis_off()
        axes[0, column].set_title(name, fontsize=9)
    bar = figure.colorbar(drawn, ax=axes, fraction=0.04, pad=0.02, aspect=12 * count)
    bar.set_label("absolute difference", fontsize=8)
    bar.ax.tick_params(labelsize=7)
    plots.head(figure, title, 10)
    return plots.save(figure, path)


def gif(frames: np.ndarray, path: str | os.PathLike, scale: int = 3) -> Path:
    """Writes frames as a GIF that repeats for ever; returns the path, whose directory it makes.

    Args:
        frames: uint8 [T, H, W, C], C of 1 (grey) or 3 (RGB), T at least 1.
        path: of the file.
        scale: every pixel becomes a square of this many pixels a side.

    Raises:
        ValueError: for another shape or dtype.
    """
    from PIL import Image

    frames = np.asarray(frames)
    if frames.dtype != np.uint8 or frames.ndim != 4 or frames.shape[3] not in CHANNELS or not len(frames):
        got = f"{frames.dtype} {frames.shape}"
        raise ValueError(f"frames must be uint8 [T, H, W, 1] or [T, H, W, 3], T at least 1; got {got}")
    frames = frames.repeat(scale, axis=1).repeat(scale, axis=2)
    first, *others = [Image.fromarray(frame[..., 0] if frame.shape[-1] == 1 else frame) for frame in frames]
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    file = io.BytesIO()
    # In milliseconds, whole hundredths of a second: about 15 frames a second.
    first.save(file, format="GIF", save_all=True, append_images=others, duration=70, loop=0)
    replace_bytes(path, file.getvalue())
    return path
