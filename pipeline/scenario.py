"""Approach scenarios: the exact relative motion of a marker past a camera, analytic and smooth at every instant.

Frames and conventions are those of ``schemas``: velocities are of the child's origin in the parent's axes, as the
parent's body frame sees it; rates are in the child's axes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from astratag.transforms import exp_so3, inverse, pose
from pipeline.convert import NS_PER_S, pose_message, vector_message
from pipeline.dynamics import right_jacobian_so3
from pipeline.mission import Section
from schemas import Truth

Array = NDArray[np.float64]

FACING = np.diag([1.0, -1.0, -1.0])
"""R_cam_marker of a marker seen square-on and upright."""


@dataclass(frozen=True, eq=False)
class RelativeMotion:
    """Where b is in a and how it moves: a pose, a velocity in the axes of a, a rate in the axes of b."""

    T_a_b: Array
    v_a_b_m_s: Array
    omega_a_b_in_b_rad_s: Array

    def mounted(self, T_c_a: Array, T_b_d: Array) -> RelativeMotion:
        """Return the motion of d in c, where a is fixed to c and d to b."""
        R_c_a, R_d_b = T_c_a[:3, :3], T_b_d[:3, :3].T
        swing_in_b = np.cross(self.omega_a_b_in_b_rad_s, T_b_d[:3, 3])
        return RelativeMotion(
            T_c_a @ self.T_a_b @ T_b_d,
            R_c_a @ (self.v_a_b_m_s + self.T_a_b[:3, :3] @ swing_in_b),
            R_d_b @ self.omega_a_b_in_b_rad_s,
        )


class Approach(Section):
    """A braking approach along the camera's axis to a slowly tumbling marker.

    The range shrinks from ``start_m`` to ``end_m`` at constant deceleration; the line of sight sways by a fraction of
    the range and the marker's attitude swings about all three axes, each sinusoidally.
    """

    duration_s: float = Field(default=27.0, gt=0)
    start_m: float = Field(default=1.5, gt=0)
    end_m: float = Field(default=0.06, gt=0)
    end_speed_m_s: float = Field(default=0.012, ge=0)
    sway_rad: tuple[float, float] = (0.045, 0.03)
    """Amplitude of the line of sight off the camera's axis, to the right and down."""
    sway_period_s: tuple[float, float] = (19.0, 14.0)
    sway_phase_rad: tuple[float, float] = (0.6, 2.4)
    tilt_rad: tuple[float, float, float] = (0.10, -0.14, 0.06)
    """Mean attitude of the marker, as a rotation vector in its own axes from facing the camera upright."""
    tumble_rad: tuple[float, float, float] = (0.07, 0.09, 0.05)
    """Amplitude of the swing about it."""
    tumble_period_s: tuple[float, float, float] = (13.0, 17.0, 11.0)
    tumble_phase_rad: tuple[float, float, float] = (0.3, 1.7, 4.0)

    @model_validator(mode="after")
    def _slows_down(self) -> Approach:
        if self.end_speed_m_s * self.duration_s > self.start_m - self.end_m:
            raise ValueError(
                f"{self.start_m} m to {self.end_m} m in {self.duration_s} s is slower on average than end_speed_m_s "
                f"{self.end_speed_m_s}: the approach must brake; shorten duration_s or lower end_speed_m_s"
            )
        if min(*self.sway_period_s, *self.tumble_period_s) <= 0:
            raise ValueError("sway_period_s and tumble_period_s must be positive")
        return self

    def at(self, t_s: float) -> RelativeMotion:
        """Return the marker's motion in the camera frame ``t_s`` seconds after the start."""
        to_go_s = self.duration_s - t_s
        braking_m_s2 = 2 * (self.start_m - self.end_m - self.end_speed_m_s * self.duration_s) / self.duration_s**2
        range_m = self.end_m + self.end_speed_m_s * to_go_s + braking_m_s2 * to_go_s**2 / 2
        closing_m_s = self.end_speed_m_s + braking_m_s2 * to_go_s

        sway, sway_rate = _swing(self.sway_rad, self.sway_period_s, self.sway_phase_rad, t_s)
        p_cam = np.append(sway * range_m, range_m)
        v_cam = np.append(sway_rate * range_m - sway * closing_m_s, -closing_m_s)

        swing, swing_rate = _swing(self.tumble_rad, self.tumble_period_s, self.tumble_phase_rad, t_s)
        theta = np.array(self.tilt_rad) + swing
        return RelativeMotion(pose(FACING @ exp_so3(theta), p_cam), v_cam, right_jacobian_so3(theta) @ swing_rate)


def _swing(
    amplitude: tuple[float, ...], period_s: tuple[float, ...], phase_rad: tuple[float, ...], t_s: float
) -> tuple[Array, Array]:
    """Return sinusoids of time and their derivatives."""
    rate = 2 * np.pi / np.array(period_s)
    angle = rate * t_s + np.array(phase_rad)
    return np.array(amplitude) * np.sin(angle), np.array(amplitude) * rate * np.cos(angle)


def frame_stamps_ns(start_ns: int, frame_rate_hz: float, count: int) -> list[int]:
    """Return the mid-exposure of each frame, UTC nanoseconds: each rounded by itself, so that nothing accumulates."""
    return [start_ns + round(k * NS_PER_S / frame_rate_hz) for k in range(count)]


def truth_message(motion: RelativeMotion, *, T_chaser_cam: Array, T_target_marker: Array, t_capture_ns: int) -> Truth:
    """Return the truth about the target for a marker's motion in the camera frame."""
    target = motion.mounted(T_chaser_cam, inverse(T_target_marker))
    return Truth(
        t_capture_ns=t_capture_ns,
        T_chaser_target=pose_message(target.T_a_b),
        v_chaser_target_m_s=vector_message(target.v_a_b_m_s),
        omega_chaser_target_in_target_rad_s=vector_message(target.omega_a_b_in_b_rad_s),
    )
