"""How the target moves past the chaser between two pictures, and how an error in that motion grows.

The nominal motion lives outside the filter; the error state is, in this order, position (m, chaser axes), attitude
(rad, right perturbation in target axes), velocity (m/s, chaser axes), rate (rad/s, target axes), acceleration (m/s2,
chaser axes) and angular acceleration (rad/s2, target axes), and what is only considered: the share by which the focal
length is off, and the constant shift of all pictures (px).  Drift is as the mission says; accelerations beside it last
for a while, as first-order Gauss-Markov processes.  Source: R. A. Singer, "Estimating optimal tracking filter
performance for manned maneuvering targets", 1970.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from astratag.compiled import VECTOR, compiled
from astratag.transforms import exp_so3, log_so3, pose, rotation_from_wxyz, skew
from pipeline.hill import clohessy_wiltshire
from pipeline.mission import DriftSection, FilterSection

Array = NDArray[np.float64]

POSITION, ATTITUDE, VELOCITY, RATE = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12)
MOTION = slice(0, 12)
ACCELERATION, ANGULAR_ACCELERATION = slice(12, 15), slice(15, 18)
SCALE, SHIFT = 18, slice(19, 21)
CONSIDERED = slice(18, 21)
"""States that are never estimated, only reckoned with: constants of the calibration (Schmidt, 1966)."""
STATES = 21
PLACES, SPEEDS = np.r_[POSITION, ATTITUDE], np.r_[VELOCITY, RATE]
PUSHES = np.r_[ACCELERATION, ANGULAR_ACCELERATION]
ESTIMATED = slice(0, 18)

ORDERS = PLACES, SPEEDS, PUSHES
NODES, WEIGHTS = np.polynomial.legendre.leggauss(8)
SHORT = 1e-3
"""Share of a correlation time below which the series of the way is exact to 1e-10."""
SMALL_ANGLE_RAD = 1e-4
"""Below it, the series of the right Jacobian to second order is exact to 1e-13."""


@dataclass(frozen=True, eq=False)
class OwnMotion:
    """What the chaser knows of its own motion; it holds until it tells anew."""

    R_hill_chaser: Array
    omega_hill_chaser_in_chaser_rad_s: Array
    acceleration_chaser_m_s2: Array
    """By its thrusters, chaser axes."""

    @classmethod
    def of(cls, drift: DriftSection) -> OwnMotion:
        """Return that of a chaser which keeps its attitude in the Hill frame and does not thrust."""
        return cls(rotation_from_wxyz(drift.R_hill_chaser_wxyz), np.zeros(3), np.zeros(3))


@dataclass(frozen=True, eq=False)
class Motion:
    """The nominal relative motion, and beside it what calibration leaves open: focal share, picture shift."""

    p_chaser_target_m: Array
    R_chaser_target: Array
    v_chaser_target_m_s: Array
    omega_chaser_target_in_target_rad_s: Array
    a_chaser_target_m_s2: Array = field(default_factory=lambda: np.zeros(3))
    """Beside the drift, chaser axes."""
    alpha_in_target_rad_s2: Array = field(default_factory=lambda: np.zeros(3))
    scale: float = 0.0
    shift_px: Array = field(default_factory=lambda: np.zeros(2))

    @classmethod
    def at_rest(cls, T_chaser_target: Array) -> Motion:
        """Return a target that stands still at a pose."""
        return cls(T_chaser_target[:3, 3].copy(), T_chaser_target[:3, :3].copy(), np.zeros(3), np.zeros(3))

    def pose_chaser_target(self) -> Array:
        """Return T_chaser_target (4, 4)."""
        return pose(self.R_chaser_target, self.p_chaser_target_m)

    def moved(self, error: Array) -> Motion:
        """Return this motion with an error state (21 or more,) put in."""
        return Motion(
            self.p_chaser_target_m + error[POSITION],
            self.R_chaser_target @ exp_so3(error[ATTITUDE]),
            self.v_chaser_target_m_s + error[VELOCITY],
            self.omega_chaser_target_in_target_rad_s + error[RATE],
            self.a_chaser_target_m_s2 + error[ACCELERATION],
            self.alpha_in_target_rad_s2 + error[ANGULAR_ACCELERATION],
            self.scale + float(error[SCALE]),
            self.shift_px + error[SHIFT],
        )

    def error_of(self, other: Motion) -> Array:
        """Return the error state (21,) with ``self.moved(error)`` equal to ``other``."""
        return np.concatenate(
            [
                other.p_chaser_target_m - self.p_chaser_target_m,
                log_so3(self.R_chaser_target.T @ other.R_chaser_target),
                other.v_chaser_target_m_s - self.v_chaser_target_m_s,
                other.omega_chaser_target_in_target_rad_s - self.omega_chaser_target_in_target_rad_s,
                other.a_chaser_target_m_s2 - self.a_chaser_target_m_s2,
                other.alpha_in_target_rad_s2 - self.alpha_in_target_rad_s2,
                [other.scale - self.scale],
                other.shift_px - self.shift_px,
            ]
        )

    def after(self, dt_s: float, noise: FilterSection, own: OwnMotion | None = None) -> Motion:
        """Return the motion ``dt_s`` seconds later."""
        p, v, omega = self.p_chaser_target_m, self.v_chaser_target_m_s, self.omega_chaser_target_in_target_rad_s
        if own is None and noise.drift.translation == "constant_velocity":
            p = p + v * dt_s
        else:
            A, b = translation_drift(dt_s, noise.drift, own)
            moved = A @ np.concatenate([p, v]) + b
            p, v = moved[:3], moved[3:]
        if noise.drift.attitude == "constant_rate":
            R = self.R_chaser_target @ exp_so3(omega * dt_s)
        else:
            R, omega = free_rotation(self.R_chaser_target, omega, dt_s, noise.drift, own)
        left, speed_s, way_s2 = lasting_push(dt_s, noise.correlation_s)
        a, alpha = self.a_chaser_target_m_s2, self.alpha_in_target_rad_s2
        return Motion(
            p + way_s2 * a,
            R @ exp_so3(way_s2 * alpha),
            v + speed_s * a,
            omega + speed_s * alpha,
            left * a,
            left * alpha,
            self.scale,
            self.shift_px,
        )

    def transition(self, dt_s: float, noise: FilterSection, own: OwnMotion | None = None) -> Array:
        """Return how an error state now becomes one ``dt_s`` later, (21, 21)."""
        turn_rad = self.omega_chaser_target_in_target_rad_s * dt_s
        F = np.eye(STATES)
        if own is None and noise.drift.translation == "constant_velocity":
            F[PLACES[:3], SPEEDS[:3]] = dt_s
        else:
            A, _ = translation_drift(dt_s, noise.drift, own)
            F[POSITION, POSITION], F[POSITION, VELOCITY] = A[:3, :3], A[:3, 3:]
            F[VELOCITY, POSITION], F[VELOCITY, VELOCITY] = A[3:, :3], A[3:, 3:]
        F[ATTITUDE, ATTITUDE] = exp_so3(-turn_rad)
        F[ATTITUDE, RATE] = dt_s * right_jacobian_so3(turn_rad)
        if noise.drift.attitude == "rigid_body":
            _free_rotation_slopes(F, self, dt_s, noise.drift, own)
        left, speed_s, way_s2 = lasting_push(dt_s, noise.correlation_s)
        pushed_rad = way_s2 * self.alpha_in_target_rad_s2
        F[ATTITUDE] = exp_so3(-pushed_rad) @ F[ATTITUDE]
        F[PLACES, PUSHES], F[SPEEDS, PUSHES], F[PUSHES, PUSHES] = way_s2, speed_s, left
        F[ATTITUDE, ANGULAR_ACCELERATION] = way_s2 * right_jacobian_so3(pushed_rad)
        return F

    def observed_from(self, before: OwnMotion, now: OwnMotion) -> Motion:
        """Return the same motion as a chaser sees it whose own rate has just changed."""
        jump = now.omega_hill_chaser_in_chaser_rad_s - before.omega_hill_chaser_in_chaser_rad_s
        return replace(
            self,
            v_chaser_target_m_s=self.v_chaser_target_m_s - skew(jump) @ self.p_chaser_target_m,
            omega_chaser_target_in_target_rad_s=self.omega_chaser_target_in_target_rad_s
            - self.R_chaser_target.T @ jump,
        )


def translation_drift(dt_s: float, drift: DriftSection, own: OwnMotion | None) -> tuple[Array, Array]:
    """Return A (6, 6) and b (6,) that take position and velocity, chaser axes, to those ``dt_s`` later.

    Through the Hill frame, where the chaser is at -R p and moves at -R (v + omega x p): by the equations of Clohessy
    and Wiltshire, or straight on, and by its own thrust.
    """
    own = OwnMotion.of(drift) if own is None else own
    rate_rad_s = drift.orbit_rate_rad_s if drift.translation == "clohessy_wiltshire" else 0.0
    Phi, Gamma = clohessy_wiltshire(rate_rad_s, dt_s)
    R0, W, zero = own.R_hill_chaser, skew(own.omega_hill_chaser_in_chaser_rad_s), np.zeros((3, 3))
    R1 = R0 @ exp_so3(own.omega_hill_chaser_in_chaser_rad_s * dt_s)
    to_hill = -np.block([[R0, zero], [R0 @ W, R0]])
    from_hill = np.block([[-R1.T, zero], [W @ R1.T, -R1.T]])
    return from_hill @ Phi @ to_hill, from_hill @ (Gamma @ (R0 @ own.acceleration_chaser_m_s2))


def free_rotation(
    R_chaser_target: Array, omega: Array, dt_s: float, drift: DriftSection, own: OwnMotion | None
) -> tuple[Array, Array]:
    """Return attitude and rate ``dt_s`` later of a rigid target that turns freely, by a midpoint step.

    Euler's equations hold for the rate in space, of which the chaser's own is part.
    """
    own_rate = _inertial_rate(drift, own)
    J = np.array(drift.target_inertia)
    inertial = omega + R_chaser_target.T @ own_rate
    middle = inertial + dt_s / 2 * _euler(inertial, J)
    later = inertial + dt_s * _euler(middle, J)
    half_turned = R_chaser_target @ exp_so3(omega * dt_s / 2)
    R = R_chaser_target @ exp_so3((middle - half_turned.T @ own_rate) * dt_s)
    return R, later - R.T @ own_rate


def _euler(omega: Array, inertia: Array) -> Array:
    return -(skew(omega) @ (inertia * omega)) / inertia


def _euler_slopes(omega: Array, inertia: Array) -> Array:
    return (skew(inertia * omega) - skew(omega) * inertia) / inertia[:, None]


def _inertial_rate(drift: DriftSection, own: OwnMotion | None) -> Array:
    """Return the chaser's rate in space (3,), chaser axes: its own, and its orbit's about z of the Hill frame."""
    own = OwnMotion.of(drift) if own is None else own
    return own.omega_hill_chaser_in_chaser_rad_s + own.R_hill_chaser.T @ np.array([0.0, 0.0, drift.orbit_rate_rad_s])


def _free_rotation_slopes(F: Array, motion: Motion, dt_s: float, drift: DriftSection, own: OwnMotion | None) -> None:
    """Put into a transition how attitude and rate follow each other to first order in ``dt_s``."""
    R, omega = motion.R_chaser_target, motion.omega_chaser_target_in_target_rad_s
    J, own_rate = np.array(drift.target_inertia), _inertial_rate(drift, own)
    inertial = omega + R.T @ own_rate
    middle = inertial + dt_s / 2 * _euler(inertial, J)
    R_later, _ = free_rotation(R, omega, dt_s, drift, own)
    half = np.eye(3) + dt_s / 2 * _euler_slopes(inertial, J)
    spin = np.eye(3) + dt_s * _euler_slopes(middle, J) @ half
    turn_rad = (middle - exp_so3(-omega * dt_s / 2) @ R.T @ own_rate) * dt_s
    F[ATTITUDE, ATTITUDE] = exp_so3(-turn_rad)
    F[ATTITUDE, RATE] = dt_s * right_jacobian_so3(turn_rad) @ half
    own_before, own_later = skew(R.T @ own_rate), skew(R_later.T @ own_rate)
    F[RATE, ATTITUDE] = spin @ own_before - own_later @ F[ATTITUDE, ATTITUDE]
    F[RATE, RATE] = spin - own_later @ F[ATTITUDE, RATE]


def lasting_push(dt_s: float, correlation_s: float) -> tuple[float, float, float]:
    """Return what ``dt_s`` seconds leave of an acceleration, and what it adds to speed (s) and way (s2), for a unit."""
    fade = dt_s / correlation_s
    gone = -np.expm1(-fade)
    way = fade - gone if fade > SHORT else fade**2 * (1 / 2 - fade / 6 + fade**2 / 24)
    return float(1 - gone), float(correlation_s * gone), float(correlation_s**2 * way)


def process_noise(dt_s: float, noise: FilterSection) -> Array:
    """Return the covariance (21, 21) that ``dt_s`` seconds of accelerations add which were not there before.

    The integral of R. A. Singer, 1970, eq. 11, by Gauss-Legendre: exact to 1e-12 up to a correlation time.
    """
    return _process_noise(dt_s, noise.correlation_s, noise.acceleration_m_s2, noise.angular_acceleration_rad_s2)


@lru_cache(maxsize=64)
def _process_noise(dt_s: float, correlation_s: float, acceleration: float, angular_acceleration: float) -> Array:
    """Return the same, shared and not to be written to: frames come at few different intervals."""
    ages_s, weights = dt_s / 2 * (1 + NODES), dt_s / 2 * WEIGHTS
    pushes = np.array([lasting_push(float(age_s), correlation_s)[::-1] for age_s in ages_s])
    added = 2 / correlation_s * (pushes.T * weights) @ pushes
    variances = np.repeat(np.square((acceleration, angular_acceleration)), 3)
    Q = np.zeros((STATES, STATES))
    for i, rows in enumerate(ORDERS):
        for j, columns in enumerate(ORDERS):
            Q[rows, columns] = added[i, j] * variances
    Q.setflags(write=False)
    return Q


def right_jacobian_so3(theta_rad: Array) -> Array:
    """Return J (3, 3) with Exp(theta + d) = Exp(theta) Exp(J d) for small d.

    Source: J. Sola et al., "A micro Lie theory for state estimation in robotics", 2018, eq. 143.
    """
    return _right_jacobian_so3(np.ascontiguousarray(theta_rad, dtype=float))


@compiled(VECTOR)
def _right_jacobian_so3(theta_rad: Array) -> Array:
    """Return I - a W + b W W of the skew matrix W, which is I - a W + b (theta theta' - angle^2 I)."""
    x, y, z = theta_rad
    angle2 = x * x + y * y + z * z
    angle = np.sqrt(angle2)
    a, b = 0.5, 1 / 6
    if angle >= SMALL_ANGLE_RAD:
        a, b = (1 - np.cos(angle)) / angle2, (angle - np.sin(angle)) / (angle2 * angle)
    J = b * np.outer(theta_rad, theta_rad)
    for i in range(3):
        J[i, i] += 1 - b * angle2
    J[0, 1] += a * z
    J[1, 0] -= a * z
    J[0, 2] -= a * y
    J[2, 0] += a * y
    J[1, 2] += a * x
    J[2, 1] -= a * x
    return J
