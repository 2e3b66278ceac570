"""The messages of our own, as pydantic models: the single source from which the protobuf is derived.

``number`` pins a field's protobuf number for ever: a field may be added with a new number, never renumbered
and never reused.  Frames, units and conventions are in the package docstring.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field

PROTO_PACKAGE = "relnav"


def number(n: int, **kwargs: Any) -> Any:
    """Return a model field with protobuf number ``n``."""
    return Field(json_schema_extra={"number": n}, **kwargs)


class Message(BaseModel):
    """Base of all messages: immutable, closed, and never NaN or infinite."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Mode(IntEnum):
    """What the relative state is worth."""

    INIT = 0
    """No marker seen yet: there is no state."""
    AMBIGUOUS = 1
    """Two poses explain what is seen: do not fly on it."""
    TRACK = 2
    COAST = 3
    """Propagated without measurements."""
    LOST = 4
    """Coasted too long: the state is not to be used."""


class Point2(Message):
    """An image point."""

    x_px: float = number(1)
    y_px: float = number(2)


class Vector3(Message):
    """Three components in the unit of the field that holds them."""

    x: float = number(1)
    y: float = number(2)
    z: float = number(3)


class Quaternion(Message):
    """A unit quaternion, w first."""

    w: float = number(1)
    x: float = number(2)
    y: float = number(3)
    z: float = number(4)


class Pose(Message):
    """A rigid transform; the field that holds it names both frames."""

    translation_m: Vector3 = number(1)
    rotation_wxyz: Quaternion = number(2)


Corners = Annotated[list[Point2], Field(min_length=4, max_length=4)]
Covariance6 = Annotated[list[float], Field(min_length=36, max_length=36)]
Covariance12 = Annotated[list[float], Field(min_length=144, max_length=144)]


class LayerCorners(Message):
    """One black square of a marker, measured."""

    layer: int = number(1, ge=0, le=2)
    corners_px: Corners = number(2)
    sigma_px: float = number(3, gt=0)
    """Standard deviation of each corner coordinate."""


class PlanarPose(Message):
    """One of the two poses that explain a planar marker."""

    T_cam_marker: Pose = number(1)
    reprojection_rms_px: float = number(2, ge=0)


class WarpGrid(Message):
    """The print's regular grid as it lies in the image, row-major from the top left."""

    rows: int = number(1, gt=0)
    columns: int = number(2, gt=0)
    points_px: list[Point2] = number(3)


class Detection(Message):
    """One marker in one frame."""

    family: str = number(1)
    marker_id: int = number(2, ge=0)
    corners_px: Corners = number(3)
    """The outer black square; predicted when only inner layers are seen."""
    layers: list[LayerCorners] = number(4)
    correlation: float = number(5)
    hamming: int = number(6, ge=0)
    method: str = number(7)
    planar_poses: list[PlanarPose] = number(8, default=[])
    T_cam_marker: Pose | None = number(9, default=None)
    covariance: Covariance6 | None = number(10, default=None)
    reprojection_rms_px: float | None = number(11, default=None)
    warp_grid: WarpGrid | None = number(12, default=None)


class Detections(Message):
    """All markers of one frame; published for every frame, empty ones too."""

    t_capture_ns: int = number(1)
    camera: str = number(2)
    width_px: int = number(3)
    height_px: int = number(4)
    detections: list[Detection] = number(5)


class PortToPort(Message):
    """The chaser's docking port as seen from the target's, and where that is in the approach corridor."""

    range_m: float = number(1)
    axial_m: float = number(2)
    """Along the target port's outward axis."""
    lateral_m: float = number(3)
    closing_speed_m_s: float = number(4)
    """Positive when the range shrinks."""
    lateral_speed_m_s: float = number(5)
    misalignment_rad: float = number(6)
    """Angle between the two port axes, 0 when they face each other."""
    roll_rad: float = number(7)
    """Turn of the chaser port about the common axis."""
    corridor_angle_rad: float = number(8)
    """Angle of the line of sight off the target port's axis."""
    in_corridor: bool = number(9)
    in_keep_out_sphere: bool = number(10, default=False)
    hold_point_m: float | None = number(11, default=None)
    """Axial distance of the next hold point ahead; absent when there is none."""
    in_docking_box: bool = number(12, default=False)
    """Contact now would be within the docking box."""
    axial_closing_speed_m_s: float = number(13, default=0.0)
    """Along the target port's axis, positive when closing."""


class RelativeState(Message):
    """The filtered relative state of the target with respect to the chaser."""

    t_capture_ns: int = number(1)
    """Time of validity."""
    mode: Mode = number(2)
    T_chaser_target: Pose | None = number(3, default=None)
    """Absent in INIT and LOST, like everything that depends on it."""
    v_chaser_target_m_s: Vector3 | None = number(4, default=None)
    """Velocity of the target's origin in chaser axes, as the chaser's body frame sees it."""
    omega_chaser_target_in_target_rad_s: Vector3 | None = number(5, default=None)
    covariance: Covariance12 | None = number(6, default=None)
    nis: float | None = number(7, default=None)
    """Normalised innovation squared of this update, with its degrees of freedom."""
    nis_dof: int = number(8, default=0)
    age_s: float | None = number(9, default=None)
    """Since the last accepted measurement."""
    hypothesis_probability: float = number(10, default=1.0)
    marker_ids: list[int] = number(11, default=[])
    """Markers used in this update; ``layers`` names the layer of each."""
    layers: list[int] = number(12, default=[])
    rejections: list[str] = number(13, default=[])
    """Why measurements of this frame were refused."""
    port: PortToPort | None = number(14, default=None)


class Truth(Message):
    """What a simulator or a motion-capture system says the relative state is."""

    t_capture_ns: int = number(1)
    T_chaser_target: Pose = number(2)
    v_chaser_target_m_s: Vector3 = number(3)
    omega_chaser_target_in_target_rad_s: Vector3 = number(4)


class ChaserMotion(Message):
    """What the chaser knows of its own motion: it holds from its time on until the next one."""

    t_capture_ns: int = number(1)
    rotation_hill_chaser_wxyz: Quaternion | None = number(2, default=None)
    """Its attitude in the Hill frame; absent: the mission's."""
    omega_hill_chaser_in_chaser_rad_s: Vector3 = number(3)
    acceleration_chaser_m_s2: Vector3 = number(4)
    """By its thrusters, chaser axes."""


class Phase(IntEnum):
    """What the chaser's guidance is doing."""

    ACQUIRE = 0
    """Waiting for a state to fly on."""
    APPROACH = 1
    HOLD_POINT = 2
    """Waiting at a hold point of the corridor, as planned."""
    HOLD = 3
    """Standing still because the state is not to be flown on."""
    RETREAT = 4
    SAFE = 5
    """Standing still after a retreat."""
    CONTACT = 6


class Guidance(Message):
    """What the chaser's guidance knows and commands; the command holds until the next one."""

    t_capture_ns: int = number(1)
    phase: Phase = number(2)
    reason: str = number(3)
    """For being in this phase."""
    navigation_age_s: float | None = number(4, default=None)
    """Since the last state that was flown on."""
    position_sigma_m: float = number(5)
    p_targetport_chaserport_m: Vector3 = number(6)
    v_targetport_chaserport_m_s: Vector3 = number(7)
    force_chaser_n: Vector3 = number(8)
    torque_chaser_n_m: Vector3 = number(9)
    delta_v_m_s: float = number(10)
    """Spent since the start, as it was delivered."""


class NodeHealth(Message):
    """A process about itself, once a second."""

    t_publish_ns: int = number(1)
    node: str = number(2)
    pid: int = number(3)
    uptime_s: float = number(4)
    cpu_s: float = number(5)
    received: int = number(6)
    published: int = number(7)
    dropped: int = number(8)
    """Frames that never reached this node, by their sequence numbers."""
    refused: int = number(9)
    """Messages that could not be decoded or handled."""
    latency_s: float | None = number(10, default=None)
    """From the frame's start in the pipeline to this node's last answer."""
    note: str = number(11, default="")
