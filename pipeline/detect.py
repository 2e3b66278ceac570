"""Offline detection: markers in images, folders, videos and recordings, each picture searched with no memory.

Corners are in the marker's order; pixels have (0, 0) at the centre of the top-left pixel.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from numpy.typing import NDArray

from astratag.annotate import annotate
from astratag.camera import Camera
from astratag.detection import Detection
from astratag.detector import Detector
from astratag.transforms import wxyz_from_rotation
from pipeline.convert import camera_from_calibration
from pipeline.detector import decode_gray, mission_detector
from pipeline.mission import Mission
from pipeline.opencv_log import quiet_opencv
from pipeline.picture_sources import IMAGE_SUFFIXES
from pipeline.recording import Recording
from pipeline.sources import natural_order
from schemas import Envelope, decode
from schemas.topics import FRAME

Gray = NDArray[np.uint8]
CameraOf = Callable[[int, int], Camera | None]
"""The camera for pictures of width x height pixels.  Raises ValueError when it is for another size."""


@dataclass(frozen=True, eq=False)
class Picture:
    """One picture to search: its name in the answer, how to get its pixels, and with what to search it."""

    name: str
    stem: str
    """The name of its annotated copy."""
    read: Callable[[], Gray]
    """Raises ValueError when the picture is broken."""
    detector: Detector
    camera_of: CameraOf


def detect_paths(
    paths: Sequence[str | Path],
    *,
    dictionary: str | Path | None = None,
    side_m: float | None = None,
    camera_path: str | Path | None = None,
    scale_camera: bool = False,
    annotate_dir: str | Path | None = None,
    on_progress: Callable[[dict[str, Any]], None] | None = None,
) -> dict[str, Any]:
    """Return what ``relnav detect`` writes as JSON: ``{"images": [...], "skipped": [...]}``.

    ``dictionary`` and ``side_m`` hold for every picture; left out, they and the surfaces come from a recording's
    mission, for everything else from the mission's defaults.  So does the camera: ``camera_path``, else the
    recording's calibration, else none, and then there are no poses.  Frame k of a video or recording is named
    ``PATH#k``.  Broken images are skipped and listed with the reason.  ``annotate_dir`` is given a picture for each;
    ``on_progress`` is called with each image's entry.

    Raises ValueError for a path that does not exist, a damaged recording, an unknown dictionary, a camera of another
    size, and when there is no picture that can be read.
    """
    mission_with = partial(_overridden, dictionary=dictionary, side_m=side_m)
    camera_of = _camera_loader(camera_path, scale_camera)
    mission_detector(mission_with(Mission()))
    images: list[dict[str, Any]] = []
    skipped: list[dict[str, str]] = []
    for picture in _pictures([Path(path) for path in paths], mission_with, camera_of):
        try:
            image = picture.read()
        except ValueError as error:
            skipped.append({"path": picture.name, "reason": str(error)})
            continue
        entry, annotated = _search(picture, image, draw=annotate_dir is not None)
        if annotate_dir is not None and annotated is not None:
            _write_picture(Path(annotate_dir) / f"{picture.stem}.png", annotated)
        images.append(entry)
        if on_progress is not None:
            on_progress(entry)
    if not images:
        raise ValueError(f"no image could be read in {', '.join(map(str, paths)) or 'no path at all'}{_why(skipped)}")
    return {"images": images, "skipped": skipped}


def _why(skipped: Sequence[dict[str, str]]) -> str:
    """Return the first reason for skipping, to go on with after what was skipped."""
    if not skipped:
        return ""
    more = f", and {len(skipped) - 1} more" if len(skipped) > 1 else ""
    return f": {skipped[0]['path']}: {skipped[0]['reason']}{more}"


def _search(picture: Picture, image: Gray, *, draw: bool) -> tuple[dict[str, Any], Gray | None]:
    """Search a picture and return its entry and, to ``draw``, the picture with what was found."""
    height, width = image.shape
    try:
        camera = picture.camera_of(width, height)
    except ValueError as error:
        raise ValueError(f"{picture.name}: {error}") from error
    start_s = time.perf_counter()
    detections = picture.detector.detect(image, camera)
    seconds = time.perf_counter() - start_s
    found = [detection_record(detection) for detection in detections]
    entry = {"path": picture.name, "width": width, "height": height, "seconds": seconds, "detections": found}
    side_m = picture.detector.default.side_m
    return entry, annotate(image, detections, camera, side_m=side_m) if draw else None


def detection_record(detection: Detection) -> dict[str, Any]:
    """Return one detection as plain lists and numbers: pixels, metres and radians."""
    T_cam_marker, covariance = detection.T_cam_marker, detection.covariance
    return {
        "family": detection.family,
        "marker_id": detection.marker_id,
        "corners_px": detection.corners_px.tolist(),
        "layers": [{"layer": seen.layer, "corners_px": seen.corners_px.tolist()} for seen in detection.layers],
        "correlation": detection.correlation,
        "hamming": detection.hamming,
        "method": detection.method,
        "T_cam_marker": None
        if T_cam_marker is None
        else {
            "translation_m": T_cam_marker[:3, 3].tolist(),
            "rotation_wxyz": wxyz_from_rotation(T_cam_marker[:3, :3]).tolist(),
        },
        "covariance": None if covariance is None else covariance.tolist(),
        "reprojection_rms_px": detection.reprojection_rms_px,
    }


def _camera_loader(path: str | Path | None, scale: bool) -> CameraOf:
    """Return the camera file's camera for a picture size, read once a size."""

    @cache
    def camera_of(width: int, height: int) -> Camera | None:
        return None if path is None else Camera.load(path, width=width, height=height, scale=scale)

    return camera_of


def _overridden(mission: Mission, *, dictionary: str | Path | None, side_m: float | None) -> Mission:
    """Return a mission with what the caller fixed in place of its own."""
    changes: dict[str, Any] = {}
    if dictionary is not None:
        changes["dictionary"] = str(dictionary)
    if side_m is not None:
        changes["default_side_m"] = side_m
        changes["markers"] = tuple(marker.model_copy(update={"side_m": side_m}) for marker in mission.markers)
    return mission.model_copy(update=changes)


def _pictures(paths: list[Path], mission_with: Callable[[Mission], Mission], camera_of: CameraOf) -> Iterator[Picture]:
    """Yield the pictures of all paths in order; of a folder, its images in natural order."""
    detector = mission_detector(mission_with(Mission()))
    for path in paths:
        if not path.exists():
            raise ValueError(f"no such file or folder: {path}")
        if path.is_dir():
            for child in sorted(path.iterdir(), key=natural_order):
                if child.suffix.lower() in IMAGE_SUFFIXES:
                    yield Picture(str(child), child.stem, partial(_read_image, child), detector, camera_of)
        elif path.suffix.lower() in IMAGE_SUFFIXES:
            yield Picture(str(path), path.stem, partial(_read_image, path), detector, camera_of)
        elif path.suffix.lower() == ".mcap":
            yield from _recording_pictures(path, mission_with, camera_of)
        else:
            yield from _video_pictures(path, detector, camera_of)


def _read_image(path: Path) -> Gray:
    try:
        return decode_gray(path.read_bytes())
    except OSError as error:
        raise ValueError(f"it cannot be read: {error.strerror}") from error


def _video_pictures(path: Path, detector: Detector, camera_of: CameraOf) -> Iterator[Picture]:
    with quiet_opencv():
        video = cv2.VideoCapture(str(path))
    try:
        number = 0
        while (frame := video.read()[1]) is not None:
            gray = frame if frame.ndim == 2 else cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
            yield Picture(f"{path}#{number}", _frame_stem(path, number), partial(np.asarray, gray), detector, camera_of)
            number += 1
        if number == 0:
            yield Picture(str(path), path.stem, _not_a_video, detector, camera_of)
    finally:
        video.release()


def _not_a_video() -> Gray:
    raise ValueError("it is not an image, a recording or a video that OpenCV can read")


def _frame_stem(path: Path, number: int) -> str:
    return f"{path.stem}_{number:06d}"


def _recording_pictures(
    path: Path, mission_with: Callable[[Mission], Mission], camera_of: CameraOf
) -> Iterator[Picture]:
    recording = Recording(path)
    detector = mission_detector(mission_with(recording.mission))
    recorded = None if recording.calibration is None else camera_from_calibration(recording.calibration)

    def camera_or_recorded(width: int, height: int) -> Camera | None:
        camera = camera_of(width, height)
        if camera is None and recorded is not None:
            recorded.require_size(width, height)
        return camera or recorded

    for envelope, _ in recording.envelopes((FRAME,)):
        name = f"{path}#{envelope.stamp.sequence}"
        stem = _frame_stem(path, envelope.stamp.sequence)
        yield Picture(name, stem, partial(_read_frame, envelope), detector, camera_or_recorded)


def _read_frame(envelope: Envelope) -> Gray:
    return decode_gray(decode(CompressedImage, envelope.payload).data)


def _write_picture(path: Path, image: Gray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    if not cv2.imwrite(str(path), image):
        raise ValueError(f"cannot write {path}")
