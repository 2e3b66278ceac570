"""Candidates: what rough quads read, as if flat, and bent where that fails; each moved until it looks as it reads."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from astratag.align import COARSE_BLUR, COARSE_STEPS, FINE_STEPS, align
from astratag.compiled import CUBE, MATRIX, compiled
from astratag.frame import FRAME, darker_inside
from astratag.geometry import LAYERS, TEMPLATE_UNITS, renamed, square
from astratag.relight import RELIT_SAMPLES, relit_cells
from astratag.search import BentQuads
from astratag.signature import (
    CELL_MIDDLES,
    LEAST_SEEN,
    SAMPLES,
    Artwork,
    Codebook,
    Reading,
    blur_level,
    cell_values,
    sample,
)
from astratag.tps import KNOTS, ThinPlate
from astratag.warp import LEAST_DEPTH, BentWarp, FittedWarp, HomographyWarp, plane_of

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

MORE_OF_SMALL = 0.1
"""How much better a square must read that is so small that its code is blurred: blurred codes are like more."""
MAX_CANDIDATES = 10
MAX_READ_FLAT = 12
"""Quads that are read, the likeliest by their cells' middles: of 230 that were markers all were among the first two."""
LEAST_LIKENESS = 0.45
"""Correlation of a layer, as printed, with what is seen below which it is something else."""
AT_ONCE, AT_ONCE_RELIT = 0.7, 0.55
"""Correlation from which a flat square is moved at once.  Of unevenly lit ones, of fewer cells, how much better than
promising it must be, together with a share of how they look.

Of 393 that were markers once moved 82 in a hundred have more, of others that read like one 11; of 118 unevenly lit ones
all, of others 91.
"""
SHARE_OF_LOOKS, WORTH_MOVING = 0.75, 0.54
"""What this share of how a flat square looks, and how much better than promising it reads, must come to.

Of 777 squares that were markers once moved three came to less, all of them half in glare; of those in pictures without
a marker half do.
"""
SURE = 0.85
"""Correlation from which a reading needs no second opinion."""
MORE_OF_BENT = 0.05
"""How much better a bent square must read: through the best of some forty shifts."""
MAX_RELIT, MAX_RELIT_READ = 4, 40
LEAST_RELIT_SIDE_PX = 32.0
"""Of squares smaller than this the margin and the gaps between cells are too thin to tell how they are lit."""
MAX_BENT = 3
MAX_BENT_READ, MAX_SHIFTS_READ = 4, 6
LEAST_BENT_SIDE_PX = 16.0
LEAST_FRAMED, LEAST_FRAMED_RELIT = 3, 2
OUTER = square(0.0, TEMPLATE_UNITS)
OUTER.flags.writeable = False


@dataclass(frozen=True, eq=False)
class Candidate:
    """A square that may be a layer of a marker: what it reads, and its corners (4, 2) in the marker's order.

    ``warp`` is what it was read through, taking the whole template onto the square.  ``aligned`` says that it was
    moved until the square looks as it reads; ``relit`` that its light is so uneven that it is read cell by cell.
    ``promise`` of a bent one is as that of ``promise_of``.
    """

    reading: Reading
    corners_px: Array
    warp: FittedWarp
    bent: bool = False
    aligned: bool = False
    relit: bool = False
    promise: float = 0.0

    @property
    def side_px(self) -> float:
        """Return how large the square looks: the root of its area."""
        return side_of(self.corners_px)


@compiled(MATRIX)
def side_of(quad: Array) -> float:
    """Return how large a quad (4, 2) looks: the root of its area."""
    (ax, ay), (bx, by), (cx, cy), (dx, dy) = quad
    return math.sqrt(abs((cx - ax) * (dy - by) - (cy - ay) * (dx - bx)) / 2)


@compiled(CUBE)
def looks_large(quads: Array) -> Array:
    """Return the same (Q,) of quads (Q, 4, 2)."""
    sizes = np.empty(len(quads))
    for q in range(len(quads)):
        sizes[q] = side_of(quads[q])
    return sizes


def flat_candidates(gray: Image, quads: Array, codebook: Codebook) -> list[Candidate]:
    """Return the quads (Q, 4, 2) that read something like a code, the best first."""
    quads = framed(gray, quads)
    if len(quads) == 0:
        return []
    if len(quads) > MAX_READ_FLAT:
        quads = quads[codebook.likeliest(sample(gray, points_in(quads, CELL_MIDDLES)), MAX_READ_FLAT)]
    sides_px = looks_large(quads)
    cells = cell_values(gray, points_in(quads, SAMPLES))
    least = codebook.promising() + np.where(blur_level(sides_px) > 0, MORE_OF_SMALL, 0.0)
    best = codebook.best_readings(cells, least, MAX_CANDIDATES, sides_px)
    return [_turned(reading, quads[i]) for i, reading in best]


def relightable(gray: Image, quads: Array) -> Array:
    """Return those of quads (Q, 4, 2), ``MAX_RELIT_READ`` at most, that are worth reading as unevenly lit."""
    return framed(gray, quads[looks_large(quads) >= LEAST_RELIT_SIDE_PX], LEAST_FRAMED_RELIT)[:MAX_RELIT_READ]


def relit_candidates(light: NDArray[np.float32], quads: Array, codebook: Codebook) -> list[Candidate]:
    """Return the quads (Q, 4, 2) that read as a code where shadows, glare and coverings leave it, the best first.

    So many cells are given up, and any code is so much like an uneven light, that a rough quad must read better.
    """
    if len(quads) == 0:
        return []
    readings = codebook.read_seen(*relit_cells(light, points_in(quads, RELIT_SAMPLES)))
    promising = [
        (reading, quad)
        for reading, quad in zip(readings, quads, strict=True)
        if reading.cells >= LEAST_SEEN and reading.correlation >= codebook.promising(reading.cells)
    ]
    best = sorted(promising, key=lambda pair: -pair[0].correlation)[:MAX_RELIT]
    return [replace(_turned(*pair), relit=True) for pair in best]


def framed(gray: Image, quads: Array, least: int = LEAST_FRAMED) -> Array:
    """Return those of quads (Q, 4, 2) that are darker inside their edges than outside, on at least so many sides."""
    return quads[darker_inside(gray, points_in(quads, FRAME), least)] if len(quads) else quads


@compiled(CUBE, MATRIX)
def points_in(quads: Array, template: Array) -> Array:
    """Return where template points (S, 2) lie (Q, S, 2) when each quad (Q, 4, 2) is the outer square."""
    at = np.empty((len(quads), len(template), 2))
    for q in range(len(quads)):
        H = plane_of(quads[q])
        for i in range(len(template)):
            u, v = template[i, 0] / TEMPLATE_UNITS, template[i, 1] / TEMPLATE_UNITS
            depth = max(H[2, 0] * u + H[2, 1] * v + 1, LEAST_DEPTH)
            at[q, i, 0] = (H[0, 0] * u + H[0, 1] * v + H[0, 2]) / depth
            at[q, i, 1] = (H[1, 0] * u + H[1, 1] * v + H[1, 2]) / depth
    return at


def _turned(reading: Reading, quad: Array) -> Candidate:
    """Return a candidate with its corners turned from the order they were read in to the marker's own."""
    corners_px = renamed(quad, reading.quarter_turns)
    return Candidate(reading, corners_px, HomographyWarp.from_points(OUTER, corners_px))


TANGENTIAL = (-0.32, -0.24, -0.16, -0.08, 0.0, 0.08, 0.16, 0.24, 0.32)
"""How far the middle of a bent print may lie along it from where it would if flat, as fractions of its sides."""


def _profiles(template: Array) -> tuple[Array, Array, Array]:
    """Return the shares (S, 4) of points (S, 2) in the bulges of four sides, and (S,) in shifts right and down.

    The Coons patch whose corners stay in place: sides bulge as parabolas, and shifts along them fall to 0 at the ends.
    """
    u, v = (template / (TEMPLATE_UNITS / 2) - 1.0).T
    rows, columns = 1 - u**2, 1 - v**2
    shares = np.stack([rows * (1 - v) / 2, columns * (1 + u) / 2, rows * (1 + v) / 2, columns * (1 - u) / 2], axis=1)
    return shares, rows, columns


_SHIFTS = np.array([(a, b) for a in TANGENTIAL for b in TANGENTIAL if abs(a) + abs(b) < 0.34])
MANY_WARPS = len(LAYERS) * (len(_SHIFTS) + 1)
"""How many warps a candidate is read through at most: flat, and bent in all ways, as any layer."""


def bent_candidates(gray: Image, quads: BentQuads, codebook: Codebook) -> list[Candidate]:
    """Return what shapes with bulging sides read through the best of all shifts along these, the best first."""
    large = looks_large(quads.corners_px) >= LEAST_BENT_SIDE_PX if len(quads.corners_px) else np.zeros(0, dtype=bool)
    shapes = BentQuads(quads.corners_px[large], quads.bulges_px[large])
    if len(shapes.corners_px) == 0:
        return []
    framed = _framed_bent(gray, shapes)
    read = zip(*(part[framed][:MAX_BENT_READ] for part in shapes), strict=True)
    found = (_bent(gray, corners_px, bulges_px, codebook) for corners_px, bulges_px in read)
    promising = [candidate for candidate in found if candidate is not None]
    return sorted(promising, key=lambda c: -c.reading.correlation)[:MAX_BENT]


def _framed_bent(gray: Image, shapes: BentQuads) -> NDArray[np.bool_]:
    """Return which shapes are darker inside their bulging edges than outside, on at least three sides."""
    shares = np.maximum(_profiles(FRAME)[0], 0.0)
    at = points_in(shapes.corners_px, FRAME) + shares @ shapes.bulges_px
    return darker_inside(gray, at, LEAST_FRAMED)


def _bent(gray: Image, corners_px: Array, bulges_px: Array, codebook: Codebook) -> Candidate | None:
    """Return what one bent shape reads through the best of the splines that fit it, None when hopeless."""
    right = (corners_px[1] - corners_px[0] + corners_px[2] - corners_px[3]) / 2
    down = (corners_px[3] - corners_px[0] + corners_px[2] - corners_px[1]) / 2
    by_side, rows, columns = _profiles(KNOTS)
    base = points_in(corners_px[None], KNOTS)[0] + by_side @ bulges_px
    along = _SHIFTS[:, 0, None, None] * (rows[:, None] * right) + _SHIFTS[:, 1, None, None] * (columns[:, None] * down)
    places = base + along
    places = places[codebook.likeliest(sample(gray, _SPLINE_MIDDLES @ places), MAX_SHIFTS_READ)]
    readings = codebook.read(cell_values(gray, (_SPLINE @ places).astype(np.float32)))
    best = max(range(len(readings)), key=lambda i: readings[i].correlation)
    if readings[best].correlation < codebook.promising() + MORE_OF_BENT:
        return None
    turns = readings[best].quarter_turns
    order = np.roll(np.arange(len(KNOTS)).reshape(-1, 4), -turns, axis=1).ravel()  # knots come in fours, like corners
    warp = BentWarp.from_points(KNOTS, places[best][order])
    return Candidate(readings[best], renamed(corners_px, turns), warp, bent=True)


_SPLINE, _SPLINE_MIDDLES = (ThinPlate(KNOTS).basis(points) for points in (SAMPLES, CELL_MIDDLES))
"""Take the places of the knots to those of the samples, the thin-plate-spline re-warp of the paper; and of the cells'
middles, a glance at which tells the likeliest shifts."""


def promise_of(gray: Image, candidate: Candidate, codebook: Codebook, artwork: Artwork) -> float | None:
    """Return how promising it is to move a candidate: from 0 on it is moved at once; None when it is not worth it."""
    if candidate.bent:
        return candidate.promise
    correlation, promising = candidate.reading.correlation, codebook.promising(candidate.reading.cells)
    looks = artwork.layer_scores(gray, candidate.warp, candidate.reading.marker_id, candidate.side_px)
    both = correlation - promising + SHARE_OF_LOOKS * float(looks.max())
    if candidate.relit:
        return both - AT_ONCE_RELIT
    return correlation - AT_ONCE if both >= WORTH_MOVING else None


def aligned(gray: Image, candidate: Candidate, codebook: Codebook, artwork: Artwork) -> Candidate | None:
    """Return a candidate moved until it looks as it reads, None when it then does not read as that surely."""
    marker_id, side_px = candidate.reading.marker_id, candidate.side_px
    scores = artwork.layer_scores(gray, candidate.warp, marker_id, side_px)
    if scores.max() < LEAST_LIKENESS:
        return None
    expected = artwork.expected(marker_id, side_px)[scores.argmax()]
    warp = candidate.warp
    reading = candidate.reading
    for blur, steps in ((COARSE_BLUR, COARSE_STEPS), (0.0, FINE_STEPS)):
        warp = align(gray, warp, artwork.points, expected, blur=blur, steps=steps)
        reading = codebook.read_as(cell_values(gray, warp(SAMPLES)[None])[0], marker_id, side_px)
        if reading.correlation < codebook.promising():
            return None
    return replace(candidate, reading=reading, corners_px=warp(OUTER), warp=warp, aligned=True)
