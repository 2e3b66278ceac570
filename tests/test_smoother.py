"""Smoothing: exact on exact corners, more exact than filtering, honest, and a recording like any other."""

import numpy as np

from astratag.transforms import difference, inverse
from pipeline.bound import posterior_bounds
from pipeline.convert import points_array, pose_matrix
from pipeline.corners import Eye, SeenLayer
from pipeline.dynamics import Motion
from pipeline.pose_filter import PoseFilter, corners_on_target
from pipeline.smoother import smooth
from schemas import RelativeState
from tests.approach import CALIBRATION, CAMERA, T0_NS, approach, detection, detections, mission, truth

HZ = 15.0
MISSION = mission()
EYE = Eye(CAMERA, inverse(MISSION.camera.T_chaser_cam.matrix()))


def filtered(seed: int, seconds: float = 6.0) -> list[tuple[RelativeState, list[SeenLayer]]]:
    rng, motion = np.random.default_rng(seed), approach(seed)
    pose_filter, frames = PoseFilter(MISSION), []
    pose_filter.step(CALIBRATION)
    for t_s in np.arange(round(seconds * HZ)) / HZ:
        seen = detection(MISSION, truth(MISSION, motion.at(t_s)).T_a_b, sigma_px=0.15, rng=rng)
        assert seen is not None
        state = next(iter(pose_filter.step(detections(t_s, seen))))
        assert isinstance(state, RelativeState)
        marker = MISSION.markers[0]
        layers = [
            SeenLayer(
                marker.id, one.layer, points_array(one.corners_px), one.sigma_px, corners_on_target(marker, one.layer)
            )
            for one in seen.layers
            if one.layer in state.layers
        ]
        frames.append((state, layers))
    return frames


def errors(states: list[RelativeState], seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return pose errors (N, 6) and their NEES per degree of freedom (N,)."""
    off, nees = [], []
    for state in states:
        T = truth(MISSION, approach(seed).at((state.t_capture_ns - T0_NS) * 1e-9)).T_a_b
        error, P = difference(T, pose_matrix(state.T_chaser_target)), np.array(state.covariance).reshape(12, 12)[:6, :6]
        off.append(error)
        nees.append(error @ np.linalg.solve(P, error) / 6)
    return np.array(off), np.array(nees)


def test_smoothed_states_are_more_exact_and_honest():
    """Position and attitude RMS fall, most in the beginning; the last state, which has no later ones, stays."""
    before, after, nees = [], [], []
    for seed in range(3):
        frames = filtered(seed)
        smoothed = list(smooth(frames, EYE, MISSION))[::-1]
        assert [s.t_capture_ns for s in smoothed] == [state.t_capture_ns for state, _ in frames]
        before.append(errors([state for state, _ in frames], seed)[0])
        off, normalised = errors(smoothed, seed)
        after.append(off)
        nees.append(normalised)
    rms = [np.sqrt(np.mean(np.square(off), axis=(0, 1))) for off in (before, after)]
    assert np.linalg.norm(rms[1][:3]) < 0.8 * np.linalg.norm(rms[0][:3])
    assert np.linalg.norm(rms[1][3:]) < 0.6 * np.linalg.norm(rms[0][3:])
    assert 0.3 < np.mean(nees) < 2


def test_the_bound_shrinks_with_every_look_and_not_without():
    """More looks, more layers or sharper corners never make the bound wider; time without looks does."""
    marker, T = MISSION.markers[0], truth(MISSION, approach(1).at(5.0)).T_a_b
    rest = Motion.at_rest(T)

    def bounds(layers: tuple[int, ...], sigma_px: float, looks: int = 20) -> list[float]:
        seen = [SeenLayer(marker.id, k, np.zeros((4, 2)), sigma_px, corners_on_target(marker, k)) for k in layers]
        frames = [(round(k * 1e8), rest, seen if k < looks else []) for k in range(20)]
        return [float(np.trace(P[:3, :3])) for P in posterior_bounds(frames, EYE, MISSION.filter)]

    usual = bounds((0, 1), 0.1)
    assert usual == sorted(usual, reverse=True)
    assert bounds((0, 1, 2), 0.1)[-1] < usual[-1] < bounds((0, 1), 0.2)[-1]
    dark = bounds((0, 1), 0.1, looks=10)
    assert dark[9:] == sorted(dark[9:])
