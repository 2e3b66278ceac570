"""The pose filter's step: each frame's detections in, the relative state of the target out.

No clock, no socket, no file: time is the capture time of what comes in.  A measurement that is not used is named in
the state's ``rejections``, as "kind: detail", the kinds being "calibration", "stamp", "unknown marker", "corners",
"pose", "gate" and "update".
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.Log_pb2 import Log
from numpy.typing import NDArray

from astratag.geometry import layer_corners_print
from astratag.transforms import inverse, transform, wxyz_from_rotation
from pipeline.convert import NS_PER_S, camera_from_calibration, points_array, pose_matrix, pose_message, vector_message
from pipeline.corner_filter import CORNER_DOF, NEAREST_M, Eye, SeenLayer, Update, gate_limit
from pipeline.corridor import port_to_port
from pipeline.hypotheses import HypothesisBank, guesses_in_chaser
from pipeline.mission import MarkerSection, Mission
from schemas import Detection, Detections, Mode, RelativeState
from schemas.codec import AnyMessage

Array = NDArray[np.float64]

CHASER_FRAME, TARGET_FRAME = "chaser", "target"
NODE = "pose_filter"
FARTHEST_PX = 1e5
"""A corner farther from the image's origin, or less certain, than this is damaged."""
FARTHEST_M = 1e5


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


class PoseFilter:
    """Detections in, relative states out: an error-state Kalman filter on the corners of all layers of all markers."""

    def __init__(self, mission: Mission):
        self._mission = mission
        self._settings = mission.filter
        self._gate = gate_limit(mission.filter.gate_probability, CORNER_DOF)
        self._eye: Eye | None = None
        self._camera_frame = mission.camera.name
        self._map = {marker.id: marker for marker in mission.markers}
        self._bank: HypothesisBank | None = None
        self._mode = Mode.INIT
        self._t_ns: int | None = None
        self._t_measured_ns: int | None = None
        self._refused_frames = 0
        """Frames in a row whose measurements were all refused."""
        self._late_frames = 0
        """Frames in a row stamped before the last one taken."""

    def step(self, message: AnyMessage) -> Iterable[AnyMessage]:
        """Take a calibration, or one frame's detections and return the state, its transforms and any events.

        Raises ValueError for a calibration that is not a camera we can use; any detections are answered.
        """
        if isinstance(message, CameraCalibration):
            self._eye = Eye(camera_from_calibration(message), inverse(self._mission.camera.T_chaser_cam.matrix()))
            self._camera_frame = message.frame_id or self._mission.camera.name
            return []
        if not isinstance(message, Detections):
            return []
        with np.errstate(all="ignore"):  # what overflows is refused where it shows
            return self._frame(message)

    def refused(self, t_capture_ns: int) -> Iterable[AnyMessage]:
        """Return the state at a frame whose detections could not be read."""
        camera = self._mission.camera.name
        return self.step(Detections(t_capture_ns=t_capture_ns, camera=camera, width_px=0, height_px=0, detections=[]))

    def tick(self, t_ns: int) -> Iterable[AnyMessage]:
        """Return the state propagated to ``t_ns``, when no frame came for a while; nothing when there is none.

        The filter itself stays at its last frame, so that a frame on its way is not refused for its age.
        """
        if self._bank is None or self._t_ns is None or t_ns <= self._t_ns:
            return []
        frame = Frame(t_ns)
        self._lose_when_old(frame)
        coasted = self._bank
        if coasted is not None:
            coasted = coasted.copy()
            coasted.predict((t_ns - self._t_ns) / NS_PER_S, self._age_s(t_ns) or 0.0)
            self._settle_mode(frame)
        return self._answer(frame, coasted)

    def _frame(self, message: Detections) -> list[AnyMessage]:
        frame = Frame(message.t_capture_ns)
        if not self._take_stamp(frame):
            return self._answer(frame, self._bank)
        groups = self._usable_layers(message, frame)
        if self._bank is not None:
            self._track([layer for _, layers in groups for layer in layers], frame)
        if self._bank is None:
            self._acquire(groups, frame)
        if frame.used:
            self._t_measured_ns = frame.t_ns
        self._settle_mode(frame)
        return self._answer(frame, self._bank)

    def _take_stamp(self, frame: Frame) -> bool:
        """Bring the filter to the frame's time; False when that is not after the last one's."""
        if self._t_ns is not None and frame.t_ns <= self._t_ns:
            return self._refuse_stamp(frame, self._t_ns)
        if self._bank is not None and self._t_ns is not None:
            self._lose_when_old(frame)
            if self._bank is not None:
                self._bank.predict((frame.t_ns - self._t_ns) / NS_PER_S, self._age_s(frame.t_ns) or 0.0)
        self._t_ns = frame.t_ns
        self._late_frames = 0
        return True

    def _refuse_stamp(self, frame: Frame, last_ns: int) -> bool:
        """Refuse a frame that is not after the last one; True when so many came that the clock was set back."""
        if frame.t_ns == last_ns:
            frame.rejections.append("stamp: the same as the last frame's")
            return False
        self._late_frames += 1
        frame.rejections.append(f"stamp: {(last_ns - frame.t_ns) / NS_PER_S:.6f} s before the last frame's")
        if self._late_frames < self._settings.reset_after_frames:
            frame.t_ns = last_ns
            return False
        self._lose(frame, f"{self._late_frames} frames in a row from before the last one: the clock was set back")
        self._t_ns, self._late_frames = frame.t_ns, 0
        return True

    def _usable_layers(self, message: Detections, frame: Frame) -> list[tuple[Detection, list[SeenLayer]]]:
        """Return the measured layers of each detection that is on the target."""
        if self._eye is None:
            if message.detections:
                frame.rejections.append("calibration: none yet")
            return []
        camera = self._eye.camera
        if (message.width_px, message.height_px) != (camera.width, camera.height):
            frame.rejections.append(
                f"calibration: for {camera.width}x{camera.height}, the frame is {message.width_px}x{message.height_px}"
            )
            return []
        groups = []
        for detection in message.detections:
            marker = self._marker(detection.marker_id)
            if marker is None:
                frame.rejections.append(f"unknown marker: {detection.marker_id} is not on the target")
                continue
            layers = []
            for seen in detection.layers:
                corners_px = points_array(seen.corners_px)
                if np.abs(corners_px).max() > FARTHEST_PX or seen.sigma_px > FARTHEST_PX:
                    frame.rejections.append(f"corners: marker {marker.id} layer {seen.layer} is out of bounds")
                    continue
                sigma_px = max(seen.sigma_px, self._settings.corner_floor_px)
                points = corners_on_target(marker, seen.layer)
                layers.append(SeenLayer(marker.id, seen.layer, corners_px, sigma_px, points))
            if layers:
                groups.append((detection, layers))
        return groups

    def _marker(self, marker_id: int) -> MarkerSection | None:
        """Return a marker of the target; without a map, any until the first is taken for the target."""
        if not self._map:
            return MarkerSection(id=marker_id, side_m=self._mission.default_side_m)
        return self._map.get(marker_id)

    def _track(self, layers: list[SeenLayer], frame: Frame) -> None:
        """Update with the layers that pass the gate; start afresh when nothing has passed for too long."""
        if not layers or self._bank is None or self._eye is None:
            return
        distances = self._bank.gate(layers, self._eye)
        for layer, distance in zip(layers, distances, strict=True):
            if distance <= self._gate:
                frame.used.append(layer)
            else:
                frame.rejections.append(
                    f"gate: marker {layer.marker_id} layer {layer.layer}, {distance:.1f} > {self._gate:.1f}"
                )
        if frame.used:
            frame.update = self._bank.update(frame.used, self._eye)
            if frame.update is None:
                frame.rejections.append("update: the corners lead to no pose")
                frame.used = []
        self._refused_frames = 0 if frame.used else self._refused_frames + 1
        if self._refused_frames >= self._settings.reset_after_frames:
            self._lose(frame, f"all measurements of {self._refused_frames} frames in a row refused")

    def _acquire(self, groups: list[tuple[Detection, list[SeenLayer]]], frame: Frame) -> None:
        """Start from the marker with the most layers, the largest of them."""
        if self._eye is None or not groups:
            return
        detection, layers = max(groups, key=lambda group: (len(group[1]), _extent_px(group[1][0].corners_px)))
        marker = self._marker(detection.marker_id)
        assert marker is not None
        poses = first_guesses(detection)
        if not poses:
            frame.rejections.append(f"pose: marker {marker.id} came without one to start from")
            return
        T_target_marker = marker.T_target_marker.matrix()
        guesses = guesses_in_chaser(poses, self._eye, inverse(T_target_marker))
        self._bank = HypothesisBank.start(guesses, layers, self._eye, self._settings, T_target_marker)
        if self._bank is None:
            frame.rejections.append(f"pose: none fits the corners of marker {marker.id}")
            return
        self._map = self._map or {marker.id: marker}
        self._refused_frames = 0
        frame.used = layers
        frame.log(
            Log.INFO,
            f"acquired marker {marker.id}, {np.linalg.norm(poses[0][:3, 3]):.3f} m from the camera, "
            f"{len(self._bank.filters)} possible {'pose' if len(self._bank.filters) == 1 else 'poses'}",
        )

    def _lose_when_old(self, frame: Frame) -> None:
        """Drop the state when its last measurement is too long ago."""
        age_s = self._age_s(frame.t_ns)
        if age_s is not None and age_s > self._settings.coast_s:
            self._lose(frame, f"no measurement for {age_s:.2f} s")

    def _lose(self, frame: Frame, why: str) -> None:
        self._bank = None
        self._map = {marker.id: marker for marker in self._mission.markers}
        self._refused_frames = 0
        if self._mode != Mode.INIT:
            self._mode = Mode.LOST
            frame.log(Log.ERROR, f"LOST: {why}")

    def _settle_mode(self, frame: Frame) -> None:
        """Name what the state is worth now, and tell when that changed."""
        if self._bank is None:
            return
        before = self._mode
        if self._bank.is_ambiguous:
            self._mode = Mode.AMBIGUOUS
        else:
            self._mode = Mode.TRACK if frame.used else Mode.COAST
        if self._mode == before:
            return
        level = Log.INFO if self._mode == Mode.TRACK else Log.WARNING
        frame.log(level, f"{self._mode.name}: {WHY[self._mode]} (was {before.name})")

    def _age_s(self, t_ns: int) -> float | None:
        return None if self._t_measured_ns is None else max(t_ns - self._t_measured_ns, 0) / NS_PER_S

    def _answer(self, frame: Frame, bank: HypothesisBank | None) -> list[AnyMessage]:
        if bank is None:
            state = RelativeState(
                t_capture_ns=frame.t_ns,
                mode=self._mode,
                age_s=self._age_s(frame.t_ns),
                rejections=frame.rejections,
            )
            return [state, *frame.events]
        estimate = bank.estimate
        motion = estimate.motion
        T_chaser_target = motion.pose_chaser_target()
        v, omega = motion.v_chaser_target_m_s, motion.omega_chaser_target_in_target_rad_s
        state = RelativeState(
            t_capture_ns=frame.t_ns,
            mode=self._mode,
            T_chaser_target=pose_message(T_chaser_target),
            v_chaser_target_m_s=vector_message(v),
            omega_chaser_target_in_target_rad_s=vector_message(omega),
            covariance=estimate.message_covariance().ravel().tolist(),
            nis=None if frame.update is None else frame.update.nis,
            nis_dof=0 if frame.update is None else frame.update.dof,
            age_s=self._age_s(frame.t_ns),
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
