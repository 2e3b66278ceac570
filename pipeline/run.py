"""A recorded run as rows, one a frame: what was published, what is true, and how far apart they are.

Range is the distance from the camera to the nearest marker of the target's map, to the target's origin when
the map is empty: true range where truth is recorded, else the estimated one.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.Log_pb2 import Log
from numpy.typing import NDArray

from astratag.camera import Camera
from astratag.transforms import difference, inverse, transform
from pipeline.convert import NS_PER_S, camera_from_calibration, pose_matrix, vector_array
from pipeline.mission import Mission
from pipeline.recording import Recording
from schemas import Detections, Envelope, Mode, RelativeState, Truth
from schemas.topics import FRAME

Array = NDArray[np.float64]
POSE_DOF = 6
STATE_DOF = 12
POSITION = slice(0, 3)
ATTITUDE = slice(3, 6)
SCORED_MODES = (Mode.TRACK, Mode.COAST)
"""Modes whose states claim to be right, and are held to it."""


@dataclass(frozen=True, eq=False)
class Row:
    """What a run says about one frame; None where nothing was recorded or there is no state.

    ``error`` (12,) is truth minus estimate in the tangent of the state's ``covariance`` (12, 12): translation (m)
    and rotation (rad) of T_chaser_target perturbed on the right, velocity (m/s) and rate (rad/s).
    """

    sequence: int
    t_s: float
    """Since the run's first capture."""
    detections: Detections | None
    state: RelativeState | None
    truth: Truth | None
    latency_s: float | None
    """From the frame's start in the pipeline to the recorder's receipt of its state."""
    range_m: float | None
    error: Array | None
    covariance: Array | None

    @property
    def scored(self) -> bool:
        """Tell whether this row's state claims to be right and truth can judge it."""
        return self.error is not None and self.state is not None and self.state.mode in SCORED_MODES

    @property
    def position_error_m(self) -> float | None:
        """Distance between the true and the estimated target origin."""
        return None if self.error is None else float(np.linalg.norm(self.error[POSITION]))

    @property
    def attitude_error_rad(self) -> float | None:
        """Angle between the true and the estimated attitude."""
        return None if self.error is None else float(np.linalg.norm(self.error[ATTITUDE]))

    @property
    def covariance_valid(self) -> bool | None:
        """Tell whether the covariance is positive definite, whatever the units; None when there is none."""
        if self.covariance is None:
            return None
        variances = np.diag(self.covariance)
        if not (variances > 0).all():
            return False
        scale = np.sqrt(variances)
        return bool(np.linalg.eigvalsh(self.covariance / np.outer(scale, scale))[0] > 0)

    def nees_per_dof(self, dof: int) -> float | None:
        """Return the normalised error squared of the first ``dof`` components, divided by ``dof``."""
        if self.error is None or not self.covariance_valid or np.isnan(self.error[:dof]).any():
            return None
        assert self.covariance is not None
        return float(self.error[:dof] @ np.linalg.solve(self.covariance[:dof, :dof], self.error[:dof])) / dof


@dataclass(frozen=True)
class Event:
    """One line of the run's log."""

    t_s: float
    level: str
    text: str


@dataclass(frozen=True, eq=False)
class Run:
    """A run: its mission, camera, a row for every frame in the order of capture, and its log."""

    mission: Mission
    camera: Camera | None
    rows: tuple[Row, ...]
    modes: tuple[tuple[float, Mode], ...]
    """Time (s since the first capture) and mode of every state published, coasting between frames included."""
    events: tuple[Event, ...]
    wall_s: float

    @property
    def has_truth(self) -> bool:
        """Tell whether truth was recorded for any frame."""
        return any(row.truth is not None for row in self.rows)


@dataclass
class _Parts:
    """What a recording holds, by the frame it belongs to."""

    t_capture_ns: dict[int, int] = field(default_factory=dict)
    entered_ns: dict[int, int] = field(default_factory=dict)
    detections: dict[int, Detections] = field(default_factory=dict)
    states: dict[int, tuple[RelativeState, int]] = field(default_factory=dict)
    truths: dict[int, Truth] = field(default_factory=dict)
    """By time of capture, like ``modes``."""
    modes: dict[int, Mode] = field(default_factory=dict)
    logs: list[Log] = field(default_factory=list)
    calibration: CameraCalibration | None = None
    received_ns: list[int] = field(default_factory=list)

    def take(self, envelope: Envelope, t_log_ns: int) -> None:
        """File one envelope.  The first message of a kind counts for a frame: later ones are coasting ticks."""
        sequence = envelope.stamp.sequence
        if envelope.topic.per_frame:
            self.t_capture_ns.setdefault(sequence, envelope.stamp.t_capture_ns)
            self.received_ns.append(t_log_ns)
        if envelope.topic is FRAME:
            self.entered_ns.setdefault(sequence, t_log_ns)
            return
        message = envelope.message()
        if isinstance(message, Detections):
            self.detections.setdefault(sequence, message)
        elif isinstance(message, RelativeState):
            self.states.setdefault(sequence, (message, t_log_ns))
            self.modes[message.t_capture_ns] = message.mode
        elif isinstance(message, Truth):
            self.truths.setdefault(message.t_capture_ns, message)
        elif isinstance(message, Log):
            self.logs.append(message)
        elif isinstance(message, CameraCalibration):
            self.calibration = message


def load_run(path: str | Path) -> Run:
    """Read a recorded run.  Raises RecordingError (a ValueError) when it is not a readable recording."""
    recording = Recording(path)
    return gather_run(recording.mission, recording.envelopes())


def gather_run(mission: Mission, received: Iterable[tuple[Envelope, int]]) -> Run:
    """Return the run that envelopes, each with its time of receipt (UTC ns), make up."""
    parts = _Parts()
    for envelope, t_log_ns in received:
        parts.take(envelope, t_log_ns)
    start_ns = min(parts.t_capture_ns.values(), default=0)
    return Run(
        mission=mission,
        camera=None if parts.calibration is None else camera_from_calibration(parts.calibration),
        rows=tuple(_row(sequence, parts, mission, start_ns) for sequence in sorted(parts.t_capture_ns)),
        modes=tuple(sorted(((t_ns - start_ns) / NS_PER_S, mode) for t_ns, mode in parts.modes.items())),
        events=tuple(_event(log, start_ns) for log in parts.logs),
        wall_s=(max(parts.received_ns) - min(parts.received_ns)) / NS_PER_S if parts.received_ns else 0.0,
    )


def _event(log: Log, start_ns: int) -> Event:
    t_s = (log.timestamp.ToNanoseconds() - start_ns) / NS_PER_S
    return Event(t_s=t_s, level=Log.Level.Name(log.level).lower(), text=log.message)


def _row(sequence: int, parts: _Parts, mission: Mission, start_ns: int) -> Row:
    t_capture_ns = parts.t_capture_ns[sequence]
    state, t_state_ns = parts.states.get(sequence, (None, 0))
    truth = parts.truths.get(t_capture_ns)
    entered_ns = parts.entered_ns.get(sequence)
    covariance = None
    if state is not None and state.covariance is not None:
        covariance = np.array(state.covariance).reshape(STATE_DOF, STATE_DOF)
    best = truth.T_chaser_target if truth is not None else state.T_chaser_target if state is not None else None
    return Row(
        sequence=sequence,
        t_s=(t_capture_ns - start_ns) / NS_PER_S,
        detections=parts.detections.get(sequence),
        state=state,
        truth=truth,
        latency_s=None if state is None or entered_ns is None else (t_state_ns - entered_ns) / NS_PER_S,
        range_m=None if best is None else marker_range_m(pose_matrix(best), mission),
        error=None if state is None or truth is None else state_error(truth, state),
        covariance=covariance,
    )


def state_error(truth: Truth, state: RelativeState) -> Array | None:
    """Return truth minus estimate (12,), as in ``Row.error``; None without a pose, or when it is of another time."""
    if state.T_chaser_target is None or state.t_capture_ns != truth.t_capture_ns:
        return None
    pose_error = difference(pose_matrix(truth.T_chaser_target), pose_matrix(state.T_chaser_target))
    if state.v_chaser_target_m_s is None or state.omega_chaser_target_in_target_rad_s is None:
        return np.concatenate([pose_error, np.full(STATE_DOF - POSE_DOF, np.nan)])
    v_error = vector_array(truth.v_chaser_target_m_s) - vector_array(state.v_chaser_target_m_s)
    omega_error = vector_array(truth.omega_chaser_target_in_target_rad_s) - vector_array(
        state.omega_chaser_target_in_target_rad_s
    )
    return np.concatenate([pose_error, v_error, omega_error])


def marker_range_m(T_chaser_target: Array, mission: Mission) -> float:
    """Return the distance from the camera to the nearest marker of the map, or to the target's origin."""
    T_cam_target = inverse(mission.camera.T_chaser_cam.matrix()) @ T_chaser_target
    origins = [marker.T_target_marker.translation_m for marker in mission.markers] or [(0.0, 0.0, 0.0)]
    return float(np.linalg.norm(transform(T_cam_target, np.array(origins)), axis=1).min())
