"""Synthesis: what a print looks like through a warp and a blur, and moving both until the image looks like that.

Where a marker is a few pixels wide, or blurred until its cells run together, neither edges nor cells can be measured
one by one; every pixel still tells of all of them at once.  The print is sampled at points of a grid on it.  What a
pixel there would see is the mean of the artwork under a Gaussian in the image, carried to the print by the warp's
local derivative: right for any slant and any curvature.  The same sums with other weights are the derivatives by
place and by blur (C. Stein, "Estimation of the mean of a multivariate normal distribution", 1981), so that one
Gauss-Newton step costs one look-up.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Generic, NamedTuple, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from astratag.compiled import CUBE, GRAY, MATRIX, VECTOR, compiled
from astratag.dictionary import Dictionary
from astratag.geometry import (
    CELLS,
    DRAWN_OFFSET,
    LAYERS,
    QUIET_MARGIN,
    SQUARES,
    TEMPLATE_UNITS,
    cell_polygons,
    layer_points,
    square,
)
from astratag.grid import FINE_LINES, LAYER_REACH, MOST_AT_A_GLANCE, MOST_LINES, Look, lines_across, look
from astratag.looks import AROUND, BY_BLUR, BY_X, BY_Y, MEAN, OUTSIDE, looks
from astratag.normal import left_over
from astratag.steps import contrast, step, values
from astratag.warp import FittedWarp

Array = NDArray[np.float64]
Light = NDArray[np.float32]
Seen = NDArray[np.bool_]
Seeing = tuple[Seen, Array, Array, Array]
W = TypeVar("W", bound=FittedWarp)

BLACK, WHITE, BEYOND = range(3)
"""Labels of what is always ink, always paper, and no longer the print; the cells' follow in their order."""
FIRST_CELL = BEYOND + 1
LABELS = FIRST_CELL + CELLS
OF_COMMON = 3 + FIRST_CELL
"""What all identities have in common: light that varies in a plane, and the labels that are no cells."""
KEPT_PICTURES = 64
FEWER_NODES, MANY_NODES = 24, 64
"""Points that stand for the Gaussian a pixel sees through, of a sharp picture; at a glance, and well."""
WIDE = 1.8
"""Where, at a slant, what is left of the blur is so many times the picture's softness one way, two rings are coarse."""
NODES_ALONG, NODES_ACROSS, ENDS = (9, 17, 33), 3, 3.0
"""Nodes in rows along the way a blur is longest, evenly spaced to so many standard deviations, and rows of them."""
APART = 1.5
"""How far apart these are at most, as far as there are so many, over the picture's softness."""
TEXELS = 4.0
"""Texels to a picture's blur."""
SIGMA_FLOOR_PX = 0.002
"""What a point's standard deviation never falls below: print, lens model, shape of the blur."""
SQUARELY, MOST_SLANTED, SLANTING = 1.3, 6.0, 2.2
"""Prints that look more than so many times smaller one way than the other are off by more than noise moves them: their
variance grows by this power of how many times more, up to a limit.  A blur is not as round there as it is taken for,
nor a print as straight within it.  Measured on 40 pictures each of markers of 20 to 48 px, and turned by 70 to 80
degrees."""
LEAST_BLUR_PX, MOST_BLUR_PX = 0.5, 8.0
STEPS, SETTLED_PX = 6, 0.02
TINY = 1e-9

ASIDE = (1e-4, 2e-4)
"""How far from a texel's centre, this way and that by turns, it is looked what is there: on an edge through centres,
that neither side owns, half of the texels are the one side's and half the other's.
"""


def _labels() -> NDArray[np.uint8]:
    """Return what is where on the print and its margin, one texel a template unit, as its centre has it."""
    size = round(TEMPLATE_UNITS * (1 + 2 * OUTSIDE))
    picture = np.full((size, size), BEYOND, np.uint8)

    def fill(polygon: Array, label: int) -> None:
        at = polygon + OUTSIDE * TEMPLATE_UNITS
        low, high = np.floor(at.min(axis=0)).astype(int), np.ceil(at.max(axis=0)).astype(int)
        x, y = np.meshgrid(*(np.arange(a, b) for a, b in zip(low, high, strict=True)))
        x, y = x + 0.5 + ASIDE[0] * (1 - 2 * (y % 2)), y + 0.5 + ASIDE[1] * (1 - 2 * (x % 2))
        ahead = np.roll(at, -1, axis=0) - at
        sides = [dx * (y - y0) - dy * (x - x0) for (x0, y0), (dx, dy) in zip(at, ahead, strict=True)]
        inside = np.abs(np.sign(sides).sum(axis=0)) == len(at)
        picture[low[1] : high[1], low[0] : high[0]][inside] = label

    def rounded(near: float, far: float, radius: float) -> None:
        centre = np.arange(size) + 0.5 - OUTSIDE * TEMPLATE_UNITS
        beyond = np.abs(centre - (near + far) / 2) - ((far - near) / 2 - radius)
        across, down = np.maximum(beyond, 0.0), np.maximum(beyond, 0.0)[:, None]
        picture[np.hypot(across, down) < radius] = WHITE

    margin = QUIET_MARGIN * TEMPLATE_UNITS
    for layer in LAYERS:
        if layer.frame is None:
            fill(square(-margin, TEMPLATE_UNITS + margin), WHITE)
        else:
            rounded(*layer.frame, layer.frame_corner_radius)
        fill(square(*layer.black), BLACK)
        for label, cell in enumerate(cell_polygons() + DRAWN_OFFSET, start=FIRST_CELL):
            fill(layer_points(cell, layer), label)
    return picture


_LABELS = _labels()


def _nodes(count: int) -> Array:
    """Return points (K, 2) that stand for a standard normal distribution in the plane, alike in weight.

    Half of a Vogel spiral and its mirror image about the middle, with unit covariance: what is seen through them is
    not moved, as it would be by points that lie more to one side.
    """
    i = np.arange(count // 2) + 0.5
    radius, angle = np.sqrt(-2 * np.log(1 - i / len(i))), i * np.pi * (np.sqrt(5.0) - 1) / 2
    half = radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    nodes = np.concatenate([half, -half])
    return np.ascontiguousarray(np.linalg.solve(np.linalg.cholesky(nodes.T @ nodes / count), nodes.T).T)


_MANY_NODES, _FEWER_NODES = _nodes(MANY_NODES), _nodes(FEWER_NODES)


class Nodes(NamedTuple):
    """Points (K, 2) that stand for a standard normal distribution in the plane, and ``moments`` (5, K) over them.

    The moments take brightnesses there to their mean, and by parts to its first and second derivatives by x and y.
    """

    places: Light
    moments: Light


def _weighted(places: Array, weights: Array) -> Nodes:
    """Return nodes of given weights (K,), which add up to one."""
    x, y = places.T
    moments = np.stack([x**0, x, y, x * x - 1, y * y - 1]) * weights
    return Nodes(places.astype(np.float32), moments.astype(np.float32))


def _rings() -> Nodes:
    """Return hexagons at the two radii of Gauss-Laguerre quadrature, turned against each other."""
    squares, weights = np.polynomial.laguerre.laggauss(2)
    angle = (np.arange(6) + [[0.0], [0.5]]) * np.pi / 3
    places = np.sqrt(2 * squares)[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], axis=2)
    return _weighted(places.reshape(-1, 2), np.repeat(weights / 6, 6))


def _rows(count: int) -> Nodes:
    """Return rows of so many nodes: evenly spaced along x, where a blur is long, and by Gauss-Hermite across."""
    along = np.linspace(-ENDS, ENDS, count)
    across, share = np.polynomial.hermite_e.hermegauss(NODES_ACROSS)
    density = np.exp(-0.5 * along**2)
    density /= density.sum()
    along /= np.sqrt(density @ along**2)
    weights = np.outer(density, share / share.sum())
    places = np.stack(np.meshgrid(along, across, indexing="ij"), axis=2)
    return _weighted(places.reshape(-1, 2), weights.ravel())


_FEW, _ROWS = _rings(), tuple(_rows(count) for count in NODES_ALONG)


class Picture(NamedTuple):
    """A print's brightness and what is beyond it (H, W), blurred by ``softness``, a texel every ``texel`` units."""

    brightness: Light
    beyond: Light
    softness: float
    texel: float


@dataclass(frozen=True, eq=False)
class Expected:
    """What N points of a print should look like, black 0 and white 1, by place in the image and by the blur.

    ``mean`` (N,), its derivatives by pixels ``by_place`` (N, 2) and by the logarithm of the blur ``by_blur`` (N,), and
    how much of what they see is beyond the print, ``beyond`` (N,).
    """

    mean: Array
    by_place: Array
    by_blur: Array
    beyond: Array


def expected(seen: Look, picture: Picture, blur_px: float) -> Expected:
    """Return what a print should look like through a blur, which is at least its picture's."""
    rows = looks_of(seen, picture, blur_px)
    return Expected(rows[MEAN], rows[BY_X : BY_Y + 1].T, rows[BY_BLUR], rows[AROUND])


def looks_of(seen: Look, picture: Picture, blur_px: float) -> Array:
    """Return the same as rows (5, N), in the order of ``steps``."""
    return looks(seen.template, seen.to_template, *picture, blur_px, *_nodes_for(seen, picture, blur_px))


def _nodes_for(seen: Look, picture: Picture, blur_px: float) -> Nodes:
    """Return as many nodes as it takes to sum what the picture's softness leaves of a blur."""
    details = max(picture.softness, picture.texel)
    rest = np.sqrt(max((blur_px * seen.units[1]) ** 2 - picture.softness**2, 0.0)) / details
    if rest < WIDE:
        return _FEW
    enough = (rows for count, rows in zip(NODES_ALONG, _ROWS, strict=True) if APART * (count - 1) >= 2 * ENDS * rest)
    return next(enough, _ROWS[-1])


@dataclass(frozen=True, eq=False)
class Alignment(Generic[W]):
    """A warp moved until the image looks as the print should.

    ``correlation`` is of the pixels with what they should be, light and its slope removed; ``covariance`` (P, P) is of
    the warp's parameters, blur and light marginalised; ``moved_px`` how far the last step moved the print.  ``slant``
    is how many times smaller the print looks one way than the other.
    """

    warp: W
    blur_px: float
    correlation: float
    covariance: Array
    moved_px: float
    slant: float

    def sigma_px(self, template: Array) -> float:
        """Return what the standard deviation of each coordinate of points (N, 2) of the print amounts to.

        As if all were independent: as many of them as the warp has parameters tell no more than these.
        """
        return float(np.sqrt(self._variance_px2(template) + SIGMA_FLOOR_PX**2))

    @property
    def cautious_covariance(self) -> Array:
        """Return the covariance (P, P) enlarged so that the outer corners are known no better than ``sigma_px``."""
        return (1 + SIGMA_FLOOR_PX**2 / self._variance_px2(SQUARES[0])) * self._at_a_slant * self.covariance

    def _variance_px2(self, template: Array) -> float:
        J = self.warp.jacobian(template)
        return self._at_a_slant * float(np.einsum("nip,pq,niq->", J, self.covariance, J)) / len(self.covariance)

    @property
    def _at_a_slant(self) -> float:
        """Return how many times larger the variance is than noise makes it."""
        return max(min(self.slant, MOST_SLANTED) / SQUARELY, 1.0) ** SLANTING


@compiled(GRAY, MATRIX, CUBE, VECTOR, VECTOR, MATRIX)
def _products(
    labels: NDArray[np.uint8], template: Array, to_template: Array, weight: Array, value: Array, nodes_px: Array
) -> Array:
    """Return the products (55, 55), summed over N weighted points, of what their light is made of, and of that itself.

    It is made of a plane over the print (3) and of the shares (51) that labels have in what a point sees, at
    ``nodes_px`` (K, 2) around it; each point sees but a few.
    """
    last = 3 + LABELS
    products, column = np.zeros((last + 1, last + 1)), np.zeros(last + 1)
    share = 1 / len(nodes_px)
    which = np.zeros(4 + len(nodes_px), dtype=np.int64)
    which[:4] = 0, 1, 2, last
    for n in range(len(template)):
        u, v = template[n, 0], template[n, 1]
        column[0], column[1], column[2] = 1.0, u / TEMPLATE_UNITS - 0.5, v / TEMPLATE_UNITS - 0.5
        column[last] = value[n]
        count = 4
        for k in range(len(nodes_px)):
            x = u + to_template[n, 0, 0] * nodes_px[k, 0] + to_template[n, 0, 1] * nodes_px[k, 1]
            y = v + to_template[n, 1, 0] * nodes_px[k, 0] + to_template[n, 1, 1] * nodes_px[k, 1]
            at_column = min(max(int(x + OUTSIDE * TEMPLATE_UNITS), 0), labels.shape[1] - 1)
            at_row = min(max(int(y + OUTSIDE * TEMPLATE_UNITS), 0), labels.shape[0] - 1)
            label = 3 + labels[at_row, at_column]
            if column[label] == 0:
                which[count] = label
                count += 1
            column[label] += share
        for i in which[:count]:
            weighted = weight[n] * column[i]
            for j in which[:count]:
                products[i, j] += weighted * column[j]
        for i in which[:count]:
            column[i] = 0.0
    return products


class Synthesis:
    """The prints of a dictionary, ready to be compared with images pixel by pixel."""

    def __init__(self, dictionary: Dictionary) -> None:
        self.ids = dictionary.ids
        self._dictionary = dictionary
        self._codes = dictionary.oriented.reshape(-1, CELLS).astype(float)

    def read(self, light: Light, warp: FittedWarp, blur_px: float, *, glance: bool = False) -> Array:
        """Return the correlation (I, 4) of an image with each identity, its print turned clockwise by quarters.

        Of cells only: what all identities have in common, and light that varies in a plane, are taken out.  A
        ``glance`` is at fewer points, and through a coarser blur.
        """
        seen = look(warp, light.shape, most_lines=MOST_AT_A_GLANCE if glance else MOST_LINES)
        if seen is None:
            return np.zeros((len(self._codes) // 4, 4))
        value = values(light, seen.at_px)
        nodes_px = blur_px * (_FEWER_NODES if glance else _MANY_NODES)
        products = _products(_LABELS, seen.template, seen.to_template, seen.weight, value, nodes_px)
        left = left_over(products, OF_COMMON)
        among, common, energy = left[:CELLS, :CELLS], left[:CELLS, CELLS], left[CELLS, CELLS]
        length = np.sqrt(((self._codes @ among) * self._codes).sum(axis=1) * energy)
        return (self._codes @ common / np.maximum(length, 1e-9)).reshape(-1, 4)

    def layer_scores(self, light: Light, square_warp: FittedWarp, marker_id: int, blur_px: float) -> Array:
        """Return how well (3,) a square and what surrounds it fit it being layer 0, 1 or 2, as correlations.

        ``square_warp`` takes the template to the image as if the square were the outermost.
        """
        seen = look(square_warp, light.shape, LAYER_REACH)
        if seen is None:
            return np.zeros(len(LAYERS))
        value, scores = values(light, seen.at_px), np.zeros(len(LAYERS))
        for layer in LAYERS:
            there = replace(
                seen, template=layer_points(seen.template, layer), to_template=layer.scale * seen.to_template
            )
            shown = looks_of(there, self._picture(marker_id, there.softness(blur_px)), blur_px)
            scores[layer.index] = contrast(seen.template, seen.weight, value, shown)[1]
        return scores

    def align(
        self,
        light: Light,
        warp: W,
        marker_id: int,
        blur_px: float,
        steps: int = STEPS,
        settled_px: float = SETTLED_PX,
        hopeless: float = -1.0,
    ) -> Alignment[W] | None:
        """Return ``warp`` and the blur moved until the image looks most like a marker; None when it is lost.

        Light and contrast may each vary in a plane over the print.  A step that moves it by less than ``settled_px`` is
        the last.  What correlates less than ``hopeless`` once a step was taken is given up.
        """
        alignment = None
        for taken in range(steps):
            alignment = self._step(light, warp, marker_id, blur_px, MOST_LINES)
            if alignment is None or (taken == 1 and alignment.correlation < hopeless):
                return None
            warp, blur_px = alignment.warp, alignment.blur_px
            if alignment.moved_px < settled_px:
                break
        return alignment

    def refined(self, light: Light, aligned: Alignment[W], marker_id: int) -> Alignment[W]:
        """Return an alignment after one more step on a finer grid, if it looks so large that there is one."""
        if lines_across(aligned.warp, FINE_LINES) <= MOST_LINES:
            return aligned
        return self._step(light, aligned.warp, marker_id, aligned.blur_px, FINE_LINES) or aligned

    def _step(self, light: Light, warp: W, marker_id: int, blur_px: float, most_lines: int) -> Alignment[W] | None:
        """Return warp and blur after a Gauss-Newton step; None when the print is out of view or does not look so."""
        seen = look(warp, light.shape, most_lines=most_lines, blur_px=blur_px)
        if seen is None:
            return None
        shown = looks_of(seen, self._picture(marker_id, seen.softness(blur_px)), blur_px)
        J = np.ascontiguousarray(warp.jacobian(seen.template))
        x, covariance, apart, correlation, moved_px = step(
            light, seen.at_px, seen.template, seen.weight, shown, J, warp.step_sigma()
        )
        if apart <= 0:
            return None
        blur_px = min(max(blur_px * math.exp(x[-1]), LEAST_BLUR_PX), MOST_BLUR_PX)
        slant = seen.units[1] / max(seen.units[0], TINY)
        return Alignment(warp.stepped(x[:-1]), blur_px, correlation, covariance[:-1, :-1], moved_px, slant)

    def _picture(self, marker_id: int, softness: float) -> Picture:
        return _picture(self._dictionary.signature(marker_id).tobytes(), softness)


@lru_cache(maxsize=KEPT_PICTURES)
def _picture(signature: bytes, softness: float) -> Picture:
    """Return the print of a signature (48 bytes) blurred by ``softness`` template units, 0 for not at all."""
    levels = np.zeros((2, 256), np.uint8)
    levels[0, WHITE] = 255
    levels[0, FIRST_CELL:LABELS] = 255 * np.frombuffer(signature, np.uint8)
    levels[1, BEYOND] = 255
    size = max(round(len(_LABELS) * min(TEXELS / softness, 1.0)), 1) if softness else len(_LABELS)
    texel = len(_LABELS) / size
    deviation = np.sqrt(max((softness / texel) ** 2 - 1 / 12 - 1 / 6, 0.1))  # what areas and interpolation leave
    channels = []
    for level in levels:
        small = cv2.resize(cv2.LUT(_LABELS, level), (size, size), interpolation=cv2.INTER_AREA).astype(np.float32) / 255
        channels.append(
            cv2.GaussianBlur(small, (0, 0), deviation, borderType=cv2.BORDER_REPLICATE) if softness else small
        )
    return Picture(channels[0], channels[1], softness, texel)
