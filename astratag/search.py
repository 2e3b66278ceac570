"""Quad search: every dark square that might be a layer of a marker, as four rough corners.

Pixels: (0, 0) is the centre of the top-left pixel.  Quads run clockwise in the image, from any corner.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import chain

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

THRESHOLD_WINDOW_PX = 15
THRESHOLD_OFFSET = 7
"""A pixel is ink when it is this many grey levels below the mean of its window."""

POLYGON_TOLERANCES = (0.03, 0.05, 0.015, 0.08)
"""Fractions of the perimeter, most useful first; skinny quads need the small ones, bent squares the large."""

MIN_PERIMETER_PX = 24.0
MIN_SIDE_PX = 3.0
LEAST_ROUNDNESS = 0.014
"""Area over squared perimeter: 0.0625 of a square, 0.03 of one seen at 80 degrees, less of ragged shapes."""
MAX_CONTOURS = 200
MAX_QUADS = 160
OUTSET_PX = 0.75
LEAST_SINE = 0.1


def find_quads(gray: Image, *, halve: bool = False) -> Array:
    """Return rough quads (Q, 4, 2) in pixels, the longest first, at most ``MAX_QUADS``; edges good to a pixel or two.

    ``halve`` searches at half resolution: three times faster, and squares below some 25 pixels are lost.
    """
    if halve:
        gray = cv2.resize(gray, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    smooth = cv2.blur(gray, (3, 3))
    ink = cv2.adaptiveThreshold(
        smooth,
        255,
        cv2.ADAPTIVE_THRESH_MEAN_C,
        cv2.THRESH_BINARY_INV,
        THRESHOLD_WINDOW_PX,
        THRESHOLD_OFFSET,
    )
    contours, _ = cv2.findContours(ink, cv2.RETR_LIST, cv2.CHAIN_APPROX_SIMPLE)
    outlines = sorted(_plausible(contours), key=lambda outline: -outline[0])[:MAX_CONTOURS]
    quads = list(chain.from_iterable(_quads_of(contour, perimeter) for perimeter, contour in outlines))
    found = _grown(np.array(quads[:MAX_QUADS], dtype=float).reshape(-1, 4, 2))
    return 2.0 * found + 0.5 if halve else found


def _plausible(contours: Sequence[NDArray[np.int32]]) -> Iterator[tuple[float, NDArray[np.int32]]]:
    """Yield perimeter and contour of those that run around ink, are long enough, and not too ragged for a square."""
    for contour in contours:
        if len(contour) >= 4:
            area = -cv2.contourArea(contour, True)  # negative around ink, positive around holes in it
            if area >= MIN_SIDE_PX**2:
                perimeter = cv2.arcLength(contour, True)
                if perimeter >= MIN_PERIMETER_PX and area >= LEAST_ROUNDNESS * perimeter**2:
                    yield perimeter, contour


def _grown(quads: Array) -> Array:
    """Return quads (Q, 4, 2) with each side moved out: contours run through the centres of the outermost ink pixels."""
    ahead = np.roll(quads, -1, axis=1) - quads
    along = ahead / np.linalg.norm(ahead, axis=2, keepdims=True)
    before = np.roll(along, 1, axis=1)
    sine = np.maximum(before[..., 0] * along[..., 1] - before[..., 1] * along[..., 0], LEAST_SINE)
    return quads + OUTSET_PX * (before - along) / sine[..., None]


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
