"""What a camera saw of a target's markers from one place, and the choice of views that show it from all sides.

Pixels have (0, 0) at the centre of the top-left pixel; corners are in the marker's order.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from astratag.camera import Camera
from astratag.detection import LayerDetection
from astratag.geometry import layer_corners_print
from astratag.pose import planar_poses
from pipeline.convert import points_array
from pipeline.corners import outward_shift
from pipeline.mission import MarkerSection
from schemas import Detections

Array = NDArray[np.float64]

LEAST_MARKERS = 2
"""A view of fewer says nothing about where they are on the target."""
FARTHEST_PX = 1e5
"""A corner farther from the image's origin, or less certain, than this is damaged."""
LIKELY = 1e-6
"""A planar pose less likely than this, beside the other one, is not tried."""


@dataclass(frozen=True, eq=False)
class SeenMarker:
    """One marker in one view; ``poses_cam_marker`` are the one or two poses (4, 4) that its corners allow."""

    marker: MarkerSection
    layers: tuple[LayerDetection, ...]
    poses_cam_marker: tuple[Array, ...]


@dataclass(frozen=True, eq=False)
class Corners:
    """The corners of markers in one view, the four of a layer one after another."""

    slot: NDArray[np.intp]
    """(N,) which of the markers in the view each belongs to."""
    points_marker: Array
    """(N, 3) metres, each in its marker's frame."""
    seen_px: Array
    """(N, 2)"""
    by_bias: Array
    """(N, 2, 11) how each moves with its marker's bias: when all edges move outward, all corners right or down, and the
    first corner right or down, the second, and so on, by a pixel."""
    sigma_px: Array
    """(N,)"""


@dataclass(frozen=True, eq=False)
class View:
    """The markers of one target in one picture of a calibrated camera."""

    camera: Camera
    markers: tuple[SeenMarker, ...]

    @property
    def ids(self) -> tuple[int, ...]:
        """Return the markers' ids."""
        return tuple(seen.marker.id for seen in self.markers)

    def only(self, ids: Iterable[int]) -> View:
        """Return what it shows of some of the markers."""
        wanted = set(ids)
        return View(self.camera, tuple(seen for seen in self.markers if seen.marker.id in wanted))

    @cached_property
    def corners(self) -> Corners:
        """Return the corners of all layers of all markers."""
        layers = [(slot, seen, layer) for slot, seen in enumerate(self.markers) for layer in seen.layers]
        quads = np.array([layer.corners_px for _, _, layer in layers])
        return Corners(
            slot=np.repeat([slot for slot, _, _ in layers], 4),
            points_marker=np.concatenate(
                [
                    seen.marker.surface.surface().points(layer_corners_print(layer.layer, seen.marker.side_m))
                    for _, seen, layer in layers
                ]
            ),
            seen_px=quads.reshape(-1, 2),
            by_bias=_by_bias(quads),
            sigma_px=np.repeat([layer.sigma_px for _, _, layer in layers], 4),
        )


def _by_bias(quads_px: Array) -> Array:
    outward = outward_shift(quads_px).reshape(-1, 2, 1)
    together = np.broadcast_to(np.eye(2), (len(outward), 2, 2))
    alone = np.tile(np.eye(8).reshape(4, 2, 8), (len(quads_px), 1, 1))
    return np.concatenate([outward, together, alone], axis=2)


def view_of(
    message: Detections, camera: Camera, markers: Mapping[int, MarkerSection], corner_floor_px: float
) -> View | None:
    """Return what a frame's detections show of the markers; None when that is fewer than two.

    Poses are found anew from the corners: recorded ones may have been made for other sides or surfaces.  No corner is
    believed better than ``corner_floor_px``.
    """
    if (message.width_px, message.height_px) != (camera.width, camera.height):
        return None
    seen: dict[int, SeenMarker] = {}
    for detection in message.detections:
        marker = markers.get(detection.marker_id)
        layers = tuple(
            LayerDetection(layer.layer, points_array(layer.corners_px), max(layer.sigma_px, corner_floor_px))
            for layer in detection.layers
            if layer.sigma_px <= FARTHEST_PX and np.abs(points_array(layer.corners_px)).max() <= FARTHEST_PX
        )
        if marker is None or not layers or marker.id in seen:
            continue
        poses = planar_poses(camera, layers, marker.side_m, marker.surface.surface())
        if poses:
            likely = tuple(found.T_cam_marker for found in poses if found.probability > LIKELY)
            seen[marker.id] = SeenMarker(marker, layers, likely)
    return View(camera, tuple(seen.values())) if len(seen) >= LEAST_MARKERS else None


def chosen_views(views: Sequence[View], count: int) -> list[View]:
    """Return at most ``count`` views, as different from each other as there are.

    Views of the same markers form a group; groups take turns in choosing their view that is farthest, by where its
    corners are in the picture, from those chosen before (T. Gonzalez, "Clustering to minimize the maximum intercluster
    distance", 1985).
    """
    if len(views) <= count:
        return list(views)
    groups: dict[tuple[int, ...], list[int]] = {}
    for index, view in enumerate(views):
        groups.setdefault(tuple(sorted(view.ids)), []).append(index)
    orders = [_farthest_first(views, members, count) for members in groups.values()]
    turns = [order[k] for k in range(max(map(len, orders))) for order in orders if k < len(order)]
    return [views[index] for index in sorted(turns[:count])]


def _farthest_first(views: Sequence[View], members: Sequence[int], count: int) -> list[int]:
    """Return members (indices of views of the same markers), each the farthest from all before it."""
    places = np.array([_places(views[index]) for index in members])
    order = [0]
    distance = np.linalg.norm(places - places[0], axis=1)
    while len(order) < min(count, len(members)):
        order.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(places - places[order[-1]], axis=1))
    return [members[k] for k in order]


def _places(view: View) -> Array:
    """Return where the largest layer's corners of each marker are, in normalised coordinates, by the markers' ids."""
    largest = [
        min(seen.layers, key=lambda layer: layer.layer).corners_px
        for seen in sorted(view.markers, key=lambda seen: seen.marker.id)
    ]
    return view.camera.undistort(np.concatenate(largest)).ravel()
