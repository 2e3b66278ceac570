"""Outline search: every dark shape that might be a layer of a marker, as four rough corners and how its sides bulge.

Pixels: (0, 0) is the centre of the top-left pixel.  Corners run clockwise in the image, from any corner.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from astratag.binarise import (
    NO_CONTOURS,
    Contours,
    largest_in_blocks,
    sums_of,
    threshold_blocks,
    threshold_enlarged,
    traced,
)
from astratag.polygons import bent_quads, clockwise, convex_quads, uncut_quads

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
FINE_PX = 40_000
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

    contours: Contours
    scale: float
    origin: Array
    outset_px: float
    """How far out of the contour the square's edge lies, in the contour's own pixels."""
    size: tuple[int, int] = (0, 0)
    """Width and height of the image they were found in, in their own pixels."""
    others: Contours = NO_CONTOURS
    """All that are long enough, also those around holes, or too ragged or open for a square."""
    followed: int = 0
    """How many pixels all borders in the image have."""

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


NONE = Outlines(contours=NO_CONTOURS, scale=1.0, origin=np.zeros(2), outset_px=0.0)


class BentQuads(NamedTuple):
    """Shapes with four corners (B, 4, 2) and a bulge of each side (B, 4, 2): how far its middle lies off the chord."""

    corners_px: Array
    bulges_px: Array


@dataclass(frozen=True, eq=False)
class Scaled:
    """An image made ready to be looked at in another resolution; one that is to be enlarged, as it is.

    ``worth`` says in which of its blocks (R, C) outlines are looked for; None is everywhere.  ``kept`` holds it
    smoothed over so many pixels, and its sums, for all that need them.
    """

    gray: Image
    enlarged: int = 1
    worth: NDArray[np.bool_] | None = None
    kept: dict[int, tuple[Image, NDArray[np.int32]]] = field(default_factory=dict)

    def smoothed(self, smooth_px: int) -> tuple[Image, NDArray[np.int32]]:
        """Return the image averaged over so many of its pixels, and its sums."""
        if smooth_px not in self.kept:
            smooth = cv2.blur(self.gray, (smooth_px, smooth_px)) if smooth_px > 1 else self.gray
            self.kept[smooth_px] = smooth, sums_of(smooth)
        return self.kept[smooth_px]

    @property
    def blocks(self) -> tuple[NDArray[np.bool_], int]:
        """Return which blocks (R, C) are worth it, and how large they are: one for all where everything is."""
        if self.worth is None:
            return np.ones((1, 1), dtype=bool), max(self.gray.shape)
        return self.worth, BLOCK_PX

    @property
    def looked_at_px(self) -> int:
        """Return how many pixels are looked at, about, once it is enlarged."""
        return self.enlarged**2 * (self.gray.size if self.worth is None else int(self.worth.sum()) * BLOCK_PX**2)

    def shapes(self, how: Binarisation) -> tuple[Image, int]:
        """Return 1 where there is ink, or white to look for holes in, and how often neighbours differ."""
        smooth, sums = self.smoothed(how.smooth_px)
        worth, block_px = self.blocks
        if self.enlarged == 1:
            return threshold_blocks(smooth, sums, worth, block_px, how.window_px, how.offset, how.holes)
        near = cv2.dilate(worth.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
        window_px = how.window_px // self.enlarged // 2 * 2 + 1
        return threshold_enlarged(smooth, sums, worth, near, block_px, window_px, how.offset, how.holes)


def scaled(gray: Image, scale: float, plain: Scaled | None = None) -> Scaled:
    """Return an image to be looked at in another resolution; of an enlarged one, only the best parts are worth it.

    ``plain`` is what this makes of it in its own resolution, if that is known: its sums serve an enlarged one too.
    """
    if scale > 1:
        return Scaled(gray, round(scale), _worth_a_fine_look(gray), plain.kept if plain else {})
    return Scaled(gray if scale == 1 else cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA))


def find_outlines(gray: Image, how: Binarisation = PLAIN, image: Scaled | None = None) -> Outlines:
    """Return the outlines of dark shapes, the longest first, at most ``MAX_CONTOURS``.

    ``image`` is what ``scaled`` makes of the gray one, if that is known.
    """
    image = image or scaled(gray, how.scale)
    shapes, changes = image.shapes(how)
    contours, followed = NO_CONTOURS, 0
    if how.scale * changes <= NOISE * image.looked_at_px:  # else thousands of contours, and none of them a square
        worth, block_px = image.blocks
        points, starts, areas, perimeters, followed = traced(shapes, worth, image.enlarged * block_px, MIN_PERIMETER_PX)
        contours = Contours(points, starts, areas, perimeters)
    if how.holes:
        contours = contours.run_backwards()
    height, width = image.gray.shape
    return Outlines(
        contours=_plausible(contours),
        scale=1 / how.scale,
        origin=np.zeros(2),
        outset_px=INSET_PX if how.holes else OUTSET_PX,
        size=(image.enlarged * width, image.enlarged * height),
        others=contours,
        followed=followed,
    )


def _worth_a_fine_look(gray: Image) -> NDArray[np.bool_] | None:
    """Return which blocks (R, C) of an image (H, W) are worth enlarging, ``FINE_PX`` at most; None when all are."""
    if gray.size <= FINE_PX:
        return None
    step = cv2.morphologyEx(gray, cv2.MORPH_GRADIENT, np.ones((STEP_PX, STEP_PX), np.uint8))
    near = cv2.dilate(largest_in_blocks(step, BLOCK_PX), np.ones((3, 3), np.uint8))
    fine = np.zeros(near.size, dtype=bool)
    fine[np.argsort(-near.ravel().astype(int), kind="stable")[: FINE_PX // BLOCK_PX**2]] = True
    return fine.reshape(near.shape)


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
    contours = outlines.contours
    if not contours.count:
        return np.zeros((0, 4, 2))
    found, quads = convex_quads(
        contours.points, contours.starts, contours.perimeters, _tolerances(whole), whole, 0 if whole else MAX_HULLS
    )
    if not whole:
        cut, uncut = uncut_quads(
            contours.points,
            contours.starts,
            contours.perimeters,
            *outlines.size,
            BORDER_PX,
            BENT_TOLERANCE,
            MAX_VERTICES,
            MAX_CUT,
        )
        found, quads = found | cut, np.where(cut[:, None, None], uncut, quads)
    return outlines.in_image(clockwise(quads[found], MIN_SIDE_PX, outlines.outset_px))


def _bent_quads(outlines: Outlines) -> BentQuads:
    contours = outlines.contours.first(MAX_BENT_OUTLINES)
    found, corners, bulges = bent_quads(
        contours.points,
        contours.starts,
        contours.perimeters,
        BENT_TOLERANCE,
        MAX_VERTICES,
        LEAST_TURN,
        MIN_SIDE_PX,
        outlines.outset_px,
    )
    return BentQuads(outlines.in_image(corners[found]), outlines.scale * bulges[found])


def _plausible(contours: Contours) -> Contours:
    """Return the contours that may be a square's, the longest first: at most ``MAX_CONTOURS``.

    They run around ink, and are not too ragged.
    """
    area, perimeter = contours.areas, contours.perimeters
    use = (area >= MIN_SIDE_PX**2) & (area >= LEAST_ROUNDNESS * perimeter**2)
    return contours.chosen(np.flatnonzero(use)[np.argsort(-perimeter[use], kind="stable")[:MAX_CONTOURS]])


def _tolerances(whole: bool) -> Array:
    return np.array(POLYGON_TOLERANCES[: WHOLE_TOLERANCES if whole else None])
