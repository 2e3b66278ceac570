"""What lies beside the edges in the print of a known code.

Across each sampling point of each edge runs a line over the print, as a profile does over the picture.  Where the line
crosses other edges, and what changes there, is known from the template and the code.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache, lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from astratag.compiled import CUBE, MATRIX, compiled
from astratag.edges import EDGE_DIRECTION, EDGE_POINTS, EDGE_REACH, EDGES, INK_TO_PAPER, POINTS_PER_EDGE
from astratag.geometry import CELLS, DRAWN_OFFSET, LAYERS, cell_polygons, layer_points

Array = NDArray[np.float64]

PAPER, INK = CELLS, CELLS + 1
"""Labels of what is no cell."""
HORIZON = 4.5
"""Crossings further away than this many times an edge's reach do not matter: nearer ones spoil it first."""
MOST_CROSSINGS = 6
LEAN_STEP, LEANS = 0.5, np.linspace(-2.5, 2.5, 11)
"""How lines lean for which crossings are listed; what others cross is taken to be as straight as beside the nearest."""
LEAST_TURNED = 0.02
"""Sine of the angle to a line at which an edge is not crossed but followed."""
BESIDE_UNITS = 0.02
"""How far before and after a crossing to look at what is there."""
FAR = 1e6
CELLS_OF_LAYERS = np.stack([layer_points(cell_polygons() + DRAWN_OFFSET, layer) for layer in LAYERS])
"""The triangles (3, 48, 3, 2) of all layers, template units."""
SIDES_OF_LAYERS = np.array([(*(layer.frame or layer.black), *layer.black) for layer in LAYERS], dtype=float)
"""Near and far side (3, 4) of each layer's frame, and of its black square."""


class Crossings(NamedTuple):
    """Other edges on the lines across E edges' M points: K each, those that are not there with ``jump`` 0.

    What is square to an edge in the picture leans in the print when it is seen at a slant: by ``LEANS`` (S,), template
    units along the edge for each across it, towards the paper.  All are (S E, M, K): ``distance`` template units across
    the edge; ``jump`` the change of brightness there, in units of the edge's own; ``skew`` how the other edge's normal
    lies, its part along the edge over its part along the line.
    """

    distance: Array
    jump: Array
    skew: Array


@lru_cache(maxsize=128)
def crossings(code: bytes) -> Crossings:
    """Return the crossings that change the brightness in a print whose 48 bits are ``code``."""
    bright = np.append(np.frombuffer(code, dtype=np.uint8).astype(float), (1.0, 0.0))  # cells, paper, ink
    distance, skew, before, after = all_crossings()
    jump = np.where(np.isfinite(distance), bright[after] - bright[before], 0.0)
    nearest = np.argsort(np.where(jump != 0, np.abs(distance), np.inf), axis=2, kind="stable")[..., :MOST_CROSSINGS]
    d, j, k = (np.ascontiguousarray(np.take_along_axis(part, nearest, axis=2)) for part in (distance, jump, skew))
    return Crossings(np.where(j != 0, d, FAR), j, k)


UNKNOWN = Crossings(*np.zeros((3, 0, POINTS_PER_EDGE, MOST_CROSSINGS)))
"""Of a print whose code is not known: none."""


@cache
def all_crossings() -> tuple[Array, Array, NDArray[np.int64], NDArray[np.int64]]:
    """Return distances, skews and the labels before and after of all crossings (S E, M, many); distance inf is none.

    That takes 0.1 s, once.
    """
    distance, skew, before, after = zip(*(_crossings_of(float(lean)) for lean in LEANS), strict=True)
    most = max(part.shape[2] for part in distance)
    return (
        _joined(distance, most, np.inf),
        _joined(skew, most, 0),
        _joined(before, most, INK),
        _joined(after, most, INK),
    )


def _joined(parts: Sequence[NDArray[Any]], most: int, fill: float) -> NDArray[Any]:
    """Return arrays (E, M, up to most) one after another (S E, M, most)."""
    return np.concatenate(
        [np.pad(part, ((0, 0), (0, 0), (0, most - part.shape[2])), constant_values=fill) for part in parts]
    )


def _crossings_of(lean: float) -> tuple[Array, Array, NDArray[np.int64], NDArray[np.int64]]:
    """Return distances, skews and the labels (E, M, many) of the crossings on lines that lean by so much."""
    starts, ends = _segments()
    side = ends - starts
    across = INK_TO_PAPER[:, None, None, :]  # (E, 1, 1, 2)
    along = EDGE_DIRECTION[:, None, None, :]
    line = across + lean * along
    away = starts - EDGE_POINTS[:, :, None, :]
    turned = line[..., 0] * side[:, 1] - line[..., 1] * side[:, 0]
    slanted = np.where(np.abs(turned) > LEAST_TURNED * np.hypot(*side.T), turned, np.inf)
    distance = (away[..., 0] * side[:, 1] - away[..., 1] * side[:, 0]) / slanted
    where = (away[..., 0] * line[..., 1] - away[..., 1] * line[..., 0]) / slanted
    horizon = HORIZON * EDGE_REACH[:, None, None]
    met = (where >= 0) & (where <= 1) & (np.abs(distance) > 1e-6) & (np.abs(distance) < horizon) & (slanted != np.inf)
    distance = np.where(met, distance, np.inf)
    order = np.argsort(distance, axis=2)[..., : met.sum(axis=2).max()]
    distance = np.take_along_axis(distance, order, axis=2)
    finite = np.where(np.isfinite(distance), distance, FAR)
    again = np.diff(finite, axis=2, prepend=-FAR) < BESIDE_UNITS  # edges that triangles share
    distance = np.where(again, np.inf, distance)
    handed = along[..., 0] * across[..., 1] - along[..., 1] * across[..., 0]
    skew = handed * (side[:, 0] * across[..., 0] + side[:, 1] * across[..., 1]) / slanted
    skew = np.take_along_axis(np.broadcast_to(skew, away.shape[:3]), order, axis=2)
    there = np.isfinite(distance)
    edge, point, _ = np.nonzero(there)
    before, after = np.full((2, *distance.shape), INK)
    for labels, by in ((before, -BESIDE_UNITS), (after, BESIDE_UNITS)):
        places = EDGE_POINTS[edge, point] + (distance[there] + by)[:, None] * line[edge, 0, 0]
        labels[there] = _label(places, SIDES_OF_LAYERS, CELLS_OF_LAYERS.reshape(len(LAYERS), CELLS, 6))
    return distance, skew, before, after


def _segments() -> tuple[Array, Array]:
    """Return start and end (S, 2) of all straight edges of the print."""
    triangles = CELLS_OF_LAYERS.reshape(-1, 3, 2)
    ends = np.roll(triangles, -1, axis=1)
    sides = [np.array([edge.start for edge in EDGES]), np.array([edge.end for edge in EDGES])]
    return np.concatenate([sides[0], triangles.reshape(-1, 2)]), np.concatenate([sides[1], ends.reshape(-1, 2)])


@compiled(MATRIX, MATRIX, CUBE)
def _label(points: Array, squares: Array, cells: Array) -> NDArray[np.int64]:
    """Return what is at template points (N, 2): a cell's number, ``PAPER`` or ``INK``.

    ``squares`` (3, 4) are near and far side of each layer's frame, and of its black square; ``cells`` (3, 48, 6) the
    corners of its triangles.
    """
    label = np.full(len(points), PAPER)
    for i in range(len(points)):
        x, y = points[i]
        for layer in range(len(squares)):
            if not (squares[layer, 0] < min(x, y) and max(x, y) < squares[layer, 1]):
                break
            label[i] = PAPER
            if not (squares[layer, 2] < min(x, y) and max(x, y) < squares[layer, 3]):
                break
            label[i] = INK
            for cell in range(CELLS):
                ax, ay, bx, by, cx, cy = cells[layer, cell]
                ab = (bx - ax) * (y - ay) > (by - ay) * (x - ax)
                bc = (cx - bx) * (y - by) > (cy - by) * (x - bx)
                ca = (ax - cx) * (y - cy) > (ay - cy) * (x - cx)
                if ab == bc and bc == ca:
                    label[i] = cell
    return label
