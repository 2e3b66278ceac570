"""Drift by configuration: against Clohessy-Wiltshire, Euler's equations, and finite differences of itself."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from astratag.transforms import exp_so3
from pipeline.dynamics import STATES, Motion, OwnMotion, lasting_push, process_noise
from pipeline.hill import clohessy_wiltshire
from pipeline.mission import DriftSection, FilterSection
from pipeline.pose_filter import PoseFilter
from schemas import ChaserMotion, RelativeState, Vector3
from tests.approach import CALIBRATION, T0_NS, detection, detections, mission

ORBIT_RAD_S = 0.00113
CW = DriftSection(
    translation="clohessy_wiltshire", orbit_rate_rad_s=ORBIT_RAD_S, R_hill_chaser_wxyz=(0.5, 0.5, -0.5, 0.5)
)
BODY = DriftSection(attitude="rigid_body", target_inertia=(1.0, 2.0, 2.5))


def motion(seed: int) -> Motion:
    rng = np.random.default_rng(seed)
    place, attitude = rng.normal(0, 10, 3), exp_so3(rng.normal(0, 1, 3))
    speed, rate = rng.normal(0, 0.1, 3), rng.normal(0, 0.2, 3)
    return Motion(place, attitude, speed, rate, rng.normal(0, 0.01, 3), rng.normal(0, 0.03, 3))


def own(seed: int) -> OwnMotion:
    rng = np.random.default_rng((seed, 1))
    return OwnMotion(exp_so3(rng.normal(0, 1, 3)), rng.normal(0, 0.01, 3), rng.normal(0, 0.01, 3))


@pytest.mark.parametrize("drift", [CW, BODY, DriftSection()], ids=["orbit", "body", "straight"])
@pytest.mark.parametrize("knows", [False, True])
@settings(deadline=None, max_examples=15)
@given(seed=st.integers(0, 1000), dt_s=st.sampled_from([0.01, 0.1, 0.5]))
def test_transition_against_finite_differences(drift, knows, seed, dt_s):
    noise, start, known = FilterSection(drift=drift), motion(seed), own(seed) if knows else None
    F = start.transition(dt_s, noise, known)
    later = start.after(dt_s, noise, known)
    for k in range(STATES):
        step = np.zeros(STATES)
        step[k] = 1e-5
        ahead, behind = (later.error_of(start.moved(s).after(dt_s, noise, known)) for s in (step, -step))
        tolerance = 3e-2 * dt_s**2 if drift is BODY else 1e-6  # those of a turning body are to first order
        assert F[:, k] == pytest.approx((ahead - behind) / 2e-5, abs=tolerance), k


@given(seed=st.integers(0, 1000))
def test_an_orbit_against_clohessy_wiltshire(seed):
    """The chaser's place about the target in the Hill frame moves as theirs does, thrust included."""
    start, known = motion(seed), own(seed)
    R, w = known.R_hill_chaser, known.omega_hill_chaser_in_chaser_rad_s
    hill = -np.r_[R @ start.p_chaser_target_m, R @ (start.v_chaser_target_m_s + np.cross(w, start.p_chaser_target_m))]
    Phi, Gamma = clohessy_wiltshire(ORBIT_RAD_S, 30.0)
    expected = Phi @ hill + Gamma @ R @ known.acceleration_chaser_m_s2
    start = replace(start, a_chaser_target_m_s2=np.zeros(3))
    later = start.after(30.0, FilterSection(drift=CW), known)
    R_later = R @ exp_so3(30.0 * w)
    assert -R_later @ later.p_chaser_target_m == pytest.approx(expected[:3])
    v_later = later.v_chaser_target_m_s + np.cross(w, later.p_chaser_target_m)
    assert -R_later @ v_later == pytest.approx(expected[3:])


def test_a_free_body_against_eulers_equations():
    start, J = motion(3), np.array(BODY.target_inertia)
    exact = solve_ivp(
        lambda _, w: -np.cross(w, J * w) / J, (0, 10), start.omega_chaser_target_in_target_rad_s, rtol=1e-10
    ).y[:, -1]
    moved = replace(start, alpha_in_target_rad_s2=np.zeros(3))
    for _ in range(200):
        moved = moved.after(0.05, FilterSection(drift=BODY))
    assert moved.omega_chaser_target_in_target_rad_s == pytest.approx(exact, abs=1e-4)


@example(dt_s=10.0, correlation_s=5.0)
@given(dt_s=st.floats(-5, 1).map(lambda power: 10.0**power), correlation_s=st.sampled_from([0.1, 1.0, 5.0]))
def test_accelerations_against_their_differential_equation(dt_s, correlation_s):
    """Transition and noise of place, speed and acceleration are those of an exponentially correlated acceleration."""
    dt_s = dt_s * correlation_s
    noise = FilterSection(acceleration_m_s2=0.7, correlation_s=correlation_s)
    A = np.array([[0, 1, 0], [0, 0, 1], [0, 0, -1 / correlation_s]])
    G = np.diag([0, 0, 2 * 0.7**2 / correlation_s])
    both = expm(np.block([[-A, G], [np.zeros((3, 3)), A.T]]) * dt_s)  # van Loan, 1978
    Phi = expm(A * dt_s)  # more exact than in the whole, where what fades is beside what grows
    left, speed_s, way_s2 = lasting_push(dt_s, correlation_s)
    assert [way_s2, speed_s, left] == pytest.approx(Phi[:, 2].tolist(), rel=1e-8)
    expected, found = Phi @ both[:3, 3:], process_noise(dt_s, noise)[np.ix_([0, 6, 12], [0, 6, 12])]
    scale = np.sqrt(np.outer(np.diag(found), np.diag(found)))
    assert found / scale == pytest.approx(expected / scale, abs=1e-4)


def test_a_known_burn_is_followed_without_measurements():
    """The chaser says that it accelerates while nothing is seen: the propagated place is where the target then is."""
    mission_ = mission()
    pose_filter = PoseFilter(mission_)
    pose_filter.step(CALIBRATION)
    rest = np.eye(4)
    rest[:3, :3] = mission_.camera.T_chaser_cam.matrix()[:3, :3] @ np.diag([1.0, -1, -1])
    rest[:3, 3] = mission_.camera.T_chaser_cam.matrix()[:3, :3] @ [0, 0, 1.2]
    for k in range(40):
        pose_filter.step(detections(k / 20, detection(mission_, rest, sigma_px=0.1)))
    burn = ChaserMotion(
        t_capture_ns=T0_NS + 2_000_000_000,
        omega_hill_chaser_in_chaser_rad_s=Vector3(x=0, y=0, z=0),
        acceleration_chaser_m_s2=Vector3(x=0.02, y=0, z=0),
    )
    assert list(pose_filter.step(burn)) == []
    state = next(iter(pose_filter.tick(T0_NS + 4_000_000_000)))
    assert isinstance(state, RelativeState) and state.T_chaser_target is not None
    moved_m = state.T_chaser_target.translation_m.x - rest[0, 3]
    assert moved_m == pytest.approx(-0.02 * 2**2 / 2, abs=2e-3)
