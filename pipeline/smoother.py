"""The relative state as all frames tell it, those that came later too: truth-like trajectories of recorded runs.

Source: H. E. Rauch, F. Tung, C. T. Striebel, "Maximum likelihood estimates of linear dynamic systems", 1965, on the
error state.  The frames' layers, gates and modes are those of the filter that ran.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from astratag.transforms import inverse
from pipeline.convert import (
    camera_from_calibration,
    points_array,
    pose_matrix,
    pose_message,
    vector_array,
    vector_message,
)
from pipeline.corner_filter import CornerFilter
from pipeline.corners import Eye, SeenLayer
from pipeline.corridor import port_to_port
from pipeline.dynamics import Motion
from pipeline.mission import MarkerSection, Mission
from pipeline.own_motion import OwnMotions
from pipeline.pose_filter import corners_on_target
from pipeline.recording import Recording, RecordingWriter
from schemas import Detections, Envelope, Mode, RelativeState
from schemas.topics import CHASER_MOTION, DETECTIONS, STATE, TRANSFORMS

Array = NDArray[np.float64]
SMOOTHED_MODES = (Mode.TRACK, Mode.COAST)


class FullFilter(CornerFilter):
    """A filter that estimates all it can: what a calibration leaves open is seen better from a whole run."""

    considered = slice(0, 0)
    forgets = False


@dataclass(frozen=True, eq=False)
class Passed:
    """What the forward pass knew at one frame: before and after its corners, and how it came there."""

    t_ns: int
    F: Array
    predicted: FullFilter
    after: FullFilter


def smooth(
    frames: Sequence[tuple[RelativeState, Sequence[SeenLayer]]],
    eye: Eye,
    mission: Mission,
    own: OwnMotions | None = None,
) -> Iterator[RelativeState]:
    """Yield the smoothed states of frames that follow each other, the last first.

    Each frame has the state that the filter made of it and the layers that it used; ``own`` is what the chaser told of
    its own motion.
    """
    passed = _forward(frames, eye, mission, OwnMotions(mission.filter.drift) if own is None else own)
    later: FullFilter | None = None
    for k in range(len(frames) - 1, -1, -1):
        now = passed[k].after
        if later is not None:
            ahead, P_ahead, P = passed[k + 1], passed[k + 1].predicted.covariance, now.covariance
            known = np.flatnonzero(np.diag(P_ahead) > 0)
            C = np.zeros_like(P)
            across = ahead.F @ P
            C[:, known] = np.linalg.solve(P_ahead[np.ix_(known, known)], across[known]).T
            P = P + C @ (later.covariance - P_ahead) @ C.T
            now = now.moved(C @ ahead.predicted.error_of(later), (P + P.T) / 2)
        later = now
        yield _told(frames[k][0], now, mission)


def _forward(
    frames: Sequence[tuple[RelativeState, Sequence[SeenLayer]]], eye: Eye, mission: Mission, own: OwnMotions
) -> list[Passed]:
    first = frames[0][0]
    assert first.T_chaser_target is not None
    T_chaser_target = pose_matrix(first.T_chaser_target)
    range_m = float(np.linalg.norm((eye.T_cam_chaser @ T_chaser_target)[:3, 3]))
    filter_ = FullFilter.start(T_chaser_target, range_m, mission.filter)
    if first.covariance is not None and first.v_chaser_target_m_s and first.omega_chaser_target_in_target_rad_s:
        filter_.motion = Motion(
            T_chaser_target[:3, 3],
            T_chaser_target[:3, :3],
            vector_array(first.v_chaser_target_m_s),
            vector_array(first.omega_chaser_target_in_target_rad_s),
        )
    filter_.know([layer for _, layers in frames for layer in layers])
    passed: list[Passed] = []
    for state, layers in frames:
        t_ns = state.t_capture_ns
        F = np.eye(len(filter_.covariance))
        for stretch in own.stretches(passed[-1].t_ns, t_ns) if passed else ():
            F = filter_.transition(stretch.dt_s, stretch.own) @ F
            filter_.predict(stretch.dt_s, stretch.own)
            if stretch.own is not None and stretch.then is not None:
                filter_.motion = filter_.motion.observed_from(stretch.own, stretch.then)
        predicted = filter_.copy()
        if layers:
            filter_.update(layers, eye)
        passed.append(Passed(t_ns, F, predicted, filter_.copy()))
    return passed


def _told(state: RelativeState, smoothed: CornerFilter, mission: Mission) -> RelativeState:
    motion = smoothed.motion
    T, v, omega = (
        motion.pose_chaser_target(),
        motion.v_chaser_target_m_s,
        motion.omega_chaser_target_in_target_rad_s,
    )
    return state.model_copy(
        update={
            "T_chaser_target": pose_message(T),
            "v_chaser_target_m_s": vector_message(v),
            "omega_chaser_target_in_target_rad_s": vector_message(omega),
            "covariance": smoothed.message_covariance().ravel().tolist(),
            "nis": None,
            "nis_dof": 0,
            "port": port_to_port(mission, T, v, omega),
        }
    )


def write_smoothed(path: str | Path, out: str | Path) -> int:
    """Write a recorded run again with smoothed states; return how many.

    States outside TRACK and COAST, and those between frames, are left out.  Raises ValueError when nothing can be
    smoothed.
    """
    recording = Recording(path)
    if recording.calibration is None:
        raise ValueError(f"{path} has no calibration: nothing to smooth with")
    smoothed = {state.t_capture_ns: state for state in _smoothed(recording)}
    if not smoothed:
        raise ValueError(f"{path} holds no states in TRACK: replay it first")
    with RecordingWriter(out, recording.mission) as writer:
        for envelope, t_receipt_ns in recording.envelopes():
            if envelope.topic is STATE:
                told = envelope.message()
                assert isinstance(told, RelativeState)
                state = smoothed.get(told.t_capture_ns)
                if state is not None and envelope.stamp.t_capture_ns == state.t_capture_ns:
                    camera = recording.mission.camera.name
                    again = Envelope.wrap(state, envelope.stamp, vehicle=recording.mission.vehicle, camera=camera)
                    writer.write(again, t_receipt_ns)
            elif envelope.topic is not TRANSFORMS:
                writer.write(envelope, t_receipt_ns)
    return len(smoothed)


def _smoothed(recording: Recording) -> Iterator[RelativeState]:
    """Yield the smoothed states of all stretches of a run that the filter followed without a break."""
    assert recording.calibration is not None
    mission = recording.mission
    eye = Eye(camera_from_calibration(recording.calibration), inverse(mission.camera.T_chaser_cam.matrix()))
    seen = {message.t_capture_ns: message for message in recording.messages(DETECTIONS)}
    own = OwnMotions(mission.filter.drift, kept=None)
    for told in recording.messages(CHASER_MOTION):
        own.take(told)
    stretch: list[tuple[RelativeState, list[SeenLayer]]] = []
    for state in recording.messages(STATE):
        message = seen.get(state.t_capture_ns)
        if message is None or (stretch and state.t_capture_ns <= stretch[-1][0].t_capture_ns):
            continue  # between frames, or told again after a late one
        if state.mode in SMOOTHED_MODES and state.T_chaser_target is not None:
            stretch.append((state, list(_used(state, message, mission))))
            continue
        if stretch:
            yield from smooth(stretch, eye, mission, own)
        stretch = []
    if stretch:
        yield from smooth(stretch, eye, mission, own)


def _used(state: RelativeState, message: Detections, mission: Mission) -> Iterator[SeenLayer]:
    """Yield the layers of a frame that the filter used."""
    used = set(zip(state.marker_ids, state.layers, strict=True))
    for detection in message.detections:
        marker = mission.marker(detection.marker_id) or MarkerSection(
            id=detection.marker_id, side_m=mission.default_side_m
        )
        for layer in detection.layers:
            if (marker.id, layer.layer) in used:
                sigma_px = max(layer.sigma_px, mission.filter.corner_floor_px)
                points = corners_on_target(marker, layer.layer)
                yield SeenLayer(marker.id, layer.layer, points_array(layer.corners_px), sigma_px, points)
