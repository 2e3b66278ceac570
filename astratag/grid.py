"""Where a print lies in the image, point by point of a grid on it, and how it is seen there."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
from numpy.typing import NDArray

from astratag.compiled import CUBE, FLAGS, INT, MATRIX, REAL, compiled
from astratag.geometry import SQUARES, TEMPLATE_UNITS
from astratag.normal import ranked
from astratag.warp import FittedWarp

Array = NDArray[np.float64]
Seen = NDArray[np.bool_]
Seeing = tuple[Seen, Array, Array, Array]

REACH, LAYER_REACH = 0.07, 0.13
"""How far beyond the black square the print is looked at, as a fraction of its side; and to tell layers apart by."""
SPACING_PX = 0.8
MOST_LINES, FINE_LINES, MOST_AT_A_GLANCE, FEWEST_LINES = 32, 64, 20, 12
"""Grid lines across the print: so many that they are ``SPACING_PX`` apart where it looks widest, within bounds.

Coarser ones find where a print is and how blurred; finer ones then measure it.
"""
MOST_SHIFT_PX = 0.03
"""Where a blur moves what is seen by more, the print bends away too fast for its looks to be known."""
HALF_UNIT = 0.5
"""How far derivatives by place reach, template units."""
FEWEST_POINTS = 60
SOFTNESS = tuple(2.0 * 2 ** (k / 2) for k in range(12))
"""Blurs of pictures that are kept, template units, and"""
SOFT_SHARE = 0.85
"""how much of the blur where it is least they may be: the rest is summed over nodes."""


@cache
def _grid(lines: int, reach: float) -> tuple[Array, Array]:
    """Return template points (lines^2, 2), and them and two neighbours half a unit on (3 lines^2, 2)."""
    span = np.linspace(-reach, 1 + reach, lines) * TEMPLATE_UNITS
    points = np.stack(np.meshgrid(span, span), axis=-1).reshape(-1, 2)
    stencil = np.concatenate([points, points + (HALF_UNIT, 0.0), points + (0.0, HALF_UNIT)])
    points.flags.writeable = stencil.flags.writeable = False  # so that warps may keep where they are on a surface
    return points, stencil


@dataclass(frozen=True, eq=False)
class Look:
    """Where and how a print is seen through one warp: N points of it in the image.

    ``template`` (N, 2) and ``at_px`` (N, 2) are the points; ``to_template`` (N, 2, 2) takes pixels to template units
    there; ``weight`` (N,) is how many pixels each stands for, at most one.
    """

    template: Array
    at_px: Array
    to_template: Array
    weight: Array

    @cached_property
    def units(self) -> tuple[float, float]:
        """Return the template units of a pixel the ways it has fewest and most: a tenth of points have fewer, more."""
        return _units(self.to_template)

    def softness(self, blur_px: float) -> float:
        """Return the softest of ``SOFTNESS`` that a picture may have to be seen through a blur, 0 for a sharp one."""
        limit = SOFT_SHARE * blur_px * self.units[0]
        return max((softness for softness in SOFTNESS if softness <= limit), default=0.0)


def widest_px(warp: FittedWarp) -> float:
    """Return how long the longest side of a print looks, at least a pixel."""
    p0, p1, p2, p3 = warp(SQUARES[0]).tolist()
    return max(math.dist(p0, p1), math.dist(p1, p2), math.dist(p2, p3), math.dist(p3, p0), 1.0)


def lines_across(warp: FittedWarp, most: int, reach: float = REACH) -> int:
    """Return how many grid lines, at most so many, are laid across a print and ``reach`` sides around it."""
    return int(min(max(widest_px(warp) * (1 + 2 * reach) / SPACING_PX, FEWEST_LINES), most))


@compiled(FLAGS, INT, INT)
def _inner(visible: Seen, lines: int, n: int) -> int:
    """Return the nearest of N points on a grid of ``lines`` that has neighbours all around, -1 if not all are seen."""
    k = min(max(n // lines, 1), lines - 2) * lines + min(max(n % lines, 1), lines - 2)
    for row in range(k - lines - 1, k + lines, lines):
        if not (visible[row] and visible[row + 1] and visible[row + 2]):
            return -1
    return k


@compiled(MATRIX, INT, INT, INT, REAL, REAL, REAL)
def _bend(at_px: Array, axis: int, lines: int, k: int, xx: float, xy: float, yy: float) -> float:
    """Return how fast pixels (N, 2) of points on a grid bend at one, along an axis: second differences, added up.

    ``xx``, ``xy`` and ``yy`` are their weights, of those along x, across, and along y.
    """
    right = at_px[k + 1, axis] - 2 * at_px[k, axis] + at_px[k - 1, axis]
    down = at_px[k + lines, axis] - 2 * at_px[k, axis] + at_px[k - lines, axis]
    before = at_px[k - lines + 1, axis] - at_px[k - lines - 1, axis]
    return xx * right + xy / 2 * (at_px[k + lines + 1, axis] - at_px[k + lines - 1, axis] - before) + yy * down


@compiled(MATRIX, FLAGS, INT, INT, REAL, REAL)
def _seen(stencil_px: Array, visible: Seen, height: int, width: int, spacing: float, blur_px: float) -> Seeing:
    """Return which of N points (N,) are seen in an image; and where, what takes pixels to template units, and weights.

    ``stencil_px`` (3 N, 2) is where they are, and then their neighbours half a unit on; ``spacing`` the template units
    between them.  Of the M that are seen come pixels (M, 2), matrices (M, 2, 2) and weights (M,): where they are seen
    through a blur of ``blur_px``, which where the print bends or shrinks moves what is seen.  Near its horizon nothing
    is.
    """
    count, lines = len(visible), round(math.sqrt(len(visible)))
    use = np.zeros(count, dtype=np.bool_)
    at_px, to_template, weight = np.empty((count, 2)), np.empty((count, 2, 2)), np.empty(count)
    m = 0
    for n in range(count):
        x, y = stencil_px[n, 0], stencil_px[n, 1]
        a, c = (stencil_px[count + n, 0] - x) / HALF_UNIT, (stencil_px[count + n, 1] - y) / HALF_UNIT
        b, d = (stencil_px[2 * count + n, 0] - x) / HALF_UNIT, (stencil_px[2 * count + n, 1] - y) / HALF_UNIT
        area = a * d - b * c
        if visible[n] and area > 1e-9 and 1 <= x <= width - 2 and 1 <= y <= height - 2:
            to_template[m, 0, 0], to_template[m, 0, 1] = d / area, -b / area
            to_template[m, 1, 0], to_template[m, 1, 1] = -c / area, a / area
            at_px[m, 0], at_px[m, 1] = x, y
            if blur_px > 0:
                inner, shift_px = _inner(visible, lines, n), 0.0
                if inner < 0:
                    continue
                # the steps on the grid that a pixel right and one down are, squared and added up
                half = (blur_px / (area * spacing)) ** 2 / 2
                xx, xy, yy = half * (b * b + d * d), -half * (a * b + c * d), half * (a * a + c * c)
                for axis in range(2):
                    bend_px = _bend(stencil_px, axis, lines, inner, xx, xy, yy)
                    at_px[m, axis] += bend_px
                    shift_px = max(shift_px, abs(bend_px))
                if shift_px > MOST_SHIFT_PX:
                    continue
            use[n] = True
            weight[m] = min(spacing**2 * area, 1.0)
            m += 1
    return use, at_px[:m], to_template[:m], weight[:m]


@compiled(CUBE)
def _units(to_template: Array) -> tuple[float, float]:
    """Return the smaller singular value of matrices (N, 2, 2) that a tenth have less than, and the larger, more."""
    count = len(to_template)
    fewest, most = np.empty(count), np.empty(count)
    for n in range(count):
        a, b, c, d = to_template[n, 0, 0], to_template[n, 0, 1], to_template[n, 1, 0], to_template[n, 1, 1]
        total, area = a * a + b * b + c * c + d * d, a * d - b * c
        apart = math.sqrt(max(total * total - 4 * area * area, 0.0))
        fewest[n], most[n] = math.sqrt(max(total - apart, 0.0) / 2), math.sqrt((total + apart) / 2)
    return ranked(fewest, count // 10), ranked(most, count - 1 - count // 10)


def look(
    warp: FittedWarp, shape: tuple[int, ...], reach: float = REACH, most_lines: int = MOST_LINES, blur_px: float = 0.0
) -> Look | None:
    """Return how a print and ``reach`` sides around it lie in an image of ``shape`` (H, W); None when hardly at all.

    Points are where they are seen through a blur: it moves them where the print bends or is seen in perspective.
    """
    lines = lines_across(warp, most_lines, reach)
    points, stencil = _grid(lines, reach)
    spacing = TEMPLATE_UNITS * (1 + 2 * reach) / (lines - 1)
    use, *seen = _seen(np.ascontiguousarray(warp(stencil)), warp.visible(points), shape[0], shape[1], spacing, blur_px)
    if len(seen[0]) < FEWEST_POINTS:
        return None
    return Look(points if len(seen[0]) == len(points) else points[use], *seen)
