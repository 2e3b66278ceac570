"""How the target moves past the chaser between two pictures, and how an error in that motion grows.

The nominal motion lives outside the filter; the error state is, in this order, position (m, chaser axes), attitude
(rad, right perturbation in target axes), velocity (m/s, chaser axes), rate (rad/s, target axes), and the bias of the
marker's edges (px, outward).  Drift is at constant velocity and constant rate, driven by white accelerations.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from astratag.transforms import exp_so3, log_so3, pose, skew
from pipeline.mission import FilterSection

Array = NDArray[np.float64]

POSITION, ATTITUDE, VELOCITY, RATE = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12)
MOTION = slice(0, 12)
EDGE_BIAS = 12
STATES = 13

SMALL_ANGLE_RAD = 1e-4
"""Below it, the series of the right Jacobian to second order is exact to 1e-13."""


@dataclass(frozen=True, eq=False)
class Motion:
    """The nominal relative motion, and the bias of the marker's edges beside it."""

    p_chaser_target_m: Array
    R_chaser_target: Array
    v_chaser_target_m_s: Array
    omega_chaser_target_in_target_rad_s: Array
    edge_bias_px: float = 0.0

    @classmethod
    def at_rest(cls, T_chaser_target: Array) -> Motion:
        """Return a target that stands still at a pose."""
        return cls(T_chaser_target[:3, 3].copy(), T_chaser_target[:3, :3].copy(), np.zeros(3), np.zeros(3))

    def pose_chaser_target(self) -> Array:
        """Return T_chaser_target (4, 4)."""
        return pose(self.R_chaser_target, self.p_chaser_target_m)

    def moved(self, error: Array) -> Motion:
        """Return this motion with an error state (13,) put in."""
        return Motion(
            self.p_chaser_target_m + error[POSITION],
            self.R_chaser_target @ exp_so3(error[ATTITUDE]),
            self.v_chaser_target_m_s + error[VELOCITY],
            self.omega_chaser_target_in_target_rad_s + error[RATE],
            self.edge_bias_px + float(error[EDGE_BIAS]),
        )

    def error_of(self, other: Motion) -> Array:
        """Return the error state (13,) with ``self.moved(error)`` equal to ``other``."""
        return np.concatenate(
            [
                other.p_chaser_target_m - self.p_chaser_target_m,
                log_so3(self.R_chaser_target.T @ other.R_chaser_target),
                other.v_chaser_target_m_s - self.v_chaser_target_m_s,
                other.omega_chaser_target_in_target_rad_s - self.omega_chaser_target_in_target_rad_s,
                [other.edge_bias_px - self.edge_bias_px],
            ]
        )

    def after(self, dt_s: float, noise: FilterSection) -> Motion:
        """Return the motion ``dt_s`` seconds later."""
        return replace(
            self,
            p_chaser_target_m=self.p_chaser_target_m + self.v_chaser_target_m_s * dt_s,
            R_chaser_target=self.R_chaser_target @ exp_so3(self.omega_chaser_target_in_target_rad_s * dt_s),
            edge_bias_px=self.edge_bias_px * float(np.exp(-dt_s / noise.edge_bias_correlation_s)),
        )

    def transition(self, dt_s: float, noise: FilterSection) -> Array:
        """Return how an error state now becomes one ``dt_s`` later, (13, 13)."""
        turn_rad = self.omega_chaser_target_in_target_rad_s * dt_s
        F = np.eye(STATES)
        F[POSITION, VELOCITY] = dt_s * np.eye(3)
        F[ATTITUDE, ATTITUDE] = exp_so3(-turn_rad)
        F[ATTITUDE, RATE] = dt_s * right_jacobian_so3(turn_rad)
        F[EDGE_BIAS, EDGE_BIAS] = np.exp(-dt_s / noise.edge_bias_correlation_s)
        return F


def process_noise(dt_s: float, noise: FilterSection, unseen_s: float = 0.0) -> Array:
    """Return the covariance (13, 13) that ``dt_s`` seconds of white accelerations and of edge bias drift add.

    Measured often, accelerations are white over ``correlation_s``.  An acceleration that has not been seen for longer,
    ``unseen_s`` seconds, has acted all the while: speeds then grow uncertain with time, not with its square root.
    """
    Q = np.zeros((STATES, STATES))
    for place, speed, sigma in (
        (POSITION, VELOCITY, noise.acceleration_m_s2),
        (ATTITUDE, RATE, noise.angular_acceleration_rad_s2),
    ):
        density = sigma**2 * max(noise.correlation_s, unseen_s)
        Q[place, place] = density * dt_s**3 / 3 * np.eye(3)
        Q[place, speed] = Q[speed, place] = density * dt_s**2 / 2 * np.eye(3)
        Q[speed, speed] = density * dt_s * np.eye(3)
    Q[EDGE_BIAS, EDGE_BIAS] = -(noise.edge_bias_px**2) * np.expm1(-2 * dt_s / noise.edge_bias_correlation_s)
    return Q


def right_jacobian_so3(theta_rad: Array) -> Array:
    """Return J (3, 3) with Exp(theta + d) = Exp(theta) Exp(J d) for small d.

    Source: J. Sola et al., "A micro Lie theory for state estimation in robotics", 2018, eq. 143.
    """
    angle = float(np.linalg.norm(theta_rad))
    W = skew(theta_rad)
    if angle < SMALL_ANGLE_RAD:
        return np.eye(3) - W / 2 + W @ W / 6
    return np.eye(3) - (1 - np.cos(angle)) / angle**2 * W + (angle - np.sin(angle)) / angle**3 * (W @ W)
