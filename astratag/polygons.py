"""Polygons: how large many contours are, and which of them simplify to convex quads.

Compiled, because an image has hundreds of contours, and each is simplified at several tolerances.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from astratag.compiled import BOOL, CUBE, INDICES, INT, MATRIX, REAL, VECTOR, compiled

Array = NDArray[np.float64]

TOLERANCES_A_SIDE = 5.0
"""How many times the tolerance the shortest side must be, or corners are moved by too much of it."""
FARTHEST_ROUNDS = 3
"""How often the point farthest from the one before is looked for, to find two that are far apart."""
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


@compiled(MATRIX, INT, REAL)
def _cleaned(polygon: Array, count: int, squared: float) -> Array:
    """Return the first ``count`` points of a polygon (N, 2) without those nearly on the line of their neighbours."""
    kept, left = polygon[:count].copy(), count
    before, write, read = count - 1, 0, 1 % count
    sx, sy = polygon[before]
    x, y = polygon[0]
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
    return kept[:left].copy()


@compiled(MATRIX, REAL)
def simplified(contour: Array, tolerance: float) -> Array:
    """Return the polygon (M, 2) that a closed contour (N, 2) stays within a tolerance of.

    Ramer, "An iterative procedure for the polygonal approximation of plane curves", 1972; Douglas and Peucker, 1973.
    Begun, ordered and cleaned of points on nearly straight lines as OpenCV's ``approxPolyDP`` does.
    """
    count, squared = len(contour), tolerance * tolerance
    polygon = np.empty((count, 2))
    start, ahead, farthest = 0, 0, 0.0
    for _ in range(FARTHEST_ROUNDS):
        start, farthest = (start + ahead) % count, 0.0
        for j in range(1, count):
            k = (start + j) % count
            apart = (contour[k, 0] - contour[start, 0]) ** 2 + (contour[k, 1] - contour[start, 1]) ** 2
            if apart > farthest:
                farthest, ahead = apart, j
    if farthest <= squared:
        return contour[start : start + 1].copy()
    other = (start + ahead) % count
    stack = np.empty((count + 2, 2), dtype=np.int64)
    stack[0, 0], stack[0, 1], stack[1, 0], stack[1, 1] = other, start, start, other
    top, size = 2, 0
    while top > 0:
        top -= 1
        begin, end = stack[top]
        x, y = contour[begin]
        dx, dy = contour[end, 0] - x, contour[end, 1] - y
        off, at = 0.0, begin
        k = (begin + 1) % count
        while k != end:
            distance = abs((contour[k, 1] - y) * dx - (contour[k, 0] - x) * dy)
            if distance > off:
                off, at = distance, k
            k = (k + 1) % count
        if off * off <= squared * (dx * dx + dy * dy):
            polygon[size, 0], polygon[size, 1] = x, y
            size += 1
        else:
            stack[top, 0], stack[top, 1], stack[top + 1, 0], stack[top + 1, 1] = at, end, begin, at
            top += 2
    return _cleaned(polygon, size, squared)


@compiled(MATRIX, INDICES, VECTOR, VECTOR, BOOL)
def convex_quads(
    points: Array, starts: NDArray[np.int64], perimeters: Array, tolerances: Array, whole: bool
) -> tuple[NDArray[np.bool_], Array]:
    """Return which contours simplify to a convex quad (N,) at a tolerance that its sides bear, and the quads (N, 4, 2).

    Contour i runs through ``points`` (P, 2) from ``starts`` (N + 1,) i on.  ``tolerances`` are fractions of perimeters.
    One not much smaller than a skinny quad's short sides moves its corners along the long ones: the first that is
    small enough counts, or the first at all of a ``whole`` square; else the finest that gives a quad.
    """
    count = len(perimeters)
    found, quads = np.zeros(count, dtype=np.bool_), np.zeros((count, 4, 2))
    for i in range(count):
        contour, finest = points[starts[i] : starts[i + 1]], np.inf
        for tolerance in tolerances:
            polygon = simplified(contour, tolerance * perimeters[i])
            if len(polygon) != 4 or not _convex(polygon):
                continue
            bearable = whole or _shortest(polygon) >= TOLERANCES_A_SIDE * tolerance * perimeters[i]
            if bearable or tolerance < finest:
                found[i], finest = True, tolerance
                quads[i] = polygon
            if bearable:
                break
    return found, quads


@compiled(MATRIX, INDICES)
def sizes(points: Array, starts: NDArray[np.int64]) -> tuple[Array, Array]:
    """Return the areas, negative of holes, and the perimeters (N,) of contours.

    Contour i runs through ``points`` (P, 2) from ``starts`` (N + 1,) i on.
    """
    count = len(starts) - 1
    area, perimeter = np.zeros(count), np.zeros(count)
    for i in range(count):
        x, y = points[starts[i + 1] - 1]
        for n in range(starts[i], starts[i + 1]):
            next_x, next_y = points[n]
            area[i] += (next_x * y - next_y * x) / 2
            perimeter[i] += math.sqrt((next_x - x) ** 2 + (next_y - y) ** 2)
            x, y = next_x, next_y
    return area, perimeter


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
