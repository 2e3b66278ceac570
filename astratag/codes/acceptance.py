"""How often chance reads as a marker, and the thresholds that keep it from doing so.

A *candidate* is something square in an image, not a marker.  It is compared with every reading of the
dictionary (``templates``: four times its ids) through every warp tried (``warps``), and the best counts.  Its
cells are modelled as independent, identically distributed normal values (soft), or fair coin tosses (hard).
The chances of the comparisons are added up (union bound), which is at most a little too careful.

Real textures are neither independent nor normal.  Smoothness alone does no harm, as the codes are rough: of
88 000 random squares in real frames, no more than the rate asked for passed from 1e-2 down to 1e-4, with 80 readings
and with 4000.  Where textures might be worse, ``effective_cells`` says how many of the 48 to count.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import bdtr, betainc, betaincinv

from astratag.checks import finite, numbers, whole
from astratag.geometry import CELLS

FALSE_ACCEPT_RATE = 1e-6
"""The share of candidates that may be accepted by chance, unless told otherwise."""
TAIL = 100
"""Candidates that a measured tail must hold: it is then known to a tenth."""
MOST_CELLS = 1e4
"""No pattern is taken for more independent cells than this."""


def chance_of_correlation(threshold: ArrayLike, cells: ArrayLike = CELLS) -> NDArray[np.float64]:
    """Return the chance that ``cells`` independent normal values correlate with a given code above a threshold.

    Both broadcast.  With the mean removed the values point anywhere in ``cells - 1`` dimensions alike, so that
    r^2 ~ Beta(1/2, cells/2 - 1), which is Student's t = r sqrt((cells - 2) / (1 - r^2)) with cells - 2 degrees
    of freedom: R. A. Fisher, "Frequency distribution of the values of the correlation coefficient", 1915.
    """
    threshold = np.asarray(threshold)
    tail = betainc(np.asarray(cells) / 2 - 1, 0.5, 1.0 - threshold**2) / 2
    return np.where(threshold >= 0, tail, 1.0 - tail)


def acceptance_threshold(
    templates: int, warps: int = 1, false_accept_rate: float = FALSE_ACCEPT_RATE, cells: float = CELLS
) -> float:
    """Return the correlation that the best of ``templates`` x ``warps`` comparisons with chance rarely exceeds.

    Of chance candidates a share of at most ``false_accept_rate`` does, in (0, 1).  1.0 for too few ``cells`` to say.
    Raises ValueError for counts below one or a rate outside (0, 1).
    """
    _check(templates, warps, false_accept_rate)
    if finite(cells, "cells") <= 2:
        return 1.0
    chance = min(false_accept_rate / (templates * warps), 0.5)
    return float(np.sqrt(1.0 - betaincinv(cells / 2 - 1, 0.5, 2 * chance)))


def effective_cells(best: ArrayLike, templates: int, warps: int = 1) -> float:
    """Return how many independent cells would explain the best correlations (C,) of C candidates with no marker.

    Read off where the tail begins to be well known: at the correlation that a hundred candidates exceed.  Less
    frequent accepts are extrapolated by whoever puts the result into ``acceptance_threshold``.
    Raises ValueError for fewer than a thousand candidates.
    """
    from scipy.optimize import brentq  # half a second, for what is done once

    best = numbers(best, "best")
    if best.ndim != 1 or len(best) < 10 * TAIL:
        raise ValueError(f"best must be at least {10 * TAIL} correlations, one a candidate, got {best.shape}")
    level, share = np.sort(best)[-TAIL], TAIL / len(best)
    least = acceptance_threshold(templates, warps, share, MOST_CELLS)
    if not least < level <= 1.0:
        raise ValueError(f"best must be correlations, {TAIL} of them above {least:.2f}, got {level:.2f} as the last")
    return float(brentq(lambda n: acceptance_threshold(templates, warps, share, n) - level, 2.0, MOST_CELLS))


def hamming_false_accept_rate(tau: int, templates: int, warps: int = 1, cells: int = CELLS) -> float:
    """Return the share of chance candidates within ``tau`` wrong cells of some reading.

    The paper's thresholds of 3, 5 and 10 with its dictionary of twenty (80 readings): 5e-9, 5e-7 and 2.5e-3.
    ``acceptance_threshold`` with this rate is the correlation threshold that is as strict.
    """
    _check(templates, warps)
    whole(tau, "tau")
    return float(min(templates * warps * bdtr(tau, cells, 0.5), 1.0))


def hamming_threshold(templates: int, warps: int = 1, false_accept_rate: float = FALSE_ACCEPT_RATE) -> int | None:
    """Return the most wrong cells that may be forgiven at a false-accept rate; None when not even a perfect reading."""
    _check(templates, warps, false_accept_rate)
    allowed = [t for t in range(CELLS) if hamming_false_accept_rate(t, templates, warps) <= false_accept_rate]
    return max(allowed, default=None)


def _check(templates: int, warps: int, false_accept_rate: float = FALSE_ACCEPT_RATE) -> None:
    whole(templates, "templates", 1)
    whole(warps, "warps", 1)
    if not 0 < finite(false_accept_rate, "false_accept_rate") < 1:
        raise ValueError(f"false_accept_rate is a share of candidates in (0, 1), got {false_accept_rate}")
