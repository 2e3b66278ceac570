"""Alignment: moving a warp until the whole print looks as expected, where edges are too faint or too bent to follow."""

from __future__ import annotations

from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from astratag.geometry import TEMPLATE_UNITS, square
from astratag.signature import sample
from astratag.warp import FittedWarp

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
W = TypeVar("W", bound=FittedWarp)

COARSE_BLUR, COARSE_STEPS = 0.03, 4
"""Blur, as a fraction of the print's side in the image, at which a warp some cells off still finds its way."""
FINE_STEPS = 3
LEAST_BLUR_PX = 0.5
TUKEY = 4.685
_CROSS = np.array([(0.0, 0.0), (1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)])[:, None, :]


def align(gray: Image, warp: W, points: Array, expected: Array, *, blur: float, steps: int) -> W:
    """Return ``warp`` moved so that the image at its ``points`` (N, 2) looks like ``expected`` (N,).

    The light may vary: brightness is a quadratic surface over the print, contrast a linear one.  Gauss-Newton
    ``steps`` with Tukey's weights on an image blurred by a fraction ``blur`` of the print's side
    (Baker and Matthews, "Lucas-Kanade 20 years on", IJCV 2004).
    """
    u, v = (points / (TEMPLATE_UNITS / 2) - 1.0).T
    light = np.stack([u**0, u, v, u * v, u * u, v * v, expected, expected * u, expected * v], axis=1)
    outline = warp(square(0.0, TEMPLATE_UNITS))
    low, high = outline.min(axis=0), outline.max(axis=0)
    span_px = float((high - low).max())
    diagonals = outline[2] - outline[0], outline[3] - outline[1]
    side_px = np.sqrt(abs(diagonals[0][0] * diagonals[1][1] - diagonals[0][1] * diagonals[1][0]) / 2)
    if not np.isfinite(span_px):
        return warp
    corner = np.clip(np.floor(low - 0.2 * span_px), 0, gray.shape[::-1]).astype(int)
    end = np.clip(np.ceil(high + 0.2 * span_px) + 1, 0, gray.shape[::-1]).astype(int)
    part = gray[corner[1] : end[1], corner[0] : end[0]]
    if min(part.shape) < 8:
        return warp
    width = 2 * round(np.sqrt(3.0) * blur * side_px) + 1  # of a box as wide as a Gaussian of that deviation
    smooth = cv2.blur(part, (width, width)) if blur * side_px > LEAST_BLUR_PX else part
    for _ in range(steps):
        at = warp(points) - corner
        inside = ((at >= 1) & (at <= np.array(smooth.shape[::-1]) - 2)).all(axis=1)
        if inside.sum() < len(points) / 2:
            return warp
        value, right, left, below, above = sample(smooth, at[None, inside] + _CROSS)
        slope = np.stack([(right - left) / 2, (below - above) / 2], axis=1)
        by_warp = (slope[:, None, :] @ warp.jacobian(points[inside]))[:, 0]
        warp = warp.stepped(_solve(np.column_stack([-by_warp, light[inside]]), value, warp.step_sigma()))
    return warp


def _solve(A: Array, value: Array, step_sigma: Array) -> Array:
    """Return the step (P,) of the first P unknowns of A x = value, twice reweighted against outliers."""
    scale = np.linalg.norm(A, axis=0) + 1e-12
    A = A / scale
    weight = np.ones(len(value))
    sigma = 10.0
    for _ in range(2):
        weighted = A * weight[:, None]
        prior = np.full(A.shape[1], 1e-9)
        prior[: len(step_sigma)] += (sigma / (step_sigma * scale[: len(step_sigma)])) ** 2
        x = np.linalg.solve(weighted.T @ A + np.diag(prior), weighted.T @ value)
        residual = value - A @ x
        sigma = 1.4826 * float(np.median(np.abs(residual))) + 1e-3
        weight = np.clip(1 - (residual / (TUKEY * sigma)) ** 2, 0, None) ** 2
    return (x / scale)[: len(step_sigma)]
