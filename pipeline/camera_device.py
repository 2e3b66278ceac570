"""A live camera behind a small interface, and the mid-exposure time of its frames."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.opencv_log import quiet_opencv

MAX_AGE_NS = 2_000_000_000
"""A driver's time stamp older than this, or in the future, is not believed."""
_MANUAL_EXPOSURE = 1.0
_EXPOSURE_UNIT_S = 1e-4
"""V4L2_CID_EXPOSURE_ABSOLUTE counts in 100 microseconds."""


@dataclass(frozen=True, eq=False)
class Grabbed:
    """A frame (height, width, 3), BGR, and what is known of its time.

    ``t_receipt_ns`` (UTC) and ``t_monotonic_ns`` are the same moment, just after the frame was handed over;
    ``t_driver_ms`` is the driver's stamp at the start of the exposure on the monotonic clock, 0 when it gives none.
    """

    image: NDArray[np.uint8]
    t_receipt_ns: int
    t_monotonic_ns: int
    t_driver_ms: float = 0.0
    exposure_s: float = 0.0


class CameraDevice(Protocol):
    """What a source needs of a camera."""

    def grab(self) -> Grabbed:
        """Wait for the next frame.  Raises ValueError when the camera gives none."""
        ...

    def close(self) -> None:
        """Give the camera back."""
        ...


def capture_time_ns(grabbed: Grabbed) -> int:
    """Return a frame's mid-exposure (UTC ns): from the driver's stamp where it can be believed, else the receipt.

    UVC drivers stamp the start of the exposure.  Under automatic exposure its length is not known and taken as 0:
    the time is then early by half an exposure.
    """
    age_ns = grabbed.t_monotonic_ns - round(grabbed.t_driver_ms * 1e6)
    if not 0 <= age_ns <= MAX_AGE_NS:
        return grabbed.t_receipt_ns
    return grabbed.t_receipt_ns - age_ns + round(grabbed.exposure_s / 2 * 1e9)


class OpenCvDevice:
    """A V4L2 camera read by OpenCV, asked for its newest frame."""

    def __init__(self, index: int, fps: float | None = None):
        self._name = f"/dev/video{index}"
        with quiet_opencv():
            self._capture = cv2.VideoCapture(index, cv2.CAP_V4L2)
        if not self._capture.isOpened():
            raise ValueError(f"cannot open camera {self._name}: is it plugged in, free, and may this user read it?")
        self._capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        if fps is not None:
            self._capture.set(cv2.CAP_PROP_FPS, fps)

    def grab(self) -> Grabbed:
        """Wait for the next frame.  Raises ValueError when the camera gives none."""
        image = self._capture.read()[1]
        if image is None:
            raise ValueError(f"camera {self._name} stopped giving frames: was it unplugged?")
        manual = self._capture.get(cv2.CAP_PROP_AUTO_EXPOSURE) == _MANUAL_EXPOSURE
        exposure = self._capture.get(cv2.CAP_PROP_EXPOSURE) if manual else 0.0
        return Grabbed(
            image=image,
            t_receipt_ns=time.time_ns(),
            t_monotonic_ns=time.monotonic_ns(),
            t_driver_ms=self._capture.get(cv2.CAP_PROP_POS_MSEC),
            exposure_s=max(exposure, 0.0) * _EXPOSURE_UNIT_S,
        )

    def close(self) -> None:
        """Give the camera back."""
        self._capture.release()
