"""Pose from the corners of layers: both planar solutions, refined on the marker's declared surface, with covariance."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from astratag.camera import Camera
from astratag.detection import LayerDetection, PlanarPose
from astratag.geometry import LAYERS, square
from astratag.surface import Surface
from astratag.transforms import pose, transform
from astratag.warp import PoseWarp, on_surface

Array = NDArray[np.float64]

_SQUARES = [square(*layer.black) for layer in LAYERS]
REFINEMENT = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 10, 1e-8)
MAX_STEPS = 30
HOPELESS_RATIO, HOPELESS_RMS_PX = 10.0, 1.0
"""A planar pose that fits the corners worse than the better one by this factor, and than this, is not refined."""
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
    points_marker = on_surface(surface, side_m, template)[0].T
    behind_m = points_marker[:, 2].mean()
    in_plane = points_marker * (1.0, 1.0, 0.0)
    rays = camera.undistort(corners_px)
    if not np.isfinite(rays).all():
        return []
    try:
        _, rotations, translations, _ = cv2.solvePnPGeneric(
            in_plane, rays.reshape(-1, 1, 2), np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
        )
    except cv2.error:  # corners almost on one line
        return []
    poses = []
    for rotation, translation in zip(rotations, translations, strict=True):
        R_cam_marker = cv2.Rodrigues(rotation)[0]
        t_cam_marker_m = translation.ravel() - R_cam_marker[:, 2] * behind_m
        if np.isfinite(R_cam_marker).all() and np.isfinite(t_cam_marker_m).all() and t_cam_marker_m[2] > 0:
            poses.append(pose(R_cam_marker, t_cam_marker_m))
    return poses


def planar_poses(
    camera: Camera, layers: Sequence[LayerDetection], side_m: float, surface: Surface
) -> tuple[PlanarPose, ...]:
    """Return both poses that explain the measured layers, refined on all their corners, the better first.

    One that explains them far worse than the other is left as the largest layer alone has it.
    """
    if not layers:
        return ()
    largest = min(layers, key=lambda seen: seen.layer)
    starts = poses_from_square(camera, _SQUARES[largest.layer], largest.corners_px, side_m, surface)
    template, corners_px = np.concatenate([_SQUARES[seen.layer] for seen in layers]), _corners(layers)

    points_marker = np.ascontiguousarray(on_surface(surface, side_m, template)[0].T)
    rms_px = _reprojection_rms(camera, starts, points_marker, corners_px)
    hopeless_px = max(HOPELESS_RMS_PX, HOPELESS_RATIO * min(rms_px, default=0.0))
    poses = [
        _refined(camera, start, points_marker, corners_px) if rms <= hopeless_px else start
        for start, rms in zip(starts, rms_px, strict=True)
    ]
    rms_px = _reprojection_rms(camera, poses, points_marker, corners_px)
    found = [PlanarPose(T_cam_marker, rms) for T_cam_marker, rms in zip(poses, rms_px, strict=True)]
    return tuple(sorted(found, key=lambda planar: planar.reprojection_rms_px))


def _reprojection_rms(camera: Camera, poses: Sequence[Array], points_marker: Array, seen_px: Array) -> list[float]:
    """Return how far points (N, 3) of the marker are from where they are seen (N, 2) under each pose, rms pixels."""
    if not poses:
        return []
    points_cam = np.concatenate([transform(T_cam_marker, points_marker) for T_cam_marker in poses])
    points_cam[:, 2] = np.maximum(points_cam[:, 2], 1e-6)  # behind the camera is far outside every image
    at = camera.project(points_cam).reshape(len(poses), -1, 2)
    return [float(rms) for rms in np.sqrt(((at - seen_px) ** 2).sum(axis=(1, 2)) / len(seen_px))]


def _refined(camera: Camera, T_cam_marker: Array, points_marker: Array, seen_px: Array) -> Array:
    """Return a pose refined on points (N, 3) of the marker seen at (N, 2) pixels; as it was where that fails."""
    rotation, translation = cv2.solvePnPRefineLM(
        points_marker,
        seen_px,
        camera.K,
        camera.distortion,
        cv2.Rodrigues(T_cam_marker[:3, :3])[0],
        T_cam_marker[:3, 3:].copy(),
        REFINEMENT,
    )
    if not np.isfinite(rotation).all() or translation[2, 0] <= 0:
        return T_cam_marker
    return pose(cv2.Rodrigues(rotation)[0], translation)


def _corners(layers: Sequence[LayerDetection]) -> Array:
    """Return all corners of the layers, (4 L, 2) pixels."""
    return np.concatenate([seen.corners_px for seen in layers])


def refine_on_corners(start: PoseWarp, layers: Sequence[LayerDetection]) -> CornerPose:
    """Return the pose that fits all corners of all layers best, weighted by their sigmas, from a start nearby.

    Levenberg-Marquardt over the corners as they lie on the marker's surface.  The covariance follows from the
    corners' sigmas, enlarged when the corners do not fit as well as these promise.
    """
    template = np.concatenate([square(*LAYERS[seen.layer].black) for seen in layers])
    corners_px = _corners(layers)
    sigma_px = np.repeat([seen.sigma_px for seen in layers], 8)
    warp, damping = start, 1e-3

    def error(candidate: PoseWarp) -> Array:
        return (corners_px - candidate(template)).ravel() / sigma_px

    residual = error(warp)
    for _ in range(MAX_STEPS):
        J = warp.jacobian(template).reshape(-1, 6) / sigma_px[:, None]
        information = J.T @ J
        delta = np.linalg.solve(information + damping * np.diag(np.diag(information)), J.T @ residual)
        moved = warp.stepped(delta)
        after = error(moved)
        gain = residual @ residual - after @ after
        if gain <= 0:
            damping *= 10
            if damping > 1e6:
                break
            continue
        warp, residual, damping = moved, after, damping / 10
        if gain <= CONVERGED_PX2 * (1 + after @ after):
            break
    misfit = max(1.0, residual @ residual / max(len(residual) - 6, 1))
    J = warp.jacobian(template).reshape(-1, 6) / sigma_px[:, None]
    reprojection_rms_px = float(np.sqrt(((residual * sigma_px) ** 2).reshape(-1, 2).sum(axis=1).mean()))
    return CornerPose(warp.T_cam_marker, misfit * np.linalg.inv(J.T @ J), reprojection_rms_px)
