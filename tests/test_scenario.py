"""An approach's velocities and rates are the derivatives of its poses, wherever the frames are mounted."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from astratag.transforms import exp_so3, inverse, log_so3, pose
from pipeline.convert import pose_matrix, vector_array
from pipeline.scenario import FACING, Approach, frame_stamps_ns, truth_message

MOUNTINGS = [
    (np.eye(4), np.eye(4)),
    (pose(exp_so3([0.4, -1.1, 2.0]), [0.3, -0.1, 0.2]), pose(exp_so3([-2.0, 0.3, 0.5]), [0.1, 0.2, -0.5])),
]
STEP_S = 1e-4


@pytest.mark.parametrize(("T_c_a", "T_b_d"), MOUNTINGS, ids=["unmounted", "mounted"])
@given(t_s=st.floats(0, 27))
def test_rates_are_derivatives(T_c_a: np.ndarray, T_b_d: np.ndarray, t_s: float) -> None:
    before, now, after = (Approach().at(t_s + dt).mounted(T_c_a, T_b_d) for dt in (-STEP_S, 0.0, STEP_S))
    v_m_s = (after.T_a_b[:3, 3] - before.T_a_b[:3, 3]) / (2 * STEP_S)
    omega_rad_s = log_so3(before.T_a_b[:3, :3].T @ after.T_a_b[:3, :3]) / (2 * STEP_S)
    assert np.allclose(now.v_a_b_m_s, v_m_s, atol=1e-8)
    assert np.allclose(now.omega_a_b_in_b_rad_s, omega_rad_s, atol=1e-8)


@given(t_s=st.floats(0, 26.9))
def test_always_closes_and_brakes(t_s: float) -> None:
    now, later = (Approach().at(t) for t in (t_s, t_s + 0.1))
    assert later.T_a_b[2, 3] < now.T_a_b[2, 3]
    assert 0 > later.v_a_b_m_s[2] > now.v_a_b_m_s[2]


def test_starts_and_ends_where_it_says() -> None:
    approach = Approach()
    assert approach.at(0.0).T_a_b[2, 3] == pytest.approx(1.5)
    assert approach.at(27.0).T_a_b[2, 3] == pytest.approx(0.06)
    assert approach.at(27.0).v_a_b_m_s[2] == pytest.approx(-0.012)


def test_without_tumble_the_marker_faces_the_camera() -> None:
    still = Approach(tilt_rad=(0, 0, 0), tumble_rad=(0, 0, 0), sway_rad=(0, 0))
    motion = still.at(10.0)
    assert np.array_equal(motion.T_a_b[:3, :3], FACING)
    assert not motion.omega_a_b_in_b_rad_s.any()
    assert not motion.T_a_b[:2, 3].any()


def test_truth_puts_the_marker_where_the_camera_saw_it() -> None:
    T_chaser_cam, T_target_marker = MOUNTINGS[1]
    motion = Approach().at(3.0)
    truth = truth_message(motion, T_chaser_cam=T_chaser_cam, T_target_marker=T_target_marker, t_capture_ns=5)
    T_cam_marker = inverse(T_chaser_cam) @ pose_matrix(truth.T_chaser_target) @ T_target_marker
    assert np.allclose(T_cam_marker, motion.T_a_b)
    rate = np.linalg.norm(vector_array(truth.omega_chaser_target_in_target_rad_s))
    assert rate == pytest.approx(np.linalg.norm(motion.omega_a_b_in_b_rad_s))


def test_stamps_are_integers_that_do_not_drift() -> None:
    stamps = frame_stamps_ns(1_000, 15.0, 401)
    assert all(isinstance(stamp, int) for stamp in stamps)
    assert stamps[0] == 1_000
    assert stamps[15] - stamps[0] == stamps[30] - stamps[15] == 1_000_000_000
    assert set(np.diff(stamps)) <= {66_666_666, 66_666_667}


def test_refuses_an_approach_that_would_speed_up() -> None:
    with pytest.raises(ValueError, match="must brake"):
        Approach(duration_s=200.0)
