"""Sampling: what an image shows between its pixels."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from astratag.compiled import BRIGHTNESS, GRAY, INT, PLACES, REAL, VECTOR, compiled

Array = NDArray[np.float64]
Brightness = NDArray[np.uint8] | NDArray[np.float32]
"""An image (H, W): gray values as they are, or linear light."""
Places = Array | NDArray[np.float32]
"""Points (..., 2)."""
Index = np.uint64


class Light(NamedTuple):
    """An image in linear light: its ``gray`` values (H, W), and how much light, 0..255, each of the 256 is."""

    gray: NDArray[np.uint8]
    of_gray: Array


AS_GRAY = np.arange(256.0)
"""The table of an image that is taken as it is."""


def sample(image: Brightness, points_px: Places) -> Array:
    """Return gray or light values at pixels (..., 2), interpolated; 0 outside the image."""
    flat = points_px.reshape(-1, 2)
    values: Array = _sampled(np.ascontiguousarray(image), np.ascontiguousarray(flat))
    return values.reshape(points_px.shape[:-1])


@compiled(REAL, REAL)
def within(x: float, last: float) -> float:
    """Return the number from 0 to ``last`` that is nearest; 0 for what is none."""
    x = x if x > 0.0 else 0.0
    return x if x < last else last


@compiled(REAL, REAL, INT, INT)
def _around(
    x: float, y: float, height: int, width: int
) -> tuple[np.uint64, np.uint64, np.uint64, np.uint64, float, float]:
    """Return the columns and rows before and after a place, and how far right and down of the first ones it is.

    Without branches; indices are unsigned, for such are not looked at for being negative.
    """
    x, y = within(x, width - 1.0), within(y, height - 1.0)
    left, top = int(x), int(y)
    column, row = np.uint64(left), np.uint64(top)
    next_column, next_row = np.uint64(min(left + 1, width - 1)), np.uint64(min(top + 1, height - 1))
    return column, next_column, row, next_row, x - left, y - top


@compiled(BRIGHTNESS, REAL, REAL)
def between(image: Brightness, x: float, y: float) -> float:
    """Return the value of an image (H, W) at a pixel, interpolated; beyond the image that of its border."""
    column, next_column, row, next_row, right, down = _around(x, y, image.shape[0], image.shape[1])
    here = image[row, column] * (1 - down) + image[next_row, column] * down
    return here * (1 - right) + (image[row, next_column] * (1 - down) + image[next_row, next_column] * down) * right


@compiled(GRAY, VECTOR, REAL, REAL)
def light_between(gray: NDArray[np.uint8], of_gray: Array, x: float, y: float) -> float:
    """Return the light that an image (H, W) shows at a pixel, interpolated; beyond the image that of its border."""
    column, next_column, row, next_row, right, down = _around(x, y, gray.shape[0], gray.shape[1])
    here = of_gray[gray[row, column]] * (1 - down) + of_gray[gray[next_row, column]] * down
    beside = of_gray[gray[row, next_column]] * (1 - down) + of_gray[gray[next_row, next_column]] * down
    return here * (1 - right) + beside * right


@compiled(REAL, REAL, INT, INT)
def fading(x: float, y: float, height: int, width: int) -> float:
    """Return 1 within an image, and how that falls to 0 within a pixel beyond."""
    across = within(x + 1, 1.0) * within(width - x, 1.0)
    return across * within(y + 1, 1.0) * within(height - y, 1.0)


@compiled(BRIGHTNESS, REAL, REAL)
def bilinear(image: Brightness, x: float, y: float) -> float:
    """Return the value of an image (H, W) at a pixel, interpolated; beyond the image 0, reached within a pixel."""
    return between(image, x, y) * fading(x, y, image.shape[0], image.shape[1])


@compiled(BRIGHTNESS, PLACES)
def _sampled(image: NDArray, points_px: NDArray) -> Array:
    """Return the values (N,) of an image at pixels (N, 2)."""
    values = np.empty(len(points_px))
    for n in range(len(points_px)):
        values[n] = bilinear(image, points_px[n, 0], points_px[n, 1])
    return values
