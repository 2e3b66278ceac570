"""What every source of frames is: its envelopes in order, and what is known about its camera."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from numpy.typing import NDArray

from astratag.camera import Camera
from pipeline.mission import Mission
from pipeline.opencv_log import quiet_opencv
from schemas import Envelope, Stamp, Topic

PNG = b"\x89PNG"
PNG_END = b"IEND\xaeB`\x82"
"""Looked for before decoding: libpng itself prints about its absence, past OpenCV."""


class SourceError(ValueError):
    """A source that cannot be opened, in one line."""


@dataclass(frozen=True)
class SourceOptions:
    """What the user says about a source that the source itself may not know."""

    camera: Path | None = None
    """Calibration file; wins over a recorded calibration."""
    mission: Path | None = None
    """Mission file; wins over a recorded mission."""
    fps: float | None = None
    """Of a folder or a video; asked of a camera."""
    scale_camera: bool = False
    """The picture was only resized: scale a calibration of another size instead of refusing it."""

    def refuse(self, why: str, **given: object) -> None:
        """Raise SourceError, with the reason, when one of these options is given to a source that cannot heed it."""
        for name, value in given.items():
            if value is not None:
                raise SourceError(f"--{name} cannot be given here: {why}")


class Source(ABC):
    """Frames in order, with what is known about their camera.

    ``frame_count`` is None when live.  While ``envelopes`` is drawn, ``skipped`` counts images that cannot be used,
    ``backwards`` frames captured before their predecessor, and ``warnings`` may grow: ``on_warning`` hears of it.
    """

    live = False
    closed_loop = False
    """It flies on the states of its own frames: they are to be written to it."""

    def __init__(self, mission: Mission, calibration: CameraCalibration, frame_count: int | None):
        self.mission = mission
        self.calibration = calibration
        self.frame_count = frame_count
        self.warnings: list[str] = []
        self.on_warning: Callable[[str], object] = lambda line: None
        self.skipped = 0
        self.backwards = 0

    @abstractmethod
    def envelopes(self) -> Iterator[Envelope]:
        """Yield the calibration, then frames, each after its truth; ``t_origin_ns`` is 0."""

    @property
    def waits(self) -> bool:
        """Tell whether a closed loop cannot go on before another state has been written to it."""
        return False

    def write(self, envelope: Envelope, t_receipt_ns: int) -> None:  # noqa: B027
        """Take what the pipeline made of the frames so far; of use to a closed loop only."""

    def close(self) -> None:  # noqa: B027
        """Nothing to finish."""

    def _warn(self, line: str) -> None:
        if line not in self.warnings:
            self.warnings.append(line)
            self.on_warning(line)

    def _envelope(self, topic: Topic, payload: bytes, stamp: Stamp) -> Envelope:
        key = topic.key(vehicle=self.mission.vehicle, camera=self.mission.camera.name)
        return Envelope(topic, key, payload, stamp)


def load_camera(options: SourceOptions, width: int, height: int) -> Camera | None:
    """Return the camera of the given file for images of this size, None when no file is given."""
    if options.camera is None:
        return None
    return Camera.load(options.camera, width=width, height=height, scale=options.scale_camera)


def decoded(data: bytes) -> NDArray[np.uint8] | None:
    """Return the image (height, width, 3) in encoded bytes, None when there is none or it is cut off."""
    if not data or (data.startswith(PNG) and PNG_END not in data):
        return None
    with quiet_opencv():
        return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
