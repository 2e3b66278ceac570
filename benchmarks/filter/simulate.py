"""Approaches drawn from the filter's own process model, corners with noise, and what the filter made of them.

That is what a bound is about: the mission's filter section describes the very disturbance that is simulated.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from astratag.transforms import difference, exp_so3, inverse, pose, skew
from pipeline.bound import Bound
from pipeline.convert import points_array, points_message, pose_matrix, pose_message, vector_array
from pipeline.corners import Eye, SeenLayer, outward_shift, predicted_corners
from pipeline.dynamics import (
    ACCELERATION,
    MOTION,
    POSITION,
    SPEEDS,
    STATES,
    VELOCITY,
    Motion,
    lasting_push,
    process_noise,
)
from pipeline.mission import FilterSection, FlatSection, Mission
from pipeline.pose_filter import PoseFilter, corners_on_target
from pipeline.scenario import FACING
from schemas import Detection, LayerCorners, Mode, PlanarPose, RelativeState
from tests.approach import CALIBRATION, CAMERA, MARKER, detections, mission, visible_layers

Array = NDArray[np.float64]
SIGMA_PX = 0.15
SETTLED_S = 2.0
MATCHED = FilterSection(
    edge_bias_px=0.0,
    one_edge_bias_px=0.0,
    edge_turn_px=0.0,
    lasting_sigma_px=0.0,
    edge_end_correlation=0.0,
    scale_sigma=0.0,
    picture_shift_px=0.0,
    correlation_s=0.1,
)
"""A camera without fault, corners each with noise of its own, accelerations that are new with every other picture."""


@dataclass(frozen=True)
class Case:
    """An approach, straight and at constant speed but for the process noise, and what is wrong with the camera."""

    name: str
    side_m: float
    tilt_rad: float
    ranges_m: tuple[float, ...]
    """Edges of the bins, farthest first."""
    rate_hz: float
    duration_s: float
    noise: FilterSection
    limits: tuple[float, ...] = ()
    """Largest ratio of RMS to the bound, for each bin; empty: no bound is computed."""
    focal_error: float = 0.0
    edge_px: float = 0.0
    """All edges are measured so far outside."""
    shift_px: float = 0.0
    """All corners are shifted so far, each way."""
    corner_px: float = 0.0
    """Standard deviation of a constant offset of each corner by itself."""

    def mission(self) -> Mission:
        """Return the mission of the filter."""
        return mission(FlatSection(), side_m=self.side_m, filter=self.noise)


@dataclass
class Samples:
    """What came of each settled frame in TRACK: a row a frame."""

    range_m: list[float] = field(default_factory=list)
    run: list[int] = field(default_factory=list)
    frame: list[int] = field(default_factory=list)
    squares: list[Array] = field(default_factory=list)
    """Squared errors of the marker's pose in the camera: lateral (m2), axial (m2), tilt (rad2)."""
    bounds: list[Array] = field(default_factory=list)
    """The same of the bound."""
    variances: list[Array] = field(default_factory=list)
    """The same of the filter's own covariance."""
    ideal: list[Array] = field(default_factory=list)
    """Squared errors of the linear filter that reaches the bound, from the same draws."""
    nees: list[float] = field(default_factory=list)
    nis: list[tuple[float, int]] = field(default_factory=list)
    cpu_s: list[float] = field(default_factory=list)
    correlation: list[tuple[float, float, int]] = field(default_factory=list)
    """Of the whitened innovations of two frames in a row: product, square, and how many."""


def motions(case: Case, mission_: Mission, rng: np.random.Generator) -> list[Motion]:
    """Return a true motion for every frame, white accelerations on a straight line from the first range to the last."""
    dt_s, count = 1 / case.rate_hz, round(case.duration_s * case.rate_hz)
    Q = process_noise(dt_s, case.noise)
    shoves = rng.multivariate_normal(np.zeros(STATES), Q, size=count)
    roll, azimuth = rng.uniform(0, 2 * np.pi, 2)
    tilt = case.tilt_rad * np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    R_cam_marker = FACING @ exp_so3([0, 0, roll]) @ exp_so3(tilt)
    T_chaser_cam = mission_.camera.T_chaser_cam.matrix()
    T_marker_target = inverse(mission_.markers[0].T_target_marker.matrix())
    first, last = (
        T_chaser_cam @ pose(R_cam_marker, [0, 0, range_m]) @ T_marker_target
        for range_m in (case.ranges_m[0], case.ranges_m[-1])
    )
    to_go_s = dt_s * np.arange(count - 1, -1, -1)
    pushed_s2 = np.array([lasting_push(float(left_s), case.noise.correlation_s)[2] for left_s in to_go_s])
    drifted = shoves[:, POSITION].sum(axis=0) + to_go_s @ shoves[:, SPEEDS[:3]] + pushed_s2 @ shoves[:, ACCELERATION]
    v = (last[:3, 3] - first[:3, 3] - drifted) / (dt_s * count)  # where the noise leads is where the marker is
    real = Motion(first[:3, 3], first[:3, :3], v, np.zeros(3))
    path = []
    for shove in shoves:
        path.append(real)
        real = real.after(dt_s, case.noise).moved(shove)
    return path


def look(
    case: Case, mission_: Mission, motion: Motion, rng: np.random.Generator, offsets_px: Array
) -> Detection | None:
    """Return what a detector with the case's camera sees."""
    T = motion.pose_chaser_target()
    layers = visible_layers(mission_, T)
    if not layers:
        return None
    centre, seen = CAMERA.K[:2, 2], []
    for layer, corners in layers.items():
        wrong = case.focal_error * (corners - centre) + case.edge_px * outward_shift(corners[None])[0] + case.shift_px
        noisy = corners + wrong + case.corner_px * offsets_px[layer] + SIGMA_PX * rng.standard_normal((4, 2))
        seen.append(LayerCorners(layer=layer, corners_px=points_message(noisy), sigma_px=SIGMA_PX))
    T_cam_marker = inverse(mission_.camera.T_chaser_cam.matrix()) @ T @ mission_.markers[0].T_target_marker.matrix()
    message = pose_message(T_cam_marker)
    return Detection(
        family="astratag20",
        marker_id=MARKER,
        corners_px=seen[0].corners_px,
        layers=seen,
        correlation=0.95,
        hamming=0,
        method="planar",
        planar_poses=[PlanarPose(T_cam_marker=message, reprojection_rms_px=SIGMA_PX)],
        T_cam_marker=message,
    )


def simulate(case: Case, runs: int, first_seed: int = 0) -> Samples:
    """Fly a case ``runs`` times and keep what the filter made of it."""
    samples, mission_ = Samples(), case.mission()
    for seed in range(first_seed, first_seed + runs):
        _run(case, mission_, seed, samples)
    return samples


def _run(case: Case, mission_: Mission, seed: int, samples: Samples) -> None:
    rng = np.random.default_rng(seed)
    offsets_px, path = rng.standard_normal((3, 4, 2)), motions(case, mission_, rng)
    seen = [look(case, mission_, motion, rng, offsets_px) for motion in path]
    ideal = list(_ideal(case, mission_, path, seen)) if case.limits else [(np.eye(12), np.zeros(12))] * len(path)
    pose_filter = PoseFilter(mission_)
    pose_filter.step(CALIBRATION)
    before: Array | None = None
    for k, (motion, found, (bound, reached)) in enumerate(zip(path, seen, ideal, strict=True)):
        message = detections(k / case.rate_hz, found)
        started_s = time.process_time()
        state = next(iter(pose_filter.step(message)))
        cpu_s = time.process_time() - started_s
        assert isinstance(state, RelativeState)
        innovation = pose_filter.innovation
        if k / case.rate_hz >= SETTLED_S and state.mode == Mode.TRACK and found is not None:
            samples.run.append(seed)
            samples.frame.append(k)
            samples.cpu_s.append(cpu_s)
            _keep(samples, mission_, motion, state, bound, reached)
            if innovation is not None and before is not None and len(before) == len(innovation):
                samples.correlation.append(
                    (float(before @ innovation), float(innovation @ innovation), len(innovation))
                )
        before = innovation


def _ideal(
    case: Case, mission_: Mission, path: list[Motion], seen: list[Detection | None]
) -> Iterator[tuple[Array, Array]]:
    """Yield the bound (12, 12) at each frame, and the error (12,) of the linear filter that reaches it.

    That filter takes its slopes at the truth, and meets the same disturbances and the same corner noise.
    """
    eye, dt_s = Eye(CAMERA, inverse(mission_.camera.T_chaser_cam.matrix())), 1 / case.rate_hz
    bound = Bound.start(path[0].pose_chaser_target(), case.ranges_m[0], case.noise)
    error = np.zeros(STATES)
    error[VELOCITY] = path[0].v_chaser_target_m_s  # filters begin at rest
    for k, (motion, found) in enumerate(zip(path, seen, strict=True)):
        if k:
            error = path[k - 1].transition(dt_s, case.noise) @ error
            error += path[k - 1].after(dt_s, case.noise).error_of(motion)
            bound.predict(dt_s)
        layers = [
            SeenLayer(
                MARKER,
                layer.layer,
                points_array(layer.corners_px),
                SIGMA_PX,
                corners_on_target(mission_.markers[0], layer.layer),
            )
            for layer in (found.layers if found is not None else [])
        ]
        bound.look(motion, layers, eye)
        exact = predicted_corners(motion, layers, eye) if layers else None
        if bound.gain is not None and exact is not None:
            K, H = bound.gain
            off_px = np.concatenate([layer.corners_px.ravel() for layer in layers]) - exact[0]
            error = error - K @ (H @ error + off_px)
        told = error[MOTION].copy()
        told[POSITION] = motion.R_chaser_target.T @ told[POSITION]
        yield bound.message_covariance(), told


def _keep(
    samples: Samples, mission_: Mission, real: Motion, state: RelativeState, bound: Array, reached: Array
) -> None:
    assert state.T_chaser_target is not None and state.covariance is not None
    assert state.v_chaser_target_m_s is not None and state.omega_chaser_target_in_target_rad_s is not None
    T_cam_chaser = inverse(mission_.camera.T_chaser_cam.matrix())
    T_target_marker = mission_.markers[0].T_target_marker.matrix()
    T, estimate = real.pose_chaser_target(), pose_matrix(state.T_chaser_target)
    whole = np.concatenate(
        [
            difference(T, estimate),
            real.v_chaser_target_m_s - vector_array(state.v_chaser_target_m_s),
            real.omega_chaser_target_in_target_rad_s - vector_array(state.omega_chaser_target_in_target_rad_s),
        ]
    )
    P = np.array(state.covariance).reshape(12, 12)
    samples.nees.append(float(whole @ np.linalg.solve(P, whole)))
    samples.nis.append((state.nis or 0.0, state.nis_dof))
    J = camera_from_target(T_cam_chaser @ T, T_target_marker)
    error, limit, own = J @ whole[:6], np.diag(J @ bound[:6, :6] @ J.T), np.diag(J @ P[:6, :6] @ J.T)
    samples.range_m.append(float((T_cam_chaser @ T @ T_target_marker)[2, 3]))
    samples.squares.append(_by_axis(error**2))
    samples.bounds.append(_by_axis(limit))
    samples.variances.append(_by_axis(own))
    samples.ideal.append(_by_axis((J @ reached[:6]) ** 2))


def _by_axis(squares: Array) -> Array:
    return np.array([squares[0] + squares[1], squares[2], squares[3] + squares[4]])


def camera_from_target(T_cam_target: Array, T_target_marker: Array) -> Array:
    """Return how an error of the target's pose becomes one of the marker's (6, 6): camera axes, then marker axes."""
    R = T_target_marker[:3, :3]
    R_cam_target = T_cam_target[:3, :3]
    J = np.zeros((6, 6))
    J[:3, :3], J[:3, 3:], J[3:, 3:] = R_cam_target, -R_cam_target @ skew(T_target_marker[:3, 3]), R.T
    return J
