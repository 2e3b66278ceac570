"""Alignment: moving a warp until the whole print looks as expected, where edges are too faint or too bent to follow."""

from __future__ import annotations

import math
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from astratag.compiled import FLAGS, GRAY, INT, MATRIX, REAL, VECTOR, compiled
from astratag.geometry import TEMPLATE_UNITS, square
from astratag.normal import factored, gram, ranked, solved
from astratag.sampling import within
from astratag.warp import FittedWarp

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
W = TypeVar("W", bound=FittedWarp)

COARSE_BLUR, COARSE_STEPS = 0.03, 4
"""Blur, as a fraction of the print's side in the image, at which a warp some cells off still finds its way."""
FINE_STEPS = 3
LEAST_BLUR_PX = 0.5
TUKEY = 4.685
FIRST_SIGMA = 10.0
"""Grey values by which the image may differ from what is expected before any step."""


def align(gray: Image, warp: W, points: Array, expected: Array, *, blur: float, steps: int) -> W:
    """Return ``warp`` moved so that the image at its ``points`` (N, 2) looks like ``expected`` (N,).

    The light may vary: brightness is a quadratic surface over the print, contrast a linear one.  Gauss-Newton
    ``steps`` with Tukey's weights on an image blurred by a fraction ``blur`` of the print's side
    (Baker and Matthews, "Lucas-Kanade 20 years on", IJCV 2004).
    """
    outline = warp(square(0.0, TEMPLATE_UNITS))
    low, high = outline.min(axis=0), outline.max(axis=0)
    span_px = float((high - low).max())
    diagonals = outline[2] - outline[0], outline[3] - outline[1]
    side_px = np.sqrt(abs(diagonals[0][0] * diagonals[1][1] - diagonals[0][1] * diagonals[1][0]) / 2)
    if not np.isfinite(span_px):
        return warp
    corner = np.clip(np.floor(low - 0.2 * span_px), 0, gray.shape[::-1]).astype(int)
    end = np.clip(np.ceil(high + 0.2 * span_px) + 1, 0, gray.shape[::-1]).astype(int)
    part = np.ascontiguousarray(gray[corner[1] : end[1], corner[0] : end[0]])
    if min(part.shape) < 8:
        return warp
    width = 2 * round(np.sqrt(3.0) * blur * side_px) + 1  # of a box as wide as a Gaussian of that deviation
    smooth = cv2.blur(part, (width, width)) if blur * side_px > LEAST_BLUR_PX else part
    size = len(warp.step_sigma())
    columns = _columns(points, expected, size)
    for _ in range(steps):
        value, gradient, inside = _sampled(smooth, np.ascontiguousarray(warp(points) - corner))
        if inside.sum() < len(points) / 2:
            return warp
        np.negative(warp.slopes(points, gradient), out=columns[:size])
        warp = warp.stepped(_solve(columns, value, inside, warp.step_sigma()))
    return warp


@compiled(MATRIX, VECTOR, INT)
def _columns(points: Array, expected: Array, size: int) -> Array:
    """Return room for ``size`` columns, and nine more (N,) that add up to any light on what is expected (N,)."""
    columns = np.empty((size + 9, len(points)))
    for n in range(len(points)):
        u, v = points[n, 0] / (TEMPLATE_UNITS / 2) - 1.0, points[n, 1] / (TEMPLATE_UNITS / 2) - 1.0
        for k, factor in enumerate((1.0, u, v, u * v, u * u, v * v)):
            columns[size + k, n] = factor
        for k, factor in enumerate((1.0, u, v)):
            columns[size + 6 + k, n] = factor * expected[n]
    return columns


@compiled(GRAY, MATRIX)
def _sampled(image: Image, at_px: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Return the values (N,) of an image (H, W) at pixels (N, 2), its gradients there (2, N), and which are inside it.

    Interpolated; gradients are central differences over two pixels.  Pixels beyond the image show the nearest inside.
    """
    height, width = image.shape
    value, gradient = np.empty(len(at_px)), np.empty((2, len(at_px)))
    inside = np.empty(len(at_px), dtype=np.bool_)
    one, two = np.uint64(1), np.uint64(2)  # unsigned indices are not looked at for being negative
    for n in range(len(at_px)):
        x, y = at_px[n, 0], at_px[n, 1]
        inside[n] = 1 <= x <= width - 2 and 1 <= y <= height - 2
        x, y = 1 + within(x - 1, width - 3.0), 1 + within(y - 1, height - 3.0)
        left, top = min(int(x), width - 3), min(int(y), height - 3)
        right, down, column, row = x - left, y - top, np.uint64(left), np.uint64(top)
        above, upper, lower, below = image[row - one], image[row], image[row + one], image[row + two]
        a = upper[column - one] + down * (float(lower[column - one]) - upper[column - one])
        b = upper[column] + down * (float(lower[column]) - upper[column])
        c = upper[column + one] + down * (float(lower[column + one]) - upper[column + one])
        d = upper[column + two] + down * (float(lower[column + two]) - upper[column + two])
        value[n] = b + right * (c - b)
        gradient[0, n] = (c - a + right * (d - b - c + a)) / 2
        a = above[column] + right * (float(above[column + one]) - above[column])
        b = upper[column] + right * (float(upper[column + one]) - upper[column])
        c = lower[column] + right * (float(lower[column + one]) - lower[column])
        d = below[column] + right * (float(below[column + one]) - below[column])
        gradient[1, n] = (c - a + down * (d - b - c + a)) / 2
    return value, gradient, inside


@compiled(MATRIX, VECTOR, VECTOR, VECTOR, REAL)
def _solution(columns: Array, value: Array, weight: Array, step_sigma: Array, sigma: float) -> Array:
    """Return the unknowns (P,) with which weighted columns (P, N) add up to values (N,).

    The first are held by their step sigmas, against values' ``sigma``.
    """
    size = len(columns)
    weighted = np.empty((size + 1, columns.shape[1]))
    for n in range(len(weight)):
        weighted[size, n] = math.sqrt(weight[n])
    for i in range(size):
        for n in range(len(weight)):
            weighted[i, n] = columns[i, n] * weighted[size, n]
    for n in range(len(weight)):
        weighted[size, n] *= value[n]
    products = gram(weighted)
    normal, right, scale = np.empty((size, size)), np.empty(size), np.empty(size)
    for i in range(size):
        scale[i] = math.sqrt(products[i, i]) + 1e-12
    for i in range(size):
        right[i] = products[size, i] / scale[i]
        for j in range(size):
            normal[i, j] = products[i, j] / (scale[i] * scale[j])
        normal[i, i] += 1e-9
    for i in range(len(step_sigma)):
        normal[i, i] += (sigma / (step_sigma[i] * scale[i])) ** 2
    return solved(factored(normal), right) / scale


@compiled(MATRIX, VECTOR, FLAGS, VECTOR)
def _solve(columns: Array, value: Array, inside: NDArray[np.bool_], step_sigma: Array) -> Array:
    """Return the step (P,) that is the first unknowns of columns (P + 9, N), solved again weighted against outliers.

    Only values (N,) ``inside`` the image count.
    """
    weight, sigma, count = inside.astype(np.float64), FIRST_SIGMA, inside.sum()
    x = _solution(columns, value, weight, step_sigma, sigma)
    residual = value.copy()
    for i in range(len(columns)):
        for n in range(len(residual)):
            residual[n] -= x[i] * columns[i, n]
    for n in range(len(residual)):
        residual[n] = abs(residual[n]) if inside[n] else np.inf
    sigma = 1.4826 * ranked(residual, count // 2) + 1e-3
    for n in range(len(weight)):
        weight[n] = max(1 - (residual[n] / (TUKEY * sigma)) ** 2, 0.0) ** 2
    return _solution(columns, value, weight, step_sigma, sigma)[: len(step_sigma)].copy()
