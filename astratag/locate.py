"""Locating edges in an image, to a few hundredths of a pixel.

Through each point of an edge a short profile is taken across it, in linear light, and the place of steepest rise from
ink to paper is found between samples.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from astratag.compiled import CUBE, FLAG_MATRIX, FLAGS, GRAY, INDICES, INT, INTO_MATRIX, MATRIX, REAL, VECTOR, compiled
from astratag.edges import ALONG_SHARE, FEW_INTERVALS, POINTS_PER_EDGE
from astratag.normal import ranked
from astratag.sampling import light_between

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

STEP_PX = 0.5
SMOOTHING_PX = 0.7
"""Standard deviation of the derivative filter, at least: little, so that neighbouring edges do not pull."""
WITHIN_REACH = 0.6
"""An edge is looked for this fraction of the way to its nearest neighbour."""
ROW_PX, MOST_ROWS, CLOSE_PX, ROWS_REACH_PX = 1.6, 5, 2.0, 4.0
"""Points of an edge far apart are looked at in several rows side by side, so far from each other that their noise is
their own: where they are looked for so near, and neighbours are so far away."""
LEAST_LENS_PX = 0.4
"""Lens, pixel and interpolation blur by no less."""
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
SMOOTHING_OF_LENS, CLOSE_SMOOTHING_OF_LENS, REACH_OF_SMOOTHING, WORTHWHILE = 0.8, 1.8, 4.0, 1.4
"""Width of the filter over the blur's, also where edges are known to a pixel or two, at most a part of their reach; and
from which gain on edges are looked for once more.

The steepest place is the less noisy the wider the filter: by 2.6, 1.8 and 1.5 times what an edge's light tells of it
(0.7, 1 and 1.5 pixels, through a blur of 0.85).
"""
USUAL_LENS_PX = 0.85
FILTER_REACH, BESIDE_PX = 3.5, 0.3
"""Where the filter ends, in its standard deviations; and how near its middle may come to where profiles end."""
APART_PX = 3.0
"""Edges at least this far from their neighbours have whole ink and whole paper beside them."""
MOST_OF_COVER, DARKEST = 0.5, 0.5
"""What lies on a marker is known by being less than this fraction as bright as its paper, which the brightest quarter
of all points show; ink darker than this, of 255, is noise."""


class Edges(NamedTuple):
    """How E edges of M points each lie in the image where they are predicted, x and y first, and where they were found.

    ``predicted_px`` (2, E, M) are points on them and ``normal`` (2, E, M) the image unit vectors from ink to paper;
    ``length_px`` (E,) is how long an edge looks, ``unit_px`` (E, M) how large a template unit looks across it,
    ``growth_px`` (E, M) how much larger for each unit towards the paper, ``squeeze`` (E, M) over how large along it,
    and ``reach_px`` (E,) how far it is from its neighbours.  Normals ``lean`` (E, M) in the print: by so many units
    along the edge for each towards the paper.  For the outermost edges ``margin_px`` (E, M) is how wide the quiet
    margin looks.

    ``offset_px`` (E, M) is the distance from there along the normals; only where ``found``, which is only where
    ``in_view``.  The points ``alone`` (E, M) are those furthest from their neighbours; ``lens_px`` is the standard
    deviation of what blurs these: lens, pixel, interpolation, and neighbours a little.  The derivative filter of each
    edge blurs by ``smoothing_px`` (E,) besides.
    ``clipped_px`` (E, M) is how far saturation may have moved the edge.  Each point is the mean of ``rows`` (E,) side
    by side, which blur along the edge, as the lens does and the filter does not: by ``beside_px`` (E,).
    """

    predicted_px: Array
    normal: Array
    length_px: Array
    unit_px: Array
    growth_px: Array
    lean: Array
    squeeze: Array
    reach_px: Array
    margin_px: Array
    offset_px: Array
    found: Mask
    in_view: Mask
    alone: Mask
    lens_px: float
    clipped_px: Array
    smoothing_px: Array
    rows: NDArray[np.int64]
    beside_px: Array


@compiled(CUBE, VECTOR, VECTOR, VECTOR, VECTOR)
def _lie(
    seen_px: Array, to_paper: Array, reach: Array, spacing: Array, outside: Array
) -> tuple[Array, Array, Array, Array, Array, Array, Array, Array, Array]:
    """Return how E edges lie in the image, the first of ``Edges``, from where their probes are seen (E, M + 10, 2)."""
    edges, points = len(seen_px), POINTS_PER_EDGE
    few, along_px = (points - 1) // FEW_INTERVALS, np.empty(points)
    predicted, normal = np.empty((2, edges, points)), np.empty((2, edges, points))
    length, reach_px = np.zeros(edges), np.empty(edges)
    unit_px, margin_px = np.empty((edges, points)), np.empty((edges, points))
    lean, squeeze = np.empty((edges, points)), np.empty((edges, points))
    across, outwards = np.empty(FEW_INTERVALS + 1), np.empty(FEW_INTERVALS + 1)
    growth_px, growths = np.empty((edges, points)), np.empty(FEW_INTERVALS + 1)
    leans, squeezes = np.empty(FEW_INTERVALS + 1), np.empty(FEW_INTERVALS + 1)
    for e in range(edges):
        for m in range(points):
            before, after = max(m - 1, 0), min(m + 1, points - 1)
            dx = (seen_px[e, after, 0] - seen_px[e, before, 0]) / (after - before)
            dy = (seen_px[e, after, 1] - seen_px[e, before, 1]) / (after - before)
            step_px = np.sqrt(dx * dx + dy * dy) + 1e-9
            length[e] += step_px * ALONG_SHARE
            along_px[m] = step_px / spacing[e]
            predicted[0, e, m], predicted[1, e, m] = seen_px[e, m]
            normal[0, e, m], normal[1, e, m] = dy * to_paper[e] / step_px, -dx * to_paper[e] / step_px
        for k in range(FEW_INTERVALS + 1):
            x, y = seen_px[e, k * few]
            nx, ny = normal[0, e, k * few], normal[1, e, k * few]
            inner, outer = seen_px[e, points + k], seen_px[e, points + FEW_INTERVALS + 1 + k]
            across[k] = abs((inner[0] - x) * nx + (inner[1] - y) * ny)
            leans[k] = ((inner[1] - y) * nx - (inner[0] - x) * ny) / along_px[k * few]
            squeezes[k] = across[k] / along_px[k * few]
            outwards[k] = (outer[0] - x) * nx + (outer[1] - y) * ny
            growths[k] = (outwards[k] / outside[e] - to_paper[e] * across[k]) / outside[e]
        for k in range(FEW_INTERVALS + 1):  # the line leans, and units grow along the edge as well
            before, after = max(k - 1, 0), min(k + 1, FEW_INTERVALS)
            growths[k] += leans[k] * (across[after] - across[before]) / ((after - before) * few * spacing[e])
        # how far apart neighbouring edges look, where that is least: small when the print is seen at a slant
        reach_px[e] = reach[e] * across.min()
        for m in range(points):
            k = min(m // few, FEW_INTERVALS - 1)
            share = m / few - k
            unit_px[e, m] = across[k] + share * (across[k + 1] - across[k])
            growth_px[e, m] = growths[k] + share * (growths[k + 1] - growths[k])
            lean[e, m] = leans[k] + share * (leans[k + 1] - leans[k])
            squeeze[e, m] = squeezes[k] + share * (squeezes[k + 1] - squeezes[k])
            margin_px[e, m] = outwards[k] + share * (outwards[k + 1] - outwards[k])
    return predicted, normal, length, unit_px, growth_px, lean, squeeze, reach_px, margin_px


@compiled(CUBE, FLAGS, VECTOR, INT, INT)
def _in_view(predicted_px: Array, facing: Mask, profile_px: Array, height: int, width: int) -> Mask:
    """Return which points (E, M) are on edges whose few points (5 E) all face the viewer, and well inside the image.

    Profiles reach ``profile_px`` (E,) to either side.
    """
    _, edges, points = predicted_px.shape
    few = len(facing) // edges
    in_view = np.zeros((edges, points), np.bool_)
    for e in range(edges):
        if facing[e * few : (e + 1) * few].all():
            for m in range(points):
                x, y = predicted_px[0, e, m], predicted_px[1, e, m]
                across = profile_px[e] <= x <= width - 1 - profile_px[e]
                in_view[e, m] = across and profile_px[e] <= y <= height - 1 - profile_px[e]
    return in_view


@compiled(REAL)
def _derivative(smoothing_px: float) -> Array:
    """Return the weights, from one step on, of what comes so many steps later less what comes before: slopes a pixel.

    Of profiles smoothed by a Gaussian of that standard deviation.
    """
    weights, moment = np.empty(int(np.ceil(FILTER_REACH * smoothing_px / STEP_PX))), 0.0
    for k in range(len(weights)):
        x_px = (k + 1) * STEP_PX
        weights[k] = x_px * np.exp(-0.5 * (x_px / smoothing_px) ** 2)
        moment += 2 * x_px * weights[k]
    return weights / moment


@compiled(GRAY, VECTOR, CUBE, CUBE, INT, INT, INT)
def _profiles(
    gray: NDArray[np.uint8], of_gray: Array, predicted_px: Array, normal: Array, edge: int, half: int, rows: int
) -> Array:
    """Return the light (2 half + 1, M) every ``STEP_PX`` across the points of an edge, each the mean of ``rows``.

    Continued beyond the image as at its border; zeros where a warp gone astray predicts no place at all.
    """
    points = predicted_px.shape[2]
    profiles = np.zeros((2 * half + 1, points))
    for row in range(rows):
        aside_px = (row - (rows - 1) / 2) * ROW_PX
        for k in range(2 * half + 1):
            away_px = (k - half) * STEP_PX
            for m in range(points):
                nx, ny = normal[0, edge, m], normal[1, edge, m]
                x = predicted_px[0, edge, m] + away_px * nx - aside_px * ny
                y = predicted_px[1, edge, m] + away_px * ny + aside_px * nx
                profiles[k, m] += light_between(gray, of_gray, x, y) / rows
    for m in range(points):
        if not (abs(predicted_px[0, edge, m]) < FAR_PX and abs(predicted_px[1, edge, m]) < FAR_PX):
            profiles[:, m] = 0.0
    return profiles


@compiled(MATRIX)
def _extremes(profiles: Array) -> tuple[Array, Array]:
    """Return the least and the most light (M,) on each of M profiles (S, M)."""
    least, most = profiles[0].copy(), profiles[0].copy()
    for k in range(1, len(profiles)):
        for m in range(len(least)):
            value = profiles[k, m]
            least[m] = value if value < least[m] else least[m]
            most[m] = value if value > most[m] else most[m]
    return least, most


@compiled(MATRIX, VECTOR, INT)
def _slopes(profiles: Array, weights: Array, kept: int) -> Array:
    """Return how profiles (S, M), continued at their ends, rise (2 kept + 1, M) in their middle and about it."""
    last, points = len(profiles) - 1, profiles.shape[1]
    slopes = np.zeros((2 * kept + 1, points))
    for k in range(2 * kept + 1):
        at = last // 2 - kept + k
        for step in range(len(weights)):
            after, before = min(at + step + 1, last), max(at - step - 1, 0)
            for m in range(points):
                slopes[k, m] += weights[step] * (profiles[after, m] - profiles[before, m])
    return slopes


@compiled(MATRIX)
def _steepest_rise(slopes: Array) -> tuple[Array, Array, Array]:
    """Return where (M,) slopes (T, M) are steepest, in pixels from their middle, and how steep there.

    Also the product of the slopes a step before and after.  The first and the last slope are not looked at but for
    that.  The place is NaN where it lies at the limit of the search: it is something else's.
    """
    steps, points = slopes.shape
    place, rise, beside = np.full(points, np.nan), np.empty(points), np.empty(points)
    for m in range(points):
        best = 1
        for k in range(2, steps - 1):
            if slopes[k, m] > slopes[best, m]:
                best = k
        below, peak, above = slopes[best - 1, m], slopes[best, m], slopes[best + 1, m]
        rise[m], beside[m] = peak, below * above
        if below < peak and above <= peak:
            at = best - steps // 2 + 0.5 * (above - below) / (2 * peak - below - above)
            place[m] = at * STEP_PX
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


@compiled(MATRIX, MATRIX, MATRIX, MATRIX, MATRIX, FLAG_MATRIX, VECTOR, VECTOR)
def _judged(
    ink: Array,
    paper: Array,
    offset_px: Array,
    rise: Array,
    beside: Array,
    in_view: Mask,
    reach_px: Array,
    smoothing_px: Array,
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
    alone, lens_px2, in_all = np.zeros(rise.shape, np.bool_), 0.0, 1e-9
    for e in range(edges):
        if reach_px[e] >= MOST_ALONE * widest_px and found[e].any():
            slopes_beside, squared = 0.0, 0.0
            for m in range(points):
                if found[e, m]:
                    alone[e, m] = True
                    slopes_beside += beside[e, m]
                    squared += rise[e, m] * rise[e, m]
            # slopes are bells: a Gaussian's logarithm is a parabola, whose width its top and what is beside it tell
            ratio = min(max(slopes_beside / max(squared, 1e-9), LOW_RATIO), HIGH_RATIO)
            lens_px2 += squared * (STEP_PX**2 / -np.log(ratio) - smoothing_px[e] ** 2)
            in_all += squared
    return found, alone, np.sqrt(max(lens_px2 / in_all, LEAST_LENS_PX**2)), clipped_px


@compiled(GRAY, VECTOR, CUBE, CUBE, VECTOR, FLAGS, INDICES, REAL, VECTOR)
def _seen(
    gray: NDArray[np.uint8],
    of_gray: Array,
    predicted_px: Array,
    normal: Array,
    reach_px: Array,
    facing: Mask,
    rows: NDArray[np.int64],
    search_px: float,
    smoothing_px: Array,
) -> tuple[Array, Mask, Mask, Mask, float, Array]:
    """Return where edges are found through filters of standard deviation ``smoothing_px`` (E,): most of ``Edges``."""
    _, edges, points = predicted_px.shape
    halves = np.ceil((search_px + 3 * smoothing_px) / STEP_PX)
    in_view = _in_view(predicted_px, facing, STEP_PX * halves, gray.shape[0], gray.shape[1])
    ink, paper = np.empty((edges, points)), np.empty((edges, points))
    offset_px, rise, beside = np.empty((edges, points)), np.empty((edges, points)), np.empty((edges, points))
    for e in range(edges):
        half, limit_px = int(halves[e]), WITHIN_REACH * reach_px[e]
        within_px = min(search_px, half * STEP_PX - 3 * smoothing_px[e] + BESIDE_PX)
        kept = int(((limit_px if limit_px < within_px else within_px) + 1e-9) / STEP_PX)
        profiles = _profiles(gray, of_gray, predicted_px, normal, e, half, rows[e])
        ink[e], paper[e] = _extremes(profiles)
        offset_px[e], rise[e], beside[e] = _steepest_rise(_slopes(profiles, _derivative(smoothing_px[e]), kept + 1))
    found, alone, lens_px, clipped_px = _judged(ink, paper, offset_px, rise, beside, in_view, reach_px, smoothing_px)
    for e in range(edges):
        for m in range(points):
            if not found[e, m]:
                offset_px[e, m] = 0.0
    return offset_px, found, in_view, alone, lens_px, clipped_px


@compiled(VECTOR, VECTOR, REAL)
def _rows(length_px: Array, reach_px: Array, search_px: float) -> NDArray[np.int64]:
    """Return in how many rows (E,) points of edges (E,) are looked at."""
    rows = np.ones(len(length_px), np.int64)
    for e in range(len(length_px)):
        if search_px <= CLOSE_PX and reach_px[e] >= ROWS_REACH_PX:
            apart_px = length_px[e] / (ALONG_SHARE * POINTS_PER_EDGE)
            rows[e] = min(max(int(apart_px / ROW_PX), 1), MOST_ROWS)
    return rows


@compiled(CUBE, CUBE, VECTOR, FLAG_MATRIX, INTO_MATRIX)
def _straighten(predicted_px: Array, normal: Array, beside_px: Array, found: Mask, offset_px: Array) -> None:
    """Take off the offsets (E, M) found how far blur along curved edges moves them to the inside of the curve."""
    _, edges, points = predicted_px.shape
    for e in range(edges):
        for m in range(points):
            if found[e, m]:
                k, bend, squared_px = min(max(m, 1), points - 2), 0.0, 1e-9
                for axis in range(2):
                    before, at, after = (
                        predicted_px[axis, e, k - 1],
                        predicted_px[axis, e, k],
                        predicted_px[axis, e, k + 1],
                    )
                    bend += normal[axis, e, k] * (before - 2 * at + after)
                    squared_px += (after - before) ** 2 / 4
                offset_px[e, m] -= beside_px[e] ** 2 / 2 * bend / squared_px


@compiled(VECTOR, REAL)
def _smoothing(reach_px: Array, wanted_px: float) -> Array:
    """Return how wide the filters of edges (E,) are, where neighbours leave room for it as wide as is wanted."""
    smoothing_px = np.empty(len(reach_px))
    for e in range(len(reach_px)):
        smoothing_px[e] = max(min(wanted_px, reach_px[e] / REACH_OF_SMOOTHING), SMOOTHING_PX)
    return smoothing_px


@compiled(GRAY, VECTOR, CUBE, FLAGS, VECTOR, VECTOR, VECTOR, VECTOR, REAL)
def locate(
    gray: NDArray[np.uint8],
    of_gray: Array,
    seen_px: Array,
    facing: Mask,
    to_paper: Array,
    reach: Array,
    spacing: Array,
    outside: Array,
    search_px: float,
) -> Edges:
    """Look for E edges up to ``search_px`` from where their probes are predicted (E, M + 10, 2).

    See ``sampling.Light`` for the image, and ``edges.Template`` for ``to_paper``, ``reach``, ``spacing`` and
    ``outside`` (E,); ``facing`` (5 E,) is which of a few points of each face the viewer.  An edge is never looked for
    beyond its own reach, so that neighbours are not taken for it.  Blurred ones are looked for once more through a
    wider filter, as far as neighbours leave room for it.
    """
    lie = _lie(seen_px, to_paper, reach, spacing, outside)
    predicted, normal, reach_px = lie[0], lie[1], lie[7]
    rows = _rows(lie[2], reach_px, search_px)
    of_lens = CLOSE_SMOOTHING_OF_LENS if search_px <= CLOSE_PX else SMOOTHING_OF_LENS
    smoothing_px = _smoothing(reach_px, of_lens * USUAL_LENS_PX)
    seen = _seen(gray, of_gray, predicted, normal, reach_px, facing, rows, search_px, smoothing_px)
    wider_px = _smoothing(reach_px, of_lens * seen[4])
    if wider_px.max() >= WORTHWHILE * smoothing_px.max():
        smoothing_px = wider_px
        seen = _seen(gray, of_gray, predicted, normal, reach_px, facing, rows, search_px, smoothing_px)
    beside_px = np.sqrt(seen[4] ** 2 + ROW_PX**2 * (rows**2 - 1) / 12)
    _straighten(predicted, normal, beside_px, seen[1], seen[0])
    return Edges(*lie, *seen, smoothing_px, rows, beside_px)
