"""What neighbouring edges do to where an edge is found: blurred together, they move its steepest place.

Blurred by a Gaussian, every edge that a profile crosses or passes adds a bell to its slope, the lower the further the
edge ends before it or begins behind it; where the sum of all bells is highest, the edge is found.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from astratag.compiled import (
    BELLS,
    FLAG_MATRIX,
    INDICES,
    INT,
    INTO_MATRIX,
    LINE_NUMBERS,
    LINES,
    MATRIX,
    REAL,
    VECTOR,
    compiled,
)
from astratag.locate import STEP_PX
from astratag.neighbours import CLOSENESS, DISTANCE, END, LEAN_STEP, LEANS, LEAST_TURNED, SKEW, START

Array = NDArray[np.float64]
Single = NDArray[np.float32]
Mask = NDArray[np.bool_]

MOST_BELLS = 24
"""The nearest so many are looked at."""
AWAY, CHANGE, COSINE, BEGIN, FINISH, SINE = range(6)
"""What of a bell, as ``around`` returns it, is where."""
LITTLE = 0.1
"""A first step of Newton's method shorter than this, in blurs, needs no second."""
BELL_ENDS = 5.0
"""Bells further away, in blurs, do not matter; nor do ends of edges."""
LEAST_CURVATURE = 0.35
"""How round the top must be, relative to that of an edge alone, to be the edge's own."""
ENDLESS_PX = 1e6


class Pull(NamedTuple):
    """What neighbours do to E edges' M points when all is blurred.

    ``px`` (E, M) is how far towards the paper the steepest place lies from the edge, NaN where the edge has no such
    place of its own.  ``curvature`` (E, M) is how round the top of the slope is there, over what an edge alone has.
    """

    px: Array
    curvature: Array


@compiled(
    LINES, LINE_NUMBERS, VECTOR, INDICES, MATRIX, MATRIX, MATRIX, MATRIX, MATRIX, MATRIX, VECTOR, VECTOR, FLAG_MATRIX
)
def around(
    places: Single,
    which: NDArray[np.int64],
    jump: Array,
    edges: NDArray[np.int64],
    unit_px: Array,
    growth_px: Array,
    lean: Array,
    squeeze: Array,
    margin_px: Array,
    backdrop: Array,
    blur_px: Array,
    beside_px: Array,
    use: Mask,
) -> Array:
    """Return the bells (E, M, ``MOST_BELLS``, 6) on profiles at the points to ``use`` (E, M) of E ``edges``.

    Each is ``AWAY`` so many pixels along the profile, and the ``CHANGE`` of brightness there crosses it at an angle of
    that ``COSINE`` and ``SINE``; along the other edge, from where the point is beside it, it is so many pixels to its
    ``BEGIN`` and ``FINISH``.  The first without a change ends the list.  Those within reach of ``blur_px`` (E,) are
    listed, the edge's own among them, and the end of the margin; nothing when no crossings are known.  These are the
    fields of ``neighbours.Crossings``, how edges look those of ``locate.Edges``; what changes at the end of the margin
    is the ``backdrop`` (E, M).
    """
    listed = len(places) // len(LEANS)
    seen = np.zeros((len(edges) if listed else 0, use.shape[1], MOST_BELLS, 6))
    for e in range(len(seen)):
        far_px = BELL_ENDS * blur_px[e]
        for m in range(use.shape[1]):
            if not use[e, m]:
                continue
            nearest = min(max(round((lean[e, m] - LEANS[0]) / LEAN_STEP), 0), len(LEANS) - 1)
            row, more = nearest * listed + edges[e], lean[e, m] - LEANS[nearest]
            narrow = squeeze[e, m] * beside_px[e] / blur_px[e]
            along_px, n = unit_px[e, m] / narrow, 0
            if backdrop[e, m] != 0.0 and margin_px[e, m] < far_px:
                seen[e, m, 0, AWAY], seen[e, m, 0, CHANGE], seen[e, m, 0, COSINE] = margin_px[e, m], backdrop[e, m], 1.0
                seen[e, m, 0, BEGIN], seen[e, m, 0, FINISH] = -ENDLESS_PX, ENDLESS_PX
                n = 1
            for k in range(which.shape[2]):
                number, place = which[row, m, k], places[row, m, k]
                if number == 0 or n == MOST_BELLS or place[CLOSENESS] * min(unit_px[e, m], along_px) > far_px:
                    break
                turned, change = 1.0 + more * place[SKEW], jump[number] if number > 0 else -jump[-number]
                if change == 0.0 or turned <= LEAST_TURNED:
                    continue
                units = place[DISTANCE] / turned
                large_px = unit_px[e, m] + growth_px[e, m] * units
                off = narrow * place[SKEW] / turned
                cosine = 1.0 / np.sqrt(1.0 + off * off)
                away_px, sine = units * large_px, off * cosine
                first_px = (place[START] * turned - more * place[DISTANCE]) * along_px / cosine - away_px * sine
                last_px = (place[END] * turned - more * place[DISTANCE]) * along_px / cosine - away_px * sine
                if large_px > 0 and cosine * abs(away_px) < far_px and first_px < far_px and last_px > -far_px:
                    bell = seen[e, m, n]
                    bell[AWAY], bell[CHANGE], bell[COSINE], bell[SINE] = away_px, change * cosine, cosine, sine
                    bell[BEGIN], bell[FINISH] = first_px, last_px
                    n += 1
    return seen


@compiled(REAL)
def _normal(x: float) -> tuple[float, float]:
    """Return the standard normal distribution up to ``x``, and its density there."""
    if x > BELL_ENDS:
        return 1.0, 0.0
    if x < -BELL_ENDS:
        return 0.0, 0.0
    return 0.5 + 0.5 * math.erf(x / math.sqrt(2.0)), np.exp(-0.5 * x * x) / math.sqrt(2 * math.pi)


@compiled(BELLS, INT, INT, REAL, INTO_MATRIX)
def _prepared(beside: Array, edge: int, point: int, blur_px: float, bells: Array) -> int:
    """Write the bells beside a point to ``bells`` (``MOST_BELLS``, 6), in blurs, and return how many these are.

    How far away they are, their change and cosine as in ``around``; then how much of an endless edge's bell they are,
    and how that grows along the profile: first and second derivative.
    """
    for k in range(MOST_BELLS):
        bell = beside[edge, point, k]
        if bell[CHANGE] == 0.0:
            return k
        first, last, sine = bell[BEGIN] / blur_px, bell[FINISH] / blur_px, bell[SINE]
        (before, at_first), (until, at_last) = _normal(first), _normal(last)
        bells[k, 0], bells[k, 1], bells[k, 2] = bell[AWAY] / blur_px, bell[CHANGE], bell[COSINE]
        bells[k, 3], bells[k, 4] = until - before, sine * (at_last - at_first)
        bells[k, 5] = sine * sine * (first * at_first - last * at_last)
    return MOST_BELLS


@compiled(INTO_MATRIX, INT, REAL)
def _sum_of_bells(bells: Array, count: int, x: float) -> tuple[float, float, float]:
    """Return slope, curvature downwards and height of the sum of bells, as ``_prepared`` writes them, at ``x``."""
    slope, curvature, height = 0.0, 0.0, 0.0
    for k in range(count):
        c = bells[k, 2]
        z = c * (bells[k, 0] - x)
        bell, part, grows = (
            bells[k, 1] * np.exp(-0.5 * z * z),
            bells[k, 3] + x * (bells[k, 4] + x / 2 * bells[k, 5]),
            bells[k, 4] + x * bells[k, 5],
        )
        slope += (grows + part * z * c) * bell
        curvature -= (bells[k, 5] + 2 * grows * z * c + part * (z * z - 1) * c * c) * bell
        height += part * bell
    return slope, curvature, height


@compiled(BELLS, VECTOR, FLAG_MATRIX, MATRIX)
def pull(beside: Array, blur_px: Array, use: Mask, offset_px: Array) -> Pull:
    """Return what neighbours, as ``around`` gives them, do to the points to ``use`` (E, M).

    All is blurred by standard deviations of ``blur_px`` (E,).  Newton's method on the sum of bells; then, as where
    points were found, ``offset_px`` (E, M), the top of the parabola through the three highest samples: between lopsided
    ones it lies elsewhere.
    """
    pull_px, roundness, bells = np.zeros(use.shape), np.ones(use.shape), np.empty((MOST_BELLS, 6))
    for e in range(use.shape[0]):
        step = STEP_PX / blur_px[e]
        for m in range(use.shape[1]):
            if not use[e, m]:
                continue
            count = _prepared(beside, e, m, blur_px[e], bells)
            slope, curvature, height = _sum_of_bells(bells, count, 0.0)
            x = slope / max(curvature, LEAST_CURVATURE)
            if abs(x) > LITTLE:
                slope, curvature, height = _sum_of_bells(bells, count, x)
                x += slope / max(curvature, LEAST_CURVATURE)
            believed = curvature >= LEAST_CURVATURE and height >= LEAST_CURVATURE
            if believed and x != 0.0:
                middle = x - (offset_px[e, m] - STEP_PX * np.round(offset_px[e, m] / STEP_PX)) / blur_px[e]
                before = _sum_of_bells(bells, count, middle - step)[2]
                after = _sum_of_bells(bells, count, middle + step)[2]
                bend = 2 * _sum_of_bells(bells, count, middle)[2] - before - after
                x = middle + step / 2 * (after - before) / max(bend, LEAST_CURVATURE * step * step)
            pull_px[e, m] = x * blur_px[e] if believed else np.nan
            roundness[e, m] = max(curvature, LEAST_CURVATURE)
    return Pull(pull_px, roundness)


@compiled(BELLS, VECTOR, FLAG_MATRIX)
def narrowing(beside: Array, blur_px: Array, use: Mask) -> Array:
    """Return how much rounder (E, M) the tops of slopes are for their height than those of edges without neighbours."""
    rounder, bells = np.ones(use.shape), np.empty((MOST_BELLS, 6))
    for e in range(use.shape[0]):
        for m in range(use.shape[1]):
            if use[e, m]:
                count = _prepared(beside, e, m, blur_px[e], bells)
                _, curvature, height = _sum_of_bells(bells, count, 0.0)
                rounder[e, m] = max(curvature, LEAST_CURVATURE) / max(height, LEAST_CURVATURE)
    return rounder
