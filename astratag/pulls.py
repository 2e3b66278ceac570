"""How far neighbouring edges pull the points of an edge that were found, and how well that is known."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from astratag.compiled import CUBE, FLAG_MATRIX, INDICES, MATRIX, REAL, VECTOR, compiled
from astratag.edges import POINTS_PER_EDGE
from astratag.neighbours import narrowing, pull

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

SHARP_REACH_PX = 4.0
"""An edge this far from its neighbours is sharp; nearer, they pull."""
PULL_PX, PULL_FLOOR_PX = 0.023, 0.002
"""How far a whole edge may be off when its neighbours are as near as ``SHARP_REACH_PX``, and at least."""
OUTERMOST = 4
"""The first so many edges are those of the outermost square."""
PULL_REST, PULL_GROWTH = 0.05, 2.0
"""How wrong a single pull is besides; how much faster than a weak pull a strong one grows with blur."""
BACKGROUND = 0.5
"""How much darker or brighter than paper what is behind the print may be, over what ink is."""
FAR_MARGIN, FAR_REACH = 5.0, 4.0
"""What is behind the print, and neighbours, do not pull from this many times the blur away."""
MOST_BLUR_STEPS, SAME_BLUR = 3, 0.03
"""Blur and pull are found from each other until the blur changes by no more than this fraction."""
MOST_PULL, LOST_PX = 0.4, 0.3
"""A pull by more than this fraction of the blur is not believed; the edge may then be off by so much."""


class Pulls(NamedTuple):
    """What is known (E, M) of how neighbours pull each point.

    ``variance`` is of what is not known of it, in points: what all points of an edge have in common does not average
    out, so each carries it as many times as there are points.  The keener a point, the less noise moves it: neighbours
    make the top of the slope rounder or flatter.  ``growth`` is how the pull grows with blur, and where it is ``lost``
    nothing is known.
    """

    pull_px: Array
    variance: Array
    keen: Array
    growth: Array
    lost: Mask


@compiled(VECTOR, MATRIX)
def _unknown(reach_px: Array, clipped_px: Array) -> Pulls:
    """Return that no pull (E, M) is known, but how large it may be."""
    variance = np.empty(clipped_px.shape)
    for e in range(len(reach_px)):
        off_px = PULL_PX * (SHARP_REACH_PX / max(reach_px[e], 1e-3)) ** 2 + PULL_FLOOR_PX
        for m in range(clipped_px.shape[1]):
            variance[e, m] = POINTS_PER_EDGE * (off_px**2 + clipped_px[e, m] ** 2)
    none = np.zeros(clipped_px.shape)
    return Pulls(none, variance, np.ones(clipped_px.shape), none, np.zeros(clipped_px.shape, np.bool_))


@compiled(CUBE, CUBE, CUBE, INDICES, MATRIX, VECTOR, FLAG_MATRIX, REAL)
def _blur_alone(
    distance: Array,
    jump: Array,
    cosine: Array,
    edges: NDArray[np.int64],
    unit_px: Array,
    reach_px: Array,
    alone: Mask,
    seen_px: float,
) -> float:
    """Return the blur that edges would show without neighbours, which narrow or widen them to what is ``seen_px``."""
    nearest_px, points = np.inf, 0
    for e in range(len(edges)):
        if alone[e].any():
            nearest_px = min(nearest_px, reach_px[e])
            points += int(np.count_nonzero(alone[e]))
    blur_px = seen_px
    if points == 0 or nearest_px > FAR_REACH * seen_px:
        return blur_px
    for _ in range(MOST_BLUR_STEPS):
        narrowed, rounder = 0.0, narrowing(distance, jump, cosine, edges, unit_px, blur_px, alone)
        for e in range(len(edges)):
            for m in range(alone.shape[1]):
                if alone[e, m]:
                    narrowed += rounder[e, m]
        before_px, blur_px = blur_px, seen_px * np.sqrt(narrowed / points)
        if abs(blur_px - before_px) < SAME_BLUR * before_px:
            break
    return blur_px


@compiled(MATRIX, MATRIX, REAL, INDICES, MATRIX, MATRIX)
def _known(
    pull_px: Array, keen: Array, blur_px: float, edges: NDArray[np.int64], margin_px: Array, clipped_px: Array
) -> Pulls:
    """Return what pulls (E, M), NaN where there is no knowing, tell."""
    believed, variance, growth = np.zeros(pull_px.shape), np.empty(pull_px.shape), np.zeros(pull_px.shape)
    lost = np.zeros(pull_px.shape, np.bool_)
    for e in range(pull_px.shape[0]):
        for m in range(pull_px.shape[1]):
            size_px = abs(pull_px[e, m])
            if size_px <= MOST_PULL * blur_px:
                believed[e, m] = pull_px[e, m]
                growth[e, m] = pull_px[e, m] * (1 + PULL_GROWTH / blur_px * size_px)
                wrong_px2 = (PULL_REST * size_px) ** 2 + PULL_FLOOR_PX**2
                margin = margin_px[e, m] / blur_px
                if edges[e] < OUTERMOST and margin < FAR_MARGIN:
                    margin = max(margin, 1.0)
                    wrong_px2 += (BACKGROUND * blur_px * margin * np.exp(-0.5 * margin * margin)) ** 2
            else:
                lost[e, m], wrong_px2 = True, LOST_PX**2
            variance[e, m] = POINTS_PER_EDGE * (wrong_px2 + clipped_px[e, m] ** 2)  # glare moves a whole edge alike
    return Pulls(believed, variance, keen.copy(), growth, lost)


@compiled(CUBE, CUBE, CUBE, INDICES, MATRIX, VECTOR, MATRIX, MATRIX, FLAG_MATRIX, FLAG_MATRIX, REAL)
def pulls_on(
    distance: Array,
    jump: Array,
    cosine: Array,
    edges: NDArray[np.int64],
    unit_px: Array,
    reach_px: Array,
    margin_px: Array,
    clipped_px: Array,
    alone: Mask,
    use: Mask,
    blur_px: float,
) -> Pulls:
    """Return what is known of the pulls on points to ``use`` (E, M) of E ``edges``.

    What lies beside edges are the fields of ``neighbours.Crossings``, how they lie and look those of ``locate.Edges``.
    """
    if len(distance) == 0:
        return _unknown(reach_px, clipped_px)
    blur_px = _blur_alone(distance, jump, cosine, edges, unit_px, reach_px, alone, blur_px)
    pulled = np.zeros(use.shape, np.bool_)
    for e in range(len(edges)):
        if reach_px[e] < FAR_REACH * blur_px:
            pulled[e] = use[e]
    found = pull(distance, jump, cosine, edges, unit_px, blur_px, pulled)
    return _known(found.px, found.curvature, blur_px, edges, margin_px, clipped_px)
