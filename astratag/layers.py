"""Corners of a marker's layers, measured: the lines along the sides of each black square, and where they meet."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from astratag.detection import LayerDetection
from astratag.edges import ALONG, EDGES, POINTS_PER_EDGE
from astratag.fit import LEAST_FOUND, SHARP_REACH_PX, EdgeFit
from astratag.geometry import LAYERS, square
from astratag.warp import FittedWarp

Array = NDArray[np.float64]

LEAST_DETERMINANT = 1e-9
"""Of the equations of a line, so that edges that were not seen do no harm."""
LEAST_SINE = 1e-6
CORNER_FLOOR_PX = 0.004
"""What a corner's standard deviation never falls below: print and lens model."""


def measure_layers(fit: EdgeFit[FittedWarp], shape: tuple[int, int]) -> tuple[LayerDetection, ...]:
    """Return the layers whose black square was measured: all four edges located, wholly in an image of ``shape``.

    Layers whose edges have neighbours so near that all four are pulled alike are left out when others are sharp: their
    corners would be wrong together.  Each edge is its predicted curve moved by an offset and a tilt of its own; corners
    are where neighbours meet.
    """
    by_edge = np.zeros((3, len(EDGES), POINTS_PER_EDGE))
    edge = fit.points.edge
    by_edge[0, edge], by_edge[1, edge], by_edge[2, edge] = fit.weight, fit.offset_px, fit.shared_px2
    weight, offset, shared = by_edge[:, _BLACK_EDGES]
    measured = (np.count_nonzero(weight, axis=2) >= LEAST_FOUND * POINTS_PER_EDGE).all(axis=1)
    reach_px = np.zeros(len(EDGES))
    reach_px[edge] = fit.points.lie.reach_px
    sharp = measured & (reach_px[_BLACK_EDGES].min(axis=1) >= SHARP_REACH_PX)
    measured = sharp if sharp.any() else measured
    corners, variance = _layer_corners(fit.before(_CORNER_PROBES), offset, weight)
    height, width = shape
    found = []
    for layer in np.flatnonzero(measured).tolist():
        square_px = corners[layer]
        if square_px.min() >= 0 and square_px[:, 0].max() <= width - 1 and square_px[:, 1].max() <= height - 1:
            common = shared[layer].sum() / np.count_nonzero(weight[layer])
            sigma_px = float(np.sqrt(variance[layer] + common + CORNER_FLOOR_PX**2))
            found.append(LayerDetection(layer, square_px, sigma_px))
    return tuple(found)


def _corner_probes() -> Array:
    """Return the layers' corners, and points a little before and after them on the outlines (3, 3 layers, 4, 2)."""
    corners = np.array([square(*layer.black) for layer in LAYERS])
    ahead = 0.02 * (np.roll(corners, -1, axis=1) - corners)
    return np.stack([corners, corners - np.roll(ahead, 1, axis=1), corners + ahead])


_CORNER_PROBES = _corner_probes()
_CORNER_PROBES.flags.writeable = False  # so that warps may keep where they are on a surface


def _layer_corners(around_px: Array, offset: Array, weight: Array) -> tuple[Array, Array]:
    """Return the corners (L, 4, 2) of squares and their variances (L,) from the offsets (L, 4, M) of edges.

    ``around_px`` (3, L, 4, 2) is where the corners are predicted, and the outlines a little before and after each.
    """
    predicted, before, after = around_px
    ends, variances = _edge_lines(offset, weight)
    # two lines meet at a corner: the end of one edge and the start of the next
    nx, ny = _outward(predicted - before)
    mx, my = _outward(after - predicted)
    a, b = ends[..., 1][:, _PREVIOUS], ends[..., 0]
    moved = np.stack([a * my - b * ny, b * nx - a * mx], axis=-1)
    sine = nx * my - ny * mx
    sine = np.where(np.abs(sine) > LEAST_SINE, sine, LEAST_SINE)  # edges behind the camera meet far away
    a, b = variances[..., 1][:, _PREVIOUS], variances[..., 0]
    variance = ((a * (my**2 + mx**2) + b * (ny**2 + nx**2)) / (2 * sine**2)).mean(axis=1)
    return predicted + moved / sine[..., None], variance


def _outward(tangent: Array) -> tuple[Array, Array]:
    """Return x and y of the unit normals to the left of clockwise tangents (..., 2), out of the square."""
    dx, dy = tangent[..., 0], tangent[..., 1]
    length = np.maximum(np.sqrt(dx * dx + dy * dy), 1e-9)
    return dy / length, -dx / length


def _edge_lines(offset: Array, weight: Array) -> tuple[Array, Array]:
    """Return the offsets (..., 2) of lines fitted along edges (..., M) at their two ends, and their variances."""
    moments = weight @ _LINE_MOMENTS
    ss, se, ee = moments[..., 0], moments[..., 1], moments[..., 2]
    seen = (weight * offset) @ _LINE
    s, e = seen[..., 0], seen[..., 1]
    determinant = np.maximum(ss * ee - se * se, LEAST_DETERMINANT)
    variances = np.stack([ee, ss], axis=-1) / determinant[..., None]
    return np.stack([ee * s - se * e, ss * e - se * s], axis=-1) / determinant[..., None], variances


_BLACK_EDGES = np.array([[i for i, e in enumerate(EDGES) if e.layer == k and not e.frame] for k in range(len(LAYERS))])
"""The edges (3, 4) of each layer's black square, clockwise from the top."""
_PREVIOUS = np.array([3, 0, 1, 2])
_LINE = np.stack([1 - ALONG, ALONG], axis=1)
"""What the points of an edge feel (M, 2) of an offset at its start and at its end."""
_LINE_MOMENTS = np.stack([_LINE[:, 0] ** 2, _LINE[:, 0] * _LINE[:, 1], _LINE[:, 1] ** 2], axis=1)
