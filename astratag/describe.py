"""Describing: from a warp fitted to a print to the detection it amounts to, with its code, layers, corners and pose."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from astratag.candidates import (
    OUTER,
    SURE,
)
from astratag.checks import instance, positive
from astratag.codes.acceptance import FALSE_ACCEPT_RATE
from astratag.curved import cells_in_view
from astratag.cylinder import CylinderWarp
from astratag.detection import Detection, LayerDetection, PlanarPose
from astratag.dictionary import Dictionary, load_dictionary
from astratag.edges import BORDER_UNITS
from astratag.geometry import LAYERS, SQUARES, TEMPLATE_UNITS, layer_points, square
from astratag.grow import Fit, settle
from astratag.layers import measure_layers
from astratag.matching import INDEPENDENT_CELLS, acceptance_of_pixels
from astratag.neighbours import Crossings, all_crossings, crossings
from astratag.pose import planar_poses, poses_from_square, refine_on_corners
from astratag.relight import RELIT_SAMPLES, relit_layer
from astratag.signature import LEAST_SEEN, Artwork, Codebook, Reading, layer_cells
from astratag.surface import Cylinder, Flat, Surface
from astratag.synthesis import Alignment, Synthesis
from astratag.transforms import difference
from astratag.view import View
from astratag.warp import OUTSIDE_PX, FittedWarp, HomographyWarp, PoseWarp, quads_inside, sides_of

Array = NDArray[np.float64]

IMPOSSIBLE = 1e-6
"""Planar poses that the corners leave less than this probability are not tried."""
SAME_COST, SAME_POSE_RAD = 0.98, 0.02
GRID_LINES = 9
GRID = np.stack(np.meshgrid(*[np.linspace(0.0, TEMPLATE_UNITS, GRID_LINES)] * 2), axis=-1)
"""The print's regular grid (9, 9, 2), template units, rows from the top."""
WARPS = 2 * len(LAYERS)
"""How often a candidate is read whose edges are measured: in each layer, in even light and relit."""
PIXEL_BLUR = 0.95
"""Blur from which squares are matched, pixels: a good lens's, and what sampling between pixels adds."""
POLISHED_TO_PX = 0.08
"""The step after one that moved a print by less would move it by a hundredth of a pixel."""
POLISHED_PX, LEAST_POLISHED = 56.0, 0.95
"""Markers that look smaller are measured by all their pixels, not by their edges, where these look right.

At 60 pixels poses are still more exact so by a half, but it takes half as long again as finding them; and from 80 on so
many points of the print would have to be looked at that edges are better.
"""
CELLS_WITHIN = np.array([layer_points(square(BORDER_UNITS, TEMPLATE_UNITS - BORDER_UNITS), layer) for layer in LAYERS])
CELLS_WITHIN.flags.writeable = False
"""The corners (3, 4, 2) of the squares that hold the layers' cells, template units."""


@dataclass(frozen=True)
class MarkerSpec:
    """How one marker was made: side of its outer black square in metres, and the surface it is on (None: unknown)."""

    side_m: float
    surface: Surface | None = None

    def __post_init__(self) -> None:
        positive(self.side_m, "side_m")
        if self.surface is not None and not isinstance(self.surface, Surface):
            raise ValueError(f"surface must be Flat(), Cylinder(radius_m, axis_rad) or None, got {self.surface!r}")
        if isinstance(self.surface, Cylinder) and self.side_m > 2 * np.pi * self.surface.radius_m:
            raise ValueError(
                f"a print with a side of {self.side_m} m goes more than once around a cylinder of radius "
                f"{self.surface.radius_m} m: is the radius in metres?"
            )


class Describer:
    """What a detector knows of its markers: how well a warp of a print reads, and what a fit amounts to."""

    def __init__(
        self,
        dictionary: str | Path | Dictionary = "astratag20",
        side_m: float = 0.1,
        surface: Surface | None = None,
        markers: Mapping[int, MarkerSpec] | None = None,
        *,
        false_accept_rate: float = FALSE_ACCEPT_RATE,
        tau_hamming: int | None = None,
    ) -> None:
        self.dictionary = dictionary if isinstance(dictionary, Dictionary) else load_dictionary(dictionary)
        self.default = MarkerSpec(side_m, surface)
        self.markers = _listed(markers, self.dictionary)
        self._codebook = Codebook(self.dictionary, false_accept_rate, tau_hamming)
        self._artwork = Artwork(self.dictionary)
        self._synthesis = Synthesis(self.dictionary)
        self._accept_of_pixels = acceptance_of_pixels(4 * len(self.dictionary), false_accept_rate)
        all_crossings()  # listed now, not when the first marker is seen

    def spec(self, marker_id: int) -> MarkerSpec:
        """Return how a marker was made."""
        return self.markers.get(marker_id, self.default)

    def near(self, marker_id: int) -> Crossings:
        """Return what lies beside the edges in a marker's print."""
        return crossings(self.dictionary.signature(marker_id).tobytes())

    def describe(self, view: View, marker_id: int, fit: Fit, method: str, warps: int = WARPS) -> Detection | None:
        """Return the detection a fit amounts to, None when the code read through it is not the marker's.

        ``warps`` is how often it was read by now, the best of which led here.
        """
        for relit in (False, True) if self._codebook.tau_hamming is None else (False,):
            reading = self._read_through(view, fit.warp, marker_id, relit)
            if reading is not None and self._codebook.accepts(reading, warps):
                break
        else:
            return None
        layers = measure_layers(fit, view.gray.shape)
        if isinstance(fit.warp, PoseWarp | CylinderWarp):
            return self._described(view, reading, fit.warp, layers, method, fit.covariance[:6, :6])
        return self._described(view, reading, fit.warp, layers, method)

    def _described(
        self,
        view: View,
        reading: Reading,
        warp: FittedWarp,
        layers: tuple[LayerDetection, ...],
        method: str,
        covariance: Array | None = None,
        planar: tuple[PlanarPose, ...] = (),
    ) -> Detection:
        """Return a detection; ``covariance`` is of a warp that is a pose, ``planar`` both poses if known."""
        spec = self.spec(reading.marker_id)
        seen_from = warp.pose if isinstance(warp, CylinderWarp) else warp
        surface = seen_from.surface if isinstance(seen_from, PoseWarp) else spec.surface or Flat()
        curved = method == "tps" or (isinstance(seen_from, PoseWarp) and seen_from.curved)
        measured = [seen.corners_px for seen in layers if seen.layer == 0]
        T_cam_marker = rms_px = None
        poses: tuple[PlanarPose, ...] = ()
        if view.camera is not None:
            fitted = seen_from.T_cam_marker if isinstance(seen_from, PoseWarp) else None
            poses = planar or planar_poses(view.camera, layers, spec.side_m, surface, fitted)
            if isinstance(seen_from, PoseWarp):
                T_cam_marker = seen_from.T_cam_marker
                exact = 0.0 if planar else None  # by pixels, corners are where the pose has them
                rms_px = next((pose.reprojection_rms_px for pose in poses if pose.T_cam_marker is fitted), exact)
            elif poses:
                start = PoseWarp(view.camera, spec.side_m, surface, poses[0].T_cam_marker)
                T_cam_marker, covariance, rms_px = refine_on_corners(start, layers)
        return Detection(
            family=self.dictionary.family,
            marker_id=reading.marker_id,
            corners_px=outer_corners(warp) if isinstance(warp, PoseWarp) or not measured else measured[0],
            layers=layers,
            correlation=reading.correlation,
            cells=reading.cells,
            hamming=reading.hamming,
            method=method,
            planar_poses=poses,
            T_cam_marker=T_cam_marker,
            covariance=covariance,
            reprojection_rms_px=rms_px,
            warp_grid_px=warp_grid(warp) if curved else None,
            surface=surface if curved and T_cam_marker is not None and method != "tps" else None,
        )

    def match_near(self, view: View, marker_id: int, warp: FittedWarp, method: str) -> Detection | None:
        """Return a marker whose print lies where ``warp`` has it to a fraction of a cell, by all its pixels."""
        aligned = self._synthesis.align(view.lit, warp, marker_id, PIXEL_BLUR)
        if aligned is None or aligned.correlation < LEAST_POLISHED:
            return None
        scores = self._synthesis.read(view.lit, aligned.warp, aligned.blur_px)
        row = self.dictionary.row(marker_id)
        if scores[row, 0] < self._accept_of_pixels or scores.argmax() != 4 * row:
            return None
        return self._described_by_pixels(view, marker_id, aligned, 0, float(scores[row, 0]), method)

    def _described_by_pixels(
        self,
        view: View,
        marker_id: int,
        aligned: Alignment,
        layer: int,
        correlation: float,
        method: str,
        before: Detection | None = None,
    ) -> Detection | None:
        """Return the detection an alignment amounts to: one layer, whose corners stand for all pixels of the print.

        What was read, and both planar poses, are those of the detection ``before`` it where there is one.
        """
        aligned = self._synthesis.refined(view.lit, aligned, marker_id)
        square_px = aligned.warp(SQUARES[layer])
        if not inside(square_px, view.gray.shape):
            return None
        if before is None or self._codebook.tau_hamming is not None:
            wrong = self._codebook.read_as(layer_cells(view.light, aligned.warp, layer), marker_id).hamming
            if self._codebook.tau_hamming is not None and wrong > self._codebook.tau_hamming:
                return None
        wrong, cells = (wrong, INDEPENDENT_CELLS) if before is None else (before.hamming, before.cells)
        layers = (LayerDetection(layer, square_px, aligned.sigma_px(SQUARES[layer])),)
        is_pose = isinstance(aligned.warp, PoseWarp | CylinderWarp)
        covariance = aligned.cautious_covariance[:6, :6] if is_pose else None
        reading = Reading(marker_id, 0, correlation, wrong, cells=cells)
        planar = before.planar_poses if before is not None and is_pose else ()
        return self._described(view, reading, aligned.warp, layers, method, covariance, planar)

    def polished(self, view: View, detection: Detection, below_px: float, surface: Surface | None = None) -> Detection:
        """Return a detection measured again by all its pixels when it looks small: from each pose its corners allow.

        ``surface`` is what it was found to be on, if that is not known beforehand.
        """
        if detection.method in ("tps", "cylinder") and self.spec(detection.marker_id).surface is None:
            return detection
        if sides_of(detection.corners_px)[0] >= below_px:
            return detection
        spec = self.spec(detection.marker_id)
        surface = spec.surface or surface
        starts: list[FittedWarp] = [HomographyWarp.from_points(OUTER, detection.corners_px)]
        if view.camera is not None and surface is not None and detection.T_cam_marker is not None:
            mirrored = [
                planar.T_cam_marker
                for planar in detection.planar_poses
                if planar.probability > IMPOSSIBLE and _apart(planar.T_cam_marker, detection.T_cam_marker)
            ]
            poses = [detection.T_cam_marker, *mirrored]
            starts = [PoseWarp(view.camera, spec.side_m, surface, T_cam_marker) for T_cam_marker in poses]
        align = partial(self._synthesis.align, settled_px=POLISHED_TO_PX)
        aligned = [align(view.lit, start, detection.marker_id, PIXEL_BLUR) for start in starts]
        best = max((one for one in aligned if one is not None), key=lambda one: one.correlation, default=None)
        if best is None or best.correlation < LEAST_POLISHED:
            return detection
        marker_id, read, method = detection.marker_id, detection.correlation, detection.method
        again = self._described_by_pixels(view, marker_id, best, 0, read, method, detection)
        if again is None:
            return detection
        return replace(again, planar_poses=detection.planar_poses or again.planar_poses)

    def pose_of_plane(self, view: View, marker_id: int, warp: FittedWarp) -> PoseWarp | None:
        """Return the pose that sees a marker of unknown surface where a plane's warp does; None without a camera."""
        spec = self.spec(marker_id)
        if view.camera is None or spec.surface is not None:
            return None
        poses = poses_from_square(view.camera, OUTER, warp(OUTER), spec.side_m, Flat())
        return PoseWarp(view.camera, spec.side_m, Flat(), poses[0]) if poses else None

    def with_other_pose(self, view: View, detection: Detection, fit: Fit) -> Detection:
        """Return the detection fitted from the other planar pose when corners allow both and the edges prefer it."""
        if not isinstance(fit.warp, PoseWarp):
            return detection
        starts = [planar.T_cam_marker for planar in detection.planar_poses if planar.probability > IMPOSSIBLE]
        away = [T_cam_marker for T_cam_marker in starts if _apart(T_cam_marker, fit.warp.T_cam_marker)]
        near = self.near(detection.marker_id)
        fits = [settle(view.light, replace(fit.warp, T_cam_marker=T), near) for T in away]
        better = min((again for again in fits if again is not None), key=lambda again: again.cost, default=fit)
        if better.cost >= SAME_COST * fit.cost:
            return detection
        return self.describe(view, detection.marker_id, better, detection.method) or detection

    def _read_through(self, view: View, warp: FittedWarp, marker_id: int, relit: bool) -> Reading | None:
        """Return the surest reading of one identity among the layers whose cells are all in the image.

        The larger layers come first, and one that is sure will do.  Where the image's border cuts all of them, those
        of which enough cells are in it.
        """
        best: Reading | None = None
        whole = quads_inside(warp(CELLS_WITHIN), *view.gray.shape).tolist()
        for layer in LAYERS:
            seen = None
            if not any(whole):
                seen = cells_in_view(warp, layer.index, view.gray.shape)
            if whole[layer.index] or (seen is not None and seen.sum() >= LEAST_SEEN):
                reading = self._read_layer(view, warp, layer.index, marker_id, relit, seen)
                best = reading if best is None else max(best, reading, key=self._codebook.excess)
                if best.correlation >= SURE:
                    break
        return best

    def _read_layer(
        self,
        view: View,
        warp: FittedWarp,
        layer: int,
        marker_id: int,
        relit: bool,
        among: NDArray[np.bool_] | None = None,
    ) -> Reading:
        """Return how well one layer reads as a marker, through a warp of the print; in even light, or ``relit``.

        Only ``among`` (48,) of its cells when these are given.
        """
        if relit:
            cells, seen = relit_layer(view.lit, warp, layer_points(RELIT_SAMPLES, LAYERS[layer]))
            return self._codebook.read_seen_as(cells, seen if among is None else seen & among, marker_id)
        cells = layer_cells(view.light, warp, layer)
        if among is None:
            return self._codebook.read_as(cells, marker_id)
        return self._codebook.read_seen_as(cells, among, marker_id)


def _listed(markers: Mapping[int, MarkerSpec] | None, dictionary: Dictionary) -> dict[int, MarkerSpec]:
    """Return the markers a detector was told of.  Raises ValueError for an unknown id or what is no such list."""
    if markers is not None and not isinstance(markers, Mapping):
        raise ValueError(f"markers must map ids to MarkerSpec, got {type(markers).__name__}")
    listed = dict(markers or {})
    for marker_id, spec in listed.items():
        dictionary.row(marker_id)
        instance(spec, MarkerSpec, f"markers[{marker_id}]", "MarkerSpec(side_m, surface) makes one")
    return listed


def inside(corners_px: Array, shape: tuple[int, ...]) -> bool:
    """Return whether all corners (4, 2) are inside an image of a shape."""
    return bool(quads_inside(np.ascontiguousarray(corners_px[None], dtype=float), *shape)[0])


def lead(scores: Array, layer: int) -> float:
    """Return how much better one layer's score (3,) is than the best of the others."""
    return float(scores[layer] - np.delete(scores, layer).max())


def _apart(T_cam_marker: Array, other: Array) -> bool:
    """Return whether two poses are turned so differently that they are two."""
    return float(np.linalg.norm(difference(T_cam_marker, other)[3:])) > SAME_POSE_RAD


def outer_corners(warp: FittedWarp) -> Array:
    """Return the print's outer corners (4, 2) in the image; one behind the camera is where its sides' lines meet."""
    corners_px = warp(OUTER)
    if corners_px.min() > OUTSIDE_PX:
        return corners_px
    inside_px = warp(SQUARES[-1])
    H = cv2.getPerspectiveTransform(SQUARES[-1].astype(np.float32), inside_px.astype(np.float32))
    return cv2.perspectiveTransform(OUTER[None], H)[0]


def warp_grid(warp: FittedWarp) -> Array:
    """Return the print's regular grid (9, 9, 2) in the image, rows from the top."""
    return warp(GRID)
