"""Where the mission's markers must appear in the image, given the true pose: the judge of what was detected."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from astratag.camera import Camera
from astratag.geometry import LAYERS, layer_corners_print
from astratag.transforms import inverse, transform
from pipeline.convert import points_array
from pipeline.mission import MarkerSection, Mission
from schemas import Detection, LayerCorners

Array = NDArray[np.float64]
OUTLINE_POINTS = 8
"""Points an edge at which a layer's outline is checked: between corners, a curved print bulges."""
FALSE_SIDE_FRACTION = 0.1
FALSE_PX = 2.0
"""A layer whose corners are off on average by more than the larger of these is not that layer."""
ROUND_TRIP_TOLERANCE = 1e-6
"""In normalised coordinates: a larger difference means that the lens model has folded over."""


@dataclass(frozen=True, eq=False)
class ExpectedLayer:
    """One layer of one marker that truth puts wholly into the image, ``corners_px`` (4, 2) in the marker's order."""

    marker_id: int
    layer: int
    corners_px: Array


def visible_layers(T_chaser_target: Array, mission: Mission, camera: Camera) -> list[ExpectedLayer]:
    """Return the layers whose whole outline faces the camera and lies in the image; nothing is taken to hide them."""
    T_cam_target = inverse(mission.camera.T_chaser_cam.matrix()) @ T_chaser_target
    found = []
    for marker in mission.markers:
        T_cam_marker = T_cam_target @ marker.T_target_marker.matrix()
        for layer in range(len(LAYERS)):
            outline_px = _outline_px(marker, layer, T_cam_marker, camera)
            if outline_px is not None:
                found.append(ExpectedLayer(marker.id, layer, outline_px[::OUTLINE_POINTS]))
    return found


def _outline_px(marker: MarkerSection, layer: int, T_cam_marker: Array, camera: Camera) -> Array | None:
    """Return a layer's outline (4 * OUTLINE_POINTS, 2) from the first corner on, None when part of it is unseen."""
    corners = layer_corners_print(layer, marker.side_m)
    along = (np.arange(OUTLINE_POINTS) / OUTLINE_POINTS)[None, :, None]
    on_print = (corners[:, None] + along * (np.roll(corners, -1, axis=0) - corners)[:, None]).reshape(-1, 2)
    surface = marker.surface.surface()
    points_cam = transform(T_cam_marker, surface.points(on_print))
    normals_cam = surface.normals(on_print) @ T_cam_marker[:3, :3].T
    if (points_cam[:, 2] <= 0).any() or (np.sum(normals_cam * points_cam, axis=1) >= 0).any():
        return None
    outline_px = camera.project(points_cam)
    if (outline_px < -0.5).any() or (outline_px > np.array([camera.width, camera.height]) - 0.5).any():
        return None
    rays = points_cam[:, :2] / points_cam[:, 2:]
    return outline_px if np.allclose(camera.undistort(outline_px), rays, atol=ROUND_TRIP_TOLERANCE) else None


def is_false(detection: Detection, T_chaser_target: Array, mission: Mission, camera: Camera) -> bool:
    """Tell whether a detection of a marker of the map lies grossly elsewhere than that marker.

    Raises ValueError when the marker is not in the map.
    """
    marker = mission.marker(detection.marker_id)
    if marker is None:
        raise ValueError(f"marker {detection.marker_id} is not in the mission's map")
    T_chaser_marker = T_chaser_target @ marker.T_target_marker.matrix()
    T_cam_marker = inverse(mission.camera.T_chaser_cam.matrix()) @ T_chaser_marker
    return any(_is_elsewhere(seen, marker, T_cam_marker, camera) for seen in detection.layers)


def _is_elsewhere(seen: LayerCorners, marker: MarkerSection, T_cam_marker: Array, camera: Camera) -> bool:
    corners = marker.surface.surface().points(layer_corners_print(seen.layer, marker.side_m))
    corners_cam = transform(T_cam_marker, corners)
    if (corners_cam[:, 2] <= 0).any():
        return True
    expected_px = camera.project(corners_cam)
    side_px = float(np.linalg.norm(expected_px - np.roll(expected_px, 1, axis=0), axis=1).mean())
    off_px = float(np.linalg.norm(points_array(seen.corners_px) - expected_px, axis=1).mean())
    return off_px > max(FALSE_SIDE_FRACTION * side_px, FALSE_PX)
