"""Images made grey, and larger or smaller. Sums are of whole numbers, so they are exact on every machine."""

import functools

import numpy as np

LUMA = np.array([299, 587, 114], np.float64)
"""Thousandths of red, green and blue in what a person sees as brightness (ITU-R BT.601)."""


def grey(image: np.ndarray) -> np.ndarray:
    """The brightness of a colour image, uint8 [H, W, 3] -> uint8 [H, W, 1], rounded."""
    return np.rint(image @ LUMA / 1000).astype(np.uint8)[..., None]


def averaged(image: np.ndarray, size: int) -> np.ndarray:
    """An image [H, W, ...] as one of size x size, each pixel the mean of the area that it covers: float64.

    Pixels on the edge of an area count by the part that lies in it. A larger size repeats pixels.
    """
    height, width = image.shape[:2]
    rows = np.tensordot(_overlaps(height, size), image, 1)
    sums = np.tensordot(_overlaps(width, size), np.swapaxes(rows, 0, 1), 1)
    return np.swapaxes(sums, 0, 1) / (height * width)


def resized(image: np.ndarray, size: int) -> np.ndarray:
    """`averaged` of an image uint8 [H, W, C], rounded: uint8 [size, size, C]."""
    return image if image.shape[:2] == (size, size) else np.rint(averaged(image, size)).astype(np.uint8)


@functools.lru_cache(maxsize=16)
def _overlaps(length: int, size: int) -> np.ndarray:
    """How much of each of `size` equal stretches lies in each of `length` pixels: float64 [size, length].

    In parts of 1 / size of a pixel, so all are whole and a row adds up to `length`.
    """
    stretches, pixels = np.arange(size)[:, None], np.arange(length)
    ends = np.minimum((stretches + 1) * length, (pixels + 1) * size)
    return np.maximum(ends - np.maximum(stretches * length, pixels * size), 0).astype(np.float64)
