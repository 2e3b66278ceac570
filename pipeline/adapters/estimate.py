"""A state message as arrays, and the rule of which states may be flown on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.convert import pose_matrix, vector_array
from schemas import Mode, RelativeState

Array = NDArray[np.float64]

POSITION, ROTATION, VELOCITY, RATE = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12)
POSE = slice(0, 6)
"""Where they are in the 12x12 covariance."""


@dataclass(frozen=True, eq=False)
class Estimate:
    """The numbers of a state; frames, units and the covariance's convention as in ``schemas``."""

    T_chaser_target: Array
    """(4, 4)"""
    v_chaser_target_m_s: Array
    omega_chaser_target_in_target_rad_s: Array
    covariance: Array
    """(12, 12), of the pose as a right perturbation in the target's axes."""

    @property
    def position_m(self) -> Array:
        """Return the target's origin (3,) in the chaser's axes."""
        return self.T_chaser_target[:3, 3]

    def fixed_axes_covariance(self) -> Array:
        """Return the covariance (12, 12) with position along, and rotation about, the chaser's axes.

        T = T_hat * (Exp(theta), rho) moves the origin by R rho and turns it by Exp(R theta) from the left, so both
        blocks are turned by R.  Velocity (chaser axes) and rate (target axes) stay as they are.
        """
        turn = np.eye(12)
        turn[POSITION, POSITION] = turn[ROTATION, ROTATION] = self.T_chaser_target[:3, :3]
        return turn @ self.covariance @ turn.T


def estimate_of(state: RelativeState) -> Estimate | None:
    """Return a state's numbers, whatever they are worth; None unless all are there."""
    v, omega = state.v_chaser_target_m_s, state.omega_chaser_target_in_target_rad_s
    if state.T_chaser_target is None or v is None or omega is None or state.covariance is None:
        return None
    covariance = np.array(state.covariance).reshape(12, 12)
    return Estimate(pose_matrix(state.T_chaser_target), vector_array(v), vector_array(omega), covariance)


def trusted_estimate(state: RelativeState) -> Estimate | None:
    """Return the numbers of a state that may be flown on: in TRACK, and complete.  None for any other."""
    return estimate_of(state) if state.mode == Mode.TRACK else None
