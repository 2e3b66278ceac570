"""What a closed loop needs of a simulator: two spacecraft that fly, and where they are.

Hill frame: x radial outward, y along-track, z along the orbit normal, about the target.  Rates of bodies are relative
to the Hill frame or to each other as named, never inertial.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from astratag.transforms import pose
from pipeline.scenario import RelativeMotion

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Departure:
    """How a flight begins."""

    r_hill_m: Array
    """Chaser from target."""
    v_hill_m_s: Array
    """As seen in the turning Hill frame."""
    R_hill_chaser: Array
    R_hill_target: Array
    omega_hill_target_rad_s: Array
    """Of the target, in target axes."""


@dataclass(frozen=True, eq=False)
class Flight:
    """Where both spacecraft are at an instant."""

    relative: RelativeMotion
    """Of the target in the chaser's frame."""
    R_hill_chaser: Array
    omega_hill_chaser_in_chaser_rad_s: Array
    R_hill_target: Array
    r_hill_m: Array
    v_hill_m_s: Array

    @classmethod
    def from_inertial(
        cls,
        *,
        r_target: Array,
        v_target: Array,
        R_inertial_target: Array,
        omega_target: Array,
        r_chaser: Array,
        v_chaser: Array,
        R_inertial_chaser: Array,
        omega_chaser: Array,
    ) -> Flight:
        """Return the flight of two bodies: positions and velocities in inertial axes, rates in body axes."""
        R_hill_inertial = hill_from_inertial(r_target, v_target)
        omega_hill = np.cross(r_target, v_target) / (r_target @ r_target)
        R_chaser_inertial = R_inertial_chaser.T
        r, v = r_chaser - r_target, v_chaser - v_target
        in_chaser = R_chaser_inertial @ -r
        R_chaser_target = R_chaser_inertial @ R_inertial_target
        return cls(
            relative=RelativeMotion(
                pose(R_chaser_target, in_chaser),
                R_chaser_inertial @ -v - np.cross(omega_chaser, in_chaser),
                omega_target - R_chaser_target.T @ omega_chaser,
            ),
            R_hill_chaser=R_hill_inertial @ R_inertial_chaser,
            omega_hill_chaser_in_chaser_rad_s=omega_chaser - R_chaser_inertial @ omega_hill,
            R_hill_target=R_hill_inertial @ R_inertial_target,
            r_hill_m=R_hill_inertial @ r,
            v_hill_m_s=R_hill_inertial @ (v - np.cross(omega_hill, r)),
        )


def hill_from_inertial(r: Array, v: Array) -> Array:
    """Return R_hill_inertial (3, 3) at a position and velocity in inertial axes."""
    radial, normal = r / np.linalg.norm(r), np.cross(r, v) / np.linalg.norm(np.cross(r, v))
    return np.stack([radial, np.cross(normal, radial), normal])


class Plant(Protocol):
    """A simulator that flies the chaser and the target."""

    def advance(self, t_ns: int, force_chaser_n: Array, torque_chaser_n_m: Array) -> None:
        """Fly to ``t_ns`` after the start under a constant force and torque, chaser axes."""
        ...

    def flight(self) -> Flight:
        """Return where both are now."""
        ...
