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

from astratag.compiled import MATRIX, REAL, VECTOR, compiled
from pipeline.corners import (
    CORNER_DOF,
    LINEAR_SHARE,
    Eye,
    SeenLayer,
    bending,
    corner_noise,
    predicted_corners,
    with_lasting,
)
from pipeline.dynamics import (
    ACCELERATION,
    ANGULAR_ACCELERATION,
    ATTITUDE,
    CONSIDERED,
    ESTIMATED,
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
from pipeline.lasting import (
    OUTWARD,
    PER_LAYER,
    LastingErrors,
    decay,
    is_modelled,
    shared_px2,
    variances_px2,
    with_new_covariance,
)
from pipeline.mission import FilterSection

Array = NDArray[np.float64]

MOST_ITERATIONS = 20
CONVERGED_SIGMAS = 1e-2
"""An iteration that moves no state by more than this share of its own uncertainty is the last."""
START_RANGE_SHARE = 0.3
START_ATTITUDE_RAD = 1.0
"""Uncertainty of the first guess of a pose before its corners are used: so wide that only they count."""


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
    """Its slopes (8 L, N) by the error state."""
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
    """Motion of the target and lasting errors of its layers, with their covariance (N, N).

    Order and axes as in ``pipeline.dynamics``, and behind that as in ``pipeline.lasting``.  Nothing is changed in
    place: a motion and a covariance that were read stay what they were.
    """

    considered: slice = CONSIDERED
    forgets: bool = True
    """Whether what lasted of layers that were not seen for long leaves the state."""

    def __init__(self, motion: Motion, P: Array, noise: FilterSection, lasting: LastingErrors | None = None):
        self.motion = motion
        self.noise = noise
        self.lasting = LastingErrors() if lasting is None else lasting
        self._P = P
        self._looked: Look | None = None

    @classmethod
    def start(cls, T_chaser_target: Array, range_m: float, noise: FilterSection) -> Self:
        """Return a filter at a guessed pose, ``range_m`` from the camera, as good as ignorant of it."""
        sigma = np.empty(STATES)
        sigma[POSITION], sigma[ATTITUDE] = START_RANGE_SHARE * range_m, START_ATTITUDE_RAD
        sigma[VELOCITY], sigma[RATE] = noise.initial_speed_m_s, noise.initial_rate_rad_s
        sigma[ACCELERATION], sigma[ANGULAR_ACCELERATION] = noise.acceleration_m_s2, noise.angular_acceleration_rad_s2
        sigma[SCALE], sigma[SHIFT] = noise.scale_sigma, noise.image_shift_px
        return cls(Motion.at_rest(T_chaser_target), np.diag(sigma**2), noise)

    @property
    def covariance(self) -> Array:
        """Return the covariance (N, N) of the error state."""
        return self._P

    def copy(self) -> Self:
        """Return a filter of its own in the same state."""
        return type(self)(self.motion, self._P, self.noise, self.lasting)

    def predict(self, dt_s: float, own: OwnMotion | None = None) -> None:
        """Let ``dt_s`` seconds pass."""
        P, lasting = self._P, self.lasting
        kept = lasting.kept(self.noise) if self.forgets else range(len(lasting.keys))
        if len(kept) < len(lasting.keys):
            rows = np.concatenate([np.arange(STATES), *(_rows(k) for k in kept)])
            P, lasting = P[np.ix_(rows, rows)], lasting.only(kept)
        F, shares = self.motion.transition(dt_s, self.noise, own), decay(dt_s, self.noise)
        left, added = np.ones(len(P)), np.zeros(len(P))
        left[STATES:] = np.tile(shares, len(kept))
        common_px2 = (1 - shares[OUTWARD] ** 2) * shared_px2(self.noise)
        added[STATES:] = np.tile((1 - shares**2) * variances_px2(self.noise), len(kept))
        added[STATES + OUTWARD :: PER_LAYER] -= common_px2
        later = _later(np.ascontiguousarray(P), F, process_noise(dt_s, self.noise), left, added, common_px2)
        self._P, self.lasting = later, lasting.after(dt_s, self.noise)
        self.motion = self.motion.after(dt_s, self.noise, own)

    def transition(self, dt_s: float, own: OwnMotion | None = None) -> Array:
        """Return how an error state now becomes one ``dt_s`` later (N, N), nothing forgotten."""
        F = np.diag(np.concatenate([np.ones(STATES), np.tile(decay(dt_s, self.noise), len(self.lasting.keys))]))
        F[:STATES, :STATES] = self.motion.transition(dt_s, self.noise, own)
        return F

    def know(self, layers: Sequence[SeenLayer]) -> None:
        """Make room for the lasting errors of layers that were not seen before."""
        if not is_modelled(self.noise):
            return
        known, lasting = len(self.lasting.keys), self.lasting.with_new([layer.key for layer in layers], self.noise)
        new = len(lasting.keys) - known
        if new:
            self._P, self.lasting = with_new_covariance(self._P, known, new, self.noise), lasting

    def gate(self, layers: Sequence[SeenLayer], eye: Eye) -> Array:
        """Return the normalised innovation squared of each layer by itself, infinite where it cannot be seen."""
        self.know(layers)
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
        self.know(layers)
        prior, error = self.motion, np.zeros(len(self._P))
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
            lasting = self.lasting.moved(error[STATES:])
            look = self._look_from(prior.moved(error), layers, eye, right_jacobian_so3(error[ATTITUDE]), lasting)
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
        self,
        motion: Motion,
        layers: Sequence[SeenLayer],
        eye: Eye,
        turned: Array | None = None,
        lasting: LastingErrors | None = None,
    ) -> Look | None:
        """Return what a motion predicts; ``turned`` (3, 3) takes attitude errors of the prior to the motion's."""
        seen = predicted_corners(motion, layers, eye)
        if seen is None:
            return None
        observed = np.concatenate([layer.corners_px.ravel() for layer in layers])
        H, residual_px = seen[1], observed - seen[0]
        if turned is not None:
            H[:, ATTITUDE] = H[:, ATTITUDE] @ turned
        if self.lasting.keys:
            H = with_lasting(H, seen[0], self.lasting.slots(layer.key for layer in layers), len(self._P))
            residual_px -= H[:, STATES:] @ (self.lasting if lasting is None else lasting).px.ravel()
        PHt, R = self._P @ H.T, corner_noise(layers, self.noise)
        S = H @ PHt + R
        if not np.isfinite(S).all():
            return None
        return Look(motion, self._P, tuple(layers), residual_px, H, PHt, R, S)

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
        IKH = np.eye(len(K)) - K @ look.H
        P = IKH @ self._P @ IKH.T + K @ look.R @ K.T
        G = right_jacobian_so3(error[ATTITUDE])
        P[ATTITUDE] = G @ P[ATTITUDE]
        P[:, ATTITUDE] = P[:, ATTITUDE] @ G.T
        P = (P + P.T) / 2
        if not np.isfinite(P).all() or dpotrf(P[ESTIMATED, ESTIMATED], lower=1)[1]:
            return None
        self._P, self.motion, self._looked = P, motion, None
        self.lasting = self.lasting.moved(error[STATES:]).seen(layer.key for layer in look.layers)
        whitened = dtrtrs(L, innovation, lower=1)[0]
        nis = float(whitened @ whitened)
        log_likelihood = -0.5 * nis - float(np.log(np.diag(L)).sum())
        return Update(nis, len(whitened), log_likelihood, whitened)

    def merged(self, other: CornerFilter, probability: float) -> CornerFilter:
        """Return the mean of both, of which the other is the right one with a probability, with its covariance."""
        apart = self.error_of(other)
        spread = probability * (1 - probability) * np.outer(apart, apart)
        return self.moved(probability * apart, (1 - probability) * self._P + probability * other._P + spread)

    def error_of(self, other: CornerFilter) -> Array:
        """Return the error state (N,) that takes this filter's estimate to that of another with the same layers."""
        assert self.lasting.keys == other.lasting.keys
        return np.concatenate([self.motion.error_of(other.motion), (other.lasting.px - self.lasting.px).ravel()])

    def moved(self, error: Array, P: Array) -> Self:
        """Return a filter with an error state (N,) put in, and another covariance."""
        return type(self)(self.motion.moved(error), P, self.noise, self.lasting.moved(error[STATES:]))

    def distrust_pose(self, factor: float) -> None:
        """Multiply the standard deviations of position and attitude."""
        scale = np.ones(len(self._P))
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


@compiled(MATRIX, MATRIX, MATRIX, VECTOR, VECTOR, REAL)
def _later(P: Array, F: Array, Q: Array, left: Array, added: Array, common_px2: float) -> Array:
    """Return a covariance (N, N) later: by F and Q (21, 21) of the motion, by shares and variances (N,) of the rest,
    and by what is added to all layers' outward errors alike.
    """
    size = len(P)
    half, later = np.empty((STATES, size)), np.empty((size, size))
    for i in range(STATES):
        half[i] = 0.0
        for k in range(STATES):
            if F[i, k] != 0.0:
                for j in range(size):
                    half[i, j] += F[i, k] * P[k, j]
    for i in range(size):
        for j in range(STATES, size):
            later[i, j] = (half[i, j] if i < STATES else P[i, j] * left[i]) * left[j]
        later[i, i] = later[i, i] + added[i] if i >= STATES else 0.0
    for i in range(STATES + OUTWARD, size, PER_LAYER):
        for j in range(STATES + OUTWARD, size, PER_LAYER):
            later[i, j] += common_px2
    for i in range(STATES):
        for j in range(STATES):
            total = Q[i, j]
            for k in range(STATES):
                if F[j, k] != 0.0:
                    total += half[i, k] * F[j, k]
            later[i, j] = total
        for j in range(STATES, size):
            later[j, i] = later[i, j]
    return later


def _rows(slot: int) -> NDArray[np.intp]:
    return np.arange(STATES + PER_LAYER * slot, STATES + PER_LAYER * (slot + 1))


def _curvature_px(look: Look, step: Array, focal_px: float) -> float:
    """Return about how much farther than linearly a step moves corners: by squares of the angle and of the way."""
    way_px = float(np.abs(look.H[:, POSITION]).max() * np.linalg.norm(step[POSITION]))
    size_px = float(np.abs(look.H[:, ATTITUDE]).max())
    return way_px**2 / focal_px + size_px * float(step[ATTITUDE] @ step[ATTITUDE])


def gate_limit(probability: float, dof: int) -> float:
    """Return the normalised innovation squared that true measurements stay below with a probability."""
    return float(chi2.ppf(probability, dof))
