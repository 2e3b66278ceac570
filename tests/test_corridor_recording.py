"""The shipped recording is what its script makes, and holds what the project promises."""

import importlib
from itertools import pairwise
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
import pytest

from astratag.transforms import difference, inverse
from pipeline.convert import camera_from_calibration, pose_matrix, vector_array
from pipeline.recording import Recording
from schemas import Truth
from schemas.topics import CALIBRATION, FRAME, TRUTH

RECORDINGS = Path(__file__).parents[1] / "recordings"
CORRIDOR = RECORDINGS / "corridor.mcap"
MIB = 2**20


@pytest.fixture(scope="module")
def recording() -> Recording:
    return Recording(CORRIDOR)


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(RECORDINGS)
    return importlib.import_module("make_corridor")


def test_is_as_large_and_as_long_as_promised(recording: Recording) -> None:
    assert CORRIDOR.stat().st_size <= 25 * MIB
    assert recording.frame_count >= 300
    stamps_ns = np.array([envelope.stamp.t_capture_ns for envelope, _ in recording.envelopes((FRAME,))])
    assert 10 <= 1e9 / np.diff(stamps_ns).mean() <= 20
    sequences = [envelope.stamp.sequence for envelope, _ in recording.envelopes((FRAME,))]
    assert sequences == list(range(recording.frame_count))


def motion(truth: Truth) -> np.ndarray:
    """Return the pose, velocity and rate of a truth in one row."""
    velocity, rate = vector_array(truth.v_chaser_target_m_s), vector_array(truth.omega_chaser_target_in_target_rad_s)
    return np.concatenate([pose_matrix(truth.T_chaser_target).ravel(), velocity, rate])


def test_comes_from_its_script(recording: Recording, script: ModuleType) -> None:
    """Mission and calibration to the last digit, truth to rounding, a picture rendered anew to what JPEG leaves."""
    assert recording.mission == script.MISSION
    calibration = next(recording.messages(CALIBRATION))
    assert np.array_equal(camera_from_calibration(calibration).K, script.CAMERA.K)
    truths = list(recording.messages(TRUTH))
    assert len(truths) == recording.frame_count
    for frame, truth in zip(recording.messages(FRAME), truths, strict=True):
        assert frame.timestamp.ToNanoseconds() == truth.t_capture_ns
    middle = len(truths) // 2
    again = next(script.frame_messages(truths[middle].t_capture_ns, b""))
    np.testing.assert_allclose(motion(again), motion(truths[middle]), rtol=0, atol=1e-14)
    frame = list(recording.messages(FRAME))[middle]
    shipped = cv2.imdecode(np.frombuffer(frame.data, np.uint8), cv2.IMREAD_COLOR_RGB)
    assert shipped.shape == (720, 1280, 3)
    rendered = script.picture(truths[middle].t_capture_ns)
    assert cv2.norm(cv2.blur(shipped, (5, 5)), cv2.blur(rendered, (5, 5)), cv2.NORM_L1) / shipped.size < 0.5


def test_approaches_from_1_5_m_to_6_cm_without_a_jump(recording: Recording) -> None:
    mission = recording.mission
    T_cam_chaser = inverse(mission.camera.T_chaser_cam.matrix())
    T_target_marker = mission.markers[0].T_target_marker.matrix()
    truths = list(recording.messages(TRUTH))
    poses = [T_cam_chaser @ pose_matrix(truth.T_chaser_target) @ T_target_marker for truth in truths]
    ranges_m = np.array([T_cam_marker[2, 3] for T_cam_marker in poses])
    assert ranges_m[0] == pytest.approx(1.5, abs=1e-3)
    assert ranges_m[-1] == pytest.approx(0.06, abs=1e-3)
    assert (np.diff(ranges_m) < 0).all()
    steps = np.array([difference(after, before) for before, after in pairwise(poses)])
    assert np.abs(np.diff(steps, axis=0)).max() < 1e-3
