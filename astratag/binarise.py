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

from astratag.compiled import (
    BOOL,
    FLAG_MATRIX,
    GRAY,
    INDEX_MATRIX,
    INDICES,
    INT,
    INTO_MARKS,
    INTO_POINTS,
    INTO_SHAPES,
    INTO_STARTS,
    MATRIX,
    REAL,
    TABLE,
    WORDS,
    compiled,
)

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
Flags = NDArray[np.bool_]
Indices = NDArray[np.int64]

MOST_REACH_PX = 15
"""How far from a pixel the widest window reaches."""
COUNTED_ROWS = 4
"""Of so many rows one is looked at for how often neighbours differ, which takes as long as telling ink from paper."""
INK, SEEN, BEFORE_PAPER = 1, 2, 4
"""What pixels of a shape are marked with, added up: on a border that was followed; on one with paper to its right."""
WORD = 8
"""Pixels that are looked at at once: borders begin in few of them."""
ALL_INK = np.uint64(0x0101010101010101)
A_PIXEL, LAST_OF_WORD = np.uint64(8), np.uint64(56)
"""By how many bits a word is shifted to move its pixels on by one, and its last one to the front."""
ROOM, PIXELS_A_POINT = 4096, 8
"""Points that there is room for at first, or one for so many pixels, if that is more."""
LEAST_POINTS = 4
"""Borders that turn less often are no squares."""
ACROSS, DOWN = np.array([(1, 1, 0, -1, -1, -1, 0, 1), (0, -1, -1, -1, 0, 1, 1, 1)])
"""Steps to the eight neighbours of a pixel, counter-clockwise in the image from the right one."""


def _turns() -> NDArray[np.uint8]:
    """Return where a border goes on from a pixel, by which of its neighbours are ink and from which it came (2048,).

    To the first that is ink, counter-clockwise; and eight times what the pixel is marked with.
    """
    turns = np.zeros((256, 8), dtype=np.uint8)
    for around in range(1, 256):
        for came_from in range(8):
            tried = [(came_from + turn) % 8 for turn in range(1, 9)]
            onwards = next(neighbour for neighbour in tried if around >> neighbour & 1)
            before = tried[: tried.index(onwards)]
            turns[around, came_from] = onwards + 8 * (SEEN + BEFORE_PAPER * (0 in before))
    return turns.ravel()


TURNS = _turns()


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
        return Contours(*_chosen(self.points, self.starts, which), self.areas[which], self.perimeters[which])

    def run_backwards(self) -> Contours:
        """Return all run the other way around: of shapes of paper, the holes are shapes."""
        return Contours(
            np.ascontiguousarray(self.points[::-1]),
            np.ascontiguousarray(self.starts[-1] - self.starts[::-1]),
            -self.areas[::-1],
            np.ascontiguousarray(self.perimeters[::-1]),
        )


@compiled(MATRIX, INDICES, INDICES)
def _chosen(points: Array, starts: Indices, which: Indices) -> tuple[Array, Indices]:
    """Return points and starts of some of ``Contours``, in that order."""
    places = np.zeros(len(which) + 1, dtype=np.int64)
    for i in range(len(which)):
        places[i + 1] = places[i] + starts[which[i] + 1] - starts[which[i]]
    kept = np.empty((places[-1], 2))
    for i in range(len(which)):
        first = starts[which[i]] - places[i]
        for k in range(places[i], places[i + 1]):
            kept[k, 0], kept[k, 1] = points[first + k, 0], points[first + k, 1]
    return kept, places


NO_CONTOURS = Contours(np.zeros((0, 2)), np.zeros(1, dtype=np.int64), np.zeros(0), np.zeros(0))


def sums_of(gray: Image) -> NDArray[np.int32]:
    """Return sums over all above and left of each pixel of an image (H, W), whose border goes on beyond it.

    Shared by all windows.  Sums of vast images wrap around, and their differences are right all the same.
    """
    wider = cv2.copyMakeBorder(gray, *(MOST_REACH_PX,) * 4, cv2.BORDER_REPLICATE)
    return np.asarray(cv2.integral(wider, sdepth=cv2.CV_32S))


@compiled(FLAG_MATRIX, INT, INT, INT)
def _spans(worth: Flags, block_px: int, height: int, width: int) -> Indices:
    """Return the parts of rows that lie in blocks that are ``worth`` it (S, 3): y, first x, and the one after the last.

    Of an image (H, W) with a border around it, row by row.
    """
    spans, count = np.empty((height * (worth.shape[1] + 1) // 2 + 1, 3), dtype=np.int64), 0
    for y in range(height):
        row, column = y // block_px, 0
        while column < worth.shape[1]:
            if not worth[row, column]:
                column += 1
                continue
            spans[count, 0], spans[count, 1] = y + 1, column * block_px + 1
            while column < worth.shape[1] and worth[row, column]:
                column += 1
            spans[count, 2] = min(column * block_px, width) + 1
            count += 1
    return spans[:count]


@compiled(GRAY, TABLE, FLAG_MATRIX, INT, INT, INT, BOOL)
def threshold_blocks(
    gray: Image, sums: NDArray[np.int32], worth: Flags, block_px: int, window_px: int, offset: int, holes: bool
) -> tuple[Image, int]:
    """Return 1 where an image (H, W) is ``offset`` below the mean around it, or with ``holes`` above; else 0.

    As OpenCV's ``adaptiveThreshold``, in blocks of ``block_px`` that are ``worth`` it (R, C), and 0 elsewhere; with a
    border of 0 around it (H + 2, W + 2 or a few more).  ``sums`` are of ``sums_of``.  Second, how often neighbours in a
    row differ, about: counted in every fourth row.
    """
    height, width = gray.shape
    shapes = np.zeros((height + 2, -(-(width + 2) // WORD) * WORD), dtype=np.uint8)
    reach, changes = window_px // 2, 0
    area = np.float32(window_px * window_px)
    half = np.float32(0.5) * area
    apart = np.float32(offset) * area
    for y, first, stop in _spans(worth, block_px, height, width):
        left, right, count = first - 1, stop - 1, stop - first
        before, after = left + MOST_REACH_PX - reach, left + MOST_REACH_PX + reach + 1
        above, below = sums[y - 1 + MOST_REACH_PX - reach], sums[y + MOST_REACH_PX + reach]
        a, b = above[before : before + count], above[after : after + count]
        c, d = below[before : before + count], below[after : after + count]
        level, shape = gray[y - 1, left:right], shapes[y, first:stop]
        if holes:
            for x in range(count):
                total = np.float32(np.int32(d[x] - c[x] - b[x] + a[x]))
                shape[x] = np.uint8(np.float32(level[x]) * area - apart - half > total)
        else:
            for x in range(count):
                total = np.float32(np.int32(d[x] - c[x] - b[x] + a[x]))
                shape[x] = np.uint8(np.float32(level[x]) * area + apart - half <= total)
        if y % COUNTED_ROWS == 0:
            for x in range(1, count):
                changes += shape[x] != shape[x - 1]
            changes += (left > 0 and shape[0] != 0) + (right < width and shape[count - 1] != 0)
    return shapes, COUNTED_ROWS * changes


@compiled(GRAY, TABLE, FLAG_MATRIX, FLAG_MATRIX, INT, INT, INT, BOOL)
def threshold_enlarged(
    gray: Image,
    sums: NDArray[np.int32],
    worth: Flags,
    near: Flags,
    block_px: int,
    window_px: int,
    offset: int,
    holes: bool,
) -> tuple[Image, int]:
    """Return what ``threshold_blocks`` does of an image (H, W) twice as large, interpolated, that is never made.

    How far a pixel stands out from the mean around it is as smooth as the image itself: so that is interpolated, and
    only in blocks that are ``worth`` it.  ``near`` are these and the blocks around them: what lies beyond is left
    undefined, for clearing it took longer than what is looked at.  Windows and blocks are in the image's own pixels.
    """
    height, width = gray.shape
    shapes = np.empty((2 * height + 2, -(-(2 * width + 2) // WORD) * WORD), dtype=np.uint8)
    shapes[0], shapes[2 * height + 1], shapes[:, 0], shapes[:, 2 * width + 1 :] = 0, 0, 0, 0
    stands_out = np.empty((height + 2, width + 2), dtype=np.float32)
    reach, changes = window_px // 2, 0
    area = np.float32(window_px * window_px)
    apart, sign = np.float32(offset) * area, np.float32(1 if holes else -1)
    for y, first, stop in _spans(near, block_px, height, width):
        left, count = first - 1, stop - first
        before, after = left + MOST_REACH_PX - reach, left + MOST_REACH_PX + reach + 1
        above, below = sums[y - 1 + MOST_REACH_PX - reach], sums[y + MOST_REACH_PX + reach]
        a, b = above[before : before + count], above[after : after + count]
        c, d = below[before : before + count], below[after : after + count]
        level, row = gray[y - 1, left:], stands_out[y, first:stop]
        for x in range(count):
            total = np.float32(np.int32(d[x] - c[x] - b[x] + a[x]))
            row[x] = sign * (np.float32(level[x]) * area - total) - apart
        shapes[2 * y - 1 : 2 * y + 1, 2 * first - 1 : 2 * stop - 1] = 0
    stands_out[0], stands_out[height + 1] = stands_out[1], stands_out[height]
    stands_out[:, 0], stands_out[:, width + 1] = stands_out[:, 1], stands_out[:, width]
    quarter, rest = np.float32(0.25), np.float32(0.75)
    between = np.empty(width + 2, dtype=np.float32)
    for y, first, stop in _spans(worth, block_px, height, width):
        count = stop - first
        for half in range(2):
            here, beside = stands_out[y, first - 1 :], stands_out[y - 1 + 2 * half, first - 1 :]
            shape = shapes[2 * y - 1 + half, 2 * first - 1 :]
            for x in range(count + 2):
                between[x] = rest * here[x] + quarter * beside[x]
            for x in range(count):
                shape[2 * x] = rest * between[x + 1] + quarter * between[x] > 0
                shape[2 * x + 1] = rest * between[x + 1] + quarter * between[x + 2] > 0
            if half == 0 and y % (COUNTED_ROWS // 2) == 0:
                for x in range(1, 2 * count):
                    changes += shape[x] != shape[x - 1]
    return shapes, COUNTED_ROWS * changes


@compiled(GRAY, INT)
def largest_in_blocks(image: Image, block_px: int) -> Image:
    """Return the largest value in each block (R, C) of an image (H, W)."""
    height, width = image.shape
    largest = np.zeros((-(-height // block_px), -(-width // block_px)), dtype=np.uint8)
    for row in range(len(largest)):
        below = np.zeros(width, dtype=np.uint8)
        for y in range(row * block_px, min((row + 1) * block_px, height)):
            for x in range(width):
                below[x] = max(below[x], image[y, x])
        for column in range(largest.shape[1]):
            for x in range(column * block_px, min((column + 1) * block_px, width)):
                largest[row, column] = max(largest[row, column], below[x])
    return largest


@compiled(GRAY, INDEX_MATRIX)
def _neighbours(shapes: Image, spans: Indices) -> Image:
    """Return which of the eight neighbours of each pixel of shapes (H + 2, W + 2) in spans are ink, a bit each."""
    around = np.empty(shapes.shape, dtype=np.uint8)
    for y, first, stop in spans:
        count = stop - first
        a, b, c = shapes[y - 1, first - 1 :], shapes[y, first - 1 :], shapes[y + 1, first - 1 :]
        ring = around[y, first:]
        for x in range(count):
            ring[x] = np.uint8(
                b[x + 2]
                | a[x + 2] << 1
                | a[x + 1] << 2
                | a[x] << 3
                | b[x] << 4
                | c[x] << 5
                | c[x + 1] << 6
                | c[x + 2] << 7
            )
    return around


@compiled(WORDS, INT, INT)
def _next_border(words: NDArray[np.uint64], at: int, stop: int) -> int:
    """Return the first pixel, from ``at`` on, at which a border begins that was not followed; or ``stop`` or later.

    Either it is ink after paper, the first of a shape, or paper after ink, the first of a hole.  ``words`` are the
    marks of all pixels.
    """
    here, end = at // WORD, -(-stop // WORD)
    skipped = np.uint64(8 * (at - here * WORD))
    while here < end:
        marks = words[here]
        before = marks << A_PIXEL | words[here - 1] >> LAST_OF_WORD
        ink, ink_before = marks & ALL_INK, before & ALL_INK
        of_shapes = ink & ~(marks >> np.uint64(1)) & ~ink_before
        of_holes = ~ink & ink_before & ~(before >> np.uint64(2))
        begins = (of_shapes | of_holes) >> skipped << skipped
        if begins != 0:
            pixel = here * WORD
            while begins & np.uint64(1) == 0:
                begins >>= A_PIXEL
                pixel += 1
            return pixel
        here, skipped = here + 1, np.uint64(0)
    return stop


@compiled(INTO_MARKS, INTO_MARKS, INT, INT, INT, INDICES, INDICES, INTO_POINTS, INT)
def _followed(
    marks: NDArray[np.uint8],
    around: NDArray[np.uint8],
    start: int,
    y: int,
    x: int,
    steps: Indices,
    onward_steps: Indices,
    points: NDArray[np.int32],
    end: int,
) -> tuple[int, int, int, int]:
    """Follow the border that begins at a pixel, and write where it turns into ``points`` (N, 2) from ``end`` on.

    Return how many points it has, which may be more than there is room for, twice its area, and its straight and
    slanted steps.  ``marks`` and ``around`` are of all pixels; ``steps`` (8,) take from one to its neighbours, and
    ``onward_steps`` (2048,) to where ``TURNS`` go: looked up at once, for each pixel waits for the one before.
    """
    of_hole = marks[start] == 0  # which begins at the paper after its ink
    x -= of_hole
    first, onwards = np.uint64(start - of_hole), np.uint64(0 if of_hole else 4)
    ring = np.uint64(around[first])
    if ring == 0:
        marks[first] |= SEEN + BEFORE_PAPER
        return 0, 0, 0, 0
    while True:
        onwards = (onwards - np.uint64(1)) & np.uint64(7)
        if ring >> onwards & np.uint64(1):
            break
    second = np.uint64(np.int64(first) + steps[onwards])
    here, came_from, straight_on = first, onwards, onwards ^ np.uint64(4)
    count, last, doubled, taken, slanted = end, len(points) - 1, 0, 0, 0
    while True:
        way = np.uint64(around[here]) << np.uint64(3) | came_from
        turn, following = np.uint64(TURNS[way]), np.uint64(np.int64(here) + onward_steps[way])
        onwards = turn & np.uint64(7)
        marks[here] |= np.uint8(turn >> np.uint64(3))
        at = np.uint64(min(count, last))
        points[at, 0] = x - 1
        points[at, 1] = y - 1
        count += 1 if onwards != straight_on else 0
        straight_on = onwards
        doubled += y * ACROSS[onwards] - x * DOWN[onwards]
        slanted += 1 if onwards & np.uint64(1) else 0
        taken += 1
        x += ACROSS[onwards]
        y += DOWN[onwards]
        if following == first and here == second:
            return count - end, doubled, taken - slanted, slanted
        here, came_from = following, onwards ^ np.uint64(4)


@compiled(INTO_MARKS, INTO_MARKS, INDEX_MATRIX, INT, REAL, INTO_POINTS, INTO_STARTS)
def _traced(
    marks: NDArray[np.uint8],
    around: NDArray[np.uint8],
    spans: Indices,
    width: int,
    least_px: float,
    points: NDArray[np.int32],
    starts: Indices,
) -> tuple[Array, Array, int]:
    """Write the borders of shapes in spans into ``points`` (P, 2) and ``starts`` (N,); see ``traced``.

    Return areas and perimeters, and how many pixels all borders have: -1 when there was no room for all points.
    """
    words = marks.view(np.uint64)
    areas, perimeters = np.empty(len(starts)), np.empty(len(starts))
    end, count, followed = 0, 0, 0
    steps, onward_steps = DOWN * width + ACROSS, np.empty(len(TURNS), dtype=np.int64)
    for way in range(len(TURNS)):
        onward_steps[way] = steps[TURNS[way] & 7]
    for y, first, stop in spans:
        row, stop = y * width, stop + y * width + 1
        at = _next_border(words, row + first, stop)
        while at < stop:
            length, doubled, straight, slanted = _followed(
                marks, around, at, y, at - row, steps, onward_steps, points, end
            )
            if end + length >= len(points):
                return areas, perimeters, -1
            followed += straight + slanted
            perimeter = straight + slanted * math.sqrt(2.0)
            if length >= LEAST_POINTS and perimeter >= least_px:
                areas[count], perimeters[count] = doubled / 2, perimeter
                end, count = end + length, count + 1
                starts[count] = end
            at = _next_border(words, at + 1, stop)
    return areas[:count].copy(), perimeters[:count].copy(), followed


@compiled(INTO_SHAPES, FLAG_MATRIX, INT, REAL)
def traced(shapes: Image, worth: Flags, block_px: int, least_px: float) -> tuple[Array, Indices, Array, Array, int]:
    """Return the borders of shapes (H + 2, W + 2), in the order of ``Contours``, and how many pixels they have in all.

    Shapes are of ``threshold_blocks``, and are marked in the course.  Borders shorter than ``least_px``, or with less
    than four points, are left out.  Suzuki and Abe, "Topological structural analysis of digitized binary images by
    border following", CVGIP 1985, without the hierarchy.  Where to turn is looked up, and where borders begin is seen
    for eight pixels at once: branches that cannot be foreseen took most of the time.
    """
    height, width = shapes.shape
    spans = _spans(worth, block_px, height - 2, width - 2)
    marks, around = shapes.ravel(), _neighbours(shapes, spans).ravel()
    room = max(ROOM, shapes.size // PIXELS_A_POINT)
    while True:
        points, starts = np.empty((room, 2), dtype=np.int32), np.zeros(room // LEAST_POINTS + 1, dtype=np.int64)
        areas, perimeters, followed = _traced(marks, around, spans, width, least_px, points, starts)
        if followed >= 0:
            starts = starts[: len(areas) + 1].copy()
            return points[: starts[-1]].astype(np.float64), starts, areas, perimeters, followed
        room *= 2
        for pixel in range(len(marks)):
            marks[pixel] &= INK
