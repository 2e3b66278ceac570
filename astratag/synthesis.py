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
from functools import cache, cached_property, lru_cache
from typing import Generic, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

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
from astratag.warp import FittedWarp

Array = NDArray[np.float64]
Light = NDArray[np.float32]
W = TypeVar("W", bound=FittedWarp)

BLACK, WHITE, BEYOND = CELLS, CELLS + 1, CELLS + 2
"""Labels of what is always ink, always paper, and no longer the print; cells are labelled by their number."""
LABELS = BEYOND + 1
KEPT_PICTURES = 64
OUTSIDE = 0.3
"""How far beyond the black square there are labels, as a fraction of its side."""
NODES, MANY_NODES = 24, 64
"""Points that stand for the Gaussian a pixel sees through: of a picture blurred beforehand, and of a sharp one."""
SOFTNESS = tuple(4.0 * 2 ** (k / 2) for k in range(10))
"""Blurs of pictures that are kept, template units, and"""
SOFT_SHARE = 0.85
"""how much of the blur where it is least they may be: the rest is summed over nodes."""
TEXELS = 4.0
"""Texels to a picture's blur."""
REACH, LAYER_REACH = 0.07, 0.13
"""How far beyond the black square the print is looked at, as a fraction of its side; and to tell layers apart by."""
SPACING_PX = 0.8
MOST_LINES, FEWEST_LINES = 32, 12
"""Grid lines across the print: so many that they are ``SPACING_PX`` apart where it looks widest, within bounds."""
SIGMA_FLOOR_PX = 0.02
"""What a point's standard deviation never falls below: print, lens model, shape of the blur."""
FINELY_SAMPLED_PX, COARSENESS = 64.0, 1.5
"""Prints that look larger are sampled so coarsely that this grows, by this power of their size."""
LEAST_BLUR_PX, MOST_BLUR_PX = 0.5, 8.0
BLUR_STEP = 0.3
"""How far one step may take the logarithm of the blur, as a standard deviation."""
STEP_PX = 1.0
"""How far one step may take a point of the print, as a standard deviation."""
STEPS, SETTLED_PX = 6, 0.02
FEWEST_POINTS = 60
LEAST_REST = 0.02
"""Fraction of the blur's variance that is always left to the nodes."""
INTERPOLATED = 9 / 4
"""Variance of a pixel's noise over that of values interpolated between pixels."""
LEAST_NOISE = 0.3
"""No light is believed to be known better than this, of 255."""


def _labels() -> NDArray[np.uint8]:
    """Return what is where on the print and its margin, one texel a template unit, as its centre has it."""
    size = round(TEMPLATE_UNITS * (1 + 2 * OUTSIDE))
    picture = np.full((size, size), BEYOND, np.uint8)

    def fill(polygon: Array, label: int) -> None:
        at = polygon + OUTSIDE * TEMPLATE_UNITS
        low, high = np.floor(at.min(axis=0)).astype(int), np.ceil(at.max(axis=0)).astype(int)
        x, y = np.meshgrid(*(np.arange(a, b) + 0.5 for a, b in zip(low, high, strict=True)))
        ahead = np.roll(at, -1, axis=0) - at
        sides = [dx * (y - y0) - dy * (x - x0) for (x0, y0), (dx, dy) in zip(at, ahead, strict=True)]
        inside = np.abs(np.sign(sides).sum(axis=0)) == len(at)
        picture[low[1] : high[1], low[0] : high[0]][inside] = label

    margin = QUIET_MARGIN * TEMPLATE_UNITS
    for layer in LAYERS:
        fill(square(*(layer.frame or (-margin, TEMPLATE_UNITS + margin))), WHITE)
        fill(square(*layer.black), BLACK)
        for label, cell in enumerate(cell_polygons() + DRAWN_OFFSET):
            fill(layer_points(cell, layer), label)
    return picture


_LABELS = _labels()
_OUTER = square(0.0, TEMPLATE_UNITS)


def _nodes(count: int) -> Array:
    """Return points (K, 2) that stand for a standard normal distribution in the plane, alike in weight.

    Vogel's spiral, with zero mean and unit covariance.
    """
    i = np.arange(count) + 0.5
    radius, angle = np.sqrt(-2 * np.log(1 - i / count)), i * np.pi * (3 - np.sqrt(5.0))
    nodes = radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    nodes -= nodes.mean(axis=0)
    return np.linalg.solve(np.linalg.cholesky(nodes.T @ nodes / count), nodes.T).T


_NODES, _MANY_NODES = _nodes(NODES), _nodes(MANY_NODES)
_X, _Y = _NODES.T
_MOMENTS = (np.stack([_X**0, _X, _Y, _X * _X - 1, _X * _Y, _Y * _Y - 1]) / NODES).astype(np.float32)
"""Take brightnesses at the nodes to their mean, and by parts to its first and second derivatives (6, K)."""


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

    def softness(self, blur_px: float) -> float:
        """Return the softest of ``SOFTNESS`` that a picture may have to be seen through a blur, 0 for a sharp one."""
        a, b, c, d = self.to_template.reshape(-1, 4).T
        total, area = a * a + b * b + c * c + d * d, a * d - b * c
        least = np.sqrt(np.maximum(total - np.sqrt(np.maximum(total**2 - 4 * area**2, 0)), 0) / 2)
        limit = SOFT_SHARE * blur_px * np.quantile(least, 0.1)
        return max((softness for softness in SOFTNESS if softness <= limit), default=0.0)

    @cached_property
    def root(self) -> Array:
        """Return the roots of the weights (N,)."""
        return np.sqrt(self.weight)

    @cached_property
    def plane(self) -> Array:
        """Return what light that varies in a plane over the print is made of (N, 3)."""
        return np.column_stack([np.ones(len(self.weight)), self.template / TEMPLATE_UNITS - 0.5])


def _widest_px(warp: FittedWarp) -> float:
    """Return how long the longest side of a print looks, at least a pixel."""
    corners = warp(_OUTER)
    return max(float(np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1).max()), 1.0)


def look(warp: FittedWarp, shape: tuple[int, ...], reach: float = REACH) -> Look | None:
    """Return how a print and ``reach`` sides around it lie in an image of ``shape`` (H, W); None when hardly at all."""
    lines = int(np.clip(_widest_px(warp) * (1 + 2 * reach) / SPACING_PX, FEWEST_LINES, MOST_LINES))
    points, stencil = _grid(lines, reach)
    at, right, below = warp(stencil.reshape(-1, 2)).reshape(3, -1, 2)
    J = 2 * np.stack([right - at, below - at], axis=2)
    determinant = J[:, 0, 0] * J[:, 1, 1] - J[:, 0, 1] * J[:, 1, 0]
    use = (determinant > 1e-9) & (at >= 1).all(axis=1) & (at <= (shape[1] - 2, shape[0] - 2)).all(axis=1)
    use &= warp.visible(points)
    if use.sum() < FEWEST_POINTS:
        return None
    step = TEMPLATE_UNITS * (1 + 2 * reach) / (lines - 1)
    (a, b), (c, d) = J[use].transpose(1, 2, 0)
    inverse = np.stack([d, -b, -c, a], axis=1).reshape(-1, 2, 2) / determinant[use, None, None]
    return Look(points[use], at[use], inverse, np.minimum(step**2 * determinant[use], 1.0))


@dataclass(frozen=True, eq=False)
class Picture:
    """A print's brightness and what is beyond it (H, W, 2), blurred by ``softness``, a texel every ``texel`` units."""

    channels: Light
    softness: float
    texel: float

    def at(self, template: Array, lxx: Array, lyx: Array, lyy: Array) -> Light:
        """Return the channels (N, K, 2) at nodes around template points (N, 2), spread by Cholesky factors (N,)."""
        x, y = _NODES.T.astype(np.float32)
        middle = ((template + OUTSIDE * TEMPLATE_UNITS) / self.texel - 0.5).astype(np.float32)
        xx, yx, yy = ((part / self.texel).astype(np.float32)[:, None] for part in (lxx, lyx, lyy))
        columns, rows = middle[:, :1] + xx * x, middle[:, 1:] + yx * x + yy * y
        return cv2.remap(self.channels, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


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
    ax, ay, bx, by = blur_px * seen.to_template.reshape(-1, 4).T
    cxx, cxy, cyy = ax * ax + ay * ay, ax * bx + ay * by, bx * bx + by * by  # the blur's covariance on the print
    soft = picture.softness**2
    lxx = np.sqrt(np.maximum(cxx - soft, LEAST_REST * cxx))  # Cholesky factor of what the picture leaves of it
    lyx = cxy / lxx
    lyy = np.sqrt(np.maximum(cyy - soft - lyx**2, LEAST_REST * (ax * by - ay * bx) ** 2 / cxx))
    channels = picture.at(seen.template, lxx, lyx, lyy)
    mean, x, y, xx, xy, yy = _MOMENTS @ np.ascontiguousarray(channels[..., 0]).T
    x, y = x / lxx - y * lyx / (lxx * lyy), y / lyy  # derivatives on the print
    dxx, dyx, dyy = 1 / lxx, -lyx / (lxx * lyy), 1 / lyy
    mxx, mxy = dxx * dxx * cxx, dxx * (dyx * cxx + dyy * cxy)
    myy = dyx * dyx * cxx + 2 * dyx * dyy * cxy + dyy * dyy * cyy
    return Expected(
        mean=mean.astype(float),
        by_place=(x[:, None] * seen.to_template[:, 0] + y[:, None] * seen.to_template[:, 1]),
        by_blur=mxx * xx + 2 * mxy * xy + myy * yy,
        beyond=channels[..., 1].mean(axis=1).astype(float),
    )


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

    def sigma_px(self, template: Array) -> float:
        """Return what the standard deviation of each coordinate of points (N, 2) of the print amounts to.

        As if all were independent: as many of them as the warp has parameters tell no more than these.
        """
        return float(np.sqrt(self._variance_px2(template) + self._floor_px() ** 2))

    @property
    def cautious_covariance(self) -> Array:
        """Return the covariance (P, P) enlarged so that the outer corners are known no better than ``sigma_px``."""
        return (1 + self._floor_px() ** 2 / self._variance_px2(_OUTER)) * self.covariance

    def _variance_px2(self, template: Array) -> float:
        J = self.warp.jacobian(template)
        return float(np.einsum("nip,pq,niq->", J, self.covariance, J)) / len(self.covariance)

    def _floor_px(self) -> float:
        """Return ``SIGMA_FLOOR_PX``, more where a print looks so large that its grid is coarse."""
        return SIGMA_FLOOR_PX * max(1.0, _widest_px(self.warp) / FINELY_SAMPLED_PX) ** COARSENESS


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
        places = seen.template[:, None] + (blur_px * _MANY_NODES) @ seen.to_template.transpose(0, 2, 1)
        texels = (places + (OUTSIDE * TEMPLATE_UNITS - 0.5)).astype(np.float32)
        labels = cv2.remap(_LABELS, texels, None, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
        rows = np.arange(len(labels), dtype=np.int64)[:, None] * LABELS + labels
        share = np.bincount(rows.ravel(), minlength=len(labels) * LABELS).reshape(-1, LABELS) / MANY_NODES
        nuisance = np.column_stack([seen.plane, share[:, BLACK:]])  # the shares add up to one
        left = _left(seen, nuisance, np.column_stack([share[:, :CELLS], _values(light, seen)]))
        B, value = left[:, :CELLS], left[:, CELLS]
        gram, common = B.T @ B, B.T @ value
        length = np.sqrt(((self._codes @ gram) * self._codes).sum(axis=1) * (value @ value))
        return (self._codes @ common / np.maximum(length, 1e-9)).reshape(-1, 4)

    def layer_scores(self, light: Light, square_warp: FittedWarp, marker_id: int, blur_px: float) -> Array:
        """Return how well (3,) a square and what surrounds it fit it being layer 0, 1 or 2, as correlations.

        ``square_warp`` takes the template to the image as if the square were the outermost.
        """
        seen = look(square_warp, light.shape, LAYER_REACH)
        if seen is None:
            return np.zeros(len(LAYERS))
        value, scores = _values(light, seen), np.zeros(len(LAYERS))
        for layer in LAYERS:
            there = replace(
                seen, template=layer_points(seen.template, layer), to_template=layer.scale * seen.to_template
            )
            looks = expected(there, self._picture(marker_id, there.softness(blur_px)), blur_px)
            scores[layer.index] = _contrast(seen, np.column_stack([seen.plane, looks.beyond]), value, looks.mean)[1]
        return scores

    def align(
        self,
        light: Light,
        warp: W,
        marker_id: int,
        blur_px: float,
        steps: int = STEPS,
        settled_px: float = SETTLED_PX,
    ) -> Alignment[W] | None:
        """Return ``warp`` and the blur moved until the image looks most like a marker; None when it is lost.

        Light and contrast may each vary in a plane over the print.  A step that moves it by less than ``settled_px`` is
        the last.
        """
        size = len(warp.step_sigma())
        alignment = None
        for _ in range(steps):
            seen = look(warp, light.shape)
            if seen is None:
                return None
            looks = expected(seen, self._picture(marker_id, seen.softness(blur_px)), blur_px)
            value = _values(light, seen)
            level = np.column_stack([seen.plane, looks.beyond])
            contrast, correlation = _contrast(seen, level, value, looks.mean)
            if contrast <= 0:
                return None
            J = warp.jacobian(seen.template)
            by_warp = -contrast * (looks.by_place[:, :1] * J[:, 0] + looks.by_place[:, 1:] * J[:, 1])
            of_light = (seen.plane * looks.mean[:, None], level)
            A = np.column_stack([by_warp, contrast * looks.by_blur, *of_light]) * seen.root[:, None]
            reach = np.maximum(np.abs(J).max(axis=(0, 1)), 1e-12)
            step_sigma = np.append(np.minimum(STEP_PX / reach, warp.step_sigma()), BLUR_STEP)
            x, covariance = _least_squares(A, value * seen.root, step_sigma, float(seen.weight.sum()))
            warp = warp.stepped(x[:size])
            blur_px = float(np.clip(blur_px * np.exp(x[size]), LEAST_BLUR_PX, MOST_BLUR_PX))
            moved_px = float(np.abs(J @ x[:size]).max())
            alignment = Alignment(warp, blur_px, correlation, covariance[:size, :size], moved_px)
            if moved_px < settled_px:
                break
        return alignment

    def _picture(self, marker_id: int, softness: float) -> Picture:
        return _picture(self._dictionary.signature(marker_id).tobytes(), softness)


@lru_cache(maxsize=KEPT_PICTURES)
def _picture(signature: bytes, softness: float) -> Picture:
    """Return the print of a signature (48 bytes) blurred by ``softness`` template units, 0 for not at all."""
    levels = np.zeros((2, 256), np.uint8)
    levels[0, :LABELS] = 255 * np.append(np.frombuffer(signature, np.uint8), (0, 1, 0))
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
    return Picture(cv2.merge(channels), softness, texel)


def _values(light: Light, seen: Look) -> Array:
    return cv2.remap(light, seen.at_px.astype(np.float32)[None], None, cv2.INTER_LINEAR)[0].astype(float)


def _left(seen: Look, nuisance: Array, columns: Array) -> Array:
    """Return columns (N, K), weighted, with what the nuisance (N, M) explains taken out."""
    Q = np.linalg.qr(nuisance * seen.root[:, None])[0]
    columns = columns * seen.root[:, None]
    return columns - Q @ (Q.T @ columns)


def _contrast(seen: Look, nuisance: Array, value: Array, looks: Array) -> tuple[float, float]:
    """Return how many units of light black and white are apart, and how values correlate with what is expected."""
    left, right = _left(seen, nuisance, np.stack([value, looks], axis=1)).T
    energy, common = float(right @ right) + 1e-12, float(left @ right)
    return common / energy, common / float(np.sqrt(energy * (left @ left + 1e-12)))


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
