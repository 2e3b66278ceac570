"""A recording as a source: what was recorded passes through byte for byte."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage

from pipeline.convert import calibration_message, camera_from_calibration
from pipeline.mission import Mission
from pipeline.recording import Recording, RecordingError
from pipeline.source import Source, SourceOptions, decoded, load_camera
from schemas import CodecError, Envelope, Stamp, decode, encode
from schemas.topics import CALIBRATION, FRAME, TRUTH


class RecordingSource(Source):
    """An MCAP recording: frames, truth and calibration pass through byte for byte, frames in file order."""

    def __init__(self, path: Path, options: SourceOptions):
        self._recording = Recording(path)
        mission = self._recording.mission if options.mission is None else Mission.load(options.mission)
        self._frame_key = _frame_key(self._recording, mission)
        self._calibration_key = self._frame_key.removesuffix("/frame") + "/calibration"
        self._options = options
        self._t_start_ns, self._size = self._first_frame()
        camera = load_camera(options, *self._size)
        self._camera_given = camera is not None
        if camera is not None:
            message = calibration_message(camera, frame_id=mission.camera.name, t_capture_ns=self._t_start_ns)
            self._first_calibration = encode(message)
        else:
            self._first_calibration = next(self._recorded_calibrations(), b"")
        if not self._first_calibration:
            raise RecordingError(f"{path} has no camera calibration: give one with --camera FILE")
        calibration = decode(CameraCalibration, self._first_calibration)
        super().__init__(mission, calibration, self._recording.topics()[self._frame_key])
        if options.fps is not None:
            self._warn("a frame rate was given: recorded frames keep their own time stamps")

    def envelopes(self) -> Iterator[Envelope]:
        """Yield the calibration and, when it changes, later ones; every frame after the truth up to its capture."""
        truths = self._truths()
        self.backwards = 0
        sequence, t_before_ns = 0, self._t_start_ns
        calibration = self._first_calibration
        yield self._envelope(CALIBRATION, calibration, Stamp(0, self._t_start_ns, 0))
        for envelope, _ in self._recording.envelopes((CALIBRATION, FRAME)):
            stamp = Stamp(sequence, envelope.stamp.t_capture_ns, 0)
            if envelope.key == self._frame_key:
                while truths and truths[0].stamp.t_capture_ns <= stamp.t_capture_ns:
                    truth = truths.popleft()
                    yield self._envelope(TRUTH, truth.payload, replace(truth.stamp, sequence=sequence))
                yield self._envelope(FRAME, envelope.payload, stamp)
                self.backwards += stamp.t_capture_ns < t_before_ns
                sequence, t_before_ns = sequence + 1, stamp.t_capture_ns
            elif envelope.key == self._calibration_key and not self._camera_given:
                before, calibration = calibration, self._for_our_size(envelope)
                if calibration != before:
                    yield self._envelope(CALIBRATION, calibration, stamp)
        if self.backwards:
            self._warn(f"{self.backwards} frames were captured before their predecessor")

    def _truths(self) -> deque[Envelope]:
        """Return the recorded truth of the frames' vehicle in the order of its time."""
        key = TRUTH.key(vehicle=self._frame_key.split("/")[1])
        truths = (envelope for envelope, _ in self._recording.envelopes((TRUTH,)) if envelope.key == key)
        return deque(sorted(truths, key=lambda envelope: envelope.stamp.t_capture_ns))

    def _first_frame(self) -> tuple[int, tuple[int, int]]:
        """Return the time of the first frame (UTC ns), and width and height of the first that can be decoded."""
        t_start_ns = None
        for envelope, _ in self._recording.envelopes((FRAME,)):
            if envelope.key != self._frame_key:
                continue
            t_start_ns = envelope.stamp.t_capture_ns if t_start_ns is None else t_start_ns
            with suppress(CodecError):
                image = decoded(decode(CompressedImage, envelope.payload).data)
                if image is not None:
                    return t_start_ns, (image.shape[1], image.shape[0])
        raise RecordingError(f"{self._recording.path} has no camera frame that can be decoded")

    def _recorded_calibrations(self) -> Iterator[bytes]:
        for envelope, _ in self._recording.envelopes((CALIBRATION,)):
            if envelope.key == self._calibration_key:
                yield self._for_our_size(envelope)

    def _for_our_size(self, envelope: Envelope) -> bytes:
        """Return a recorded calibration unchanged when it is for the frames' size, scaled when allowed.

        Raises RecordingError when it is neither.
        """
        try:
            message = decode(CameraCalibration, envelope.payload)
            camera = camera_from_calibration(message)
            if (camera.width, camera.height) == self._size:
                return envelope.payload
            if not self._options.scale_camera:
                camera.require_size(*self._size)
        except ValueError as error:
            raise RecordingError(f"{self._recording.path}: {error}") from error
        t_capture_ns = message.timestamp.ToNanoseconds()
        scaled = camera.scaled(*self._size)
        return encode(calibration_message(scaled, frame_id=message.frame_id, t_capture_ns=t_capture_ns))


def _frame_key(recording: Recording, mission: Mission) -> str:
    """Return the key of the mission's camera, or of the only one.  Raises RecordingError when there is no choice."""
    wanted = FRAME.key(vehicle=mission.vehicle, camera=mission.camera.name)
    keys = recording.frame_keys
    if wanted in keys:
        return wanted
    if not keys:
        found = ", ".join([*recording.topics(), *recording.ignored]) or "no topic"
        raise RecordingError(
            f"{recording.path} has no camera frames: expected {wanted} or one topic of foxglove images, found {found}"
        )
    if len(keys) > 1:
        raise RecordingError(f"{recording.path} has several cameras ({', '.join(keys)}): name one in the mission")
    return keys[0]
