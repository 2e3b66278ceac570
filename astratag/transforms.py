"""Rigid transforms as 4x4 matrices, and the one perturbation convention used for every pose covariance.

``T_a_b`` takes b-coordinates to a and is the pose of b in a.  A pose is perturbed on the right, in the
child's axes, metres then radians: T = T_hat * [Exp(theta), rho], xi = (rho, theta).
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from astratag.compiled import MATRIX, VECTOR, compiled

Array = NDArray[np.float64]

SMALL_ANGLE_RAD = 1e-4
"""Below it the series are exact to the last digit."""
LEAST_SINE = 1e-12
"""Of half an angle: what is smaller is the half-angle itself."""


def pose(R_a_b: ArrayLike, t_a_b_m: ArrayLike) -> Array:
    """Return T_a_b (4, 4) from a rotation (3, 3) and a translation (3,)."""
    T = np.zeros((4, 4))
    T[3, 3] = 1.0
    T[:3, :3] = R_a_b
    T[:3, 3] = np.asarray(t_a_b_m, dtype=float).reshape(3)
    return T


def inverse(T_a_b: Array) -> Array:
    """Return T_b_a."""
    R = T_a_b[:3, :3]
    return pose(R.T, -R.T @ T_a_b[:3, 3])


def transform(T_a_b: Array, points_b: Array) -> Array:
    """Return points (..., 3) of b in a."""
    return points_b @ T_a_b[:3, :3].T + T_a_b[:3, 3]


def exp_so3(theta_rad: ArrayLike) -> Array:
    """Return the rotation (3, 3) of a rotation vector (3,)."""
    return cv2.Rodrigues(np.asarray(theta_rad, dtype=float).reshape(3, 1))[0]


def log_so3(R_a_b: Array) -> Array:
    """Return the rotation vector (3,) of a rotation, its angle in [0, pi]."""
    return _log_so3(np.ascontiguousarray(R_a_b, dtype=float))


def skew(v: ArrayLike) -> Array:
    """Return the matrix (3, 3) that takes w to the cross product of v and w."""
    x, y, z = np.asarray(v, dtype=float).reshape(3)
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def perturb(T_a_b: Array, xi: ArrayLike) -> Array:
    """Return T_a_b moved by xi = (rho m, theta rad) (6,) in the axes of b."""
    return perturbed(np.ascontiguousarray(T_a_b, dtype=float), np.ascontiguousarray(xi, dtype=float))


def difference(T_a_b: Array, T_a_b_hat: Array) -> Array:
    """Return xi (6,) with perturb(T_a_b_hat, xi) == T_a_b: the error whose covariance a pose carries."""
    return _difference(np.ascontiguousarray(T_a_b, dtype=float), np.ascontiguousarray(T_a_b_hat, dtype=float))


def wxyz_from_rotation(R_a_b: ArrayLike) -> Array:
    """Return the unit quaternion (w, x, y, z), w >= 0."""
    return _wxyz(np.ascontiguousarray(R_a_b, dtype=float))


def rotation_from_wxyz(rotation_wxyz: ArrayLike) -> Array:
    """Return the rotation (3, 3) of a quaternion (w, x, y, z)."""
    return Rotation.from_quat(np.asarray(rotation_wxyz, dtype=float), scalar_first=True).as_matrix()


@compiled(MATRIX, VECTOR)
def perturbed(T_a_b: Array, xi: Array) -> Array:
    """Return ``perturb``: Rodrigues' formula, and a product of transforms."""
    x, y, z = xi[3], xi[4], xi[5]
    angle2 = x * x + y * y + z * z
    angle = math.sqrt(angle2)
    if angle < SMALL_ANGLE_RAD:
        sine, versine = 1 - angle2 / 6, 0.5 - angle2 / 24  # over the angle, and over its square
    else:
        sine, versine = math.sin(angle) / angle, (1 - math.cos(angle)) / angle2
    moved = np.zeros((4, 4))
    moved[3, 3] = 1.0
    for i in range(3):
        a, b, c = T_a_b[i, 0], T_a_b[i, 1], T_a_b[i, 2]
        along = versine * (a * x + b * y + c * z)
        same = 1 - versine * angle2
        moved[i, 0] = same * a + along * x + sine * (b * z - c * y)
        moved[i, 1] = same * b + along * y + sine * (c * x - a * z)
        moved[i, 2] = same * c + along * z + sine * (a * y - b * x)
        moved[i, 3] = T_a_b[i, 3] + a * xi[0] + b * xi[1] + c * xi[2]
    return moved


@compiled(MATRIX)
def _wxyz(R: Array) -> Array:
    """Return ``wxyz_from_rotation``.

    By the largest of its components, so that none is divided by a small one (Shepperd, 1978).
    """
    x, y, z = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    xy, xz, yz = R[0, 1] + R[1, 0], R[0, 2] + R[2, 0], R[1, 2] + R[2, 1]
    a, e, i = R[0, 0], R[1, 1], R[2, 2]
    columns = (
        (1 + a + e + i, x, y, z),
        (x, 1 + a - e - i, xy, xz),
        (y, xy, 1 - a + e - i, yz),
        (z, xz, yz, 1 - a - e + i),
    )
    largest, q = columns[0][0], columns[0]
    for column, own in ((columns[1], columns[1][1]), (columns[2], columns[2][2]), (columns[3], columns[3][3])):
        if own > largest:
            largest, q = own, column
    scale = math.copysign(1 / math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]), q[0])
    return np.array([scale * q[0], scale * q[1], scale * q[2], scale * q[3]])


@compiled(MATRIX)
def _log_so3(R: Array) -> Array:
    """Return ``log_so3``."""
    w, x, y, z = _wxyz(R)
    length = math.sqrt(x * x + y * y + z * z)
    scale = 2.0 * math.atan2(length, w) / length if length > LEAST_SINE else 2.0  # w is 1 there
    return np.array([scale * x, scale * y, scale * z])


@compiled(MATRIX, MATRIX)
def _difference(T: Array, T_hat: Array) -> Array:
    """Return ``difference``."""
    turned, xi = np.zeros((3, 3)), np.zeros(6)
    for i in range(3):
        for k in range(3):
            xi[i] += T_hat[k, i] * (T[k, 3] - T_hat[k, 3])
            for j in range(3):
                turned[i, j] += T_hat[k, i] * T[k, j]
    xi[3:] = _log_so3(turned)
    return xi
