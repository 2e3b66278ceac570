"""Candidates: what rough quads read, as if flat, and bent through thin-plate splines where that fails."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from astratag.align import COARSE_BLUR, COARSE_STEPS, FINE_STEPS, align
from astratag.geometry import TEMPLATE_UNITS, square
from astratag.signature import ACCEPT_OF_MANY_WARPS, SAMPLES, Artwork, Codebook, Reading, Warp, cell_values
from astratag.tps import KNOTS, ThinPlate, ThinPlateWarp, bent_places
from astratag.warp import BentWarp, HomographyWarp

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

PROMISING = 0.5
"""Correlation through a rough quad from which a candidate is worth fitting."""
MAX_CANDIDATES = 12
FAINT = 0.25
"""Correlation as if flat from which a quad is worth bending."""
HOPELESS = 0.4
"""Correlation after a coarse alignment below which a fine one is not tried."""
SURE = 0.85
"""Correlation from which a reading needs no second opinion."""
MAX_FAINT = 24
MAX_BENT = 3
LEAST_BENT_SIDE_PX = 24.0
OUTER = square(0.0, TEMPLATE_UNITS)

_PLATE = ThinPlate(KNOTS)
_BENT_SAMPLES = _PLATE.basis(SAMPLES)


@dataclass(frozen=True, eq=False)
class Candidate:
    """A square that may be a layer of a marker: what it reads, and its corners (4, 2) in the marker's order.

    ``warp`` is what it was read through, taking the whole template onto the square.
    """

    reading: Reading
    corners_px: Array
    warp: Warp
    bent: bool = False


def flat_candidates(gray: Image, quads: Array, codebook: Codebook) -> tuple[list[Candidate], list[Candidate]]:
    """Return the quads (Q, 4, 2) that read something like a code, and those that do only faintly, the best first."""
    if len(quads) == 0:
        return [], []
    readings = codebook.read(cell_values(gray, _samples_in(quads)))
    ranked = sorted(zip(readings, quads, strict=True), key=lambda pair: -pair[0].correlation)
    promising = [_turned(*pair) for pair in ranked if pair[0].correlation >= PROMISING]
    faint = [_turned(*pair) for pair in ranked[:MAX_FAINT] if FAINT <= pair[0].correlation < PROMISING]
    return promising[:MAX_CANDIDATES], faint


def _samples_in(quads: Array) -> NDArray[np.float32]:
    """Return where the cells' sampling points lie (Q, S, 2) when each quad (Q, 4, 2) is the outer square.

    The projective map of the unit square onto four points in closed form: Heckbert, "Fundamentals of texture
    mapping and image warping", 1989.
    """
    p0, p1, p2, p3 = (quads[:, corner] for corner in range(4))
    d1, d2, total = p1 - p2, p3 - p2, p0 - p1 + p2 - p3
    area = d1[:, 0] * d2[:, 1] - d1[:, 1] * d2[:, 0]
    area = np.where(np.abs(area) > 1e-9, area, np.inf)
    g = ((total[:, 0] * d2[:, 1] - total[:, 1] * d2[:, 0]) / area)[:, None]
    h = ((d1[:, 0] * total[:, 1] - d1[:, 1] * total[:, 0]) / area)[:, None]
    across, down = p1 - p0 + g * p1, p3 - p0 + h * p3
    rows = np.stack([np.column_stack([across, g]), np.column_stack([down, h]), np.insert(p0, 2, 1.0, axis=1)], axis=2)
    u, v = (SAMPLES / TEMPLATE_UNITS).T.astype(np.float32)
    x, y, depth = (a * u + b * v + c for a, b, c in rows.astype(np.float32).transpose(1, 2, 0)[..., None])
    return np.stack([x, y], axis=2) / np.maximum(depth, np.float32(1e-6))[:, :, None]


def _turned(reading: Reading, quad: Array) -> Candidate:
    """Return a candidate with its corners turned from the order they were read in to the marker's own."""
    corners_px = np.roll(quad, -reading.quarter_turns, axis=0)
    return Candidate(reading, corners_px, HomographyWarp.from_points(OUTER, corners_px))


def bent_candidates(gray: Image, faint: Sequence[Candidate], codebook: Codebook, artwork: Artwork) -> list[Candidate]:
    """Return those of the faint candidates that read well once bent and aligned, the best first."""
    large = [candidate for candidate in faint if _side_px(candidate) >= LEAST_BENT_SIDE_PX]
    found = [_bend(gray, candidate, codebook, artwork) for candidate in large[:MAX_BENT]]
    return sorted((c for c in found if c is not None), key=lambda c: -c.reading.correlation)


def _side_px(candidate: Candidate) -> float:
    """Return the mean length of a candidate's sides."""
    corners = candidate.corners_px
    return float(np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1).mean())


def _bend(gray: Image, candidate: Candidate, codebook: Codebook, artwork: Artwork) -> Candidate | None:
    """Return a faint candidate read through a warp that bends, None when that reads no better than chance.

    It is tried as it is and through the thin-plate spline that reads best, each aligned with the artwork of
    the code it is taken for.
    """
    best: Candidate | None = None
    for start in (candidate, _through_splines(gray, candidate, codebook)):
        marker_id = start.reading.marker_id
        expected = artwork.expected(marker_id)[0]
        warp = BentWarp.from_points(KNOTS, start.warp(KNOTS))
        for blur, steps, least in ((COARSE_BLUR, COARSE_STEPS, HOPELESS), (0.0, FINE_STEPS, ACCEPT_OF_MANY_WARPS)):
            warp = align(gray, warp, artwork.points, expected, blur=blur, steps=steps)
            reading = codebook.read_as(cell_values(gray, warp(SAMPLES)[None])[0], marker_id)
            if reading.correlation < least:
                break
        else:
            if best is None or reading.correlation > best.reading.correlation:
                best = Candidate(reading, warp(OUTER), warp, bent=True)
        if best is not None and best.reading.correlation > SURE:
            break
    return best


def _through_splines(gray: Image, candidate: Candidate, codebook: Codebook) -> Candidate:
    """Return what a quad reads through the best of all thin-plate splines."""
    corners = candidate.corners_px
    places = bent_places(candidate.warp(KNOTS), corners)
    readings = codebook.read(cell_values(gray, _BENT_SAMPLES @ places))
    best = max(range(len(readings)), key=lambda i: readings[i].correlation)
    turns = readings[best].quarter_turns
    knots = np.roll(np.arange(len(KNOTS)).reshape(-1, 4), -turns, axis=1).ravel()  # knots come in fours, like corners
    return Candidate(readings[best], np.roll(corners, -turns, axis=0), ThinPlateWarp(_PLATE, places[best][knots]))
