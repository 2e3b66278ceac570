"""Edges of a marker: the twenty straight lines of its print, and where they are in an image to a few hundredths.

Each edge is sampled at fixed points along it.  Through each point a short profile is taken across the edge,
in linear light, and the place of steepest rise from ink to paper is found between samples.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from astratag.geometry import LAYERS, QUIET_MARGIN, TEMPLATE_UNITS, square
from astratag.warp import FittedWarp

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Image = NDArray[np.uint8]
Transfer = Literal["srgb", "linear"]

POINTS_PER_EDGE = 21
END_MARGIN = 0.08
"""Fraction of an edge left out at either end, where corners are round and blurred."""
STEP_PX = 0.5
SMOOTHING_PX = 0.7
"""Standard deviation of the derivative filter: little, so that neighbouring edges do not pull."""
MARGIN_UNITS = QUIET_MARGIN * TEMPLATE_UNITS
BORDER_UNITS = 50.0
"""Ink between a black square's edge and the nearest cell, in units of its own layer."""


@dataclass(frozen=True)
class Edge:
    """One side of a square: from ``start`` to ``end`` clockwise in the template, ink on one side of it."""

    layer: int
    side: int
    """0 top, 1 right, 2 bottom, 3 left."""
    frame: bool
    """True for the outer edge of a white frame, which has ink outside; False for a black square's edge."""
    start: tuple[float, float]
    end: tuple[float, float]
    reach: float
    """Distance to the nearest other edge on either side, template units."""


def _edges() -> tuple[Edge, ...]:
    edges: list[Edge] = []
    for layer in LAYERS:
        border = BORDER_UNITS * layer.scale
        squares = [(False, layer.black, MARGIN_UNITS)]
        if layer.frame is not None:
            thickness = layer.black[0] - layer.frame[0]
            parent = LAYERS[layer.index - 1]
            ring = layer.frame[0] - (parent.origin + parent.scale * 150.0)  # the parent's cells end at 150
            squares = [(False, layer.black, thickness), (True, layer.frame, min(thickness, ring))]
        for frame, (near, far), outside in squares:
            corners = square(near, far)
            reach = outside if frame else min(border, outside)
            for side in range(4):
                start, end = tuple(corners[side]), tuple(corners[(side + 1) % 4])
                edges.append(Edge(layer.index, side, frame, start, end, reach))
    return tuple(edges)


EDGES = _edges()
ALONG = np.linspace(END_MARGIN, 1 - END_MARGIN, POINTS_PER_EDGE)
_STARTS, _ENDS = np.array([e.start for e in EDGES]), np.array([e.end for e in EDGES])
EDGE_POINTS = _STARTS[:, None, :] + ALONG[None, :, None] * (_ENDS - _STARTS)[:, None, :]
"""Sampling points (20, 21, 2), template units."""
EDGE_LAYER = np.array([e.layer for e in EDGES])
EDGE_IS_FRAME = np.array([e.frame for e in EDGES])
_TO_PAPER = np.where(EDGE_IS_FRAME, -1.0, 1.0)[:, None]
EDGE_REACH = np.array([e.reach for e in EDGES])
_FEW = slice(None, None, (POINTS_PER_EDGE - 1) // 4)
_OUTWARDS = np.array([(0.0, -1.0), (1.0, 0.0), (0.0, 1.0), (-1.0, 0.0)])[[e.side for e in EDGES]][:, None, :]
INK_TO_PAPER = _OUTWARDS[:, 0] * _TO_PAPER
"""Unit vectors (20, 2) across the edges, template axes."""
_FEW_POINTS = EDGE_POINTS[:, _FEW]
_BETWEEN_FEW = np.stack([np.interp(ALONG, ALONG[_FEW], one) for one in np.eye(len(ALONG[_FEW]))])
"""Takes what is known at the few points of an edge (E, 5) to all (E, M)."""
ALONG_SHARE = (POINTS_PER_EDGE - 1) / POINTS_PER_EDGE / (1 - 2 * END_MARGIN)
"""The length of an edge over the sum of its points' spacings."""
_PROBES = np.concatenate([EDGE_POINTS, _FEW_POINTS - _OUTWARDS, _FEW_POINTS + MARGIN_UNITS * _OUTWARDS], axis=1)
"""The points of each edge, a few of them one unit further in, and as far out as the quiet margin is wide."""
_LAST_INWARDS = POINTS_PER_EDGE + _FEW_POINTS.shape[1]
MOST_ALONE = 0.8
"""Edges whose reach is at least this fraction of the largest tell the blur."""
LOW_RATIO, HIGH_RATIO = (float(np.exp(-((STEP_PX / blur_px) ** 2))) for blur_px in (0.75, 12.0))
"""What edges under the least and the most blur have in the product beside the top, over the top's square."""
LEAST_RISE, LEAST_RISE_GREY = 0.35, 0.05
"""How steep a rise must be: a fraction of what is typical of its own edge, both as shares of the light on its paper
(a shadow takes as much off both), and in linear grey values a pixel."""
SATURATED, WHOLE_RISE, CLIPPED_PX = 250.0, 0.75, 1.7
"""Where paper is as bright as this, an edge that rises by less than this share of it is cut off at the top by glare,
and looks so many pixels nearer to the ink for each share that is missing (at a blur of 0.8 pixels)."""

APART_PX = 3.0
"""Edges at least this far from their neighbours have whole ink and whole paper beside them."""
MOST_OF_COVER, DARKEST = 0.5, 0.5
"""What lies on a marker is known by being less than this fraction as bright as its paper, which the brightest quarter
of all points show; ink darker than this, of 255, is noise."""


def inverse_transfer(transfer: Transfer) -> NDArray[np.float32]:
    """Return the table (256,) from gray values to linear light, 0..255.

    "srgb" undoes the curve of ordinary 8-bit cameras (IEC 61966-2-1), which moves a black-white edge 0.2 to
    0.4 pixels into the black.
    """
    code = np.arange(256) / 255.0
    if transfer == "linear":
        light = code
    elif transfer == "srgb":
        light = np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)
    else:
        raise ValueError(f"transfer must be 'srgb' or 'linear', got {transfer!r}")
    return (255.0 * light).astype(np.float32)


@dataclass(frozen=True, eq=False)
class EdgePoints:
    """Where the edges were found: E edges of M points each, x and y first.

    ``offset_px`` (E, M) is the distance from the point ``predicted_px`` (2, E, M) along ``normal`` (2, E, M), the
    image unit vector from ink to paper; only where ``found``, which is only where ``in_view``.  ``edge`` (E,) indexes
    ``EDGES``; ``length_px`` (E,) is how long it looks, ``unit_px`` (E, M) how large a template unit looks across it and
    ``reach_px`` (E,) how far it is from its neighbours.  For the outermost edges ``margin_px`` (E, M) is how wide
    the quiet margin looks.  The points ``alone`` (E, M) are those furthest
    from theirs; ``blur_px`` is the standard deviation of all that blurs these: lens, pixel, interpolation, derivative
    filter, and neighbours a little.  ``clipped_px`` (E, M) is how far saturation may have moved the edge.
    """

    edge: NDArray[np.int64]
    predicted_px: Array
    normal: Array
    offset_px: Array
    found: Mask
    in_view: Mask
    length_px: Array
    unit_px: Array
    reach_px: Array
    margin_px: Array
    alone: Mask
    blur_px: float
    smoothing_px: float
    clipped_px: Array

    @property
    def lens_px(self) -> float:
        """Return the standard deviation of what blurs the image, the derivative filter left out."""
        return float(np.sqrt(self.blur_px**2 - self.smoothing_px**2))


class Template(NamedTuple):
    """What E edges are in the template, not to be changed: warps keep where these points are on a surface.

    ``points`` (E M, 2); ``probes`` (E, M + 10, 2) the points, a few of them one unit further in, and as far out as the
    quiet margin; ``few`` (E 5, 2); ``to_paper`` (E, 1) +1 where paper is outwards, else -1; ``reach`` (E,).
    """

    points: Array
    probes: Array
    few: Array
    to_paper: Array
    reach: Array


def template_of(edges: NDArray[np.int64]) -> Template:
    """Return what ``edges`` (indices of ``EDGES``) are in the template."""
    return _template_of(tuple(edges.tolist()))


@lru_cache(maxsize=32)
def _template_of(edges: tuple[int, ...]) -> Template:
    chosen = list(edges)
    flat = (EDGE_POINTS[chosen].reshape(-1, 2), _PROBES[chosen], _FEW_POINTS[chosen].reshape(-1, 2))
    template = Template(*flat, _TO_PAPER[chosen], EDGE_REACH[chosen])
    for part in template:
        part.flags.writeable = False
    return template


def locate(
    light: NDArray[np.float32],
    warp: FittedWarp,
    edges: NDArray[np.int64],
    search_px: float,
    smoothing_px: float = SMOOTHING_PX,
) -> EdgePoints:
    """Look for ``edges`` (indices of ``EDGES``) up to ``search_px`` from where ``warp`` predicts them.

    ``light`` is the image in linear light.  An edge is never looked for beyond its own reach, so that
    neighbours are not taken for it.  ``smoothing_px`` is the standard deviation of the derivative filter.
    """
    template = template_of(edges)
    seen_px = np.ascontiguousarray(warp(template.probes).transpose(2, 0, 1))
    predicted = seen_px[:, :, :POINTS_PER_EDGE]
    tangent = np.empty(predicted.shape)  # two spacings long
    np.subtract(predicted[:, :, 2:], predicted[:, :, :-2], out=tangent[:, :, 1:-1])
    tangent[:, :, 0] = 2 * (predicted[:, :, 1] - predicted[:, :, 0])
    tangent[:, :, -1] = 2 * (predicted[:, :, -1] - predicted[:, :, -2])
    spacings = np.sqrt(tangent[0] * tangent[0] + tangent[1] * tangent[1]) + 1e-9
    to_paper = template.to_paper / spacings
    normal = np.empty(predicted.shape)
    np.multiply(tangent[1], to_paper, out=normal[0])
    np.multiply(tangent[0], -to_paper, out=normal[1])
    # how far apart neighbouring edges look, where that is least: small when the print is seen at a slant
    few, few_normal = predicted[:, :, _FEW], normal[:, :, _FEW]
    inwards = (seen_px[:, :, POINTS_PER_EDGE:_LAST_INWARDS] - few) * few_normal
    outwards = (seen_px[:, :, _LAST_INWARDS:] - few) * few_normal
    across_px = np.abs(inwards[0] + inwards[1])
    reach_px = template.reach * across_px.min(axis=1)

    visible = warp.visible(template.few).reshape(len(edges), -1).all(axis=1)
    half = int(np.ceil((search_px + 3 * smoothing_px) / STEP_PX))
    in_view: Mask = _inside(predicted, half * STEP_PX, light.shape) & np.asarray(visible)[:, None]
    steps = np.arange(-half, half + 1, dtype=np.float32) * np.float32(STEP_PX)
    at = np.clip(predicted, -1e4, 1e4).astype(np.float32).reshape(2, -1, 1)
    x, y = at + normal.astype(np.float32).reshape(2, -1, 1) * steps
    profile = cv2.remap(light, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    limit_px = np.fmin(search_px, 0.6 * reach_px)  # a warp gone astray has no reach, and finds nothing
    offset, rise, beside = _steepest_rise(profile, limit_px, smoothing_px)
    ink, paper = (of(profile, axis=1).reshape(rise.shape) for of in (np.min, np.max))
    share = np.maximum(rise, 0.0) / np.maximum(paper, 1.0)
    found = in_view & np.isfinite(offset) & (rise > LEAST_RISE_GREY)
    found &= share > LEAST_RISE * share.mean(axis=1, keepdims=True)
    found &= ~_covered(ink, paper, reach_px)
    missing = np.maximum(WHOLE_RISE - (1 - ink / np.maximum(paper, 1.0)), 0.0)
    offset[~found] = 0.0
    alone = found & (reach_px >= MOST_ALONE * np.where(found.any(axis=1), reach_px, 0.0).max())[:, None]
    return EdgePoints(
        edge=edges,
        predicted_px=predicted,
        normal=normal,
        offset_px=offset,
        found=found,
        in_view=in_view,
        length_px=spacings.sum(axis=1) * (ALONG_SHARE / 2),
        unit_px=across_px @ _BETWEEN_FEW,
        reach_px=reach_px,
        margin_px=(outwards[0] + outwards[1]) @ _BETWEEN_FEW,
        alone=alone,
        blur_px=_blur(alone, rise, beside),
        smoothing_px=smoothing_px,
        clipped_px=np.where(paper >= SATURATED, CLIPPED_PX * missing, 0.0),
    )


def _covered(ink: Array, paper: Array, reach_px: Array) -> Mask:
    """Return which points (E, M) have something else beside them than paper.

    It is darker than paper, but not because of a shadow: that would darken the ink as well.
    """
    apart = reach_px >= APART_PX
    if not apart.any():
        return np.zeros(ink.shape, dtype=bool)
    dark = apart[:, None] & (paper < MOST_OF_COVER * _brightest_quarter(paper[apart]))
    if not dark.any():
        return dark
    ratio = paper / (ink + DARKEST)
    return dark & (ratio < MOST_OF_COVER * _brightest_quarter(ratio[apart]))


def _brightest_quarter(values: Array) -> float:
    """Return what a quarter of values exceed."""
    middle = 3 * values.size // 4
    return float(np.partition(values, middle, axis=None)[middle])


def _blur(alone: Mask, rise: Array, beside: Array) -> float:
    """Return the standard deviation of the bells that slopes are, from their values at the top and beside it.

    A Gaussian's logarithm is a parabola.
    """
    ratio = beside[alone].sum() / max(np.square(rise[alone]).sum(), 1e-9)
    return float(STEP_PX / np.sqrt(-np.log(np.clip(ratio, LOW_RATIO, HIGH_RATIO))))


def _inside(middle: Array, reach_px: float, shape: tuple[int, ...]) -> Mask:
    """Return which profiles (E, M), reaching as far to either side of ``middle`` (2, E, M), are inside an image."""
    x, y = middle
    across = (x >= reach_px) & (x <= shape[1] - 1 - reach_px)
    return across & (y >= reach_px) & (y <= shape[0] - 1 - reach_px)


@cache
def _derivative(samples: int, smoothing_px: float, kept: int) -> NDArray[np.float32]:
    """Return the matrix (S, T) that takes profiles (N, S), continued at their ends, to smoothed slopes a step.

    Of the slopes those in the middle are kept, ``kept`` to either side.
    """
    reach = int(np.ceil(3.5 * smoothing_px / STEP_PX))
    x = np.arange(-reach, reach + 1) * STEP_PX
    kernel = x * np.exp(-0.5 * (x / smoothing_px) ** 2)
    kernel /= kernel @ x
    matrix = np.zeros((samples, samples))
    for column in range(samples):
        np.add.at(matrix[:, column], np.clip(np.arange(column - reach, column + reach + 1), 0, samples - 1), kernel)
    middle = samples // 2
    return np.ascontiguousarray(matrix[:, middle - kept : middle + kept + 1].astype(np.float32))


def _steepest_rise(profile: NDArray[np.float32], limit_px: Array, smoothing_px: float) -> tuple[Array, Array, Array]:
    """Return where (E, M) profiles (E M, S) rise most, in pixels from their middle, and how steeply there.

    Also the product of the slopes a step before and after.
    The place is NaN where the steepest rise lies at the limit (E,) of the search: it is something else's.
    """
    samples = profile.shape[1]
    trusted_px = np.minimum(limit_px, (samples // 2) * STEP_PX - 3 * smoothing_px + 0.3) + 1e-9
    kept = int(trusted_px.max() / STEP_PX) + 1
    slope = profile @ _derivative(samples, smoothing_px, kept)
    steps = np.arange(-kept, kept + 1) * STEP_PX
    forbidden = np.where(np.abs(steps) <= trusted_px[:, None], 0.0, -np.inf).astype(np.float32)
    best = (slope.reshape(len(limit_px), -1, len(steps)) + forbidden[:, None, :]).argmax(axis=2).ravel()
    flat = slope.ravel()
    at = np.arange(0, flat.size, len(steps)) + best
    below, peak, above = flat[at - 1], flat[at], flat[at + 1]
    curvature = 2 * peak - below - above
    place = steps[best] + STEP_PX * 0.5 * (above - below) / np.where(curvature > 0, curvature, 1.0)
    place[(below >= peak) | (above > peak)] = np.nan
    shape = (len(limit_px), -1)
    return place.reshape(shape), peak.astype(float).reshape(shape), (below * above).reshape(shape)
