"""Dead reckoning in the Hill frame: the orbit against two-body motion, thrust known, measurements weighed."""

import numpy as np
from scipy.integrate import solve_ivp

from astratag.transforms import exp_so3, log_so3
from pipeline.convert import NS_PER_S
from pipeline.hill import RelativeOrbit, TargetAttitude, clohessy_wiltshire

RATE_RAD_S = 1.13e-3
MU, RADIUS_M = 3.986004418e14, 6.778e6


def orbit(x: np.ndarray, sigma: float = 1e-3) -> RelativeOrbit:
    return RelativeOrbit(
        x, sigma**2 * np.eye(6), 0, rate_rad_s=RATE_RAD_S, inflation=1.0, disturbance_m_s2=1e-6, thrust_error_share=0.0
    )


def test_against_two_body_motion():
    """Over 500 s and 20 m the linear solution is that of Kepler's force to a millimetre."""
    n = np.sqrt(MU / RADIUS_M**3)
    x0 = np.array([1.0, 20.0, 2.0, 0.01, -0.02, 0.005])

    def motion(_t: float, x: np.ndarray) -> np.ndarray:
        r = x[:3] + [RADIUS_M, 0, 0]
        pull = -MU * r / np.linalg.norm(r) ** 3 + n**2 * r * [1, 1, 0] + 2 * n * np.array([x[4], -x[3], 0])
        return np.concatenate([x[3:], pull])

    exact = solve_ivp(motion, (0, 500), x0, rtol=1e-11, atol=1e-9).y[:, -1]
    np.testing.assert_allclose(clohessy_wiltshire(n, 500.0)[0] @ x0, exact, atol=1e-3)


def test_steps_compose():
    one, other, both = (clohessy_wiltshire(RATE_RAD_S, dt_s)[0] for dt_s in (0.3, 1.7, 2.0))
    np.testing.assert_allclose(one @ other, both, atol=1e-12)


def test_thrust_is_reckoned_from_when_it_was_commanded():
    """One second at 0.01 m/s^2 from t = 1 s: 5 mm at its end, and 10 mm a second from then on."""
    reckoned = orbit(np.zeros(6))
    reckoned.thrust(1 * NS_PER_S, np.array([0.0, 0.0, 0.01]))
    reckoned.thrust(2 * NS_PER_S, np.zeros(3))
    assert reckoned.at(1 * NS_PER_S)[0][2] == 0
    np.testing.assert_allclose(reckoned.at(4 * NS_PER_S)[0][[2, 5]], [0.025, 0.01], rtol=1e-4)


def test_a_late_measurement_keeps_the_thrust_after_it():
    reckoned = orbit(np.zeros(6), sigma=1.0)
    reckoned.thrust(1 * NS_PER_S, np.array([0.0, 0.0, 0.01]))
    assert reckoned.measure(NS_PER_S // 2, np.array([0.0, 0.0, 0.3]), 1e-12 * np.eye(3))
    x, _ = reckoned.at(2 * NS_PER_S)
    assert x[2] > 0.3 + 0.004


def test_a_measurement_that_contradicts_changes_nothing():
    reckoned = orbit(np.zeros(6))
    before = reckoned.at(NS_PER_S)[0]
    assert not reckoned.measure(NS_PER_S, np.array([0.0, 1.0, 0.0]), 1e-6 * np.eye(3))
    np.testing.assert_array_equal(reckoned.at(NS_PER_S)[0], before)


def test_uncertainty_grows_without_measurements_and_shrinks_with_them():
    reckoned = orbit(np.zeros(6), sigma=0.01)
    blind = [np.trace(reckoned.at(t_s * NS_PER_S)[1]) for t_s in (1, 10, 100)]
    assert blind == sorted(blind)
    for k in range(1, 50):
        reckoned.measure(k * NS_PER_S // 5, np.zeros(3), 1e-6 * np.eye(3))
    assert np.trace(reckoned.at(10 * NS_PER_S)[1]) < blind[0]


def test_attitude_converges_to_what_is_measured_and_refuses_a_flip():
    R_true = exp_so3(np.array([0.02, -0.01, 0.03]))
    target = TargetAttitude(np.eye(3), 0.05, 0, inflation=10.0, drift_rad_sqrt_s=0.0)
    for k in range(1, 400):
        assert target.measure(k, R_true, 1e-4 * np.eye(3))
    assert np.linalg.norm(log_so3(R_true.T @ target.R_hill_target)) < 0.002
    assert target.sigma_rad < 0.003
    kept = target.R_hill_target.copy()
    assert not target.measure(400, R_true @ exp_so3(np.array([0.6, 0, 0])), 1e-4 * np.eye(3))
    np.testing.assert_array_equal(target.R_hill_target, kept)
