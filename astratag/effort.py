"""Effort: how much close looking one image is worth, in counts, so that none takes for ever."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from astratag.candidates import Candidate, looks_large

Array = NDArray[np.float64]

SAME_SQUARE = 0.04
"""Squares whose centres and sides differ by less than this fraction are one square found twice."""


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
    """Return whether a candidate is the same square as one before, and reads the same no better."""
    if candidate.reading.marker_id != before.reading.marker_id or candidate.bent != before.bent:
        return False
    same = same_square(candidate.corners_px[None], before.corners_px)[0]
    return bool(same) and candidate.reading.correlation <= before.reading.correlation


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
