"""The benchmark on pictures: noise and bound are right on simulated corners, and the scenes show their markers."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from astratag.transforms import inverse
from benchmarks.corridors.__main__ import with_longer_focus
from benchmarks.corridors.bound import (
    GROWN,
    MODES,
    CornerNoise,
    Frame,
    Noise,
    measured_noise,
    mode_residuals,
    modes_of,
    posterior_bound,
)
from benchmarks.corridors.scenes import CAMERA as SCENE_CAMERA
from benchmarks.corridors.scenes import RENDERED, Corridor, picture_at, scene_of
from pipeline.convert import (
    calibration_message,
    camera_from_calibration,
    pose_matrix,
    pose_message,
    vector_message,
)
from pipeline.corners import Eye, SeenLayer, outward_shift, predicted_corners
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


def plain(keys, correlation: float = 0.0, kept: float = 0.0) -> Noise:
    """Return noise that is alike in all coordinates, of which part may last."""
    noise = CornerNoise(np.full(MODES, SIGMA_PX), np.full(MODES, correlation), 100)
    return Noise(dict.fromkeys(keys, noise), np.full(MODES, kept))


def test_white_noise_is_measured_as_what_it_is():
    noise = measured_noise(mode_residuals(frames(100), MISSION, CAMERA))
    assert {key[0] for key in noise.layers} == {3, 7, 11, 15}
    for measured in noise.layers.values():
        assert measured.samples == 100
        assert measured.rms_px == pytest.approx(SIGMA_PX, rel=0.15)
        assert abs(measured.correlation) < 0.15
    assert all(abs(alike) < 0.05 for alike in noise.alike.values())


def test_noise_that_lasts_is_told_from_new_noise():
    """Half of the growth's variance keeps 0.9 from frame to frame, and is the same for two markers' layers."""
    rng, count = np.random.default_rng(SEED), 4000
    steps, lasting = rng.standard_normal(count), np.zeros(count)
    for k in range(1, count):
        lasting[k] = 0.9 * lasting[k - 1] + np.sqrt(1 - 0.9**2) * steps[k]
    modes = rng.standard_normal((2, count, MODES))
    modes[:, :, GROWN] = np.sqrt(0.5) * (lasting + rng.standard_normal((2, count)))
    keys = (1, 0, 0), (2, 0, 0)
    noise = measured_noise({key: list(enumerate(modes[k])) for k, key in enumerate(keys)})
    assert noise.kept[GROWN] == pytest.approx(0.9, abs=0.05)
    assert noise.alike[False] == pytest.approx(0.5, abs=0.05)
    for key in keys:
        share = noise.lasting_share(key)
        assert share[GROWN] == pytest.approx(0.5, abs=0.06)
        assert np.delete(share, GROWN) * np.delete(noise.kept, GROWN) == pytest.approx(0.0, abs=0.06)


def test_modes_are_orthonormal_and_growth_is_outward():
    quad = np.array([[100.0, 50], [180, 60], [170, 140], [90, 130]])
    modes = modes_of(quad)
    assert modes @ modes.T == pytest.approx(np.eye(MODES), abs=1e-12)
    outward = outward_shift(quad[None]).ravel()
    assert abs(modes[GROWN] @ outward) == pytest.approx(np.linalg.norm(outward), rel=1e-3)


def test_the_bound_at_the_first_frame_is_that_of_its_corners():
    """Against the filter's own Jacobian: at one frame, with next to no prior, the bound is the inverse information."""
    (first,) = frames(1)
    noise = plain(mode_residuals([first], MISSION, CAMERA))
    bound = posterior_bound([first], MISSION, CAMERA, noise)[0]
    eye = Eye(CAMERA, inverse(MISSION.camera.T_chaser_cam.matrix()))
    motion = Motion.at_rest(pose_matrix(first.truth.T_chaser_target))
    layers = [
        SeenLayer(marker.id, layer, np.zeros((4, 2)), SIGMA_PX, corners_on_target(marker, layer))
        for marker in MISSION.markers
        for layer in [k for m, k, _ in noise.layers if m == marker.id]
    ]
    predicted = predicted_corners(motion, layers, eye)
    assert predicted is not None
    H = predicted[1][:, :6]
    np.testing.assert_allclose(bound[:6, :6], np.linalg.inv(H.T @ H / SIGMA_PX**2), rtol=2e-3, atol=1e-11)


def test_the_bound_shrinks_with_time_and_grows_with_what_lasts():
    seen = frames(40)
    noise = plain(mode_residuals(seen, MISSION, CAMERA), correlation=0.45, kept=0.9)
    white, lasting = (posterior_bound(seen, MISSION, CAMERA, each) for each in (noise.white(), noise))
    sigma = [np.sqrt(np.trace(P[:3, :3])) for P in white]
    assert sigma[-1] < 0.8 * sigma[0]
    assert np.linalg.eigvalsh(lasting[0] - white[0]).min() > -1e-9  # a single look does not know what lasts
    assert np.trace(lasting[-1][:6, :6]) > 1.5 * np.trace(white[-1][:6, :6])


def test_a_longer_focus_is_the_same_camera_but_for_that():
    exact = calibration_message(SCENE_CAMERA, frame_id="nav", t_capture_ns=0)
    longer = camera_from_calibration(with_longer_focus(exact, 1e-3)).K
    assert longer[[0, 1], [0, 1]] == pytest.approx(1.001 * SCENE_CAMERA.K[[0, 1], [0, 1]])
    assert longer[:2, 2] == pytest.approx(SCENE_CAMERA.K[:2, 2])


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
    residuals = mode_residuals([Frame(0.0, found, truth, 0)], corridor.mission, SCENE_CAMERA)
    assert np.sqrt(np.mean([off**2 for samples in residuals.values() for _, off in samples])) < 0.1
