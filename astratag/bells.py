"""What neighbouring edges do to where an edge is found: blurred together, they move its steepest place.

Blurred by a Gaussian, every edge that a profile crosses adds a bell to its slope; where the sum of all bells is
highest, the edge is found.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from astratag.compiled import CUBE, FLAG_MATRIX, INDICES, INT, MATRIX, REAL, compiled
from astratag.locate import STEP_PX
from astratag.neighbours import LEAN_STEP, LEANS, LEAST_TURNED, MOST_CROSSINGS

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

BESIDE = MOST_CROSSINGS + 1
"""What a profile crosses: edges of the print, and the end of its margin."""
LITTLE = 0.1
"""A first step of Newton's method shorter than this, in blurs, needs no second."""
BELL_ENDS = 5.0
"""Bells further away, in blurs, do not matter."""
LEAST_CURVATURE = 0.35
"""How round the top must be, relative to that of an edge alone, to be the edge's own."""


class Pull(NamedTuple):
    """What neighbours do to E edges' M points when all is blurred.

    ``px`` (E, M) is how far towards the paper the steepest place lies from the edge, NaN where the edge has no such
    place of its own.  ``curvature`` (E, M) is how round the top of the slope is there, over what an edge alone has.
    """

    px: Array
    curvature: Array


@compiled(CUBE, CUBE, CUBE, INDICES, MATRIX, MATRIX, MATRIX, MATRIX, MATRIX, MATRIX, FLAG_MATRIX)
def around(
    distance: Array,
    jump: Array,
    skew: Array,
    edges: NDArray[np.int64],
    unit_px: Array,
    growth_px: Array,
    lean: Array,
    squeeze: Array,
    margin_px: Array,
    backdrop: Array,
    use: Mask,
) -> Array:
    """Return what profiles at the points to ``use`` (E, M) of E ``edges`` cross: K edges, and the end of the margin.

    First how many pixels away they are (E, M, 3 K + 3), then by how much they change the slope, then the cosines at
    which they are crossed; nothing when no crossings are known.  Those are the fields of ``neighbours.Crossings``, how
    edges look those of ``locate.Edges``; what changes at the end of the margin is the ``backdrop`` (E, M).
    """
    listed = len(distance) // len(LEANS)
    seen = np.zeros((len(edges) if listed else 0, use.shape[1], 3 * BESIDE))
    for e in range(len(seen)):
        for m in range(use.shape[1]):
            if not use[e, m]:
                continue
            nearest = min(max(round((lean[e, m] - LEANS[0]) / LEAN_STEP), 0), len(LEANS) - 1)
            row, more = nearest * listed + edges[e], lean[e, m] - LEANS[nearest]
            for k in range(MOST_CROSSINGS):
                change, turned = jump[row, m, k], 1.0 + more * skew[row, m, k]
                if change == 0.0 or turned <= LEAST_TURNED:
                    continue
                units = distance[row, m, k] / turned
                large_px = unit_px[e, m] + growth_px[e, m] * units
                if large_px > 0:
                    off = squeeze[e, m] * skew[row, m, k] / turned
                    cosine = 1.0 / np.sqrt(1.0 + off * off)
                    seen[e, m, k] = units * large_px
                    seen[e, m, BESIDE + k] = change * cosine
                    seen[e, m, 2 * BESIDE + k] = cosine
            seen[e, m, MOST_CROSSINGS], seen[e, m, BESIDE + MOST_CROSSINGS] = margin_px[e, m], backdrop[e, m]
            seen[e, m, 2 * BESIDE + MOST_CROSSINGS] = 1.0
    return seen


@compiled(CUBE, INT, INT, REAL, REAL)
def _sum_of_bells(beside: Array, edge: int, point: int, blur_px: float, x: float) -> tuple[float, float, float]:
    """Return slope, curvature downwards and height, at ``x``, of a point's own bell, of height 1 at 0, and all others.

    Of the own bell as it is at its top.  ``beside`` is what ``around`` returns; all else is in blurs.
    """
    slope, curvature, height = 0.0, 1.0, 1.0
    for k in range(BESIDE):
        jump, c = beside[edge, point, BESIDE + k], beside[edge, point, 2 * BESIDE + k]
        z = c * (beside[edge, point, k] / blur_px - x)
        if abs(z) < BELL_ENDS and jump != 0.0:
            bell = jump * np.exp(-0.5 * z * z)
            slope += z * c * bell
            curvature -= (z * z - 1) * c * c * bell
            height += bell
    return slope, curvature, height


@compiled(CUBE, INT, INT, REAL, REAL)
def _height(beside: Array, edge: int, point: int, blur_px: float, x: float) -> float:
    """Return how steep a point's profile is at ``x``: the height of all bells, its own among them; as above."""
    height = np.exp(-0.5 * x * x)
    for k in range(BESIDE):
        z = beside[edge, point, 2 * BESIDE + k] * (beside[edge, point, k] / blur_px - x)
        if abs(z) < BELL_ENDS:
            height += beside[edge, point, BESIDE + k] * np.exp(-0.5 * z * z)
    return height


@compiled(CUBE, REAL, FLAG_MATRIX, MATRIX)
def pull(beside: Array, blur_px: float, use: Mask, offset_px: Array) -> Pull:
    """Return what neighbours, as ``around`` gives them, do to the points to ``use`` (E, M).

    All is blurred by a standard deviation of ``blur_px``.  Newton's method on the sum of bells; then, as where points
    were found, ``offset_px`` (E, M), the top of the parabola through the three highest samples: between lopsided ones
    it lies elsewhere.
    """
    pull_px, roundness = np.zeros(use.shape), np.ones(use.shape)
    step = STEP_PX / blur_px
    for e in range(use.shape[0]):
        for m in range(use.shape[1]):
            if not use[e, m]:
                continue
            slope, curvature, height = _sum_of_bells(beside, e, m, blur_px, 0.0)
            x = slope / max(curvature, LEAST_CURVATURE)
            if abs(x) > LITTLE:
                slope, curvature, height = _sum_of_bells(beside, e, m, blur_px, x)
                own = np.exp(-0.5 * x * x)
                curvature += (1 - x * x) * own - 1
                height += own - 1
                x += (slope - x * own) / max(curvature, LEAST_CURVATURE)
            believed = curvature >= LEAST_CURVATURE and height >= LEAST_CURVATURE
            if believed and x != 0.0:
                middle = x - (offset_px[e, m] - STEP_PX * np.round(offset_px[e, m] / STEP_PX)) / blur_px
                before = _height(beside, e, m, blur_px, middle - step)
                after = _height(beside, e, m, blur_px, middle + step)
                bend = 2 * _height(beside, e, m, blur_px, middle) - before - after
                x = middle + step / 2 * (after - before) / max(bend, LEAST_CURVATURE * step * step)
            pull_px[e, m] = x * blur_px if believed else np.nan
            roundness[e, m] = max(curvature, LEAST_CURVATURE)
    return Pull(pull_px, roundness)


@compiled(CUBE, REAL, FLAG_MATRIX)
def narrowing(beside: Array, blur_px: float, use: Mask) -> Array:
    """Return how much rounder (E, M) the tops of slopes are for their height than those of edges without neighbours."""
    rounder = np.ones(use.shape)
    for e in range(use.shape[0]):
        for m in range(use.shape[1]):
            if use[e, m]:
                _, curvature, height = _sum_of_bells(beside, e, m, blur_px, 0.0)
                rounder[e, m] = max(curvature, LEAST_CURVATURE) / max(height, LEAST_CURVATURE)
    return rounder
