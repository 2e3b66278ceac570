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

from astratag.edges import EDGE_POINTS, EDGE_REACH, EDGES, INK_TO_PAPER
from astratag.geometry import CELLS, DRAWN_OFFSET, LAYERS, cell_polygons, layer_points

Array = NDArray[np.float64]
Single = NDArray[np.float32]

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
LEAST_CURVATURE = 0.35
"""How round the top must be, relative to that of an edge alone, to be the edge's own."""


class Crossings(NamedTuple):
    """Other edges on the lines across E edges' M points: K each, those that are not there with ``jump`` 0.

    ``distance`` (K, E, M) template units towards the paper; ``jump`` (K, E, M) the change of brightness there, in
    units of the edge's own times the cosine of the angle it is crossed at; ``cosine`` (K, E, M) that cosine.
    """

    distance: Single
    jump: Single
    cosine: Single


@lru_cache(maxsize=128)
def crossings(code: bytes) -> Crossings:
    """Return the crossings that change the brightness in a print whose 48 bits are ``code``."""
    distance, cosine, before, after = _all_crossings()
    bright = np.append(np.frombuffer(code, dtype=np.uint8).astype(float), (1.0, 0.0))  # cells, paper, ink
    jump = np.where(np.isfinite(distance), (bright[after] - bright[before]) * cosine, 0.0)
    nearest = np.argsort(np.where(jump != 0, np.abs(distance), np.inf), axis=2, kind="stable")[..., :MOST_CROSSINGS]
    kept = (np.take_along_axis(part, nearest, axis=2) for part in (distance, jump, cosine))
    d, j, c = (np.ascontiguousarray(part.transpose(2, 0, 1)) for part in kept)
    return Crossings(*(part.astype(np.float32) for part in (np.where(j != 0, d, FAR), j, c)))


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


def _sum_of_bells(z: Single, jump: Single, cosine: Single) -> tuple[Single, Single, Single]:
    """Return slope, curvature downwards and height (E, M) of an edge's own bell at its top and K others ``z`` away."""
    bell = jump * np.exp(-0.5 * z * z)
    bent = cosine * bell
    slope = np.add.reduce(z * bent, axis=0)
    bent *= cosine
    return slope, 1 - np.add.reduce((z * z - 1) * bent, axis=0), 1 + np.add.reduce(bell, axis=0)


def pull(near: Crossings, edges: NDArray[np.int64], unit_px: Array, blur_px: float) -> Pull:
    """Return what neighbours do to ``edges`` under a blur of standard deviation ``blur_px``.

    ``unit_px`` (E, M) is how large a template unit looks across the edge.  Newton's method on the sum of bells.
    """
    z, jump, cosine = _distances(near, edges, unit_px, blur_px)
    slope, curvature, height = _sum_of_bells(z, jump, cosine)
    x = (slope / np.maximum(curvature, LEAST_CURVATURE)).astype(np.float32, copy=False)
    if np.abs(x).max(initial=0.0) > LITTLE:
        slope, curvature, height = _sum_of_bells(z - cosine * x, jump, cosine)
        own = np.exp(-0.5 * x * x)
        curvature += (1 - x * x) * own - 1
        height += own - 1
        x += (slope - x * own) / np.maximum(curvature, LEAST_CURVATURE)
    x[(curvature < LEAST_CURVATURE) | (height < LEAST_CURVATURE)] = np.nan
    return Pull((x * blur_px).astype(float), np.maximum(curvature, LEAST_CURVATURE).astype(float))


def narrowing(near: Crossings, edges: NDArray[np.int64], unit_px: Array, blur_px: float) -> Array:
    """Return how much rounder (E, M) the tops of slopes are for their height than those of edges without neighbours."""
    _, curvature, height = _sum_of_bells(*_distances(near, edges, unit_px, blur_px))
    return np.maximum(curvature, LEAST_CURVATURE) / np.maximum(height, LEAST_CURVATURE)


def _distances(
    near: Crossings, edges: NDArray[np.int64], unit_px: Array, blur_px: float
) -> tuple[Single, Single, Single]:
    """Return how far the crossings are, square to them and in blurs, their jumps and their cosines, all (K, E, M)."""
    cosine = near.cosine[:, edges]
    return near.distance[:, edges] * (cosine * (unit_px / blur_px).astype(np.float32)), near.jump[:, edges], cosine
