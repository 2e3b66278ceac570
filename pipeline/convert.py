"""Between the marker library's arrays and the messages."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from numpy.typing import ArrayLike, NDArray

import astratag.detection
from astratag.camera import Camera
from astratag.transforms import pose, rotation_from_wxyz, wxyz_from_rotation
from schemas import Detection, LayerCorners, PlanarPose, Point2, Pose, Quaternion, Vector3, WarpGrid

Array = NDArray[np.float64]
NS_PER_S = 1_000_000_000


def points_message(points_px: Array) -> list[Point2]:
    """Return image points (N, 2) as messages."""
    return [Point2(x_px=x, y_px=y) for x, y in points_px.tolist()]


def points_array(points: Sequence[Point2]) -> Array:
    """Return image points as an array (N, 2)."""
    return np.array([(p.x_px, p.y_px) for p in points], dtype=float).reshape(-1, 2)


def vector_message(v: ArrayLike) -> Vector3:
    """Return a vector (3,) as a message."""
    x, y, z = np.asarray(v, dtype=float).tolist()
    return Vector3(x=x, y=y, z=z)


def vector_array(v: Vector3) -> Array:
    """Return a vector message as an array (3,)."""
    return np.array([v.x, v.y, v.z])


def pose_message(T_a_b: Array) -> Pose:
    """Return a transform (4, 4) as a message."""
    w, x, y, z = wxyz_from_rotation(T_a_b[:3, :3]).tolist()
    return Pose(translation_m=vector_message(T_a_b[:3, 3]), rotation_wxyz=Quaternion(w=w, x=x, y=y, z=z))


def pose_matrix(message: Pose) -> Array:
    """Return a pose message as a transform (4, 4)."""
    q = message.rotation_wxyz
    return pose(rotation_from_wxyz((q.w, q.x, q.y, q.z)), vector_array(message.translation_m))


def detection_message(detection: astratag.detection.Detection) -> Detection:
    """Return the marker library's detection as a message."""
    grid = detection.warp_grid_px
    return Detection(
        family=detection.family,
        marker_id=detection.marker_id,
        corners_px=points_message(detection.corners_px),
        layers=[
            LayerCorners(layer=seen.layer, corners_px=points_message(seen.corners_px), sigma_px=seen.sigma_px)
            for seen in detection.layers
        ],
        correlation=detection.correlation,
        hamming=detection.hamming,
        method=detection.method,
        planar_poses=[
            PlanarPose(T_cam_marker=pose_message(p.T_cam_marker), reprojection_rms_px=p.reprojection_rms_px)
            for p in detection.planar_poses
        ],
        T_cam_marker=None if detection.T_cam_marker is None else pose_message(detection.T_cam_marker),
        covariance=None if detection.covariance is None else detection.covariance.ravel().tolist(),
        reprojection_rms_px=detection.reprojection_rms_px,
        warp_grid=None
        if grid is None
        else WarpGrid(rows=grid.shape[0], columns=grid.shape[1], points_px=points_message(grid.reshape(-1, 2))),
    )


def calibration_message(camera: Camera, *, frame_id: str, t_capture_ns: int) -> CameraCalibration:
    """Return a camera as foxglove's calibration message."""
    message = CameraCalibration(
        frame_id=frame_id,
        width=camera.width,
        height=camera.height,
        distortion_model="plumb_bob",
        D=camera.distortion.tolist(),
        K=camera.K.ravel().tolist(),
        R=np.eye(3).ravel().tolist(),
        P=np.hstack([camera.K, np.zeros((3, 1))]).ravel().tolist(),
    )
    message.timestamp.FromNanoseconds(t_capture_ns)
    return message


def camera_from_calibration(message: CameraCalibration) -> Camera:
    """Return the camera of a calibration message.  Raises ValueError when it is not a camera we can use."""
    if message.distortion_model not in ("plumb_bob", ""):
        raise ValueError(f"calibration has distortion model {message.distortion_model!r}; only plumb_bob is supported")
    if len(message.K) != 9:
        raise ValueError(f"calibration has {len(message.K)} numbers in K, expected 9")
    return Camera(np.array(message.K).reshape(3, 3), message.D, width=message.width, height=message.height)
