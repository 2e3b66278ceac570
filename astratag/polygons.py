"""Polygons: which of many contours simplify to convex quads, straight or with bulging sides.

Compiled, because an image has hundreds of contours.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from astratag.compiled import (
    BOOL,
    CUBE,
    INDICES,
    INT,
    INTO_INDICES,
    INTO_MATRIX,
    INTO_VECTOR,
    MATRIX,
    REAL,
    VECTOR,
    compiled,
)
from astratag.simplify import begin_splits, hull, no_splits, simplified, simplified_into, split_further

Array = NDArray[np.float64]

TOLERANCES_A_SIDE = 5.0
"""How many times the tolerance the shortest side must be, or corners are moved by too much of it."""
MOST_POINTS = 12
"""Contours that take more points than this, before those on nearly straight lines are left out, are no quads."""
TINY = 1e-9
LEAST_SINE = 0.1
"""Of the angle at a quad's corner: at a sharper one its sides meet no farther out than at this."""


@compiled(MATRIX)
def _convex(quad: Array) -> bool:
    """Return whether a quad (4, 2) turns the same way at each corner."""
    left = 0
    for i in range(4):
        j, k = (i + 1) % 4, (i + 2) % 4
        turn = (quad[j, 0] - quad[i, 0]) * (quad[k, 1] - quad[j, 1]) - (quad[j, 1] - quad[i, 1]) * (
            quad[k, 0] - quad[j, 0]
        )
        if turn == 0:
            return False
        left += turn > 0
    return left == 0 or left == 4


@compiled(MATRIX)
def _shortest(quad: Array) -> float:
    """Return how long the shortest side of a quad (4, 2) is."""
    shortest = np.inf
    for i in range(4):
        j = (i + 1) % 4
        shortest = min(shortest, math.hypot(quad[j, 0] - quad[i, 0], quad[j, 1] - quad[i, 1]))
    return shortest


@compiled(MATRIX)
def _length(polygon: Array) -> float:
    """Return the perimeter of a polygon (N, 2)."""
    length, before = 0.0, polygon[-1]
    for point in polygon:
        length += math.hypot(point[0] - before[0], point[1] - before[1])
        before = point
    return length


@compiled(MATRIX, REAL, VECTOR, BOOL, INTO_INDICES, INTO_VECTOR, INTO_MATRIX, INTO_MATRIX)
def _convex_quad(
    contour: Array,
    perimeter: float,
    tolerances: Array,
    whole: bool,
    splits: NDArray[np.int64],
    off: Array,
    polygon: Array,
    best: Array,
) -> bool:
    """Return whether a contour (N, 2) simplifies to a convex quad, and write it into ``best`` (4, 2); see below."""
    finest, too_fine, too_coarse = np.inf, 0.0, np.inf
    begin_splits(contour, splits, off)
    for tolerance in tolerances:
        if not too_fine < tolerance < too_coarse:
            continue
        count = split_further(contour, splits, off, polygon, tolerance * perimeter)
        if count > MOST_POINTS:
            too_fine = tolerance
        elif count < 4:
            too_coarse = tolerance
        quad = polygon[:4]
        if count != 4 or not _convex(quad):
            continue
        bearable = whole or _shortest(quad) >= TOLERANCES_A_SIDE * tolerance * perimeter
        if bearable or tolerance < finest:
            best[:] = quad
            finest = tolerance
        if bearable:
            break
    return finest < np.inf


@compiled(MATRIX, INDICES, VECTOR, VECTOR, BOOL, INT)
def convex_quads(
    points: Array, starts: NDArray[np.int64], perimeters: Array, tolerances: Array, whole: bool, most_hulls: int
) -> tuple[NDArray[np.bool_], Array]:
    """Return which contours simplify to a convex quad (N,) at a tolerance that its sides bear, and the quads (N, 4, 2).

    Else their hulls, of the first ``most_hulls`` that do not.  Contour i runs through ``points`` (P, 2) from ``starts``
    (N + 1,) i on.  ``tolerances`` are fractions of perimeters.  One not much smaller than a skinny quad's short sides
    moves its corners along the long ones: the first that is small enough counts, or the first at all of a ``whole``
    square; else the finest that gives a quad.
    """
    count = len(perimeters)
    found, quads, hulls = np.zeros(count, dtype=np.bool_), np.zeros((count, 4, 2)), 0
    splits, off, polygon = no_splits(np.diff(starts).max() if count > 0 else 0, MOST_POINTS)
    for i in range(count):
        contour = points[starts[i] : starts[i + 1]]
        found[i] = _convex_quad(contour, perimeters[i], tolerances, whole, splits, off, polygon, quads[i])
        if not found[i] and hulls < most_hulls:
            hulls += 1
            around = hull(contour)
            if 4 <= len(around) < len(contour):
                found[i] = _convex_quad(around, _length(around), tolerances, whole, splits, off, polygon, quads[i])
    return found, quads


@compiled(MATRIX, REAL, INT, INT, INT, REAL)
def _uncut(contour: Array, tolerance: float, most_vertices: int, width: int, height: int, border: float) -> Array:
    """Return the convex quad (4, 2) that an image's border cut corners off, else an empty one (0, 2); see below."""
    polygon, none = simplified(hull(contour), tolerance, most_vertices), np.empty((0, 2))
    count, sides = len(polygon), 0
    if not 4 < count <= most_vertices:
        return none
    starts, along = np.empty((4, 2)), np.empty((4, 2))
    for i in range(count):
        j = (i + 1) % count
        if (
            max(polygon[i, 0], polygon[j, 0]) <= border
            or max(polygon[i, 1], polygon[j, 1]) <= border
            or min(polygon[i, 0], polygon[j, 0]) >= width - 1 - border
            or min(polygon[i, 1], polygon[j, 1]) >= height - 1 - border
        ):
            continue
        if sides == 4:
            return none
        starts[sides], along[sides] = polygon[i], polygon[j] - polygon[i]
        sides += 1
    if sides < 4:
        return none
    quad, left = np.empty((4, 2)), 0
    for i in range(4):
        before = (i + 3) % 4
        (ux, uy), (vx, vy), (dx, dy) = along[before], along[i], starts[i] - starts[before]
        turned = ux * vy - uy * vx
        if turned == 0:
            return none
        left += turned > 0
        quad[i] = starts[before] + along[before] * ((dx * vy - dy * vx) / turned)
    return quad if left == 0 or left == 4 else none


@compiled(MATRIX, INDICES, VECTOR, INT, INT, REAL, REAL, INT, INT)
def uncut_quads(
    points: Array,
    starts: NDArray[np.int64],
    perimeters: Array,
    width: int,
    height: int,
    border: float,
    tolerance: float,
    most_vertices: int,
    most: int,
) -> tuple[NDArray[np.bool_], Array]:
    """Return which contours are convex quads that an image's border cut corners off (N,), and these whole (N, 4, 2).

    Contours are given as to ``convex_quads``, in an image of ``width`` and ``height``.  Those within ``border`` of its
    border are cut; the first ``most`` of them are looked at.
    """
    count = len(perimeters)
    found, quads, cut = np.zeros(count, dtype=np.bool_), np.zeros((count, 4, 2)), 0
    for i in range(count):
        contour = points[starts[i] : starts[i + 1]]
        low = min(contour[:, 0].min(), contour[:, 1].min())
        high = max(contour[:, 0].max() - width, contour[:, 1].max() - height) + 1
        if low > border and high < -border:
            continue
        if cut == most:
            break
        cut += 1
        quad = _uncut(contour, tolerance * perimeters[i], most_vertices, width, height, border)
        if len(quad) > 0:
            found[i], quads[i] = True, quad
    return found, quads


@compiled(MATRIX, REAL)
def grown(quad: Array, outset: float) -> Array:
    """Return a clockwise quad (4, 2) with each side moved out."""
    along, at = np.empty((4, 2)), np.empty((4, 2))
    for i in range(4):
        dx, dy = quad[(i + 1) % 4, 0] - quad[i, 0], quad[(i + 1) % 4, 1] - quad[i, 1]
        length = max(math.sqrt(dx * dx + dy * dy), TINY)
        along[i, 0], along[i, 1] = dx / length, dy / length
    for i in range(4):
        sine = along[i - 1, 0] * along[i, 1] - along[i - 1, 1] * along[i, 0]
        for axis in range(2):
            at[i, axis] = quad[i, axis] + outset * (along[i - 1, axis] - along[i, axis]) / max(sine, LEAST_SINE)
    return at


@compiled(CUBE, REAL, REAL)
def clockwise(quads: Array, least_side: float, outset: float) -> Array:
    """Return quads (Q, 4, 2) clockwise and each side moved out, without those that have a shorter side."""
    kept, count = np.empty(quads.shape), 0
    for q in range(len(quads)):
        quad = quads[q]
        if _shortest(quad) < least_side:
            continue
        across = (quad[2, 0] - quad[0, 0]) * (quad[3, 1] - quad[1, 1])
        turned = across < (quad[2, 1] - quad[0, 1]) * (quad[3, 0] - quad[1, 0])
        for i in range(4):
            kept[count, i] = quad[3 - i if turned else i]
        kept[count] = grown(kept[count], outset)
        count += 1
    return kept[:count].copy()


@compiled(VECTOR, VECTOR)
def turn(before: Array, after: Array) -> float:
    """Return by how many radians one vector (2,) is turned clockwise in the image from another."""
    return math.atan2(before[0] * after[1] - before[1] * after[0], before[0] * after[0] + before[1] * after[1])


@compiled(MATRIX)
def _turns(polygon: Array) -> Array:
    """Return by how many radians a polygon (N, 2) turns clockwise in the image at each point (N,)."""
    count = len(polygon)
    turns = np.empty(count)
    for i in range(count):
        turns[i] = turn(polygon[i] - polygon[i - 1], polygon[(i + 1) % count] - polygon[i])
    return turns


@compiled(MATRIX, MATRIX)
def _bulge(contour: Array, corners: Array) -> tuple[Array, Array]:
    """Return four points of a clockwise contour (N, 2) in its order, and the bulges (4, 2) of the sides between.

    How far, outwards, the middle of the parabola lies that fits a side best.
    """
    count, places = len(contour), np.zeros(4, dtype=np.int64)
    for i in range(4):
        while contour[places[i], 0] != corners[i, 0] or contour[places[i], 1] != corners[i, 1]:
            places[i] += 1
    places.sort()
    ordered, bulges = contour[places], np.empty((4, 2))
    for i in range(4):
        dx, dy = ordered[(i + 1) % 4] - ordered[i]
        chord = math.hypot(dx, dy)
        off, weight = 0.0, 0.5
        for k in range(places[i], places[i + 1] if i < 3 else places[0] + count):
            x, y = contour[k % count] - ordered[i]
            along = (x * dx + y * dy) / (chord * chord)
            profile = 4 * along * (1 - along)
            off += profile * (x * dy - y * dx) / chord
            weight += profile * profile
        bulges[i, 0], bulges[i, 1] = off / weight * dy / chord, -off / weight * dx / chord
    return ordered, bulges


@compiled(MATRIX, INDICES, VECTOR, REAL, INT, REAL, REAL, REAL)
def bent_quads(
    points: Array,
    starts: NDArray[np.int64],
    perimeters: Array,
    tolerance: float,
    most_vertices: int,
    least_turn: float,
    least_side: float,
    outset: float,
) -> tuple[NDArray[np.bool_], Array, Array]:
    """Return which counter-clockwise contours have four corners (N,), these (N, 4, 2), and the sides' bulges (N, 4, 2).

    Contours are given as to ``convex_quads``.  Simplified to 4 to ``most_vertices`` points, the four where they turn
    most are corners; the sides between these are moved out.
    """
    count = len(perimeters)
    found, corners, bulges = np.zeros(count, dtype=np.bool_), np.zeros((count, 4, 2)), np.zeros((count, 4, 2))
    splits, off, room = no_splits(np.diff(starts).max() if count > 0 else 0, 2 * most_vertices)
    for i in range(count):
        contour = points[starts[i] : starts[i + 1]]
        vertices = simplified_into(contour, splits, off, room, tolerance * perimeters[i])
        if not 4 <= vertices <= most_vertices:
            continue
        polygon = room[:vertices][::-1].copy()
        turns = _turns(polygon)
        if (turns >= least_turn).sum() < 4:
            continue
        four = polygon[np.sort(np.argsort(-turns, kind="mergesort")[:4])]
        if _shortest(four) >= least_side:
            found[i] = True
            ordered, bulges[i] = _bulge(contour[::-1].copy(), four)
            corners[i] = grown(ordered, outset)
    return found, corners, bulges
