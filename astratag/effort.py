"""Effort: how much close looking one image is worth, in counts, so that none takes for ever."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from astratag.candidates import Candidate, side_of
from astratag.compiled import CUBE, INT, MATRIX, compiled

Array = NDArray[np.float64]

SAME_SQUARE = 0.04
"""Squares whose centres and sides differ by less than this fraction are one square found twice."""
BETTER = 0.03
"""A square that was looked at is looked at again where it reads so much better."""
LEAST_UNITS, UNITS_A_PIXEL, MOST_UNITS, SHARE_OF_FLAT = 7_600, 0.02425, 16_000, 0.7
"""What one image is worth whatever its size, and more for each pixel, up to a limit: what the hardest markers of the
benchmark take, which at 640x480 is 15 000; and the share of that where every marker is known to be flat.  A plain one
with a marker takes about a thousand.

A unit is what takes about a microsecond, counted and never measured, so that the same image always gets the same.
"""


class Effort:
    """How many units of effort an image is worth, and how many were spent on it."""

    def __init__(self, pixels: int, *, flat: bool = False) -> None:
        self.most = min(LEAST_UNITS + UNITS_A_PIXEL * pixels, MOST_UNITS) * (SHARE_OF_FLAT if flat else 1.0)
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

    look: float = 250.0
    """One way of telling ink from paper, however small the picture."""
    pixel: float = 0.0013
    """Of a picture in which outlines are looked for."""
    resized_pixel: float = 0.0002
    """More of the whole picture, at the resolution worked at."""
    border_pixel: float = 0.009
    """Of the borders of all shapes, which are followed."""
    near_pixel: float = 0.02
    """Of these, looked through for near sides."""
    outline: float = 6.5
    """Simplified, and read as if flat; or simplified as if bent."""
    edges: float = 150.0
    aligned: float = 900.0
    bent: float = 1.3
    """A bent square whose frame is looked at."""
    bent_read: float = 370.0
    """Those that have one, and how the best look."""
    curved: float = 1350.0
    relit: float = 34.0
    """A square read cell by cell."""
    by_pixels: float = 270.0
    matched: float = 1500.0
    spline: float = 450.0


COST = Costs()


class Tries:
    """The candidates of one image that were looked at in one costly way: each once, unless it reads better later.

    Of those that come to nothing ``most`` are looked at.
    """

    def __init__(self, most: int) -> None:
        self.most = most
        self.made: list[Candidate] = []

    def take(self, candidate: Candidate) -> bool:
        """Return whether a candidate is to be looked at, and remember it if so."""
        if len(self.made) >= self.most or any(_no_better(candidate, before) for before in self.made):
            return False
        self.made.append(candidate)
        return True

    def succeed(self) -> None:
        """Tell that the one looked at last was a marker."""
        self.most += 1


def _no_better(candidate: Candidate, before: Candidate) -> bool:
    """Return whether a candidate is the same square as one before, and reads the same not much better."""
    if candidate.reading.marker_id != before.reading.marker_id or candidate.bent != before.bent:
        return False
    same = same_square(candidate.corners_px, before.corners_px)
    return same and candidate.reading.correlation < before.reading.correlation + BETTER


@compiled(MATRIX, MATRIX)
def same_square(quad: Array, other: Array) -> bool:
    """Return whether two quads (4, 2) are one square, found again."""
    side_px, other_px = side_of(quad), side_of(other)
    apart_px = abs(side_px - other_px)
    for axis in range(2):
        apart_px = max(apart_px, abs(quad[:, axis].sum() - other[:, axis].sum()) / 4)
    return apart_px < SAME_SQUARE * min(side_px, other_px)


@compiled(CUBE, CUBE, INT)
def first_distinct(quads: Array, before: Array, most: int) -> Array:
    """Return the first of quads (Q, 4, 2), ``most`` at most, that are neither of ``before`` (B, 4, 2) nor alike."""
    kept, count = np.empty((most, 4, 2)), 0
    for q in range(len(quads)):
        if count == most:
            break
        fresh = True
        for b in range(len(before)):
            fresh = fresh and not same_square(quads[q], before[b])
        for k in range(count):
            fresh = fresh and not same_square(quads[q], kept[k])
        if fresh:
            kept[count] = quads[q]
            count += 1
    return kept[:count].copy()
