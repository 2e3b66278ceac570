"""Signatures: from a warp of the template into the image to an identity, an orientation and how sure it is.

A *warp* takes template points (700 units to the side, y down) to pixels.  The 48 cells are sampled in the
gray image through it, a smooth illumination surface fitted to points that are black in every identity is
removed, and what is left is correlated with every code in every orientation: soft bits, no threshold.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from astratag.codes import Reading
from astratag.dictionary import Dictionary
from astratag.geometry import (
    CELLS,
    DRAWN_OFFSET,
    LAYERS,
    QUIET_MARGIN,
    TEMPLATE_UNITS,
    cell_polygons,
    layer_points,
    square,
)

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
Warp = Callable[[Array], Array]
"""Takes template points (..., 2) to pixels (..., 2)."""

ACCEPT = 0.72
"""Cells-only correlation of chance patterns exceeds this once in a million candidates."""
ACCEPT_OF_MANY_WARPS = 0.78
"""The same when a candidate is read through several warps and the best counts."""


def _cell_samples() -> Array:
    """Return the sampling points (48, 10, 2) of the cells: a triangular grid, kept off the cells' edges."""
    grid = [(i, j, 3 - i - j) for i in range(4) for j in range(4 - i)]
    weights = 1 / 3 + 0.62 * (np.array(grid) / 3 - 1 / 3)
    return np.einsum("sv,cvd->csd", weights, cell_polygons() + DRAWN_OFFSET)


def _always_black() -> Array:
    """Return points (B, 2) that are black in every identity: the border, and the gaps between the regions."""
    along = np.linspace(0.03, 0.97, 16) * TEMPLATE_UNITS
    low, high = np.full(16, 0.034 * TEMPLATE_UNITS), np.full(16, 0.966 * TEMPLATE_UNITS)
    border = np.concatenate([np.stack(p, axis=1) for p in ((along, low), (along, high), (low, along), (high, along))])
    step = np.linspace(0.0, 1.0, 6)[:, None]
    gap = np.array([60.0, 290.0]) + step * np.array([100.0, -100.0])  # between the top-left and the left region
    gaps = [gap]
    for flip in (lambda p: p[:, ::-1], lambda p: p * (-1, 1) + (700, 0), lambda p: p * (1, -1) + (0, 700)):
        gaps += [flip(g) for g in gaps]
    return np.concatenate([border, *gaps])


def _smooth(points: Array) -> Array:
    """Return the terms (N, 6) of a quadratic surface at template points (N, 2)."""
    x, y = (points / (TEMPLATE_UNITS / 2) - 1.0).T
    return np.stack([np.ones_like(x), x, y, x * y, x * x, y * y], axis=1)


CELL_SAMPLES = _cell_samples()
ALWAYS_BLACK = _always_black()
SAMPLES = np.concatenate([CELL_SAMPLES.reshape(-1, 2), ALWAYS_BLACK])
BLUR_UNITS = (0.0, 60.0, 120.0)
"""Widths of box blurs, template units, at which codes are known: what small squares look like."""
PIXEL_BLUR = 2.8
"""Width in pixels of the box blur that is like a lens's and a pixel's together (sigma 0.8)."""
_ILLUMINATION = _smooth(CELL_SAMPLES.mean(axis=1)) @ np.linalg.pinv(_smooth(ALWAYS_BLACK))
"""Takes the always-black samples (B,) to the black level at the cells (48,)."""


class Codebook:
    """A dictionary ready for correlation."""

    def __init__(self, dictionary: Dictionary) -> None:
        self.dictionary = dictionary
        codes = dictionary.oriented.reshape(-1, CELLS).astype(float)
        self._unit_codes = [unit(codes @ mixing.T + around) for mixing, around in _mixings()]

    def read(self, cells: Array, side_px: Array | None = None) -> list[Reading]:
        """Return the best reading of each row of cells (Q, 48); ``side_px`` (Q,) is how large each square looks."""
        if len(cells) == 0:
            return []
        levels = np.zeros(len(cells), dtype=int) if side_px is None else blur_level(side_px)
        correlations = np.empty((len(cells), len(self._unit_codes[0])))
        for level in np.unique(levels):
            rows = levels == level
            correlations[rows] = np.einsum("qc,kc->qk", unit(cells[rows]), self._unit_codes[level])
        best = correlations.argmax(axis=1)
        wrong = hamming(cells, self.dictionary.oriented.reshape(-1, CELLS)[best])
        return [
            Reading(self.dictionary.ids[b // 4], int(b % 4), float(correlations[q, b]), int(wrong[q]))
            for q, b in enumerate(best)
        ]

    def read_as(self, cells: Array, marker_id: int, side_px: float = np.inf) -> Reading:
        """Return how well cells (48,) fit an upright marker of a known identity that looks ``side_px`` large."""
        row = self.dictionary.ids.index(marker_id)
        codes = self._unit_codes[int(blur_level(np.array(side_px)))]
        correlation = float(unit(cells[None])[0] @ codes[4 * row])
        return Reading(marker_id, 0, correlation, int(hamming(cells[None], self.dictionary.signatures[row][None])[0]))


def blur_level(side_px: Array) -> NDArray[np.int64]:
    """Return which of ``BLUR_UNITS`` is nearest to what a square ``side_px`` large looks like."""
    width = PIXEL_BLUR * TEMPLATE_UNITS / np.maximum(side_px, 1.0)
    return np.abs(np.asarray(width)[..., None] - BLUR_UNITS).argmin(axis=-1)


@lru_cache(maxsize=1)
def _mixings() -> tuple[tuple[Array, Array], ...]:
    """Return, for each of ``BLUR_UNITS``, what cells see of each cell's white (48, 48), and of the margin's (48,)."""
    scale, margin = 0.5, QUIET_MARGIN * TEMPLATE_UNITS
    at = (SAMPLES + margin)[None] * scale - 0.5
    pictures = np.zeros((CELLS + 1, *(round((TEMPLATE_UNITS + 2 * margin) * scale),) * 2), np.uint8)
    pictures[CELLS] = 255
    shapes = (*(cell_polygons() + DRAWN_OFFSET), square(0.0, TEMPLATE_UNITS))
    for picture, polygon, level in zip(pictures, shapes, [255] * CELLS + [0], strict=True):
        cv2.fillPoly(picture, [np.round(((polygon + margin) * scale - 0.5) * 16).astype(np.int32)], level, shift=4)
    mixings = [(np.eye(CELLS), np.zeros(CELLS))]
    for width in BLUR_UNITS[1:]:
        blurred = (cv2.blur(picture, (round(width * scale),) * 2) for picture in pictures)
        seen = np.concatenate([cell_values(picture, at) for picture in blurred]) / 255.0
        mixings.append((seen[:CELLS].T, seen[CELLS]))
    return tuple(mixings)


def unit(cells: Array) -> Array:
    """Return rows (Q, N) with zero mean and unit length; a row without contrast becomes zero."""
    centred = cells - cells.mean(axis=1, keepdims=True)
    length = np.linalg.norm(centred, axis=1, keepdims=True)
    return centred / np.where(length > 1e-9, length, np.inf)


def hamming(cells: Array, codes: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Return how many cells of each row (Q, 48) are on the wrong side of half way from its code's black to white."""
    ones = codes.sum(axis=1)
    white = (cells * codes).sum(axis=1) / np.maximum(ones, 1)
    black = (cells * (1 - codes)).sum(axis=1) / np.maximum(CELLS - ones, 1)
    return ((cells > ((white + black) / 2)[:, None]) != (codes == 1)).sum(axis=1)


def sample(gray: Image, points_px: Array | NDArray[np.float32]) -> Array:
    """Return gray values at pixels (N, M, 2), interpolated; 0 outside the image."""
    points = np.clip(points_px.astype(np.float32, copy=False), -1e4, 1e4)
    flat = points.reshape(-1, 1, 2)
    if len(flat) < 32_000:
        return cv2.remap(gray, flat, None, cv2.INTER_LINEAR).reshape(points.shape[:-1]).astype(float)
    return cv2.remap(gray, points, None, cv2.INTER_LINEAR).astype(float)


def cell_values(gray: Image, samples_px: Array | NDArray[np.float32]) -> Array:
    """Return the 48 cell means (Q, 48), black level removed, of patterns sampled at ``SAMPLES`` (Q, S, 2)."""
    values = sample(gray, samples_px)
    cells = values[:, : CELL_SAMPLES.shape[0] * CELL_SAMPLES.shape[1]].reshape(len(values), CELLS, -1).mean(axis=2)
    # einsum, not @: products of this size wake BLAS threads that cost more than they save
    return cells - np.einsum("qb,cb->qc", values[:, -len(ALWAYS_BLACK) :], _ILLUMINATION)


def layer_cells(gray: Image, warp: Warp, layer: int) -> Array:
    """Return the cells (48,) of one layer of a marker whose print is warped into the image."""
    return cell_values(gray, warp(layer_points(SAMPLES, LAYERS[layer]))[None])[0]


class Artwork:
    """What the whole print looks like around a square read in it, for each layer that square may be."""

    GRID = 32
    REACH = 0.12
    """How far beyond the square to look, as a fraction of its side: less than the quiet margin."""
    UNITS_PER_PIXEL = 1.0

    def __init__(self, dictionary: Dictionary) -> None:
        self._dictionary = dictionary
        self._expected: dict[tuple[int, float], Array] = {}
        span = np.linspace(-self.REACH, 1 + self.REACH, self.GRID) * TEMPLATE_UNITS
        self.points = np.stack(np.meshgrid(span, span), axis=-1).reshape(-1, 2)
        """Where to sample (N, 2), as if the square were the outermost."""

    def expected(self, marker_id: int, side_px: float = np.inf) -> Array:
        """Return the print's brightness (3, N) at ``points`` for each layer the square may be, ``side_px`` large."""
        softness = BLUR_UNITS[int(blur_level(np.array(side_px)))] / TEMPLATE_UNITS
        key = marker_id, softness
        if key not in self._expected:
            picture = self._picture(self._dictionary.signature(marker_id))
            sampled = []
            for layer in LAYERS:
                finest = max((1 + 2 * self.REACH) / (self.GRID - 1), softness)
                spacing = layer.scale * TEMPLATE_UNITS * finest / self.UNITS_PER_PIXEL
                blurred = cv2.blur(picture, (max(1, round(spacing)),) * 2)
                at = (layer_points(self.points, layer) + QUIET_MARGIN * TEMPLATE_UNITS) / self.UNITS_PER_PIXEL - 0.5
                sampled.append(sample(blurred, at[None])[0])
            self._expected[key] = np.array(sampled)
        return self._expected[key]

    def _picture(self, code: NDArray[np.uint8]) -> Image:
        """Return the print with its margin, a unit to the pixel."""
        margin = QUIET_MARGIN * TEMPLATE_UNITS
        size = round((TEMPLATE_UNITS + 2 * margin) / self.UNITS_PER_PIXEL)
        picture = np.full((size, size), 255, np.uint8)

        def fill(polygon: Array, value: int) -> None:
            at = (polygon + margin) / self.UNITS_PER_PIXEL - 0.5
            cv2.fillPoly(picture, [np.round(at * 16).astype(np.int32)], value, shift=4)

        def box(near: float, far: float) -> Array:
            return np.array([(near, near), (far, near), (far, far), (near, far)])

        for layer in LAYERS:
            if layer.frame is not None:
                fill(box(*layer.frame), 255)
            fill(box(*layer.black), 0)
            for cell in cell_polygons()[code == 1] + DRAWN_OFFSET:
                fill(layer_points(cell, layer), 255)
        return picture

    def likeness(self, gray: Image, warp: Warp, marker_id: int, side_px: float = np.inf) -> float:
        """Return the correlation of a whole print with the image seen through its warp."""
        return float(self.layer_scores(gray, warp, marker_id, side_px)[0])

    def layer_scores(self, gray: Image, square_warp: Warp, marker_id: int, side_px: float = np.inf) -> Array:
        """Return how well (3,) the surroundings of a square fit it being layer 0, 1 or 2, as correlations.

        ``square_warp`` takes the template to the image as if the square were the outermost.
        Points outside the image do not count.
        """
        at = square_warp(self.points)
        height, width = gray.shape
        inside = (at >= 0).all(axis=1) & (at[:, 0] <= width - 1) & (at[:, 1] <= height - 1)
        if inside.sum() < 16:
            return np.zeros(len(LAYERS))
        seen = unit(sample(gray, at[None, inside]))[0]
        return unit(self.expected(marker_id, side_px)[:, inside]) @ seen
