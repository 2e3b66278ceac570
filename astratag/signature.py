"""Signatures: from a warp of the template into the image to an identity, an orientation and how sure it is.

A *warp* takes template points (700 units to the side, y down) to pixels.  The 48 cells are sampled in the
gray image through it, a smooth illumination surface fitted to points that are black in every identity is
removed, and what is left is correlated with every code in every orientation: soft bits, no threshold.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial

import cv2
import numpy as np
from numpy.typing import NDArray

from astratag.codes import Reading, acceptance_threshold
from astratag.codes.acceptance import FALSE_ACCEPT_RATE
from astratag.codes.soft import correlations
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
Brightness = NDArray[np.uint8] | NDArray[np.float32]
"""An image (H, W): gray values as they are, or linear light."""
Warp = Callable[[Array], Array]
"""Takes template points (..., 2) to pixels (..., 2)."""

PROMISING_RATE = 0.02
"""The share of chance patterns that may read well enough to be worth fitting."""
LIKELY_RATE = 0.001
"""The share whose reading through the edges of one layer may be worth fitting all the others."""
EFFECTIVE_SHARE = 45 / CELLS
"""How many independent cells one counts for: by ``effective_cells``, of squares of any size in 130 000 photographs'."""
LEAST_SEEN = CELLS // 2
"""With fewer cells seen chance fits better than it should: what hides the others has a shape too."""


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
_LAYER_SAMPLES = [layer_points(SAMPLES, layer) for layer in LAYERS]
for _samples in _LAYER_SAMPLES:
    _samples.flags.writeable = False  # so that warps may keep where they are on a surface
BLUR_UNITS = (0.0, 60.0, 120.0)
"""Widths of box blurs, template units, at which codes are known: what small squares look like."""
BLURRED_CELLS = (CELLS, 25, 21)
"""How many cells a correlation with such codes is worth, measured likewise: blur makes them alike."""
PIXEL_BLUR = 2.8
"""Width in pixels of the box blur that is like a lens's and a pixel's together (sigma 0.8)."""
_ILLUMINATION = _smooth(CELL_SAMPLES.mean(axis=1)) @ np.linalg.pinv(_smooth(ALWAYS_BLACK))
"""Takes the always-black samples (B,) to the black level at the cells (48,)."""


class Codebook:
    """A dictionary ready for correlation, and which correlations are more than chance.

    ``tau_hamming``, unless None, is the paper's rule instead: so many cells may be wrong.
    """

    def __init__(
        self,
        dictionary: Dictionary,
        false_accept_rate: float = FALSE_ACCEPT_RATE,
        tau_hamming: int | None = None,
    ) -> None:
        if tau_hamming is not None and not (isinstance(tau_hamming, int) and 0 <= tau_hamming < CELLS):
            raise ValueError(f"tau_hamming is how many of {CELLS} cells may be wrong, an integer, got {tau_hamming!r}")
        self.dictionary = dictionary
        self.false_accept_rate = false_accept_rate
        self.tau_hamming = tau_hamming
        self._codes = dictionary.oriented.reshape(-1, CELLS).astype(float)
        self.unit_codes = [unit(self._codes @ mixing.T + around) for mixing, around in _mixings()]
        self._threshold = lru_cache(maxsize=None)(partial(acceptance_threshold, len(self._codes)))
        self.least(1)  # refuses a rate that is none

    def least(self, warps: int, cells: int = CELLS) -> float:
        """Return the correlation that the best of ``warps`` readings of a chance pattern rarely exceeds."""
        return self._threshold(warps, self.false_accept_rate, EFFECTIVE_SHARE * cells)

    def least_blurred(self, other_chance: float) -> float:
        """Return the same of the most blurred codes, for squares also asked for what chance has so seldom."""
        rate = min(self.false_accept_rate / other_chance, PROMISING_RATE)
        return self._threshold(1, rate, EFFECTIVE_SHARE * BLURRED_CELLS[-1])

    def promising(self, cells: int = CELLS) -> float:
        """Return the correlation through a rough quad from which it is worth fitting."""
        return self._threshold(1, PROMISING_RATE, EFFECTIVE_SHARE * cells)

    def likely(self, cells: int) -> float:
        """Return the correlation through one layer's own edges from which the others are worth fitting."""
        return self._threshold(1, LIKELY_RATE, EFFECTIVE_SHARE * cells)

    def excess(self, reading: Reading) -> float:
        """Return how much better a reading correlates than chance would."""
        return reading.correlation - self.least(1, reading.cells)

    def accepts(self, reading: Reading, warps: int) -> bool:
        """Return whether a reading, the best of so many ``warps`` and blurs, is a marker's."""
        if self.tau_hamming is not None:
            return reading.hamming <= self.tau_hamming
        return reading.correlation >= self.least(warps * len(BLUR_UNITS), reading.cells)

    def read(self, cells: Array, side_px: Array | None = None) -> list[Reading]:
        """Return the best reading of each row of cells (Q, 48); ``side_px`` (Q,) is how large each square looks."""
        if len(cells) == 0:
            return []
        levels = np.zeros(len(cells), dtype=int) if side_px is None else blur_level(side_px)
        found = np.empty((len(cells), len(self._codes)))
        for level in np.unique(levels):
            rows = levels == level
            found[rows] = np.einsum("qc,kc->qk", unit(cells[rows]), self.unit_codes[level])
        return self._best(found, cells, np.ones(cells.shape, dtype=bool))

    def read_seen(self, cells: Array, seen: NDArray[np.bool_]) -> list[Reading]:
        """Return the best reading of each row of cells (Q, 48) when only those that are ``seen`` (Q, 48) count."""
        return self._best(correlations(cells, seen, self._codes), cells, seen)

    def _best(self, found: Array, cells: Array, seen: NDArray[np.bool_]) -> list[Reading]:
        """Return the readings that correlate best among all ``found`` (Q, 4 N)."""
        best = found.argmax(axis=1)
        wrong = hamming(cells, self.dictionary.oriented.reshape(-1, CELLS)[best], seen)
        count = seen.sum(axis=1)
        return [
            Reading(self.dictionary.ids[b // 4], int(b % 4), float(found[q, b]), int(wrong[q]), cells=int(count[q]))
            for q, b in enumerate(best)
        ]

    def read_as(self, cells: Array, marker_id: int, side_px: float | None = None) -> Reading:
        """Return how well cells (48,) fit an upright marker of a known identity.

        One that looks ``side_px`` large, or as blurred as chance explains least.
        """
        row = self.dictionary.row(marker_id)
        found = np.array([codes[4 * row] for codes in self.unit_codes]) @ unit(cells[None])[0]
        if side_px is None:
            level = int((found - [self.least(1, worth) for worth in BLURRED_CELLS]).argmax())
        else:
            level = int(blur_level(np.array(side_px)))
        wrong = int(hamming(cells[None], self.dictionary.signatures[row][None])[0])
        return Reading(marker_id, 0, float(found[level]), wrong, cells=BLURRED_CELLS[level])

    def read_seen_as(self, cells: Array, seen: NDArray[np.bool_], marker_id: int) -> Reading:
        """Return how well the ``seen`` (48,) of cells (48,) fit an upright marker of a known identity."""
        code = self.dictionary.signature(marker_id)[None]
        if seen.sum() < LEAST_SEEN:
            return Reading(marker_id, 0, 0.0, int(seen.sum()), cells=LEAST_SEEN)
        correlation = float(correlations(cells, seen[None], code.astype(float))[0, 0])
        wrong = int(hamming(cells[None], code, seen[None])[0])
        return Reading(marker_id, 0, correlation, wrong, cells=int(seen.sum()))


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


def hamming(cells: Array, codes: NDArray[np.uint8], seen: NDArray[np.bool_] | None = None) -> NDArray[np.int64]:
    """Return how many of the ``seen`` cells of each row (Q, 48) are on the wrong side of half way from black to white.

    Half way between the means of those that its code (Q, 48) has black and white.
    """
    white, black = codes == 1, codes == 0
    if seen is None:
        seen = np.ones(cells.shape, dtype=bool)
    white, black = white & seen, black & seen
    middle = sum((cells * part).sum(axis=1) / np.maximum(part.sum(axis=1), 1) for part in (white, black)) / 2
    return (seen & ((cells > middle[:, None]) != white)).sum(axis=1)


def sample(gray: Brightness, points_px: Array | NDArray[np.float32]) -> Array:
    """Return gray or light values at pixels (N, M, 2), interpolated; 0 outside the image."""
    points = np.clip(points_px.astype(np.float32, copy=False), -1e4, 1e4)
    flat = points.reshape(-1, 1, 2)
    if len(flat) < 32_000:
        return cv2.remap(gray, flat, None, cv2.INTER_LINEAR).reshape(points.shape[:-1]).astype(float)
    return cv2.remap(gray, points, None, cv2.INTER_LINEAR).astype(float)


def cell_values(gray: Brightness, samples_px: Array | NDArray[np.float32]) -> Array:
    """Return the 48 cell means (Q, 48), black level removed, of patterns sampled at ``SAMPLES`` (Q, S, 2)."""
    values = sample(gray, samples_px)
    cells = values[:, : CELL_SAMPLES.shape[0] * CELL_SAMPLES.shape[1]].reshape(len(values), CELLS, -1).mean(axis=2)
    # einsum, not @: products of this size wake BLAS threads that cost more than they save
    return cells - np.einsum("qb,cb->qc", values[:, -len(ALWAYS_BLACK) :], _ILLUMINATION)


def layer_cells(gray: Brightness, warp: Warp, layer: int) -> Array:
    """Return the cells (48,) of one layer of a marker whose print is warped into the image."""
    return cell_values(gray, warp(_LAYER_SAMPLES[layer])[None])[0]


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
