"""What was found, drawn into the camera's picture: quads by layer, grid of a curved print, axes, identity.

Pixels have (0, 0) at the centre of the top-left pixel, here and in Rerun's messages.
"""

from __future__ import annotations

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from astratag.camera import Camera
from astratag.transforms import transform
from pipeline.convert import points_array, pose_matrix
from pipeline.mission import Mission
from pipeline.view.geometry import dashed
from pipeline.view.layout import AXIS_COLORS, LAYER_COLORS, LAYER_NAMES, OVERLAY, overlay_styles, rgba
from pipeline.view.scene import Log
from schemas import Detection, Detections

Array = NDArray[np.float64]

CLOSED = [0, 1, 2, 3, 0]


class Overlay:
    """Draws the detections of each frame; ``camera`` None: without axes."""

    def __init__(self, log: Log, mission: Mission):
        self.camera: Camera | None = None
        self._log = log
        self._mission = mission
        self._drawn: set[str] = set()
        """What there is to take away when it is no longer seen."""
        for name, style in overlay_styles().items():
            log(f"{OVERLAY}/{name}", style, static=True)

    def draw(self, message: Detections) -> None:
        """Draw what was found in one frame, and take away what no longer is."""
        found = message.detections
        if not found:
            if self._drawn:
                self._log(OVERLAY, rr.Clear(recursive=True))
                self._drawn.clear()
            return
        layers = [seen for detection in found for seen in detection.layers]
        quads = [points_array(seen.corners_px)[CLOSED][None] for seen in layers]
        self._draw_strips("quads", quads, [LAYER_COLORS[seen.layer] for seen in layers])
        unseen = [detection for detection in found if all(seen.layer != 0 for seen in detection.layers)]
        self._draw_strips("predicted", [dashed(points_array(detection.corners_px)) for detection in unseen])
        self._draw_strips("grid", [lines for detection in found for lines in _grid_lines(detection)])
        axes = [strips for detection in found if (strips := self._axes(detection)) is not None]
        self._draw_strips("axes", axes, list(AXIS_COLORS) * len(axes))
        at = [_label_place(detection, message.width_px, message.height_px) for detection in found]
        self._log(f"{OVERLAY}/labels", rr.Points2D.from_fields(positions=at, labels=[_label(d) for d in found]))

    def _draw_strips(self, name: str, strips: list[Array], colors: list[int] | None = None) -> None:
        """Draw strips, each (n, points, 2); a name that has none and had none is left alone."""
        if not strips and name not in self._drawn:
            return
        (self._drawn.add if strips else self._drawn.discard)(name)
        joined = np.concatenate(strips, dtype=np.float32) if strips else np.zeros((0, 2, 2), np.float32)
        drawn = rr.LineStrips2D.from_fields(strips=joined, colors=None if colors is None else rgba(colors))
        self._log(f"{OVERLAY}/{name}", drawn)

    def _axes(self, detection: Detection) -> Array | None:
        """Return the marker's x, y and z axes (3, 2, 2), half a side long, in the image; None when out of sight."""
        if detection.T_cam_marker is None or self.camera is None:
            return None
        marker = self._mission.marker(detection.marker_id)
        length_m = 0.5 * (marker.side_m if marker else self._mission.default_side_m)
        ends_marker = length_m * np.vstack([np.zeros(3), np.eye(3)])
        ends_cam = transform(pose_matrix(detection.T_cam_marker), ends_marker)
        if (ends_cam[:, 2] < 0.1 * length_m).any():
            return None
        origin, *ends = self.camera.project(ends_cam)
        return np.array([(origin, end) for end in ends])


def _grid_lines(detection: Detection) -> list[Array]:
    """Return the rows (1, columns, 2) and columns (1, rows, 2) of the grid on which a curved print was read."""
    warp = detection.warp_grid
    if warp is None or warp.rows != warp.columns:
        return []
    grid = points_array(warp.points_px).reshape(warp.rows, warp.columns, 2)
    return [grid, grid.transpose(1, 0, 2)]


def _label(detection: Detection) -> str:
    layers = "+".join(LAYER_NAMES[seen.layer] for seen in detection.layers)
    return f"marker {detection.marker_id} · {layers} · {detection.method}"


def _label_place(detection: Detection, width_px: int, height_px: int) -> tuple[float, float]:
    """Return a place above the marker, inside the image."""
    x, y = points_array(detection.corners_px).T
    return (
        float(np.clip(x.mean(), 0.2 * width_px, 0.8 * width_px)),
        float(np.clip(y.min() - 0.075 * height_px, 0.05 * height_px, 0.95 * height_px)),
    )
