"""Monte Carlo: the filter's covariance is that of its errors (NEES, NIS), and its accuracy is at the bound."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from astratag.transforms import difference, inverse, perturb
from pipeline.convert import pose_matrix, vector_array
from pipeline.corner_filter import CornerFilter
from pipeline.corners import Eye, SeenLayer, corner_noise, predicted_corners
from pipeline.dynamics import ACCELERATION, ANGULAR_ACCELERATION, RATE, STATES, VELOCITY, Motion, process_noise
from pipeline.hypotheses import HypothesisBank
from pipeline.lasting import PER_LAYER, covariance_px2, decay
from pipeline.mission import FilterSection, FlatSection
from pipeline.pose_filter import PoseFilter, corners_on_target
from schemas import Mode, RelativeState
from tests.approach import CALIBRATION, CAMERA, CYLINDER, approach, detection, detections, mission, truth

HZ = 15.0
CONFIDENCE = 0.999


def error_of(state: RelativeState, T, v, omega) -> np.ndarray:
    """Return the error (12,) in the convention of the message's covariance."""
    return np.concatenate(
        [
            difference(T, pose_matrix(state.T_chaser_target)),
            v - vector_array(state.v_chaser_target_m_s),
            omega - vector_array(state.omega_chaser_target_in_target_rad_s),
        ]
    )


def nees(error: np.ndarray, state: RelativeState) -> float:
    P = np.array(state.covariance).reshape(12, 12)[: len(error), : len(error)]
    return float(error @ np.linalg.solve(P, error))


def band(dof: int, runs: int) -> tuple[float, float]:
    """Return the limits of a mean of ``runs`` chi-square variables, per degree of freedom."""
    tail = (1 - CONFIDENCE) / 2
    return chi2.ppf(tail, dof * runs) / (dof * runs), chi2.ppf(1 - tail, dof * runs) / (dof * runs)


def pushed(noise: FilterSection, rng: np.random.Generator) -> np.ndarray:
    """Return the error state (21,) of accelerations as they are at any time."""
    error = np.zeros(STATES)
    error[ACCELERATION] = noise.acceleration_m_s2 * rng.standard_normal(3)
    error[ANGULAR_ACCELERATION] = noise.angular_acceleration_rad_s2 * rng.standard_normal(3)
    return error


def lasting_drawn(noise: FilterSection, rng: np.random.Generator) -> dict[int, np.ndarray]:
    """Return lasting errors (9,) by layer as they are at any time."""
    root = np.linalg.cholesky(covariance_px2(3, noise))
    return dict(enumerate((root @ rng.standard_normal(len(root))).reshape(3, PER_LAYER)))


def lasting_later(px: dict[int, np.ndarray], dt_s: float, noise: FilterSection, rng: np.random.Generator):
    """Return lasting errors (9,) by layer ``dt_s`` later."""
    left, fresh = decay(dt_s, noise), lasting_drawn(noise, rng)
    return {layer: left * before + np.sqrt(1 - left**2) * fresh[layer] for layer, before in px.items()}


def test_consistent_with_its_own_model():
    """Motion, lasting errors and corners drawn from what the filter assumes: NEES and NIS inside their 99.9 % bands."""
    runs, frames, sigma_px, dt_s = 40, 30, 0.1, 1 / HZ
    mission_ = mission()
    noise = mission_.filter
    Q = process_noise(dt_s, noise)
    at_the_end, innovations = [], []
    for seed in range(runs):
        rng = np.random.default_rng(seed)
        T = truth(mission_, approach(seed, tilt_rad=(0.2, -0.3, 0.1)).at(12.0)).T_a_b
        first = pushed(noise, rng)
        first[VELOCITY] = noise.initial_speed_m_s * rng.standard_normal(3) / 20
        first[RATE] = noise.initial_rate_rad_s * rng.standard_normal(3) / 20
        real = Motion.at_rest(T).moved(first)
        lasting_px = lasting_drawn(noise, rng)
        pose_filter = PoseFilter(mission_)
        pose_filter.step(CALIBRATION)
        for k in range(frames):
            T = real.pose_chaser_target()
            seen = detection(mission_, T, sigma_px=sigma_px, rng=rng, lasting_px=lasting_px)
            state = next(iter(pose_filter.step(detections(k * dt_s, seen))))
            if k > frames // 2 and state.nis_dof:
                innovations.append((state.nis, state.nis_dof))
            last, lasting_px = real, lasting_later(lasting_px, dt_s, noise, rng)
            real = real.after(dt_s, noise).moved(rng.multivariate_normal(np.zeros(STATES), Q))
        error = error_of(
            state, last.pose_chaser_target(), last.v_chaser_target_m_s, last.omega_chaser_target_in_target_rad_s
        )
        at_the_end.append(nees(error, state) / 12)
    low, high = band(12, runs)
    assert low < np.mean(at_the_end) < high
    nis, dof = np.sum(innovations, axis=0)
    low, high = chi2.ppf([0.0005, 0.9995], dof) / dof
    assert low < nis / dof < high


@pytest.mark.parametrize("surface", [CYLINDER, FlatSection()], ids=["cylinder", "flat"])
@pytest.mark.parametrize("sigma_px", [0.03, 0.15])
@pytest.mark.parametrize("bias_px", [0.0, 0.05])
def test_consistent_on_slow_approaches(surface, sigma_px, bias_px):
    """Smooth approaches of another kind than the model's noise: NEES per degree of freedom between 0.5 and 2.

    An edge bias that NIS would hardly show (0.05 px: 1 mm of range at 1.2 m) is estimated with the motion.
    """
    mission_ = mission(surface, filter=FilterSection(edge_bias_px=0.03))
    found, of_pose = [], []
    for seed in range(2):
        rng, motion = np.random.default_rng(seed), approach(seed)
        pose_filter = PoseFilter(mission_)
        pose_filter.step(CALIBRATION)
        for k in range(int(motion.duration_s * 8)):
            real = truth(mission_, motion.at(k / 8))
            seen = detection(mission_, real.T_a_b, sigma_px=sigma_px, rng=rng, bias_px=bias_px)
            state = next(iter(pose_filter.step(detections(k / 8, seen))))
            error = error_of(state, real.T_a_b, real.v_a_b_m_s, real.omega_a_b_in_b_rad_s)
            found.append(nees(error, state) / 12)
            of_pose.append(nees(error[:6], state) / 6)
            assert state.mode == Mode.TRACK
    assert 0.5 < np.mean(found) < 2
    assert 0.5 < np.mean(of_pose) < 2


def test_accuracy_at_the_bound():
    """Pose RMS within 25 % (5 % with 300 runs) of the posterior Cramer-Rao bound, run along the truth.

    Source: P. Tichavsky, C. Muravchik, A. Nehorai, "Posterior Cramer-Rao bounds for discrete-time nonlinear
    filtering", 1998, which for a linear model with Gaussian noise is the Riccati recursion at the truth.
    """
    runs, frames, sigma_px, dt_s = 60, 30, 0.1, 1 / HZ
    mission_ = mission()
    noise = mission_.filter.model_copy(update={"edge_bias_px": 0.0, "one_edge_bias_px": 0.0, "edge_turn_px": 0.0})
    eye = Eye(CAMERA, inverse(mission_.camera.T_chaser_cam.matrix()))
    points = [corners_on_target(mission_.markers[0], layer) for layer in (0, 1, 2)]
    T = truth(mission_, approach(0, tilt_rad=(0.2, -0.3, 0.1)).at(12.0)).T_a_b
    rest = Motion.at_rest(T)

    def layers_at(motion, rng=None):
        corners = predicted_corners(motion, [SeenLayer(0, 0, np.zeros((4, 2)), 1.0, p) for p in points], eye)[0]
        exact = [
            SeenLayer(0, k, c.reshape(4, 2), sigma_px, p)
            for k, (c, p) in enumerate(zip(corners.reshape(3, 8), points, strict=True))
        ]
        if rng is None:
            return exact
        off_px = np.linalg.cholesky(corner_noise(exact, noise)) @ rng.standard_normal(len(corners))
        return [
            replace(layer, corners_px=layer.corners_px + off)
            for layer, off in zip(exact, off_px.reshape(3, 4, 2), strict=True)
        ]

    bound = CornerFilter.start(T, 1.0, noise)
    for k in range(frames):
        if k:
            bound.predict(dt_s)
        bound.update(layers_at(rest), eye)
    limit = np.sqrt(np.diag(bound.message_covariance()))[:6]

    errors = []
    Q = process_noise(dt_s, noise)
    for seed in range(runs):
        rng = np.random.default_rng(seed)
        real = rest.moved(pushed(noise, rng))
        bank = HypothesisBank.start([T], layers_at(real, rng), eye, noise)
        for _ in range(frames - 1):
            real = real.after(dt_s, noise).moved(rng.multivariate_normal(np.zeros(STATES), Q))
            bank.predict(dt_s)
            bank.update(layers_at(real, rng), eye)
        errors.append(difference(real.pose_chaser_target(), bank.best.motion.pose_chaser_target()))
    rms = np.sqrt(np.mean(np.square(errors), axis=0))
    assert rms[:3] @ rms[:3] < 1.25**2 * limit[:3] @ limit[:3]
    assert rms[3:] @ rms[3:] < 1.25**2 * limit[3:] @ limit[3:]


def test_covariance_is_in_the_messages_convention():
    """Poses drawn from a message's covariance with ``perturb`` have corners that scatter as the filter says."""
    mission_ = mission()
    T = truth(mission_, approach(3).at(6.0)).T_a_b
    errors = []
    for seed in range(150):
        pose_filter = PoseFilter(mission_)
        pose_filter.step(CALIBRATION)
        rng = np.random.default_rng(seed)
        lasting_px = lasting_drawn(mission_.filter, rng)
        for k in range(4):  # so close in time that nothing moves, and that the first look counts little
            seen = detection(mission_, T, sigma_px=0.1, rng=rng, lasting_px=lasting_px)
            state = next(iter(pose_filter.step(detections(k * 1e-6, seen))))
        errors.append(difference(T, pose_matrix(state.T_chaser_target)))
    scatter = np.cov(np.array(errors).T)
    P = np.array(state.covariance).reshape(12, 12)[:6, :6]
    whitened = np.linalg.solve(np.linalg.cholesky(P), np.array(errors).T)
    low, high = band(6, len(errors))
    assert low < np.mean(whitened**2) < high
    # each axis by itself, so that swapped axes or frames cannot hide in the sum
    ratios = np.diag(scatter) / np.diag(P)
    low, high = chi2.ppf([0.0001, 0.9999], len(errors) - 1) / (len(errors) - 1)
    assert (low < ratios).all() and (ratios < high).all()
    moved = perturb(T, errors[0])
    assert difference(moved, T) == pytest.approx(errors[0])
