"""Steps: how a print that does not look as it should must move, by one Gauss-Newton step over all its pixels.

Compiled.  ``looks`` (5, N) are the rows of ``looks``; light and contrast may each vary in a plane.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from astratag.compiled import CUBE, LIGHT, MATRIX, REAL, VECTOR, compiled
from astratag.geometry import TEMPLATE_UNITS
from astratag.looks import AROUND, BY_BLUR, BY_X, BY_Y, MEAN
from astratag.normal import dot, factored, gram, inverse, left_over, solved
from astratag.sampling import between

Array = NDArray[np.float64]
Light = NDArray[np.float32]

BLUR_STEP = 0.3
"""How far one step may take the logarithm of the blur, as a standard deviation."""
STEP_PX = 1.0
"""How far one step may take a point of the print, as a standard deviation."""
LEAST_REACH_PX = 1e-12
"""By how much a parameter moves the print at least."""
INTERPOLATED = 1.0
"""Variance of a pixel's noise over that of residuals: 9/4 for values interpolated between pixels, less for what is left
because looks are not exact.  As large as poses of markers of 16 to 48 px ask for, on 70 pictures a size."""
LEAST_NOISE = 0.3
"""No light is believed to be known better than this, of 255."""
OF_LIGHT, OF_LEVEL = 7, 4
"""Unknowns of light: contrast and level in a plane each, and what is beyond the print, that count to the level."""


@compiled(LIGHT, MATRIX)
def values(light: Light, at_px: Array) -> Array:
    """Return the light (N,) at pixels (N, 2) within the image."""
    seen = np.empty(len(at_px))
    for n in range(len(at_px)):
        seen[n] = between(light, at_px[n, 0], at_px[n, 1])
    return seen


@compiled(MATRIX, VECTOR, VECTOR, MATRIX)
def contrast(template: Array, weight: Array, value: Array, looks: Array) -> tuple[float, float]:
    """Return how many units of light black and white are apart, and how values correlate with what is expected.

    Of N points: template (N, 2), weight (N,), value (N,).  What a plane of light and what is beyond the print explain
    is taken out.
    """
    columns = np.empty((OF_LEVEL + 2, len(value)))
    for n in range(len(value)):
        root = math.sqrt(weight[n])
        columns[0, n] = root
        columns[1, n] = root * (template[n, 0] / TEMPLATE_UNITS - 0.5)
        columns[2, n] = root * (template[n, 1] / TEMPLATE_UNITS - 0.5)
        columns[3, n] = root * looks[AROUND, n]
        columns[4, n] = root * value[n]
        columns[5, n] = root * looks[MEAN, n]
    left = left_over(gram(columns), OF_LEVEL)
    energy, common = left[1, 1] + 1e-12, left[0, 1]
    return common / energy, common / math.sqrt(energy * (left[0, 0] + 1e-12))


@compiled(MATRIX, VECTOR, VECTOR, REAL)
def least_squares(columns: Array, value: Array, step_sigma: Array, pixels: float) -> tuple[Array, Array]:
    """Return the unknowns (P,) that make columns (P, N) add up to values (N,), and their covariance (P, P).

    The first are held by their step sigmas.  The columns stand for so many ``pixels``, which tell of the noise.
    """
    normal, size = gram(columns), len(columns)
    right, scale = np.empty(size), np.empty(size)
    for i in range(size):
        scale[i] = math.sqrt(normal[i, i]) + 1e-12
        right[i] = dot(columns[i], value) / scale[i]
    for i in range(size):
        for j in range(size):
            normal[i, j] /= scale[i] * scale[j]
        normal[i, i] += 1e-9
    factor = factored(normal)
    free = solved(factor, right) / scale
    residual = value.copy()
    for i in range(size):
        residual -= free[i] * columns[i]
    variance = INTERPOLATED * dot(residual, residual) / max(pixels - size, 1.0) + LEAST_NOISE**2
    covariance = inverse(factor)
    for i in range(size):
        for j in range(size):
            covariance[i, j] *= variance / (scale[i] * scale[j])
    for i in range(len(step_sigma)):
        normal[i, i] += variance / (step_sigma[i] * scale[i]) ** 2
    return solved(factored(normal), right) / scale, covariance


@compiled(LIGHT, MATRIX, MATRIX, VECTOR, MATRIX, CUBE, VECTOR)
def step(
    light: Light, at_px: Array, template: Array, weight: Array, looks: Array, J: Array, warp_sigma: Array
) -> tuple[Array, Array, float, float, float]:
    """Return a step (P + 1,) of warp and blur, its covariance (P + 1, P + 1), contrast, correlation and movement.

    ``J`` (N, 2, P) are the derivatives of ``at_px`` (N, 2) by the warp's parameters, which one step may take by
    ``warp_sigma`` (P,); the movement is how many pixels the step moves a point most.
    """
    value = values(light, at_px)
    apart, correlation = contrast(template, weight, value, looks)
    count, size = len(value), J.shape[2]
    columns, root = np.empty((size + 1 + OF_LIGHT, count)), np.sqrt(weight)
    step_sigma = np.empty(size + 1)
    for p in range(size):
        reach_px = LEAST_REACH_PX
        for n in range(count):
            by_x, by_y = J[n, 0, p], J[n, 1, p]
            columns[p, n] = -apart * root[n] * (looks[BY_X, n] * by_x + looks[BY_Y, n] * by_y)
            reach_px = max(reach_px, abs(by_x), abs(by_y))
        step_sigma[p] = min(STEP_PX / reach_px, warp_sigma[p])
    step_sigma[size] = BLUR_STEP
    for n in range(count):
        columns[size, n] = apart * root[n] * looks[BY_BLUR, n]
        u, v = template[n, 0] / TEMPLATE_UNITS - 0.5, template[n, 1] / TEMPLATE_UNITS - 0.5
        for first, brightness in ((size + 1, root[n] * looks[MEAN, n]), (size + 4, root[n])):
            columns[first, n], columns[first + 1, n], columns[first + 2, n] = brightness, brightness * u, brightness * v
        columns[size + OF_LIGHT, n] = root[n] * looks[AROUND, n]
    x, covariance = least_squares(columns, root * value, step_sigma, weight.sum())
    moved_px = 0.0
    for n in range(count):
        for axis in range(2):
            along = 0.0
            for p in range(size):
                along += J[n, axis, p] * x[p]
            moved_px = max(moved_px, abs(along))
    return x[: size + 1].copy(), covariance[: size + 1, : size + 1].copy(), apart, correlation, moved_px
