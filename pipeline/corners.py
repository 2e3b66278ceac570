"""Where the corners of black squares are seen, how that follows the error state, and how noisy they are measured.

Pixels: (0, 0) is the centre of the top-left pixel; corners in the marker's order.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from astratag.camera import Camera, pixel, pixel_slope
from astratag.compiled import CUBE, FLAGS, INDICES, INT, MATRIX, REAL, VECTOR, compiled
from pipeline.dynamics import ATTITUDE, POSITION, SCALE, SHIFT, STATES, Motion
from pipeline.lasting import EDGES, OUTWARD, PER_LAYER, TURNS
from pipeline.mission import FilterSection

Array = NDArray[np.float64]

CORNER_DOF = 8
"""Image coordinates of the four corners of one black square."""
TINY = float(np.finfo(float).tiny)
SHARPEST = 0.1
"""Sine between neighbouring edges, or its square, bounded so that a needle's corner stays near."""
NEAREST_M = 1e-3
"""A corner nearer to the camera than this, or behind it, is not a measurement that can be linearised."""
LINEAR_SHARE = 0.02
"""Where curvature moves corners by less than this share of their noise, one iteration is enough."""
LEAST_WHITE = 0.3
"""Share of a corner's variance that is new in each picture, however much of it could last."""
LASTS_TO_PX = 140.0
"""Extent of a layer up to which all lasts of a sigma that can: beyond, the less the farther its edges are apart."""
LINES_FROM_PX = 60.0
"""Extent of a marker's largest layer from which on corners err like ends of lines along edges: measured, as smaller
prints are matched pixel by pixel."""
LEAST_ALONE = 0.01
"""Share of that which each coordinate has by itself: a damaged layer may have no edges."""
LASTING_LOOKS = 20
"""How many looks an error of the attitude lasts while it is large: 2 s of pictures, until others outweigh them."""
FIRST_OF_POSITION, FIRST_OF_ATTITUDE, FIRST_OF_SHIFT = POSITION.start, ATTITUDE.start, SHIFT.start
FIRST_OF_EDGES, FIRST_OF_TURNS = EDGES.start, TURNS.start


@dataclass(frozen=True, eq=False)
class SeenLayer:
    """One black square as it was measured, and where its corners are on the target."""

    marker_id: int
    layer: int
    corners_px: Array
    """(4, 2)"""
    sigma_px: float
    points_target: Array
    """(4, 3)"""

    @property
    def key(self) -> tuple[int, int]:
        """Return the marker and the layer."""
        return self.marker_id, self.layer


@dataclass(frozen=True, eq=False)
class Eye:
    """A calibrated camera and where it sits on the chaser."""

    camera: Camera
    T_cam_chaser: Array

    @property
    def size_px(self) -> tuple[int, int]:
        """Return the width and height of the camera's images."""
        return self.camera.width, self.camera.height


def predicted_corners(motion: Motion, layers: Sequence[SeenLayer], eye: Eye) -> tuple[Array, Array] | None:
    """Return where the layers' corners are seen (8 L,) px and how that follows the motion's error state (8 L, 21).

    None when a corner is not before the camera or anything is out of bounds.
    """
    points_target = np.concatenate([layer.points_target for layer in layers])
    R_cam_chaser = eye.T_cam_chaser[:3, :3]
    R_cam_target = R_cam_chaser @ motion.R_chaser_target
    place = R_cam_chaser @ motion.p_chaser_target_m + eye.T_cam_chaser[:3, 3]
    pixels, H = _predicted(
        points_target,
        R_cam_target,
        place,
        np.ascontiguousarray(eye.T_cam_chaser),
        eye.camera.lens,
        motion.scale,
        motion.shift_px,
    )
    return (pixels, H) if len(H) else None


def corner_noise(layers: Sequence[SeenLayer], noise: FilterSection) -> Array:
    """Return the covariance (8 L, 8 L) px2 of what is new in a picture: each layer's own, and the shift of them all.

    A detector's sigma is how far corners are off in all; what lasts of it, ``lasting_sigma_px``, is in the state.
    """
    corners_px = np.array([layer.corners_px for layer in layers], dtype=float)
    sides_px = np.ptp(corners_px, axis=1).max(axis=1)
    by_lines, largest_px = noise.edge_end_correlation != 0, dict[int, float]()
    for layer, side_px in zip(layers, sides_px.tolist(), strict=True):
        largest_px[layer.marker_id] = max(side_px, largest_px.get(layer.marker_id, 0.0))
    return _corner_noise(
        corners_px,
        np.array([layer.sigma_px for layer in layers]),
        np.array([bool(by_lines and largest_px[layer.marker_id] >= LINES_FROM_PX) for layer in layers]),
        noise.edge_end_correlation,
        noise.lasting_sigma_px**2 * np.minimum(1.0, LASTS_TO_PX / np.maximum(sides_px, 1.0)),
        noise.picture_shift_px**2,
    )


def with_lasting(H: Array, predicted_px: Array, slots: Sequence[int], columns: int) -> Array:
    """Return slopes (8 L, ``columns``): those by the motion (8 L, 21), and those by the layers' lasting errors."""
    edges = edge_shifts(predicted_px.reshape(-1, 4, 2)).reshape(-1, 4, CORNER_DOF)
    return _with_lasting(H, edges, np.array(slots, dtype=np.int64), columns)


@compiled(MATRIX, CUBE, INDICES, INT)
def _with_lasting(H: Array, edges: Array, slots: NDArray[np.int64], columns: int) -> Array:
    whole = np.zeros((len(H), columns))
    for row in range(len(H)):
        layer, coordinate = row // CORNER_DOF, row % CORNER_DOF
        for column in range(STATES):
            whole[row, column] = H[row, column]
        first = STATES + PER_LAYER * slots[layer]
        for edge in range(4):
            shift = edges[layer, edge, coordinate]
            whole[row, first + OUTWARD] += shift
            whole[row, first + FIRST_OF_EDGES + edge] = shift
            whole[row, first + FIRST_OF_TURNS + edge] = -shift if coordinate // 2 == edge else shift
    return whole


def bending(motion: Motion, P_attitude: Array, layers: Sequence[SeenLayer], eye: Eye) -> Array | None:
    """Return what slopes miss of corners (8 L, 8 L) px2 at attitudes as uncertain as this, None where that is little.

    A nearly frontal print shows its tilt by squares of it: slopes depend on a tilt that is hardly known.  What they
    miss stays the same while the error of the attitude does, and is no smaller after many looks: it counts for each.
    Second moment of the second-order term, as in R. P. Wishner, J. A. Tabaczynski, M. Athans, "A comparison of three
    non-linear filters", 1969.
    """
    points_target = np.concatenate([layer.points_target for layer in layers])
    R_cam_chaser = eye.T_cam_chaser[:3, :3]
    place = R_cam_chaser @ motion.p_chaser_target_m + eye.T_cam_chaser[:3, 3]
    little_px = LINEAR_SHARE * min(layer.sigma_px for layer in layers)
    bent = _bending(
        points_target,
        R_cam_chaser @ motion.R_chaser_target,
        place,
        np.ascontiguousarray(P_attitude),
        float(eye.camera.K[0, 0]),
        little_px,
    )
    return bent if len(bent) else None


@compiled(MATRIX, MATRIX, VECTOR, MATRIX, REAL, REAL)
def _bending(
    points_target: Array, R_cam_target: Array, place: Array, P_attitude: Array, focal_px: float, little_px: float
) -> Array:
    """Return ``bending`` of points (N, 3), (2 N, 2 N), of no size where all moves by less than ``little_px``."""
    count = len(points_target)
    arms, centre, farthest_m = np.empty((count, 3)), np.zeros(3), 0.0
    for n in range(count):
        for k in range(3):
            centre[k] += points_target[n, k] / count
    for n in range(count):
        for k in range(3):
            arms[n, k] = points_target[n, k] - centre[k]
            farthest_m = max(farthest_m, abs(arms[n, k]))
    depth_m = (
        place[2] + R_cam_target[2, 0] * centre[0] + R_cam_target[2, 1] * centre[1] + R_cam_target[2, 2] * centre[2]
    )
    px_m = focal_px / depth_m
    most_px = px_m * farthest_m * (P_attitude[0, 0] + P_attitude[1, 1] + P_attitude[2, 2])
    if np.sqrt(LASTING_LOOKS) * most_px < little_px:
        return np.empty((0, 0))
    mean_px, spread_px, bent_px = np.zeros(2 * count), np.zeros((2 * count, 3, 3)), np.empty((3, 3))
    for n in range(count):
        for axis in range(2):
            row, along = 2 * n + axis, 0.0
            for k in range(3):
                along += R_cam_target[axis, k] * arms[n, k]
            # second derivatives by w_i and w_j of Exp(w) a at w = 0 are (e_i a_j + e_j a_i) / 2, less a for i = j
            for i in range(3):
                for j in range(3):
                    both = R_cam_target[axis, i] * arms[n, j] + R_cam_target[axis, j] * arms[n, i]
                    bent_px[i, j] = px_m * (both / 2 - (along if i == j else 0.0))
                    mean_px[row] += bent_px[i, j] * P_attitude[i, j] / 2
            for i in range(3):
                for j in range(3):
                    for k in range(3):
                        spread_px[row, i, j] += bent_px[i, k] * P_attitude[k, j]
    bending_px2 = np.empty((2 * count, 2 * count))
    for row in range(2 * count):
        for column in range(row + 1):
            variance_px2 = 0.0
            for i in range(3):
                for j in range(3):
                    variance_px2 += spread_px[row, i, j] * spread_px[column, j, i] / 2
            bending_px2[row, column] = LASTING_LOOKS * (variance_px2 + mean_px[row] * mean_px[column])
            bending_px2[column, row] = bending_px2[row, column]
    return bending_px2


@compiled(MATRIX, MATRIX, VECTOR, MATRIX, VECTOR, REAL, VECTOR)
def _predicted(
    points_target: Array,
    R_cam_target: Array,
    place: Array,
    T_cam_chaser: Array,
    lens: Array,
    scale: float,
    shift_px: Array,
) -> tuple[Array, Array]:
    """Return pixels (2 N,) of points (N, 3) and their slopes (2 N, 21); no slopes at all where they make no sense."""
    count = len(points_target)
    pixels, H, by_point, nothing = (
        np.empty(2 * count),
        np.zeros((2 * count, STATES)),
        np.empty(3),
        np.zeros((0, STATES)),
    )
    for n in range(count):
        x, y, z = points_target[n]
        right = R_cam_target[0, 0] * x + R_cam_target[0, 1] * y + R_cam_target[0, 2] * z + place[0]
        down = R_cam_target[1, 0] * x + R_cam_target[1, 1] * y + R_cam_target[1, 2] * z + place[1]
        ahead = R_cam_target[2, 0] * x + R_cam_target[2, 1] * y + R_cam_target[2, 2] * z + place[2]
        if not ahead >= NEAREST_M:
            return pixels, nothing
        seen = pixel(right, down, ahead, lens)
        for axis in range(2):
            row, centre = 2 * n + axis, lens[2 + axis]
            off_centre = seen[axis] - centre
            pixels[row] = centre + (1 + scale) * off_centre + shift_px[axis]
            by_point[:] = pixel_slope(right, down, ahead, lens, 1.0 - axis, 1.0 * axis)
            a = b = c = total = 0.0
            for j in range(3):
                slope = (1 + scale) * by_point[j]
                for k in range(3):
                    H[row, FIRST_OF_POSITION + k] += slope * T_cam_chaser[j, k]
                a += slope * R_cam_target[j, 0]
                b += slope * R_cam_target[j, 1]
                c += slope * R_cam_target[j, 2]
            H[row, FIRST_OF_ATTITUDE] = y * c - z * b  # a.(w x r) = (r x a).w
            H[row, FIRST_OF_ATTITUDE + 1] = z * a - x * c
            H[row, FIRST_OF_ATTITUDE + 2] = x * b - y * a
            H[row, SCALE] = off_centre
            H[row, FIRST_OF_SHIFT + axis] = 1.0
            for column in range(STATES):
                total += abs(H[row, column])
            if not np.isfinite(total + abs(pixels[row])):
                return pixels, nothing
    return pixels, H


def cross_rows(points: Array, rows: Array) -> Array:
    """Return points (N, 3) crossed with each row of matrices (N, 2, 3): a.(w x r) = (r x a).w."""
    x, y, z = points.T[:, :, None]
    a, b, c = rows[..., 0], rows[..., 1], rows[..., 2]
    crossed = np.empty(rows.shape)
    crossed[..., 0], crossed[..., 1], crossed[..., 2] = y * c - z * b, z * a - x * c, x * b - y * a
    return crossed


def outward_shift(quads_px: Array) -> Array:
    """Return how corners (L, 4, 2) move when every edge of their quad moves outward by a pixel."""
    return edge_shifts(quads_px).sum(axis=1)


def edge_shifts(quads_px: Array) -> Array:
    """Return how corners (L, 4, 4, 2) move when one edge, that from a corner to the next, moves outward by a pixel.

    A corner slides along the other of its edges: by d with d.n = 1 for the outward normal n of the one that moves, and
    d.n = 0 for that of the other.
    """
    return _edge_shifts(np.ascontiguousarray(quads_px, dtype=float))


@compiled(CUBE)
def _edge_shifts(quads_px: Array) -> Array:
    shifts, normals = np.zeros((len(quads_px), 4, 4, 2)), np.empty((4, 2))
    for q in range(len(quads_px)):
        quad, turn = quads_px[q], 0.0
        for i in range(4):
            after, last = (i + 1) % 4, (i + 2) % 4
            x, y = quad[after, 0] - quad[i, 0], quad[after, 1] - quad[i, 1]
            turn += x * (quad[last, 1] - quad[after, 1]) - y * (quad[last, 0] - quad[after, 0])
            length = max(np.sqrt(x * x + y * y), TINY)
            normals[i, 0], normals[i, 1] = y / length, -x / length
        for i in range(4):
            last = (i + 3) % 4
            x, y = normals[i]
            before_x, before_y = normals[last]
            cosine = before_x * x + before_y * y
            share = np.sign(turn) / max(1 - cosine * cosine, SHARPEST)
            shifts[q, i, i, 0], shifts[q, i, i, 1] = share * (x - cosine * before_x), share * (y - cosine * before_y)
            shifts[q, last, i, 0] = share * (before_x - cosine * x)
            shifts[q, last, i, 1] = share * (before_y - cosine * y)
    return shifts


@compiled(CUBE, VECTOR, FLAGS, REAL, VECTOR, REAL)
def _corner_noise(
    quads_px: Array,
    sigma_px: Array,
    by_lines: NDArray[np.bool_],
    correlation: float,
    lasting_px2: Array,
    shift_px2: float,
) -> Array:
    """Return the covariance (8 L, 8 L) of corners (L, 4, 2), which may be where lines along the edges meet.

    ``sigma_px`` (L,) is that of a coordinate, the mean over a layer; a line's two ends are correlated by so much.
    """
    size = 8 * len(quads_px)
    R, by_edge = np.zeros((size, size)), np.empty((4, 2, 2))
    for q in range(len(quads_px)):
        quad, power = quads_px[q], 0.0
        for i in range(4):
            x, y = quad[i]
            before_x, before_y = x - quad[(i + 3) % 4, 0], y - quad[(i + 3) % 4, 1]
            after_x, after_y = quad[(i + 1) % 4, 0] - x, quad[(i + 1) % 4, 1] - y
            before, after = np.sqrt(before_x**2 + before_y**2), np.sqrt(after_x**2 + after_y**2)
            sine = (before_x * after_y - before_y * after_x) / max(before * after, TINY)
            sine = np.copysign(max(abs(sine), SHARPEST), sine)
            # a corner slides along one edge when the other is moved outward
            by_edge[i, 0, 0], by_edge[i, 0, 1] = after_x / max(after, TINY) / sine, after_y / max(after, TINY) / sine
            by_edge[i, 1, 0], by_edge[i, 1, 1] = (
                -before_x / max(before, TINY) / sine,
                -before_y / max(before, TINY) / sine,
            )
            power += 2 / (8 * sine * sine)
        variance_px2 = max(sigma_px[q] ** 2 - lasting_px2[q], LEAST_WHITE * sigma_px[q] ** 2)
        alone = LEAST_ALONE if by_lines[q] else 1.0
        scale = (1 - alone) * variance_px2 / power
        for i in range(4):
            here, there = 8 * q + 2 * i, 8 * q + 2 * ((i + 1) % 4)
            for a in range(2):
                for b in range(2):
                    R[here + a, here + b] = scale * (
                        by_edge[i, 0, a] * by_edge[i, 0, b] + by_edge[i, 1, a] * by_edge[i, 1, b]
                    )
                    across = scale * correlation * by_edge[i, 1, a] * by_edge[(i + 1) % 4, 0, b]
                    R[here + a, there + b] += across
                    R[there + b, here + a] += across
                R[here + a, here + a] += alone * variance_px2
    for row in range(size):
        for column in range(row % 2, size, 2):
            R[row, column] += shift_px2
    return R
