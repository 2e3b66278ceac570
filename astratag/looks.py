"""Looks: what points of a print look like through a warp and a blur, as sums over what is around them.  Compiled.

See ``synthesis``.  A point's looks are black 0 to white 1.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from astratag.compiled import CUBE, INDEX, INT, LIGHT, MATRIX, REAL, SINGLE, compiled
from astratag.geometry import QUIET_MARGIN, TEMPLATE_UNITS

Array = NDArray[np.float64]
Light = NDArray[np.float32]

MEAN, BY_X, BY_Y, BY_BLUR, AROUND = range(5)
"""Rows of looks: brightness, its derivatives by pixels and by the logarithm of the blur, and the share of what a point
sees that is beyond the print."""
LOOKS = AROUND + 1
OUTSIDE = 0.3
"""How far beyond the black square pictures of a print reach, as a fraction of its side."""
MARGIN = QUIET_MARGIN
"""How far beyond it they are print."""
SOFT_REACH = 4.0
"""How many times its softness a blurred picture's edge is seen at most."""
HAIR = 1e-3
"""What is beyond a picture lies so many texels before its last one, so that there is always a next."""
LEAST_REST = 0.02
"""Fraction of the blur's variance that is always left to the nodes."""
TINY = 1e-9


@compiled(MATRIX, REAL)
def _axes(to_template: Array, blur_px: float) -> tuple[float, float, float, float]:
    """Return the variances of a blur on the print along the axis it is longest in, and across; and that axis.

    ``to_template`` (2, 2) takes pixels there.
    """
    (ax, ay), (bx, by) = (to_template[0, 0], to_template[0, 1]), (to_template[1, 0], to_template[1, 1])
    square_px = blur_px * blur_px
    cxx, cxy, cyy = square_px * (ax * ax + ay * ay), square_px * (ax * bx + ay * by), square_px * (bx * bx + by * by)
    middle, half, area = (cxx + cyy) / 2, (cxx - cyy) / 2, square_px * (ax * by - ay * bx)
    apart = math.sqrt(half * half + cxy * cxy)
    longest = middle + apart
    x, y = (half + apart, cxy) if half >= 0 else (abs(cxy), math.copysign(apart - half, cxy))
    length = math.sqrt(x * x + y * y)
    if length < TINY * longest:
        return longest, longest, 1.0, 0.0
    return longest, area * area / longest, x / length, y / length


@compiled(REAL, REAL)
def _rest(variance: float, softness: float) -> float:
    """Return what standard deviation a picture's softness leaves of a blur's variance."""
    return math.sqrt(max(variance - softness * softness, LEAST_REST * variance))


@compiled(SINGLE, INT)
def _texel(x: np.float32, size: int) -> tuple[np.uint32, np.float32]:
    """Return the texel, of ``size``, that is before a place, and how far the place is from there to the next.

    Unsigned, so that it is not looked at for being negative.
    """
    last = np.float32(size - 1 - HAIR)
    x = x if x > 0 else np.float32(0)
    x = x if x < last else last
    before = np.int32(x)
    return np.uint32(before), x - np.float32(before)


@compiled(LIGHT, INDEX, INDEX, SINGLE, SINGLE)
def _mixed(picture: Light, row: np.uint32, column: np.uint32, down: np.float32, right: np.float32) -> np.float32:
    """Return a picture between a texel and the next ones."""
    next_row, next_column = np.uint32(row + np.uint32(1)), np.uint32(column + np.uint32(1))
    left, upper = picture[row, column], picture[row, next_column]
    left += down * (picture[next_row, column] - left)
    upper += down * (picture[next_row, next_column] - upper)
    return left + right * (upper - left)


@compiled(LIGHT, LIGHT, LIGHT, LIGHT)
def _sums(picture: Light, spreads: Light, nodes: Light, moments: Light) -> Light:
    """Return moments (M, K) of a picture at nodes (K, 2) around each of N points: (M, N).

    ``spreads`` (6, N) are texels: x and y, and the axes along and across which the nodes are spread.  Points go in
    the inner loops, and in single precision, so that they become vector instructions.
    """
    count = spreads.shape[1]
    sums, seen = np.zeros((len(moments), count), dtype=np.float32), np.empty(count, dtype=np.float32)
    for k in range(len(nodes)):
        u, v = nodes[k, 0], nodes[k, 1]
        for n in range(count):
            x = spreads[0, n] + spreads[2, n] * u + spreads[4, n] * v
            y = spreads[1, n] + spreads[3, n] * u + spreads[5, n] * v
            column, right = _texel(x, picture.shape[1])
            row, down = _texel(y, picture.shape[0])
            seen[n] = _mixed(picture, row, column, down, right)
        for m in range(len(moments)):
            to, moment = sums[m], moments[m, k]
            for n in range(count):
                to[n] += moment * seen[n]
    return sums


@compiled(LIGHT, REAL, REAL, INT)
def _near_end(spreads: Light, far: float, soft: float, size: int) -> NDArray[np.int64]:
    """Return which of N points (M,) see more than the print, whose margin ends ``MARGIN`` beyond the black square.

    ``spreads`` (6, N) as in ``_sums``, with nodes as ``far`` as that; ``soft`` is how far the picture, of ``size``
    texels, is blurred: all in texels.
    """
    near, count = np.empty(spreads.shape[1], dtype=np.int64), 0
    low = (OUTSIDE - MARGIN) / (1 + 2 * OUTSIDE) * size + soft
    for n in range(len(near)):
        across = far * math.sqrt(spreads[2, n] ** 2 + spreads[4, n] ** 2)
        down = far * math.sqrt(spreads[3, n] ** 2 + spreads[5, n] ** 2)
        x, y = spreads[0, n], spreads[1, n]
        if min(x, size - 1 - x) - across < low or min(y, size - 1 - y) - down < low:
            near[count] = n
            count += 1
    return near[:count]


@compiled(MATRIX, CUBE, LIGHT, LIGHT, REAL, REAL, REAL, LIGHT, LIGHT)
def looks(
    template: Array,
    to_template: Array,
    brightness: Light,
    beyond: Light,
    softness: float,
    texel: float,
    blur_px: float,
    nodes: Light,
    moments: Light,
) -> Array:
    """Return what points (N, 2) should look like (5, N): by sums over nodes (K, 2) around each, ``moments`` (5, K).

    ``brightness`` and ``beyond`` (H, W) are the print, and what is no longer the print, blurred by ``softness``, a
    texel every ``texel`` template units.
    """
    count = len(template)
    rows, spreads = np.empty((LOOKS, count)), np.empty((6, count), dtype=np.float32)
    for n in range(count):
        longest, shortest, c, s = _axes(to_template[n], blur_px)
        along, across = _rest(longest, softness) / texel, _rest(shortest, softness) / texel
        spreads[0, n] = (template[n, 0] + OUTSIDE * TEMPLATE_UNITS) / texel - 0.5
        spreads[1, n] = (template[n, 1] + OUTSIDE * TEMPLATE_UNITS) / texel - 0.5
        spreads[2, n], spreads[3, n], spreads[4, n], spreads[5, n] = c * along, s * along, -s * across, c * across
    far = 0.0
    for k in range(len(nodes)):
        far = max(far, math.sqrt(nodes[k, 0] ** 2 + nodes[k, 1] ** 2))
    near = _near_end(spreads, far, SOFT_REACH * softness / texel + 1, len(beyond))
    rows[AROUND] = 0.0
    if len(near) > 0:
        rows[AROUND, near] = _sums(beyond, np.ascontiguousarray(spreads[:, near]), nodes, moments[:1])[0]
    sums = _sums(brightness, spreads, nodes, moments)
    for n in range(count):
        longest, shortest, c, s = _axes(to_template[n], blur_px)
        along, across = _rest(longest, softness), _rest(shortest, softness)
        ahead, aside = sums[1, n] / along, sums[2, n] / across  # derivatives on the print, along the axes
        x, y = c * ahead - s * aside, s * ahead + c * aside
        rows[MEAN, n] = sums[0, n]
        rows[BY_X, n] = x * to_template[n, 0, 0] + y * to_template[n, 1, 0]
        rows[BY_Y, n] = x * to_template[n, 0, 1] + y * to_template[n, 1, 1]
        rows[BY_BLUR, n] = longest / along**2 * sums[3, n] + shortest / across**2 * sums[4, n]
    return rows
