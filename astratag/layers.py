"""Corners of a marker's layers, measured: the lines along the sides of each black square, and where they meet."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from astratag.compiled import INDICES, INT, MATRIX, REAL, VECTOR, array, compiled
from astratag.detection import LayerDetection
from astratag.edges import ALONG, EDGES, POINTS_PER_EDGE
from astratag.fit import EdgeFit, followed
from astratag.geometry import LAYERS, square
from astratag.pulls import SHARP_REACH_PX
from astratag.warp import FittedWarp, quads_inside

Array = NDArray[np.float64]

LEAST_DETERMINANT = 1e-9
"""Of the equations of a line, so that edges that were not seen do no harm."""
LEAST_SINE = 1e-6
_BLACK_EDGES = np.array([[i for i, e in enumerate(EDGES) if e.layer == k and not e.frame] for k in range(len(LAYERS))])
"""The edges (3, 4) of each layer's black square, clockwise from the top."""
CORNER_FLOOR_PX = 0.003
"""What a corner's standard deviation never falls below: print and lens model, and what is not as round as a Gaussian.
Measured on the shipped approach, where corners of layers from 140 px on are off by 0.005 px."""


def measure_layers(fit: EdgeFit[FittedWarp], shape: tuple[int, int]) -> tuple[LayerDetection, ...]:
    """Return the layers whose black square was measured: all four edges located, wholly in an image of ``shape``.

    Layers whose edges have neighbours so near that all four are pulled alike are left out when others are sharp: their
    corners would be wrong together.  Each edge is its predicted curve moved by an offset and a tilt of its own; corners
    are where neighbours meet.
    """
    corners, sigma_px = _measured(
        fit.before(_CORNER_PROBES),
        fit.edges,
        fit.offset_px,
        fit.weight,
        fit.shared_px2,
        fit.reach_px,
        *shape,
    )
    found = enumerate(zip(corners, sigma_px.tolist(), strict=True))
    return tuple(LayerDetection(layer, at_px, sigma) for layer, (at_px, sigma) in found if sigma < math.inf)


def _corner_probes() -> Array:
    """Return the layers' corners, and points a little before and after them on the outlines (3, 3 layers, 4, 2)."""
    corners = np.array([square(*layer.black) for layer in LAYERS])
    ahead = 0.02 * (np.roll(corners, -1, axis=1) - corners)
    return np.stack([corners, corners - np.roll(ahead, 1, axis=1), corners + ahead])


_CORNER_PROBES = _corner_probes()
_CORNER_PROBES.flags.writeable = False  # so that warps may keep where they are on a surface


@compiled(REAL, REAL)
def _outward(dx: float, dy: float) -> tuple[float, float]:
    """Return the unit normal to the left of a clockwise tangent, out of the square."""
    length = max(np.sqrt(dx * dx + dy * dy), 1e-9)
    return dy / length, -dx / length


@compiled(VECTOR, VECTOR)
def _edge_line(offset: Array, weight: Array) -> tuple[float, float, float, float]:
    """Return the offsets of a line fitted along an edge (M,) at its start and its end, and their variances."""
    ss = se = ee = s = e = 0.0
    for m in range(POINTS_PER_EDGE):
        start, end = (1 - ALONG[m]) * weight[m], ALONG[m] * weight[m]
        ss, se, ee = ss + start * (1 - ALONG[m]), se + start * ALONG[m], ee + end * ALONG[m]
        s, e = s + start * offset[m], e + end * offset[m]
    determinant = max(ss * ee - se * se, LEAST_DETERMINANT)
    return (ee * s - se * e) / determinant, (ss * e - se * s) / determinant, ee / determinant, ss / determinant


@compiled(array(REAL, 4), INT, INDICES, MATRIX, MATRIX)
def _corners(
    around_px: Array, layer: int, rows: NDArray[np.int64], offset: Array, weight: Array
) -> tuple[Array, float]:
    """Return the corners (4, 2) of a layer's square and their variance from its edges, ``rows`` (4,) of offsets (E, M).

    ``around_px`` (3, L, 4, 2) is where corners are predicted, and the outlines a little before and after each.
    """
    corners, variance = np.empty((4, 2)), 0.0
    for corner in range(4):
        x, y = around_px[0, layer, corner]
        # two lines meet at a corner, the end of one edge and the start of the next: outward normals n and m
        nx, ny = _outward(x - around_px[1, layer, corner, 0], y - around_px[1, layer, corner, 1])
        mx, my = _outward(around_px[2, layer, corner, 0] - x, around_px[2, layer, corner, 1] - y)
        before, after = rows[corner - 1], rows[corner]
        _, a, _, variance_a = _edge_line(offset[before], weight[before])
        b, _, variance_b, _ = _edge_line(offset[after], weight[after])
        sine = nx * my - ny * mx
        if abs(sine) <= LEAST_SINE:  # edges behind the camera meet far away
            sine = LEAST_SINE
        corners[corner, 0], corners[corner, 1] = x + (a * my - b * ny) / sine, y + (b * nx - a * mx) / sine
        variance += (variance_a + variance_b) / (8 * sine * sine)
    return corners, variance


@compiled(array(REAL, 4), INDICES, MATRIX, MATRIX, MATRIX, VECTOR, INT, INT)
def _measured(
    around_px: Array,
    edges: NDArray[np.int64],
    offset: Array,
    weight: Array,
    shared: Array,
    reach_px: Array,
    height: int,
    width: int,
) -> tuple[Array, Array]:
    """Return the corners (L, 4, 2) of the layers and their standard deviations (L,), inf of those not measured."""
    layers = len(_BLACK_EDGES)
    corners, sigma_px, nearest_px = np.zeros((layers, 4, 2)), np.full(layers, np.inf), np.zeros(layers)
    rows = np.full((layers, 4), -1)
    for layer in range(layers):
        for row in range(len(edges)):
            for side in range(4):
                if edges[row] == _BLACK_EDGES[layer, side] and followed(weight[row]):
                    rows[layer, side] = row
        nearest_px[layer] = np.inf
        for side in range(4):
            nearest_px[layer] = min(nearest_px[layer], reach_px[rows[layer, side]] if rows[layer, side] >= 0 else 0.0)
    least_px = SHARP_REACH_PX if nearest_px.max() >= SHARP_REACH_PX else 0.0
    for layer in range(layers):
        if nearest_px[layer] > 0 and nearest_px[layer] >= least_px:
            square_px, variance = _corners(around_px, layer, rows[layer], offset, weight)
            if quads_inside(square_px.reshape(1, 4, 2), height, width)[0]:
                points, common = 0, 0.0
                for row in rows[layer]:
                    points += int(np.count_nonzero(weight[row]))
                    common += shared[row].sum()
                corners[layer] = square_px
                sigma_px[layer] = np.sqrt(variance + common / points + CORNER_FLOOR_PX**2)
    return corners, sigma_px
