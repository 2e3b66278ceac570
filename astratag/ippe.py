"""The two poses that explain four corners of a plane.  Compiled.

Collins and Bartoli, "Infinitesimal plane-based pose estimation", IJCV 2014: what a homography does about one point of
the plane fixes its rotation but for a reflection.  OpenCV has the same, in twenty times as many calls.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from astratag.compiled import MATRIX, REAL, compiled
from astratag.warp import plane_between

Array = NDArray[np.float64]


@compiled(REAL, REAL)
def _along_axis(x: float, y: float) -> Array:
    """Return the smallest rotation (3, 3) that takes the optical axis to the line of sight through (x, y, 1)."""
    length = math.sqrt(x * x + y * y + 1)
    ax, ay, az = x / length, y / length, 1 / length
    share = 1 / (1 + az)
    R = np.empty((3, 3))
    R[0, 0], R[0, 1], R[0, 2] = 1 - ax * ax * share, -ax * ay * share, ax
    R[1, 0], R[1, 1], R[1, 2] = -ax * ay * share, 1 - ay * ay * share, ay
    R[2, 0], R[2, 1], R[2, 2] = -ax, -ay, az
    return R


@compiled(MATRIX)
def _rotations(H: Array) -> Array:
    """Return both rotations (2, 3, 3) of a plane that a homography (3, 3) with H[2, 2] = 1 takes to x/z and y/z."""
    x, y = H[0, 2], H[1, 2]
    V = _along_axis(x, y)
    b00, b01, b10, b11 = V[0, 0] - x * V[2, 0], V[0, 1] - x * V[2, 1], V[1, 0] - y * V[2, 0], V[1, 1] - y * V[2, 1]
    area = b00 * b11 - b01 * b10
    A, R, both = np.empty((2, 2)), np.empty((3, 3)), np.zeros((2, 3, 3))
    for i in range(2):
        along, across = H[0, i] - H[2, i] * x, H[1, i] - H[2, i] * y  # of the point about which it is seen
        A[0, i], A[1, i] = (b11 * along - b01 * across) / area, (b00 * across - b10 * along) / area
    aa, ab, bb = A[0, 0] ** 2 + A[0, 1] ** 2, A[0, 0] * A[1, 0] + A[0, 1] * A[1, 1], A[1, 0] ** 2 + A[1, 1] ** 2
    A /= math.sqrt(0.5 * (aa + bb + math.sqrt((aa - bb) ** 2 + 4 * ab * ab)))  # by its larger singular value
    down = math.sqrt(max(1 - A[0, 0] ** 2 - A[1, 0] ** 2, 0.0)), math.sqrt(max(1 - A[0, 1] ** 2 - A[1, 1] ** 2, 0.0))
    same = 1.0 if A[0, 0] * A[0, 1] + A[1, 0] * A[1, 1] <= 0 else -1.0
    for k in range(2):
        c, d = (down[0], same * down[1]) if k == 0 else (-down[0], -same * down[1])
        for i in range(2):
            R[i, 0], R[i, 1] = A[i, 0], A[i, 1]
        R[2, 0], R[2, 1] = c, d
        for i in range(3):  # the third is across the first two
            j, m = (i + 1) % 3, (i + 2) % 3
            R[i, 2] = R[j, 0] * R[m, 1] - R[m, 0] * R[j, 1]
        for i in range(3):
            for j in range(3):
                for m in range(3):
                    both[k, i, j] += V[i, m] * R[m, j]
    return both


@compiled(MATRIX, MATRIX, MATRIX)
def _translation(R: Array, points: Array, rays: Array) -> Array:
    """Return where (3,) a plane turned by R (3, 3) is, for its points (N, 2) to be seen along rays (N, 2) at best."""
    u_sum, v_sum, squares, right = 0.0, 0.0, 0.0, np.zeros(3)
    for n in range(len(points)):
        u, v, p, q = rays[n, 0], rays[n, 1], points[n, 0], points[n, 1]
        depth = R[2, 0] * p + R[2, 1] * q
        along, across = u * depth - R[0, 0] * p - R[0, 1] * q, v * depth - R[1, 0] * p - R[1, 1] * q
        u_sum, v_sum, squares = u_sum + u, v_sum + v, squares + u * u + v * v
        right[0], right[1], right[2] = right[0] + along, right[1] + across, right[2] - u * along - v * across
    count, t = len(points), np.empty(3)
    spread = squares - (u_sum * u_sum + v_sum * v_sum) / count
    t[2] = (right[2] + (u_sum * right[0] + v_sum * right[1]) / count) / spread
    t[0], t[1] = (right[0] + u_sum * t[2]) / count, (right[1] + v_sum * t[2]) / count
    return t


@compiled(MATRIX, MATRIX)
def plane_poses(points: Array, rays: Array) -> Array:
    """Return the two poses (2, 4, 4) of a plane four points (4, 2) of which are seen along rays (4, 2), x/z and y/z.

    The one that explains them better comes first.  Not finite where the points or the rays are on one line.
    """
    middle_x, middle_y = points[:, 0].mean(), points[:, 1].mean()
    about = np.empty((4, 2))
    for n in range(4):
        about[n, 0], about[n, 1] = points[n, 0] - middle_x, points[n, 1] - middle_y
    H = plane_between(about, rays)
    rotations, poses, squared = _rotations(H / H[2, 2]), np.zeros((2, 4, 4)), np.zeros(2)
    for k in range(2):
        R = rotations[k]
        t = _translation(R, about, rays)
        for n in range(4):
            p, q = about[n, 0], about[n, 1]
            x, y = R[0, 0] * p + R[0, 1] * q + t[0], R[1, 0] * p + R[1, 1] * q + t[1]
            z = R[2, 0] * p + R[2, 1] * q + t[2]
            squared[k] += (x / z - rays[n, 0]) ** 2 + (y / z - rays[n, 1]) ** 2
        for i in range(3):
            poses[k, i, :3] = R[i]
            poses[k, i, 3] = t[i] - R[i, 0] * middle_x - R[i, 1] * middle_y
        poses[k, 3, 3] = 1.0
    return poses[::-1].copy() if squared[1] < squared[0] else poses
