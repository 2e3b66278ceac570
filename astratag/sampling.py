"""Sampling: what an image shows between its pixels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from astratag.compiled import BRIGHTNESS, PLACES, REAL, compiled

Array = NDArray[np.float64]
Brightness = NDArray[np.uint8] | NDArray[np.float32]
"""An image (H, W): gray values as they are, or linear light."""
Places = Array | NDArray[np.float32]
"""Points (..., 2)."""


def sample(image: Brightness, points_px: Places) -> Array:
    """Return gray or light values at pixels (..., 2), interpolated; 0 outside the image."""
    flat = points_px.reshape(-1, 2)
    values: Array = _sampled(np.ascontiguousarray(image), np.ascontiguousarray(flat))
    return values.reshape(points_px.shape[:-1])


@compiled(REAL, REAL)
def _within(x: float, last: float) -> float:
    """Return the number from 0 to ``last`` that is nearest; 0 for what is none."""
    x = x if x > 0.0 else 0.0
    return x if x < last else last


@compiled(BRIGHTNESS, REAL, REAL)
def between(image: Brightness, x: float, y: float) -> float:
    """Return the value of an image (H, W) at a pixel, interpolated; beyond the image that of its border.

    Without branches, so that loops over points become vector instructions.
    """
    height, width = image.shape
    x, y = _within(x, width - 1.0), _within(y, height - 1.0)
    left, top = int(x), int(y)
    column, row = np.uint64(left), np.uint64(top)  # unsigned ones are not looked at for being negative
    next_column, next_row = np.uint64(min(left + 1, width - 1)), np.uint64(min(top + 1, height - 1))
    right, down = x - left, y - top
    here = image[row, column] * (1 - down) + image[next_row, column] * down
    return here * (1 - right) + (image[row, next_column] * (1 - down) + image[next_row, next_column] * down) * right


@compiled(BRIGHTNESS, REAL, REAL)
def bilinear(image: Brightness, x: float, y: float) -> float:
    """Return the value of an image (H, W) at a pixel, interpolated; beyond the image 0, reached within a pixel."""
    height, width = image.shape
    across = _within(x + 1, 1.0) * _within(width - x, 1.0)
    return between(image, x, y) * across * _within(y + 1, 1.0) * _within(height - y, 1.0)


@compiled(BRIGHTNESS, PLACES)
def _sampled(image: NDArray, points_px: NDArray) -> Array:
    """Return the values (N,) of an image at pixels (N, 2)."""
    values = np.empty(len(points_px))
    for n in range(len(points_px)):
        values[n] = bilinear(image, points_px[n, 0], points_px[n, 1])
    return values
