"""The tracker: a detector with memory, which looks first where markers must be."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray

from astratag.camera import Camera
from astratag.candidates import OUTER
from astratag.checks import instance
from astratag.confirm import COST_LIMIT
from astratag.describe import POLISHED_PX
from astratag.detection import Detection
from astratag.detector import EVERY_WAY, HALVE_FROM_PX, Detector, surest
from astratag.edges import EDGE_LAYER
from astratag.fit import fit_edges
from astratag.grow import ALL_EDGES, SETTLED_PX, Fit, grow, layer_side_px, settle
from astratag.search import COARSE, PLAIN, find_outlines
from astratag.surface import Flat
from astratag.transforms import difference, perturb
from astratag.view import View
from astratag.warp import HomographyWarp, PoseWarp

Array = NDArray[np.float64]

SEARCH_EVERY = 10
"""Frames between searches of the whole image for markers not yet tracked."""
STEADY_PX, TRACK_PX = 2.0, 6.0
"""How far from its prediction an edge may be when the marker moves on as before, and when it does not."""
OUTER_EDGES = ALL_EDGES[EDGE_LAYER < 2]
"""Of a marker that moves on as before: the innermost square adds less than a hundredth to what these tell."""
MATCHED_PX = 90.0
"""Markers that look smaller, and whose edges cannot be followed, are looked for by all their pixels."""
CERTAIN = 0.9999
"""Probability of the other planar pose from which a tracked marker is taken to be there instead."""
LEAST_BOX_PX = 16
FIT_MARGIN, LOCAL_MARGIN = 0.05, 0.5
"""How much wider than the marker, on each side as a fraction of its size, a fit and a local search look."""
FIT_MARGIN_PX = TRACK_PX + 6.0


@dataclass(frozen=True, eq=False)
class Track:
    """Where one marker was in the last frame and the one before (None when it was not seen then)."""

    marker_id: int
    corners_px: Array
    T_cam_marker: Array
    T_cam_marker_before: Array | None

    @cached_property
    def predictions(self) -> list[Array]:
        """Return where the marker may be now: moved on as it moved last, or where it was."""
        if self.T_cam_marker_before is None:
            return [self.T_cam_marker]
        motion = difference(self.T_cam_marker, self.T_cam_marker_before)
        return [perturb(self.T_cam_marker, motion), self.T_cam_marker]


class Tracker:
    """Finds the markers of a detector in consecutive images of one camera.

    Each marker's edges are predicted from its last motion, refined and verified by its code; then looked for
    nearby; then in the whole image, which is also searched now and then for markers that come into view, unless
    all those that the detector was told of are there.
    The same images give the same detections.
    """

    def __init__(self, detector: Detector) -> None:
        self.detector = instance(detector, Detector, "detector", "the tracker adds memory to one")
        self._tracks: list[Track] = []
        self._frames = 0
        self._searches = 0

    def reset(self) -> None:
        """Forget all markers, as before the first image."""
        self._tracks, self._frames, self._searches = [], 0, 0

    def detect(self, image: NDArray[np.uint8], camera: Camera | None = None) -> list[Detection]:
        """Return the markers in the next image, the surest first; without ``camera`` every image is searched.

        Raises ValueError as ``Detector.detect`` does.
        """
        found, before = self._follow_all(image, camera) if camera is not None and self._tracks else ([], {})
        if not found or len(found) < len(self._tracks) or (self._frames % SEARCH_EVERY == 0 and not self._all(found)):
            view = self.detector.view(image, camera)
            found = surest(self.detector.find(view), first=found)
            found = self.detector.find_missing(view, found, [EVERY_WAY[self._searches % len(EVERY_WAY)]])
            self._searches += 1
        self._tracks = [
            Track(seen.marker_id, seen.corners_px, seen.T_cam_marker, before.get(id(seen)))
            for seen in found
            if seen.T_cam_marker is not None
        ]
        self._frames += 1
        return found

    def _all(self, found: list[Detection]) -> bool:
        """Return whether every marker the detector was told of is found."""
        told = set(self.detector.markers)
        return bool(told) and told <= {seen.marker_id for seen in found}

    def _follow_all(self, image: NDArray[np.uint8], camera: Camera) -> tuple[list[Detection], dict[int, Array]]:
        """Return the tracked markers still seen, and for each (by Python's id) its pose in the last frame."""
        around = [self._around(track, camera) for track in self._tracks]
        boxes = [_box(corners, FIT_MARGIN, FIT_MARGIN_PX, camera) for corners in around]
        view = self.detector.view(image, camera, [box for box in boxes if box is not None])
        found: list[Detection] = []
        before: dict[int, Array] = {}
        for track, corners, box in zip(self._tracks, around, boxes, strict=True):
            seen = None if box is None else self._follow(view, track) or self._search_near(view, track, corners)
            if seen is not None:
                found.append(seen)
                before[id(seen)] = track.T_cam_marker
        return surest(found) if len(found) > 1 else found, before

    def _around(self, track: Track, camera: Camera) -> Array:
        """Return where the corners (8, 2) of a tracked marker may be: where they were, and moved on."""
        spec = self.detector.spec(track.marker_id)
        moved_on = PoseWarp(camera, spec.side_m, spec.surface or Flat(), track.predictions[0])
        return np.concatenate([track.corners_px, moved_on(OUTER)])

    def _follow(self, view: View, track: Track) -> Detection | None:
        """Return a tracked marker where it is predicted; None when it is not there."""
        right, bottom = view.gray.shape[1] - STEADY_PX, view.gray.shape[0] - STEADY_PX
        inside = all(STEADY_PX < x < right and STEADY_PX < y < bottom for x, y in track.corners_px.tolist())
        edges = OUTER_EDGES if inside else ALL_EDGES
        steady = [(track.predictions[0], STEADY_PX, edges)] if len(track.predictions) > 1 else []
        for T_cam_marker, search_px, edges in [*steady, *((T, TRACK_PX, ALL_EDGES) for T in track.predictions)]:
            fit = self._fit_near(view, track.marker_id, T_cam_marker, search_px, edges)
            if fit is not None and fit.cost < COST_LIMIT:
                detection = self.detector.describe(view, track.marker_id, fit, "tracked")
                if detection is not None:
                    surface = fit.warp.surface if isinstance(fit.warp, PoseWarp) else None
                    return self.detector.polished(view, self._unmirrored(view, detection, fit), POLISHED_PX, surface)
        return self._match_near(view, track)

    def _unmirrored(self, view: View, detection: Detection, fit: Fit) -> Detection:
        """Return the detection from the other planar pose once that is all but certain, and never to and fro."""
        likelier = detection.planar_poses[:1]
        if all(planar.T_cam_marker is detection.T_cam_marker or planar.probability < CERTAIN for planar in likelier):
            return detection
        return self.detector.with_other_pose(view, detection, fit)

    def _match_near(self, view: View, track: Track) -> Detection | None:
        """Return a tracked marker that is too small or blurred for its edges to be followed."""
        for T_cam_marker in track.predictions:
            warp = self._predicted(view, track.marker_id, T_cam_marker)
            if layer_side_px(warp, 0) < MATCHED_PX:
                detection = self.detector.match_near(view, track.marker_id, warp, "tracked")
                if detection is not None:
                    return detection
        return None

    def _predicted(self, view: View, marker_id: int, T_cam_marker: Array) -> HomographyWarp | PoseWarp:
        """Return where a print is under a predicted pose: as a plane's when its surface is not known."""
        spec = self.detector.spec(marker_id)
        assert view.camera is not None
        warp = PoseWarp(view.camera, spec.side_m, spec.surface or Flat(), T_cam_marker)
        return warp if spec.surface is not None else HomographyWarp.from_points(OUTER, warp(OUTER))

    def _fit_near(
        self, view: View, marker_id: int, T_cam_marker: Array, search_px: float, edges: NDArray[np.int64]
    ) -> Fit | None:
        """Return the fit to ``edges`` around a predicted pose, to all when it moved far."""
        warp, near = self._predicted(view, marker_id, T_cam_marker), self.detector.near(marker_id)
        if isinstance(warp, HomographyWarp):
            return grow(view.light, warp, 0, near, partial(self.detector.pose_of_plane, view, marker_id))
        fit: Fit | None = fit_edges(view.light, warp, edges, search_px, near)
        return fit if fit is None or fit.moved_px < SETTLED_PX else settle(view.light, fit.warp, near)

    def _search_near(self, view: View, track: Track, around: Array) -> Detection | None:
        """Return a lost marker from a search of the part of the image around the corners (4 N, 2) it should have."""
        assert view.camera is not None
        box = _box(around, LOCAL_MARGIN, FIT_MARGIN_PX, view.camera)
        if box is None:
            return None
        view = self.detector.view(view.gray, view.camera, [box])
        (left, top), (right, bottom) = box
        part = view.gray[top:bottom, left:right]
        outlines = find_outlines(part, COARSE if part.size > HALVE_FROM_PX else PLAIN).moved(box[0])
        found = self.detector.search(view, outlines) or self.detector.search_later(view)
        return next((seen for seen in found if seen.marker_id == track.marker_id), None)


def _box(around: Array, margin: float, margin_px: float, camera: Camera) -> NDArray[np.int64] | None:
    """Return the part of the image (2, 2) about points (N, 2), low and high x, y; None when hardly any is in it."""
    box = []
    for places, size in zip(around.T.tolist(), (camera.width, camera.height), strict=True):
        low, high = min(places), max(places)
        wider = margin * (high - low) + margin_px
        box.append((int(max(0.0, min(size, low - wider))), int(max(0.0, min(size, high + wider)))))
    return np.array(box).T if min(high - low for low, high in box) >= LEAST_BOX_PX else None
