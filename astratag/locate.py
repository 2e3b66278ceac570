"""Locating edges in an image, to a few hundredths of a pixel.

Through each point of an edge a short profile is taken across it, in linear light, and the place of steepest rise from
ink to paper is found between samples.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from astratag.compiled import CUBE, FLAG_MATRIX, FLAGS, INT, LIGHT, MATRIX, REAL, VECTOR, compiled
from astratag.edges import ALONG_SHARE, FEW_INTERVALS, POINTS_PER_EDGE, template_of
from astratag.normal import ranked
from astratag.sampling import between
from astratag.warp import FittedWarp

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

STEP_PX = 0.5
SMOOTHING_PX = 0.7
"""Standard deviation of the derivative filter: little, so that neighbouring edges do not pull."""
WITHIN_REACH = 0.6
"""An edge is looked for this fraction of the way to its nearest neighbour."""
FAR_PX = 1e6
"""No image reaches so far."""
MOST_ALONE = 0.8
"""Edges whose reach is at least this fraction of the largest tell the blur."""
LOW_RATIO, HIGH_RATIO = (float(np.exp(-((STEP_PX / blur_px) ** 2))) for blur_px in (0.75, 12.0))
"""What edges under the least and the most blur have in the product beside the top, over the top's square."""
LEAST_RISE, LEAST_RISE_GREY = 0.35, 0.05
"""How steep a rise must be: a fraction of what is typical of its own edge, both as shares of the light on its paper
(a shadow takes as much off both), and in linear grey values a pixel."""
SATURATED, WHOLE_RISE, CLIPPED_PX = 250.0, 0.75, 1.7
"""Where paper is as bright as this, an edge that rises by less than this share of it is cut off at the top by glare,
and looks so many pixels nearer to the ink for each share that is missing (at a blur of 0.8 pixels)."""

APART_PX = 3.0
"""Edges at least this far from their neighbours have whole ink and whole paper beside them."""
MOST_OF_COVER, DARKEST = 0.5, 0.5
"""What lies on a marker is known by being less than this fraction as bright as its paper, which the brightest quarter
of all points show; ink darker than this, of 255, is noise."""


class Lie(NamedTuple):
    """How E edges of M points each lie in the image where they are predicted, x and y first.

    ``normal`` (2, E, M) is the image unit vector from ink to paper at the points ``predicted_px`` (2, E, M);
    ``length_px`` (E,) is how long an edge looks, ``unit_px`` (E, M) how large a template unit looks across it and
    ``reach_px`` (E,) how far it is from its neighbours.  For the outermost edges ``margin_px`` (E, M) is how wide
    the quiet margin looks.
    """

    predicted_px: Array
    normal: Array
    length_px: Array
    unit_px: Array
    reach_px: Array
    margin_px: Array


@dataclass(frozen=True, eq=False)
class EdgePoints:
    """Where the edges were found: E edges of M points each.

    ``edge`` (E,) indexes ``EDGES``; how they ``lie`` is of what was predicted.  ``offset_px`` (E, M) is the distance
    from there along the normals; only where ``found``, which is only where ``in_view``.  The points ``alone`` (E, M)
    are those furthest from their neighbours; ``blur_px`` is the standard deviation of all that blurs these: lens,
    pixel, interpolation, derivative filter, and neighbours a little.  ``clipped_px`` (E, M) is how far saturation may
    have moved the edge.
    """

    edge: NDArray[np.int64]
    lie: Lie
    offset_px: Array
    found: Mask
    in_view: Mask
    alone: Mask
    blur_px: float
    smoothing_px: float
    clipped_px: Array

    @property
    def lens_px(self) -> float:
        """Return the standard deviation of what blurs the image, the derivative filter left out."""
        return float(np.sqrt(self.blur_px**2 - self.smoothing_px**2))


def locate(
    light: NDArray[np.float32],
    warp: FittedWarp,
    edges: NDArray[np.int64],
    search_px: float,
    smoothing_px: float = SMOOTHING_PX,
) -> EdgePoints:
    """Look for ``edges`` (indices of ``EDGES``) up to ``search_px`` from where ``warp`` predicts them.

    ``light`` is the image in linear light.  An edge is never looked for beyond its own reach, so that
    neighbours are not taken for it.  ``smoothing_px`` is the standard deviation of the derivative filter.
    """
    template = template_of(edges)
    half = int(np.ceil((search_px + 3 * smoothing_px) / STEP_PX))
    lie = Lie(*_lie(warp(template.probes), template.to_paper, template.reach))
    in_view = _in_view(lie.predicted_px, warp.visible(template.few), half * STEP_PX, *light.shape)
    profiles, ink, paper = _profiles(light, lie.predicted_px, lie.normal, half)
    limit_px = np.fmin(min(search_px, half * STEP_PX - 3 * smoothing_px + 0.3), WITHIN_REACH * lie.reach_px)
    slopes = profiles @ _derivative(2 * half + 1, smoothing_px, int(limit_px.max() / STEP_PX) + 2)
    offset_px, rise, beside = _steepest_rise(slopes, limit_px)
    found, alone, blur_px, clipped_px = _judged(ink, paper, offset_px, rise, beside, in_view, lie.reach_px)
    offset_px = np.where(found, offset_px, 0.0)
    return EdgePoints(edges, lie, offset_px, found, in_view, alone, blur_px, smoothing_px, clipped_px)


@cache
def _derivative(samples: int, smoothing_px: float, kept: int) -> Array:
    """Return the matrix (S, T) that takes profiles (..., S), continued at their ends, to smoothed slopes a pixel.

    Of the slopes those in the middle are kept, ``kept`` to either side.
    """
    reach = int(np.ceil(3.5 * smoothing_px / STEP_PX))
    x = np.arange(-reach, reach + 1) * STEP_PX
    kernel = x * np.exp(-0.5 * (x / smoothing_px) ** 2)
    kernel /= kernel @ x
    matrix = np.zeros((samples, samples))
    for column in range(samples):
        np.add.at(matrix[:, column], np.clip(np.arange(column - reach, column + reach + 1), 0, samples - 1), kernel)
    middle = samples // 2
    return np.ascontiguousarray(matrix[:, middle - kept : middle + kept + 1])


@compiled(CUBE, VECTOR, VECTOR)
def _lie(seen_px: Array, to_paper: Array, reach: Array) -> tuple[Array, Array, Array, Array, Array, Array]:
    """Return how E edges lie in the image, the fields of ``Lie``, from where their probes are seen (E, M + 10, 2)."""
    edges, points = len(seen_px), POINTS_PER_EDGE
    few = (points - 1) // FEW_INTERVALS
    predicted, normal = np.empty((2, edges, points)), np.empty((2, edges, points))
    length, reach_px = np.zeros(edges), np.empty(edges)
    unit_px, margin_px = np.empty((edges, points)), np.empty((edges, points))
    across, outwards = np.empty(FEW_INTERVALS + 1), np.empty(FEW_INTERVALS + 1)
    for e in range(edges):
        for m in range(points):
            before, after = max(m - 1, 0), min(m + 1, points - 1)
            dx = (seen_px[e, after, 0] - seen_px[e, before, 0]) / (after - before)
            dy = (seen_px[e, after, 1] - seen_px[e, before, 1]) / (after - before)
            spacing = np.sqrt(dx * dx + dy * dy) + 1e-9
            length[e] += spacing * ALONG_SHARE
            predicted[0, e, m], predicted[1, e, m] = seen_px[e, m]
            normal[0, e, m], normal[1, e, m] = dy * to_paper[e] / spacing, -dx * to_paper[e] / spacing
        for k in range(FEW_INTERVALS + 1):
            x, y = seen_px[e, k * few]
            nx, ny = normal[0, e, k * few], normal[1, e, k * few]
            inner, outer = seen_px[e, points + k], seen_px[e, points + FEW_INTERVALS + 1 + k]
            across[k] = abs((inner[0] - x) * nx + (inner[1] - y) * ny)
            outwards[k] = (outer[0] - x) * nx + (outer[1] - y) * ny
        # how far apart neighbouring edges look, where that is least: small when the print is seen at a slant
        reach_px[e] = reach[e] * across.min()
        for m in range(points):
            k = min(m // few, FEW_INTERVALS - 1)
            share = m / few - k
            unit_px[e, m] = across[k] + share * (across[k + 1] - across[k])
            margin_px[e, m] = outwards[k] + share * (outwards[k + 1] - outwards[k])
    return predicted, normal, length, unit_px, reach_px, margin_px


@compiled(CUBE, FLAGS, REAL, INT, INT)
def _in_view(predicted_px: Array, facing: Mask, profile_px: float, height: int, width: int) -> Mask:
    """Return which points (E, M) are on edges whose few points (5 E) all face the viewer, and well inside the image."""
    _, edges, points = predicted_px.shape
    few = len(facing) // edges
    in_view = np.zeros((edges, points), np.bool_)
    for e in range(edges):
        if facing[e * few : (e + 1) * few].all():
            for m in range(points):
                x, y = predicted_px[0, e, m], predicted_px[1, e, m]
                across = profile_px <= x <= width - 1 - profile_px
                in_view[e, m] = across and profile_px <= y <= height - 1 - profile_px
    return in_view


@compiled(LIGHT, CUBE, CUBE, INT)
def _profiles(light: NDArray[np.float32], predicted_px: Array, normal: Array, half: int) -> tuple[Array, Array, Array]:
    """Return the light (E, M, 2 half + 1) every ``STEP_PX`` across edges, and the least and the most of each (E, M).

    Continued beyond the image as at its border; zeros where a warp gone astray predicts no place at all.
    """
    _, edges, points = predicted_px.shape
    profiles = np.zeros((edges, points, 2 * half + 1))
    ink, paper = np.zeros((edges, points)), np.zeros((edges, points))
    for e in range(edges):
        for m in range(points):
            x, y = predicted_px[0, e, m], predicted_px[1, e, m]
            if abs(x) < FAR_PX and abs(y) < FAR_PX:
                step_x, step_y = STEP_PX * normal[0, e, m], STEP_PX * normal[1, e, m]
                least, most = np.inf, -np.inf
                for k in range(2 * half + 1):
                    value = between(light, x + (k - half) * step_x, y + (k - half) * step_y)
                    profiles[e, m, k] = value
                    least, most = min(least, value), max(most, value)
                ink[e, m], paper[e, m] = least, most
    return profiles, ink, paper


@compiled(CUBE, VECTOR)
def _steepest_rise(slopes: Array, limit_px: Array) -> tuple[Array, Array, Array]:
    """Return where (E, M) slopes (E, M, T) are steepest, in pixels from their middle, and how steep there.

    Also the product of the slopes a step before and after.
    The place is NaN where it lies at the limit (E,) of the search: it is something else's.
    """
    edges, points, steps = slopes.shape
    place, rise, beside = (np.full((edges, points), np.nan), np.empty((edges, points)), np.empty((edges, points)))
    for e in range(edges):
        kept = int((limit_px[e] + 1e-9) / STEP_PX)
        for m in range(points):
            best = steps // 2 - kept
            for k in range(best + 1, steps // 2 + kept + 1):
                if slopes[e, m, k] > slopes[e, m, best]:
                    best = k
            below, peak, above = slopes[e, m, best - 1], slopes[e, m, best], slopes[e, m, best + 1]
            rise[e, m], beside[e, m] = peak, below * above
            if below < peak and above <= peak:
                at = best - steps // 2 + 0.5 * (above - below) / (2 * peak - below - above)
                place[e, m] = at * STEP_PX
    return place, rise, beside


@compiled(MATRIX, MATRIX, VECTOR)
def _covered(ink: Array, paper: Array, reach_px: Array) -> Mask:
    """Return which points (E, M) have something else beside them than paper.

    It is darker than paper, but not because of a shadow: that would darken the ink as well.
    """
    edges, points = ink.shape
    covered, bright, ratio, count = np.zeros(ink.shape, np.bool_), np.empty(ink.size), np.empty(ink.size), 0
    for e in range(edges):
        if reach_px[e] >= APART_PX:
            for m in range(points):
                bright[count], ratio[count] = paper[e, m], paper[e, m] / (ink[e, m] + DARKEST)
                count += 1
    if count == 0:
        return covered
    least_bright = MOST_OF_COVER * ranked(bright[:count], 3 * count // 4)  # what a quarter of all exceed
    least_ratio = MOST_OF_COVER * ranked(ratio[:count], 3 * count // 4)
    for e in range(edges):
        if reach_px[e] >= APART_PX:
            for m in range(points):
                dark = paper[e, m] < least_bright
                covered[e, m] = dark and paper[e, m] / (ink[e, m] + DARKEST) < least_ratio
    return covered


@compiled(MATRIX, MATRIX, MATRIX, MATRIX, MATRIX, FLAG_MATRIX, VECTOR)
def _judged(
    ink: Array, paper: Array, offset_px: Array, rise: Array, beside: Array, in_view: Mask, reach_px: Array
) -> tuple[Mask, Mask, float, Array]:
    """Return which points (E, M) are found and which of them stand alone, the blur, and how far clipping moved them."""
    edges, points = rise.shape
    found, clipped_px = np.zeros(rise.shape, np.bool_), np.zeros(rise.shape)
    for e in range(edges):
        typical = 0.0
        for m in range(points):
            typical += max(rise[e, m], 0.0) / max(paper[e, m], 1.0) / points
        for m in range(points):
            steep = rise[e, m] / max(paper[e, m], 1.0) > LEAST_RISE * typical and rise[e, m] > LEAST_RISE_GREY
            found[e, m] = in_view[e, m] and steep and not np.isnan(offset_px[e, m])
            if paper[e, m] >= SATURATED:
                clipped_px[e, m] = CLIPPED_PX * max(WHOLE_RISE - (1 - ink[e, m] / max(paper[e, m], 1.0)), 0.0)
    found &= ~_covered(ink, paper, reach_px)
    widest_px = 0.0
    for e in range(edges):
        if found[e].any():
            widest_px = max(widest_px, reach_px[e])
    alone, slopes_beside, squared = np.zeros(rise.shape, np.bool_), 0.0, 0.0
    for e in range(edges):
        if reach_px[e] >= MOST_ALONE * widest_px:
            for m in range(points):
                if found[e, m]:
                    alone[e, m] = True
                    slopes_beside += beside[e, m]
                    squared += rise[e, m] * rise[e, m]
    # slopes are bells; a Gaussian's logarithm is a parabola, whose width its values at the top and beside it tell
    ratio = min(max(slopes_beside / max(squared, 1e-9), LOW_RATIO), HIGH_RATIO)
    return found, alone, STEP_PX / np.sqrt(-np.log(ratio)), clipped_px
