"""What neighbouring edges do to where an edge is found: blurred together, they move its steepest place.

Across each sampling point of each edge runs a line over the print.  Where the line crosses other edges, and what
changes there, is known from the template and the code.  Blurred by a Gaussian, every crossing adds a bell to the
slope of the profile; the place where the sum of all bells is highest is where the edge will be found.
"""

from __future__ import annotations

from functools import cache, lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from astratag.compiled import CUBE, FLAG_MATRIX, INDICES, INT, MATRIX, REAL, compiled
from astratag.edges import EDGE_POINTS, EDGE_REACH, EDGES, INK_TO_PAPER, POINTS_PER_EDGE
from astratag.geometry import CELLS, DRAWN_OFFSET, LAYERS, cell_polygons, layer_points

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

PAPER, INK = CELLS, CELLS + 1
"""Labels of what is no cell."""
HORIZON = 4.5
"""Crossings further away than this many times an edge's reach do not matter: nearer ones spoil it first."""
MOST_CROSSINGS = 6
BESIDE_UNITS = 0.02
"""How far before and after a crossing to look at what is there."""
FAR = 1e6
LITTLE = 0.1
"""A first step of Newton's method shorter than this, in blurs, needs no second."""
BELL_ENDS = 5.0
"""Bells further away, in blurs, do not matter."""
LEAST_CURVATURE = 0.35
"""How round the top must be, relative to that of an edge alone, to be the edge's own."""


class Crossings(NamedTuple):
    """Other edges on the lines across E edges' M points: K each, those that are not there with ``jump`` 0.

    ``distance`` (K, E, M) template units towards the paper; ``jump`` (K, E, M) the change of brightness there, in
    units of the edge's own times the cosine of the angle it is crossed at; ``cosine`` (K, E, M) that cosine.
    """

    distance: Array
    jump: Array
    cosine: Array


@lru_cache(maxsize=128)
def crossings(code: bytes) -> Crossings:
    """Return the crossings that change the brightness in a print whose 48 bits are ``code``."""
    distance, cosine, before, after = _all_crossings()
    bright = np.append(np.frombuffer(code, dtype=np.uint8).astype(float), (1.0, 0.0))  # cells, paper, ink
    jump = np.where(np.isfinite(distance), (bright[after] - bright[before]) * cosine, 0.0)
    nearest = np.argsort(np.where(jump != 0, np.abs(distance), np.inf), axis=2, kind="stable")[..., :MOST_CROSSINGS]
    kept = (np.take_along_axis(part, nearest, axis=2) for part in (distance, jump, cosine))
    d, j, c = (np.ascontiguousarray(part.transpose(2, 0, 1)) for part in kept)
    return Crossings(np.where(j != 0, d, FAR), j, c)


UNKNOWN = Crossings(*np.zeros((3, 0, len(EDGES), POINTS_PER_EDGE)))
"""Of a print whose code is not known: none."""


@cache
def _all_crossings() -> tuple[Array, Array, NDArray[np.int64], NDArray[np.int64]]:
    """Return distances, cosines and the labels before and after of all crossings (E, M, many); distance inf is none."""
    starts, ends = _segments()
    along = ends - starts
    length = np.hypot(*along.T)
    ray = INK_TO_PAPER[:, None, None, :]  # (E, 1, 1, 2)
    away = starts - EDGE_POINTS[:, :, None, :]
    parallel = ray[..., 0] * along[:, 1] - ray[..., 1] * along[:, 0]
    slanted = np.where(np.abs(parallel) > 1e-9, parallel, np.inf)
    distance = (away[..., 0] * along[:, 1] - away[..., 1] * along[:, 0]) / slanted
    where = (away[..., 0] * ray[..., 1] - away[..., 1] * ray[..., 0]) / slanted
    horizon = HORIZON * EDGE_REACH[:, None, None]
    met = (where >= 0) & (where <= 1) & (np.abs(distance) > 1e-6) & (np.abs(distance) < horizon) & (parallel != 0)
    distance = np.where(met, distance, np.inf)
    order = np.argsort(distance, axis=2)[..., : met.sum(axis=2).max()]
    distance = np.take_along_axis(distance, order, axis=2)
    finite = np.where(np.isfinite(distance), distance, FAR)
    again = np.diff(finite, axis=2, prepend=-FAR) < BESIDE_UNITS  # edges that triangles share
    distance = np.where(again, np.inf, distance)
    cosine = np.take_along_axis(np.abs(parallel) / length + 0 * away[..., 0], order, axis=2)
    finite = np.where(np.isfinite(distance), distance, 0.0)[..., None]
    before, after = (_label(EDGE_POINTS[:, :, None, :] + (finite + side * BESIDE_UNITS) * ray) for side in (-1, 1))
    return distance, cosine, before, after


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


class Pull(NamedTuple):
    """What neighbours do to E edges' M points when all is blurred.

    ``px`` (E, M) is how far towards the paper the steepest place lies from the edge, NaN where the edge has no such
    place of its own.  ``curvature`` (E, M) is how round the top of the slope is there, over what an edge alone has.
    """

    px: Array
    curvature: Array


@compiled(CUBE, CUBE, CUBE, INT, INT, REAL, REAL)
def _sum_of_bells(
    distance: Array, jump: Array, cosine: Array, edge: int, point: int, unit: float, x: float
) -> tuple[float, float, float]:
    """Return slope, curvature downwards and height, at ``x``, of a point's own bell, of height 1 at 0, and all others.

    Of the own bell as it is at its top; ``unit`` is how large a template unit looks, and everything is in blurs.
    """
    slope, curvature, height = 0.0, 1.0, 1.0
    for k in range(MOST_CROSSINGS):
        c = cosine[k, edge, point]
        z = c * (distance[k, edge, point] * unit - x)
        if abs(z) < BELL_ENDS and jump[k, edge, point] != 0.0:
            bell = jump[k, edge, point] * np.exp(-0.5 * z * z)
            slope += z * c * bell
            curvature -= (z * z - 1) * c * c * bell
            height += bell
    return slope, curvature, height


@compiled(CUBE, CUBE, CUBE, INDICES, MATRIX, REAL, FLAG_MATRIX)
def pull(
    distance: Array, jump: Array, cosine: Array, edges: NDArray[np.int64], unit_px: Array, blur_px: float, use: Mask
) -> Pull:
    """Return what neighbours, the fields of ``Crossings``, do to the points to ``use`` (E, M) of E ``edges``.

    All is blurred by a standard deviation of ``blur_px``; ``unit_px`` (E, M) is how large a template unit looks across
    the edge.  Newton's method on the sum of bells.
    """
    pull_px, roundness = np.zeros(use.shape), np.ones(use.shape)
    for e in range(len(edges)):
        for m in range(use.shape[1]):
            if not use[e, m]:
                continue
            unit = unit_px[e, m] / blur_px
            slope, curvature, height = _sum_of_bells(distance, jump, cosine, edges[e], m, unit, 0.0)
            x = slope / max(curvature, LEAST_CURVATURE)
            if abs(x) > LITTLE:
                slope, curvature, height = _sum_of_bells(distance, jump, cosine, edges[e], m, unit, x)
                own = np.exp(-0.5 * x * x)
                curvature += (1 - x * x) * own - 1
                height += own - 1
                x += (slope - x * own) / max(curvature, LEAST_CURVATURE)
            believed = curvature >= LEAST_CURVATURE and height >= LEAST_CURVATURE
            pull_px[e, m] = x * blur_px if believed else np.nan
            roundness[e, m] = max(curvature, LEAST_CURVATURE)
    return Pull(pull_px, roundness)


@compiled(CUBE, CUBE, CUBE, INDICES, MATRIX, REAL, FLAG_MATRIX)
def narrowing(
    distance: Array, jump: Array, cosine: Array, edges: NDArray[np.int64], unit_px: Array, blur_px: float, use: Mask
) -> Array:
    """Return how much rounder (E, M) the tops of slopes are for their height than those of edges without neighbours."""
    rounder = np.ones(use.shape)
    for e in range(len(edges)):
        for m in range(use.shape[1]):
            if use[e, m]:
                unit = unit_px[e, m] / blur_px
                _, curvature, height = _sum_of_bells(distance, jump, cosine, edges[e], m, unit, 0.0)
                rounder[e, m] = max(curvature, LEAST_CURVATURE) / max(height, LEAST_CURVATURE)
    return rounder
