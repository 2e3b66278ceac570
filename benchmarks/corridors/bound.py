"""What the corners, as noisy as they are measured to be, allow: the posterior Cramer-Rao bound along a true motion.

Noise is measured by what it does to a square: shift it both ways, grow, turn, stretch, shear or narrow it.  Each of
these modes has a variance of its own, of which a measured share lasts as a first-order Gauss-Markov process, and is
part of the bound's state; the rest is new in each picture.  That a square grows lasts for seconds, and says something
of the range; that it is turned or narrowed does not last, and says something of the attitude.  Taken alike in all
coordinates, growth that lasts would count as shifts and tilts that do, and a filter that knows better does better than
such a bound.  How far squares grow alike is measured too: markers side by side do, and still tell the range by how far
they are apart.

Source: P. Tichavsky, C. Muravchik, A. Nehorai, "Posterior Cramer-Rao bounds for discrete-time nonlinear filtering",
1998; with the filter's own model of how the target may move.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations

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
from pipeline.mission import FilterSection, Mission
from pipeline.pose_filter import corners_on_target
from schemas import Detections, Truth

Array = NDArray[np.float64]
Key = tuple[int, int, int]
"""Marker, layer, and the bin of range."""
MODES = 8
"""Of a square: shifted right and down, grown, turned, stretched, sheared, narrowed to a side and to an end."""
GROWN = 2
_SIGNS = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
"""Of right and down at the corners."""
STATES = ESTIMATED.stop
GROSS_PX = 0.5
"""RMS of a layer's corners beyond which they are not noise: ten times what the detector promises at its worst."""
LEAST_SAMPLES = 5
"""A correlation in time from fewer is not believed."""
MOST_KEPT, LEAST_KEPT, MOST_LASTING = 0.99, 0.05, 0.95
"""Of a mode's lasting part, left in the next frame: at most, and least that is taken for lasting; and its largest share
of the variance."""
LEAST_ALONE = 0.05
"""Least eigenvalue of the correlations of how layers grow: none follows wholly from the others."""
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
    """How far a layer's corners are off: the RMS (8,) of each mode, its correlation (8,) from one frame to the next."""

    mode_px: Array
    correlations: Array
    samples: int

    @property
    def rms_px(self) -> float:
        """Return the RMS of a coordinate."""
        return float(np.sqrt(np.mean(self.mode_px**2)))

    @property
    def correlation(self) -> float:
        """Return that of all modes together, by their power."""
        return float(np.average(self.correlations, weights=self.mode_px**2))


@dataclass(frozen=True, eq=False)
class Noise:
    """The noise of each layer in each bin of range, and how it lasts."""

    layers: Mapping[Key, CornerNoise]
    kept: Array = field(default_factory=lambda: np.zeros(MODES))
    """What is left (8,) of a mode's lasting part in the next frame."""
    alike: Mapping[bool, float] = field(default_factory=dict)
    """Correlation of how much two layers grow, whether they are of one marker."""

    def white(self) -> Noise:
        """Return noise as large that is all new in every frame."""
        return Noise({key: replace(noise, correlations=np.zeros(MODES)) for key, noise in self.layers.items()})

    def lasting_share(self, key: Key) -> Array:
        """Return which share (8,) of the modes' variances lasts."""
        shares = self.layers[key].correlations / np.maximum(self.kept, LEAST_KEPT)
        return np.clip(np.where(self.kept > LEAST_KEPT, shares, 0.0), 0.0, MOST_LASTING)

    def growing_alike(self, squares: Sequence[tuple[int, int]]) -> Array:
        """Return the correlations (L, L) of how markers' layers grow for long."""
        together = np.eye(len(squares))
        for i, j in combinations(range(len(squares)), 2):
            together[i, j] = together[j, i] = self.alike.get(squares[i][0] == squares[j][0], 0.0)
        values, vectors = np.linalg.eigh(together)
        together = (vectors * np.maximum(values, LEAST_ALONE)) @ vectors.T
        sizes = np.sqrt(np.diag(together))
        return np.asarray(together / np.outer(sizes, sizes))


def modes_of(quad_px: Array) -> Array:
    """Return what each mode does to the corners (4, 2) px of a square that looks like this: orthonormal rows (8, 8)."""
    quad_px = np.asarray(quad_px)
    right = quad_px[1] + quad_px[2] - quad_px[0] - quad_px[3]
    down = quad_px[2] + quad_px[3] - quad_px[0] - quad_px[1]
    u, v = _SIGNS.T
    one, none = np.ones(4), np.zeros(4)
    by_axes = [(one, none), (none, one), (u, v), (-v, u), (u, -v), (v, u), (u * v, none), (none, u * v)]
    right, down = right / np.linalg.norm(right), down / np.linalg.norm(down)
    rows = np.array([(np.outer(a, right) + np.outer(b, down)).ravel() for a, b in by_axes])
    U, _, Vt = np.linalg.svd(rows / np.linalg.norm(rows, axis=1, keepdims=True))
    return np.asarray(U @ Vt)  # the orthonormal rows nearest to those: seen at an angle, axes are not square


@dataclass(frozen=True, eq=False)
class MeasuredLayer:
    """A layer of a marker of the map that was measured in a frame: where it is (4, 2) px, and what it is off."""

    marker_id: int
    layer: int
    true_px: Array
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
            true_px = camera.project(transform(T_cam_target, points))
            off_px = points_array(layer.corners_px) - true_px
            found.append(MeasuredLayer(detection.marker_id, layer.layer, true_px, off_px))
    return found


def true_points(marker_id: int, layer: int, mission: Mission) -> Array:
    """Return where a layer's corners (4, 3) are on the target."""
    marker = mission.marker(marker_id)
    assert marker is not None
    return corners_on_target(marker, layer)


def mode_residuals(frames: Sequence[Frame], mission: Mission, camera: Camera) -> dict[Key, list[tuple[int, Array]]]:
    """Return by layer and range the frames' numbers and their modes (8,) px, gross ones left out."""
    residuals: dict[Key, list[tuple[int, Array]]] = defaultdict(list)
    for k, frame in enumerate(frames):
        for seen in measured_layers(frame, mission, camera):
            if not seen.is_gross:
                modes_px = modes_of(seen.true_px) @ seen.off_px.ravel()
                residuals[seen.marker_id, seen.layer, frame.range_bin].append((k, modes_px))
    return dict(residuals)


def measured_noise(residuals: Mapping[Key, Sequence[tuple[int, Array]]]) -> Noise:
    """Return the noise of each layer's corners in each bin of range."""
    layers = {}
    lagged = np.zeros((2, MODES))
    for key, samples in residuals.items():
        power = np.mean([modes**2 for _, modes in samples], axis=0)
        one, two = (_lagged(samples, frames) for frames in (1, 2))
        together = np.zeros(MODES) if one is None else one
        layers[key] = CornerNoise(np.sqrt(power), together / np.maximum(power, 1e-12), len(samples))
        if one is not None and two is not None:
            lagged += len(samples) * np.array([one, two])
    kept = np.clip(lagged[1] / np.maximum(lagged[0], 1e-12), 0.0, MOST_KEPT)
    return Noise(layers, np.where(lagged[0] > 0, kept, 0.0), _alike(residuals))


def _lagged(samples: Sequence[tuple[int, Array]], frames: int) -> Array | None:
    """Return the covariance (8,) px^2 of modes with themselves so many frames later; None from too few."""
    later = dict(samples)
    pairs = [modes * later[k + frames] for k, modes in samples if k + frames in later]
    return np.asarray(np.mean(pairs, axis=0)) if len(pairs) >= LEAST_SAMPLES else None


def _alike(residuals: Mapping[Key, Sequence[tuple[int, Array]]]) -> dict[bool, float]:
    """Return how the growth of two layers is correlated, those of one marker and those of different ones."""
    sums: dict[bool, Array] = defaultdict(lambda: np.zeros(2))
    for one, other in combinations(sorted(residuals), 2):
        if one[2] != other[2]:
            continue
        later = {k: float(modes[GROWN]) for k, modes in residuals[other]}
        pairs = [(float(modes[GROWN]), later[k]) for k, modes in residuals[one] if k in later]
        if len(pairs) >= LEAST_SAMPLES:
            a, b = np.array(pairs).T
            sums[one[0] == other[0]] += [a @ b, np.sqrt((a @ a) * (b @ b))]
    return {same: float(product / max(power, 1e-12)) for same, (product, power) in sums.items()}


def posterior_bound(frames: Sequence[Frame], mission: Mission, camera: Camera, noise: Noise) -> Array:
    """Return the covariance (K, 12, 12) below which no unbiased estimate at each frame can be, chaser axes.

    The state is the motion's, and behind it the lasting modes of every layer that is ever seen.
    """
    settings = mission.filter
    squares = sorted({key[:2] for key in noise.layers})
    grown = STATES + GROWN + MODES * np.arange(len(squares))
    together, kept = noise.growing_alike(squares), np.tile(noise.kept, len(squares))
    size = STATES + len(kept)
    P = np.zeros((size, size))
    P[:STATES, :STATES] = np.diag(_prior_sigma(settings) ** 2)
    P[STATES:, STATES:] = np.eye(len(kept))
    P[np.ix_(grown, grown)] = together
    stationary = P[STATES:, STATES:].copy()
    bounds, before_s = [], None
    for frame in frames:
        motion = _true_motion(frame.truth)
        if before_s is not None:
            dt_s, F, Q = frame.t_s - before_s, np.zeros((size, size)), np.zeros((size, size))
            F[:STATES, :STATES] = motion.transition(dt_s, settings)[ESTIMATED, ESTIMATED]
            F[STATES:, STATES:] = np.diag(kept)
            Q[:STATES, :STATES] = process_noise(dt_s, settings)[ESTIMATED, ESTIMATED]
            Q[STATES:, STATES:] = stationary * (1 - np.outer(kept, kept))
            P = F @ P @ F.T + Q
        seen = [layer for layer in measured_layers(frame, mission, camera) if not layer.is_gross]
        if seen:
            H, R = np.zeros((MODES * len(seen), size)), np.zeros(MODES * len(seen))
            for k, layer in enumerate(seen):
                key = layer.marker_id, layer.layer, frame.range_bin
                rows = slice(MODES * k, MODES * (k + 1))
                first = STATES + MODES * squares.index(key[:2])
                share, variance = noise.lasting_share(key), noise.layers[key].mode_px ** 2
                points = true_points(layer.marker_id, layer.layer, mission)
                H[rows, :STATES] = modes_of(layer.true_px) @ _corner_jacobian(motion, points, mission, camera)
                H[rows, first : first + MODES] = np.diag(np.sqrt(share * variance))
                R[rows] = (1 - share) * variance
            S = H @ P @ H.T + np.diag(R)
            P = P - P @ H.T @ np.linalg.solve(S, H @ P)
            P = (P + P.T) / 2
        bounds.append(P[MOTION, MOTION])
        before_s = frame.t_s
    return np.array(bounds)


def _prior_sigma(settings: FilterSection) -> Array:
    prior = np.empty(STATES)
    prior[POSITION], prior[ATTITUDE] = IGNORANT_M, IGNORANT_RAD
    prior[VELOCITY], prior[RATE] = settings.initial_speed_m_s, settings.initial_rate_rad_s
    prior[ACCELERATION] = settings.acceleration_m_s2
    prior[ANGULAR_ACCELERATION] = settings.angular_acceleration_rad_s2
    return prior


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
