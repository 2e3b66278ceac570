"""Annotation: a picture of what was detected, for people to look at."""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np
from numpy.typing import NDArray

from astratag import checks
from astratag.camera import Camera
from astratag.detection import Detection
from astratag.transforms import transform

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]

LAYER_BGR = ((80, 220, 60), (255, 180, 40), (60, 160, 255))
"""Colours of the measured layers, outermost first."""
OUTLINE_BGR = (60, 60, 235)
"""Colour of an outer square that is predicted, not measured, and of the mark at the marker's top-left corner."""
GRID_BGR = (200, 200, 70)
AXES_BGR = ((60, 60, 235), (60, 200, 60), (235, 120, 40))
"""Colours of the marker's x, y and z axes."""
SUBPIXEL_BITS = 4


def annotate(
    image: NDArray[np.uint8],
    detections: Iterable[Detection],
    camera: Camera | None = None,
    *,
    side_m: float | None = None,
) -> Picture:
    """Return a BGR copy (H, W, 3) of a gray or BGR image with the detections drawn on it.

    Measured layers in colour, the outer square in red where it is predicted, a dot on the marker's own
    top-left corner, the print's grid on curved surfaces, and identity, correlation and method in words.  With
    ``camera`` and ``side_m`` the marker's axes too, half a side long.
    Raises ValueError for another kind of image, a camera of another size, or a side that is no length.
    """
    image = checks.picture(image)
    if side_m is not None:
        checks.positive(side_m, "side_m")
    if camera is not None:
        checks.instance(camera, Camera, "camera", "Camera.load(path) reads one")
        camera.require_size(image.shape[1], image.shape[0])
    picture = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) if image.ndim == 2 else image.copy()
    thickness = max(1, round(picture.shape[1] / 900))
    if not isinstance(detections, Iterable):
        raise ValueError(f"detections must be a list of Detection, got {detections!r}")
    for seen in detections:
        checks.instance(seen, Detection, "detections", "Detector.detect finds them")
        if seen.warp_grid_px is not None:
            for line in (*seen.warp_grid_px, *seen.warp_grid_px.swapaxes(0, 1)):
                _line(picture, line, GRID_BGR, 1, closed=False)
        measured = {layer.layer for layer in seen.layers}
        if 0 not in measured:
            _line(picture, seen.corners_px, OUTLINE_BGR, thickness)
        for layer in seen.layers:
            _line(picture, layer.corners_px, LAYER_BGR[layer.layer], thickness)
        cv2.circle(picture, _fixed(seen.corners_px[0]), 4 << SUBPIXEL_BITS, OUTLINE_BGR, -1, cv2.LINE_AA, SUBPIXEL_BITS)
        if camera is not None and side_m is not None and seen.T_cam_marker is not None:
            _axes(picture, seen.T_cam_marker, camera, side_m / 2)
        _label(picture, seen)
    return picture


def _fixed(point: Array) -> tuple[int, int]:
    """Return a point as OpenCV's fixed-point numbers, kept within what these hold."""
    x, y = np.clip(np.round(point * (1 << SUBPIXEL_BITS)), -(1 << 24), 1 << 24)
    return int(x), int(y)


def _line(
    picture: Picture, points: Array, colour: tuple[int, int, int], thickness: int, *, closed: bool = True
) -> None:
    """Draw a polyline through points (N, 2)."""
    fixed = np.array([_fixed(point) for point in points], dtype=np.int32)
    cv2.polylines(picture, [fixed], closed, colour, thickness, cv2.LINE_AA, SUBPIXEL_BITS)


def _axes(picture: Picture, T_cam_marker: Array, camera: Camera, length_m: float) -> None:
    """Draw the marker's axes where they are in front of the camera."""
    ends = transform(T_cam_marker, np.vstack([np.zeros(3), np.eye(3) * length_m]))
    if (ends[:, 2] <= 0).any():
        return
    origin, *tips = camera.project(ends)
    for tip, colour in zip(tips, AXES_BGR, strict=True):
        cv2.line(picture, _fixed(origin), _fixed(tip), colour, 2, cv2.LINE_AA, SUBPIXEL_BITS)


def _label(picture: Picture, seen: Detection) -> None:
    """Write identity, correlation, method and layers above the marker, inside the picture."""
    layers = "".join(str(layer.layer) for layer in seen.layers) or "-"
    words = f"{seen.marker_id}  {seen.correlation:.2f}  {seen.method}  layers {layers}"
    scale = max(0.4, picture.shape[1] / 1600)
    (width, height), _ = cv2.getTextSize(words, cv2.FONT_HERSHEY_SIMPLEX, scale, 1)
    left, top = seen.corners_px.min(axis=0)
    at = (
        int(np.clip(left, 2, max(2, picture.shape[1] - width - 2))),
        int(np.clip(top - 6, height + 2, picture.shape[0] - 4)),
    )
    cv2.rectangle(picture, (at[0] - 3, at[1] - height - 3), (at[0] + width + 3, at[1] + 5), (0, 0, 0), -1)
    cv2.putText(picture, words, at, cv2.FONT_HERSHEY_SIMPLEX, scale, (255, 255, 255), 1, cv2.LINE_AA)
