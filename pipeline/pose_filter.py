"""The pose filter's step: each frame's detections in, the relative state of the target out.

No clock, no socket, no file: time is the capture time of what comes in.  A frame that comes late is taken at its own
time, and the state of the newest one is published again.  A measurement that is not used is named in
the state's ``rejections``, as "kind: detail", the kinds being "calibration", "stamp", "map", "unknown marker",
"corners", "pose", "gate" and "update".
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.Log_pb2 import Log
from numpy.typing import NDArray

from astratag.geometry import layer_corners_print
from astratag.transforms import inverse, transform, wxyz_from_rotation
from pipeline.convert import (
    NS_PER_S,
    camera_from_calibration,
    points_array,
    pose_matrix,
    pose_message,
    vector_message,
)
from pipeline.corner_filter import Update, gate_limit
from pipeline.corners import CORNER_DOF, NEAREST_M, Eye, SeenLayer
from pipeline.corridor import port_to_port
from pipeline.history import History
from pipeline.hypotheses import HypothesisBank, guesses_in_chaser
from pipeline.map_check import MapCheck, Verdict
from pipeline.mission import MarkerSection, Mission
from pipeline.own_motion import OwnMotions
from schemas import ChaserMotion, Detection, Detections, Mode, RelativeState
from schemas.codec import AnyMessage

Array = NDArray[np.float64]

CHASER_FRAME, TARGET_FRAME = "chaser", "target"
NODE = "pose_filter"
FARTHEST_PX = 1e5
"""A corner farther from the image's origin, or less certain, than this is damaged."""
FARTHEST_M = 1e5
OVERDUE_PERIODS = 2.5
"""A measurement is overdue when it is older than so many usual periods between frames."""
PERIODS_KEPT = 9


@dataclass
class Frame:
    """What one frame, or one tick, did to the filter."""

    t_ns: int
    rejections: list[str] = field(default_factory=list)
    used: list[SeenLayer] = field(default_factory=list)
    update: Update | None = None
    events: list[Log] = field(default_factory=list)

    def log(self, level: Log.Level.ValueType, text: str) -> None:
        """Tell an event at the frame's capture time."""
        event = Log(level=level, message=text, name=NODE)
        event.timestamp.FromNanoseconds(self.t_ns)
        self.events.append(event)


@dataclass
class Track:
    """Everything about the target that a frame changes."""

    map: dict[int, MarkerSection]
    bank: HypothesisBank | None = None
    mode: Mode = Mode.INIT
    t_ns: int | None = None
    t_measured_ns: int | None = None
    refused_frames: int = 0
    """Frames in a row whose measurements were all refused."""

    def copy(self) -> Track:
        """Return a track of its own that is the same."""
        return replace(self, bank=None if self.bank is None else self.bank.copy())

    def age_s(self, t_ns: int) -> float | None:
        """Return how long before ``t_ns`` anything was measured; None when nothing ever was."""
        return None if self.t_measured_ns is None else max(t_ns - self.t_measured_ns, 0) / NS_PER_S


class PoseFilter:
    """Detections in, relative states out: an error-state Kalman filter on the corners of all layers of all markers."""

    def __init__(self, mission: Mission):
        self._mission = mission
        self._settings = mission.filter
        self._gate = gate_limit(mission.filter.gate_probability, CORNER_DOF)
        self._eye: Eye | None = None
        self._camera_frame = mission.camera.name
        self._points: dict[tuple[int, int], Array] = {}
        """Corners of each marker's layers on the target."""
        self._map_check = MapCheck(mission)
        self._track = Track(self._mapped())
        self._history: History[Detections, Track] = History(round(mission.filter.history_s * NS_PER_S))
        self._own = OwnMotions(mission.filter.drift)
        self._periods_ns: deque[int] = deque(maxlen=PERIODS_KEPT)
        self._update: Update | None = None
        self._late_frames = 0
        """Frames in a row stamped before all that is remembered."""

    @property
    def innovation(self) -> Array | None:
        """Return the last frame's innovation in its own standard deviations, None when nothing was used."""
        return None if self._update is None else self._update.whitened

    @property
    def tick_period_s(self) -> float | None:
        """Return the period at which a live run asks for propagated states; None: when frames stay away."""
        rate_hz = self._settings.output_rate_hz
        return None if rate_hz is None else 1 / rate_hz

    def step(self, message: AnyMessage) -> Iterable[AnyMessage]:
        """Take a calibration, or one frame's detections and return the state, its transforms and any events.

        Raises ValueError for a calibration that is not a camera we can use; any detections are answered.
        """
        if isinstance(message, CameraCalibration):
            self._eye = Eye(camera_from_calibration(message), inverse(self._mission.camera.T_chaser_cam.matrix()))
            self._camera_frame = message.frame_id or self._mission.camera.name
            return []
        if isinstance(message, ChaserMotion):
            self._own.take(message)
        if not isinstance(message, Detections):
            return []
        with np.errstate(all="ignore"):  # what overflows is refused where it shows
            return self._take(message)

    def refused(self, t_capture_ns: int) -> Iterable[AnyMessage]:
        """Return the state at a frame whose detections could not be read."""
        camera = self._mission.camera.name
        return self.step(Detections(t_capture_ns=t_capture_ns, camera=camera, width_px=0, height_px=0, detections=[]))

    def tick(self, t_ns: int) -> Iterable[AnyMessage]:
        """Return the state propagated to ``t_ns``; nothing when there is none.

        The mode is COAST once a frame is overdue.  The filter itself stays at its last frame, so that a frame on its
        way is not refused for its age.
        """
        track = self._track
        if track.bank is None or track.t_ns is None or t_ns <= track.t_ns:
            return []
        frame = Frame(t_ns)
        self._lose_when_old(track, frame)
        if track.bank is None:
            self._history.clear()
            return self._answer(track, frame, None)
        coasted = track.copy()
        self._predict(coasted, t_ns)
        age_s = track.age_s(t_ns)
        if age_s is None or age_s > self._overdue_s():
            self._settle_mode(track, frame)
        return self._answer(track, frame, coasted.bank)

    def _overdue_s(self) -> float:
        """Return the age from which on a measurement is overdue."""
        return OVERDUE_PERIODS * float(np.median(self._periods_ns)) / NS_PER_S if self._periods_ns else 0.0

    def _take(self, message: Detections) -> list[AnyMessage]:
        """Take one frame in, whenever it comes."""
        t_ns, last_ns = message.t_capture_ns, self._track.t_ns
        frame = Frame(t_ns)
        verdict = self._judged(message)
        if verdict.refused:
            frame.rejections += verdict.refused.values()
            kept = [seen for seen in message.detections if seen.marker_id not in verdict.refused]
            message = message.model_copy(update={"detections": kept})
        if last_ns is None or t_ns > last_ns:
            if last_ns is not None:
                self._periods_ns.append(t_ns - last_ns)
            self._late_frames = 0
            self._advance(message, frame)
        elif t_ns == last_ns or self._history.holds(t_ns):
            frame.t_ns = last_ns
            which = "the last frame's" if t_ns == last_ns else "that of a frame before"
            frame.rejections.append(f"stamp: the same as {which}")
        elif self._history.reaches(t_ns):
            self._take_late(message, frame, last_ns)
        elif not self._is_set_back(frame, last_ns):
            frame.t_ns = last_ns
        else:
            self._advance(message, frame)
        self._update = frame.update
        for text in verdict.events:
            frame.log(Log.WARNING, text)
        return self._answer(self._track, frame, self._track.bank)

    def _judged(self, message: Detections) -> Verdict:
        """Return which markers contradict the map, once for each frame that comes."""
        if self._eye is None or (message.width_px, message.height_px) != self._eye.size_px:
            return Verdict()
        return self._map_check.take(message, self._eye.camera)

    def _take_late(self, message: Detections, frame: Frame, last_ns: int) -> None:
        """Go back to before a late frame, take it, and then again all that had come since."""
        before = self._track.mode
        self._track, later = self._history.rewind(message.t_capture_ns)
        self._track = self._track.copy()
        self._advance(message, frame)
        for _, again in later:
            self._advance(again, Frame(again.t_capture_ns))
        frame.t_ns, frame.events = last_ns, []
        self._tell_mode(self._track, before, frame)

    def _is_set_back(self, frame: Frame, last_ns: int) -> bool:
        """Refuse a frame from before all that is remembered; True when so many came that the clock was set back."""
        self._late_frames += 1
        frame.rejections.append(f"stamp: {(last_ns - frame.t_ns) / NS_PER_S:.6f} s before the last frame's")
        if self._late_frames < self._settings.reset_after_frames:
            return False
        why = f"{self._late_frames} frames in a row from before the last one: the clock was set back"
        self._lose(self._track, frame, why)
        self._history.clear()
        self._track.t_ns, self._late_frames = None, 0
        self._periods_ns.clear()
        return True

    def _advance(self, message: Detections, frame: Frame) -> None:
        """Take in the frame that follows the track's last one, and remember it."""
        track = self._track
        if track.bank is not None:
            self._lose_when_old(track, frame)
        if track.bank is not None:
            self._predict(track, frame.t_ns)
        track.t_ns = frame.t_ns
        groups = self._usable_layers(track, message, frame)
        if track.bank is not None:
            self._follow(track, [layer for _, layers in groups for layer in layers], frame)
        if track.bank is None:
            self._acquire(track, groups, frame)
        if frame.used:
            track.t_measured_ns = frame.t_ns
        self._settle_mode(track, frame)
        self._history.append(frame.t_ns, message, track.copy())

    def _predict(self, track: Track, t_ns: int) -> None:
        """Propagate to ``t_ns``, by what the chaser did meanwhile if that is known."""
        assert track.bank is not None and track.t_ns is not None
        for stretch in self._own.stretches(track.t_ns, t_ns):
            track.bank.predict(stretch.dt_s, stretch.own)
            if stretch.own is not None and stretch.then is not None:
                track.bank.observe_from(stretch.own, stretch.then)

    def _usable_layers(
        self, track: Track, message: Detections, frame: Frame
    ) -> list[tuple[Detection, list[SeenLayer]]]:
        """Return the measured layers of each detection that is on the target."""
        if self._eye is None:
            if message.detections:
                frame.rejections.append("calibration: none yet")
            return []
        if (message.width_px, message.height_px) != self._eye.size_px:
            width, height = self._eye.size_px
            frame.rejections.append(
                f"calibration: for {width}x{height}, the frame is {message.width_px}x{message.height_px}"
            )
            return []
        groups = []
        for detection in message.detections:
            marker = self._marker(track, detection.marker_id)
            if marker is None:
                frame.rejections.append(f"unknown marker: {detection.marker_id} is not on the target")
                continue
            layers = []
            for seen in detection.layers:
                corners_px = points_array(seen.corners_px)
                if not (np.abs(corners_px).max() < FARTHEST_PX and 0 < seen.sigma_px < FARTHEST_PX):
                    frame.rejections.append(f"corners: marker {marker.id} layer {seen.layer} is out of bounds")
                    continue
                sigma_px = max(seen.sigma_px, self._settings.corner_floor_px)
                layers.append(SeenLayer(marker.id, seen.layer, corners_px, sigma_px, self._corners(marker, seen.layer)))
            if layers:
                groups.append((detection, layers))
        return groups

    def _marker(self, track: Track, marker_id: int) -> MarkerSection | None:
        """Return a marker of the target; without a map, any until the first is taken for the target."""
        if not track.map:
            return MarkerSection(id=marker_id, side_m=self._mission.default_side_m)
        return track.map.get(marker_id)

    def _corners(self, marker: MarkerSection, layer: int) -> Array:
        key = (marker.id, layer)
        if key not in self._points:
            self._points[key] = corners_on_target(marker, layer)
        return self._points[key]

    def _follow(self, track: Track, layers: list[SeenLayer], frame: Frame) -> None:
        """Update with the layers that pass the gate; start afresh when nothing has passed for too long."""
        if not layers or track.bank is None or self._eye is None:
            return
        distances = track.bank.gate(layers, self._eye)
        for layer, distance in zip(layers, distances, strict=True):
            if distance <= self._gate:
                frame.used.append(layer)
            else:
                frame.rejections.append(
                    f"gate: marker {layer.marker_id} layer {layer.layer}, {distance:.1f} > {self._gate:.1f}"
                )
        if frame.used:
            frame.update = track.bank.update(frame.used, self._eye)
            if frame.update is None:
                frame.rejections.append("update: the corners lead to no pose")
                frame.used = []
        track.refused_frames = 0 if frame.used else track.refused_frames + 1
        if track.refused_frames >= self._settings.reset_after_frames:
            self._lose(track, frame, f"all measurements of {track.refused_frames} frames in a row refused")

    def _acquire(self, track: Track, groups: list[tuple[Detection, list[SeenLayer]]], frame: Frame) -> None:
        """Start from the marker with the most layers, the largest of them."""
        if self._eye is None or not groups:
            return
        detection, layers = max(groups, key=lambda group: (len(group[1]), _extent_px(group[1][0].corners_px)))
        marker = self._marker(track, detection.marker_id)
        assert marker is not None
        poses = first_guesses(detection)
        if not poses:
            frame.rejections.append(f"pose: marker {marker.id} came without one to start from")
            return
        T_target_marker = marker.T_target_marker.matrix()
        guesses = guesses_in_chaser(poses, self._eye, inverse(T_target_marker))
        track.bank = HypothesisBank.start(guesses, layers, self._eye, self._settings, T_target_marker)
        if track.bank is None:
            frame.rejections.append(f"pose: none fits the corners of marker {marker.id}")
            return
        track.map = track.map or {marker.id: marker}
        track.refused_frames = 0
        frame.used = layers
        frame.log(
            Log.INFO,
            f"acquired marker {marker.id}, {np.linalg.norm(poses[0][:3, 3]):.3f} m from the camera, "
            f"{len(track.bank.filters)} possible {'pose' if len(track.bank.filters) == 1 else 'poses'}",
        )

    def _lose_when_old(self, track: Track, frame: Frame) -> None:
        """Drop the state when its last measurement is too long ago."""
        age_s = track.age_s(frame.t_ns)
        if age_s is not None and age_s > self._settings.coast_s:
            self._lose(track, frame, f"no measurement for {age_s:.2f} s")

    def _lose(self, track: Track, frame: Frame, why: str) -> None:
        track.bank = None
        track.map = self._mapped()
        track.refused_frames = 0
        if track.mode != Mode.INIT:
            track.mode = Mode.LOST
            frame.log(Log.ERROR, f"LOST: {why}")

    def _settle_mode(self, track: Track, frame: Frame) -> None:
        """Name what the state is worth now, and tell when that changed."""
        if track.bank is None:
            return
        before = track.mode
        if track.bank.is_ambiguous:
            track.mode = Mode.AMBIGUOUS
        else:
            track.mode = Mode.TRACK if frame.used else Mode.COAST
        self._tell_mode(track, before, frame)

    def _tell_mode(self, track: Track, before: Mode, frame: Frame) -> None:
        if track.mode == before or track.mode not in WHY:
            return
        level = Log.INFO if track.mode == Mode.TRACK else Log.WARNING
        frame.log(level, f"{track.mode.name}: {WHY[track.mode]} (was {before.name})")

    def _mapped(self) -> dict[int, MarkerSection]:
        return {marker.id: marker for marker in self._mission.markers}

    def _answer(self, track: Track, frame: Frame, bank: HypothesisBank | None) -> list[AnyMessage]:
        if bank is None:
            state = RelativeState(
                t_capture_ns=frame.t_ns,
                mode=track.mode,
                age_s=track.age_s(frame.t_ns),
                rejections=frame.rejections,
            )
            return [state, *frame.events]
        estimate = bank.estimate
        motion = estimate.motion
        T_chaser_target = motion.pose_chaser_target()
        v, omega = motion.v_chaser_target_m_s, motion.omega_chaser_target_in_target_rad_s
        state = RelativeState(
            t_capture_ns=frame.t_ns,
            mode=track.mode,
            T_chaser_target=pose_message(T_chaser_target),
            v_chaser_target_m_s=vector_message(v),
            omega_chaser_target_in_target_rad_s=vector_message(omega),
            covariance=estimate.message_covariance().ravel().tolist(),
            nis=None if frame.update is None else frame.update.nis,
            nis_dof=0 if frame.update is None else frame.update.dof,
            age_s=track.age_s(frame.t_ns),
            hypothesis_probability=bank.probability,
            marker_ids=[layer.marker_id for layer in frame.used],
            layers=[layer.layer for layer in frame.used],
            rejections=frame.rejections,
            port=port_to_port(self._mission, T_chaser_target, v, omega),
        )
        return [state, self._transforms(frame.t_ns, T_chaser_target), *frame.events]

    def _transforms(self, t_ns: int, T_chaser_target: Array) -> FrameTransforms:
        message = FrameTransforms()
        T_chaser_cam = self._mission.camera.T_chaser_cam.matrix()
        for child, T in ((TARGET_FRAME, T_chaser_target), (self._camera_frame, T_chaser_cam)):
            added = message.transforms.add(parent_frame_id=CHASER_FRAME, child_frame_id=child)
            added.timestamp.FromNanoseconds(t_ns)
            added.translation.x, added.translation.y, added.translation.z = T[:3, 3].tolist()
            w, x, y, z = wxyz_from_rotation(T[:3, :3]).tolist()
            added.rotation.w, added.rotation.x, added.rotation.y, added.rotation.z = w, x, y, z
        return message


WHY = {
    Mode.AMBIGUOUS: "two poses explain what is seen",
    Mode.TRACK: "one pose, measured",
    Mode.COAST: "no measurement, propagating",
}


def corners_on_target(marker: MarkerSection, layer: int) -> Array:
    """Return where the corners (4, 3) of a layer's black square are on the target, metres, target axes."""
    on_print = layer_corners_print(layer, marker.side_m)
    return transform(marker.T_target_marker.matrix(), marker.surface.surface().points(on_print))


def first_guesses(detection: Detection) -> list[Array]:
    """Return the poses T_cam_marker (4, 4) that came with a detection, the refined one first, damaged ones left out."""
    messages = [planar.T_cam_marker for planar in detection.planar_poses]
    if detection.T_cam_marker is not None:
        messages.insert(0, detection.T_cam_marker)
    guesses = []
    for message in messages:
        q, t = message.rotation_wxyz, message.translation_m
        if 0.5 < q.w**2 + q.x**2 + q.y**2 + q.z**2 < 2 and NEAREST_M < t.z < FARTHEST_M:
            guesses.append(pose_matrix(message))
    return guesses


def _extent_px(corners_px: Array) -> float:
    return float(np.ptp(corners_px, axis=0).max())
