"""Edges of a marker: the twenty straight lines of its print, and where they are in an image to a few hundredths.

Each edge is sampled at fixed points along it.  Through each point a short profile is taken across the edge,
in linear light, and the place of steepest rise from ink to paper is found between samples.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from astratag.geometry import LAYERS, QUIET_MARGIN, TEMPLATE_UNITS, square
from astratag.warp import FittedWarp

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Image = NDArray[np.uint8]
Transfer = Literal["srgb", "linear"]

POINTS_PER_EDGE = 24
END_MARGIN = 0.08
"""Fraction of an edge left out at either end, where corners are round and blurred."""
STEP_PX = 0.5
SMOOTHING_PX = 0.7
"""Standard deviation of the derivative filter: little, so that neighbouring edges do not pull."""
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
        squares = [(False, layer.black, QUIET_MARGIN * TEMPLATE_UNITS)]
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
"""Sampling points (20, 24, 2), template units."""
EDGE_LAYER = np.array([e.layer for e in EDGES])
EDGE_IS_FRAME = np.array([e.frame for e in EDGES])
_TO_PAPER = np.where(EDGE_IS_FRAME, -1.0, 1.0)[:, None]
EDGE_REACH = np.array([e.reach for e in EDGES])
_FEW = np.array([0, POINTS_PER_EDGE // 2, POINTS_PER_EDGE - 1])
_OUTWARDS = np.array([(0.0, -1.0), (1.0, 0.0), (0.0, 1.0), (-1.0, 0.0)])[[e.side for e in EDGES]][:, None, :]
_FEW_POINTS = EDGE_POINTS[:, _FEW]
_PROBES = np.concatenate([EDGE_POINTS, _FEW_POINTS - _OUTWARDS], axis=1)
"""The points of each edge, and a few of them one unit further in."""
LEAST_RISE, LEAST_RISE_GREY = 0.35, 0.05
"""How steep a rise must be: a fraction of what is typical of its own edge, and in linear grey values a pixel."""


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
    """Where the edges were found: E edges of M points each.

    ``offset_px`` (E, M) is the distance from the predicted point along ``normal`` (E, M, 2), the image unit
    vector from ink to paper; only where ``found``, which is only where ``in_view``.  ``edge`` (E,) indexes
    ``EDGES``; ``length_px`` and ``reach_px`` (E,) are how long it looks and how far from its neighbours.
    """

    edge: NDArray[np.int64]
    predicted_px: Array
    normal: Array
    offset_px: Array
    found: Mask
    in_view: Mask
    length_px: Array
    reach_px: Array


def locate(light: NDArray[np.float32], warp: FittedWarp, edges: NDArray[np.int64], search_px: float) -> EdgePoints:
    """Look for ``edges`` (indices of ``EDGES``) up to ``search_px`` from where ``warp`` predicts them.

    ``light`` is the image in linear light.  An edge is never looked for beyond its own reach, so that
    neighbours are not taken for it.
    """
    seen_px = warp(_PROBES[edges])
    predicted, inwards = seen_px[:, :POINTS_PER_EDGE], seen_px[:, POINTS_PER_EDGE:]
    tangent = np.empty_like(predicted)
    tangent[:, 1:-1] = (predicted[:, 2:] - predicted[:, :-2]) / 2
    tangent[:, 0], tangent[:, -1] = predicted[:, 1] - predicted[:, 0], predicted[:, -1] - predicted[:, -2]
    spacing = np.maximum(np.hypot(tangent[..., 0], tangent[..., 1]), 1e-9)
    length_px = spacing.mean(axis=1) * (POINTS_PER_EDGE - 1) / (1 - 2 * END_MARGIN)
    to_paper = _TO_PAPER[edges] / spacing
    normal = np.empty_like(predicted)
    normal[..., 0], normal[..., 1] = tangent[..., 1] * to_paper, -tangent[..., 0] * to_paper
    # how far apart neighbouring edges look, where that is least: small when the print is seen at a slant
    across = (inwards - predicted[:, _FEW]) * normal[:, _FEW]
    reach_px = EDGE_REACH[edges] * np.abs(across.sum(axis=2)).min(axis=1)
    visible = warp.visible(_FEW_POINTS[edges].reshape(-1, 2)).reshape(-1, len(_FEW)).all(axis=1)

    half = int(np.ceil((search_px + 3 * SMOOTHING_PX) / STEP_PX))
    in_view: Mask = _inside(predicted, half * STEP_PX * normal, light.shape) & np.asarray(visible)[:, None]
    steps = np.arange(-half, half + 1, dtype=np.float32) * np.float32(STEP_PX)
    at = np.clip(predicted, -1e4, 1e4).astype(np.float32).reshape(-1, 2)
    aside = normal.astype(np.float32).reshape(-1, 2)
    x, y = (at[:, axis, None] + aside[:, axis, None] * steps for axis in (0, 1))
    profile = cv2.remap(light, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    offset, rise = _steepest_rise(profile.reshape(*normal.shape[:2], -1), np.minimum(search_px, 0.6 * reach_px))
    typical = np.maximum(rise, 0.0).mean(axis=1, keepdims=True)
    found = in_view & np.isfinite(offset) & (rise > np.maximum(LEAST_RISE * typical, LEAST_RISE_GREY))
    return EdgePoints(edges, predicted, normal, np.where(found, offset, 0.0), found, in_view, length_px, reach_px)


def _inside(middle: Array, half: Array, shape: tuple[int, ...]) -> Mask:
    """Return which profiles (E, M), reaching ``half`` (E, M, 2) to either side of ``middle``, are inside an image."""
    reach = np.abs(half)
    inside = (middle >= reach) & (middle + reach <= (shape[1] - 1, shape[0] - 1))
    return inside[..., 0] & inside[..., 1]


@cache
def _derivative(samples: int) -> NDArray[np.float32]:
    """Return the matrix (S, S) that takes profiles (N, S), continued at their ends, to their smoothed slopes a step."""
    reach = int(np.ceil(3.5 * SMOOTHING_PX / STEP_PX))
    x = np.arange(-reach, reach + 1) * STEP_PX
    kernel = x * np.exp(-0.5 * (x / SMOOTHING_PX) ** 2)
    kernel /= kernel @ x
    matrix = np.zeros((samples, samples))
    for column in range(samples):
        np.add.at(matrix[:, column], np.clip(np.arange(column - reach, column + reach + 1), 0, samples - 1), kernel)
    return matrix.astype(np.float32)


def _steepest_rise(profile: NDArray[np.float32], limit_px: Array) -> tuple[Array, Array]:
    """Return where (E, M) the profile (E, M, S) rises most, in pixels from its middle, and how steeply there.

    The place is NaN where the steepest rise lies at the limit (E,) of the search: it is something else's.
    """
    edges, points, samples = profile.shape
    slope = profile.reshape(-1, samples) @ _derivative(samples)
    steps = (np.arange(samples) - samples // 2) * STEP_PX
    trusted_px = np.minimum(limit_px, steps[-1] - 3 * SMOOTHING_PX + 0.3)[:, None] + 1e-9
    forbidden = np.where(np.abs(steps) <= trusted_px, 0.0, -np.inf).astype(np.float32)
    best = (slope.reshape(profile.shape) + forbidden[:, None, :]).argmax(axis=2).ravel()
    at = np.arange(edges * points) * samples + np.clip(best, 1, samples - 2)
    flat = slope.ravel()
    below, peak, above = flat[at - 1], flat[at], flat[at + 1]
    curvature = 2 * peak - below - above
    is_peak = (below < peak) & (above <= peak)
    place = steps[best] + STEP_PX * 0.5 * (above - below) / np.where(is_peak, curvature, 1.0)
    shape = (edges, points)
    return np.where(is_peak, place, np.nan).reshape(shape), peak.astype(float).reshape(shape)
