"""Edges of a marker: the twenty straight lines of its print, and the points along them at which they are measured."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from astratag.geometry import LAYERS, QUIET_MARGIN, TEMPLATE_UNITS, square

Array = NDArray[np.float64]
Transfer = Literal["srgb", "linear"]

POINTS_PER_EDGE = 21
END_MARGIN = 0.08
"""Fraction of an edge left out at either end, where corners are round and blurred."""
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
_TO_PAPER = np.where(EDGE_IS_FRAME, -1.0, 1.0)
EDGE_REACH = np.array([e.reach for e in EDGES])
FEW_INTERVALS = 4
"""What varies little along an edge is known at its two ends and between so many equal parts of it."""
_OUTWARDS = np.array([(0.0, -1.0), (1.0, 0.0), (0.0, 1.0), (-1.0, 0.0)])[[e.side for e in EDGES]][:, None, :]
INK_TO_PAPER = _OUTWARDS[:, 0] * _TO_PAPER[:, None]
"""Unit vectors (20, 2) across the edges, template axes."""
EDGE_DIRECTION = np.stack([-_OUTWARDS[:, 0, 1], _OUTWARDS[:, 0, 0]], axis=1)
"""Unit vectors (20, 2) along the edges, as their points follow one another."""
EDGE_SPACING = np.linalg.norm(EDGE_POINTS[:, 1] - EDGE_POINTS[:, 0], axis=1)
"""Template units (20,) between neighbouring points."""
_FEW_POINTS = EDGE_POINTS[:, :: (POINTS_PER_EDGE - 1) // FEW_INTERVALS]
ALONG_SHARE = (POINTS_PER_EDGE - 1) / POINTS_PER_EDGE / (1 - 2 * END_MARGIN)
"""The length of an edge over the sum of its points' spacings."""
_OUTERMOST = (EDGE_LAYER == 0) & ~EDGE_IS_FRAME
EDGE_OUTSIDE = np.where(_OUTERMOST, MARGIN_UNITS, EDGE_REACH)
"""How far outside of each edge to look how large units are there: to the quiet margin's end, or the next edge."""
_OUTSIDE = EDGE_OUTSIDE[:, None, None] * _OUTWARDS
_PROBES = np.concatenate([EDGE_POINTS, _FEW_POINTS - _OUTWARDS, _FEW_POINTS + _OUTSIDE], axis=1)
"""The points of each edge, a few of them one unit further in, and ``EDGE_OUTSIDE`` further out."""


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


class Template(NamedTuple):
    """What E edges are in the template, not to be changed: warps keep where these points are on a surface.

    ``points`` (E M, 2); ``probes`` (E, M + 10, 2) the points, a few of them one unit further in, and ``outside`` (E,)
    further out; ``few`` (E 5, 2); ``to_paper`` (E,) +1 where paper is outwards, else -1; ``reach`` (E,); ``spacing``
    (E,) of the points.
    """

    points: Array
    probes: Array
    few: Array
    to_paper: Array
    reach: Array
    spacing: Array
    outside: Array


def template_of(edges: NDArray[np.int64]) -> Template:
    """Return what ``edges`` (indices of ``EDGES``) are in the template."""
    return _template_of(tuple(edges.tolist()))


@lru_cache(maxsize=32)
def _template_of(edges: tuple[int, ...]) -> Template:
    chosen = list(edges)
    flat = (EDGE_POINTS[chosen].reshape(-1, 2), _PROBES[chosen], _FEW_POINTS[chosen].reshape(-1, 2))
    template = Template(*flat, _TO_PAPER[chosen], EDGE_REACH[chosen], EDGE_SPACING[chosen], EDGE_OUTSIDE[chosen])
    for part in template:
        part.flags.writeable = False
    return template
