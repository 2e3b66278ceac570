"""Outline search: every dark shape that might be a layer of a marker, as four rough corners and how its sides bulge.

Pixels: (0, 0) is the centre of the top-left pixel.  Corners run clockwise in the image, from any corner.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from astratag.binarise import threshold_blocks
from astratag.polygons import clockwise, convex_quads, grown, sizes

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
Contour = NDArray[np.int32]
"""Pixels (N, 1, 2) along the border of a shape."""


class Binarisation(NamedTuple):
    """How ink is told from paper: a pixel is ink when ``offset`` grey levels below the mean of its ``window_px``."""

    scale: float = 1.0
    """Work at another resolution: at half of it three times faster, and squares below some 25 pixels are lost."""
    smooth_px: int = 3
    window_px: int = 15
    offset: int = 7
    holes: bool = False
    """Look for holes in what is ``offset`` above the mean, instead: black squares in their margins and frames.

    White then hangs together by its corners, so that a ring a pixel wide is still closed, and what the square's
    inside looks like does not matter.
    """


COARSE = Binarisation(scale=0.5, offset=14)
"""For a first look: large squares, clearly darker than their surroundings, which most textures are not."""
PLAIN = Binarisation()
NARROW = Binarisation(smooth_px=1, window_px=7)
"""For squares so small, or seen at such a slant, that their borders are a pixel or two wide."""
FAINT = Binarisation(scale=0.5, offset=2)
"""For pictures of low contrast."""
BROAD = Binarisation(smooth_px=1, window_px=31, offset=15, holes=True)
"""For blur and glare, which widen what is white."""
TINY = Binarisation(scale=2.0, smooth_px=1, window_px=9, holes=True)
"""For squares of some 12 to 30 pixels."""
SLANTED = Binarisation(scale=2.0, smooth_px=1, window_px=21, offset=15, holes=True)
STEEP = Binarisation(scale=2.0, smooth_px=1, window_px=31, offset=20, holes=True)
"""For margins a pixel wide, of squares seen at more than 80 degrees."""
THIN = Binarisation(scale=2.0, smooth_px=1, window_px=11)
"""For borders a pixel wide, and rings about to close where a print turns away."""

BLOCK_PX, STEP_PX = 16, 5
"""Where an image is worth twice its resolution is decided in blocks, by the largest step of brightness in each."""
FINE_PX = 80_000
"""How much of an image is looked at that closely, in its own pixels, the largest steps first.

Paper and ink make the largest: what was found so filled at most a tenth of 640x480, and a fourth among sharp clutter.
"""

POLYGON_TOLERANCES = (0.03, 0.05, 0.015, 0.08)
"""Fractions of the perimeter, most useful first; skinny quads need the small ones, bent squares the large."""
WHOLE_TOLERANCES = 2
"""How many of them a square needs that is whole, not very skinny, and not very bent."""
BENT_TOLERANCE = 0.015
MAX_VERTICES = 16
LEAST_TURN = 0.2
"""Radians by which the outline of a bent square turns at each of its corners."""

MIN_PERIMETER_PX = 24.0
MIN_SIDE_PX = 3.0
LEAST_ROUNDNESS = 0.009
"""Area over squared perimeter: 0.0625 of a square, 0.03 of one seen at 80 degrees, less of ragged shapes."""
NOISE = 0.2
"""Share of pixels that are ink where their neighbour is not, or the reverse, from which a picture is noise.

Of its own pixels: enlarged twice, half as many change.
"""
MAX_CONTOURS = 500
MAX_BENT_OUTLINES = 120
MAX_HULLS, MAX_CUT = 120, 12
"""Outlines, the longest first, whose hulls are simplified; and whose corners beyond the image's border are looked for.
"""
OUTSET_PX, INSET_PX = 0.75, -0.5
"""Contours run through the centres of the outermost ink pixels, or of the white pixels beside a hole."""
BORDER_PX = 1
"""Outlines this near to the image's border are cut by it."""


@dataclass(frozen=True, eq=False)
class Outlines:
    """Plausible contours, the longest first, and what takes their coordinates to the whole image's pixels."""

    contours: list[tuple[float, Contour]]
    scale: float
    origin: Array
    outset_px: float
    """How far out of the contour the square's edge lies, in the contour's own pixels."""
    size: tuple[int, int] = (0, 0)
    """Width and height of the image they were found in, in their own pixels."""
    others: Sequence[Contour] = ()
    """All contours, also those around holes, or too ragged or open for a square."""

    def moved(self, origin: Array) -> Outlines:
        """Return the outlines of a part of an image whose first pixel is at ``origin`` (2,)."""
        return replace(self, origin=self.origin + origin)

    def in_image(self, points: Array) -> Array:
        """Return points (..., 2) of a contour in pixels of the image."""
        return self.scale * points + (self.scale - 1) / 2 + self.origin

    @cached_property
    def quads(self) -> Array:
        """Return the quads (Q, 4, 2) that they may be when their sides are straight."""
        return _quads(self, whole=False)

    @cached_property
    def bent_quads(self) -> BentQuads:
        """Return what they may be when their sides bulge."""
        return _bent_quads(self)


NONE = Outlines(contours=[], scale=1.0, origin=np.zeros(2), outset_px=0.0)


class BentQuads(NamedTuple):
    """Shapes with four corners (B, 4, 2) and a bulge of each side (B, 4, 2): how far its middle lies off the chord."""

    corners_px: Array
    bulges_px: Array


class Scaled(NamedTuple):
    """An image at another resolution, and which blocks (R, C) of it outlines are looked for in; None is everywhere."""

    gray: Image
    worth: NDArray[np.bool_] | None = None
    block_px: int = BLOCK_PX


def scaled(gray: Image, scale: float) -> Scaled:
    """Return an image at another resolution; of one that is enlarged, only the best parts are worth looking at."""
    if scale == 1.0:
        return Scaled(gray)
    interpolation = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    other = cv2.resize(gray, None, fx=scale, fy=scale, interpolation=interpolation)
    return Scaled(other, _worth_a_fine_look(gray) if scale > 1 else None, round(BLOCK_PX * scale))


def find_outlines(gray: Image, how: Binarisation = PLAIN, image: Scaled | None = None) -> Outlines:
    """Return the outlines of dark shapes, the longest first, at most ``MAX_CONTOURS``.

    ``image`` is what ``scaled`` makes of the gray one, if that is known.
    """
    gray, worth, block_px = scaled(gray, how.scale) if image is None else image
    smooth = cv2.blur(gray, (how.smooth_px,) * 2) if how.smooth_px > 1 else gray
    if worth is None:
        kind, offset = (cv2.THRESH_BINARY, -how.offset) if how.holes else (cv2.THRESH_BINARY_INV, how.offset)
        shapes = cv2.adaptiveThreshold(smooth, 255, cv2.ADAPTIVE_THRESH_MEAN_C, kind, how.window_px, offset)
        looked_at = shapes.size
    else:
        shapes = threshold_blocks(smooth, worth, block_px, how.window_px, how.offset, how.holes)
        looked_at = int(worth.sum()) * block_px**2
    changes = cv2.countNonZero(cv2.absdiff(shapes[:, 1:], shapes[:, :-1]))
    noisy = how.scale * changes > NOISE * looked_at  # hundreds of thousands of contours, and none of them a square
    contours = () if noisy else cv2.findContours(shapes, cv2.RETR_LIST, cv2.CHAIN_APPROX_SIMPLE)[0]
    if how.holes:
        contours = [contour[::-1] for contour in contours]  # holes are run around the other way
    return Outlines(
        contours=_plausible(contours),
        scale=1 / how.scale,
        origin=np.zeros(2),
        outset_px=INSET_PX if how.holes else OUTSET_PX,
        size=(shapes.shape[1], shapes.shape[0]),
        others=contours,
    )


def _worth_a_fine_look(gray: Image) -> NDArray[np.bool_] | None:
    """Return which blocks (R, C) of an image (H, W) are worth enlarging, ``FINE_PX`` at most; None when all are."""
    if gray.size <= FINE_PX:
        return None
    rows, columns = (-(-extent // BLOCK_PX) for extent in gray.shape)
    step = cv2.morphologyEx(gray, cv2.MORPH_GRADIENT, np.ones((STEP_PX, STEP_PX), np.uint8))
    step = cv2.copyMakeBorder(
        step, 0, rows * BLOCK_PX - len(gray), 0, columns * BLOCK_PX - gray.shape[1], cv2.BORDER_CONSTANT
    )
    largest = step.reshape(rows, BLOCK_PX, columns, BLOCK_PX).max(axis=(1, 3))
    near = cv2.dilate(largest, np.ones((3, 3), np.uint8))
    fine = np.zeros(near.size, dtype=bool)
    fine[np.argsort(-near.ravel().astype(int), kind="stable")[: FINE_PX // BLOCK_PX**2]] = True
    return fine.reshape(rows, columns)


def find_quads(gray: Image, how: Binarisation = PLAIN) -> Array:
    """Return rough quads (Q, 4, 2) in pixels, the longest first; edges good to a pixel or two."""
    return quads_of(find_outlines(gray, how))


def quads_of(outlines: Outlines, *, whole: bool = False) -> Array:
    """Return the quads (Q, 4, 2) that outlines may be when their sides are straight.

    ``whole`` leaves out outlines that are ragged, cut or covered: seldom squares, and long to look at.
    """
    return _quads(outlines, whole=True) if whole else outlines.quads


def bent_quads_of(outlines: Outlines) -> BentQuads:
    """Return what outlines may be when their sides bulge: the four sharpest corners, and how they run between."""
    return outlines.bent_quads


def _quads(outlines: Outlines, *, whole: bool) -> Array:
    contours = [contour for _, contour in outlines.contours]
    if not contours:
        return np.zeros((0, 4, 2))
    perimeters = np.array([perimeter for perimeter, _ in outlines.contours])
    found, quads = _simplified_to_quads(contours, perimeters, whole)
    for i in np.flatnonzero(_cut(outlines))[:MAX_CUT].tolist() if not whole else ():
        uncut = _uncut(contours[i], perimeters[i], outlines.size)
        if uncut is not None:
            found[i], quads[i] = True, uncut[:, 0]
    return outlines.in_image(clockwise(quads[found], MIN_SIDE_PX, outlines.outset_px))


def _bent_quads(outlines: Outlines) -> BentQuads:
    contours, polygons = [], []
    for perimeter, contour in outlines.contours[:MAX_BENT_OUTLINES]:
        polygon = cv2.approxPolyDP(contour, BENT_TOLERANCE * perimeter, True)
        if 4 <= len(polygon) <= MAX_VERTICES:
            contours.append(contour[::-1])  # contours around ink run counter-clockwise in the image
            polygons.append(polygon[::-1])
    if not contours:
        return BentQuads(*np.zeros((2, 0, 4, 2)))
    corners, sharp = _sharpest(polygons)
    sharp &= _squared(corners[:, [1, 2, 3, 0]] - corners).min(axis=1) >= MIN_SIDE_PX**2
    corners, contours = corners[sharp], [contours[i] for i in np.flatnonzero(sharp)]
    if not contours:
        return BentQuads(*np.zeros((2, 0, 4, 2)))
    corners, bulges = _bulging(contours, corners)
    corners = np.array([grown(quad, outlines.outset_px) for quad in corners])
    return BentQuads(outlines.in_image(corners), outlines.scale * bulges)


def _plausible(contours: Sequence[Contour]) -> list[tuple[float, Contour]]:
    """Return perimeters and contours, the longest first, of those that may be a square's: at most ``MAX_CONTOURS``.

    They run around ink, are long enough, and not too ragged.
    """
    contours = [contour for contour in contours if len(contour) >= 4]
    if not contours:
        return []
    area, perimeter = sizes(*_joined(contours))
    use = (area >= MIN_SIDE_PX**2) & (perimeter >= MIN_PERIMETER_PX) & (area >= LEAST_ROUNDNESS * perimeter**2)
    longest = np.flatnonzero(use)[np.argsort(-perimeter[use], kind="stable")[:MAX_CONTOURS]].tolist()
    return [(float(perimeter[i]), contours[i]) for i in longest]


def starts_of(parts: Sequence[Contour]) -> NDArray[np.int64]:
    """Return where each of several arrays (N,) begins once they are concatenated."""
    lengths = np.fromiter(map(len, parts), np.int64, len(parts))
    return np.cumsum(lengths) - lengths


def _cross(a: Array, b: Array) -> Array:
    """Return the cross products (...) of vectors (..., 2)."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _squared(a: Array) -> Array:
    """Return the squared lengths (...) of vectors (..., 2)."""
    return a[..., 0] * a[..., 0] + a[..., 1] * a[..., 1]


def _simplified_to_quads(
    contours: Sequence[Contour], perimeters: Array, whole: bool
) -> tuple[NDArray[np.bool_], Array]:
    """Return which contours simplify to a convex quad (N,), and these quads (N, 4, 2).

    Else those of their hulls, unless only a ``whole`` square will do.
    """
    found, quads = convex_quads(*_joined(contours), perimeters, _tolerances(whole), whole)
    if whole:
        return found, quads
    hulls = {i: cv2.convexHull(contours[i]) for i in np.flatnonzero(~found)[:MAX_HULLS].tolist()}
    rest = [i for i, hull in hulls.items() if 4 <= len(hull) < len(contours[i])]
    if rest:
        around = [hulls[i] for i in rest]
        lengths = np.array([cv2.arcLength(hull, True) for hull in around])
        found[rest], quads[rest] = convex_quads(*_joined(around), lengths, _tolerances(False), False)
    return found, quads


def _tolerances(whole: bool) -> Array:
    return np.array(POLYGON_TOLERANCES[: WHOLE_TOLERANCES if whole else None])


def _joined(contours: Sequence[Contour]) -> tuple[Array, NDArray[np.int64]]:
    """Return the points (P, 2) of contours one after another, and where each begins, and the last ends (N + 1,)."""
    return np.concatenate(contours)[:, 0].astype(float), np.append(starts_of(contours), sum(map(len, contours)))


def _cut(outlines: Outlines) -> NDArray[np.bool_]:
    """Return which outlines touch the border of the image they were found in."""
    contours = [contour for _, contour in outlines.contours]
    if not contours:
        return np.zeros(0, dtype=bool)
    points, starts = np.concatenate(contours)[:, 0], starts_of(contours)
    low, high = np.minimum.reduceat(points, starts), np.maximum.reduceat(points, starts)
    last = np.array(outlines.size) - 1
    return np.asarray((low <= BORDER_PX).any(axis=1) | (high >= last - BORDER_PX).any(axis=1))


def _uncut(contour: Contour, perimeter: float, size: tuple[int, int]) -> Array | None:
    """Return the convex quad (4, 1, 2) that the border of an image of a size cut corners off; None if it cut none."""
    polygon = cv2.approxPolyDP(cv2.convexHull(contour), BENT_TOLERANCE * perimeter, True)[:, 0].astype(float)
    after = np.roll(polygon, -1, axis=0)
    near_low = np.maximum(polygon, after) <= BORDER_PX
    near_high = np.minimum(polygon, after) >= np.array(size) - 1 - BORDER_PX
    sides = np.flatnonzero(~(near_low | near_high).any(axis=1))
    if len(sides) != 4 or len(polygon) == 4:
        return None
    along = (after - polygon)[sides]
    before, start = np.roll(along, 1, axis=0), polygon[np.roll(sides, 1)]
    turn = _cross(before, along)
    if not ((turn > 0).all() or (turn < 0).all()):
        return None
    return (start + before * (_cross(polygon[sides] - start, along) / turn)[:, None])[:, None]


def _sharpest(polygons: Sequence[Contour]) -> tuple[Array, NDArray[np.bool_]]:
    """Return the four vertices of each polygon (N, 1, 2) that turn most (B, 4, 2), and which turn enough (B,)."""
    lengths = np.array([len(polygon) for polygon in polygons])
    rows, column = np.arange(len(polygons))[:, None], np.arange(MAX_VERTICES)
    vertices = np.zeros((len(polygons), MAX_VERTICES, 2))
    vertices[column < lengths[:, None]] = np.concatenate(polygons)[:, 0]
    after = vertices[rows, np.where(column + 1 < lengths[:, None], column + 1, 0)] - vertices
    before = vertices - vertices[rows, np.where(column > 0, column - 1, lengths[:, None] - 1)]
    turn = np.arctan2(_cross(before, after), (before * after).sum(axis=2))
    turn[column >= lengths[:, None]] = -np.inf
    order = np.argsort(-turn, axis=1, kind="stable")[:, :4]
    return vertices[rows, np.sort(order, axis=1)], turn[rows[:, 0], order[:, 3]] >= LEAST_TURN


def _bulging(contours: Sequence[Contour], corners: Array) -> tuple[Array, Array]:
    """Return four corners (B, 4, 2) on each contour, and the bulges (B, 4, 2) of the sides between, as parabolas."""
    points = np.concatenate(contours)[:, 0].astype(float)
    lengths = np.array([len(contour) for contour in contours])
    owner, starts = np.repeat(np.arange(len(contours)), lengths), np.cumsum(lengths) - lengths
    apart = _squared(points[:, None] - corners[owner])
    at_corner = apart == np.minimum.reduceat(apart, starts)[owner]
    place = np.where(at_corner, np.arange(len(points))[:, None], len(points))
    places = np.minimum.reduceat(place, starts)
    order = np.argsort(places, axis=1)
    corners = np.take_along_axis(corners, order[..., None], axis=1)
    places = np.take_along_axis(places, order, axis=1)
    side = (np.arange(len(points))[:, None] >= places[owner]).sum(axis=1) - 1  # -1, before the first, is the last
    chords = corners[:, [1, 2, 3, 0]] - corners
    outward = np.stack([chords[..., 1], -chords[..., 0]], axis=2) / np.sqrt(_squared(chords))[..., None]
    from_corner, chord = points - corners[owner, side], chords[owner, side]
    along = (from_corner * chord).sum(axis=1) / _squared(chord)
    profile = 4 * along * (1 - along)
    key, count = 4 * owner + side % 4, 4 * len(contours)
    off = np.bincount(key, profile * (from_corner * outward[owner, side]).sum(axis=1), count)
    height = off / (np.bincount(key, profile**2, count) + 0.5)
    return corners, outward * height.reshape(-1, 4)[..., None]
