"""Outline search: every dark shape that might be a layer of a marker, as four rough corners and how its sides bulge.

Pixels: (0, 0) is the centre of the top-left pixel.  Corners run clockwise in the image, from any corner.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import chain
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Image = NDArray[np.uint8]


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


COARSE = Binarisation(scale=0.5)
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
"""For margins a pixel wide, of squares seen at more than 80 degrees."""
THIN = Binarisation(scale=2.0, smooth_px=1, window_px=9)
"""For borders a pixel wide."""

POLYGON_TOLERANCES = (0.03, 0.05, 0.015, 0.08)
"""Fractions of the perimeter, most useful first; skinny quads need the small ones, bent squares the large."""
BENT_TOLERANCE = 0.015
MAX_VERTICES = 16

MIN_PERIMETER_PX = 24.0
MIN_SIDE_PX = 3.0
LEAST_ROUNDNESS = 0.009
"""Area over squared perimeter: 0.0625 of a square, 0.03 of one seen at 80 degrees, less of ragged shapes."""
MAX_CONTOURS = 500
MAX_BENT_OUTLINES = 120
OUTSET_PX, INSET_PX = 0.75, -0.5
"""Contours run through the centres of the outermost ink pixels, or of the white pixels beside a hole."""
LEAST_SINE = 0.1


class Outlines(NamedTuple):
    """Plausible contours, the longest first, and what takes their coordinates to the whole image's pixels."""

    contours: list[tuple[float, NDArray[np.int32]]]
    scale: float
    origin: Array
    outset_px: float
    """How far out of the contour the square's edge lies, in the contour's own pixels."""

    def moved(self, origin: Array) -> Outlines:
        """Return the outlines of a part of an image whose first pixel is at ``origin`` (2,)."""
        return self._replace(origin=self.origin + origin)

    def in_image(self, points: Array) -> Array:
        """Return points (..., 2) of a contour in pixels of the image."""
        return self.scale * points + (self.scale - 1) / 2 + self.origin


class BentQuads(NamedTuple):
    """Shapes with four corners (B, 4, 2) and a bulge of each side (B, 4, 2): how far its middle lies off the chord."""

    corners_px: Array
    bulges_px: Array


def find_outlines(gray: Image, how: Binarisation = PLAIN) -> Outlines:
    """Return the outlines of dark shapes, the longest first, at most ``MAX_CONTOURS``."""
    if how.scale != 1.0:
        interpolation = cv2.INTER_AREA if how.scale < 1 else cv2.INTER_CUBIC
        gray = cv2.resize(gray, None, fx=how.scale, fy=how.scale, interpolation=interpolation)
    smooth = cv2.blur(gray, (how.smooth_px,) * 2) if how.smooth_px > 1 else gray
    kind, offset = (cv2.THRESH_BINARY, -how.offset) if how.holes else (cv2.THRESH_BINARY_INV, how.offset)
    shapes = cv2.adaptiveThreshold(smooth, 255, cv2.ADAPTIVE_THRESH_MEAN_C, kind, how.window_px, offset)
    contours, _ = cv2.findContours(shapes, cv2.RETR_LIST, cv2.CHAIN_APPROX_SIMPLE)
    if how.holes:
        contours = [contour[::-1] for contour in contours]  # holes are run around the other way
    found = sorted(_plausible(contours), key=lambda outline: -outline[0])[:MAX_CONTOURS]
    return Outlines(found, 1 / how.scale, np.zeros(2), INSET_PX if how.holes else OUTSET_PX)


def find_quads(gray: Image, how: Binarisation = PLAIN) -> Array:
    """Return rough quads (Q, 4, 2) in pixels, the longest first; edges good to a pixel or two."""
    return quads_of(find_outlines(gray, how))


def quads_of(outlines: Outlines) -> Array:
    """Return the quads (Q, 4, 2) that outlines may be when their sides are straight."""
    quads = list(chain.from_iterable(_quads_of(contour, perimeter) for perimeter, contour in outlines.contours))
    return outlines.in_image(_grown(np.array(quads, dtype=float).reshape(-1, 4, 2), outlines.outset_px))


def bent_quads_of(outlines: Outlines) -> BentQuads:
    """Return what outlines may be when their sides bulge: the four sharpest corners, and how they run between."""
    found = [_bent(contour, perimeter) for perimeter, contour in outlines.contours[:MAX_BENT_OUTLINES]]
    corners, bulges = (np.array([f[i] for f in found if f is not None]).reshape(-1, 4, 2) for i in (0, 1))
    return BentQuads(outlines.in_image(_grown(corners, outlines.outset_px)), outlines.scale * bulges)


def _plausible(contours: Sequence[NDArray[np.int32]]) -> Iterator[tuple[float, NDArray[np.int32]]]:
    """Yield perimeter and contour of those that run around ink, are long enough, and not too ragged for a square."""
    for contour in contours:
        if len(contour) >= 4:
            area = -cv2.contourArea(contour, True)  # negative around ink, positive around holes in it
            if area >= MIN_SIDE_PX**2:
                perimeter = cv2.arcLength(contour, True)
                if perimeter >= MIN_PERIMETER_PX and area >= LEAST_ROUNDNESS * perimeter**2:
                    yield perimeter, contour


def _grown(quads: Array, outset_px: float) -> Array:
    """Return quads (Q, 4, 2) with each side moved out."""
    ahead = np.roll(quads, -1, axis=1) - quads
    along = ahead / np.maximum(np.linalg.norm(ahead, axis=2, keepdims=True), 1e-9)
    before = np.roll(along, 1, axis=1)
    sine = np.maximum(before[..., 0] * along[..., 1] - before[..., 1] * along[..., 0], LEAST_SINE)
    return quads + outset_px * (before - along) / sine[..., None]


def _quads_of(contour: NDArray[np.int32], perimeter: float) -> Iterator[Array]:
    """Yield the quads that one contour may be: itself simplified, and its hull simplified, when they differ."""
    direct = _simplified(contour, perimeter)
    if direct is not None:
        yield direct
    hull = cv2.convexHull(contour)
    if direct is None and len(hull) >= 4:
        around = _simplified(hull, cv2.arcLength(hull, True))
        if around is not None:
            yield around


def _simplified(contour: NDArray[np.int32], perimeter: float) -> Array | None:
    """Return the convex quad (4, 2) the contour simplifies to at the first tolerance that gives one."""
    for tolerance in POLYGON_TOLERANCES:
        polygon = cv2.approxPolyDP(contour, tolerance * perimeter, True)
        if len(polygon) == 4 and cv2.isContourConvex(polygon):
            quad = polygon.reshape(4, 2).astype(float)
            sides = np.linalg.norm(np.roll(quad, -1, axis=0) - quad, axis=1)
            if sides.min() < MIN_SIDE_PX:
                return None
            return quad if cv2.contourArea(polygon, True) > 0 else quad[::-1]
    return None


def _bent(contour: NDArray[np.int32], perimeter: float) -> tuple[Array, Array] | None:
    """Return the four sharpest corners (4, 2) of a contour, clockwise, and the bulges (4, 2) of the sides between."""
    polygon = cv2.approxPolyDP(contour, BENT_TOLERANCE * perimeter, True)
    if not 4 <= len(polygon) <= MAX_VERTICES:
        return None
    vertices = polygon[::-1, 0].astype(float)  # contours around ink run counter-clockwise in the image
    ahead = np.roll(vertices, -1, axis=0) - vertices
    before = np.roll(ahead, 1, axis=0)
    turn = np.arctan2(before[:, 0] * ahead[:, 1] - before[:, 1] * ahead[:, 0], (before * ahead).sum(axis=1))
    corners = vertices[np.sort(np.argsort(-turn)[:4])]
    chords = np.roll(corners, -1, axis=0) - corners
    if np.linalg.norm(chords, axis=1).min() < MIN_SIDE_PX or turn[np.argsort(-turn)[3]] < 0.2:
        return None
    points = contour[::-1, 0].astype(float)
    at = ((points[:, None] - corners) ** 2).sum(axis=2).argmin(axis=0)
    bulges = np.zeros((4, 2))
    for side, chord in enumerate(chords):
        between = np.roll(points, -at[side], axis=0)[: (at[(side + 1) % 4] - at[side]) % len(points) + 1]
        length = np.linalg.norm(chord)
        outward = np.array([chord[1], -chord[0]]) / length
        along = (between - corners[side]) @ chord / length**2
        profile = 4 * along * (1 - along)
        bulges[side] = outward * (profile @ ((between - corners[side]) @ outward) / (profile @ profile + 0.5))
    return corners, bulges
