"""Several markers on one target are one state: on several sides, tilted, on a cylinder, coming and going."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from astratag.transforms import difference
from pipeline.convert import pose_matrix
from pipeline.mission import Mission
from pipeline.pose_filter import PoseFilter
from schemas import Mode, RelativeState
from tests.bundles import CALIBRATION, MISSION, looking, seen_from

SEED = 20260712
RATE_HZ = 15.0
SIGMA_PX = 0.15
SETTLED_FRAMES = 30


def swing(k: int) -> np.ndarray:
    """Return T_cam_target while the camera goes slowly round the target, from its front to its side and nearer."""
    s = k / 300
    return looking(-0.35 + 1.95 * s, 0.12 * np.sin(4 * s), 0.95 - 0.25 * s)


def fly(mission: Mission, poses: list[np.ndarray], only: dict[int, set[int]] | None = None):
    """Return the states of a flight, and the sets of markers seen; ``only`` limits what is seen from a frame on."""
    pose_filter, rng = PoseFilter(mission), np.random.default_rng(SEED)
    pose_filter.step(CALIBRATION)
    states, seen, limit = [], [], None
    for k, T_cam_target in enumerate(poses):
        limit = (only or {}).get(k, limit)
        message = seen_from(
            T_cam_target, mission, sigma_px=SIGMA_PX, rng=rng, t_s=k / RATE_HZ, only=limit, noise=mission.filter
        )
        states.append(next(iter(pose_filter.step(message))))
        seen.append({found.marker_id for found in message.detections})
    return states, seen


def errors(states: list[RelativeState], poses: list[np.ndarray]) -> np.ndarray:
    """Return what is off (K, 6) of each T_chaser_target."""
    T_chaser_cam = MISSION.camera.T_chaser_cam.matrix()
    return np.array(
        [
            difference(T_chaser_cam @ T_cam_target, pose_matrix(state.T_chaser_target))
            for state, T_cam_target in zip(states, poses, strict=True)
        ]
    )


def test_markers_come_and_go_and_the_state_goes_on():
    """From the front to the side: the first markers leave, one round the corner enters; one state all the way."""
    poses = [swing(k) for k in range(300)]
    states, seen = fly(MISSION, poses)
    assert {3, 7, 11} <= seen[0] and 15 not in seen[0]
    assert 15 in seen[-1] and 7 not in seen[-1]
    settled = states[SETTLED_FRAMES:]
    assert all(state.mode == Mode.TRACK for state in settled)
    used = [set(state.marker_ids) for state in settled]
    assert max(len(ids) for ids in used) >= 3
    assert sum(bool(state.rejections) for state in settled) < 0.05 * len(settled)
    off = errors(states, poses)[SETTLED_FRAMES:]
    assert np.linalg.norm(off[:, :3], axis=1).max() < 1.5e-3
    assert np.linalg.norm(off[:, 3:], axis=1).max() < np.radians(0.5)


def test_no_jump_when_the_markers_in_view_change():
    """7 alone, then 3 and 11 without it, then 15 alone: each step is within what the covariances before it allow."""
    poses = [looking(0.45 + 0.0005 * k, 0.1, 0.7) for k in range(160)]
    states, _ = fly(MISSION, poses, only={0: {3, 7, 11, 15}, 40: {7}, 80: {3, 11}, 120: {15}})
    off = errors(states, poses)
    for k in (40, 80, 120):
        P = np.array(states[k - 1].covariance).reshape(12, 12)[:6, :6]
        step = off[k] - off[k - 1]
        assert step @ np.linalg.solve(P, step) < chi2.ppf(0.9999, 6)
        assert states[k].mode == Mode.TRACK
    assert [set(states[k].marker_ids) for k in (60, 100, 140)] == [{7}, {3, 11}, {15}]


def test_the_bundle_is_never_less_certain_than_one_of_its_markers():
    poses = [looking(0.45 + 0.0005 * k, 0.1, 0.8) for k in range(60)]

    def sigmas(only: set[int]) -> np.ndarray:
        states, _ = fly(MISSION, poses, only={0: only})
        assert states[-1].mode == Mode.TRACK
        return np.sqrt(np.diag(np.array(states[-1].covariance).reshape(12, 12))[:6])

    together = sigmas({3, 7, 11, 15})
    for marker_id in (3, 7, 11):
        assert (together < 1.02 * sigmas({marker_id})).all()


def test_the_bundles_covariance_holds():
    """Mean squared error in sigmas, a degree of freedom, over three flights: never overconfident by much."""
    squared = []
    for flight in range(3):
        poses = [looking(0.2 + 0.05 * np.sin(k / 40 + flight), 0.05 * flight, 0.9 - 0.002 * k) for k in range(80)]
        states, _ = fly(MISSION, poses)
        for state, xi in zip(states[SETTLED_FRAMES:], errors(states, poses)[SETTLED_FRAMES:], strict=True):
            squared.append(xi @ np.linalg.solve(np.array(state.covariance).reshape(12, 12)[:6, :6], xi) / 6)
    print(f"seed {SEED}: NEES {np.mean(squared):.2f} per degree of freedom")
    assert 0.2 < np.mean(squared) < 1.6


@pytest.mark.parametrize("marker_id", [7, 3, 11])
def test_every_marker_alone_gives_the_same_target(marker_id: int):
    """Whichever is seen, sizes and surfaces and places on the target make no difference to what is told."""
    poses = [looking(0.3 + 0.001 * k, 0.1, 0.7) for k in range(60)]
    states, _ = fly(MISSION, poses, only={0: {marker_id}})
    off = errors(states[-1:], poses[-1:])[0]
    P = np.array(states[-1].covariance).reshape(12, 12)[:6, :6]
    assert states[-1].mode == Mode.TRACK
    assert off @ np.linalg.solve(P, off) < chi2.ppf(0.9999, 6)
