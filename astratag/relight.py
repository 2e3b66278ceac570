"""Relit cells: what the cells of a pattern would read under even light, and which of them light or coverings hide.

A hard shadow multiplies light, glare adds to it until the image saturates.  So every cell is judged against the
ink and the paper around it, in logarithms of linear light.  *Ink* is what the nearest points show that are black in
every identity.  *Paper* is the second brightest nearby, for the brightest may be noise: either as a level (in glare
nothing is brighter than saturated) or as a ratio to its own ink (that is the same in shadow and out of it), whichever
is darker.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from astratag.compiled import INDICES, LIGHT, PLACES_OF_MANY, REAL, VECTOR, compiled
from astratag.geometry import CELLS, TEMPLATE_UNITS
from astratag.sampling import Places, bilinear
from astratag.signature import ALWAYS_BLACK, CELL_SAMPLES, SAMPLES_A_CELL, Warp

Array = NDArray[np.float64]
Light = NDArray[np.float32]
Seen = NDArray[np.bool_]

FULL = 255.0
LOG_FULL = math.log(FULL)
DARKEST = 0.5
"""Linear light, of 255, that is added before logarithms are taken: what is darker is noise."""
CODE_EXPONENT = 1 / 2.4
"""Grey values are about this power of light: noise is alike in all of them, in light it is not."""
INK_POINTS, PAIR_POINTS, PAPER_POINTS = 7, 3, 12
"""Neighbours that tell a cell's ink, a margin point's ink or a cell's margin, and a cell's paper.

Odd, because medians of them follow the edge of a shadow; a dozen cells and margin points always have paper in them.
"""
LEAST_CONTRAST, MOST_CELLS = 0.15, 0.8
"""Contrast below this fraction of what only the best fifth of the cells exceed counts as hidden."""
LEAST_CONTRAST_GREY = 6.0
"""The same in grey levels: quantisation and noise make as much."""


def _square_points(near: float, far: float, low: float, high: float, count: int) -> Array:
    """Return ``count`` points along each side (4 count, 2) of the square from ``low`` to ``high``, template units."""
    along = np.linspace(near, far, count)
    sides = ((along, low), (along, high), (low, along), (high, along))
    return np.concatenate([np.stack(np.broadcast_arrays(x, y), axis=1) for x, y in sides])


def _nearest(points: Array, among: Array, count: int) -> NDArray[np.int64]:
    """Return which ``count`` of the points ``among`` (A, 2) are nearest to each of ``points`` (N, 2)."""
    apart = ((points[:, None] - among) ** 2).sum(axis=2)
    return np.ascontiguousarray(np.argsort(apart, axis=1, kind="stable")[:, :count])


_CENTRES = CELL_SAMPLES.mean(axis=1)
_RING = _square_points(165.0, TEMPLATE_UNITS - 165.0, 165.0, TEMPLATE_UNITS - 165.0, 12)
"""Black in every identity: between the cells and the frame, or the middle, inside them."""
_INK = np.concatenate([ALWAYS_BLACK, _RING])
_MARGIN = _square_points(
    0.02 * TEMPLATE_UNITS, 0.98 * TEMPLATE_UNITS, -0.03 * TEMPLATE_UNITS, 1.03 * TEMPLATE_UNITS, 16
)
"""White around every layer: on the quiet margin, or in the middle of a frame."""
RELIT_SAMPLES = np.concatenate([CELL_SAMPLES.reshape(-1, 2), _INK, _MARGIN])
"""Where a pattern is sampled (S, 2) to be relit, template units."""
_INK_FROM = CELLS * SAMPLES_A_CELL
_MARGIN_FROM = _INK_FROM + len(_INK)
_INK_OF_CELL, _INK_OF_MARGIN = _nearest(_CENTRES, _INK, INK_POINTS), _nearest(_MARGIN, _INK, PAIR_POINTS)
_MARGIN_OF_CELL = _nearest(_CENTRES, _MARGIN, PAIR_POINTS)
_PAPER_OF_CELL = _nearest(_CENTRES, np.concatenate([_CENTRES, _MARGIN]), PAPER_POINTS)


@compiled(VECTOR, INDICES)
def _median(values: Array, which: NDArray[np.int64]) -> float:
    """Return the middle one of those of values (N,) that ``which`` (K,) says."""
    middle = 0.0
    for k in range(len(which)):
        value, below, before = values[which[k]], 0, 0
        for other in range(len(which)):
            below += values[which[other]] < value
            before += values[which[other]] == value and other < k
        middle = value if below + before == len(which) // 2 else middle
    return middle


@compiled(VECTOR, INDICES)
def _second_largest(values: Array, which: NDArray[np.int64]) -> float:
    """Return the second largest of those of values (N,) that ``which`` (K,) says."""
    largest, second = -np.inf, -np.inf
    for k in which:
        largest, second = max(largest, values[k]), max(second, min(largest, values[k]))
    return second


@compiled(REAL)
def _grey(logarithm: float) -> float:
    """Return about which grey value a logarithm of light has."""
    return FULL * math.exp(CODE_EXPONENT * (logarithm - LOG_FULL))


@compiled(VECTOR, VECTOR, VECTOR)
def _relit(samples: Array, ink: Array, margin: Array) -> tuple[Array, Seen]:
    """Return one pattern's cells (48,), and which are seen, from logarithms of light at its samples."""
    levels, ratios = np.empty(CELLS + len(margin)), np.empty(CELLS + len(margin))
    ink_of_cell, beside_margin = np.empty(CELLS), np.empty(len(margin))
    for c in range(CELLS):
        ink_of_cell[c] = _median(ink, _INK_OF_CELL[c])
        levels[c] = samples[c * SAMPLES_A_CELL : (c + 1) * SAMPLES_A_CELL].mean()
        ratios[c] = levels[c] - ink_of_cell[c]
    for m in range(len(margin)):
        ink_of_margin = _median(ink, _INK_OF_MARGIN[m])
        levels[CELLS + m], ratios[CELLS + m] = margin[m], margin[m] - ink_of_margin
        beside_margin[m] = _grey(margin[m]) - _grey(ink_of_margin)
    contrast, clear, visible = np.empty(CELLS), np.empty(CELLS), np.empty(CELLS)
    for c in range(CELLS):
        by_ratio = _second_largest(ratios, _PAPER_OF_CELL[c])
        contrast[c] = min(by_ratio, _second_largest(levels, _PAPER_OF_CELL[c]) - ink_of_cell[c])
        clear[c] = _grey(ink_of_cell[c] + contrast[c]) - _grey(ink_of_cell[c])
        visible[c] = min(clear[c], _median(beside_margin, _MARGIN_OF_CELL[c]))
    ordered, place = np.sort(clear), MOST_CELLS * (CELLS - 1)
    below = int(place)
    exceeded = ordered[below] + (place - below) * (ordered[below + 1] - ordered[below])
    least = max(LEAST_CONTRAST * exceeded, LEAST_CONTRAST_GREY)
    cells, seen = np.zeros(CELLS), visible >= least
    for c in range(CELLS):
        if seen[c]:
            cells[c] = min(max(ratios[c] / contrast[c], 0.0), 1.0)
    return cells, seen


@compiled(LIGHT, PLACES_OF_MANY)
def _relit_cells(light: Light, samples_px: NDArray) -> tuple[Array, Seen]:
    cells, seen = np.empty((len(samples_px), CELLS)), np.empty((len(samples_px), CELLS), dtype=np.bool_)
    logarithm = np.empty(samples_px.shape[1])
    for q in range(len(samples_px)):
        for s in range(len(logarithm)):
            logarithm[s] = math.log(bilinear(light, samples_px[q, s, 0], samples_px[q, s, 1]) + DARKEST)
        cells[q], seen[q] = _relit(logarithm[:_INK_FROM], logarithm[_INK_FROM:_MARGIN_FROM], logarithm[_MARGIN_FROM:])
    return cells, seen


def relit_cells(light: Light, samples_px: Places) -> tuple[Array, Seen]:
    """Return cells (Q, 48) of patterns sampled at ``RELIT_SAMPLES`` (Q, S, 2), 0 ink to 1 paper, and which are seen.

    ``light`` (H, W) is the image in linear light, 0..255.  A cell is hidden where its own ink and paper look alike,
    as saturated ones do, or where the margin nearest to it looks like the border inside it: something lies on both.
    """
    return _relit_cells(light, np.ascontiguousarray(samples_px))


def relit_layer(light: Light, warp: Warp, samples: Array) -> tuple[Array, Seen]:
    """Return the relit cells (48,) seen through a warp at a layer's own ``samples``, and which of them are seen."""
    cells, seen = relit_cells(light, warp(samples)[None])
    return cells[0], seen[0]
