"""Synthesis: what a print looks like through a warp and a blur, and moving both until the image looks like that.

Where a marker is a few pixels wide, or blurred until its cells run together, neither edges nor cells can be measured
one by one; every pixel still tells of all of them at once.  The print is sampled at points of a grid on it.  What a
pixel there would see is the mean of the artwork under a Gaussian in the image, carried to the print by the warp's
local derivative: right for any slant and any curvature.  The same sums with other weights are the derivatives by
place and by blur (C. Stein, "Estimation of the mean of a multivariate normal distribution", 1981), so that one
Gauss-Newton step costs one look-up.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Generic, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from astratag.dictionary import Dictionary
from astratag.geometry import CELLS, DRAWN_OFFSET, LAYERS, QUIET_MARGIN, TEMPLATE_UNITS, cell_polygons, layer_points, square
from astratag.warp import FittedWarp

Array = NDArray[np.float64]
Light = NDArray[np.float32]
W = TypeVar("W", bound=FittedWarp)

BLACK, WHITE = CELLS, CELLS + 1
"""Labels of what is always ink and always paper; cells are labelled by their number."""
NODES = 64
"""Points that stand for the Gaussian a pixel sees through."""
REACH, LAYER_REACH = 0.07, 0.13
"""How far beyond the black square the print is looked at, as a fraction of its side; and to tell layers apart by."""
SPACING_PX = 0.8
MOST_LINES, FEWEST_LINES = 44, 12
"""Grid lines across the print: so many that they are ``SPACING_PX`` apart where it looks widest, within bounds."""
LEAST_BLUR_PX, MOST_BLUR_PX = 0.5, 8.0
BLUR_STEP = 0.3
"""How far one step may take the logarithm of the blur, as a standard deviation."""
STEP_PX = 1.0
"""How far one step may take a point of the print, as a standard deviation."""
STEPS, SETTLED_PX = 6, 0.02
FEWEST_POINTS = 60
INTERPOLATED = 9 / 4
"""Variance of a pixel's noise over that of values interpolated between pixels."""
LEAST_NOISE = 0.3
"""No light is believed to be known better than this, of 255."""


def _labels() -> NDArray[np.uint8]:
    """Return what is where on the print and its margin, one texel a template unit, as its centre has it."""
    size = round(TEMPLATE_UNITS * (1 + 2 * QUIET_MARGIN))
    picture = np.full((size, size), WHITE, np.uint8)

    def fill(polygon: Array, label: int) -> None:
        at = polygon + QUIET_MARGIN * TEMPLATE_UNITS
        low, high = np.floor(at.min(axis=0)).astype(int), np.ceil(at.max(axis=0)).astype(int)
        x, y = np.meshgrid(*(np.arange(a, b) + 0.5 for a, b in zip(low, high, strict=True)))
        ahead = np.roll(at, -1, axis=0) - at
        sides = [dx * (y - y0) - dy * (x - x0) for (x0, y0), (dx, dy) in zip(at, ahead, strict=True)]
        inside = np.abs(np.sign(sides).sum(axis=0)) == len(at)
        picture[low[1] : high[1], low[0] : high[0]][inside] = label

    for layer in LAYERS:
        if layer.frame is not None:
            fill(square(*layer.frame), WHITE)
        fill(square(*layer.black), BLACK)
        for label, cell in enumerate(cell_polygons() + DRAWN_OFFSET):
            fill(layer_points(cell, layer), label)
    return picture


LABELS = _labels()


def _nodes() -> tuple[Array, Array]:
    """Return points (K, 2) of a standard normal distribution in the plane, alike in weight, spread evenly.

    The weights (K, 4) are of the mean, its derivatives by x and y and by the logarithm of the deviation.
    """
    i = np.arange(NODES) + 0.5
    radius, angle = np.sqrt(-2 * np.log(1 - i / NODES)), i * np.pi * (3 - np.sqrt(5.0))  # Vogel's spiral
    nodes = radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    nodes = np.linalg.solve(np.linalg.cholesky(nodes.T @ nodes / NODES), nodes.T).T
    weights = np.column_stack([np.ones(NODES), nodes, (nodes**2).sum(axis=1) - 2.0]) / NODES
    return nodes, weights - np.concatenate([[0.0], weights[:, 1:].mean(axis=0)])


_NODES, _WEIGHTS = _nodes()


@cache
def _grid(lines: int, reach: float) -> tuple[Array, Array]:
    """Return template points (lines^2, 2), and them and two neighbours half a unit on (3, lines^2, 2)."""
    span = np.linspace(-reach, 1 + reach, lines) * TEMPLATE_UNITS
    points = np.stack(np.meshgrid(span, span), axis=-1).reshape(-1, 2)
    return points, np.stack([points, points + (0.5, 0.0), points + (0.0, 0.5)])


@dataclass(frozen=True, eq=False)
class Look:
    """Where and how a print is seen through one warp: N points of it in the image.

    ``template`` (N, 2) and ``at_px`` (N, 2) are the points; ``to_template`` (N, 2, 2) takes pixels to template units
    there; ``weight`` (N,) is how many pixels each stands for, at most one.
    """

    template: Array
    at_px: Array
    to_template: Array
    weight: Array

    def places(self, blur_px: float) -> NDArray[np.float32]:
        """Return the texels (N, K, 2) of the label picture that the points see through a blur."""
        spread = (blur_px * _NODES) @ self.to_template.transpose(0, 2, 1)
        return (self.template[:, None] + spread + (QUIET_MARGIN * TEMPLATE_UNITS - 0.5)).astype(np.float32)

    @cached_property
    def root(self) -> Array:
        """Return the roots of the weights (N,)."""
        return np.sqrt(self.weight)

    @cached_property
    def plane(self) -> Array:
        """Return what light that varies in a plane over the print is made of (N, 3)."""
        return np.column_stack([np.ones(len(self.weight)), self.template / TEMPLATE_UNITS - 0.5])


def look(warp: FittedWarp, shape: tuple[int, ...], reach: float = REACH) -> Look | None:
    """Return how a print and ``reach`` sides around it lie in an image of ``shape`` (H, W); None when hardly at all."""
    corners = warp(square(0.0, TEMPLATE_UNITS))
    widest = max(np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1).max(), 1.0)
    lines = int(np.clip(widest * (1 + 2 * reach) / SPACING_PX, FEWEST_LINES, MOST_LINES))
    points, stencil = _grid(lines, reach)
    at, right, below = warp(stencil.reshape(-1, 2)).reshape(3, -1, 2)
    J = 2 * np.stack([right - at, below - at], axis=2)
    determinant = J[:, 0, 0] * J[:, 1, 1] - J[:, 0, 1] * J[:, 1, 0]
    use = (determinant > 1e-9) & (at >= 1).all(axis=1) & (at <= (shape[1] - 2, shape[0] - 2)).all(axis=1)
    use &= warp.visible(points)
    if use.sum() < FEWEST_POINTS:
        return None
    step = TEMPLATE_UNITS * (1 + 2 * reach) / (lines - 1)
    return Look(points[use], at[use], np.linalg.inv(J[use]), np.minimum(step**2 * determinant[use], 1.0))


@dataclass(frozen=True, eq=False)
class Alignment(Generic[W]):
    """A warp moved until the image looks as the print should.

    ``correlation`` is of the pixels with what they should be, light and its slope removed; ``covariance`` (P, P) is of
    the warp's parameters, blur and light marginalised; ``moved_px`` how far the last step moved the print.
    """

    warp: W
    blur_px: float
    correlation: float
    covariance: Array
    moved_px: float


class Synthesis:
    """The prints of a dictionary, ready to be compared with images pixel by pixel."""

    def __init__(self, dictionary: Dictionary) -> None:
        self.ids = dictionary.ids
        self._dictionary = dictionary
        self._codes = dictionary.oriented.reshape(-1, CELLS).astype(float)

    def read(self, light: Light, warp: FittedWarp, blur_px: float) -> Array:
        """Return the correlation (I, 4) of an image with each identity, its print turned clockwise by quarters.

        Of cells only: what all identities have in common, and light that varies in a plane, are taken out.
        """
        seen = look(warp, light.shape)
        if seen is None:
            return np.zeros((len(self._codes) // 4, 4))
        places = seen.places(blur_px)
        labels = cv2.remap(LABELS, places, None, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
        rows = np.arange(len(places), dtype=np.int64)[:, None] * (CELLS + 2) + labels
        share = np.bincount(rows.ravel(), minlength=len(places) * (CELLS + 2)).reshape(-1, CELLS + 2) / NODES
        nuisance = np.column_stack([seen.plane, share[:, :CELLS].sum(axis=1), share[:, WHITE]])
        return _correlations(seen, nuisance, _values(light, seen), share[:, :CELLS] @ self._codes.T).reshape(-1, 4)

    def layer_scores(self, light: Light, square_warp: FittedWarp, marker_id: int, blur_px: float) -> Array:
        """Return how well (3,) a square and what surrounds it fit it being layer 0, 1 or 2, as correlations.

        ``square_warp`` takes the template to the image as if the square were the outermost.
        """
        seen = look(square_warp, light.shape, LAYER_REACH)
        if seen is None:
            return np.zeros(len(LAYERS))
        picture, value = self._picture(marker_id), _values(light, seen)
        scores = np.zeros(len(LAYERS))
        for layer in LAYERS:
            there = replace(seen, template=layer_points(seen.template, layer), to_template=layer.scale * seen.to_template)
            scores[layer.index] = _contrast(seen, value, _seen_through(picture, there.places(blur_px)).mean(axis=1))[1]
        return scores

    def align(self, light: Light, warp: W, marker_id: int, blur_px: float, steps: int = STEPS) -> Alignment[W] | None:
        """Return ``warp`` and the blur moved until the image looks most like a marker; None when it is lost.

        Light and contrast may each vary in a plane over the print.
        """
        picture = self._picture(marker_id)
        size = len(warp.step_sigma())
        alignment = None
        for _ in range(steps):
            seen = look(warp, light.shape)
            if seen is None:
                return None
            mean, by_x, by_y, by_blur = (_seen_through(picture, seen.places(blur_px)) @ _WEIGHTS).T
            value = _values(light, seen)
            contrast, correlation = _contrast(seen, value, mean)
            if contrast <= 0:
                return None
            J = warp.jacobian(seen.template)
            by_warp = -contrast / blur_px * (by_x[:, None] * J[:, 0] + by_y[:, None] * J[:, 1])
            plane = seen.plane
            A = np.column_stack([by_warp, contrast * by_blur, plane * mean[:, None], plane]) * seen.root[:, None]
            reach = np.maximum(np.abs(J).max(axis=(0, 1)), 1e-12)
            step_sigma = np.append(np.minimum(STEP_PX / reach, warp.step_sigma()), BLUR_STEP)
            x, covariance = _least_squares(A, value * seen.root, step_sigma, float(seen.weight.sum()))
            warp = warp.stepped(x[:size])
            blur_px = float(np.clip(blur_px * np.exp(x[size]), LEAST_BLUR_PX, MOST_BLUR_PX))
            moved_px = float(np.abs(J @ x[:size]).max())
            alignment = Alignment(warp, blur_px, correlation, covariance[:size, :size], moved_px)
            if moved_px < SETTLED_PX:
                break
        return alignment

    @cache  # noqa: B019 - one picture an identity, as long as its dictionary
    def _picture(self, marker_id: int) -> Light:
        return np.append(self._dictionary.signature(marker_id), (0, 1)).astype(np.float32)[LABELS]


def _seen_through(picture: Light, places: NDArray[np.float32]) -> Light:
    """Return the picture's brightness (N, K) at places (N, K, 2)."""
    return cv2.remap(picture, places, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def _values(light: Light, seen: Look) -> Array:
    return cv2.remap(light, seen.at_px.astype(np.float32)[None], None, cv2.INTER_LINEAR)[0].astype(float)


def _left(seen: Look, nuisance: Array, columns: Array) -> Array:
    """Return columns (N, K), weighted, with what the nuisance (N, M) explains taken out."""
    Q = np.linalg.qr(nuisance * seen.root[:, None])[0]
    columns = columns * seen.root[:, None]
    return columns - Q @ (Q.T @ columns)


def _correlations(seen: Look, nuisance: Array, value: Array, expected: Array) -> Array:
    """Return the correlations (K,) of values (N,) with what is expected (N, K), a nuisance (N, M) taken out."""
    columns = _left(seen, nuisance, np.column_stack([value, expected]))
    length = np.maximum(np.sqrt(np.einsum("nk,nk->k", columns, columns)), 1e-9)
    return columns[:, 0] @ columns[:, 1:] / (length[0] * length[1:])


def _contrast(seen: Look, value: Array, expected: Array) -> tuple[float, float]:
    """Return how many units of light black and white are apart, and how values correlate with what is expected."""
    value, expected = _left(seen, seen.plane, np.stack([value, expected], axis=1)).T
    energy, common = max(expected @ expected, 1e-12), value @ expected
    return float(common / energy), float(common / np.sqrt(energy * max(value @ value, 1e-12)))


def _least_squares(A: Array, value: Array, step_sigma: Array, pixels: float) -> tuple[Array, Array]:
    """Return the unknowns (P,) of A x = value, the first held by their step sigmas, and their covariance (P, P)."""
    scale = np.sqrt(np.einsum("np,np->p", A, A)) + 1e-12
    A = A / scale
    normal, right = A.T @ A, A.T @ value
    free = np.linalg.solve(normal + 1e-9 * np.eye(len(right)), right)
    residual = value - A @ free
    variance = INTERPOLATED * float(residual @ residual) / max(pixels - len(free), 1.0) + LEAST_NOISE**2
    prior = np.full(len(right), 1e-9)
    prior[: len(step_sigma)] += variance / (step_sigma * scale[: len(step_sigma)]) ** 2
    x = np.linalg.solve(normal + np.diag(prior), right)
    covariance = variance * np.linalg.inv(normal + 1e-9 * np.eye(len(right)))
    return x / scale, covariance / np.outer(scale, scale)
