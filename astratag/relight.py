"""Relit cells: what the cells of a pattern would read under even light, and which of them light or coverings hide.

A hard shadow multiplies light, glare adds to it until the image saturates.  So every cell is judged against the
ink and the paper around it, in logarithms of linear light.  *Ink* is what the nearest points show that are black in
every identity.  *Paper* is the brightest nearby, either as a level (in glare nothing is brighter than saturated) or
as a ratio to its own ink (that is the same in shadow and out of it), whichever is darker.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from astratag.geometry import CELLS, TEMPLATE_UNITS
from astratag.signature import ALWAYS_BLACK, CELL_SAMPLES, Warp, sample

Array = NDArray[np.float64]
Light = NDArray[np.float32]
Seen = NDArray[np.bool_]

FULL = 255.0
DARKEST = 0.5
"""Linear light, of 255, that is added before logarithms are taken: what is darker is noise."""
CODE_EXPONENT = 1 / 2.4
"""Grey values are about this power of light: noise is alike in all of them, in light it is not."""
INK_POINTS, PAIR_POINTS, PAPER_POINTS = 7, 3, 12
"""Neighbours that tell a cell's ink, a margin point's ink or a cell's margin, and a cell's paper.

Odd, because medians of them follow the edge of a shadow; a dozen cells and margin points always have paper in them.
"""
BRIGHTEST = 2
"""Paper is the second brightest of its neighbours: the brightest may be noise."""
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
    return np.argsort(((points[:, None] - among) ** 2).sum(axis=2), axis=1, kind="stable")[:, :count]


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
_PARTS = np.cumsum([CELL_SAMPLES.shape[0] * CELL_SAMPLES.shape[1], len(_INK)])
_INK_OF_CELL, _INK_OF_MARGIN = _nearest(_CENTRES, _INK, INK_POINTS), _nearest(_MARGIN, _INK, PAIR_POINTS)
_MARGIN_OF_CELL = _nearest(_CENTRES, _MARGIN, PAIR_POINTS)
_PAPER_OF_CELL = _nearest(_CENTRES, np.concatenate([_CENTRES, _MARGIN]), PAPER_POINTS)


def relit_cells(light: Light, samples_px: Array | NDArray[np.float32]) -> tuple[Array, Seen]:
    """Return cells (Q, 48) of patterns sampled at ``RELIT_SAMPLES`` (Q, S, 2), 0 ink to 1 paper, and which are seen.

    ``light`` (H, W) is the image in linear light, 0..255.  A cell is hidden where its own ink and paper look alike,
    as saturated ones do, or where the margin nearest to it looks like the border inside it: something lies on both.
    """
    samples, ink, margin = np.split(np.log(sample(light, samples_px) + DARKEST), _PARTS, axis=1)
    cells = samples.reshape(len(samples), CELLS, -1).mean(axis=2)
    ink_of_cell, ink_of_margin = np.median(ink[:, _INK_OF_CELL], axis=2), np.median(ink[:, _INK_OF_MARGIN], axis=2)
    levels = np.concatenate([cells, margin], axis=1)
    ratios = np.concatenate([cells - ink_of_cell, margin - ink_of_margin], axis=1)
    contrast = np.minimum(_paper(ratios), _paper(levels) - ink_of_cell)
    clear = _grey(ink_of_cell + contrast) - _grey(ink_of_cell)
    beside = np.median((_grey(margin) - _grey(ink_of_margin))[:, _MARGIN_OF_CELL], axis=2)
    least = LEAST_CONTRAST * np.quantile(clear, MOST_CELLS, axis=1, keepdims=True)
    seen = np.minimum(clear, beside) >= np.maximum(least, LEAST_CONTRAST_GREY)
    return np.where(seen, np.clip((cells - ink_of_cell) / np.where(seen, contrast, 1.0), 0.0, 1.0), 0.0), seen


def relit_layer(light: Light, warp: Warp, samples: Array) -> tuple[Array, Seen]:
    """Return the relit cells (48,) seen through a warp at a layer's own ``samples``, and which of them are seen."""
    cells, seen = relit_cells(light, warp(samples)[None])
    return cells[0], seen[0]


def _paper(brightness: Array) -> Array:
    """Return the second largest (Q, 48) of what is around each cell, of cells and margin (Q, 48 + M)."""
    return np.partition(brightness[:, _PAPER_OF_CELL], -BRIGHTEST, axis=2)[..., -BRIGHTEST]


def _grey(logarithm: Array) -> Array:
    """Return about which grey value a logarithm of light has."""
    return FULL * (np.exp(logarithm) / FULL) ** CODE_EXPONENT
