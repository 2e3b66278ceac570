"""What ``relnav dock`` flies: orbit, spacecraft, camera, light, faults, guidance and safety, in one file.

Written as YAML or JSON; every field has a default that works.  Without a file: a V-bar approach from 20 m to a port
whose marker of 0.5 m is looked at by a camera inside the chaser's port.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from pydantic import Field, model_validator

from pipeline.mission import (
    CameraSection,
    CorridorSection,
    FilterSection,
    MarkerSection,
    Mission,
    PoseSection,
    Section,
    read_sections,
)
from pipeline.sim_camera import LightSection, SensorSection, SimCameraSection

MU_EARTH_M3_S2 = 3.986004418e14
EARTH_RADIUS_M = 6_378_136.6


class OrbitSection(Section):
    """The target's circular orbit."""

    altitude_m: float = Field(default=400e3, gt=0)
    inclination_rad: float = 0.9

    @property
    def radius_m(self) -> float:
        """Return its radius."""
        return EARTH_RADIUS_M + self.altitude_m

    @property
    def rate_rad_s(self) -> float:
        """Return the mean motion."""
        return float(np.sqrt(MU_EARTH_M3_S2 / self.radius_m**3))


class BodySection(Section):
    """A rigid spacecraft; its frame's origin is its centre of mass."""

    mass_kg: float = Field(default=500.0, gt=0)
    inertia_kg_m2: tuple[float, float, float] = (120.0, 150.0, 150.0)


class ChaserSection(BodySection):
    """The chaser and what moves it, and how well it knows its own attitude."""

    force_max_n: float = Field(default=20.0, gt=0)
    """Along each body axis."""
    torque_max_n_m: float = Field(default=2.0, gt=0)
    force_scale_sigma: float = Field(default=0.02, ge=0)
    """Of the force that comes over what was asked for, constant in a run, for each axis."""
    attitude_bias_sigma_rad: float = Field(default=3e-4, ge=0)
    """Of the star tracker against the camera's mounting, constant in a run, for each axis."""
    attitude_noise_rad: float = Field(default=1e-4, ge=0)
    rate_noise_rad_s: float = Field(default=2e-5, ge=0)


class TargetSection(BodySection):
    """The target: it turns with its Hill frame, up to what is drawn for a run."""

    mass_kg: float = Field(default=5000.0, gt=0)
    inertia_kg_m2: tuple[float, float, float] = (20000.0, 20000.0, 20000.0)
    R_hill_target_wxyz: tuple[float, float, float, float] = (0.5, -0.5, 0.5, 0.5)
    """Port axis (z) along the velocity."""
    attitude_sigma_rad: float = Field(default=0.015, ge=0)
    rate_sigma_rad_s: float = Field(default=3e-5, ge=0)


class StartSection(Section):
    """Where the flight begins, port to port, and how well the chaser knows that."""

    axial_m: float = Field(default=20.0, gt=0)
    position_sigma_m: float = Field(default=0.3, ge=0)
    velocity_sigma_m_s: float = Field(default=0.005, ge=0)
    attitude_sigma_rad: float = Field(default=0.01, ge=0)
    known_position_sigma_m: float = Field(default=0.3, gt=0)
    known_velocity_sigma_m_s: float = Field(default=0.01, gt=0)


class BlindSection(Section):
    """From when the ports are first nearer than ``below_m``, the sun shines into the lens."""

    below_m: float = Field(gt=0)
    duration_s: float | None = Field(default=None, gt=0)
    """None: for good."""


class FaultSection(Section):
    """What goes wrong."""

    drop_share: float = Field(default=0.02, ge=0, lt=1)
    """Of frames that the camera never delivers."""
    blind: BlindSection | None = None


class GuidanceSection(Section):
    """How the chaser flies down the corridor, from hold point to hold point."""

    cruise_speed_m_s: float = Field(default=0.15, gt=0)
    contact_speed_m_s: float = Field(default=0.07, gt=0)
    braking_m_s2: float = Field(default=0.003, gt=0)
    hold_s: float = Field(default=10.0, ge=0)
    """At each hold point of the corridor."""
    arrival_m: float = Field(default=0.1, gt=0)
    """A hold point is reached when nearer than this."""
    position_gain_hz: float = Field(default=0.1, gt=0)
    """Speed towards a place for each metre that it is away."""
    lateral_speed_max_m_s: float = Field(default=0.03, gt=0)
    velocity_deadband_m_s: float = Field(default=0.003, gt=0)
    """No thrust below this velocity error along an axis; once begun, thrust goes on to a quarter of it."""
    response_s: float = Field(default=2.0, gt=0)
    """Time in which a velocity error is taken out."""
    attitude_bandwidth_rad_s: float = Field(default=0.12, gt=0)


class SafetySection(Section):
    """When the navigation is believed, and what is done when it is not."""

    coast_limit_s: float = Field(default=1.5, gt=0)
    """Longest flight towards the target without a measurement."""
    confirm_s: float = Field(default=1.0, ge=0)
    """Measurements without a gap before an approach begins or goes on."""
    acquire_limit_s: float = Field(default=60.0, gt=0)
    hold_limit_s: float = Field(default=8.0, gt=0)
    """Longest hold without measurements before the retreat."""
    retreat_speed_m_s: float = Field(default=0.10, gt=0)
    retreat_m: float = Field(default=5.0, gt=0)
    """A retreat ends at least so far out, at a hold point if there is one."""
    position_sigma_limit_share: float = Field(default=0.05, gt=0)
    """Of the range: a state less certain is not flown on."""
    position_sigma_limit_m: float = Field(default=0.05, gt=0)
    """However near."""
    commit_m: float = Field(default=0.15, ge=0)
    """Nearer than this the chaser can no longer stop, and goes on to contact on what it knows."""
    settled_s: float = Field(default=20.0, ge=0)
    """The run ends when a retreat has been over for so long."""


FORWARD = (0.5, 0.5, 0.5, 0.5)
"""Camera and port look along the chaser's x axis; their x is the chaser's y."""

DOCK_MISSION = Mission(
    camera=CameraSection(T_chaser_cam=PoseSection(translation_m=(0.6, 0.0, 0.0), rotation_wxyz=FORWARD)),
    markers=(MarkerSection(id=7, side_m=0.5, T_target_marker=PoseSection(translation_m=(0.0, 0.0, 0.9))),),
    T_chaser_port=PoseSection(translation_m=(1.0, 0.0, 0.0), rotation_wxyz=FORWARD),
    T_target_port=PoseSection(translation_m=(0.0, 0.0, 1.0)),
    corridor=CorridorSection(start_m=20.0, port_radius_m=0.2, hold_points_m=(8.0, 2.0), keep_out_radius_m=10.0),
    filter=FilterSection(
        acceleration_m_s2=0.002,
        angular_acceleration_rad_s2=0.0003,
        edge_bias_px=0.06,
        corner_floor_px=0.03,
        one_tilt_rad=float(np.deg2rad(20)),
    ),
)
"""Camera and marker lie back in their ports, so that the marker's inner layers stay in view: 0.5 m apart at contact.

From 20 m its tilt is hardly seen: the autopilot needs the place, and a covariance that stands for both tilts.  The
chaser tells its thrust, of which a few per cent are not known; the rest is what an orbit bends a straight way by."""


class DockScenario(Section):
    """One docking, from its start to contact or to a safe hold; the same seed gives the same run."""

    mission: Mission = DOCK_MISSION
    orbit: OrbitSection = OrbitSection()
    chaser: ChaserSection = ChaserSection()
    target: TargetSection = TargetSection()
    start: StartSection = StartSection()
    camera: SimCameraSection = SimCameraSection(rate_hz=5.0)
    light: LightSection = LightSection()
    sensor: SensorSection = SensorSection()
    faults: FaultSection = FaultSection()
    guidance: GuidanceSection = GuidanceSection()
    safety: SafetySection = SafetySection()
    dynamics_step_s: float = Field(default=0.05, gt=0)
    duration_max_s: float = Field(default=900.0, gt=0)
    seed: int = Field(default=0, ge=0)

    @model_validator(mode="after")
    def _flies(self) -> DockScenario:
        steps = 1 / (self.camera.rate_hz * self.dynamics_step_s)
        if abs(steps - round(steps)) > 1e-9 or steps < 1:
            raise ValueError(f"a frame must last a whole number of dynamics steps, not {steps:g}")
        if not self.mission.markers:
            raise ValueError("the mission must map at least one marker: the simulated camera draws those")
        return self

    @classmethod
    def load(cls, path: str | Path) -> DockScenario:
        """Read a scenario file.  Raises ValueError when it cannot be read or is not valid."""
        return read_sections(cls, path, what="scenario")

    def to_json(self) -> str:
        """Return what the scenario says as JSON, which ``load`` reads back unchanged."""
        return json.dumps(self.model_dump(mode="json"), indent=2) + "\n"
