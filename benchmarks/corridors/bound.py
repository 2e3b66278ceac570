"""What the corners, as noisy as they are measured to be, allow: the posterior Cramer-Rao bound along a true motion.

Source: P. Tichavsky, C. Muravchik, A. Nehorai, "Posterior Cramer-Rao bounds for discrete-time nonlinear filtering",
1998; with the filter's own model of how the target may move.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from astratag.camera import Camera
from astratag.transforms import inverse, skew, transform
from pipeline.convert import points_array, pose_matrix, vector_array
from pipeline.dynamics import (
    ACCELERATION,
    ANGULAR_ACCELERATION,
    ATTITUDE,
    ESTIMATED,
    MOTION,
    POSITION,
    RATE,
    VELOCITY,
    Motion,
    process_noise,
)
from pipeline.mission import Mission
from pipeline.pose_filter import corners_on_target
from schemas import Detections, Truth

Array = NDArray[np.float64]
Key = tuple[int, int, int]
"""Marker, layer, and the bin of range."""
STATES = ESTIMATED.stop
GROSS_PX = 0.5
"""RMS of a layer's corners beyond which they are not noise: ten times what the detector promises at its worst."""
LEAST_SAMPLES = 5
"""A correlation in time from fewer is not believed."""
MOST_CORRELATED = 0.95
IGNORANT_M, IGNORANT_RAD = 1.0, 1.0


@dataclass(frozen=True, eq=False)
class Frame:
    """One frame: what was detected in it, and what is true."""

    t_s: float
    detections: Detections
    truth: Truth
    range_bin: int


@dataclass(frozen=True)
class CornerNoise:
    """How far a layer's corners are off: the RMS of a coordinate, and its correlation from one frame to the next."""

    rms_px: float
    correlation: float
    samples: int

    def variance_px2(self, *, correlated: bool) -> float:
        """Return the variance (px^2) of a coordinate.

        With ``correlated``, that of white noise with the same mean over many frames: (1 + r) / (1 - r) times as much.
        """
        r = min(max(self.correlation, 0.0), MOST_CORRELATED) if correlated else 0.0
        return self.rms_px**2 * (1 + r) / (1 - r)


@dataclass(frozen=True, eq=False)
class MeasuredLayer:
    """A layer of a marker of the map that was measured in a frame, and what its corners (4, 2) px are off."""

    marker_id: int
    layer: int
    off_px: Array

    @property
    def is_gross(self) -> bool:
        """Tell whether this is no noise but something else, which a filter has to refuse."""
        return float(np.sqrt(np.mean(self.off_px**2))) > GROSS_PX


def measured_layers(frame: Frame, mission: Mission, camera: Camera) -> list[MeasuredLayer]:
    """Return the layers that were measured in a frame: seen minus true."""
    T_cam_target = inverse(mission.camera.T_chaser_cam.matrix()) @ pose_matrix(frame.truth.T_chaser_target)
    ids = {marker.id for marker in mission.markers}
    found = []
    for detection in frame.detections.detections:
        for layer in detection.layers if detection.marker_id in ids else ():
            points = true_points(detection.marker_id, layer.layer, mission)
            off_px = points_array(layer.corners_px) - camera.project(transform(T_cam_target, points))
            found.append(MeasuredLayer(detection.marker_id, layer.layer, off_px))
    return found


def true_points(marker_id: int, layer: int, mission: Mission) -> Array:
    """Return where a layer's corners (4, 3) are on the target."""
    marker = mission.marker(marker_id)
    assert marker is not None
    return corners_on_target(marker, layer)


def corner_residuals(frames: Sequence[Frame], mission: Mission, camera: Camera) -> dict[Key, list[tuple[int, Array]]]:
    """Return by layer and range the frames' numbers and what their corners (4, 2) px are off, gross ones left out."""
    residuals: dict[Key, list[tuple[int, Array]]] = defaultdict(list)
    for k, frame in enumerate(frames):
        for seen in measured_layers(frame, mission, camera):
            if not seen.is_gross:
                residuals[seen.marker_id, seen.layer, frame.range_bin].append((k, seen.off_px))
    return dict(residuals)


def measured_noise(residuals: Mapping[Key, Sequence[tuple[int, Array]]]) -> dict[Key, CornerNoise]:
    """Return the noise of each layer's corners in each bin of range."""
    noise = {}
    for key, samples in residuals.items():
        off_px = np.array([off for _, off in samples])
        pairs = [(a, b) for (i, a), (j, b) in pairwise(samples) if j == i + 1]
        power = float(np.mean(off_px**2))
        together = float(np.mean([np.mean(a * b) for a, b in pairs])) if len(pairs) >= LEAST_SAMPLES else 0.0
        noise[key] = CornerNoise(float(np.sqrt(power)), together / max(power, 1e-12), len(samples))
    return noise


def posterior_bound(
    frames: Sequence[Frame], mission: Mission, camera: Camera, noise: Mapping[Key, CornerNoise], *, correlated: bool
) -> Array:
    """Return the covariance (K, 12, 12) below which no unbiased estimate at each frame can be, chaser axes."""
    settings = mission.filter
    prior = np.empty(STATES)
    prior[POSITION], prior[ATTITUDE] = IGNORANT_M, IGNORANT_RAD
    prior[VELOCITY], prior[RATE] = settings.initial_speed_m_s, settings.initial_rate_rad_s
    prior[ACCELERATION] = settings.acceleration_m_s2
    prior[ANGULAR_ACCELERATION] = settings.angular_acceleration_rad_s2
    P, bounds, before_s = np.diag(prior**2), [], None
    for frame in frames:
        motion = _true_motion(frame.truth)
        if before_s is not None:
            dt_s = frame.t_s - before_s
            F = motion.transition(dt_s, settings)[ESTIMATED, ESTIMATED]
            P = F @ P @ F.T + process_noise(dt_s, settings)[ESTIMATED, ESTIMATED]
        information = np.linalg.inv(P)
        for seen in measured_layers(frame, mission, camera):
            if seen.is_gross:
                continue
            H = _corner_jacobian(motion, true_points(seen.marker_id, seen.layer, mission), mission, camera)
            variance = noise[seen.marker_id, seen.layer, frame.range_bin].variance_px2(correlated=correlated)
            information = information + H.T @ H / variance
        P = np.linalg.inv(information)
        P = (P + P.T) / 2
        bounds.append(P[MOTION, MOTION])
        before_s = frame.t_s
    return np.array(bounds)


def _true_motion(truth: Truth) -> Motion:
    T_chaser_target = pose_matrix(truth.T_chaser_target)
    return Motion(
        T_chaser_target[:3, 3],
        T_chaser_target[:3, :3],
        vector_array(truth.v_chaser_target_m_s),
        vector_array(truth.omega_chaser_target_in_target_rad_s),
    )


def _corner_jacobian(motion: Motion, points_target: Array, mission: Mission, camera: Camera) -> Array:
    """Return how corners (4, 3) on the target move in the image with the state, (8, 18)."""
    T_cam_chaser = inverse(mission.camera.T_chaser_cam.matrix())
    R_cam_chaser = T_cam_chaser[:3, :3]
    points_cam = transform(T_cam_chaser @ motion.pose_chaser_target(), points_target)
    by_point = camera.projection_jacobian(points_cam) @ R_cam_chaser
    H = np.zeros((len(points_target), 2, STATES))
    H[:, :, POSITION] = by_point
    for k, point in enumerate(points_target):
        H[k, :, ATTITUDE] = -by_point[k] @ motion.R_chaser_target @ skew(point)
    return H.reshape(-1, STATES)
