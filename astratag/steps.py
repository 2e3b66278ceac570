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
from astratag.normal import factored, gram, inverse, left_over, projected, solved
from astratag.sampling import between

Array = NDArray[np.float64]
Light = NDArray[np.float32]

BLUR_STEP = 0.3
"""How far one step may take the logarithm of the blur, as a standard deviation."""
STEP_PX = 1.0
"""How far one step may take a point of the print, as a standard deviation."""
INTERPOLATED = 9 / 4
"""Variance of a pixel's noise over that of values interpolated between pixels."""
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
    columns = np.empty((len(value), OF_LEVEL + 2))
    for n in range(len(value)):
        root = math.sqrt(weight[n])
        columns[n, 0] = root
        columns[n, 1] = root * (template[n, 0] / TEMPLATE_UNITS - 0.5)
        columns[n, 2] = root * (template[n, 1] / TEMPLATE_UNITS - 0.5)
        columns[n, 3] = root * looks[AROUND, n]
        columns[n, 4] = root * value[n]
        columns[n, 5] = root * looks[MEAN, n]
    left = left_over(gram(columns), OF_LEVEL)
    energy, common = left[1, 1] + 1e-12, left[0, 1]
    return common / energy, common / math.sqrt(energy * (left[0, 0] + 1e-12))


@compiled(MATRIX, VECTOR, VECTOR, REAL)
def least_squares(A: Array, value: Array, step_sigma: Array, pixels: float) -> tuple[Array, Array]:
    """Return the unknowns (P,) of A x = value (N,), the first held by their step sigmas, and their covariance (P, P).

    ``A`` (N, P) and ``value`` stand for so many ``pixels``, which tell of the noise.
    """
    normal, right = gram(A), projected(A, value)
    size = len(right)
    scale = np.empty(size)
    for i in range(size):
        scale[i] = math.sqrt(normal[i, i]) + 1e-12
    for i in range(size):
        right[i] /= scale[i]
        for j in range(size):
            normal[i, j] /= scale[i] * scale[j]
        normal[i, i] += 1e-9
    factor = factored(normal)
    free = solved(factor, right) / scale
    energy = 0.0
    for n in range(len(value)):
        residual = value[n]
        for i in range(size):
            residual -= A[n, i] * free[i]
        energy += residual * residual
    variance = INTERPOLATED * energy / max(pixels - size, 1.0) + LEAST_NOISE**2
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
    A = np.empty((count, size + 1 + OF_LIGHT))
    reach = np.full(size, 1e-12)
    for n in range(count):
        root = math.sqrt(weight[n])
        for p in range(size):
            A[n, p] = -apart * root * (looks[BY_X, n] * J[n, 0, p] + looks[BY_Y, n] * J[n, 1, p])
            reach[p] = max(reach[p], abs(J[n, 0, p]), abs(J[n, 1, p]))
        A[n, size] = apart * root * looks[BY_BLUR, n]
        u, v = template[n, 0] / TEMPLATE_UNITS - 0.5, template[n, 1] / TEMPLATE_UNITS - 0.5
        for first, brightness in ((size + 1, root * looks[MEAN, n]), (size + 4, root)):
            A[n, first], A[n, first + 1], A[n, first + 2] = brightness, brightness * u, brightness * v
        A[n, size + 7] = root * looks[AROUND, n]
        value[n] *= root
    step_sigma = np.empty(size + 1)
    for p in range(size):
        step_sigma[p] = min(STEP_PX / reach[p], warp_sigma[p])
    step_sigma[size] = BLUR_STEP
    x, covariance = least_squares(A, value, step_sigma, weight.sum())
    moved_px = 0.0
    for n in range(count):
        for axis in range(2):
            along = 0.0
            for p in range(size):
                along += J[n, axis, p] * x[p]
            moved_px = max(moved_px, abs(along))
    return x[: size + 1].copy(), covariance[: size + 1, : size + 1].copy(), apart, correlation, moved_px
