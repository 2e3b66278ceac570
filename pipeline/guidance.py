"""Flying the corridor: from what is known to force and torque, from hold point to hold point, and away when in doubt.

Axial is along the target port's axis outward, lateral across it; both of the chaser's port from the target's.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from astratag.transforms import log_so3
from pipeline.bridge import Navigation
from pipeline.convert import NS_PER_S
from pipeline.dock_scenario import ChaserSection, GuidanceSection, SafetySection
from pipeline.mission import Mission
from schemas import Phase

Array = NDArray[np.float64]

PORTS_FACING = np.diag([1.0, -1.0, -1.0])
"""R_targetport_chaserport when docked."""
DEADBAND_RELEASE = 0.25
CORRIDOR_SHARE = 0.7
"""Share of the corridor's radius beyond which the chaser centres itself before it goes on."""
RETREATED_M = 0.3
DAMPING = 0.8


@dataclass(frozen=True, eq=False)
class Place:
    """Where the chaser's port is from the target's, in the target port's axes, and which way that is in Hill axes."""

    p_m: Array
    v_m_s: Array
    R_hill_port: Array

    @property
    def axial_m(self) -> float:
        """Return the distance along the port's axis."""
        return float(self.p_m[2])

    @property
    def lateral_m(self) -> float:
        """Return the distance from the port's axis."""
        return float(np.hypot(self.p_m[0], self.p_m[1]))


@dataclass(frozen=True, eq=False)
class Command:
    """What the chaser is told to do, and why."""

    phase: Phase
    reason: str
    acceleration_hill_m_s2: Array
    force_chaser_n: Array
    torque_chaser_n_m: Array
    place: Place


class Autopilot:
    """Navigation in, commands out; its memory is the phase that it is in, and which thrusters are on."""

    def __init__(
        self, mission: Mission, chaser: ChaserSection, guidance: GuidanceSection, safety: SafetySection, t_ns: int
    ):
        self._mission, self._chaser, self._guidance, self._safety = mission, chaser, guidance, safety
        self._phase, self._since_ns, self._reason = Phase.ACQUIRE, t_ns, "waiting for a state"
        self._holds_m = list(mission.corridor.hold_points_m)
        self._anchor_m: Array | None = None
        """Where a hold is held, target port axes."""
        self._retreat_to_m = mission.corridor.start_m
        self._firing = np.zeros(3, bool)

    @property
    def phase(self) -> Phase:
        """Return what the chaser is doing."""
        return self._phase

    def phase_s(self, t_ns: int) -> float:
        """Return for how long it has been doing so."""
        return (t_ns - self._since_ns) / NS_PER_S

    def command(self, navigation: Navigation) -> Command:
        """Return what to do now."""
        place = self._place(navigation)
        self._decide(navigation, place)
        acceleration = self._thrust(place, self._wanted_velocity(place))
        R_hill_chaser = navigation.own.R_hill_chaser
        force = self._chaser.mass_kg * R_hill_chaser.T @ acceleration
        force = np.clip(force, -self._chaser.force_max_n, self._chaser.force_max_n)
        return Command(
            self._phase,
            self._reason,
            R_hill_chaser @ force / self._chaser.mass_kg,
            force,
            self._torque(navigation),
            place,
        )

    def _place(self, navigation: Navigation) -> Place:
        T_target_port, T_chaser_port = self._mission.T_target_port.matrix(), self._mission.T_chaser_port.matrix()
        R_hill_port = navigation.R_hill_target @ T_target_port[:3, :3]
        own = navigation.own
        port_hill = navigation.r_hill_m + own.R_hill_chaser @ T_chaser_port[:3, 3]
        p = R_hill_port.T @ (port_hill - navigation.R_hill_target @ T_target_port[:3, 3])
        return Place(p, R_hill_port.T @ navigation.v_hill_m_s, R_hill_port)

    def _decide(self, navigation: Navigation, place: Place) -> None:
        """Go to the next phase when it is time, or when the navigation is no longer worth flying on."""
        doubt = self._doubt(navigation, place)
        held_s = self.phase_s(navigation.t_ns)
        is_confirmed = not doubt and navigation.fresh_s >= self._safety.confirm_s

        def go(phase: Phase, reason: str) -> None:
            self._enter(phase, reason, navigation.t_ns, place)

        match self._phase:
            case Phase.ACQUIRE if is_confirmed:
                self._holds_m = [hold for hold in self._holds_m if hold < place.axial_m]
                go(Phase.APPROACH, "the state is confirmed")
            case Phase.ACQUIRE if held_s > self._safety.acquire_limit_s:
                go(Phase.RETREAT, f"no confirmed state for {held_s:.0f} s: {doubt}")
            case Phase.APPROACH | Phase.HOLD_POINT if doubt and place.axial_m > self._safety.commit_m:
                go(Phase.HOLD, doubt)
            case Phase.APPROACH if self._holds_m and place.axial_m < self._holds_m[0] + self._guidance.arrival_m:
                go(Phase.HOLD_POINT, f"hold point at {self._holds_m[0]:g} m")
            case Phase.HOLD_POINT if held_s >= self._guidance.hold_s and self._is_centred(place):
                self._holds_m.pop(0)
                go(Phase.APPROACH, "go")
            case Phase.HOLD if is_confirmed:
                go(Phase.APPROACH, "the state is confirmed again")
            case Phase.HOLD if held_s > self._safety.hold_limit_s:
                go(Phase.RETREAT, doubt or "the state does not come back for good")
            case Phase.RETREAT if place.axial_m > self._retreat_to_m - RETREATED_M:
                go(Phase.SAFE, "retreated")
            case Phase.SAFE if is_confirmed:
                go(Phase.APPROACH, "the state is confirmed again")

    def _doubt(self, navigation: Navigation, place: Place) -> str:
        """Return why the navigation is not worth flying towards the target on, or nothing."""
        safety = self._safety
        if navigation.age_s is None:
            return navigation.refused
        if navigation.age_s > safety.coast_limit_s:
            return f"{navigation.mode.name}: no measurement for {navigation.age_s:.1f} s"
        limit_m = max(
            safety.position_sigma_limit_m, safety.position_sigma_limit_share * float(np.linalg.norm(place.p_m))
        )
        if navigation.position_sigma_m > limit_m:
            return f"position known to {navigation.position_sigma_m:.2f} m only"
        return ""

    def _enter(self, phase: Phase, reason: str, t_ns: int, place: Place) -> None:
        if phase is Phase.RETREAT:
            safe_m = max(self._safety.retreat_m, place.axial_m)
            holds_m = self._mission.corridor.hold_points_m
            self._retreat_to_m = min((hold for hold in holds_m if hold >= safe_m), default=safe_m)
            self._holds_m = [hold for hold in holds_m if hold <= self._retreat_to_m + RETREATED_M]
        centre = np.array([0.0, 0.0, place.axial_m])
        if phase is Phase.HOLD_POINT:
            centre[2] = self._holds_m[0]
        elif phase is Phase.SAFE:
            centre[2] = self._retreat_to_m
        self._anchor_m = place.p_m.copy() if phase is Phase.HOLD else centre
        self._phase, self._since_ns, self._reason = phase, t_ns, reason

    def _is_centred(self, place: Place) -> bool:
        return place.lateral_m <= CORRIDOR_SHARE * self._corridor_radius_m(place)

    def _corridor_radius_m(self, place: Place) -> float:
        corridor = self._mission.corridor
        return corridor.port_radius_m + max(place.axial_m, 0.0) * float(np.tan(corridor.half_angle_rad))

    def _wanted_velocity(self, place: Place) -> Array:
        """Return the velocity that the chaser's port should have, target port axes."""
        guidance, gain = self._guidance, self._guidance.position_gain_hz
        if self._phase is Phase.ACQUIRE:
            return np.zeros(3)
        if self._phase in (Phase.HOLD, Phase.HOLD_POINT, Phase.SAFE):
            assert self._anchor_m is not None
            return limited(gain * (self._anchor_m - place.p_m), guidance.lateral_speed_max_m_s)
        lateral = limited(-gain * np.array([place.p_m[0], place.p_m[1], 0.0]), guidance.lateral_speed_max_m_s)
        if self._phase is Phase.RETREAT:
            return lateral + np.array([0.0, 0.0, self._safety.retreat_speed_m_s])
        return lateral - np.array([0.0, 0.0, self._closing_speed_m_s(place)])

    def _closing_speed_m_s(self, place: Place) -> float:
        """Return how fast to approach: braking evenly to the next hold point, or to the speed of contact."""
        guidance = self._guidance
        if not self._is_centred(place):
            return 0.0
        if self._holds_m:
            to_go_m = max(place.axial_m - self._holds_m[0], 0.0)
            braked_m_s = min(
                float(np.sqrt(2 * guidance.braking_m_s2 * to_go_m)), 2 * guidance.position_gain_hz * to_go_m
            )
            return min(guidance.cruise_speed_m_s, braked_m_s)
        contact_m_s = guidance.contact_speed_m_s
        braked_m_s = float(np.sqrt(contact_m_s**2 + 2 * guidance.braking_m_s2 * max(place.axial_m, 0.0)))
        return min(guidance.cruise_speed_m_s, braked_m_s)

    def _thrust(self, place: Place, wanted_m_s: Array) -> Array:
        """Return the acceleration, Hill axes, that takes out what is worth taking out of the velocity error."""
        error = wanted_m_s - place.v_m_s
        deadband = self._guidance.velocity_deadband_m_s
        self._firing = np.abs(error) > np.where(self._firing, DEADBAND_RELEASE, 1.0) * deadband
        return place.R_hill_port @ (np.where(self._firing, error, 0.0) / self._guidance.response_s)

    def _torque(self, navigation: Navigation) -> Array:
        """Return the torque, chaser axes, that turns the chaser's port to the target's and keeps it there."""
        own, bandwidth = navigation.own, self._guidance.attitude_bandwidth_rad_s
        R_hill_port = navigation.R_hill_target @ self._mission.T_target_port.matrix()[:3, :3]
        wanted = R_hill_port @ PORTS_FACING @ self._mission.T_chaser_port.matrix()[:3, :3].T
        error_rad = log_so3(wanted.T @ own.R_hill_chaser)
        turn = bandwidth**2 * error_rad + 2 * DAMPING * bandwidth * own.omega_hill_chaser_in_chaser_rad_s
        torque = -np.array(self._chaser.inertia_kg_m2) * turn
        return np.clip(torque, -self._chaser.torque_max_n_m, self._chaser.torque_max_n_m)


def limited(v: Array, most: float) -> Array:
    """Return a vector of the same direction that is no longer than ``most``."""
    length = float(np.linalg.norm(v))
    return v * min(1.0, most / length) if length > 0 else v


def is_over(phase: Phase) -> bool:
    """Tell whether a run ends in this phase."""
    return phase in (Phase.CONTACT, Phase.SAFE)
