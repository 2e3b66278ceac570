"""The detector: markers in one image, with no memory.

The method, in order: find quads; read each as if it were flat; for the promising ones decide which layer of
the marker was seen; fit the whole marker's edges, from that layer outwards and inwards; read it again
through the fit and accept it or not; measure each layer's corners; find the pose.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from astratag.camera import Camera
from astratag.candidates import (
    OUTER,
    PROMISING,
    SURE,
    Candidate,
    aligned,
    bent_candidates,
    flat_candidates,
    framed,
    looks_large,
)
from astratag.detection import Detection, LayerDetection, PlanarPose
from astratag.dictionary import Dictionary, load_dictionary
from astratag.edges import Transfer, inverse_transfer
from astratag.fit import measure_layers
from astratag.geometry import LAYERS, TEMPLATE_UNITS, Layer, layer_points, square
from astratag.grow import Fit, fit_own_edges, grow, layer_side_px, settle
from astratag.matching import acceptance_of_pixels, match
from astratag.pose import planar_poses, poses_from_square, refine_on_corners
from astratag.search import (
    BROAD,
    COARSE,
    FAINT,
    NARROW,
    PLAIN,
    SLANTED,
    THIN,
    TINY,
    Outlines,
    bent_quads_of,
    find_outlines,
    quads_of,
)
from astratag.signature import ACCEPT, Artwork, Codebook, Reading, layer_cells
from astratag.surface import Flat, Surface
from astratag.synthesis import Alignment, Synthesis
from astratag.tps import KNOTS
from astratag.transforms import difference
from astratag.warp import BentWarp, FittedWarp, HomographyWarp, PoseWarp

Array = NDArray[np.float64]

HALVE_FROM_PX = 500_000
"""Images with more pixels than this are searched at half resolution first."""
LEAST_LIKENESS = 0.45
"""Correlation of the whole print with what is seen through a fit, below which it is something else."""
CERTAIN_LIKENESS = 0.75
"""Likeness from which no other layer is tried."""
LEAST_LOOKS = (0.72, 0.72, 0.85)
"""Correlation of a square and its surroundings with what it reads, by layer, without which its edges must agree.

More of the innermost, which has no other inside it to tell it by.
"""
ACCEPT_OF_LOOKS, SURE_LOOKS = 0.82, 0.88
"""Correlation from which a square is believed whose edges cannot be measured: with few wrong cells, with more."""
FEW_WRONG, MOST_WRONG = 8, 9
"""Cells of such a square that may be on the wrong side of half way; blur alone puts some there."""
CLEARLY_THAT_LAYER = 0.12
"""How much better such a square must look as one layer than as any other: a wrong one makes the range wrong."""
LIKELY_THAT_LAYER, LIKELY_LOOKS = 0.05, 0.5
"""The same where its edges agree too, of the clearest layer measured; and how well that layer must look."""
MOVED_PX, MOVED = 4.0, 0.1
"""How far an alignment may move corners: pixels, or a fraction of the square's side if that is more."""
LOOKS_SIGMA_PX, LOOKS_SIGMA = 0.3, 0.01
"""Standard deviation of corners that were aligned, not measured: in pixels, and more as a fraction of a bent side."""
AMBIGUOUS_RATIO, AMBIGUOUS_RMS_PX = 4.0, 0.05
"""Both planar poses are tried when the worse fits the corners within this factor of the better, or of this residual."""
SAME_COST, SAME_POSE_RAD = 0.98, 0.02
NOTICEABLE_BEND = 0.02
"""A print of unknown surface is called curved from this bend on, as a fraction of its side."""
GRID_LINES = 9
GRID = np.stack(np.meshgrid(*[np.linspace(0.0, TEMPLATE_UNITS, GRID_LINES)] * 2), axis=-1)
"""The print's regular grid (9, 9, 2), template units, rows from the top."""
PIXEL_BLUR = 0.9
"""Blur from which squares are matched, pixels: a good lens's, and what sampling between pixels adds."""
POLISHED_PX, LEAST_POLISHED = 90.0, 0.95
"""Markers that look smaller than this are measured by all their pixels, not by their edges, where these look right."""
SAME_SQUARE = 0.04
"""Squares whose centres and sides differ by less than this fraction are one."""
MAX_MATCHED = 12
"""Squares compared with the print pixel by pixel, in one image."""
MAX_ALIGNED = 3
"""Candidates moved until they look as they read, in one search."""
MOVES, DAMPING = 8, 0.03
"""Damped Gauss-Newton steps from the plane through a bent square's corners onto the square."""


SQUARES = np.array([square(*layer.black) for layer in LAYERS])
"""The black squares' corners (3, 4, 2), template units."""


@dataclass(frozen=True)
class MarkerSpec:
    """How one marker was made: side of its outer black square in metres, and the surface it is on (None: unknown)."""

    side_m: float
    surface: Surface | None = None

    def __post_init__(self) -> None:
        if self.surface is not None and not isinstance(self.surface, Surface):
            raise ValueError(f"surface must be Flat(), Cylinder(radius_m, axis_rad) or None, got {self.surface!r}")


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
    One detector serves one thread at a time.
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
        self._light = np.zeros((0, 0), dtype=np.float32)
        self._codebook = Codebook(self.dictionary)
        self._artwork = Artwork(self.dictionary)
        self._synthesis = Synthesis(self.dictionary)
        self._accept_of_pixels = acceptance_of_pixels(4 * len(self.dictionary))

    def detect(self, image: NDArray[np.uint8], camera: Camera | None = None) -> list[Detection]:
        """Return the markers in a gray (H, W) or BGR (H, W, 3) uint8 image, the surest first; poses need ``camera``.

        Raises ValueError for another kind of image, or a camera of another size.
        """
        return self.find(self.view(image, camera))

    def find(self, view: View) -> list[Detection]:
        """Return the markers in a whole image, the surest first.

        One way of telling ink from paper after another, the fastest first, as long as nothing sure is found.
        """
        large = view.gray.size > HALVE_FROM_PX
        found: list[Detection] = []
        for how in (COARSE, NARROW, PLAIN, FAINT) if large else (PLAIN, NARROW, FAINT):
            outlines = find_outlines(view.gray, how)
            found += self.search(view, outlines)
            if not _sure(found) and how != COARSE:
                found += self._search_bent(view, outlines)
            if _sure(found) or (found and how != COARSE):
                break
        else:
            found += self._search_pixels(view)
        return surest(found)

    def _search_pixels(self, view: View) -> list[Detection]:
        """Return the markers whose edges or cells cannot be followed, by all their pixels; see ``matching``."""
        tried: list[Array] = []
        for how in (TINY, BROAD, SLANTED, THIN):
            quads = framed(view.gray, quads_of(find_outlines(view.gray, how)))
            fresh = [quad for quad in quads if not any(_alike(quad, before) for before in tried)]
            fresh = fresh[: MAX_MATCHED - len(tried)]
            tried += fresh
            found = [seen for seen in (self._confirm_pixels(view, quad) for quad in fresh) if seen is not None]
            if found:
                return found
        return []

    def _confirm_pixels(self, view: View, quad: Array) -> Detection | None:
        """Return the marker that a rough quad (4, 2) is a layer of."""
        seen = match(self._synthesis, view.light, quad, PIXEL_BLUR, self._accept_of_pixels)
        if seen is None:
            return None
        return self._described_by_pixels(view, seen.marker_id, seen.alignment, seen.layer, seen.correlation, "planar")

    def match_near(self, view: View, marker_id: int, warp: FittedWarp, method: str) -> Detection | None:
        """Return a marker whose print lies where ``warp`` has it to a fraction of a cell, by all its pixels."""
        aligned = self._synthesis.align(view.light, warp, marker_id, PIXEL_BLUR)
        if aligned is None or aligned.correlation < LEAST_POLISHED:
            return None
        scores = self._synthesis.read(view.light, aligned.warp, aligned.blur_px)
        row = self.dictionary.row(marker_id)
        if scores[row, 0] < self._accept_of_pixels or scores.argmax() != 4 * row:
            return None
        return self._described_by_pixels(view, marker_id, aligned, 0, float(scores[row, 0]), method)

    def _described_by_pixels(
        self, view: View, marker_id: int, aligned: Alignment, layer: int, correlation: float, method: str
    ) -> Detection | None:
        """Return the detection an alignment amounts to: one layer, whose corners stand for all pixels of the print."""
        square_px = aligned.warp(SQUARES[layer])
        height, width = view.gray.shape
        if (square_px < 0).any() or (square_px > (width - 1, height - 1)).any():
            return None
        wrong = self._codebook.read_as(layer_cells(view.gray, aligned.warp, layer), marker_id).hamming
        layers = (LayerDetection(layer, square_px, aligned.sigma_px(SQUARES[layer])),)
        covariance = aligned.covariance if isinstance(aligned.warp, PoseWarp) else None
        reading = Reading(marker_id, 0, correlation, wrong)
        return self._described(view, reading, aligned.warp, layers, method, covariance)

    def view(
        self, image: NDArray[np.uint8], camera: Camera | None, boxes: Sequence[NDArray[np.int64]] | None = None
    ) -> View:
        """Return an image made ready: all of it, or only ``boxes`` ((2, 2) pixels: low and high x, y) of its light.

        The light is kept in one buffer, which the next call overwrites: fresh memory costs more than the table.
        Raises ValueError as ``detect`` does.
        """
        gray = as_gray(image)
        if camera is not None:
            camera.require_size(gray.shape[1], gray.shape[0])
        if self._light.shape != gray.shape:
            self._light = np.zeros(gray.shape, dtype=np.float32)
        whole = np.array([(0, 0), gray.shape[::-1]])
        for (left, top), (right, bottom) in [whole] if boxes is None else boxes:
            part = slice(int(top), int(bottom)), slice(int(left), int(right))
            cv2.LUT(gray[part], self._light_of, dst=self._light[part])
        return View(gray, self._light, camera)

    def spec(self, marker_id: int) -> MarkerSpec:
        """Return how a marker was made."""
        return self.markers.get(marker_id, self.default)

    def search(self, view: View, outlines: Outlines) -> list[Detection]:
        """Return the markers among outlines read as if flat, each once, the surest first."""
        return surest(self._confirm_all(view, flat_candidates(view.gray, quads_of(outlines), self._codebook)))

    def _search_bent(self, view: View, outlines: Outlines) -> list[Detection]:
        """Return the markers among outlines with bulging sides, none when every marker is on a plane."""
        if not self._bends:
            return []
        return surest(self._confirm_all(view, bent_candidates(view.gray, bent_quads_of(outlines), self._codebook)))

    @property
    def _bends(self) -> bool:
        """Return whether a marker may be on a curved surface: one that is listed, or any when none is."""
        specs = self.markers.values() or [self.default]
        return any(not isinstance(spec.surface, Flat) for spec in specs)

    def _confirm_all(self, view: View, candidates: Sequence[Candidate]) -> list[Detection]:
        """Return the markers among candidates, each once; by their edges, else the best few after an alignment."""
        found: list[Detection] = []

        def take(candidate: Candidate, detection: Detection | None) -> bool:
            if detection is not None and not _inside_any(detection.corners_px, found):
                found.append(detection)
            return detection is not None

        left = [
            c
            for c in candidates
            if not _inside_any(c.corners_px, found) and (c.bent or not take(c, self._confirm_edges(view, c)))
        ]
        for candidate in [] if _sure(found) else left[:MAX_ALIGNED]:
            if not _inside_any(candidate.corners_px, found):
                take(candidate, self._confirm_aligned(view, candidate))
        return found

    def _confirm_aligned(self, view: View, candidate: Candidate) -> Detection | None:
        """Return the marker a candidate is a layer of, once moved until it looks as it reads; None when it does not.

        What then reads surely is a marker even where its edges are too blurred to be measured.
        """
        sure = aligned(view.gray, candidate, self._codebook, self._artwork)
        if sure is None:
            if candidate.bent or candidate.reading.correlation < ACCEPT_OF_LOOKS:
                return None
            sure = candidate
        if np.abs(sure.corners_px - candidate.corners_px).max() > max(MOVED_PX, MOVED * candidate.side_px):
            return None
        return self._confirm_edges(view, sure) or self._confirm_looks(view, sure)

    def _confirm_looks(self, view: View, candidate: Candidate) -> Detection | None:
        """Return the marker an aligned candidate is a layer of, its corners where the alignment put them."""
        marker_id = candidate.reading.marker_id
        scores = self._artwork.layer_scores(view.gray, candidate.warp, marker_id, candidate.side_px)
        layer = int(scores.argmax())
        reading = candidate.reading
        least = ACCEPT_OF_LOOKS if reading.hamming <= FEW_WRONG else SURE_LOOKS
        if reading.correlation < least or reading.hamming > MOST_WRONG:
            return None
        if scores[layer] < LEAST_LOOKS[layer] or _lead(scores, layer) < CLEARLY_THAT_LAYER:
            return None
        if candidate.bent and layer == len(LAYERS) - 1:
            return None  # nothing inside fixes its bend, and the whole print is over five times as large
        flat = replace(candidate, bent=False)  # a bend does not carry from an inner layer to the whole print
        warp = self._whole_print(candidate if layer == 0 else flat, layer)
        sigma_px = LOOKS_SIGMA_PX + LOOKS_SIGMA * candidate.side_px * candidate.bent
        corners = LayerDetection(layer, candidate.corners_px, sigma_px)
        height, width = view.gray.shape
        if (candidate.corners_px < 0).any() or (candidate.corners_px > (width - 1, height - 1)).any():
            return None
        method = "tps" if candidate.bent else "planar"
        return self._described(view, candidate.reading, warp, (corners,), method)

    def _confirm_edges(self, view: View, candidate: Candidate) -> Detection | None:
        """Return the marker a candidate is a layer of by its edges, None when these, its code or its looks disagree."""
        marker_id = candidate.reading.marker_id
        guesses = self._artwork.layer_scores(view.gray, candidate.warp, marker_id)
        best: tuple[float, Fit | None] = (LEAST_LIKENESS, None)
        for layer in np.argsort(-guesses).tolist():
            fit = self._fit(view, candidate, layer)
            if fit is not None:
                likeness = self._artwork.likeness(view.gray, fit.warp, marker_id)
                best = max(best, (likeness, fit), key=lambda pair: pair[0])
            if best[0] > CERTAIN_LIKENESS:
                break
        likeness, fit = best
        if fit is None:
            return None
        if isinstance(fit.warp, PoseWarp):
            method = "cylinder" if fit.warp.curved else "planar"
        else:
            method = "tps" if candidate.bent or _bend_fraction(fit.warp) > NOTICEABLE_BEND else "planar"
        detection = self.describe(view, marker_id, fit, method)
        if detection is None or not self._layers_agree(view, detection, fit.warp):
            return None
        return self._with_other_pose(view, detection, fit)

    def _layers_agree(self, view: View, detection: Detection, warp: FittedWarp) -> bool:
        """Return whether a measured layer looks like itself and not like another, which may have the same edges."""
        for seen in detection.layers:
            layer = LAYERS[seen.layer]
            side_px = layer_side_px(warp, seen.layer)
            inside = partial(_inside_layer, warp, layer)
            scores = self._artwork.layer_scores(view.gray, inside, detection.marker_id, side_px)
            if scores[seen.layer] >= LIKELY_LOOKS and _lead(scores, seen.layer) >= LIKELY_THAT_LAYER:
                return True
        return False

    def _whole_print(self, candidate: Candidate, layer: int) -> HomographyWarp | BentWarp:
        """Return the warp of the whole print when the candidate is ``layer`` of it."""
        if candidate.bent:
            return BentWarp.from_points(layer_points(KNOTS, LAYERS[layer]), candidate.warp(KNOTS))
        return HomographyWarp.from_points(square(*LAYERS[layer].black), candidate.corners_px)

    def _fit(self, view: View, candidate: Candidate, layer: int) -> Fit | None:
        """Return the fit of a whole marker begun at one layer, None as soon as its code is not read there."""
        marker_id = candidate.reading.marker_id
        starts = list(self._starts(view, candidate, layer))
        if candidate.bent and starts and isinstance(starts[0], BentWarp):
            return grow(view.light, starts[0], layer)
        for start in starts:
            begun = fit_own_edges(view.light, start, layer)
            if begun is not None:
                cells = layer_cells(view.gray, begun.warp, layer)
                if self._codebook.read_as(cells, marker_id).correlation >= PROMISING:
                    return grow(view.light, begun.warp, layer)
        return None

    def _with_other_pose(self, view: View, detection: Detection, fit: Fit) -> Detection:
        """Return the detection fitted from the other planar pose when corners allow both and the edges prefer it."""
        if not isinstance(fit.warp, PoseWarp) or len(detection.planar_poses) < 2:
            return detection
        best, other = (planar.reprojection_rms_px for planar in detection.planar_poses)
        if other > AMBIGUOUS_RATIO * max(best, AMBIGUOUS_RMS_PX):
            return detection
        starts = [planar.T_cam_marker for planar in detection.planar_poses]
        away = [T for T in starts if np.linalg.norm(difference(T, fit.warp.T_cam_marker)[3:]) > SAME_POSE_RAD]
        fits = [settle(view.light, replace(fit.warp, T_cam_marker=T)) for T in away]
        better = min((again for again in fits if again is not None), key=lambda again: again.cost, default=fit)
        if better.cost >= SAME_COST * fit.cost:
            return detection
        return self.describe(view, detection.marker_id, better, detection.method) or detection

    def _starts(self, view: View, candidate: Candidate, layer: int) -> Iterator[FittedWarp]:
        """Yield warps to start fitting from when the candidate is ``layer`` of its marker."""
        spec = self.spec(candidate.reading.marker_id)
        template = square(*LAYERS[layer].black)
        if view.camera is not None and spec.surface is not None:
            knots = layer_points(KNOTS, LAYERS[layer])
            for T in poses_from_square(view.camera, template, candidate.corners_px, spec.side_m, spec.surface):
                start = PoseWarp(view.camera, spec.side_m, spec.surface, T)
                yield moved_onto(start, knots, candidate.warp(KNOTS)) if candidate.bent else start
        else:
            yield self._whole_print(candidate, layer)

    def describe(self, view: View, marker_id: int, fit: Fit, method: str) -> Detection | None:
        """Return the detection a fit amounts to, None when the code read through it is not the marker's."""
        reading = self._read_through(view, fit.warp, marker_id)
        if reading is None or reading.correlation < ACCEPT:
            return None
        if layer_side_px(fit.warp, 0) < POLISHED_PX and not isinstance(fit.warp, BentWarp):
            polished = self.match_near(view, marker_id, fit.warp, method)
            if polished is not None:
                return polished
        layers = measure_layers(fit, view.gray.shape)
        if isinstance(fit.warp, PoseWarp):
            return self._described(view, reading, fit.warp, layers, method, fit.covariance)
        return self._described(view, reading, fit.warp, layers, method)

    def _described(
        self,
        view: View,
        reading: Reading,
        warp: FittedWarp,
        layers: tuple[LayerDetection, ...],
        method: str,
        covariance: Array | None = None,
    ) -> Detection:
        """Return a detection; ``covariance`` is of a warp that is a pose."""
        spec = self.spec(reading.marker_id)
        curved = method == "tps" or (isinstance(warp, PoseWarp) and warp.curved)
        T_cam_marker = rms_px = None
        poses: tuple[PlanarPose, ...] = ()
        if view.camera is not None:
            surface = spec.surface or Flat()
            poses = planar_poses(view.camera, layers, spec.side_m, surface)
            if isinstance(warp, PoseWarp):
                T_cam_marker = warp.T_cam_marker
                rms_px = _corner_rms(warp, layers) if layers else None
            elif poses:
                start = PoseWarp(view.camera, spec.side_m, surface, poses[0].T_cam_marker)
                T_cam_marker, covariance, rms_px = refine_on_corners(start, layers)
        return Detection(
            family=self.dictionary.family,
            marker_id=reading.marker_id,
            corners_px=next((seen.corners_px for seen in layers if seen.layer == 0), warp(OUTER)),
            layers=layers,
            correlation=reading.correlation,
            hamming=reading.hamming,
            method=method,
            planar_poses=poses,
            T_cam_marker=T_cam_marker,
            covariance=covariance,
            reprojection_rms_px=rms_px,
            warp_grid_px=warp_grid(warp) if curved else None,
        )

    def _read_through(self, view: View, warp: FittedWarp, marker_id: int) -> Reading | None:
        """Return the best reading of one identity among the layers that are whole in the image.

        The larger layers come first, and one that is sure will do.
        """
        height, width = view.gray.shape
        best: Reading | None = None
        for layer, corners in zip(LAYERS, warp(SQUARES), strict=True):
            if (corners >= 0).all() and (corners <= (width - 1, height - 1)).all():
                reading = self._codebook.read_as(layer_cells(view.gray, warp, layer.index), marker_id)
                best = reading if best is None or reading.correlation > best.correlation else best
                if best.correlation >= SURE:
                    break
        return best


def _alike(quad: Array, other: Array) -> bool:
    """Return whether two quads (4, 2) are one square found twice."""
    centre, sides_px = quad.mean(axis=0) - other.mean(axis=0), looks_large(np.stack([quad, other]))
    return bool(np.abs(centre).max() < SAME_SQUARE * sides_px.min() and np.ptp(sides_px) < SAME_SQUARE * sides_px.min())


def moved_onto(warp: PoseWarp, template: Array, points_px: Array) -> PoseWarp:
    """Return a pose moved until template points (N, 2) of its print lie nearest to where they are seen (N, 2)."""
    for _ in range(MOVES):
        J = warp.jacobian(template).reshape(-1, 6)
        scale = np.linalg.norm(J, axis=0) + 1e-12
        left = (points_px - warp(template)).ravel()
        damped = np.vstack([J / scale, DAMPING * np.eye(6)])
        delta = np.linalg.lstsq(damped, np.append(left, np.zeros(6)), rcond=None)[0]
        warp = warp.stepped(delta / scale)
    return warp


def _inside_layer(warp: FittedWarp, layer: Layer, points: Array) -> Array:
    """Return the pixels of points (..., 2) given as if ``layer`` were the outermost square."""
    return warp(layer_points(points, layer))


def _lead(scores: Array, layer: int) -> float:
    """Return how much better one layer's score (3,) is than the best of the others."""
    return float(scores[layer] - np.delete(scores, layer).max())


def _sure(found: Sequence[Detection]) -> bool:
    """Return whether markers were found and all of them surely."""
    return bool(found) and all(seen.correlation >= SURE for seen in found)


def _bend_fraction(warp: FittedWarp) -> float:
    """Return how far a print is bent, as a fraction of its side."""
    return float(np.abs(warp.bend).max()) / layer_side_px(warp, 0) if isinstance(warp, BentWarp) else 0.0


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
    return warp(GRID)


def _corner_rms(warp: PoseWarp, layers: Sequence[LayerDetection]) -> float:
    """Return the root mean square distance in pixels of the measured corners from where the pose puts them."""
    errors = warp(SQUARES[[seen.layer for seen in layers]]) - np.stack([seen.corners_px for seen in layers])
    return float(np.sqrt((errors**2).sum(axis=-1).mean()))


def surest(found: Sequence[Detection], first: Sequence[Detection] = ()) -> list[Detection]:
    """Return ``first`` and the detections that overlap neither these nor a surer one, the surest first."""
    kept = list(first)
    for seen in sorted(found, key=lambda seen: -seen.correlation):
        if not _inside_any(seen.corners_px, kept):
            kept.append(seen)
    return sorted(kept, key=lambda seen: -seen.correlation)


def _inside_any(corners_px: Array, found: Sequence[Detection]) -> bool:
    """Return whether a square's centre lies inside a marker already found, or a found marker's centre inside it."""

    def holds(outer: Array, inner: Array) -> bool:
        return cv2.pointPolygonTest(outer.astype(np.float32), inner.mean(axis=0).tolist(), False) >= 0

    return any(holds(seen.corners_px, corners_px) or holds(corners_px, seen.corners_px) for seen in found)
