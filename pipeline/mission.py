"""The mission: vehicle, camera mounting, the target's marker map, ports, corridor and filter, in one file.

Written as YAML or JSON by people, carried as the attachment ``mission.json`` in every recording, and read by
every node.  Frames and units as in ``schemas``; every field has a default that works.
"""

from __future__ import annotations

import itertools
import json
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
import yaml
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from astratag.surface import Cylinder, Flat
from astratag.transforms import pose, rotation_from_wxyz

ATTACHMENT = "mission.json"
"""The name under which a recording carries its mission."""


class Section(BaseModel):
    """Base of all sections: closed, immutable, finite."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


S = TypeVar("S", bound=Section)


def parse_sections(kind: type[S], text: str | bytes, *, source: str) -> S:
    """Read sections from YAML or JSON text.  Raises ValueError that names the source and the field."""
    try:
        data: Any = yaml.safe_load(text)
        return kind.model_validate(data if data is not None else {})
    except yaml.YAMLError as error:
        raise ValueError(f"{source} is not YAML or JSON: {' '.join(str(error).split())}") from error
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"]) or "the file"
        raise ValueError(f"{source}: {where}: {first['msg']}") from error


def read_sections(kind: type[S], path: str | Path, *, what: str) -> S:
    """Read sections from a file.  Raises ValueError when it cannot be read or is not valid."""
    try:
        text = Path(path).read_text()
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"cannot read {what} {path}: {error}") from error
    return parse_sections(kind, text, source=f"{what} {path}")


class PoseSection(Section):
    """A rigid transform; the field that holds it names both frames."""

    translation_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rotation_wxyz: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)

    @model_validator(mode="after")
    def _unit(self) -> PoseSection:
        norm = float(np.linalg.norm(self.rotation_wxyz))
        if abs(norm - 1) > 1e-3:
            raise ValueError(f"rotation_wxyz must be a unit quaternion, its norm is {norm:.4g}")
        return self

    def matrix(self) -> NDArray[np.float64]:
        """Return the 4x4 transform, which is shared and cannot be written to."""
        return _matrix(self.translation_m, self.rotation_wxyz)


@lru_cache(maxsize=1024)
def _matrix(translation_m: tuple[float, ...], rotation_wxyz: tuple[float, ...]) -> NDArray[np.float64]:
    """Return a transform; every frame asks for those of the mission."""
    T = pose(rotation_from_wxyz(rotation_wxyz), translation_m)
    T.setflags(write=False)
    return T


class FlatSection(Section):
    """A flat surface."""

    kind: Literal["flat"] = "flat"

    def surface(self) -> Flat:
        """Return the marker library's surface."""
        return Flat()


class CylinderSection(Section):
    """The outside of a cylinder; ``axis_rad`` is its axis in the marker's plane, from x towards y."""

    kind: Literal["cylinder"] = "cylinder"
    radius_m: float = Field(gt=0)
    axis_rad: float = 0.0

    def surface(self) -> Cylinder:
        """Return the marker library's surface."""
        return Cylinder(self.radius_m, self.axis_rad)


class MarkerSection(Section):
    """One marker on the target."""

    id: int = Field(ge=0)
    side_m: float = Field(default=0.1, gt=0)
    surface: Annotated[FlatSection | CylinderSection, Field(discriminator="kind")] = FlatSection()
    T_target_marker: PoseSection = PoseSection()


class CameraSection(Section):
    """The camera and where it sits on the chaser."""

    name: str = Field(default="nav", pattern=r"^[A-Za-z0-9_-]+$")
    T_chaser_cam: PoseSection = PoseSection()
    transfer: Literal["srgb", "linear"] = "srgb"
    """How pixel values follow light: edges are located in linear light."""


class DockingBoxSection(Section):
    """What the ports must keep to at contact.

    Source: International Docking System Standard, revision F, table of initial contact conditions.
    """

    closing_speed_m_s: tuple[float, float] = (0.05, 0.10)
    lateral_speed_m_s: float = Field(default=0.04, gt=0)
    angular_rate_rad_s: float = Field(default=float(np.deg2rad(0.20)), gt=0)
    lateral_m: float = Field(default=0.10, gt=0)
    angle_rad: float = Field(default=float(np.deg2rad(4.0)), gt=0)
    """Of pitch and yaw together, and of roll."""


class CorridorSection(Section):
    """The approach corridor: a cone about the target port's outward axis, with its apex behind the port."""

    half_angle_rad: float = Field(default=float(np.deg2rad(10.0)), gt=0, lt=np.pi / 2)
    start_m: float = Field(default=1.5, gt=0)
    stop_m: float = Field(default=0.0, ge=0)
    """Axial distances between which the corridor is drawn and flown."""
    port_radius_m: float = Field(default=0.02, ge=0)
    """Radius of the corridor at the port itself."""
    hold_points_m: tuple[Annotated[float, Field(gt=0)], ...] = ()
    """Axial distances at which an approach waits for a go, farthest first."""
    keep_out_radius_m: float = Field(default=200.0, ge=0)
    """Sphere about the target's origin that is entered through the corridor only; the space station's by default."""
    docking_box: DockingBoxSection = DockingBoxSection()

    @model_validator(mode="after")
    def _in_order(self) -> CorridorSection:
        if any(near >= far for far, near in itertools.pairwise(self.hold_points_m)):
            raise ValueError(f"hold_points_m must come farthest first, got {list(self.hold_points_m)}")
        if self.stop_m >= self.start_m:
            raise ValueError(f"stop_m {self.stop_m} must be nearer than start_m {self.start_m}")
        return self


class DriftSection(Section):
    """How the target moves past the chaser when nothing is known of accelerations."""

    translation: Literal["constant_velocity", "clohessy_wiltshire"] = "constant_velocity"
    orbit_rate_rad_s: float = Field(default=0.0, ge=0)
    """Of a circular orbit, for Clohessy-Wiltshire."""
    R_hill_chaser_wxyz: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    """The chaser's attitude in the Hill frame of ``schemas``, which it keeps unless it tells otherwise."""
    attitude: Literal["constant_rate", "rigid_body"] = "constant_rate"
    target_inertia: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Principal moments about the target's axes, in any unit, for a rigid body that turns freely."""

    @model_validator(mode="after")
    def _means_something(self) -> DriftSection:
        if self.translation == "clohessy_wiltshire" and self.orbit_rate_rad_s == 0:
            raise ValueError("clohessy_wiltshire needs an orbit_rate_rad_s, such as 0.00113 in low Earth orbit")
        if min(self.target_inertia) <= 0:
            raise ValueError(f"target_inertia must be positive, got {list(self.target_inertia)}")
        norm = float(np.linalg.norm(self.R_hill_chaser_wxyz))
        if abs(norm - 1) > 1e-3:
            raise ValueError(f"R_hill_chaser_wxyz must be a unit quaternion, its norm is {norm:.4g}")
        return self


class FilterSection(Section):
    """The pose filter's noise, gates and timers."""

    drift: DriftSection = DriftSection()

    acceleration_m_s2: float = Field(default=0.003, gt=0)
    """Standard deviation of the relative acceleration, along each axis: slow approaches without burns."""
    angular_acceleration_rad_s2: float = Field(default=0.01, gt=0)
    correlation_s: float = Field(default=8.0, gt=0)
    """How long both last: braking, swaying and tumbling do for a good part of their period."""
    edge_bias_px: float = Field(default=0.006, ge=0)
    """How far the edges of a black square may be measured outside or inside their place, all four by the same."""
    edge_bias_shared: float = Field(default=0.5, ge=0, lt=1)
    """Of that variance, what is the same for all black squares: blur and exposure are of the whole picture."""
    edge_bias_correlation_s: float = Field(default=10.0, gt=0)
    one_edge_bias_px: float = Field(default=0.003, ge=0)
    """How far each edge may be outside by itself for long: repeated looks do not find that out."""
    edge_turn_px: float = Field(default=0.002, ge=0)
    """How far the end of each edge may be outside for long, and its beginning inside."""
    one_edge_bias_correlation_s: float = Field(default=2.0, gt=0)
    lasting_sigma_px: float = Field(default=0.006, ge=0)
    """How much of the sigma that a detector gives is of such errors, and not new in each picture."""
    edge_end_correlation: float = Field(default=-0.5, gt=-1, lt=1)
    """Of what a line fitted along an edge is off at its two ends, where corners are; 0: corners are not where lines
    meet, and each of their coordinates is off by itself."""
    corner_floor_px: float = Field(default=0.004, gt=0)
    """No corner is believed better than this."""
    scale_sigma: float = Field(default=2e-4, ge=0)
    """How far the focal length, as a share of itself, may be off, or the marker's size: constant, considered."""
    image_shift_px: float = Field(default=0.0, ge=0)
    """How far all pictures may be shifted alike, by a principal point that is off: constant, considered."""
    picture_shift_px: float = Field(default=0.001, ge=0)
    """How far a whole picture may be shifted: more where the camera shakes or stamps are late."""
    initial_speed_m_s: float = Field(default=0.2, gt=0)
    initial_rate_rad_s: float = Field(default=0.2, gt=0)
    gate_probability: float = Field(default=0.999999999, gt=0.5, lt=1)
    """Share of true measurements that a gate lets through: layers whose sigma is half too small must pass it too."""
    ambiguity_ratio: float = Field(default=1e4, gt=1)
    """How many times likelier one of two poses must become before the other is dropped."""
    one_tilt_rad: float = Field(default=float(np.deg2rad(2.0)), ge=0)
    """Two poses turned by less against each other are published as one that covers both."""
    reset_after_frames: int = Field(default=5, gt=0)
    """Frames refused in a row, all measurements or the stamp, that make the filter start again."""
    history_s: float = Field(default=1.0, ge=0)
    """A frame that comes later than others by up to this is taken at its own time, and they again after it."""
    output_rate_hz: float | None = Field(default=None, gt=0, le=1000)
    """Live: propagated states at this rate between frames; None: ten a second, once frames stay away.  A replay gives a
    state a frame, whatever this says: ticks are of a clock, and what it gives must repeat to the byte."""
    coast_s: float = Field(default=5.0, gt=0)
    """Longest propagation without measurements before LOST."""


class Mission(Section):
    """Everything the nodes must agree on."""

    vehicle: str = Field(default="chaser", pattern=r"^[A-Za-z0-9_-]+$")
    camera: CameraSection = CameraSection()
    dictionary: str = "astratag20"
    default_side_m: float = Field(default=0.1, gt=0)
    """Side of a marker when the map is empty."""
    markers: tuple[MarkerSection, ...] = ()
    """Empty: the first marker seen, flat and of the default side, is the target frame."""
    T_chaser_port: PoseSection = PoseSection()
    T_target_port: PoseSection = PoseSection()
    corridor: CorridorSection = CorridorSection()
    filter: FilterSection = FilterSection()

    @model_validator(mode="after")
    def _distinct(self) -> Mission:
        ids = [marker.id for marker in self.markers]
        if len(set(ids)) != len(ids):
            raise ValueError(f"markers lists an id twice: {ids}")
        return self

    @classmethod
    def parse(cls, text: str | bytes, *, source: str) -> Mission:
        """Read a mission from YAML or JSON text.  Raises ValueError that names the source and the field."""
        return parse_sections(cls, text, source=f"mission {source}")

    @classmethod
    def load(cls, path: str | Path) -> Mission:
        """Read a mission file.  Raises ValueError when it cannot be read or is not valid."""
        return read_sections(cls, path, what="mission")

    def to_json(self) -> str:
        """Return what the mission says as indented JSON, which ``parse`` reads back unchanged.

        Sections it leaves to the defaults stay so: a recording follows the tuning of the version that replays it.
        """
        return json.dumps(self.model_dump(mode="json", include=self.model_fields_set), indent=2) + "\n"

    def marker(self, marker_id: int) -> MarkerSection | None:
        """Return a marker of the map, or None when it is not on the target."""
        return next((marker for marker in self.markers if marker.id == marker_id), None)
