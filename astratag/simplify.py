"""Simplifying: contours as polygons that stay within a tolerance of them, and their convex hulls.

Compiled, because an image has hundreds of contours, and each is simplified at several tolerances.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from astratag.compiled import INT, INTO_INDICES, INTO_MATRIX, INTO_VECTOR, MATRIX, REAL, compiled

Array = NDArray[np.float64]

FARTHEST_ROUNDS = 3
"""How often the point farthest from the one before is looked for, to find two that are far apart."""
BEGIN, END, AT, PARTS, COUNT, STACK = range(6)
"""What is known of a part of a contour: from which of its points to which, where it leads farthest off a line, and its
two parts; of the first, how many parts there are.  In the last column are those that are still to be looked at."""
NOT_KNOWN = -1.0


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
    """Return room for how a contour of so many points is split, and for a polygon of ``most``."""
    return np.empty((2 * points + 4, 6), dtype=np.int64), np.empty(2 * points + 4), np.empty((most + 1, 2))


@compiled(MATRIX, INTO_INDICES, INTO_VECTOR)
def begin_splits(contour: Array, splits: NDArray[np.int64], off: Array) -> float:
    """Begin with the two parts of a contour between two points that are far apart; return how far, squared."""
    start, other, squared = _far_apart(contour)
    for k in range(2):
        splits[k, BEGIN], splits[k, END] = (start, other) if k == 0 else (other, start)
        splits[k, PARTS], off[k] = 0, NOT_KNOWN
    splits[0, COUNT] = 2
    return squared


@compiled(MATRIX, INTO_INDICES, INTO_VECTOR, INTO_MATRIX, REAL)
def split_further(contour: Array, splits: NDArray[np.int64], off: Array, polygon: Array, tolerance: float) -> int:
    """Do as ``simplified_into`` once the first splits are begun with.

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
    if begin_splits(contour, splits, off) <= tolerance * tolerance:
        polygon[0] = contour[splits[0, BEGIN]]
        return 1
    return split_further(contour, splits, off, polygon, tolerance)


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
