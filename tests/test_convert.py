"""Between arrays and messages: there and back is the identity, and calibrations survive their message."""

import numpy as np
import pytest
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

import astratag.detection
from astratag.camera import Camera
from astratag.transforms import exp_so3, pose
from pipeline.convert import (
    calibration_message,
    camera_from_calibration,
    detection_message,
    points_array,
    points_message,
    pose_matrix,
    pose_message,
    vector_array,
    vector_message,
)
from schemas import Detection, decode, encode

FINITE = st.floats(-1e6, 1e6)
VECTORS = arrays(float, 3, elements=FINITE)
SQUARE_PX = np.array([[10.5, 20.25], [110.0, 22.0], [108.0, 121.0], [9.0, 119.0]])


@given(arrays(float, st.tuples(st.integers(0, 5), st.just(2)), elements=FINITE))
def test_points_there_and_back(points_px: np.ndarray) -> None:
    np.testing.assert_array_equal(points_array(points_message(points_px)), points_px)


@given(VECTORS)
def test_vectors_there_and_back(vector: np.ndarray) -> None:
    np.testing.assert_array_equal(vector_array(vector_message(vector)), vector)


@given(axis=VECTORS, log_angle=st.floats(-12, 0.49), translation_m=VECTORS)
def test_poses_there_and_back(axis: np.ndarray, log_angle: float, translation_m: np.ndarray) -> None:
    """Angles from 1e-12 rad to a little short of half a turn, log-uniformly."""
    length = np.linalg.norm(axis)
    theta_rad = axis / length * 10**log_angle if length > 1e-6 else np.zeros(3)
    T_a_b = pose(exp_so3(theta_rad), translation_m)
    message = pose_message(T_a_b)
    q = message.rotation_wxyz
    assert q.w >= 0
    assert q.w**2 + q.x**2 + q.y**2 + q.z**2 == pytest.approx(1, abs=1e-14)
    np.testing.assert_allclose(pose_matrix(message), T_a_b, rtol=0, atol=1e-12)


@pytest.mark.parametrize("axis", np.eye(3), ids="xyz")
def test_half_turns_there_and_back(axis: np.ndarray) -> None:
    T_a_b = pose(exp_so3(np.pi * axis), (1, 2, 3))
    np.testing.assert_allclose(pose_matrix(pose_message(T_a_b)), T_a_b, rtol=0, atol=1e-12)


@given(
    focal_px=st.tuples(st.floats(200, 1e4), st.floats(200, 1e4)),
    distortion=arrays(float, 5, elements=st.floats(-20, 20)),
    size=st.tuples(st.integers(2, 8000), st.integers(2, 8000)),
)
def test_a_camera_survives_its_calibration_message(focal_px, distortion, size) -> None:
    width, height = size
    K = [[focal_px[0], 0, (width - 1) / 2], [0, focal_px[1], (height - 1) / 2], [0, 0, 1]]
    camera = Camera(K, distortion, width=width, height=height)
    payload = encode(calibration_message(camera, frame_id="nav", t_capture_ns=1_234_567_890_123_456_789))
    message = decode(CameraCalibration, payload)
    again = camera_from_calibration(message)
    np.testing.assert_array_equal(again.K, camera.K)
    np.testing.assert_array_equal(again.distortion, camera.distortion)
    assert (again.width, again.height) == size
    assert message.timestamp.ToNanoseconds() == 1_234_567_890_123_456_789
    np.testing.assert_array_equal(np.reshape(message.P, (3, 4))[:, :3], camera.K)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"distortion_model": "equidistant"}, "distortion model 'equidistant'"),
        ({"K": [1.0] * 4}, "4 numbers in K, expected 9"),
        ({"K": [0.0] * 9}, "K must"),
        ({"width": 0}, "width must be a whole number, 1 or more"),
        ({"D": [0.0] * 8}, "distortion must be 5 terms"),
    ],
)
def test_calibrations_that_are_no_camera_of_ours(changes: dict, reason: str) -> None:
    good = {"width": 640, "height": 480, "K": [500, 0, 319.5, 0, 500, 239.5, 0, 0, 1], "distortion_model": "plumb_bob"}
    assert camera_from_calibration(CameraCalibration(**good)).width == 640
    with pytest.raises(ValueError, match=reason):
        camera_from_calibration(CameraCalibration(**{**good, **changes}))


def library_detection(**changes) -> astratag.detection.Detection:
    fields = {
        "family": "astratag20",
        "marker_id": 19,
        "corners_px": SQUARE_PX,
        "layers": (astratag.detection.LayerDetection(1, SQUARE_PX / 2, 0.07),),
        "correlation": 0.93,
        "hamming": 2,
        "method": "tps",
    }
    return astratag.detection.Detection(**{**fields, **changes})


def test_a_detection_without_a_camera() -> None:
    message = decode(Detection, encode(detection_message(library_detection())))
    assert (message.family, message.marker_id, message.method, message.hamming) == ("astratag20", 19, "tps", 2)
    np.testing.assert_array_equal(points_array(message.corners_px), SQUARE_PX)
    assert [(seen.layer, seen.sigma_px) for seen in message.layers] == [(1, 0.07)]
    np.testing.assert_array_equal(points_array(message.layers[0].corners_px), SQUARE_PX / 2)
    absent = (message.T_cam_marker, message.covariance, message.reprojection_rms_px, message.warp_grid)
    assert absent == (None, None, None, None)
    assert message.planar_poses == []


def test_a_detection_with_everything() -> None:
    T_cam_marker = pose(exp_so3((3.0, 0.1, -0.2)), (0.1, -0.2, 0.9))
    covariance = np.arange(36.0).reshape(6, 6)
    grid_px = np.arange(24.0).reshape(3, 4, 2)
    flipped = astratag.detection.PlanarPose(T_cam_marker, 0.4)
    detection = library_detection(
        planar_poses=(flipped, flipped),
        T_cam_marker=T_cam_marker,
        covariance=covariance,
        reprojection_rms_px=0.1,
        warp_grid_px=grid_px,
    )
    message = decode(Detection, encode(detection_message(detection)))
    assert message.T_cam_marker is not None
    assert message.warp_grid is not None
    np.testing.assert_allclose(pose_matrix(message.T_cam_marker), T_cam_marker, atol=1e-15)
    assert np.reshape(message.covariance, (6, 6)).tolist() == covariance.tolist()
    assert (message.warp_grid.rows, message.warp_grid.columns) == (3, 4)
    np.testing.assert_array_equal(points_array(message.warp_grid.points_px).reshape(3, 4, 2), grid_px)
    assert [p.reprojection_rms_px for p in message.planar_poses] == [0.4, 0.4]
