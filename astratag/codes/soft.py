"""Soft decisions: cell brightnesses in, the reading that correlates best with them out, or why there is none.

Cells are (48,) brightnesses with the illumination removed, in any unit and on any level: only their correlation
with a code counts.  Cells of erased regions do not count at all.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from astratag.codes.acceptance import acceptance_threshold
from astratag.codes.algebraic import Rejected
from astratag.codes.words import Words
from astratag.geometry import CELLS, REGIONS

Array = NDArray[np.float64]
Bits = NDArray[np.uint8]
Kept = NDArray[np.bool_]

LEAST_CONTRAST = 1e-9
"""Cells that spread less than this, as a fraction of their size, are all alike."""
SAME_FIT = 1e-9
"""Two readings that correlate as closely as this cannot be told apart."""


@dataclass(frozen=True)
class Reading:
    """The best explanation of one pattern: which code, turned clockwise by how many quarters, how well."""

    marker_id: int
    quarter_turns: int
    correlation: float
    hamming: int


def kept_cells(cells: Array, erased: ArrayLike | None, regions: NDArray[np.int64]) -> Kept:
    """Return which cells (48,) count when the cells of some ``regions`` (8, 6) are ``erased`` (8,).

    Raises ValueError when ``cells`` or ``erased`` are not what ``decode`` takes.
    """
    if np.shape(cells) != (CELLS,) or not np.isfinite(cells).all():
        raise ValueError(f"cells must be {CELLS} finite brightnesses, got shape {np.shape(cells)}: one code at a time")
    kept = np.ones(CELLS, dtype=bool)
    if erased is not None:
        flags = np.asarray(erased)
        if flags.shape != (REGIONS,) or flags.dtype != bool:
            raise ValueError(f"erased must be {REGIONS} booleans, one a region, got {flags.dtype} {flags.shape}")
        kept[regions[flags]] = False
    return kept


def correlations(cells: Array, kept: Kept, codes: NDArray) -> Array:
    """Return the correlation (N,) of cells (48,) with codes (N, 48) of ones and zeros over the kept cells.

    Zero where the cells or a code show no contrast there.
    """
    n = kept.sum()
    centred = np.where(kept, cells - cells[kept].mean(), 0.0)
    length = np.linalg.norm(centred)
    ones = codes @ kept.astype(float)
    spread = np.sqrt(ones * (n - ones) / n)  # length of a code with its mean removed
    if length <= LEAST_CONTRAST * np.abs(cells).max():
        return np.zeros(len(codes))
    return (codes @ centred) / np.where(spread > 0, spread * length, np.inf)


def hamming(cells: Array, kept: Kept, code: Bits) -> int:
    """Return how many kept cells (48,) are on the wrong side of half way between the code's black and white ones."""
    white, black = cells[kept & (code == 1)], cells[kept & (code == 0)]
    middle = (white.mean() + black.mean()) / 2
    return int((kept & ((cells > middle) != (code == 1))).sum())


def decide(
    cells: Array,
    kept: Kept,
    codes: NDArray,
    identify: Callable[[int], tuple[int, int] | None],
    readings: int,
    threshold: float | None,
) -> Reading | Rejected:
    """Return the reading among ``codes`` (N, 48) that correlates best, or why none is good enough.

    ``identify`` says whose code n is and how it is turned.  ``readings`` is how many there are in all, from which
    ``threshold``, unless given, follows at the usual false-accept rate.
    """
    if threshold is None:
        threshold = acceptance_threshold(readings, cells=int(kept.sum()))
    scores = correlations(cells, kept, codes)
    best = int(scores.argmax())
    score = float(scores[best])
    if score <= 0.0:
        return Rejected("the cells show no contrast")
    if score < threshold:
        return Rejected(f"the best correlation is {score:.3f}, below {threshold:.3f}")
    if (scores > score - SAME_FIT).sum() > 1:
        return Rejected("two readings fit alike in the regions in view")
    identity = identify(best)
    if identity is None:
        return Rejected("the best codeword looks the same after half a turn and is nobody's")
    return Reading(*identity, score, hamming(cells, kept, codes[best].astype(np.uint8)))


def split_level(values: Array) -> float:
    """Return the level that splits values (N,) into two groups with the largest variance between them.

    Source: N. Otsu, "A threshold selection method from gray-level histograms", 1979, on the values themselves.
    """
    ordered = np.sort(values)
    below = np.arange(1, len(ordered))
    total = np.cumsum(ordered)
    gap = (total[-1] - total[:-1]) / (len(ordered) - below) - total[:-1] / below
    best = int((below * (len(ordered) - below) * gap**2).argmax())
    return float(ordered[best : best + 2].mean())


def likely_words(cells: Array, kept: Kept, level: float, generator: Sequence[int]) -> Words:
    """Return the codewords (C,) that agree with the surest cells but for none, one or two of these.

    Source: M. P. C. Fossorier and S. Lin, "Soft-decision decoding of linear block codes based on ordered
    statistics", 1995, of order two: the code is brought into systematic form on its surest independent cells.
    """
    doubt = np.where(kept, -np.abs(cells - level), 1.0)
    rows, sure = list(generator), list[int]()
    first = 0
    for cell in np.argsort(doubt, kind="stable").tolist():
        bit = 1 << cell
        pivot = next((row for row in rows if row & bit), None)
        if pivot is not None:
            rows.remove(pivot)
            rows = [row ^ pivot if row & bit else row for row in rows]
            sure = [row ^ pivot if row & bit else row for row in sure] + [pivot]
            if bool(first & bit) != bool(kept[cell] and cells[cell] > level):
                first ^= pivot
        if not rows:
            break
    flips = [0, *sure, *(a ^ b for a, b in combinations(sure, 2))]
    return np.array([first ^ flip for flip in flips], dtype=np.uint64)
