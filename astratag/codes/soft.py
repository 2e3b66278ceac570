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

from astratag.checks import finite, numbers, whole
from astratag.codes.acceptance import acceptance_threshold, chance_of_correlation
from astratag.codes.algebraic import Rejected
from astratag.codes.words import REGION_CELLS, Words
from astratag.geometry import CELLS, REGIONS

Array = NDArray[np.float64]
Bits = NDArray[np.uint8]
Kept = NDArray[np.bool_]

LEAST_CONTRAST = 1e-9
"""Cells that spread less than this, as a fraction of their size, are all alike."""
SAME_FIT = 1e-9
"""Two readings that correlate as closely as this cannot be told apart."""
CREDIBLE = 0.999
"""Correlations above this are taken for this: cells are never read so well that more of them would not tell more."""
CLEAR = 1e4
"""Where regions may be missing chance must explain every other reading so many times better than the one found."""


@dataclass(frozen=True)
class Reading:
    """The best explanation of one pattern: which code, turned clockwise by how many quarters, how well."""

    marker_id: int
    quarter_turns: int
    correlation: float
    hamming: int
    missing: tuple[int, ...] = ()
    """Regions of the image that were left out because the rest fits far better without them."""
    cells: int = CELLS
    """How many cells the correlation is worth: those that are seen and count, and fewer when blur makes codes alike."""


def checked_cells(cells: ArrayLike) -> Array:
    """Return brightnesses (48,) the largest scaled to 1.  Raises ValueError for what ``decode`` cannot take."""
    values = numbers(cells, "cells")
    if values.shape != (CELLS,):
        raise ValueError(f"cells must be {CELLS} finite brightnesses, got shape {values.shape}: one code at a time")
    return values / max(np.abs(values).max(), np.finfo(float).tiny)


def erased_regions(erased: ArrayLike | None) -> Kept:
    """Return which regions (8,) are erased.  Raises ValueError for what are not eight booleans."""
    flags = np.zeros(REGIONS, dtype=bool) if erased is None else np.asarray(erased)
    if flags.shape != (REGIONS,) or flags.dtype != bool:
        raise ValueError(f"erased must be {REGIONS} booleans, one a region, got {flags.dtype} {flags.shape}")
    return flags


def kept_cells(erased: ArrayLike | None) -> Kept:
    """Return which cells (48,) count when some regions are ``erased`` (8,).  Raises as ``erased_regions`` does."""
    kept = np.ones(CELLS, dtype=bool)
    kept[REGION_CELLS[erased_regions(erased)]] = False
    return kept


def correlations(cells: Array, kept: Kept, codes: NDArray) -> Array:
    """Return the correlation (S, N) of cells (48,) or (S, 48) with codes (N, 48) over S sets (S, 48) of cells.

    Zero where the cells or a code show no contrast there.
    """
    n = np.maximum(kept.sum(axis=1, keepdims=True), 1)
    centred = np.where(kept, cells - (kept * cells).sum(axis=1, keepdims=True) / n, 0.0)
    length = np.linalg.norm(centred, axis=1, keepdims=True)
    unit = centred / np.where(length > LEAST_CONTRAST * np.abs(cells).max(axis=-1, keepdims=True), length, np.inf)
    ones = kept.astype(float) @ codes.T
    spread = np.sqrt(ones * (n - ones) / n)  # length of a code of ones and zeros with its mean removed
    return (unit @ codes.T) / np.where(spread > 0, spread, np.inf)


def with_regions_missing(kept: Kept, most_missing: int) -> tuple[list[tuple[int, ...]], Kept]:
    """Return the choices of up to so many of the whole regions left, and the cells (S, 48) that each leaves."""
    in_view = np.flatnonzero(kept[REGION_CELLS].all(axis=1)).tolist()
    choices = [c for m in range(min(most_missing, len(in_view) - 1) + 1) for c in combinations(in_view, m)]
    left = np.repeat(kept[None], len(choices), axis=0)
    for row, choice in enumerate(choices):
        left[row, REGION_CELLS[list(choice)]] = False
    return choices, left


def hamming(cells: Array, kept: Kept, code: Bits) -> int:
    """Return how many kept cells (48,) are on the wrong side of half way between the code's black and white ones."""
    white, black = cells[kept & (code == 1)], cells[kept & (code == 0)]
    middle = (white.mean() + black.mean()) / 2
    return int((kept & ((cells > middle) != (code == 1))).sum())


@dataclass(frozen=True)
class Search:
    """What ``decide`` is to find: one of so many ``readings``, and what the caller of ``decode`` asked for."""

    readings: int
    threshold: float | None
    most_missing: int

    def __post_init__(self) -> None:
        if self.threshold is not None:
            finite(self.threshold, "threshold")
        object.__setattr__(self, "most_missing", whole(self.most_missing, "most_missing"))
        if self.most_missing >= REGIONS:
            raise ValueError(f"most_missing must be a number of regions, 0 to {REGIONS - 1}, got {self.most_missing}")


def decide(
    cells: Array, kept: Kept, codes: NDArray, identify: Callable[[int], tuple[int, int] | None], search: Search
) -> Reading | Rejected:
    """Return the reading among ``codes`` (N, 48) that chance explains least, or why none is good enough.

    ``identify`` says whose code n is and how it is turned.  With regions that may be missing every choice of them
    is tried and counts as one more comparison.
    """
    if not kept.any():
        return Rejected("no region is left")
    choices, left = with_regions_missing(kept, search.most_missing)
    count = left.sum(axis=1)
    scores = correlations(cells, left, codes)
    score = scores.max(axis=1)
    if not (score > 0).any():
        return Rejected("the cells show no contrast")
    floor = {n: acceptance_threshold(search.readings, len(choices), cells=n) for n in set(count.tolist())}
    needed = np.array([floor[n] if search.threshold is None else search.threshold for n in count.tolist()])
    chance = np.where(score >= needed, chance_of_correlation(np.minimum(score, CREDIBLE), count), np.inf)
    surest = int(chance.argmin())
    if np.isinf(chance[surest]):
        return Rejected(f"the best correlation is {score[0]:.3f}, below {needed[0]:.3f}")
    code = int(scores[surest].argmax())
    scores[:, code] = -1.0
    rival = scores.max(axis=1)
    rival_chance = chance_of_correlation(np.minimum(rival, CREDIBLE), count).min()
    unclear = len(choices) > 1 and rival_chance < CLEAR * chance[surest]
    if unclear or rival[surest] > score[surest] - SAME_FIT:
        return Rejected("two readings fit alike in the regions in view")
    identity = identify(code)
    if identity is None:
        return Rejected("the best codeword looks the same after half a turn and is nobody's")
    wrong = hamming(cells, left[surest], codes[code].astype(np.uint8))
    return Reading(*identity, float(score[surest]), wrong, choices[surest], int(count[surest]))


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
