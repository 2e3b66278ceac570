"""Polygons: which of many contours simplify to convex quads, straight or with bulging sides.

Compiled, because an image has hundreds of contours, and each is simplified at several tolerances.
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

Array = NDArray[np.float64]

TOLERANCES_A_SIDE = 5.0
"""How many times the tolerance the shortest side must be, or corners are moved by too much of it."""
MOST_POINTS = 12
"""Contours that take more points than this, before those on nearly straight lines are left out, are no quads."""
FARTHEST_ROUNDS = 3
"""How often the point farthest from the one before is looked for, to find two that are far apart."""
BEGIN, END, AT, PARTS, COUNT, STACK = range(6)
"""What is known of a part of a contour: from which of its points to which, where it leads farthest off a line, and its
two parts; of the first, how many parts there are.  In the last column are those that are still to be looked at."""
NOT_KNOWN = -1.0
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


@compiled(INTO_MATRIX, INT, REAL)
def _cleaned(kept: Array, count: int, squared: float) -> int:
    """Leave points nearly on the line of their neighbours out of the first ``count`` of a polygon (N, 2).

    Return how many are left, which are the first then.
    """
    left = count
    before, write, read = count - 1, 0, 1 % count
    sx, sy = kept[before]
    x, y = kept[0]
    i = 0
    while i < count and left > 2:
        ex, ey = kept[read]
        read = (read + 1) % count
        dx, dy = ex - sx, ey - sy
        off = abs((x - sx) * dy - (y - sy) * dx)
        onwards = (x - sx) * (ex - x) + (y - sy) * (ey - y) >= 0
        if off * off <= 0.5 * squared * (dx * dx + dy * dy) and dx != 0 and dy != 0 and onwards:
            left -= 1
            sx, sy = ex, ey
            kept[write, 0], kept[write, 1] = sx, sy
            x, y = kept[read]
            read = (read + 1) % count
            i += 2
        else:
            sx, sy = x, y
            kept[write, 0], kept[write, 1] = sx, sy
            x, y = ex, ey
            i += 1
        write = (write + 1) % count
    return left


@compiled(MATRIX)
def _far_apart(contour: Array) -> tuple[int, int, float]:
    """Return two points of a contour (N, 2) that are far apart, and how far, squared: where its polygon begins."""
    start, farthest, squared = 0, 0, 0.0
    for _ in range(FARTHEST_ROUNDS):
        start, squared = farthest, 0.0
        x, y = contour[start]
        for half in range(2):  # from the start on around it: of points as far the first counts
            for k in range(start + 1, len(contour)) if half == 0 else range(start):
                apart = (contour[k, 0] - x) ** 2 + (contour[k, 1] - y) ** 2
                if apart > squared:
                    squared, farthest = apart, k
    return start, farthest, squared


@compiled(MATRIX, INT, INT)
def _farthest_off(contour: Array, begin: int, end: int) -> tuple[float, int]:
    """Return how far a contour (N, 2) leads off the line between two of its points, times their distance, and where."""
    x, y = contour[begin]
    dx, dy = contour[end, 0] - x, contour[end, 1] - y
    off, at = 0.0, begin
    stop = end if end > begin else len(contour)
    for half in range(2):
        for k in range(begin + 1, stop) if half == 0 else range(0 if end <= begin else end, end):
            distance = abs((contour[k, 1] - y) * dx - (contour[k, 0] - x) * dy)
            if distance > off:
                off, at = distance, k
    return off, at


@compiled(INT, INT)
def no_splits(points: int, most: int) -> tuple[NDArray[np.int64], Array, Array]:
    """Return room for how a contour of so many points is split, and for a polygon of ``most``; see ``_simplified``."""
    return np.empty((2 * points + 4, 6), dtype=np.int64), np.empty(2 * points + 4), np.empty((most + 1, 2))


@compiled(INT, INT, INTO_INDICES, INTO_VECTOR)
def _begin_splits(start: int, other: int, splits: NDArray[np.int64], off: Array) -> None:
    """Begin with the two parts of a contour between two points of it."""
    for k in range(2):
        splits[k, BEGIN], splits[k, END] = (start, other) if k == 0 else (other, start)
        splits[k, PARTS], off[k] = 0, NOT_KNOWN
    splits[0, COUNT] = 2


@compiled(MATRIX, INTO_INDICES, INTO_VECTOR, INTO_MATRIX, REAL)
def _simplified(contour: Array, splits: NDArray[np.int64], off: Array, polygon: Array, tolerance: float) -> int:
    """Do as ``simplified_into`` once the first splits are made.

    Where it is split does not depend on the tolerance: what was found out at one serves the next, and it is split
    further where that is needed.  Part k leads ``off`` (K,) k, times its length, off a straight line, at a point; it is
    split there into two parts from ``PARTS`` on.  Room is given by the caller, for there are hundreds of contours.
    """
    splits[0, STACK], splits[1, STACK] = 1, 0
    top, size = 2, 0
    while top > 0:
        top -= 1
        k = splits[top, STACK]
        begin, end = splits[k, BEGIN], splits[k, END]
        if off[k] == NOT_KNOWN:
            off[k], splits[k, AT] = _farthest_off(contour, begin, end)
        x, y = contour[begin]
        dx, dy = contour[end, 0] - x, contour[end, 1] - y
        if off[k] * off[k] <= tolerance * tolerance * (dx * dx + dy * dy):
            polygon[size, 0], polygon[size, 1] = x, y
            size += 1
            if size == len(polygon):
                return size
            continue
        parts = splits[k, PARTS]
        if parts == 0:
            parts, at = splits[0, COUNT], splits[k, AT]
            splits[k, PARTS], splits[0, COUNT] = parts, parts + 2
            splits[parts, BEGIN], splits[parts, END], splits[parts, PARTS] = begin, at, 0
            splits[parts + 1, BEGIN], splits[parts + 1, END], splits[parts + 1, PARTS] = at, end, 0
            off[parts] = off[parts + 1] = NOT_KNOWN
        splits[top, STACK], splits[top + 1, STACK] = parts + 1, parts
        top += 2
    return _cleaned(polygon, size, tolerance * tolerance)


@compiled(MATRIX, INTO_INDICES, INTO_VECTOR, INTO_MATRIX, REAL)
def simplified_into(contour: Array, splits: NDArray[np.int64], off: Array, polygon: Array, tolerance: float) -> int:
    """Write what ``simplified`` returns into a polygon (M + 1, 2); return how many points it has.

    Room is of ``no_splits``.
    """
    start, other, squared = _far_apart(contour)
    if squared <= tolerance * tolerance:
        polygon[0] = contour[start]
        return 1
    _begin_splits(start, other, splits, off)
    return _simplified(contour, splits, off, polygon, tolerance)


@compiled(MATRIX, REAL, INT)
def simplified(contour: Array, tolerance: float, most: int) -> Array:
    """Return the polygon (M, 2) that a closed contour (N, 2) stays within a tolerance of.

    One that takes more than ``most`` points is given up: what comes back has more than a few, and means nothing.

    Ramer, "An iterative procedure for the polygonal approximation of plane curves", 1972; Douglas and Peucker, 1973.
    Begun, ordered and cleaned of points on nearly straight lines as OpenCV's ``approxPolyDP`` does.
    """
    splits, off, polygon = no_splits(len(contour), most)
    return polygon[: simplified_into(contour, splits, off, polygon, tolerance)]


@compiled(MATRIX)
def hull(contour: Array) -> Array:
    """Return the convex hull (M, 2), clockwise in the image, of pixels (N, 2): whole numbers."""
    top, bottom = int(contour[:, 1].min()), int(contour[:, 1].max())
    rows = bottom - top + 1
    left, right = np.full(rows, np.inf), np.full(rows, -np.inf)
    for x, y in contour:
        row = int(y) - top
        left[row], right[row] = min(left[row], x), max(right[row], x)
    around = np.empty((2 * rows, 2))
    count = 0
    for half in range(2):
        first = max(count - 1, 0)
        for step in range(rows):
            row = rows - 1 - step if half else step
            x, y = left[row] if half else right[row], float(row + top)
            if abs(x) == np.inf:
                continue
            while count >= first + 2:
                ax, ay = around[count - 1, 0] - around[count - 2, 0], around[count - 1, 1] - around[count - 2, 1]
                if ax * (y - around[count - 2, 1]) - ay * (x - around[count - 2, 0]) > 0:
                    break
                count -= 1
            if count == 0 or around[count - 1, 0] != x or around[count - 1, 1] != y:
                around[count, 0], around[count, 1] = x, y
                count += 1
    if count > 1 and around[0, 0] == around[count - 1, 0] and around[0, 1] == around[count - 1, 1]:
        count -= 1
    return around[:count].copy()


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
    start, other, _ = _far_apart(contour)
    _begin_splits(start, other, splits, off)
    for tolerance in tolerances:
        if not too_fine < tolerance < too_coarse:
            continue
        count = _simplified(contour, splits, off, polygon, tolerance * perimeter)
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
