"""A tiny plant for the tests of the closed loop: two bodies in straight lines, turning as their torques say."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from astratag.transforms import exp_so3, pose
from pipeline.convert import NS_PER_S
from pipeline.dock_scenario import DockScenario
from pipeline.plant import Departure, Flight
from pipeline.scenario import RelativeMotion


class FakePlant:
    """The chaser drifts in a Hill frame that stands still; the target does not turn."""

    def __init__(self, scenario: DockScenario, departure: Departure):
        self._mass_kg, self._inertia = scenario.chaser.mass_kg, np.array(scenario.chaser.inertia_kg_m2)
        self._r, self._v = departure.r_hill_m.copy(), departure.v_hill_m_s.copy()
        self._R, self._omega = departure.R_hill_chaser.copy(), np.zeros(3)
        self._R_hill_target, self._t_ns = departure.R_hill_target, 0

    def advance(self, t_ns: int, force_chaser_n: NDArray, torque_chaser_n_m: NDArray) -> None:
        dt_s, self._t_ns = (t_ns - self._t_ns) / NS_PER_S, t_ns
        acceleration = self._R @ force_chaser_n / self._mass_kg
        self._r = self._r + self._v * dt_s + acceleration * dt_s**2 / 2
        self._v = self._v + acceleration * dt_s
        self._omega = self._omega + torque_chaser_n_m / self._inertia * dt_s
        self._R = self._R @ exp_so3(self._omega * dt_s)

    def flight(self) -> Flight:
        R_chaser_target = self._R.T @ self._R_hill_target
        p = -self._R.T @ self._r
        return Flight(
            relative=RelativeMotion(
                pose(R_chaser_target, p),
                -self._R.T @ self._v - np.cross(self._omega, p),
                -R_chaser_target.T @ self._omega,
            ),
            R_hill_chaser=self._R,
            omega_hill_chaser_in_chaser_rad_s=self._omega,
            R_hill_target=self._R_hill_target,
            r_hill_m=self._r,
            v_hill_m_s=self._v,
        )
