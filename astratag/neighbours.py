"""What lies beside the edges in the print of a known code.

Across each sampling point of each edge runs a line over the print, as a profile does over the picture.  Where it
crosses or passes other edges, and what changes there, is known from the template and the code.
"""

from __future__ import annotations

from functools import cache, lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from astratag.compiled import CUBE, MATRIX, compiled
from astratag.edges import EDGE_DIRECTION, EDGE_POINTS, EDGE_REACH, EDGES, INK_TO_PAPER, POINTS_PER_EDGE
from astratag.geometry import CELLS, DRAWN_OFFSET, LAYERS, cell_polygons, layer_points

Array = NDArray[np.float64]
Single = NDArray[np.float32]
Numbers = NDArray[np.int64]

PAPER, INK = CELLS, CELLS + 1
"""Labels of what is no cell."""
HORIZON = 4.5
"""Edges further away than this many times an edge's reach do not matter: nearer ones spoil it first."""
LEAN_STEP, LEANS = 0.5, np.linspace(-2.5, 2.5, 11)
"""How lines lean for which is listed what is beside them; what others pass is as straight as beside the nearest."""
LEAST_TURNED = 0.02
"""Sine of the angle to a line at which an edge is not crossed but followed."""
BESIDE_UNITS = 0.02
"""How far to either side of an edge to look at what is there."""
SAME_UNITS = 1e-3
DISTANCE, SKEW, START, END, CLOSENESS = range(5)
PLACE = 5
"""What of ``Crossings.places`` is where, and how much that is."""
CELLS_OF_LAYERS = np.stack([layer_points(cell_polygons() + DRAWN_OFFSET, layer) for layer in LAYERS])
"""The triangles (3, 48, 3, 2) of all layers, template units."""
SIDES_OF_LAYERS = np.array([(*(layer.frame or layer.black), *layer.black) for layer in LAYERS], dtype=float)
"""Near and far side (3, 4) of each layer's frame, and of its black square."""


class Crossings(NamedTuple):
    """The edges, its own among them, that a line across a point of one of E edges crosses or passes, K at most.

    What is square to an edge in the picture leans in the print when it is seen at a slant: by ``LEANS`` (S,), template
    units along the edge for each across it, towards the paper.  For each lean, edge and point, nearest first, the
    ``places`` (S E, M, K, ``PLACE``), template units: the ``DISTANCE`` across the edge at which the line crosses the
    other, or would if that were longer; the ``SKEW`` of its normal, the part along the edge over the part along the
    line; where it starts and ends (``START``, ``END``), along the edge from the line; its ``CLOSENESS`` to the point.
    ``which`` (S E, M, K) is its number, from 1 on, in ``jump``: how much brighter it becomes there, in units of the
    edge's own.  A negative one is crossed the other way, and 0 is none.
    """

    places: Single
    which: Numbers
    jump: Array


@lru_cache(maxsize=128)
def crossings(code: bytes) -> Crossings:
    """Return the crossings in a print whose 48 bits are ``code``."""
    bright = np.append(np.frombuffer(code, dtype=np.uint8).astype(float), (1.0, 0.0))  # cells, paper, ink
    _, _, left, right = _segments()
    return Crossings(*all_crossings(), np.append(0.0, bright[left] - bright[right]))


UNKNOWN = Crossings(
    np.zeros((0, POINTS_PER_EDGE, 0, PLACE), dtype=np.float32),
    np.zeros((0, POINTS_PER_EDGE, 0), dtype=np.int64),
    np.zeros(1),
)
"""Of a print whose code is not known: none."""


@cache
def all_crossings() -> tuple[Single, Numbers]:
    """Return ``places`` and ``which`` of ``Crossings``, the same for all codes.  That takes 0.1 s, once."""
    listed = [_crossings_of(float(lean)) for lean in LEANS]
    row = np.concatenate([lines + n * EDGE_POINTS.size // 2 for n, (lines, _, _) in enumerate(listed)])
    places, numbers = (np.concatenate(parts) for parts in list(zip(*listed, strict=True))[1:])
    order = np.lexsort((places[:, CLOSENESS], row))
    counts = np.bincount(row, minlength=len(LEANS) * EDGE_POINTS.size // 2)
    rank = np.arange(len(row)) - np.repeat(np.cumsum(counts) - counts, counts)
    shape = (len(LEANS) * len(EDGES), POINTS_PER_EDGE, counts.max())
    at_places, which = np.zeros((*shape, PLACE), dtype=np.float32), np.zeros(shape, dtype=np.int64)
    at_places.reshape(-1, shape[2], PLACE)[row[order], rank] = places[order]
    which.reshape(-1, shape[2])[row[order], rank] = numbers[order]
    return at_places, which


def _crossings_of(lean: float) -> tuple[Numbers, Array, Numbers]:
    """Return what lines that lean by so much cross or pass, N in all: the lines' numbers, places (N, 5) and which."""
    starts, ends, _, _ = _segments()
    (u, v), (u_end, v_end) = (_along_and_across(points, lean) for points in (starts, ends))
    near = (np.minimum(np.abs(v), np.abs(v_end)) < HORIZON * EDGE_REACH[:, None, None]) | (v * v_end < 0)
    edge, point, number = np.nonzero(near)
    u, v, u_end, v_end = u[near], v[near], u_end[near], v_end[near]
    du, dv = u_end - u, v_end - v
    length = np.hypot(du, dv)
    part = np.clip(-(u * du + v * dv) / length**2, 0, 1)
    closeness = np.hypot(u + part * du, v + part * dv)
    listed = (np.abs(du) > LEAST_TURNED * length) & (closeness < HORIZON * EDGE_REACH[edge])
    slope = dv[listed] / du[listed]
    handed = EDGE_DIRECTION[:, 0] * INK_TO_PAPER[:, 1] - EDGE_DIRECTION[:, 1] * INK_TO_PAPER[:, 0]
    which = (number + 1) * np.sign(du * handed[edge]).astype(np.int64)
    begin, finish = np.minimum(u, u_end)[listed], np.maximum(u, u_end)[listed]
    places = np.stack([v[listed] - u[listed] * slope, -slope, begin, finish, closeness[listed]], axis=1)
    return (edge * POINTS_PER_EDGE + point)[listed], places, which[listed]


def _along_and_across(places: Array, lean: float) -> tuple[Array, Array]:
    """Return where places (S, 2) lie from edges' points (E, M, S): along the edge, and along the leaning line."""
    along, across = (
        (axis @ places.T)[:, None, :] - (axis[:, None, :] * EDGE_POINTS).sum(axis=2)[:, :, None]
        for axis in (EDGE_DIRECTION, INK_TO_PAPER)
    )
    return along - lean * across, across


@cache
def _segments() -> tuple[Array, Array, Numbers, Numbers]:
    """Return start and end (S, 2) of all straight edges of the print, each once, and the labels to their two sides.

    First to the side to which the normal turns from the direction as the y axis does from the x axis.
    """
    corners = CELLS_OF_LAYERS.reshape(-1, 3, 2)
    sides = np.stack([corners, np.roll(corners, -1, axis=1)], axis=2).reshape(-1, 2, 2)
    sides = np.concatenate([[(edge.start, edge.end) for edge in EDGES], sides])
    once = {frozenset(map(tuple, np.round(side / SAME_UNITS).astype(int).tolist())): side for side in sides[::-1]}
    starts, ends = np.stack(list(once.values())[::-1], axis=1)
    ahead = (ends - starts) / np.linalg.norm(ends - starts, axis=1, keepdims=True)
    beside = BESIDE_UNITS * np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)
    cells = CELLS_OF_LAYERS.reshape(len(LAYERS), CELLS, 6)
    left, right = (_label((starts + ends) / 2 + away, SIDES_OF_LAYERS, cells) for away in (beside, -beside))
    return starts, ends, left, right


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
