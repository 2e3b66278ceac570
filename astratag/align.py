"""Alignment: moving a warp until the whole print looks as expected, where edges are too faint or too bent to follow."""

from __future__ import annotations

import math
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from astratag.compiled import CUBE, GRAY, MATRIX, REAL, VECTOR, compiled
from astratag.geometry import TEMPLATE_UNITS, square
from astratag.normal import dot, factored, gram, ranked, solved
from astratag.sampling import between
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
    u, v = (points / (TEMPLATE_UNITS / 2) - 1.0).T
    light = np.stack([u**0, u, v, u * v, u * u, v * v, expected, expected * u, expected * v])
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
    for _ in range(steps):
        J = np.ascontiguousarray(warp.jacobian(points))
        columns, value = _columns(smooth, np.ascontiguousarray(warp(points) - corner), J, light)
        if len(value) < len(points) / 2:
            return warp
        warp = warp.stepped(_solve(columns, value, warp.step_sigma()))
    return warp


@compiled(GRAY, MATRIX, CUBE, MATRIX)
def _columns(image: Image, at_px: Array, J: Array, light: Array) -> tuple[Array, Array]:
    """Return columns (P + 9, M) that add up to the values (M,) of an image at those pixels (N, 2) that are inside it.

    They are what the values change by as the warp's parameters do, ``J`` (N, 2, P), and what ``light`` (9, N) does.
    """
    height, width = image.shape
    size = J.shape[2]
    inside = np.empty(len(at_px), dtype=np.int64)
    count = 0
    for n in range(len(at_px)):
        if 1 <= at_px[n, 0] <= width - 2 and 1 <= at_px[n, 1] <= height - 2:
            inside[count] = n
            count += 1
    columns, value = np.empty((size + len(light), count)), np.empty(count)
    for m in range(count):
        n = inside[m]
        x, y = at_px[n, 0], at_px[n, 1]
        value[m] = between(image, x, y)
        by_x = (between(image, x + 1, y) - between(image, x - 1, y)) / 2
        by_y = (between(image, x, y + 1) - between(image, x, y - 1)) / 2
        for p in range(size):
            columns[p, m] = -(by_x * J[n, 0, p] + by_y * J[n, 1, p])
        for i in range(len(light)):
            columns[size + i, m] = light[i, n]
    return columns, value


@compiled(MATRIX, VECTOR, VECTOR, VECTOR, REAL)
def _solution(columns: Array, value: Array, weight: Array, step_sigma: Array, sigma: float) -> tuple[Array, Array]:
    """Return the unknowns (P,) with which weighted columns (P, N) add up to values (N,), and what is left (N,).

    The first are held by their step sigmas, against values' ``sigma``.
    """
    size = len(columns)
    normal, right, scale = gram(columns * np.sqrt(weight)), np.empty(size), np.empty(size)
    weighted = weight * value
    for i in range(size):
        scale[i] = math.sqrt(dot(columns[i], columns[i])) + 1e-12
        right[i] = dot(columns[i], weighted) / scale[i]
    for i in range(size):
        for j in range(size):
            normal[i, j] /= scale[i] * scale[j]
        normal[i, i] += 1e-9
    for i in range(len(step_sigma)):
        normal[i, i] += (sigma / (step_sigma[i] * scale[i])) ** 2
    x = solved(factored(normal), right) / scale
    residual = value.copy()
    for i in range(size):
        residual -= x[i] * columns[i]
    return x, residual


@compiled(MATRIX, VECTOR, VECTOR)
def _solve(columns: Array, value: Array, step_sigma: Array) -> Array:
    """Return the step (P,) that is the first unknowns of columns (P + 9, N), twice reweighted against outliers."""
    weight, sigma = np.ones(len(value)), FIRST_SIGMA
    for _ in range(2):
        x, residual = _solution(columns, value, weight, step_sigma, sigma)
        sigma = 1.4826 * ranked(np.abs(residual), len(residual) // 2) + 1e-3
        for n in range(len(weight)):
            weight[n] = max(1 - (residual[n] / (TUKEY * sigma)) ** 2, 0.0) ** 2
    return x[: len(step_sigma)].copy()
