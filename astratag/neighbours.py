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
    distance, skew, before, after = _all_crossings()
    jump = np.where(np.isfinite(distance), bright[after] - bright[before], 0.0)
    nearest = np.argsort(np.where(jump != 0, np.abs(distance), np.inf), axis=2, kind="stable")[..., :MOST_CROSSINGS]
    d, j, k = (np.ascontiguousarray(np.take_along_axis(part, nearest, axis=2)) for part in (distance, jump, skew))
    return Crossings(np.where(j != 0, d, FAR), j, k)


UNKNOWN = Crossings(*np.zeros((3, 0, POINTS_PER_EDGE, MOST_CROSSINGS)))
"""Of a print whose code is not known: none."""


@cache
def _all_crossings() -> tuple[Array, Array, NDArray[np.int64], NDArray[np.int64]]:
    """Return distances, skews and the labels before and after of all crossings (S E, M, many); distance inf is none."""
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
    finite = np.where(np.isfinite(distance), distance, 0.0)[..., None]
    before, after = (_label(EDGE_POINTS[:, :, None, :] + (finite + by * BESIDE_UNITS) * line) for by in (-1, 1))
    return distance, skew, before, after


def _triangles() -> Array:
    """Return the cells of all layers (3, 48, 3, 2), template units."""
    return np.stack([layer_points(cell_polygons() + DRAWN_OFFSET, layer) for layer in LAYERS])


def _segments() -> tuple[Array, Array]:
    """Return start and end (S, 2) of all straight edges of the print."""
    triangles = _triangles().reshape(-1, 3, 2)
    ends = np.roll(triangles, -1, axis=1)
    sides = [np.array([edge.start for edge in EDGES]), np.array([edge.end for edge in EDGES])]
    return np.concatenate([sides[0], triangles.reshape(-1, 2)]), np.concatenate([sides[1], ends.reshape(-1, 2)])


def _label(points: Array) -> NDArray[np.int64]:
    """Return what is at template points (..., 2): a cell's number, ``PAPER`` or ``INK``."""
    flat = points.reshape(-1, 2)
    label = np.full(len(flat), PAPER)
    for layer, cells in zip(LAYERS, _triangles(), strict=True):
        for (near, far), what in ((layer.frame or layer.black, PAPER), (layer.black, INK)):
            label[((flat > near) & (flat < far)).all(axis=1)] = what
        inside = np.flatnonzero(((flat > layer.black[0]) & (flat < layer.black[1])).all(axis=1))
        x, y = flat[inside].T
        for cell, corners in enumerate(cells):
            edges = np.roll(corners, -1, axis=0) - corners
            turns = [ex * (y - ay) - ey * (x - ax) for (ax, ay), (ex, ey) in zip(corners, edges, strict=True)]
            label[inside[(np.sign(turns[0]) == np.sign(turns[1])) & (np.sign(turns[1]) == np.sign(turns[2]))]] = cell
    return label.reshape(points.shape[:-1])
