"""Pose from the corners of layers: both planar solutions, refined on the marker's declared surface, with covariance."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from astratag.camera import Camera, pixel
from astratag.compiled import BOOL, CUBE, INT, MATRIX, REAL, VECTOR, compiled
from astratag.detection import LayerDetection, PlanarPose
from astratag.geometry import SQUARES
from astratag.ippe import plane_poses
from astratag.normal import dot, factored, inverse
from astratag.surface import Surface
from astratag.transforms import perturbed
from astratag.warp import PoseWarp, in_camera, on_surface, pose_jacobian, seen_from

Array = NDArray[np.float64]

FEW_STEPS, MAX_STEPS = 6, 30
"""Steps that refine one of two poses: near to where one explains what is seen, further ones would lead it to the other.
And those that refine the pose."""
NEAREST_M = 1e-6
"""A point behind the camera is taken for one so near: far outside every image."""
HOPELESS_RATIO, HOPELESS_RMS_PX = 10.0, 1.0
"""A planar pose that fits the corners worse than the better one by this factor, and than this, is not refined."""
UNSEEN = 1e-12
"""Information, as a fraction of the best, that is taken to be there where the corners do not fix the pose at all."""
LEAST_SCALE = 1e-12
"""Added to pixels per metre and per radian, so that none is zero."""
FIRST_DAMPING, MOST_DAMPING = 1e-3, 1e6
CONVERGED_PX2 = 1e-9
"""Stop when the squared error, in sigmas, no longer falls by this fraction."""


class CornerPose(NamedTuple):
    """A pose refined on corners: ``covariance`` (6, 6) metres then radians, right perturbation in marker axes."""

    T_cam_marker: Array
    covariance: Array
    reprojection_rms_px: float


def poses_from_square(
    camera: Camera, template: Array, corners_px: Array, side_m: float, surface: Surface
) -> list[Array]:
    """Return the one or two poses T_cam_marker that explain four corners as a plane, the likelier first.

    ``template`` (4, 2) units of a square of the print, ``corners_px`` (4, 2) where it is seen.  On a curved
    surface the plane is the one through its corners.
    Collins and Bartoli, "Infinitesimal plane-based pose estimation", IJCV 2014.
    """
    points_marker = on_surface(surface, side_m, template)[0]
    behind_m = points_marker[2].mean()
    found = []
    for T_cam_plane in plane_poses(np.ascontiguousarray(points_marker[:2].T), camera.undistort(corners_px)):
        T_cam_plane[:3, 3] -= T_cam_plane[:3, 2] * behind_m
        if np.isfinite(T_cam_plane).all() and T_cam_plane[2, 3] > 0:
            found.append(T_cam_plane)
    return found


def planar_poses(
    camera: Camera,
    layers: Sequence[LayerDetection],
    side_m: float,
    surface: Surface,
    known: Array | None = None,
) -> tuple[PlanarPose, ...]:
    """Return both poses that explain the measured layers, refined on all their corners, the likelier first.

    ``known`` is a pose already fitted to more than the corners: it stands for the one it is near, and the other is
    looked for from its mirror image.  One that explains the corners far worse than the other is not refined.
    """
    if not layers:
        return ()
    corners = template_of_layers(tuple(seen.layer for seen in layers))
    corners_px = np.concatenate([seen.corners_px for seen in layers])
    if known is None:
        largest = min(layers, key=lambda seen: seen.layer)
        starts = poses_from_square(camera, SQUARES[largest.layer], largest.corners_px, side_m, surface)
    else:
        starts = [known, mirrored(known)]
    if not starts:
        return ()
    points_marker = on_surface(surface, side_m, corners)[0]
    sigma_px = np.repeat([seen.sigma_px for seen in layers], 4)
    lens = camera.lens
    poses, *told = _explaining(np.array(starts), known is not None, points_marker, corners_px, sigma_px, lens)
    given = [known, *poses[1:]] if known is not None else list(poses)
    found = [PlanarPose(*one) for one in zip(given, *(each.tolist() for each in told), strict=True)]
    seen = (planar for planar in found if math.isfinite(planar.reprojection_rms_px))
    return tuple(sorted(seen, key=lambda planar: -planar.probability))


@compiled(MATRIX)
def mirrored(T_cam_marker: Array) -> Array:
    """Return the pose that looks the same from so far that perspective does not tell them apart.

    The plane is mirrored in depth, along the line of sight to the marker's centre (Schweighofer and Pinz, "Robust pose
    estimation from a planar target", PAMI 2006).
    """
    t = T_cam_marker[:3, 3]
    other, length2 = T_cam_marker.copy(), (t * t).sum()
    for axis in range(3):
        along = 2 * (t * T_cam_marker[:3, axis]).sum() / length2
        other[:3, axis] = T_cam_marker[:3, axis] - along * t
    other[:3, 2] *= -1
    return other


@lru_cache(maxsize=8)
def template_of_layers(layers: tuple[int, ...]) -> Array:
    """Return the corners (4 L, 2) of layers' black squares, template units, not to be changed."""
    corners = np.concatenate([SQUARES[layer] for layer in layers])
    corners.flags.writeable = False
    return corners


@compiled(MATRIX, MATRIX, MATRIX, VECTOR)
def _squared_errors(T: Array, points_marker: Array, seen_px: Array, lens: Array) -> Array:
    """Return how far points (3, N) of the marker are from where they are seen (N, 2) under a pose: (N,) px^2."""
    squared_px = np.empty(len(seen_px))
    for i in range(len(seen_px)):
        x, y, z = in_camera(T, points_marker[0, i], points_marker[1, i], points_marker[2, i])
        u, v = pixel(x, y, max(z, NEAREST_M), lens)
        squared_px[i] = (u - seen_px[i, 0]) ** 2 + (v - seen_px[i, 1]) ** 2
    return squared_px


def refine_on_corners(start: PoseWarp, layers: Sequence[LayerDetection]) -> CornerPose:
    """Return the pose that fits all corners of all layers best, weighted by their sigmas, from a start nearby.

    Levenberg-Marquardt over the corners as they lie on the marker's surface.  The covariance follows from the
    corners' sigmas, enlarged when the corners do not fit as well as these promise.
    """
    template = template_of_layers(tuple(seen.layer for seen in layers))
    corners_px = np.concatenate([seen.corners_px for seen in layers])
    sigma_px = np.repeat([seen.sigma_px for seen in layers], 4)
    points_marker = on_surface(start.surface, start.side_m, template)[0]
    T, covariance, rms_px = _adjusted(start.T_cam_marker, points_marker, corners_px, sigma_px, start.camera.lens)
    return CornerPose(T, covariance, float(rms_px))


@compiled(MATRIX, MATRIX, MATRIX, VECTOR, VECTOR)
def _normal_equations(
    T_cam_marker: Array, points_marker: Array, seen_px: Array, sigma_px: Array, lens: Array
) -> tuple[Array, Array, float]:
    """Return normal matrix (6, 6), right side (6,) and squared error of points (3, N) seen at (N, 2), in sigmas."""
    J = pose_jacobian(points_marker, T_cam_marker, lens)
    at = seen_from(points_marker, T_cam_marker, lens, 0.0)
    normal, right, squared = np.zeros((6, 6)), np.zeros(6), 0.0
    for i in range(len(seen_px)):
        for axis in range(2):
            residual = (seen_px[i, axis] - at[i, axis]) / sigma_px[i]
            squared += residual * residual
            for p in range(6):
                right[p] += J[i, axis, p] * residual / sigma_px[i]
                for q in range(6):
                    normal[p, q] += J[i, axis, p] * J[i, axis, q] / sigma_px[i] ** 2
    return normal, right, squared


@compiled(MATRIX, REAL)
def _damped_inverse(normal: Array, damping: float) -> Array:
    """Return the inverse (6, 6) of a normal matrix whose diagonal grows by a fraction.

    Metres and radians differ by orders: it is inverted in pixels.
    """
    scale, damped = np.empty(6), np.empty((6, 6))
    for p in range(6):
        scale[p] = np.sqrt(normal[p, p]) + LEAST_SCALE
    for p in range(6):
        for q in range(6):
            damped[p, q] = normal[p, q] / (scale[p] * scale[q]) + (damping if p == q else 0.0)
    undamped = inverse(factored(damped))
    for p in range(6):
        for q in range(6):
            undamped[p, q] /= scale[p] * scale[q]
    return undamped


@compiled(MATRIX, MATRIX, MATRIX, VECTOR, VECTOR, INT)
def _nearest(
    T_cam_marker: Array, points_marker: Array, seen_px: Array, sigma_px: Array, lens: Array, most_steps: int
) -> tuple[Array, Array, float]:
    """Return the pose nearest to points (3, N) seen at (N, 2), its normal matrix (6, 6) and squared error, in sigmas.

    Levenberg and Marquardt's, begun at a pose.
    """
    T, damping, step = T_cam_marker.copy(), FIRST_DAMPING, np.empty(6)
    normal, right, squared = _normal_equations(T, points_marker, seen_px, sigma_px, lens)
    for _ in range(most_steps):
        by_right = _damped_inverse(normal, damping)
        for p in range(6):
            step[p] = dot(by_right[p], right)
        moved = perturbed(T, step)
        next_normal, next_right, next_squared = _normal_equations(moved, points_marker, seen_px, sigma_px, lens)
        gain = squared - next_squared
        if not gain > 0:
            damping *= 10
            if damping > MOST_DAMPING:
                break
            continue
        T, damping, normal, right, squared = moved, damping / 10, next_normal, next_right, next_squared
        if gain <= CONVERGED_PX2 * (1 + squared):
            break
    return T, normal, squared


@compiled(MATRIX, MATRIX, MATRIX, VECTOR, VECTOR)
def _adjusted(
    T_cam_marker: Array, points_marker: Array, seen_px: Array, sigma_px: Array, lens: Array
) -> tuple[Array, Array, float]:
    """Return the pose nearest to points (3, N) seen at (N, 2) within ``sigma_px`` (N,), its covariance, and RMS."""
    T, normal, squared = _nearest(T_cam_marker, points_marker, seen_px, sigma_px, lens, MAX_STEPS)
    covariance, misfit = _damped_inverse(normal, UNSEEN), max(1.0, squared / max(2 * len(seen_px) - 6, 1))
    for p in range(6):
        for q in range(6):
            covariance[p, q] *= misfit
    return T, covariance, math.sqrt(_squared_errors(T, points_marker, seen_px, lens).mean())


@compiled(CUBE, BOOL, MATRIX, MATRIX, VECTOR, VECTOR)
def _explaining(
    starts: Array, known: bool, points_marker: Array, seen_px: Array, sigma_px: Array, lens: Array
) -> tuple[Array, Array, Array]:
    """Return P poses refined on points (3, N) seen at (N, 2), the RMS misfit of each (P,), and its probability (P,).

    Unless the first is ``known``; and one that explains the points far worse than the other is left as it was.
    """
    count, poses = len(starts), starts.copy()
    rms_px, misfit, even = np.empty(count), np.empty(count), np.ones(len(seen_px))
    for p in range(count):
        rms_px[p] = math.sqrt(_squared_errors(poses[p], points_marker, seen_px, lens).mean())
    hopeless_px = max(HOPELESS_RMS_PX, HOPELESS_RATIO * rms_px.min())
    for p in range(count):
        if not (known and p == 0) and rms_px[p] <= hopeless_px:
            refined = _nearest(starts[p], points_marker, seen_px, even, lens, FEW_STEPS)[0]
            if np.isfinite(refined).all() and refined[2, 3] > 0:
                poses[p] = refined
        squared_px = _squared_errors(poses[p], points_marker, seen_px, lens)
        rms_px[p], misfit[p] = math.sqrt(squared_px.mean()), (squared_px / sigma_px**2).sum()
        if not math.isfinite(misfit[p]):
            rms_px[p] = misfit[p] = np.inf
    likely = np.exp(-0.5 * (misfit - misfit.min()))
    return poses, rms_px, likely / likely.sum()
