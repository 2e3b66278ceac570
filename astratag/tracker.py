"""The tracker: a detector with memory, which looks first where markers must be."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from astratag.camera import Camera
from astratag.candidates import OUTER
from astratag.detection import Detection
from astratag.detector import HALVE_FROM_PX, Detector, View, surest
from astratag.fit import fit_edges
from astratag.grow import ALL_EDGES, SETTLED_PX, Fit, grow, settle
from astratag.search import find_quads
from astratag.surface import Flat
from astratag.transforms import difference, perturb
from astratag.warp import FittedWarp, HomographyWarp, PoseWarp

Array = NDArray[np.float64]

SEARCH_EVERY = 10
"""Frames between searches of the whole image for markers not yet tracked."""
TRACK_PX = 6.0
"""How far from its prediction an edge may be."""
COST_LIMIT = 1.0
"""Mean truncated squared residual (of 9 at most) above which a followed fit is not believed."""
LEAST_BOX_PX = 16
LOCAL_MARGIN = 0.5
"""How much wider than the marker, on each side as a fraction of its size, a local search looks."""


@dataclass(frozen=True, eq=False)
class Track:
    """Where one marker was in the last frame and the one before (None when it was not seen then)."""

    marker_id: int
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
        self.detector = detector
        self._tracks: list[Track] = []
        self._frames = 0

    def reset(self) -> None:
        """Forget all markers, as before the first image."""
        self._tracks, self._frames = [], 0

    def detect(self, image: NDArray[np.uint8], camera: Camera | None = None) -> list[Detection]:
        """Return the markers in the next image, the surest first; without ``camera`` every image is searched.

        Raises ValueError as ``Detector.detect`` does.
        """
        found, before = self._follow_all(image, camera) if camera is not None and self._tracks else ([], {})
        if not found or len(found) < len(self._tracks) or (self._frames % SEARCH_EVERY == 0 and not self._all(found)):
            found = surest(self.detector.find(self.detector.view(image, camera)), first=found)
        self._tracks = [
            Track(seen.marker_id, seen.T_cam_marker, before.get(id(seen)))
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
        boxes = [self._box(track, camera) for track in self._tracks]
        view = self.detector.view(image, camera, [box for box in boxes if box is not None])
        found: list[Detection] = []
        before: dict[int, Array] = {}
        for track, box in zip(self._tracks, boxes, strict=True):
            seen = None if box is None else self._follow(view, track, box)
            if seen is not None:
                found.append(seen)
                before[id(seen)] = track.T_cam_marker
        return surest(found), before

    def _box(self, track: Track, camera: Camera) -> NDArray[np.int64] | None:
        """Return the part of the image (2, 2) a tracked marker should be in, low and high x, y; None when out of it."""
        spec = self.detector.spec(track.marker_id)
        surface = spec.surface or Flat()
        around = np.concatenate([PoseWarp(camera, spec.side_m, surface, T)(OUTER) for T in track.predictions])
        margin = LOCAL_MARGIN * (around.max(axis=0) - around.min(axis=0))
        box = np.stack([around.min(axis=0) - margin, around.max(axis=0) + margin])
        box = np.clip(box, 0, (camera.width, camera.height)).astype(int)
        return box if (box[1] - box[0]).min() >= LEAST_BOX_PX else None

    def _follow(self, view: View, track: Track, box: NDArray[np.int64]) -> Detection | None:
        """Return a tracked marker where it is predicted, or near there; None when it is lost."""
        for T_cam_marker in track.predictions:
            fit = self._fit_near(view, track.marker_id, T_cam_marker)
            if fit is not None and fit.cost < COST_LIMIT:
                detection = self.detector.describe(view, track.marker_id, fit, "tracked")
                if detection is not None:
                    return detection
        return self._search_near(view, track, box)

    def _fit_near(self, view: View, marker_id: int, T_cam_marker: Array) -> Fit | None:
        """Return the fit to all edges around a predicted pose."""
        spec = self.detector.spec(marker_id)
        assert view.camera is not None
        warp: FittedWarp = PoseWarp(view.camera, spec.side_m, spec.surface or Flat(), T_cam_marker)
        if spec.surface is None:
            return grow(view.light, HomographyWarp.from_points(OUTER, warp(OUTER)), 0)
        fit = fit_edges(view.light, warp, ALL_EDGES, TRACK_PX, sharp_only=True)
        return fit if fit is None or fit.moved_px < SETTLED_PX else settle(view.light, fit.warp)

    def _search_near(self, view: View, track: Track, box: NDArray[np.int64]) -> Detection | None:
        """Return a lost marker from a search of the part of the image it should be in."""
        (left, top), (right, bottom) = box
        part = view.gray[top:bottom, left:right]
        found, _ = self.detector.search(view, find_quads(part, halve=part.size > HALVE_FROM_PX) + box[0])
        return next((seen for seen in found if seen.marker_id == track.marker_id), None)
