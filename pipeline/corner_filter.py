"""One hypothesis of the pose filter: an iterated error-state Kalman filter on the corners of black squares.

The nominal motion is kept outside; what calibration leaves open is considered, not estimated (Schmidt, 1966), and the
covariance update is Joseph's, which holds for any gain.  Pixels: (0, 0) is the centre of the top-left pixel; corners
in the marker's order.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dpotrf, dpotrs, dtrtrs
from scipy.stats import chi2

from astratag.camera import Camera
from astratag.compiled import CUBE, MATRIX, compiled
from pipeline.dynamics import (
    ATTITUDE,
    CONSIDERED,
    EDGE_BIAS,
    MOTION,
    POSITION,
    RATE,
    SCALE,
    SHIFT,
    STATES,
    VELOCITY,
    Motion,
    OwnMotion,
    process_noise,
    right_jacobian_so3,
)
from pipeline.mission import FilterSection

Array = NDArray[np.float64]

CORNER_DOF = 8
"""Image coordinates of the four corners of one black square."""
FIRST_OF_POSITION, FIRST_OF_ATTITUDE, FIRST_OF_SHIFT = POSITION.start, ATTITUDE.start, SHIFT.start
TINY = float(np.finfo(float).tiny)
SHARPEST = 0.1
"""One plus the cosine between neighbouring edges' normals, bounded so that a needle's corner stays near."""
NEAREST_M = 1e-3
"""A corner nearer to the camera than this, or behind it, is not a measurement that can be linearised."""
MOST_ITERATIONS = 20
CONVERGED_SIGMAS = 1e-2
"""An iteration that moves no state by more than this share of its own uncertainty is the last."""
LINEAR_SHARE = 0.02
"""Where curvature moves corners by less than this share of their noise, one iteration is enough."""
LASTING_LOOKS = 20
"""How many looks an error of the attitude lasts while it is large: 2 s of pictures, until others outweigh them."""
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

    @property
    def size_px(self) -> tuple[int, int]:
        """Return the width and height of the camera's images."""
        return self.camera.width, self.camera.height


@dataclass(frozen=True, eq=False)
class Update:
    """What a set of measurements said about a hypothesis."""

    nis: float
    dof: int
    log_likelihood: float
    whitened: Array
    """The innovation (dof,) in its own standard deviations: white when the filter is right."""


@dataclass(frozen=True, eq=False)
class Look:
    """What a motion and its covariance predict of layers, and how they were measured instead."""

    motion: Motion
    P: Array
    layers: tuple[SeenLayer, ...]
    residual_px: Array
    """Measured minus predicted (8 L,)."""
    H: Array
    """Its slopes (8 L, 16) by the error state."""
    PHt: Array
    R: Array
    """Covariance (8 L, 8 L) of the measurement."""
    S: Array
    """Covariance (8 L, 8 L) of the residual."""

    def only(self, chosen: Sequence[int]) -> Look:
        """Return the part of some of the layers."""
        rows = np.concatenate([np.arange(CORNER_DOF * k, CORNER_DOF * (k + 1)) for k in chosen])
        layers = tuple(self.layers[k] for k in chosen)
        R, S = (whole[np.ix_(rows, rows)] for whole in (self.R, self.S))
        return Look(
            self.motion,
            self.P,
            layers,
            self.residual_px[rows],
            self.H[rows],
            np.ascontiguousarray(self.PHt[:, rows]),
            R,
            S,
        )


class CornerFilter:
    """Motion of the target with its covariance (16, 16), order and axes as in ``pipeline.dynamics``.

    Nothing is changed in place: a motion and a covariance that were read stay what they were.
    """

    considered: slice = CONSIDERED

    def __init__(self, motion: Motion, P: Array, noise: FilterSection):
        self.motion = motion
        self.noise = noise
        self._P = P
        self._looked: Look | None = None

    @classmethod
    def start(cls, T_chaser_target: Array, range_m: float, noise: FilterSection) -> Self:
        """Return a filter at a guessed pose, ``range_m`` from the camera, as good as ignorant of it."""
        sigma = np.empty(STATES)
        sigma[POSITION], sigma[ATTITUDE] = START_RANGE_SHARE * range_m, START_ATTITUDE_RAD
        sigma[VELOCITY], sigma[RATE] = noise.initial_speed_m_s, noise.initial_rate_rad_s
        sigma[EDGE_BIAS], sigma[SCALE], sigma[SHIFT] = noise.edge_bias_px, noise.scale_sigma, noise.image_shift_px
        return cls(Motion.at_rest(T_chaser_target), np.diag(sigma**2), noise)

    @property
    def covariance(self) -> Array:
        """Return the covariance (16, 16) of the error state."""
        return self._P

    def copy(self) -> Self:
        """Return a filter of its own in the same state."""
        return type(self)(self.motion, self._P, self.noise)

    def predict(self, dt_s: float, unseen_s: float = 0.0, own: OwnMotion | None = None) -> None:
        """Let ``dt_s`` seconds pass, at the end of which nothing was measured for ``unseen_s`` seconds."""
        F = self.motion.transition(dt_s, self.noise, own)
        self._P = F @ self._P @ F.T + process_noise(dt_s, self.noise, unseen_s)
        self.motion = self.motion.after(dt_s, self.noise, own)

    def gate(self, layers: Sequence[SeenLayer], eye: Eye) -> Array:
        """Return the normalised innovation squared of each layer by itself, infinite where it cannot be seen."""
        look = self._look(layers, eye)
        if look is None and len(layers) > 1:
            return np.concatenate([self.gate([layer], eye) for layer in layers])
        if look is None:
            return np.array([np.inf])
        count = len(layers)
        of_layer = np.arange(count)
        S = look.S.reshape(count, CORNER_DOF, count, CORNER_DOF)[of_layer, :, of_layer]
        residual = look.residual_px.reshape(count, CORNER_DOF, 1)
        return np.sum(residual * np.linalg.solve(S, residual), axis=(1, 2))

    def update(self, layers: Sequence[SeenLayer], eye: Eye) -> Update | None:
        """Take measurements in; return what they said, or None, and nothing changed, when they make no sense.

        Source: B. M. Bell and F. W. Cathey, "The iterated Kalman filter update as a Gauss-Newton method", 1993.
        """
        prior, error = self.motion, np.zeros(STATES)
        look, focal_px = self._look(layers, eye), float(eye.camera.K[0, 0])
        linear_px = LINEAR_SHARE * min(layer.sigma_px for layer in layers)
        for _ in range(MOST_ITERATIONS):
            if look is None:
                return None
            innovation = look.residual_px + look.H @ error
            L, fault = dpotrf(look.S, lower=1)
            if fault:
                return None
            K = dpotrs(L, look.PHt.T, lower=1)[0].T
            K[self.considered] = 0.0
            step, error = K @ innovation - error, K @ innovation
            variance = np.diag(self._P) - np.sum(K * look.PHt, axis=1)
            is_last = np.all(step**2 <= CONVERGED_SIGMAS**2 * np.abs(variance) + np.finfo(float).tiny)
            if is_last or _curvature_px(look, step, focal_px) < linear_px:
                return self._conclude(prior, error, look, K, innovation, L, eye)
            look = self._look_from(prior.moved(error), layers, eye, right_jacobian_so3(error[ATTITUDE]))
        return None

    def _look(self, layers: Sequence[SeenLayer], eye: Eye) -> Look | None:
        """Return what is predicted of the layers, from what the gate has found already if it has."""
        last = self._looked
        if last is not None and last.motion is self.motion and last.P is self._P:
            places = {id(layer): k for k, layer in enumerate(last.layers)}
            chosen = [places.get(id(layer)) for layer in layers]
            if chosen == list(range(len(last.layers))):
                return last
            if None not in chosen:
                return last.only([k for k in chosen if k is not None])
        self._looked = self._look_from(self.motion, layers, eye)
        return self._looked

    def _look_from(
        self, motion: Motion, layers: Sequence[SeenLayer], eye: Eye, turned: Array | None = None
    ) -> Look | None:
        """Return what a motion predicts; ``turned`` (3, 3) takes attitude errors of the prior to the motion's."""
        seen = predicted_corners(motion, layers, eye)
        if seen is None:
            return None
        observed, H = np.concatenate([layer.corners_px.ravel() for layer in layers]), seen[1]
        if turned is not None:
            H[:, ATTITUDE] = H[:, ATTITUDE] @ turned
        PHt, R = self._P @ H.T, self._corner_noise(layers)
        S = H @ PHt + R
        if not np.isfinite(S).all():
            return None
        return Look(motion, self._P, tuple(layers), observed - seen[0], H, PHt, R, S)

    def _corner_noise(self, layers: Sequence[SeenLayer]) -> Array:
        """Return the covariance (8 L, 8 L) of corners: each one's own, and the shift of the picture that all share."""
        R = np.diag(np.repeat([layer.sigma_px**2 for layer in layers], CORNER_DOF))
        R[::2, ::2] += self.noise.picture_shift_px**2
        R[1::2, 1::2] += self.noise.picture_shift_px**2
        return R

    def _conclude(
        self, prior: Motion, error: Array, look: Look, K: Array, innovation: Array, L: Array, eye: Eye
    ) -> Update | None:
        """Accept an update, with less weight where the slopes do not hold as far as the pose is still uncertain."""
        left = self._P[ATTITUDE, ATTITUDE] - K[ATTITUDE] @ look.PHt[ATTITUDE].T
        bent = bending(look.motion, (left + left.T) / 2, look.layers, eye)
        if bent is not None:
            R, S = look.R + bent, look.S + bent
            L, fault = dpotrf(S, lower=1)
            if fault:
                return None
            look = replace(look, R=R, S=S)
            K = dpotrs(L, look.PHt.T, lower=1)[0].T
            K[self.considered] = 0.0
            error = K @ innovation
        return self._accept(prior.moved(error), error, look, K, innovation, L)

    def _accept(self, motion: Motion, error: Array, look: Look, K: Array, innovation: Array, L: Array) -> Update | None:
        """Put the error into the motion and express the covariance in the axes of the new attitude."""
        IKH = np.eye(STATES) - K @ look.H
        P = IKH @ self._P @ IKH.T + K @ look.R @ K.T
        G = right_jacobian_so3(error[ATTITUDE])
        P[ATTITUDE] = G @ P[ATTITUDE]
        P[:, ATTITUDE] = P[:, ATTITUDE] @ G.T
        P = (P + P.T) / 2
        if not np.isfinite(P).all() or dpotrf(P[MOTION, MOTION], lower=1)[1]:
            return None
        self._P, self.motion, self._looked = P, motion, None
        whitened = dtrtrs(L, innovation, lower=1)[0]
        nis = float(whitened @ whitened)
        log_likelihood = -0.5 * nis - float(np.log(np.diag(L)).sum())
        return Update(nis, len(whitened), log_likelihood, whitened)

    def merged(self, other: CornerFilter, probability: float) -> CornerFilter:
        """Return the mean of both, of which the other is the right one with a probability, with its covariance."""
        apart = self.motion.error_of(other.motion)
        spread = probability * (1 - probability) * np.outer(apart, apart)
        P = (1 - probability) * self._P + probability * other._P + spread
        return CornerFilter(self.motion.moved(probability * apart), P, self.noise)

    def distrust_pose(self, factor: float) -> None:
        """Multiply the standard deviations of position and attitude."""
        scale = np.ones(STATES)
        scale[POSITION] = scale[ATTITUDE] = factor
        self._P = scale[:, None] * self.covariance * scale

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
    """Return where the layers' corners are seen (8 L,) px and how that follows the error state (8 L, 16).

    None when a corner is not before the camera or anything is out of bounds.
    """
    points_target = np.concatenate([layer.points_target for layer in layers])
    R_cam_chaser = eye.T_cam_chaser[:3, :3]
    R_cam_target = R_cam_chaser @ motion.R_chaser_target
    place = R_cam_chaser @ motion.p_chaser_target_m + eye.T_cam_chaser[:3, 3]
    points_cam = points_target @ R_cam_target.T + place
    if not np.isfinite(points_cam).all() or points_cam[:, 2].min() < NEAREST_M:
        return None
    centre = eye.camera.K[:2, 2]
    off_centre = eye.camera.project(points_cam) - centre
    by_point = (1 + motion.scale) * eye.camera.projection_jacobian(points_cam)
    outward = outward_shift(off_centre.reshape(-1, 4, 2)).reshape(-1, 2)
    H = _derivatives(points_target, by_point, eye.T_cam_chaser, R_cam_target, off_centre, outward)
    pixels = centre + (1 + motion.scale) * off_centre + motion.shift_px + motion.edge_bias_px * outward
    if not (np.isfinite(pixels).all() and np.isfinite(H).all()):
        return None
    return pixels.ravel(), H.reshape(-1, STATES)


def bending(motion: Motion, P_attitude: Array, layers: Sequence[SeenLayer], eye: Eye) -> Array | None:
    """Return what slopes miss of corners (8 L, 8 L) px2 at attitudes as uncertain as this, None where that is little.

    A nearly frontal print shows its tilt by squares of it: slopes depend on a tilt that is hardly known.  What they
    miss stays the same while the error of the attitude does, and is no smaller after many looks: it counts for each.
    Second moment of the second-order term, as in R. P. Wishner, J. A. Tabaczynski, M. Athans, "A comparison of three
    non-linear filters", 1969.
    """
    points = np.concatenate([layer.points_target for layer in layers])
    R_cam_chaser = eye.T_cam_chaser[:3, :3]
    R_cam_target = R_cam_chaser @ motion.R_chaser_target
    centre = points.mean(axis=0)
    depth_m = (R_cam_target @ centre + R_cam_chaser @ motion.p_chaser_target_m + eye.T_cam_chaser[:3, 3])[2]
    px_m, arms = eye.camera.K[0, 0] / float(depth_m), points - centre
    sigma_px = min(layer.sigma_px for layer in layers)
    most_px = px_m * float(np.abs(arms).max()) * float(np.trace(P_attitude))
    if np.sqrt(LASTING_LOOKS) * most_px < LINEAR_SHARE * sigma_px:
        return None
    # second derivatives by w_i and w_j of component k of Exp(w) a, for every arm a_n, at w = 0
    one = np.eye(3)
    curved = (np.einsum("ik,nj->nkij", one, arms) + np.einsum("jk,ni->nkij", one, arms)) / 2
    curved -= np.einsum("ij,nk->nkij", one, arms)
    bent_px = px_m * np.einsum("rk,nkij->nrij", R_cam_target[:2], curved).reshape(-1, 3, 3)
    mean_px = np.einsum("aij,ij->a", bent_px, P_attitude) / 2
    spread_px = bent_px @ P_attitude
    variance_px2 = np.einsum("aij,bji->ab", spread_px, spread_px) / 2
    return np.asarray(LASTING_LOOKS * (variance_px2 + np.outer(mean_px, mean_px)))


def _curvature_px(look: Look, step: Array, focal_px: float) -> float:
    """Return about how much farther than linearly a step moves corners: by squares of the angle and of the way."""
    way_px = float(np.abs(look.H[:, POSITION]).max() * np.linalg.norm(step[POSITION]))
    size_px = float(np.abs(look.H[:, ATTITUDE]).max())
    return way_px**2 / focal_px + size_px * float(step[ATTITUDE] @ step[ATTITUDE])


@compiled(MATRIX, CUBE, MATRIX, MATRIX, MATRIX, MATRIX)
def _derivatives(
    points_target: Array, by_point: Array, T_cam_chaser: Array, R_cam_target: Array, off_centre: Array, outward: Array
) -> Array:
    """Return how pixels (N, 2) of points (N, 3) follow the error state (N, 2, 16), given how they follow the points."""
    H = np.zeros((len(by_point), 2, STATES))
    for n in range(len(by_point)):
        x, y, z = points_target[n]
        for axis in range(2):
            for k in range(3):
                for j in range(3):
                    H[n, axis, FIRST_OF_POSITION + k] += by_point[n, axis, j] * T_cam_chaser[j, k]
            a = b = c = 0.0
            for j in range(3):
                a += by_point[n, axis, j] * R_cam_target[j, 0]
                b += by_point[n, axis, j] * R_cam_target[j, 1]
                c += by_point[n, axis, j] * R_cam_target[j, 2]
            H[n, axis, FIRST_OF_ATTITUDE] = y * c - z * b  # a.(w x r) = (r x a).w
            H[n, axis, FIRST_OF_ATTITUDE + 1] = z * a - x * c
            H[n, axis, FIRST_OF_ATTITUDE + 2] = x * b - y * a
            H[n, axis, EDGE_BIAS] = outward[n, axis]
            H[n, axis, SCALE] = off_centre[n, axis]
            H[n, axis, FIRST_OF_SHIFT + axis] = 1.0
    return H


def cross_rows(points: Array, rows: Array) -> Array:
    """Return points (N, 3) crossed with each row of matrices (N, 2, 3): a.(w x r) = (r x a).w."""
    x, y, z = points.T[:, :, None]
    a, b, c = rows[..., 0], rows[..., 1], rows[..., 2]
    crossed = np.empty(rows.shape)
    crossed[..., 0], crossed[..., 1], crossed[..., 2] = y * c - z * b, z * a - x * c, x * b - y * a
    return crossed


def outward_shift(quads_px: Array) -> Array:
    """Return how corners (L, 4, 2) move when every edge of their quad moves outward by a pixel.

    A corner moves by d with d.n = 1 for the outward normals n of both its edges.
    """
    return _outward_shift(np.ascontiguousarray(quads_px, dtype=float))


@compiled(CUBE)
def _outward_shift(quads_px: Array) -> Array:
    shift, normals = np.empty(quads_px.shape), np.empty((4, 2))
    for q in range(len(quads_px)):
        quad, turn = quads_px[q], 0.0
        for i in range(4):
            after, last = (i + 1) % 4, (i + 2) % 4
            x, y = quad[after, 0] - quad[i, 0], quad[after, 1] - quad[i, 1]
            turn += x * (quad[last, 1] - quad[after, 1]) - y * (quad[last, 0] - quad[after, 0])
            length = max(np.sqrt(x * x + y * y), TINY)
            normals[i, 0], normals[i, 1] = y / length, -x / length
        for i in range(4):
            x, y = normals[i]
            before_x, before_y = normals[(i + 3) % 4]
            share = np.sign(turn) / max(1 + before_x * x + before_y * y, SHARPEST)
            shift[q, i, 0], shift[q, i, 1] = share * (before_x + x), share * (before_y + y)
    return shift


def gate_limit(probability: float, dof: int) -> float:
    """Return the normalised innovation squared that true measurements stay below with a probability."""
    return float(chi2.ppf(probability, dof))
