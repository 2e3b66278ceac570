"""The update and the smoother against filterpy's, where the corners are so near that both are linear."""

from __future__ import annotations

import numpy as np
from filterpy.kalman import KalmanFilter, rts_smoother

from astratag.transforms import inverse
from pipeline.convert import pose_matrix, pose_message, vector_message
from pipeline.corner_filter import CornerFilter
from pipeline.corners import Eye, SeenLayer, corner_noise, predicted_corners
from pipeline.dynamics import STATES, Motion, process_noise
from pipeline.mission import FilterSection
from pipeline.pose_filter import corners_on_target
from pipeline.smoother import FullFilter, smooth
from schemas import Mode, RelativeState
from tests.approach import CAMERA, MARKER, T0_NS, approach, mission, truth

SIGMA_PX = 1e-3
"""So little noise that corners follow the pose linearly, to what is compared."""
KNOWN = FilterSection(
    corner_floor_px=1e-4,
    edge_bias_px=0.0,
    one_edge_bias_px=0.0,
    edge_turn_px=0.0,
    picture_shift_px=0.0,
    image_shift_px=0.01,
    acceleration_m_s2=1e-5,
    angular_acceleration_rad_s2=1e-5,
)
MISSION = mission(filter=KNOWN)
EYE = Eye(CAMERA, inverse(MISSION.camera.T_chaser_cam.matrix()))
REAL = Motion.at_rest(truth(MISSION, approach(3).at(20.0)).T_a_b)
SPREAD = np.diag(np.repeat([1e-5, 1e-5, 1e-4, 1e-4, 1e-5, 1e-5, 1e-4, 1e-2], [3, 3, 3, 3, 3, 3, 1, 2]) ** 2)
"""A covariance to start from, in the filter's order: m, rad, m/s, rad/s, m/s2, rad/s2, share, px."""

SETTLED = 8
"""Frames from the start until a covariance can be inverted as it stands, which filterpy does."""


def seen(rng: np.random.Generator) -> list[SeenLayer]:
    """Return all three layers of a marker that stands still, with noise."""
    layers = []
    for layer in range(3):
        blank = SeenLayer(MARKER, layer, np.zeros((4, 2)), SIGMA_PX, corners_on_target(MISSION.markers[0], layer))
        found = predicted_corners(REAL, [blank], EYE)
        assert found is not None
        corners_px = found[0].reshape(4, 2) + SIGMA_PX * rng.standard_normal((4, 2))
        layers.append(SeenLayer(MARKER, layer, corners_px, SIGMA_PX, blank.points_target))
    return layers


def test_an_update_is_filterpys():
    """The error state and its covariance, at a prior whose corners are a few sigma off."""
    rng = np.random.default_rng(0)
    layers = seen(rng)
    prior = REAL.moved(np.linalg.cholesky(SPREAD) @ rng.standard_normal(STATES))
    ours, theirs = FullFilter(prior, SPREAD, KNOWN), KalmanFilter(dim_x=STATES, dim_z=24)
    predicted = predicted_corners(prior, layers, EYE)
    assert predicted is not None
    theirs.P, theirs.H, theirs.R = SPREAD.copy(), predicted[1], corner_noise(layers, KNOWN)
    measured = np.concatenate([layer.corners_px.ravel() for layer in layers])
    theirs.update((measured - predicted[0])[:, None])
    update = ours.update(layers, EYE)
    assert update is not None
    sigma = np.sqrt(np.diag(theirs.P))
    np.testing.assert_allclose(prior.error_of(ours.motion) / sigma, theirs.x[:, 0] / sigma, atol=0.01)
    np.testing.assert_allclose(ours.covariance / np.outer(sigma, sigma), theirs.P / np.outer(sigma, sigma), atol=0.01)
    np.testing.assert_allclose(update.nis, theirs.mahalanobis**2, rtol=0.01)


def test_the_smoother_is_filterpys():
    """Every state but the first few, as errors from the true motion."""
    rng, dt_s, T = np.random.default_rng(1), 0.05, REAL.pose_chaser_target()
    frames = [(state_at(k * dt_s), seen(rng)) for k in range(20)]
    forward = FullFilter.start(T, float(np.linalg.norm((EYE.T_cam_chaser @ T)[:3, 3])), KNOWN)
    xs, Ps, Fs = [], [], []
    for k, (_, layers) in enumerate(frames):
        Fs.append(forward.motion.transition(dt_s, KNOWN))
        if k > 0:
            forward.predict(dt_s)
        assert forward.update(layers, EYE) is not None
        xs.append(REAL.error_of(forward.motion))
        Ps.append(forward.covariance)
    Qs = [process_noise(dt_s, KNOWN)] * (len(frames) - SETTLED)
    expected, P_expected, _, _ = rts_smoother(np.array(xs[SETTLED:]), np.array(Ps[SETTLED:]), Fs[SETTLED:], Qs)
    smoothed = list(smooth(frames, EYE, MISSION))[::-1][SETTLED:]
    assert len(smoothed) == len(expected) == len(frames) - SETTLED
    for state, x, P in zip(smoothed, expected, P_expected, strict=True):
        told = CornerFilter(REAL.moved(x), P, KNOWN).message_covariance()
        assert state.T_chaser_target is not None and state.covariance is not None
        off = REAL.moved(x).error_of(Motion.at_rest(pose_matrix(state.T_chaser_target)))[:6]
        sigma = np.sqrt(np.diag(told))
        np.testing.assert_allclose(off / np.sqrt(np.diag(P))[:6], 0.0, atol=0.02)
        ours = np.array(state.covariance).reshape(12, 12)
        np.testing.assert_allclose(ours / np.outer(sigma, sigma), told / np.outer(sigma, sigma), atol=0.02)


def state_at(t_s: float) -> RelativeState:
    """Return what a filter told of the marker that stands still, with the covariance to start from."""
    start = CornerFilter(REAL, SPREAD, KNOWN)
    zero = vector_message(np.zeros(3))
    return RelativeState(
        t_capture_ns=T0_NS + round(t_s * 1e9),
        mode=Mode.TRACK,
        T_chaser_target=pose_message(REAL.pose_chaser_target()),
        v_chaser_target_m_s=zero,
        omega_chaser_target_in_target_rad_s=zero,
        covariance=start.message_covariance().ravel().tolist(),
        age_s=0.0,
    )
