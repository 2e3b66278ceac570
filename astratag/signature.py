"""Signatures: from a warp of the template into the image to an identity, an orientation and how sure it is.

A *warp* takes template points (700 units to the side, y down) to pixels.  The 48 cells are sampled in the
gray image through it, a smooth illumination surface fitted to points that are black in every identity is
removed, and what is left is correlated with every code in every orientation: soft bits, no threshold.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cached_property, lru_cache, partial

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from astratag.codes import Reading, acceptance_threshold
from astratag.codes.acceptance import FALSE_ACCEPT_RATE
from astratag.codes.soft import correlations
from astratag.compiled import (
    BITS,
    CUBE,
    FLAG_MATRIX,
    GRAY,
    INDICES,
    INT,
    MATRIX,
    PLACES_OF_MANY,
    VECTOR,
    compiled,
)
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
from astratag.normal import dot
from astratag.sampling import AS_GRAY, Light, Places, between, fading, light_between, sample

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
Warp = Callable[[Array], Array]
"""Takes template points (..., 2) to pixels (..., 2)."""

PROMISING_RATE = 0.02
"""The share of chance patterns that may read well enough to be worth fitting."""
LIKELY_RATE = 0.001
"""The share whose reading through the edges of one layer may be worth fitting all the others."""
EFFECTIVE_SHARE = 45 / CELLS
"""How many independent cells one counts for: by ``effective_cells``, of squares of any size in 130 000 photographs'."""
LEAST_POINTS = 16
"""With fewer points of a print in the image nothing is said of its looks."""
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
CELL_MIDDLES = cell_polygons().mean(axis=1)
_LAYER_SAMPLES = [layer_points(SAMPLES, layer) for layer in LAYERS]
for _samples in _LAYER_SAMPLES:
    _samples.flags.writeable = False  # so that warps may keep where they are on a surface
BLUR_UNITS = (0.0, 60.0, 120.0)
"""Widths of box blurs, template units, at which codes are known: what small squares look like."""
_HALF_WAY = (np.array(BLUR_UNITS[:-1]) + BLUR_UNITS[1:]) / 2
BLURRED_CELLS = (CELLS, 25, 21)
"""How many cells a correlation with such codes is worth, measured likewise: blur makes them alike."""
PIXEL_BLUR = 2.8
"""Width in pixels of the box blur that is like a lens's and a pixel's together (sigma 0.8)."""
_ILLUMINATION = np.ascontiguousarray((_smooth(CELL_SAMPLES.mean(axis=1)) @ np.linalg.pinv(_smooth(ALWAYS_BLACK))).T)
"""What each of the always-black samples adds to the black level at the cells (B, 48)."""
SAMPLES_A_CELL = CELL_SAMPLES.shape[1]
LEAST_LENGTH = 1e-9
"""Brightnesses without their mean that are shorter than this have no contrast."""


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
        self._bits = np.ascontiguousarray(dictionary.oriented.reshape(-1, CELLS))
        self._codes = self._bits.astype(float)
        self.unit_codes = np.stack([unit(self._codes @ mixing.T + around) for mixing, around in _mixings()])
        """All readings (3, 4 N, 48) at each of ``BLUR_UNITS``, with zero mean and unit length."""
        self._by_cell = np.ascontiguousarray(self.unit_codes.transpose(0, 2, 1))
        self._upright = np.ascontiguousarray(self.unit_codes[:, ::4].transpose(1, 0, 2))
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
        best, found, wrong = self._best(cells, side_px)
        return self._readings(best, found, wrong, np.full(len(cells), CELLS))

    def likeliest(self, glances: Array, most: int) -> NDArray[np.int64]:
        """Return the rows of glances at cells (Q, 48), ``most`` at most, that are most like a code, the best first."""
        return np.argsort(-(unit(glances) @ self.unit_codes[0].T).max(axis=1), kind="stable")[:most]

    def best_readings(
        self, cells: Array, least: Array, most: int, side_px: Array | None = None
    ) -> list[tuple[int, Reading]]:
        """Return the rows that correlate with at least ``least`` (Q,) and their readings, the best first."""
        best, found, wrong = self._best(cells, side_px)
        rows = np.argsort(-found, kind="stable")
        rows = rows[found[rows] >= least[rows]][:most]
        readings = self._readings(best[rows], found[rows], wrong[rows], np.full(len(rows), CELLS))
        return list(zip(rows.tolist(), readings, strict=True))

    def _best(self, cells: Array, side_px: Array | None) -> tuple[NDArray[np.int64], Array, NDArray[np.int64]]:
        levels = np.zeros(len(cells), dtype=np.int64) if side_px is None else blur_level(side_px)
        return _best_codes(cells, levels, self._by_cell, self._bits)

    def read_seen(self, cells: Array, seen: NDArray[np.bool_]) -> list[Reading]:
        """Return the best reading of each row of cells (Q, 48) when only those that are ``seen`` (Q, 48) count."""
        found = correlations(cells, seen, self._codes)
        best = found.argmax(axis=1)
        wrong = hamming(cells, self._bits[best], seen)
        return self._readings(best, found[np.arange(len(best)), best], wrong, seen.sum(axis=1))

    def _readings(
        self, best: NDArray[np.int64], found: Array, wrong: NDArray[np.int64], count: NDArray[np.int64]
    ) -> list[Reading]:
        """Return the readings: the ``best`` (Q,) of all codes, how these correlate, and how many cells are wrong."""
        rows = zip(best.tolist(), found.tolist(), wrong.tolist(), count.tolist(), strict=True)
        return [
            Reading(self.dictionary.ids[code // 4], code % 4, correlation, differ, cells=cells)
            for code, correlation, differ, cells in rows
        ]

    def read_as(self, cells: Array, marker_id: int, side_px: float | None = None) -> Reading:
        """Return how well cells (48,) fit an upright marker of a known identity.

        One that looks ``side_px`` large, or as blurred as chance explains least.
        """
        row, level = self.dictionary.row(marker_id), -1 if side_px is None else int(blur_level(side_px))
        printed = self.dictionary.signatures[row : row + 1]
        correlation, level, wrong = _read_as(cells[None], self._upright[row], printed, self._least_of_levels, level)
        return Reading(marker_id, 0, correlation, wrong, cells=BLURRED_CELLS[level])

    @cached_property
    def _least_of_levels(self) -> Array:
        """Return which correlation (3,) with codes at each of ``BLUR_UNITS`` chance rarely exceeds."""
        return np.array([self.least(1, worth) for worth in BLURRED_CELLS])

    def read_seen_as(self, cells: Array, seen: NDArray[np.bool_], marker_id: int) -> Reading:
        """Return how well the ``seen`` (48,) of cells (48,) fit an upright marker of a known identity."""
        code = self.dictionary.signature(marker_id)[None]
        if seen.sum() < LEAST_SEEN:
            return Reading(marker_id, 0, 0.0, int(seen.sum()), cells=LEAST_SEEN)
        correlation = float(correlations(cells, seen[None], code.astype(float))[0, 0])
        wrong = int(hamming(cells[None], code, seen[None])[0])
        return Reading(marker_id, 0, correlation, wrong, cells=int(seen.sum()))


def blur_level(side_px: ArrayLike) -> NDArray[np.int64]:
    """Return which of ``BLUR_UNITS`` is nearest to what a square ``side_px`` large looks like."""
    return np.searchsorted(_HALF_WAY, PIXEL_BLUR * TEMPLATE_UNITS / np.maximum(side_px, 1.0))


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


@compiled(MATRIX)
def unit(cells: Array) -> Array:
    """Return rows (Q, N) with zero mean and unit length; a row without contrast becomes zero."""
    rows = np.empty_like(cells)
    for q in range(len(cells)):
        mean = cells[q].sum() / cells.shape[1]
        energy = 0.0
        for n in range(cells.shape[1]):
            rows[q, n] = cells[q, n] - mean
            energy += rows[q, n] ** 2
        length = math.sqrt(energy)
        for n in range(cells.shape[1]):
            rows[q, n] *= 1 / length if length > LEAST_LENGTH else 0.0
    return rows


def hamming(cells: Array, codes: NDArray[np.uint8], seen: NDArray[np.bool_] | None = None) -> NDArray[np.int64]:
    """Return how many of the ``seen`` cells of each row (Q, 48) are on the wrong side of half way from black to white.

    Half way between the means of those that its code (Q, 48) has black and white.
    """
    return _wrong(cells, codes, np.ones(cells.shape, dtype=bool) if seen is None else seen)


@compiled(MATRIX, BITS, FLAG_MATRIX)
def _wrong(cells: Array, codes: NDArray[np.uint8], seen: NDArray[np.bool_]) -> NDArray[np.int64]:
    wrong = np.zeros(len(cells), dtype=np.int64)
    for q in range(len(cells)):
        total, count = np.zeros(2), np.zeros(2)
        for c in range(CELLS):
            if seen[q, c]:
                total[codes[q, c]] += cells[q, c]
                count[codes[q, c]] += 1
        half_way = (total[0] / max(count[0], 1.0) + total[1] / max(count[1], 1.0)) / 2
        for c in range(CELLS):
            wrong[q] += seen[q, c] and (cells[q, c] > half_way) != (codes[q, c] == 1)
    return wrong


@compiled(MATRIX, INDICES, CUBE, BITS)
def _best_codes(
    cells: Array, level: NDArray[np.int64], codes: Array, bits: NDArray[np.uint8]
) -> tuple[NDArray[np.int64], Array, NDArray[np.int64]]:
    """Return which code (Q,) each row of cells (Q, 48) correlates with best, how well (Q,), and its wrong cells (Q,).

    ``codes`` (L, 48, K) are of unit length, at the ``level`` (Q,) of blur of each row; ``bits`` (K, 48) as printed.
    """
    rows, best, correlation = unit(cells), np.empty(len(cells), dtype=np.int64), np.empty(len(cells))
    printed = np.empty(cells.shape, dtype=np.uint8)
    for q in range(len(cells)):
        found = np.zeros(codes.shape[2])
        for c in range(CELLS):
            cell, white = rows[q, c], codes[level[q], c]
            for k in range(len(found)):
                found[k] += cell * white[k]
        best[q] = found.argmax()
        correlation[q] = found[best[q]]
        printed[q] = bits[best[q]]
    return best, correlation, _wrong(cells, printed, np.ones(cells.shape, dtype=np.bool_))


@compiled(MATRIX, MATRIX, BITS, VECTOR, INT)
def _read_as(
    cells: Array, codes: Array, printed: NDArray[np.uint8], least: Array, level: int
) -> tuple[float, int, int]:
    """Return how well cells (1, 48) correlate with a code, at which level of blur, and how many of them are wrong.

    ``codes`` (L, 48) are of unit length and ``printed`` (1, 48) as it is; a negative ``level`` is the one at which the
    correlation most exceeds the ``least`` (L,).
    """
    row, found = unit(cells)[0], np.empty(len(codes))
    for k in range(len(codes)):
        found[k] = dot(codes[k], row)
    if level < 0:
        level = int((found - least).argmax())
    return found[level], level, _wrong(cells, printed, np.ones(cells.shape, dtype=np.bool_))[0]


def cell_values(gray: Image, samples_px: Places, of_gray: Array = AS_GRAY) -> Array:
    """Return the 48 cell means (Q, 48), black level removed, of patterns sampled at ``SAMPLES`` (Q, S, 2).

    Of what ``of_gray`` (256,) makes of each gray value.
    """
    return _cells(gray, of_gray, np.ascontiguousarray(samples_px), _ILLUMINATION)


@compiled(GRAY, VECTOR, PLACES_OF_MANY, MATRIX)
def _cells(gray: Image, of_gray: Array, samples_px: NDArray, illumination: Array) -> Array:
    """Return cells (Q, 48) of patterns sampled at cells, and where they are black, (Q, S, 2).

    Each black sample adds a row of ``illumination`` (B, 48) to the black level at the cells.
    """
    cells = np.zeros((len(samples_px), CELLS))
    values = np.empty(samples_px.shape[1])
    for q in range(len(cells)):
        for s in range(len(values)):
            x, y = samples_px[q, s, 0], samples_px[q, s, 1]
            values[s] = light_between(gray, of_gray, x, y) * fading(x, y, gray.shape[0], gray.shape[1])
        for c in range(CELLS):
            cells[q, c] = values[c * SAMPLES_A_CELL : (c + 1) * SAMPLES_A_CELL].mean()
        for b in range(len(illumination)):
            for c in range(CELLS):
                cells[q, c] -= values[CELLS * SAMPLES_A_CELL + b] * illumination[b, c]
    return cells


def layer_cells(light: Light, warp: Warp, layer: int) -> Array:
    """Return the cells (48,) of one layer of a marker whose print is warped into the image."""
    return cell_values(light.gray, warp(_LAYER_SAMPLES[layer])[None], light.of_gray)[0]


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
        self.points.flags.writeable = False  # so that warps may keep where they are on a surface
        """Where to sample (N, 2), as if the square were the outermost."""
        row, column = np.divmod(np.arange(len(self.points)), self.GRID)
        self.half = np.flatnonzero((row + column) % 2 == 0)
        """Which of these do nearly as well: every other one, as the white squares of a chessboard."""

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
        at_px = np.ascontiguousarray(square_warp(self.points))
        return _likenesses(gray, at_px, self.expected(marker_id, side_px))


@compiled(GRAY, MATRIX, MATRIX)
def _likenesses(gray: Image, at_px: Array, expected: Array) -> Array:
    """Return the correlations (L,) of an image at those pixels (N, 2) that are inside it with pictures (L, N)."""
    height, width = gray.shape
    seen = np.zeros(len(at_px), dtype=np.int64)
    count = 0
    for n in range(len(at_px)):
        if 0 <= at_px[n, 0] <= width - 1 and 0 <= at_px[n, 1] <= height - 1:
            seen[count] = n
            count += 1
    likenesses = np.zeros(len(expected))
    if count < LEAST_POINTS:
        return likenesses
    rows = np.empty((1 + len(expected), count))
    for i in range(count):
        rows[0, i] = between(gray, at_px[seen[i], 0], at_px[seen[i], 1])
        for layer in range(len(expected)):
            rows[1 + layer, i] = expected[layer, seen[i]]
    rows = unit(rows)
    for layer in range(len(expected)):
        likenesses[layer] = (rows[0] * rows[1 + layer]).sum()
    return likenesses
