"""Binarising: telling ink from paper by the mean around each pixel, and the borders of the shapes that makes.

Compiled, because an image is binarised some ten ways, an enlarged one has millions of pixels of which few are worth it,
and clutter has thousands of shapes of which few are large enough.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from astratag.compiled import BOOL, GRAY, INDICES, INT, INTO_POINTS, INTO_SHAPES, REAL, TABLE, array, compiled

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
Flags = NDArray[np.bool_]
Indices = NDArray[np.int64]

MOST_REACH_PX = 15
"""How far from a pixel the widest window reaches."""
INK, SEEN, SEEN_BEFORE_PAPER = 1, 2, 3
"""What a pixel of a shape is marked as while borders are followed: on none yet, on one, on one with paper to its right.
"""
WORD, ALL_INK, NO_INK = 8, np.uint64(0x0101010101010101), np.uint64(0)
"""Pixels that are looked at at once where all of them are alike."""
ROOM = 4096
"""Points that there is room for at first."""
ACROSS, DOWN = np.array([(1, 1, 0, -1, -1, -1, 0, 1), (0, -1, -1, -1, 0, 1, 1, 1)])
"""Steps to the eight neighbours of a pixel, counter-clockwise in the image from the right one."""


@dataclass(frozen=True, eq=False)
class Contours:
    """Borders of shapes, one after another.

    ``points`` (P, 2) are pixels x, y where a border turns: counter-clockwise in the image around a shape, clockwise
    around a hole in one.  Border i begins at ``starts`` (N + 1,) i; ``areas`` (N,), negative of holes, and
    ``perimeters`` (N,) are in pixels.
    """

    points: Array
    starts: Indices
    areas: Array
    perimeters: Array

    @property
    def count(self) -> int:
        """Return how many there are."""
        return len(self.areas)

    def contour(self, i: int) -> Array:
        """Return the points (M, 2) of one."""
        return self.points[self.starts[i] : self.starts[i + 1]]

    def first(self, most: int) -> Contours:
        """Return the first of them, ``most`` at most."""
        starts = self.starts[: most + 1]
        return Contours(self.points[: starts[-1]], starts, self.areas[:most], self.perimeters[:most])

    def chosen(self, which: Indices) -> Contours:
        """Return some of them, in that order."""
        lengths = np.diff(self.starts)[which]
        starts = np.append(0, np.cumsum(lengths))
        at = np.arange(starts[-1]) + np.repeat(self.starts[which] - starts[:-1], lengths)
        return Contours(self.points[at], starts, self.areas[which], self.perimeters[which])

    def run_backwards(self) -> Contours:
        """Return all run the other way around: of shapes of paper, the holes are shapes."""
        return Contours(
            np.ascontiguousarray(self.points[::-1]),
            np.ascontiguousarray(self.starts[-1] - self.starts[::-1]),
            -self.areas[::-1],
            np.ascontiguousarray(self.perimeters[::-1]),
        )


NO_CONTOURS = Contours(np.zeros((0, 2)), np.zeros(1, dtype=np.int64), np.zeros(0), np.zeros(0))


def sums_of(gray: Image) -> NDArray[np.int32]:
    """Return sums over all above and left of each pixel of an image (H, W), whose border goes on beyond it.

    Shared by all windows.  Sums of vast images wrap around, and their differences are right all the same.
    """
    wider = cv2.copyMakeBorder(gray, *(MOST_REACH_PX,) * 4, cv2.BORDER_REPLICATE)
    return np.asarray(cv2.integral(wider, sdepth=cv2.CV_32S))


@compiled(GRAY, TABLE, array(BOOL, 2), INT, INT, INT, BOOL)
def threshold_blocks(
    gray: Image, sums: NDArray[np.int32], worth: Flags, block_px: int, window_px: int, offset: int, holes: bool
) -> tuple[Image, int]:
    """Return 1 where an image (H, W) is ``offset`` below the mean around it, or with ``holes`` above; else 0.

    As OpenCV's ``adaptiveThreshold``, in blocks of ``block_px`` that are ``worth`` it (R, C), and 0 elsewhere; with a
    border of 0 around it (H + 2, W + 2 or a few more).  ``sums`` are of ``sums_of``.  Second, how often neighbours in a
    row differ.
    """
    height, width = gray.shape
    shapes = np.zeros((height + 2, -(-(width + 2) // WORD) * WORD), dtype=np.uint8)
    reach, changes = window_px // 2, 0
    area = np.float32(window_px * window_px)
    half = np.float32(0.5) * area
    apart = np.float32(offset) * area
    for row in range(worth.shape[0]):
        column = 0
        while column < worth.shape[1]:
            if not worth[row, column]:
                column += 1
                continue
            first = column
            while column < worth.shape[1] and worth[row, column]:
                column += 1
            left, right = first * block_px, min(column * block_px, width)
            before, after = left + MOST_REACH_PX - reach, left + MOST_REACH_PX + reach + 1
            count = right - left
            for y in range(row * block_px, min((row + 1) * block_px, height)):
                above, below = sums[y + MOST_REACH_PX - reach], sums[y + MOST_REACH_PX + reach + 1]
                a, b = above[before : before + count], above[after : after + count]
                c, d = below[before : before + count], below[after : after + count]
                level, shape = gray[y, left:right], shapes[y + 1, left + 1 : right + 1]
                if holes:
                    for x in range(count):
                        total = np.float32(np.int32(d[x] - c[x] - b[x] + a[x]))
                        shape[x] = np.uint8(np.float32(level[x]) * area - apart - half > total)
                else:
                    for x in range(count):
                        total = np.float32(np.int32(d[x] - c[x] - b[x] + a[x]))
                        shape[x] = np.uint8(np.float32(level[x]) * area + apart - half <= total)
                for x in range(1, count):
                    changes += shape[x] != shape[x - 1]
                changes += (left > 0 and shape[0] != 0) + (right < width and shape[count - 1] != 0)
    return shapes, changes


@compiled(INTO_SHAPES, INT, INT, INT)
def _next_border(shapes: Image, y: int, x: int, stop: int) -> int:
    """Return the first pixel of a row, from ``x`` on, at which a border begins that was not followed; or ``stop``.

    Either it is ink after paper, the first of a shape, or paper after ink, the first of a hole.
    """
    row = shapes[y]
    words = row.view(np.uint64)
    before = row[x - 1]
    while x < stop:
        if x % WORD == 0 and x + WORD <= stop and words[x // WORD] == (NO_INK if before == 0 else ALL_INK):
            x += WORD
            before = row[x - 1]
            continue
        mark = row[x]
        if mark == 0:
            if before != 0 and before != SEEN_BEFORE_PAPER:
                return x
        elif before == 0 and mark == INK:
            return x
        before = mark
        x += 1
    return stop


@compiled(INTO_SHAPES, INT, INT, INDICES, INTO_POINTS)
def _followed(shapes: Image, y: int, x: int, steps: Indices, points: Array) -> tuple[int, float, int, int]:
    """Follow the border that begins at a pixel, and write where it turns into ``points`` (N, 2) as far as they go.

    Return how many points it has, its area, and its straight and slanted steps.  ``steps`` (16,) take places to the
    neighbours, twice around.
    """
    marks, first = shapes.ravel(), y * shapes.shape[1] + x
    s = 4
    if marks[first] == 0:
        first, x, s = first - 1, x - 1, 0
    last = s
    while True:
        s = (s - 1) & 7
        second = first + steps[s]
        if marks[second] != 0 or s == last:
            break
    if s == last:
        marks[first] = SEEN_BEFORE_PAPER
        return 0, 0.0, 0, 0
    here, turned_from = first, s ^ 4
    count, doubled, straight, slanted = 0, 0, 0, 0
    while True:
        last = s
        while True:
            s += 1
            following = here + steps[s]
            if marks[following] != 0:
                break
        s &= 7
        if last > s - 1 >= 0:
            marks[here] = SEEN_BEFORE_PAPER
        elif marks[here] == INK:
            marks[here] = SEEN
        if s != turned_from:
            if count < len(points):
                points[count, 0], points[count, 1] = x - 1, y - 1
            count += 1
            turned_from = s
        doubled += y * ACROSS[s] - x * DOWN[s]
        straight += 1 - (s & 1)
        slanted += s & 1
        x += ACROSS[s]
        y += DOWN[s]
        if following == first and here == second:
            return count, doubled / 2, straight, slanted
        here, s = following, (s + 4) & 7


@compiled(INTO_SHAPES, REAL)
def traced(shapes: Image, least_px: float) -> tuple[Array, Indices, Array, Array, int]:
    """Return the borders of shapes (H + 2, W + 2), in the order of ``Contours``, and how many pixels they have in all.

    Shapes are 1, with 0 around all, and are marked in the course.  Borders shorter than ``least_px``, or with less than
    four points, are left out.  Suzuki and Abe, "Topological structural analysis of digitized binary images by border
    following", CVGIP 1985, without the hierarchy.
    """
    height, width = shapes.shape
    points, starts = np.empty((ROOM, 2)), np.zeros(ROOM, dtype=np.int64)
    areas, perimeters = np.empty(ROOM), np.empty(ROOM)
    end, count, followed = 0, 0, 0
    steps = np.concatenate((DOWN * width + ACROSS, DOWN * width + ACROSS))
    for y in range(1, height - 1):
        x = _next_border(shapes, y, 1, width)
        while x < width:
            length, area, straight, slanted = _followed(shapes, y, x, steps, points[end:])
            followed += straight + slanted
            perimeter = straight + slanted * math.sqrt(2.0)
            if length >= 4 and perimeter >= least_px:
                if end + length > len(points):
                    points = np.concatenate((points[:end], np.empty((end + 2 * length, 2))))
                    _followed(shapes, y, x, steps, points[end:])
                if count + 1 == len(starts):
                    starts = np.concatenate((starts, np.zeros_like(starts)))
                    areas = np.concatenate((areas, np.empty_like(areas)))
                    perimeters = np.concatenate((perimeters, np.empty_like(perimeters)))
                areas[count], perimeters[count] = area, perimeter
                end, count = end + length, count + 1
                starts[count] = end
            x = _next_border(shapes, y, x + 1, width)
    return points[:end].copy(), starts[: count + 1].copy(), areas[:count].copy(), perimeters[:count].copy(), followed
