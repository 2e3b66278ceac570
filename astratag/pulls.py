"""How far neighbouring edges pull the points of an edge that were found, and how well that is known."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from astratag.backdrop import FAR_MARGIN, OUTERMOST, THIN_MARGIN
from astratag.bells import narrowing, pull
from astratag.compiled import BELLS, FLAG_MATRIX, INDICES, MATRIX, REAL, VECTOR, compiled
from astratag.edges import POINTS_PER_EDGE
from astratag.locate import LEAST_LENS_PX, SMOOTHING_PX

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

INTERPOLATION_PX2 = 1 / 6
"""How far interpolation between pixels smooths their noise, as a variance."""
SHARP_REACH_PX = 4.0
"""An edge this far from its neighbours is sharp; nearer, they pull."""
PULL_PX, PULL_FLOOR_PX = 0.023, 0.0005
"""How far a whole edge may be off when its neighbours are as near as ``SHARP_REACH_PX``, and at least."""
PULL_REST, PULL_GROWTH = 0.04, 2.0
"""How wrong a pull is that is known, as a fraction of it (0.03 to 0.06 through an exact blur); how much faster than a
weak one a strong one grows with blur."""
BACKGROUND = 0.12
"""How far off the brightness of what is behind the print may be, over how much darker than paper ink is."""
FAR_REACH = 4.0
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


@compiled(BELLS, VECTOR, FLAG_MATRIX, REAL, VECTOR)
def _lens_alone(beside: Array, reach_px: Array, alone: Mask, seen_px: float, smoothing_px: Array) -> float:
    """Return the blur that edges would show without neighbours, which narrow or widen them to what is ``seen_px``.

    Without what the filters, ``smoothing_px`` (E,), add to it.
    """
    nearest, points = np.inf, 0
    for e in range(len(reach_px)):
        if alone[e].any():
            nearest = min(nearest, reach_px[e] / np.hypot(seen_px, smoothing_px[e]))
            points += int(np.count_nonzero(alone[e]))
    lens_px = seen_px
    if points == 0 or nearest > FAR_REACH:
        return lens_px
    for _ in range(MOST_BLUR_STEPS):
        lens_px2, rounder = 0.0, narrowing(beside, np.hypot(lens_px, smoothing_px), alone)
        for e in range(len(reach_px)):
            for m in range(alone.shape[1]):
                if alone[e, m]:
                    lens_px2 += rounder[e, m] * (seen_px**2 + smoothing_px[e] ** 2) - smoothing_px[e] ** 2
        before_px, lens_px = lens_px, np.sqrt(max(lens_px2 / points, LEAST_LENS_PX**2))
        if abs(lens_px - before_px) < SAME_BLUR * before_px:
            break
    return lens_px


@compiled(MATRIX, MATRIX, VECTOR, INDICES, MATRIX, MATRIX)
def _known(
    pull_px: Array,
    keen: Array,
    blur_px: Array,
    edges: NDArray[np.int64],
    margin_px: Array,
    clipped_px: Array,
) -> Pulls:
    """Return what pulls (E, M), NaN where there is no knowing, tell."""
    believed, variance, growth = np.zeros(pull_px.shape), np.empty(pull_px.shape), np.zeros(pull_px.shape)
    lost = np.zeros(pull_px.shape, np.bool_)
    for e in range(pull_px.shape[0]):
        for m in range(pull_px.shape[1]):
            size_px = abs(pull_px[e, m])
            if size_px <= MOST_PULL * blur_px[e]:
                believed[e, m] = pull_px[e, m]
                growth[e, m] = pull_px[e, m] * (1 + PULL_GROWTH / blur_px[e] * size_px)
                wrong_px2 = (PULL_REST * size_px) ** 2 + PULL_FLOOR_PX**2
                margin = margin_px[e, m] / blur_px[e]
                if edges[e] < OUTERMOST and margin < FAR_MARGIN:
                    margin = max(margin, THIN_MARGIN)
                    wrong_px2 += (BACKGROUND * blur_px[e] * margin * np.exp(-0.5 * margin * margin)) ** 2
            else:
                lost[e, m], wrong_px2 = True, LOST_PX**2
            variance[e, m] = POINTS_PER_EDGE * (wrong_px2 + clipped_px[e, m] ** 2)  # glare moves a whole edge alike
    return Pulls(believed, variance, keen.copy(), growth, lost)


@compiled(REAL, REAL)
def quieter(lens_px: float, smoothing_px: float) -> float:
    """Return how much less noise moves an edge through a filter than through the narrowest, both wide as the lens.

    The second derivative through a filter is as noisy as the power of -5/2 of its width, interpolation included, and
    crosses zero as steeply as that of -3 of all blur.
    """
    blur = (lens_px**2 + SMOOTHING_PX**2) / (lens_px**2 + smoothing_px**2)
    filtered = (smoothing_px**2 + INTERPOLATION_PX2) / (SMOOTHING_PX**2 + INTERPOLATION_PX2)
    return float(blur**1.5 * filtered**1.25)


@compiled(VECTOR, VECTOR, FLAG_MATRIX)
def within_reach(reach_px: Array, blur_px: Array, points: Mask) -> Mask:
    """Return which of the points (E, M) are on edges whose neighbours (E,) are near enough to pull."""
    pulled = np.zeros(points.shape, np.bool_)
    for e in range(len(reach_px)):
        if reach_px[e] < FAR_REACH * blur_px[e]:
            pulled[e] = points[e]
    return pulled


@compiled(BELLS, INDICES, VECTOR, MATRIX, MATRIX, MATRIX, FLAG_MATRIX, FLAG_MATRIX, REAL, VECTOR)
def pulls_on(
    beside: Array,
    edges: NDArray[np.int64],
    reach_px: Array,
    margin_px: Array,
    clipped_px: Array,
    offset_px: Array,
    alone: Mask,
    use: Mask,
    lens_px: float,
    smoothing_px: Array,
) -> Pulls:
    """Return what is known of the pulls on points to ``use`` (E, M) of E ``edges``.

    What is ``beside`` them is what ``bells.around`` returns, empty where the code is not known; how they lie and look
    are fields of ``locate.Edges``.
    """
    if len(beside) == 0:
        return _unknown(reach_px, clipped_px)
    lens_px = _lens_alone(beside, reach_px, alone, lens_px, smoothing_px)
    blur_px = np.hypot(lens_px, smoothing_px)
    found = pull(beside, blur_px, within_reach(reach_px, blur_px, use), offset_px)
    for e in range(len(blur_px)):
        found.curvature[e] *= quieter(lens_px, smoothing_px[e])
    return _known(found.px, found.curvature, blur_px, edges, margin_px, clipped_px)
