"""Sources of bare pictures: a folder of images, a video, a camera.  The messages are made here."""

from __future__ import annotations

import itertools
from abc import abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from numpy.typing import NDArray

from astratag.camera import Camera
from pipeline.camera_device import CameraDevice, capture_time_ns
from pipeline.convert import NS_PER_S, calibration_message
from pipeline.mission import Mission
from pipeline.opencv_log import quiet_opencv
from pipeline.source import PNG, Source, SourceError, SourceOptions, decoded, load_camera
from schemas import Envelope, Stamp, encode
from schemas.topics import CALIBRATION, FRAME

EPOCH_NS = 946_684_800 * NS_PER_S
"""2000-01-01 00:00 UTC: a date that no camera's clock shows, for frames without time stamps."""
FOLDER_FPS = 10.0
VIDEO_FPS = 30.0
"""For videos that do not tell theirs."""
JPEG_QUALITY = 95
ASSUMED_FIELD_OF_VIEW_RAD = np.deg2rad(60.0)
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".pgm", ".ppm")
PASSED_ON = {PNG: "png", b"\xff\xd8\xff": "jpeg"}
"""Files that begin like this are passed on as they are; others become PNG."""
NAMED = 10
"""Images skipped beyond these are only counted."""


@dataclass(frozen=True)
class Picture:
    """One encoded image: "jpeg" or "png", its size in pixels, and its mid-exposure (UTC ns)."""

    data: bytes
    format: str
    width: int
    height: int
    t_capture_ns: int


class PictureSource(Source):
    """A source of bare pictures: it makes the messages itself."""

    def __init__(self, options: SourceOptions, width: int, height: int, frame_count: int | None, t_start_ns: int):
        mission = Mission() if options.mission is None else Mission.load(options.mission)
        camera = load_camera(options, width, height)
        assumed = camera is None
        if camera is None:
            camera = assumed_camera(width, height)
        calibration = calibration_message(camera, frame_id=mission.camera.name, t_capture_ns=t_start_ns)
        super().__init__(mission, calibration, frame_count)
        if assumed:
            self._warn("no camera calibration given: a lens of 60 degrees is assumed, so ranges are not to scale")

    @abstractmethod
    def pictures(self) -> Iterator[Picture]:
        """Yield the pictures in order."""

    def envelopes(self) -> Iterator[Envelope]:
        """Yield the calibration, then a frame for every picture."""
        t_start_ns = self.calibration.timestamp.ToNanoseconds()
        yield self._envelope(CALIBRATION, encode(self.calibration), Stamp(0, t_start_ns, 0))
        for sequence, picture in enumerate(self.pictures()):
            image = CompressedImage(frame_id=self.mission.camera.name, format=picture.format, data=picture.data)
            image.timestamp.FromNanoseconds(picture.t_capture_ns)
            yield self._envelope(FRAME, encode(image), Stamp(sequence, picture.t_capture_ns, 0))


class FolderSource(PictureSource):
    """Image files in natural order (frame_2 before frame_10); broken ones are skipped, counted and named."""

    def __init__(self, paths: list[Path], options: SourceOptions):
        self._paths = paths
        self._period_s = 1 / (options.fps or FOLDER_FPS)
        first = next((picture for path in paths if isinstance(picture := _read(path, 0), Picture)), None)
        if first is None:
            raise SourceError(f"none of the {len(paths)} images in {paths[0].parent} can be read")
        super().__init__(options, first.width, first.height, len(paths), EPOCH_NS)

    def pictures(self) -> Iterator[Picture]:
        """Yield each readable picture of the first one's size; file k was taken at EPOCH_NS + k / fps."""
        self.skipped = 0
        for k, path in enumerate(self._paths):
            picture = _read(path, EPOCH_NS + round(k * self._period_s * NS_PER_S))
            size = (self.calibration.width, self.calibration.height)
            if isinstance(picture, Picture) and (picture.width, picture.height) != size:
                picture = f"is {picture.width}x{picture.height}, the first one {size[0]}x{size[1]}"
            if isinstance(picture, Picture):
                yield picture
            else:
                self.skipped += 1
                if self.skipped <= NAMED:
                    self._warn(f"skipped {path}: it {picture}")
        if self.skipped:
            self._warn(f"{self.skipped} of {len(self._paths)} images were skipped")


def _read(path: Path, t_capture_ns: int) -> Picture | str:
    """Read an image file.  A string says what is wrong with it."""
    try:
        data = path.read_bytes()
    except OSError as error:
        return f"cannot be read: {error.strerror}"
    image = decoded(data)
    if image is None:
        return "is not an image that can be decoded"
    kind = next((name for beginning, name in PASSED_ON.items() if data.startswith(beginning)), None)
    if kind is None:
        kind, data = "png", cv2.imencode(".png", image)[1].tobytes()
    return Picture(data, kind, image.shape[1], image.shape[0], t_capture_ns)


class VideoSource(PictureSource):
    """A video file, read by OpenCV; its frames are recorded as JPEG."""

    def __init__(self, path: Path, options: SourceOptions):
        self._path = path
        with self._opened() as capture:
            first = capture.read()[1]
            fps, count = capture.get(cv2.CAP_PROP_FPS), int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
        if first is None:
            raise SourceError(f"cannot read video {path}: it has no frame that OpenCV can decode")
        self._period_s = 1 / (options.fps or (fps if fps > 0 else VIDEO_FPS))
        super().__init__(options, first.shape[1], first.shape[0], max(count, 1), EPOCH_NS)

    def pictures(self) -> Iterator[Picture]:
        """Yield every frame; frame k was taken at EPOCH_NS + k / fps."""
        with self._opened() as capture:
            for k in itertools.count():
                image = capture.read()[1]
                if image is None:
                    break
                yield encoded_picture(image, EPOCH_NS + round(k * self._period_s * NS_PER_S))
        if self.frame_count is not None and k < self.frame_count:
            self._warn(f"{self._path} has {k} readable frames, its header says {self.frame_count}")

    @contextmanager
    def _opened(self) -> Iterator[cv2.VideoCapture]:
        with quiet_opencv():
            capture = cv2.VideoCapture(str(self._path))
        try:
            if not capture.isOpened():
                raise SourceError(f"cannot open {self._path}: not a recording, an image or a video that OpenCV reads")
            yield capture
        finally:
            capture.release()


class CameraSource(PictureSource):
    """A live camera.  Its frames are recorded as JPEG; time is mid-exposure where the driver tells it."""

    live = True

    def __init__(self, device: CameraDevice, options: SourceOptions):
        self._device = device
        grabbed = device.grab()
        height, width = grabbed.image.shape[:2]
        super().__init__(options, width, height, None, capture_time_ns(grabbed))

    def pictures(self) -> Iterator[Picture]:
        """Yield frames for as long as the camera gives them.  Raises ValueError when it stops."""
        try:
            while True:
                grabbed = self._device.grab()
                yield encoded_picture(grabbed.image, capture_time_ns(grabbed))
        finally:
            self._device.close()


def assumed_camera(width: int, height: int) -> Camera:
    """Return a lens without distortion that sees ASSUMED_FIELD_OF_VIEW_RAD from left to right."""
    focal_px = width / 2 / np.tan(ASSUMED_FIELD_OF_VIEW_RAD / 2)
    K = [[focal_px, 0, (width - 1) / 2], [0, focal_px, (height - 1) / 2], [0, 0, 1]]
    return Camera(K, width=width, height=height)


def encoded_picture(image: NDArray[np.uint8], t_capture_ns: int) -> Picture:
    """Return an image (height, width, 3), BGR, as JPEG."""
    data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes()
    return Picture(data, "jpeg", image.shape[1], image.shape[0], t_capture_ns)
