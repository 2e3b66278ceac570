"""The benchmark on pictures: noise and bound are right on simulated corners, and the scenes show their markers."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from astratag.transforms import inverse
from benchmarks.corridors.bound import CornerNoise, Frame, corner_residuals, measured_noise, posterior_bound
from benchmarks.corridors.scenes import CAMERA as SCENE_CAMERA
from benchmarks.corridors.scenes import RENDERED, Corridor, picture_at, scene_of
from pipeline.convert import calibration_message, pose_matrix, pose_message, vector_message
from pipeline.corners import Eye, SeenLayer, predicted_corners
from pipeline.detector import DetectorStep, decode_gray
from pipeline.dynamics import Motion
from pipeline.expected import is_false
from pipeline.pose_filter import corners_on_target
from schemas import Truth
from tests.bundles import CAMERA, MISSION, looking, seen_from
from tests.test_detector_step import frame as frame_message

SEED = 20260712
SIGMA_PX = 0.1


def frames(count: int) -> list[Frame]:
    """Return frames of a still target with white corner noise."""
    rng, T_cam_target = np.random.default_rng(SEED), looking(0.2, 0.1, 0.9)
    still = vector_message(np.zeros(3))
    found = []
    for k in range(count):
        message = seen_from(T_cam_target, MISSION, sigma_px=SIGMA_PX, rng=rng, t_s=k / 15)
        T_chaser_target = pose_message(MISSION.camera.T_chaser_cam.matrix() @ T_cam_target)
        truth = Truth(
            t_capture_ns=message.t_capture_ns,
            T_chaser_target=T_chaser_target,
            v_chaser_target_m_s=still,
            omega_chaser_target_in_target_rad_s=still,
        )
        found.append(Frame(k / 15, message, truth, 0))
    return found


def test_white_noise_is_measured_as_what_it_is():
    noise = measured_noise(corner_residuals(frames(100), MISSION, CAMERA))
    assert {key[0] for key in noise} == {3, 7, 11, 15}
    for measured in noise.values():
        assert measured.samples == 100
        assert measured.rms_px == pytest.approx(SIGMA_PX, rel=0.15)
        assert abs(measured.correlation) < 0.15


@pytest.mark.parametrize("r", [0.3, 0.7])
def test_correlated_noise_counts_as_its_mean_does(r: float):
    """Noise that keeps a share r from frame to frame: its mean varies as that of the white noise it counts as."""
    rng, count, draws = np.random.default_rng(SEED), 200, 400
    steps = rng.standard_normal((draws, count, 4, 2)) * np.sqrt(1 - r**2)
    series = np.empty_like(steps)
    series[:, 0] = steps[:, 0] / np.sqrt(1 - r**2)
    for k in range(1, count):
        series[:, k] = r * series[:, k - 1] + steps[:, k]
    noise = measured_noise({(0, 0, 0): list(enumerate(series[0]))})[0, 0, 0]
    assert noise.correlation == pytest.approx(r, abs=0.1)
    exact = CornerNoise(1.0, r, count).variance_px2(correlated=True)
    assert series.mean(axis=1).var() * count == pytest.approx(exact, rel=0.1)


def test_the_bound_at_the_first_frame_is_that_of_its_corners():
    """Against the filter's own Jacobian: at one frame, with next to no prior, the bound is the inverse information."""
    (first,) = frames(1)
    noise = dict.fromkeys(corner_residuals([first], MISSION, CAMERA), CornerNoise(SIGMA_PX, 0.0, 1))
    bound = posterior_bound([first], MISSION, CAMERA, noise, correlated=False)[0]
    eye = Eye(CAMERA, inverse(MISSION.camera.T_chaser_cam.matrix()))
    motion = Motion.at_rest(pose_matrix(first.truth.T_chaser_target))
    layers = [
        SeenLayer(marker.id, layer, np.zeros((4, 2)), SIGMA_PX, corners_on_target(marker, layer))
        for marker in MISSION.markers
        for layer in [k for m, k, _ in noise if m == marker.id]
    ]
    predicted = predicted_corners(motion, layers, eye)
    assert predicted is not None
    H = predicted[1][:, :6]
    np.testing.assert_allclose(bound[:6, :6], np.linalg.inv(H.T @ H / SIGMA_PX**2), rtol=2e-3, atol=1e-12)


def test_the_bound_shrinks_with_time_and_grows_with_correlation():
    seen = frames(40)
    noise = dict.fromkeys(corner_residuals(seen, MISSION, CAMERA), CornerNoise(SIGMA_PX, 0.5, 40))
    white, correlated = (posterior_bound(seen, MISSION, CAMERA, noise, correlated=c) for c in (False, True))
    sigma = [np.sqrt(np.trace(P[:3, :3])) for P in white]
    assert sigma[-1] < 0.8 * sigma[0]
    assert all(np.linalg.eigvalsh(b - a).min() > -1e-12 for a, b in zip(white, correlated, strict=True))


@pytest.mark.slow
@pytest.mark.parametrize("corridor", RENDERED, ids=lambda corridor: corridor.name)
def test_the_rendered_markers_are_where_truth_has_them(corridor: Corridor):
    """In the middle of the approach every marker is found, to 0.1 px on average."""
    t_s = 0.6 * corridor.approach.duration_s
    picture = decode_gray(picture_at(corridor, scene_of(corridor), t_s))
    step = DetectorStep(corridor.mission)
    step.step(calibration_message(SCENE_CAMERA, frame_id="nav", t_capture_ns=0))
    found, _ = step.step(frame_message(cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR)))
    T_cam_target = corridor.approach.at(t_s).T_a_b @ inverse(corridor.mission.markers[0].T_target_marker.matrix())
    T_chaser_target = corridor.mission.camera.T_chaser_cam.matrix() @ T_cam_target
    assert {seen.marker_id for seen in found.detections} == {marker.id for marker in corridor.mission.markers}
    assert not any(is_false(seen, T_chaser_target, corridor.mission, SCENE_CAMERA) for seen in found.detections)
    still = vector_message(np.zeros(3))
    truth = Truth(
        t_capture_ns=0,
        T_chaser_target=pose_message(T_chaser_target),
        v_chaser_target_m_s=still,
        omega_chaser_target_in_target_rad_s=still,
    )
    residuals = corner_residuals([Frame(0.0, found, truth, 0)], corridor.mission, SCENE_CAMERA)
    assert np.sqrt(np.mean([off**2 for samples in residuals.values() for _, off in samples])) < 0.1
