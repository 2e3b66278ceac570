"""Standard messages of other recorders: images and calibrations under names that are not in our table of topics."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from numpy.typing import NDArray

from schemas import CodecError, decode, encode
from schemas.codec import schema_name

_RAW_IMAGE = schema_name(RawImage)
IMAGE_SCHEMAS = (schema_name(CompressedImage), _RAW_IMAGE)
CALIBRATION_SCHEMAS = (schema_name(CameraCalibration),)

_CHANNELS = {"mono8": 1, "8UC1": 1, "bgr8": 3, "8UC3": 3, "rgb8": 3, "bgra8": 4, "rgba8": 4}
_TO_BGR = {"rgb8": cv2.COLOR_RGB2BGR, "bgra8": cv2.COLOR_BGRA2BGR, "rgba8": cv2.COLOR_RGBA2BGR}


def standard_message(schema: str, payload: bytes) -> tuple[bytes, int]:
    """Return an image or a calibration as the payload of our topics, and its own time stamp (UTC ns, 0 if unset).

    Compressed images and calibrations pass through unchanged; raw images become PNG.  Raises ValueError when the
    bytes are damaged or a raw image has an encoding that has no PNG.
    """
    if schema == _RAW_IMAGE:
        raw = decode(RawImage, payload)
        compressed = CompressedImage(timestamp=raw.timestamp, frame_id=raw.frame_id, format="png", data=_png(raw))
        return encode(compressed), raw.timestamp.ToNanoseconds()
    kind: Any = CameraCalibration if schema in CALIBRATION_SCHEMAS else CompressedImage
    return payload, decode(kind, payload).timestamp.ToNanoseconds()


def stamped(payload: bytes, t_capture_ns: int) -> bytes:
    """Return an image with a time stamp put in."""
    message = decode(CompressedImage, payload)
    message.timestamp.FromNanoseconds(t_capture_ns)
    return encode(message)


def _png(raw: RawImage) -> bytes:
    """Return a raw image as PNG."""
    pixels = _pixels(raw)
    if raw.encoding in _TO_BGR:
        pixels = cv2.cvtColor(pixels, _TO_BGR[raw.encoding])
    return cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()


def _pixels(raw: RawImage) -> NDArray[np.uint8]:
    """Return the pixels (height, width[, channels]) of a raw image of 8-bit channels."""
    channels = _CHANNELS.get(raw.encoding)
    if channels is None:
        raise ValueError(f"raw images with encoding {raw.encoding!r} cannot be read, only {', '.join(_CHANNELS)}")
    row = raw.width * channels
    step = raw.step or row
    if not row or not raw.height or step < row or len(raw.data) < step * raw.height:
        raise CodecError(f"{len(raw.data)} bytes are no {raw.encoding} image of {raw.width}x{raw.height}")
    rows = np.frombuffer(raw.data, np.uint8, step * raw.height).reshape(raw.height, step)
    return rows[:, :row].reshape((raw.height, raw.width, channels) if channels > 1 else (raw.height, raw.width))
