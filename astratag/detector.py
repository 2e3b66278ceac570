"""The detector: markers in one image, with no memory.

The method, in order: find quads; read each as if it were flat; for the promising ones decide which layer of
the marker was seen; fit the whole marker's edges, from that layer outwards and inwards; read it again
through the fit and accept it or not; measure each layer's corners; find the pose.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from astratag.camera import Camera
from astratag.candidates import OUTER, PROMISING, Candidate, bent_candidates, flat_candidates
from astratag.detection import Detection, LayerDetection
from astratag.dictionary import Dictionary, load_dictionary
from astratag.edges import Transfer, inverse_transfer
from astratag.fit import measure_layers
from astratag.geometry import LAYERS, TEMPLATE_UNITS, layer_points, square
from astratag.grow import Fit, fit_own_edges, grow
from astratag.pose import as_planar, planar_poses, poses_from_square
from astratag.search import find_quads
from astratag.signature import ACCEPT, Artwork, Codebook, Reading, layer_cells
from astratag.surface import Flat, Surface
from astratag.tps import KNOTS
from astratag.warp import BentWarp, FittedWarp, HomographyWarp, PoseWarp

Array = NDArray[np.float64]

LEAST_LIKENESS = 0.45
"""Correlation of the whole print with what is seen through a fit, below which it is something else."""
CERTAIN_LIKENESS = 0.85
"""Likeness from which no other layer is tried."""
GRID_LINES = 9


@dataclass(frozen=True)
class MarkerSpec:
    """How one marker was made: side of its outer black square in metres, and the surface it is on (None: unknown)."""

    side_m: float
    surface: Surface | None = None


@dataclass(frozen=True, eq=False)
class View:
    """One image as the detector works on it: gray values, linear light, and the camera that took it."""

    gray: NDArray[np.uint8]
    light: NDArray[np.float32]
    camera: Camera | None


class Detector:
    """Finds the markers of a dictionary in single images.

    ``side_m`` and ``surface`` hold for every marker that ``markers`` (id to ``MarkerSpec``) does not list.
    ``surface`` None is unknown: the code is read as flat, else through a thin-plate spline, and the pose is as
    if flat.  ``transfer`` is how the camera encodes light: "srgb" (ordinary 8-bit cameras) or "linear".
    """

    def __init__(
        self,
        dictionary: str | Path | Dictionary = "astratag20",
        side_m: float = 0.1,
        surface: Surface | None = None,
        markers: Mapping[int, MarkerSpec] | None = None,
        *,
        transfer: Transfer = "srgb",
    ) -> None:
        if not (np.isfinite(side_m) and side_m > 0):
            raise ValueError(f"side_m must be a positive length in metres, got {side_m}")
        self.dictionary = dictionary if isinstance(dictionary, Dictionary) else load_dictionary(dictionary)
        self.default = MarkerSpec(side_m, surface)
        self.markers = dict(markers or {})
        for marker_id, spec in self.markers.items():
            self.dictionary.signature(marker_id)
            if not (np.isfinite(spec.side_m) and spec.side_m > 0):
                raise ValueError(f"markers[{marker_id}].side_m must be a positive length in metres, got {spec.side_m}")
        self._light_of = inverse_transfer(transfer)
        self._codebook = Codebook(self.dictionary)
        self._artwork = Artwork(self.dictionary)

    def detect(self, image: NDArray[np.uint8], camera: Camera | None = None) -> list[Detection]:
        """Return the markers in a gray (H, W) or BGR (H, W, 3) uint8 image, the surest first; poses need ``camera``.

        Raises ValueError for another kind of image, or a camera of another size.
        """
        view = self.view(image, camera)
        return self.search(view, find_quads(view.gray))

    def view(self, image: NDArray[np.uint8], camera: Camera | None) -> View:
        """Return an image made ready.  Raises ValueError as ``detect`` does."""
        gray = as_gray(image)
        if camera is not None:
            camera.require_size(gray.shape[1], gray.shape[0])
        return View(gray, cv2.LUT(gray, self._light_of), camera)

    def spec(self, marker_id: int) -> MarkerSpec:
        """Return how a marker was made."""
        return self.markers.get(marker_id, self.default)

    def search(self, view: View, quads: Array) -> list[Detection]:
        """Return the markers among rough quads (Q, 4, 2), each marker once."""
        promising, faint = flat_candidates(view.gray, quads, self._codebook)
        found = self._confirm_all(view, promising, [])
        if not isinstance(self.default.surface, Flat):
            open_ones = [c for c in faint if not _inside_any(c.corners_px, found)]
            found = self._confirm_all(view, bent_candidates(view.gray, open_ones, self._codebook, self._artwork), found)
        return sorted(found, key=lambda d: -d.correlation)

    def _confirm_all(self, view: View, candidates: Sequence[Candidate], found: list[Detection]) -> list[Detection]:
        """Return what was found before and the markers among more candidates, each marker once."""
        found = list(found)
        for candidate in candidates:
            if not _inside_any(candidate.corners_px, found):
                detection = self._confirm(view, candidate)
                if detection is not None and not _inside_any(detection.corners_px, found):
                    found.append(detection)
        return found

    def _confirm(self, view: View, candidate: Candidate) -> Detection | None:
        """Return the marker a candidate is a layer of, None when its edges, its code or its looks say otherwise."""
        marker_id = candidate.reading.marker_id
        guesses = self._artwork.layer_scores(view.gray, candidate.warp, marker_id)
        best: tuple[float, Fit | None] = (LEAST_LIKENESS, None)
        for layer in np.argsort(-guesses).tolist():
            for start in self._starts(view, candidate, layer):
                fit = self._fit(view, start, layer, marker_id)
                if fit is not None:
                    likeness = self._artwork.likeness(view.gray, fit.warp, marker_id)
                    best = max(best, (likeness, fit), key=lambda pair: pair[0])
            if best[0] > CERTAIN_LIKENESS:
                break
        if best[1] is None:
            return None
        flat = "cylinder" if isinstance(best[1].warp, PoseWarp) and best[1].warp.curved else "planar"
        return self.describe(view, marker_id, best[1], "tps" if candidate.bent else flat)

    def _starts(self, view: View, candidate: Candidate, layer: int) -> Iterator[FittedWarp]:
        """Yield warps to start fitting from when the candidate is ``layer`` of its marker."""
        spec = self.spec(candidate.reading.marker_id)
        template = square(*LAYERS[layer].black)
        if view.camera is not None and spec.surface is not None:
            for T in poses_from_square(view.camera, template, candidate.corners_px, spec.side_m, spec.surface):
                yield PoseWarp(view.camera, spec.side_m, spec.surface, T)
        elif candidate.bent:
            yield BentWarp.from_points(layer_points(KNOTS, LAYERS[layer]), candidate.warp(KNOTS))
        else:
            yield HomographyWarp.from_points(template, candidate.corners_px)

    def _fit(self, view: View, start: FittedWarp, layer: int, marker_id: int) -> Fit | None:
        """Return the fit of a whole marker begun at one layer, None as soon as its code is not read there."""
        warp = start if isinstance(start, BentWarp) else fit_own_edges(view.light, start, layer)
        if warp is None:
            return None
        cells = layer_cells(view.gray, warp, layer)
        if self._codebook.read_as(cells, marker_id).correlation < PROMISING:
            return None
        return grow(view.light, warp, layer)

    def describe(self, view: View, marker_id: int, fit: Fit, method: str) -> Detection | None:
        """Return the detection a fit amounts to, None when the code read through it is not the marker's."""
        reading = self._read_through(view, fit.warp, marker_id)
        if reading is None or reading.correlation < ACCEPT:
            return None
        layers = measure_layers(fit, view.gray.shape)
        spec, warp = self.spec(marker_id), fit.warp
        curved = method == "tps" or (isinstance(warp, PoseWarp) and warp.curved)
        T_cam_marker = covariance = rms_px = None
        poses: Sequence = ()
        if view.camera is not None:
            poses = planar_poses(view.camera, layers, spec.side_m, spec.surface or Flat())
            if isinstance(warp, PoseWarp):
                T_cam_marker, covariance = warp.T_cam_marker, fit.covariance
                rms_px = _corner_rms(warp, layers)
            elif poses:
                T_cam_marker, covariance = poses[0].T_cam_marker, poses[0].covariance
                rms_px = poses[0].reprojection_rms_px
        return Detection(
            family=self.dictionary.family,
            marker_id=marker_id,
            corners_px=next((seen.corners_px for seen in layers if seen.layer == 0), warp(OUTER)),
            layers=layers,
            correlation=reading.correlation,
            hamming=reading.hamming,
            method=method,
            planar_poses=as_planar(poses),
            T_cam_marker=T_cam_marker,
            covariance=covariance,
            reprojection_rms_px=rms_px,
            warp_grid_px=warp_grid(warp) if curved else None,
        )

    def _read_through(self, view: View, warp: FittedWarp, marker_id: int) -> Reading | None:
        """Return the best reading of one identity among the layers that are whole in the image and large enough."""
        height, width = view.gray.shape
        readings = []
        for layer in LAYERS:
            corners = warp(square(*layer.black))
            if (corners < 0).any() or (corners > (width - 1, height - 1)).any():
                continue
            readings.append(self._codebook.read_as(layer_cells(view.gray, warp, layer.index), marker_id))
        return max(readings, key=lambda r: r.correlation, default=None)


def as_gray(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return a gray (H, W) or BGR (H, W, 3) image as gray.  Raises ValueError for anything else."""
    if not isinstance(image, np.ndarray) or image.dtype != np.uint8:
        kind = image.dtype if isinstance(image, np.ndarray) else type(image).__name__
        raise ValueError(f"image must be a uint8 array, got {kind}: scale other depths to 0..255 first")
    if image.ndim == 3 and image.shape[2] == 3:
        image = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    if image.ndim != 2 or min(image.shape) < 8:
        raise ValueError(
            f"image must be gray (H, W) or BGR (H, W, 3) and at least 8x8 pixels, got shape {image.shape}. Did it load?"
        )
    return np.ascontiguousarray(image)


def warp_grid(warp: FittedWarp) -> Array:
    """Return the print's regular grid (9, 9, 2) in the image, rows from the top."""
    span = np.linspace(0.0, TEMPLATE_UNITS, GRID_LINES)
    return warp(np.stack(np.meshgrid(span, span), axis=-1))


def _corner_rms(warp: PoseWarp, layers: Sequence[LayerDetection]) -> float | None:
    """Return the root mean square distance in pixels of the measured corners from where the pose puts them."""
    if not layers:
        return None
    errors = np.concatenate([warp(square(*LAYERS[seen.layer].black)) - seen.corners_px for seen in layers])
    return float(np.sqrt((errors**2).sum(axis=1).mean()))


def _inside_any(corners_px: Array, found: Sequence[Detection]) -> bool:
    """Return whether a square's centre lies inside a marker already found, or a found marker's centre inside it."""

    def holds(outer: Array, inner: Array) -> bool:
        return cv2.pointPolygonTest(outer.astype(np.float32), inner.mean(axis=0).tolist(), False) >= 0

    return any(holds(seen.corners_px, corners_px) or holds(corners_px, seen.corners_px) for seen in found)
