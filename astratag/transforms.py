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
    w, *v = wxyz_from_rotation(R_a_b).tolist()
    length = math.hypot(*v)
    scale = 2.0 * math.atan2(length, w) / length if length > 1e-12 else 2.0  # w is 1 there
    return np.array([scale * v[0], scale * v[1], scale * v[2]])


def skew(v: ArrayLike) -> Array:
    """Return the matrix (3, 3) that takes w to the cross product of v and w."""
    x, y, z = np.asarray(v, dtype=float).reshape(3)
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def perturb(T_a_b: Array, xi: ArrayLike) -> Array:
    """Return T_a_b moved by xi = (rho m, theta rad) (6,) in the axes of b."""
    return perturbed(np.ascontiguousarray(T_a_b, dtype=float), np.ascontiguousarray(xi, dtype=float))


def difference(T_a_b: Array, T_a_b_hat: Array) -> Array:
    """Return xi (6,) with perturb(T_a_b_hat, xi) == T_a_b: the error whose covariance a pose carries."""
    R_hat = T_a_b_hat[:3, :3]
    rho = R_hat.T @ (T_a_b[:3, 3] - T_a_b_hat[:3, 3])
    return np.concatenate([rho, log_so3(R_hat.T @ T_a_b[:3, :3])])


def wxyz_from_rotation(R_a_b: Array) -> Array:
    """Return the unit quaternion (w, x, y, z), w >= 0.

    By the largest of its components, so that none is divided by a small one (Shepperd, 1978).
    """
    (a, b, c), (d, e, f), (g, h, i) = np.asarray(R_a_b, dtype=float).tolist()
    columns = (
        (1 + a + e + i, h - f, c - g, d - b),
        (h - f, 1 + a - e - i, b + d, c + g),
        (c - g, b + d, 1 - a + e - i, f + h),
        (d - b, c + g, f + h, 1 - a - e + i),
    )
    largest = max(range(4), key=lambda k: columns[k][k])
    q = columns[largest]
    scale = math.copysign(1 / math.hypot(*q), q[0])
    return np.array(q) * scale


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
