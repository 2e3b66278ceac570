"""One hypothesis of the pose filter: an iterated error-state Kalman filter on the corners of black squares.

The algebra of prediction and of the Joseph update is filterpy's, with the nominal motion kept outside: its state is
the error, zero before each update, and what it is given to measure is the corner residual.  Pixels: (0, 0) is the
centre of the top-left pixel; corners in the marker's order.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter
from numpy.typing import NDArray
from scipy.stats import chi2

from astratag.camera import Camera
from pipeline.dynamics import (
    ATTITUDE,
    EDGE_BIAS,
    MOTION,
    POSITION,
    RATE,
    STATES,
    VELOCITY,
    Motion,
    process_noise,
    right_jacobian_so3,
)
from pipeline.mission import FilterSection

Array = NDArray[np.float64]

CORNER_DOF = 8
"""Image coordinates of the four corners of one black square."""
NEXT_CORNER, PREVIOUS_CORNER = [1, 2, 3, 0], [3, 0, 1, 2]
SHARPEST = 0.1
"""One plus the cosine between neighbouring edges' normals, bounded so that a needle's corner stays near."""
NEAREST_M = 1e-3
"""A corner nearer to the camera than this, or behind it, is not a measurement that can be linearised."""
MOST_ITERATIONS = 20
CONVERGED_SIGMAS = 1e-2
"""An iteration that moves no state by more than this share of its own uncertainty is the last."""
START_RANGE_SHARE = 0.3
START_ATTITUDE_RAD = 1.0
"""Uncertainty of the first guess of a pose before its corners are used: so wide that only they count."""


@dataclass(frozen=True, eq=False)
class SeenLayer:
    """One black square as it was measured, and where its corners are on the target."""

    marker_id: int
    layer: int
    corners_px: Array
    """(4, 2)"""
    sigma_px: float
    points_target: Array
    """(4, 3)"""


@dataclass(frozen=True, eq=False)
class Eye:
    """A calibrated camera and where it sits on the chaser."""

    camera: Camera
    T_cam_chaser: Array


@dataclass(frozen=True)
class Update:
    """What a set of measurements said about a hypothesis."""

    nis: float
    dof: int
    log_likelihood: float


class CornerFilter:
    """Motion of the target with its covariance (13, 13), order and axes as in ``pipeline.dynamics``."""

    def __init__(self, motion: Motion, P: Array, noise: FilterSection):
        self.motion = motion
        self.noise = noise
        self._kalman = ExtendedKalmanFilter(dim_x=STATES, dim_z=CORNER_DOF)
        self._kalman.x = np.zeros(STATES)
        self._kalman.P = P

    @classmethod
    def start(cls, T_chaser_target: Array, range_m: float, noise: FilterSection) -> CornerFilter:
        """Return a filter at a guessed pose, ``range_m`` from the camera, as good as ignorant of it."""
        sigma = np.empty(STATES)
        sigma[POSITION], sigma[ATTITUDE] = START_RANGE_SHARE * range_m, START_ATTITUDE_RAD
        sigma[VELOCITY], sigma[RATE] = noise.initial_speed_m_s, noise.initial_rate_rad_s
        sigma[EDGE_BIAS] = noise.edge_bias_px
        return cls(Motion.at_rest(T_chaser_target), np.diag(sigma**2), noise)

    @property
    def covariance(self) -> Array:
        """Return the covariance (13, 13) of the error state."""
        return self._kalman.P

    def copy(self) -> CornerFilter:
        """Return a filter of its own in the same state."""
        return CornerFilter(self.motion, self.covariance.copy(), self.noise)

    def predict(self, dt_s: float, unseen_s: float = 0.0) -> None:
        """Let ``dt_s`` seconds pass, at the end of which nothing was measured for ``unseen_s`` seconds."""
        self._kalman.F = self.motion.transition(dt_s, self.noise)
        self._kalman.Q = process_noise(dt_s, self.noise, unseen_s)
        self._kalman.predict()
        self.motion = self.motion.after(dt_s, self.noise)

    def gate(self, layers: Sequence[SeenLayer], eye: Eye) -> Array:
        """Return the normalised innovation squared of each layer by itself, infinite where it cannot be seen."""
        seen = predicted_corners(self.motion, layers, eye)
        if seen is None and len(layers) > 1:
            return np.concatenate([self.gate([layer], eye) for layer in layers])
        if seen is None:
            return np.array([np.inf])
        distances = np.empty(len(layers))
        for k, layer in enumerate(layers):
            rows = slice(CORNER_DOF * k, CORNER_DOF * (k + 1))
            residual, H = layer.corners_px.ravel() - seen[0][rows], seen[1][rows]
            S = H @ self.covariance @ H.T + self._corner_noise([layer])
            distances[k] = residual @ np.linalg.solve(S, residual)
        return distances

    def update(self, layers: Sequence[SeenLayer], eye: Eye) -> Update | None:
        """Take measurements in; return what they said, or None, and nothing changed, when they make no sense.

        Source: B. M. Bell and F. W. Cathey, "The iterated Kalman filter update as a Gauss-Newton method", 1993.
        """
        prior, P_prior = self.motion, self.covariance
        observed = np.concatenate([layer.corners_px.ravel() for layer in layers])
        R = self._corner_noise(layers)
        no_prediction = np.zeros(len(observed))
        kalman, error = self._kalman, np.zeros(STATES)
        for _ in range(MOST_ITERATIONS):
            seen = predicted_corners(prior.moved(error), layers, eye)
            if seen is None:
                break
            H = seen[1]
            H[:, ATTITUDE] = H[:, ATTITUDE] @ right_jacobian_so3(error[ATTITUDE])
            kalman.x, kalman.P = np.zeros(STATES), P_prior
            try:
                kalman.update(observed - seen[0] + H @ error, lambda _, H=H: H, lambda _: no_prediction, R=R)
                np.linalg.cholesky(kalman.P[MOTION, MOTION])
            except (ValueError, np.linalg.LinAlgError):  # infinite, or no longer positive definite
                break
            step, error = kalman.x - error, kalman.x
            if np.all(step**2 <= CONVERGED_SIGMAS**2 * np.diag(kalman.P) + np.finfo(float).tiny):
                return self._accept(prior.moved(error), error)
        kalman.P = P_prior
        return None

    def _corner_noise(self, layers: Sequence[SeenLayer]) -> Array:
        """Return the covariance (8 L, 8 L) of corners: each one's own, and the shift of the picture that all share."""
        R = np.diag(np.repeat([layer.sigma_px**2 for layer in layers], CORNER_DOF))
        R[::2, ::2] += self.noise.picture_shift_px**2
        R[1::2, 1::2] += self.noise.picture_shift_px**2
        return R

    def _accept(self, motion: Motion, error: Array) -> Update:
        """Put the error into the motion and express the covariance in the axes of the new attitude."""
        kalman = self._kalman
        G = np.eye(STATES)
        G[ATTITUDE, ATTITUDE] = right_jacobian_so3(error[ATTITUDE])
        P = G @ kalman.P @ G.T
        kalman.P, self.motion = (P + P.T) / 2, motion
        nis = float(kalman.y @ kalman.SI @ kalman.y)
        return Update(nis, len(kalman.y), -0.5 * (nis + float(np.linalg.slogdet(kalman.S)[1])))

    def widen(self, other: CornerFilter, probability: float) -> None:
        """Cover also the other filter's motion, which is the right one with a (small) probability."""
        apart = self.motion.error_of(other.motion)
        own, others = self.covariance, other.covariance
        self._kalman.P = (1 - probability) * own + probability * (others + np.outer(apart, apart))

    def distrust_pose(self, factor: float) -> None:
        """Multiply the standard deviations of position and attitude."""
        scale = np.ones(STATES)
        scale[POSITION] = scale[ATTITUDE] = factor
        self._kalman.P = scale[:, None] * self.covariance * scale

    def misfit(self, layers: Sequence[SeenLayer], eye: Eye) -> float:
        """Return the squared residuals of layers at the motion as it is now, in units of their variance."""
        seen = predicted_corners(self.motion, layers, eye)
        if seen is None:
            return np.inf
        sigma = np.repeat([layer.sigma_px for layer in layers], CORNER_DOF)
        observed = np.concatenate([layer.corners_px.ravel() for layer in layers])
        return float(np.sum(((observed - seen[0]) / sigma) ** 2))

    def message_covariance(self) -> Array:
        """Return the covariance (12, 12) in the messages' convention: the position in target axes as well."""
        P = self.covariance[MOTION, MOTION].copy()
        R = self.motion.R_chaser_target
        P[POSITION] = R.T @ P[POSITION]
        P[:, POSITION] = P[:, POSITION] @ R
        return (P + P.T) / 2


def predicted_corners(motion: Motion, layers: Sequence[SeenLayer], eye: Eye) -> tuple[Array, Array] | None:
    """Return where the layers' corners are seen (8 L,) px and how that follows the error state (8 L, 13).

    None when a corner is not before the camera or anything is out of bounds.
    """
    points_target = np.concatenate([layer.points_target for layer in layers])
    R_cam_chaser = eye.T_cam_chaser[:3, :3]
    R_cam_target = R_cam_chaser @ motion.R_chaser_target
    points_cam = points_target @ R_cam_target.T + R_cam_chaser @ motion.p_chaser_target_m + eye.T_cam_chaser[:3, 3]
    if not np.isfinite(points_cam).all() or points_cam[:, 2].min() < NEAREST_M:
        return None
    pixels = eye.camera.project(points_cam)
    by_point = eye.camera.projection_jacobian(points_cam)
    outward = outward_shift(pixels.reshape(-1, 4, 2)).reshape(-1, 2)

    H = np.zeros((len(pixels), 2, STATES))
    H[:, :, POSITION] = by_point @ R_cam_chaser
    H[:, :, ATTITUDE] = cross_rows(points_target, by_point @ R_cam_target)
    H[:, :, EDGE_BIAS] = outward
    pixels = pixels + motion.edge_bias_px * outward
    if not (np.isfinite(pixels).all() and np.isfinite(H).all()):
        return None
    return pixels.ravel(), H.reshape(-1, STATES)


def cross_rows(points: Array, rows: Array) -> Array:
    """Return points (N, 3) crossed with each row of matrices (N, 2, 3): a.(w x r) = (r x a).w."""
    x, y, z = (points[:, k, None] for k in range(3))
    a, b, c = rows[..., 0], rows[..., 1], rows[..., 2]
    return np.stack([y * c - z * b, z * a - x * c, x * b - y * a], axis=-1)


def outward_shift(quads_px: Array) -> Array:
    """Return how corners (L, 4, 2) move when every edge of their quad moves outward by a pixel.

    A corner moves by d with d.n = 1 for the outward normals n of both its edges.
    """
    edges = quads_px[:, NEXT_CORNER] - quads_px
    x, y = edges[..., 0], edges[..., 1]
    turn = np.sign(np.sum(x * y[:, NEXT_CORNER] - y * x[:, NEXT_CORNER], axis=1))
    normals = np.stack([y, -x], axis=-1) * (turn[:, None] / np.maximum(np.hypot(x, y), np.finfo(float).tiny))[..., None]
    before = normals[:, PREVIOUS_CORNER]
    return (before + normals) / np.maximum(1 + np.sum(before * normals, axis=2, keepdims=True), SHARPEST)


def gate_limit(probability: float, dof: int) -> float:
    """Return the normalised innovation squared that true measurements stay below with a probability."""
    return float(chi2.ppf(probability, dof))
