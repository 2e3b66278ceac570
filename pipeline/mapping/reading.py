"""Views of a target from recordings: with their recorded detections, else the detector looks at their frames."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration

from astratag.camera import Camera
from pipeline.convert import camera_from_calibration
from pipeline.detector import DetectorStep
from pipeline.mapping.start import MapError
from pipeline.mapping.views import View, view_of
from pipeline.mission import MarkerSection, Mission
from pipeline.recording import Recording, RecordingError
from pipeline.sources import open_source
from schemas import Detections, Envelope
from schemas.topics import CALIBRATION, DETECTIONS, FRAME

OnFrame = Callable[[int, int | None], None]
"""Hears how many frames of how many, or of nobody knows how many, the detector has looked at."""


@dataclass(eq=False)
class Sightings:
    """What recordings show of a mission's markers."""

    mission: Mission
    markers: tuple[MarkerSection, ...]
    """The mission's; all that were seen, flat and of the default side, when it lists none."""
    views: list[View] = field(default_factory=list)
    frames: int = 0
    others: Counter[int] = field(default_factory=Counter)
    """In how many frames markers were seen that the mission does not list."""


def read_sightings(
    recordings: Sequence[str | Path],
    *,
    mission_path: Path | None = None,
    camera_path: Path | None = None,
    scale_camera: bool = False,
    on_frame: OnFrame = lambda done, total: None,
) -> Sightings:
    """Return what recordings, videos or folders of images show of the markers of one target.

    The mission is the first one's unless a file is given; so is each one's calibration.  Raises ValueError, in one
    line, when one cannot be read.
    """
    frames: list[tuple[Detections, Camera | None]] = []
    mission = None if mission_path is None else Mission.load(mission_path)
    for recording in recordings:
        found, recorded_mission = _detected(recording, mission_path, camera_path, scale_camera, on_frame)
        frames.extend(found)
        mission = mission or recorded_mission
    assert mission is not None
    if all(camera is None for _, camera in frames):
        raise MapError(f"{recordings[0]} has no camera calibration: give one with --camera FILE")
    ids = Counter(found.marker_id for message, _ in frames for found in message.detections)
    markers = mission.markers or tuple(MarkerSection(id=m, side_m=mission.default_side_m) for m in sorted(ids))
    sections = {marker.id: marker for marker in markers}
    sightings = Sightings(mission, markers, frames=len(frames))
    sightings.others.update({marker_id: count for marker_id, count in ids.items() if marker_id not in sections})
    for message, camera in frames:
        view = None if camera is None else view_of(message, camera, sections, mission.filter.corner_floor_px)
        if view is not None:
            sightings.views.append(view)
    return sightings


def _detected(
    recording: str | Path, mission_path: Path | None, camera_path: Path | None, scale_camera: bool, on_frame: OnFrame
) -> tuple[list[tuple[Detections, Camera | None]], Mission]:
    """Return the detections of each frame with its camera, and the mission that goes with them."""
    with suppress(RecordingError):  # a video, a folder, or not readable, which the source then tells
        recorded = Recording(recording)
        messages = list(recorded.messages(DETECTIONS))
        if messages:
            camera_of = _camera_of(recorded, camera_path, scale_camera)
            return [(message, camera_of(message)) for message in messages], recorded.mission
    source = open_source(recording, mission=mission_path, camera=camera_path, scale_camera=scale_camera)
    if source.live:
        raise MapError(f"{recording} is a camera: record with `relnav live --source {recording}` first")
    return list(_detect(source.mission, source.envelopes(), source.frame_count, on_frame)), source.mission


def _camera_of(recorded: Recording, camera_path: Path | None, scale: bool) -> Callable[[Detections], Camera | None]:
    """Return which camera took a frame: the given one, else the recorded one."""
    if camera_path is None:
        message = recorded.calibration
        camera = None if message is None else camera_from_calibration(message)
        return lambda detections: camera
    loaded: dict[tuple[int, int], Camera] = {}

    def given(detections: Detections) -> Camera | None:
        size = detections.width_px, detections.height_px
        if not all(size):  # a frame that could not be looked at
            return None
        if size not in loaded:
            loaded[size] = Camera.load(camera_path, width=size[0], height=size[1], scale=scale)
        return loaded[size]

    return given


def _detect(
    mission: Mission, envelopes: Iterator[Envelope], total: int | None, on_frame: OnFrame
) -> Iterator[tuple[Detections, Camera | None]]:
    """Yield what the detector finds in the frames of a source; a frame that it refuses shows nothing."""
    step, camera, done = DetectorStep(mission), None, 0
    for envelope in envelopes:
        if envelope.topic not in (CALIBRATION, FRAME):
            continue
        message = envelope.message()
        if isinstance(message, CameraCalibration):
            camera = camera_from_calibration(message)
        with suppress(ValueError):
            for found in step.step(message):
                if isinstance(found, Detections):
                    yield found, camera
        if envelope.topic is FRAME:
            done += 1
            on_frame(done, total)
