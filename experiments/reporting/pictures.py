"""Pictures as data URIs: drawn here, or taken from the runs and made smaller where need be."""

import base64
import io
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from srl_jax.errors import ConfigError
from srl_jax.files.reading import read_bytes

from ..drawing import plots
from ..drawing.colours import Style
from ..drawing.plots import Curve

heights, interval_curves = plots.heights, plots.interval_curve
LARGEST = 1 << 24
"""Bytes that a picture on disk may have."""
ARMS_A_PICTURE = 6
"""Lines of arms that can be told apart in one picture of learning curves."""


class Picture(NamedTuple):
    """A picture within a page: a data URI, its width and height in pixels, and the bytes of the file."""

    source: str
    size: tuple[int, int]
    bytes: int


COLUMN = 360
"""Width of a column of the page, in pixels."""


def drawn(draw: Callable[[Path], object]) -> Picture | None:
    """What a function of the path of a PNG file draws; None where it writes nothing."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "picture.png"
        draw(path)
        return picture(path.read_bytes(), str(path)) if path.exists() else None


def picture(data: bytes, name: str, limit: int = LARGEST) -> Picture:
    """A PNG or GIF as it is; with more bytes than the limit, a GIF's first frames, a PNG as a narrow WebP.

    Raises:
        ConfigError: it is none; `name` is the file's.
    """
    from PIL import Image

    try:
        with Image.open(io.BytesIO(data), formats=("PNG", "GIF")) as image:
            if image.format == "GIF" and len(data) > limit:
                return picture(_first_frames(image, limit), name)
            if len(data) > limit:
                return _narrow(image)
            kind, size = image.get_format_mimetype(), image.size
    except (OSError, ValueError, SyntaxError, EOFError, Image.DecompressionBombError):
        raise ConfigError(f"{name}: neither a PNG nor a GIF, or damaged") from None
    return Picture(f"data:{kind};base64,{base64.b64encode(data).decode()}", size, len(data))


def _narrow(image) -> Picture:
    """A WebP as wide as a column of the page."""
    file = io.BytesIO()
    image = image.convert("RGB")
    image.thumbnail((COLUMN, image.height))
    image.save(file, format="WEBP", quality=40, method=6)
    source = f"data:image/webp;base64,{base64.b64encode(file.getvalue()).decode()}"
    return Picture(source, image.size, len(file.getvalue()))


def _first_frames(image, limit: int) -> bytes:
    """As many frames of a GIF as the limit has room for, one at least, each for as long as it was shown."""
    from PIL import ImageSequence

    frames = [frame.copy() for frame in ImageSequence.Iterator(image)]
    while True:
        file, first = io.BytesIO(), frames[0]
        durations = [frame.info.get("duration", 70) for frame in frames]
        first.save(file, "GIF", save_all=True, append_images=frames[1:], loop=0, duration=durations)
        if file.tell() <= limit or len(frames) == 1:
            return file.getvalue()
        del frames[max(1, min(len(frames) - 1, len(frames) * limit // file.tell())) :]


def taken(path: Path, limit: int) -> Picture | None:
    """A picture of a run, see `picture`; None where there is none.

    Raises:
        ConfigError: it cannot be read, or is no picture.
    """
    try:
        return picture(read_bytes(path, LARGEST), str(path), limit)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from None


def curves(
    title: str,
    lines: Sequence[tuple[Style, Curve]],
    *,
    size: tuple[float, float] = (3.4, 2.3),
    label: str = "",
    across: str = "",
    policies: Mapping[str, float] | None = None,
    limits: tuple[float, float] | None = None,
) -> Picture:
    """A picture of one number against another; which line is whose is said beside it.

    Args:
        title: above it.
        lines: an arm's style and its curve.
        size: width and height in inches.
        label, across: of the axes; empty across for env steps.
        policies: name -> mean return of reference policies.
        limits: of the vertical axis; None for what `heights` gives.
    """
    named = [plots.Line(str(i), curve, seeds=2) for i, (_, curve) in enumerate(lines)]
    looks = {str(i): style for i, (style, _) in enumerate(lines)}
    levels = [plots.Level(*policy) for policy in (policies or {}).items()]
    panel = plots.Panel("", named, (), levels, title, across, limits)
    return drawn(lambda path: plots.draw_panels([panel], path, "", "", looks, label, size))
