"""Effort: how much close looking one image is worth, in counts, so that none takes for ever."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from astratag.candidates import Candidate, looks_large

Array = NDArray[np.float64]

SAME_SQUARE = 0.04
"""Squares whose centres and sides differ by less than this fraction are one square found twice."""
BETTER = 0.03
"""A square that was looked at is looked at again where it reads so much better."""
LEAST_UNITS, UNITS_A_PIXEL, MOST_UNITS = 8_000, 0.053, 24_500
"""What one image is worth whatever its size, and more for each pixel, up to a limit: what the hardest markers of the
benchmark take, which at 640x480 is 24 000.  A plain one with a marker takes about a thousand.

A unit is what takes about a microsecond, counted and never measured, so that the same image always gets the same.
"""


class Effort:
    """How many units of effort an image is worth, and how many were spent on it."""

    def __init__(self, pixels: int) -> None:
        self.most = min(LEAST_UNITS + UNITS_A_PIXEL * pixels, MOST_UNITS)
        self.spent = 0.0

    def spend(self, units: float) -> bool:
        """Return whether so many units are left, and spend them if so."""
        return self.spent + units <= self.most and self.begin(units)

    def begin(self, units: float) -> bool:
        """Return whether any units are left, and spend so many if so: what is promising is looked at to its end."""
        if self.spent >= self.most:
            return False
        self.spent += units
        return True

    def afford(self, units: float, most: int) -> int:
        """Return how many things of so many units each can be done, ``most`` at most, and spend what they take."""
        count = max(0, min(most, int((self.most - self.spent) / units)))
        self.spent += count * units
        return count


@dataclass(frozen=True)
class Costs:
    """What is done in an image, in units."""

    pixel: float = 0.0015
    """Of a picture in which outlines are looked for."""
    resized_pixel: float = 0.0002
    """More of the whole picture, at the resolution worked at."""
    border_pixel: float = 0.012
    """Of the borders of all shapes: followed, or looked through for near sides."""
    outline: float = 7.0
    """Simplified, and read as if flat."""
    edges: float = 250.0
    aligned: float = 1500.0
    bent: float = 0.9
    """A bent square whose frame is looked at."""
    bent_read: float = 800.0
    """Those that have one, and how the best look."""
    curved: float = 3000.0
    relit: float = 22.0
    """An outline read cell by cell."""
    by_pixels: float = 650.0
    matched: float = 2000.0
    spline: float = 500.0


COST = Costs()


class Tries:
    """The candidates of one image that were looked at in one costly way: each once, unless it reads better later."""

    def __init__(self, most: int) -> None:
        self.most = most
        self.made: list[Candidate] = []

    def take(self, candidate: Candidate) -> bool:
        """Return whether a candidate is to be looked at, and remember it if so."""
        if len(self.made) >= self.most or any(_no_better(candidate, before) for before in self.made):
            return False
        self.made.append(candidate)
        return True


def _no_better(candidate: Candidate, before: Candidate) -> bool:
    """Return whether a candidate is the same square as one before, and reads the same not much better."""
    if candidate.reading.marker_id != before.reading.marker_id or candidate.bent != before.bent:
        return False
    same = same_square(candidate.corners_px[None], before.corners_px)[0]
    return bool(same) and candidate.reading.correlation < before.reading.correlation + BETTER


def same_square(quads: Array, quad: Array) -> NDArray[np.bool_]:
    """Return which quads (Q, 4, 2) are the square (4, 2), found again."""
    apart_px = np.abs(quads.mean(axis=1) - quad.mean(axis=0)).max(axis=1)
    sides_px, side_px = looks_large(quads), looks_large(quad[None])
    return np.maximum(apart_px, np.abs(sides_px - side_px)) < SAME_SQUARE * np.minimum(sides_px, side_px)


def first_distinct(quads: Array, before: Array, most: int) -> Array:
    """Return the first of quads (Q, 4, 2), ``most`` at most, that are neither of ``before`` (B, 4, 2) nor alike."""
    kept: list[int] = []
    fresh = np.ones(len(quads), dtype=bool)
    for quad in before:
        fresh &= ~same_square(quads, quad)
    while len(kept) < most and fresh.any():
        kept.append(int(fresh.argmax()))
        fresh &= ~same_square(quads, quads[kept[-1]])
        fresh[kept[-1]] = False
    return quads[kept]
