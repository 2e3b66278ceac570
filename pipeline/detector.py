"""The detector's step: camera frames in, markers out, with what a viewer draws over the picture."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import cv2
import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from foxglove_schemas_protobuf.PointsAnnotation_pb2 import PointsAnnotation
from numpy.typing import NDArray

import astratag.detection
from astratag.annotate import LAYER_BGR
from astratag.camera import Camera
from astratag.detector import Detector, MarkerSpec
from astratag.tracker import Tracker
from pipeline.convert import camera_from_calibration, detection_message
from pipeline.mission import Mission
from pipeline.opencv_log import quiet_opencv
from schemas import Detections
from schemas.codec import AnyMessage

LAYER_COLORS = tuple((red / 255, green / 255, blue / 255) for blue, green, red in LAYER_BGR)
"""Red, green and blue (0 to 1) of the outlines of the layers, outermost first."""
GRID_COLOR = (0.30, 0.75, 1.00)
TEXT_COLOR = (1.00, 1.00, 1.00)
LINE_PX = 2.0
FONT_PX = 16.0


def decode_gray(data: bytes) -> NDArray[np.uint8]:
    """Return the picture in an image file's bytes, uint8 gray (height, width).  Raises ValueError when damaged."""
    with quiet_opencv():
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE) if data else None
    if image is None:
        raise ValueError(f"{len(data)} bytes are not a whole image: truncated, or a format that OpenCV does not read?")
    return image


def mission_detector(mission: Mission) -> Detector:
    """Return a detector for a mission's dictionary and markers.  Raises ValueError for an unknown dictionary."""
    return Detector(
        mission.dictionary,
        mission.default_side_m,
        markers={m.id: MarkerSpec(m.side_m, m.surface.surface()) for m in mission.markers},
        transfer=mission.camera.transfer,
    )


class DetectorStep:
    """Frames and their calibration in; for each frame its detections, then the annotations that show them.

    Frames that come before any calibration are searched all the same, their detections have no poses.
    """

    def __init__(self, mission: Mission):
        self._camera_name = mission.camera.name
        self._tracker = Tracker(mission_detector(mission))
        self._camera: Camera | None = None

    def step(self, message: AnyMessage) -> Iterable[AnyMessage]:
        """Take one message.  Raises ValueError for a damaged image or one of another size than the calibration's."""
        if isinstance(message, CameraCalibration):
            self._camera = camera_from_calibration(message)
            return []
        if not isinstance(message, CompressedImage):
            return []
        image = decode_gray(message.data)
        height, width = image.shape
        if self._camera is not None:
            self._camera.require_size(width, height)
        detections = self._tracker.detect(image, self._camera)
        found = Detections(
            t_capture_ns=message.timestamp.ToNanoseconds(),
            camera=self._camera_name,
            width_px=width,
            height_px=height,
            detections=[detection_message(detection) for detection in detections],
        )
        return [found, annotations_message(detections, found.t_capture_ns)]

    def refused(self, t_capture_ns: int) -> Iterable[AnyMessage]:
        """Return that nothing was found: the frame could not be looked at."""
        return [Detections(t_capture_ns=t_capture_ns, camera=self._camera_name, width_px=0, height_px=0, detections=[])]


def annotations_message(detections: Sequence[astratag.detection.Detection], t_capture_ns: int) -> ImageAnnotations:
    """Return a loop around each layer seen, the id at the first corner, and the grid of a curved print."""
    message = ImageAnnotations()
    message.timestamp.FromNanoseconds(t_capture_ns)
    for detection in detections:
        if detection.warp_grid_px is not None:
            _add_grid(message, detection.warp_grid_px)
        for seen in detection.layers:
            _add_points(message, PointsAnnotation.LINE_LOOP, seen.corners_px, LAYER_COLORS[seen.layer])
        _add_text(message, f"{detection.marker_id}", detection.corners_px[0])
    return message


def _add_points(message: ImageAnnotations, kind: int, points_px: NDArray[np.float64], color: Sequence[float]) -> None:
    annotation = message.points.add(type=kind, thickness=LINE_PX if kind == PointsAnnotation.LINE_LOOP else LINE_PX / 2)
    annotation.timestamp.CopyFrom(message.timestamp)
    annotation.outline_color.CopyFrom(_color(color))
    add = annotation.points.add
    for x, y in points_px.tolist():
        point = add()  # filled in after: twice as fast as by keywords
        point.x, point.y = x, y


def _add_grid(message: ImageAnnotations, grid_px: NDArray[np.float64]) -> None:
    """Add the rows and columns of a grid (rows, columns, 2) as one list of segments."""
    along_rows = np.stack([grid_px[:, :-1], grid_px[:, 1:]], axis=2).reshape(-1, 2)
    along_columns = np.stack([grid_px[:-1], grid_px[1:]], axis=2).reshape(-1, 2)
    _add_points(message, PointsAnnotation.LINE_LIST, np.concatenate([along_rows, along_columns]), GRID_COLOR)


def _add_text(message: ImageAnnotations, text: str, position_px: NDArray[np.float64]) -> None:
    annotation = message.texts.add(text=text, font_size=FONT_PX)
    annotation.timestamp.CopyFrom(message.timestamp)
    annotation.position.x, annotation.position.y = position_px.tolist()
    annotation.text_color.CopyFrom(_color(TEXT_COLOR))
    annotation.background_color.CopyFrom(_color((0.0, 0.0, 0.0), alpha=0.6))


def _color(rgb: Sequence[float], alpha: float = 1.0) -> Color:
    red, green, blue = rgb
    return Color(r=red, g=green, b=blue, a=alpha)
