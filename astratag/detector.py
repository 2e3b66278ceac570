"""The detector: markers in one image, with no memory.

The method, in order: find quads; read each as if it were flat; for the promising ones decide which layer of
the marker was seen; fit the whole marker's edges, from that layer outwards and inwards; read it again
through the fit and accept it or not; measure each layer's corners; find the pose.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from astratag.camera import Camera
from astratag.candidates import (
    LEAST_LIKENESS,
    MANY_WARPS,
    OUTER,
    SURE,
    Candidate,
    aligned,
    bent_candidates,
    flat_candidates,
    framed,
    relit_candidates,
)
from astratag.checks import instance, picture, positive
from astratag.codes.acceptance import FALSE_ACCEPT_RATE, chance_of_correlation
from astratag.codes.soft import CREDIBLE
from astratag.curved import (
    PrintLike,
    Seen,
    clearly_bent,
    covariance_of,
    curved_candidates,
    facing,
    fine_outlines,
    moved_onto,
    near_sides,
    on_cylinder,
    seen_whole,
)
from astratag.cylinder import Bent, CylinderWarp, assumed_camera, bent_beside, bent_through
from astratag.detection import Detection, LayerDetection, PlanarPose
from astratag.dictionary import Dictionary, load_dictionary
from astratag.edges import BORDER_UNITS, Transfer, inverse_transfer
from astratag.effort import Tries, first_distinct
from astratag.fit import follows_all_sides
from astratag.geometry import LAYERS, TEMPLATE_UNITS, Layer, layer_points, square
from astratag.grow import CURVED_GAIN, Fit, fit_own_edges, grow, layer_side_px, settle
from astratag.layers import measure_layers
from astratag.matching import INDEPENDENT_CELLS, Rough, acceptance_of_pixels, match, rough_matches
from astratag.neighbours import Crossings, crossings
from astratag.pose import planar_poses, poses_from_square, refine_on_corners
from astratag.relight import RELIT_SAMPLES, relit_layer
from astratag.search import (
    BROAD,
    COARSE,
    FAINT,
    NARROW,
    PLAIN,
    SLANTED,
    THIN,
    TINY,
    Binarisation,
    Outlines,
    bent_quads_of,
    find_outlines,
    quads_of,
)
from astratag.signature import EFFECTIVE_SHARE, Artwork, Codebook, Reading, Warp, layer_cells
from astratag.surface import Cylinder, Flat, Surface
from astratag.synthesis import Alignment, Synthesis
from astratag.tps import KNOTS
from astratag.transforms import difference
from astratag.warp import OUTSIDE_PX, BentWarp, FittedWarp, HomographyWarp, PoseWarp

Array = NDArray[np.float64]

LEAST_IMAGE_PX = 8
"""Images narrower than this hold no marker that could be read."""
HALVE_FROM_PX = 500_000
"""Parts of an image with more pixels than this are searched at half resolution; in whole ones, thin borders come first.
"""
LIKELY = 0.68
"""Correlation through a rough quad from which it is looked at even where surer ones were markers."""
COST_LIMIT = 1.0
"""Mean truncated squared residual (of 9 at most) above which a fit that was begun near its end is not believed."""
CERTAIN_LIKENESS = 0.75
"""Likeness from which no other layer is tried."""
LEAST_LOOKS = (0.72, 0.72, 0.85)
"""Correlation of a square and its surroundings with what it reads, by layer, without which its edges must agree.

More of the innermost, which has no other inside it to tell it by.
"""
CHANCE_OF_LOOKS, MORE_OF_WRONG = 0.0025, 0.06
"""The share of squares, of those that read like a marker by chance, that look like it as well: what a square may pass
whose edges cannot be measured.  And how much better its code must correlate with more than a few wrong cells."""
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
IMPOSSIBLE = 1e-6
"""Planar poses that the corners leave less than this probability are not tried."""
SAME_COST, SAME_POSE_RAD = 0.98, 0.02
FLAT_COST, FLAT_LIKENESS = 0.05, 0.93
"""A plane that explains edges and looks as well as this needs no rival."""
SAME_LIKENESS, MORE_LIKE = 0.01, 0.05
"""A print looks the same through two warps, and clearly more like the marker through one, from these differences on."""
NOTICEABLE_BEND = 0.02
"""A print of unknown surface is called curved from this bend on, as a fraction of its side."""
GRID_LINES = 9
GRID = np.stack(np.meshgrid(*[np.linspace(0.0, TEMPLATE_UNITS, GRID_LINES)] * 2), axis=-1)
"""The print's regular grid (9, 9, 2), template units, rows from the top."""
EVERY_WAY = (PLAIN, NARROW, FAINT)
"""Ways of telling ink from paper in which listed markers are looked for that were not found at once."""
COVER_REACH_PX = 30_000
"""OpenCV draws no further."""
WARPS = 2 * len(LAYERS)
"""How often a candidate is read whose edges are measured: in each layer, in even light and relit."""
PIXEL_BLUR = 0.9
"""Blur from which squares are matched, pixels: a good lens's, and what sampling between pixels adds."""
POLISHED_PX, ALIGNED_POLISHED_PX, LEAST_POLISHED = 75.0, 90.0, 0.95
"""Markers that look smaller than this are measured by all their pixels, not by their edges, where these look right.

The second is for those whose edges could not be measured at all.
"""
MAX_READ_BY_PIXELS, MAX_MATCHED = 12, 5
"""Squares in one image that are read by all their pixels; and that are aligned with a print."""
MAX_BY_EDGES, MAX_ALIGNED, MAX_CURVED = 12, 8, 12
"""Candidates in one image whose edges are fitted; that are moved until they look as they read; and so on cylinders."""
MAX_ALIGNED_AT_ONCE = 4
"""Of the latter two, those found by one way of telling ink from paper."""


SQUARES = np.array([square(*layer.black) for layer in LAYERS])
"""The black squares' corners (3, 4, 2), template units."""
SQUARES.flags.writeable = False
CELLS_WITHIN = np.array([layer_points(square(BORDER_UNITS, TEMPLATE_UNITS - BORDER_UNITS), layer) for layer in LAYERS])
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


@dataclass(frozen=True, eq=False)
class View:
    """One image as the detector works on it: gray, in linear light, and with its camera.

    ``by_edges`` and ``aligned`` hold what was looked at closely in it, and end that when it was enough.
    """

    gray: NDArray[np.uint8]
    light: NDArray[np.float32]
    camera: Camera | None
    by_edges: Tries = field(default_factory=lambda: Tries(MAX_BY_EDGES))
    aligned: Tries = field(default_factory=lambda: Tries(MAX_ALIGNED))
    curved: Tries = field(default_factory=lambda: Tries(MAX_CURVED))

    @property
    def some_camera(self) -> Camera:
        """Return the camera, or one like most when it is not known: to bend prints with, not for poses."""
        return self.camera or assumed_camera(self.gray.shape[1], self.gray.shape[0])


class Detector:
    """Finds the markers of a dictionary in single images.

    ``side_m`` and ``surface`` hold for every marker that ``markers`` (id to ``MarkerSpec``) does not list.
    ``surface`` None is unknown: the code is read as flat, else through a thin-plate spline, and the pose is as
    if flat.  ``transfer`` is how the camera encodes light: "srgb" (ordinary 8-bit cameras) or "linear".
    ``false_accept_rate`` is the share of candidates without a marker that may read as one by chance; which correlation
    that asks for follows from the dictionary.  ``tau_hamming`` sets the paper's rule instead: at most so many wrong
    cells (its 3, 5 and 10), whatever the chance of that, and none that cannot be seen.
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
        false_accept_rate: float = FALSE_ACCEPT_RATE,
        tau_hamming: int | None = None,
    ) -> None:
        self.dictionary = dictionary if isinstance(dictionary, Dictionary) else load_dictionary(dictionary)
        self.default = MarkerSpec(side_m, surface)
        self.markers = _listed(markers, self.dictionary)
        self._light_of = inverse_transfer(transfer)
        self._light = np.zeros((0, 0), dtype=np.float32)
        self._codebook = Codebook(self.dictionary, false_accept_rate, tau_hamming)
        self._artwork = Artwork(self.dictionary)
        self._synthesis = Synthesis(self.dictionary)
        self._accept_of_pixels = acceptance_of_pixels(4 * len(self.dictionary), false_accept_rate)

    def detect(self, image: NDArray[np.uint8], camera: Camera | None = None) -> list[Detection]:
        """Return the markers in a gray (H, W) or BGR (H, W, 3) uint8 image, the surest first; poses need ``camera``.

        Raises ValueError for another kind of image, or a camera of another size.
        """
        view = self.view(image, camera)
        return self.find_missing(view, self.find(view))

    def find(self, view: View) -> list[Detection]:
        """Return the markers in a whole image, the surest first.

        A quick look at half resolution, then one way of telling ink from paper after another, as long as nothing sure
        is found; see ``View`` for how much of that one image is worth.
        """
        if min(view.gray.shape) < LEAST_IMAGE_PX:
            return []
        found = self.search(view, find_outlines(view.gray, COARSE), whole=True)
        large = view.gray.size > HALVE_FROM_PX
        for how in (NARROW, PLAIN, FAINT) if large else (PLAIN, NARROW, FAINT):
            if _sure(found):
                break
            outlines = find_outlines(view.gray, how)
            found += self.search(view, outlines)
            if not _sure(found):
                found += self._search_relit(view, quads_of(outlines))
            if not _sure(found) and how == PLAIN:
                found += self._search_bent(view, outlines)
            if found:
                break
        return (
            surest(found) or self._search_very_bent(view) or self._search_pixels(view) or self._search_by_spline(view)
        )

    def find_missing(
        self, view: View, found: Sequence[Detection], ways: Sequence[Binarisation] = EVERY_WAY
    ) -> list[Detection]:
        """Return what is found and the listed markers that are missing in it, looked for in one way after another.

        ``find`` ends with something sure, and a small, bent or faint marker beside it may be lost.  Those that were
        listed are worth another look where nothing is found yet, and nothing else is taken from it.
        """
        found = list(found)
        for how in ways if found else ():
            missing = set(self.markers) - {seen.marker_id for seen in found}
            if not missing:
                break
            rest = replace(view, gray=_covered(view.gray, found))
            outlines = find_outlines(rest.gray, how)
            others = [*self.search(rest, outlines), *self._search_bent(rest, outlines)]
            found = surest([seen for seen in others if seen.marker_id in missing], first=found)
        return found

    def _search_pixels(self, view: View) -> list[Detection]:
        """Return the markers whose edges or cells cannot be followed, by all their pixels; see ``matching``.

        Those in uneven light are read cell by cell.
        """
        tried, left = np.zeros((0, 4, 2)), MAX_MATCHED
        for how in (TINY, BROAD, SLANTED, THIN):
            quads = quads_of(find_outlines(view.gray, how))
            found = self._search_relit(view, quads)
            if found:
                return found
            fresh = first_distinct(framed(view.gray, quads), tried, MAX_READ_BY_PIXELS - len(tried))
            tried = np.concatenate([tried, fresh])
            rough = rough_matches(self._synthesis, view.light, fresh, PIXEL_BLUR)[:left]
            left -= len(rough)
            found = [seen for seen in (self._confirm_pixels(view, one) for one in rough) if seen is not None]
            if found or left == 0:
                return found
        return []

    def _confirm_pixels(self, view: View, rough: Rough) -> Detection | None:
        """Return the marker that a rough square is a layer of."""
        seen = match(self._synthesis, view.light, rough, PIXEL_BLUR, self._accept_of_pixels)
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
        if not _inside(square_px, view.gray.shape):
            return None
        wrong = self._codebook.read_as(layer_cells(view.light, aligned.warp, layer), marker_id).hamming
        if self._codebook.tau_hamming is not None and wrong > self._codebook.tau_hamming:
            return None
        layers = (LayerDetection(layer, square_px, aligned.sigma_px(SQUARES[layer])),)
        is_pose = isinstance(aligned.warp, PoseWarp | CylinderWarp)
        covariance = aligned.cautious_covariance[:6, :6] if is_pose else None
        reading = Reading(marker_id, 0, correlation, wrong, cells=INDEPENDENT_CELLS)
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
            instance(camera, Camera, "camera", "Camera.load(path) reads one")
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

    def near(self, marker_id: int) -> Crossings:
        """Return what lies beside the edges in a marker's print."""
        return crossings(self.dictionary.signature(marker_id).tobytes())

    def search(self, view: View, outlines: Outlines, *, whole: bool = False) -> list[Detection]:
        """Return the markers among outlines read as if flat, each once, the surest first; see ``quads_of``."""
        quads = quads_of(outlines, whole=whole)
        return surest(self._confirm_all(view, flat_candidates(view.gray, quads, self._codebook), whole))

    def _search_relit(self, view: View, quads: Array) -> list[Detection]:
        """Return the markers among quads (Q, 4, 2) in glare, hard shadow or half covered."""
        if self._codebook.tau_hamming is not None:
            return []
        return surest(self._confirm_all(view, relit_candidates(view.gray, view.light, quads, self._codebook)))

    def _search_bent(self, view: View, outlines: Outlines) -> list[Detection]:
        """Return the markers among outlines bent about cylinders, none when every marker is on a plane."""
        if not self._bends:
            return []
        quads = np.concatenate([quads_of(outlines), bent_quads_of(outlines).corners_px])
        return self._search_curved(view, bent_through(view.some_camera, quads))

    def _search_very_bent(self, view: View) -> list[Detection]:
        """Return the markers bent about cylinders so much, or so far turned, that none was found otherwise."""
        if not self._bends:
            return []
        fine = fine_outlines(view.gray) if view.gray.size <= HALVE_FROM_PX else find_outlines(view.gray, NARROW)
        beside = bent_beside(view.some_camera, near_sides(view.gray))
        return self._search_bent(view, fine) or self._search_curved(view, beside)

    def _search_by_spline(self, view: View) -> list[Detection]:
        """Return the markers on surfaces that no cylinder explains."""
        if not self._bends:
            return []
        bent = bent_quads_of(find_outlines(view.gray, PLAIN))
        return surest(self._confirm_all(view, bent_candidates(view.gray, bent, self._codebook)))

    def _search_curved(self, view: View, bent: Bent) -> list[Detection]:
        """Return the markers among squares bent about cylinders."""
        return surest(self._confirm_all(view, curved_candidates(view.gray, bent, self._codebook)))

    @property
    def _bends(self) -> bool:
        """Return whether a marker may be on a curved surface: one that is listed, or any when none is."""
        specs = self.markers.values() or [self.default]
        return any(not isinstance(spec.surface, Flat) for spec in specs)

    def _confirm_all(self, view: View, candidates: Sequence[Candidate], quick: bool = False) -> list[Detection]:
        """Return the markers among candidates, each once; by their edges, else the best few after an alignment."""
        found: list[Detection] = []
        unmeasured: list[Detection] = []

        def take(candidate: Candidate, detection: Detection | None) -> bool:
            if detection is not None and not _inside_any(detection.corners_px, found):
                (found if detection.layers else unmeasured).append(detection)
            return detection is not None and bool(detection.layers)

        left: list[Candidate] = []
        for candidate in candidates:
            weak = candidate.reading.correlation < LIKELY and _sure(found)
            if weak or _inside_any(candidate.corners_px, found):
                continue
            by_edges = not candidate.bent and view.by_edges.take(candidate)
            if not (by_edges and take(candidate, self._confirm_edges(view, candidate))):
                left.append(candidate)
        for candidate in [] if _sure(found) or quick else left[:MAX_ALIGNED_AT_ONCE]:
            tries = view.curved if isinstance(candidate.warp, CylinderWarp) else view.aligned
            if not _inside_any(candidate.corners_px, found) and tries.take(candidate):
                take(candidate, self._confirm_aligned(view, candidate))
        return found + [seen for seen in surest(unmeasured) if not _inside_any(seen.corners_px, found)]

    def _confirm_aligned(self, view: View, candidate: Candidate) -> Detection | None:
        """Return the marker a candidate is a layer of, once moved until it looks as it reads; None when it does not.

        What then reads surely is a marker even where its edges are too blurred to be measured.
        """
        if isinstance(candidate.warp, CylinderWarp):
            return self._confirm_curved(view, candidate)
        sure = aligned(view.gray, candidate, self._codebook, self._artwork)
        if sure is None:
            if candidate.bent or candidate.reading.correlation < self._codebook.least_blurred(CHANCE_OF_LOOKS):
                return None
            sure = candidate
        if np.abs(sure.corners_px - candidate.corners_px).max() > max(MOVED_PX, MOVED * candidate.side_px):
            return None
        by_edges = self._confirm_edges(view, sure)
        if by_edges is not None and by_edges.layers:
            return by_edges
        return self._confirm_looks(view, sure) or by_edges

    def _confirm_curved(self, view: View, candidate: Candidate) -> Detection | None:
        """Return the marker a square bent about a cylinder is a layer of, by its edges where these can be measured."""
        marker_id = candidate.reading.marker_id
        spec = self.spec(marker_id)
        if isinstance(spec.surface, Flat):
            return None
        seen = seen_whole(view.gray, candidate, spec.side_m, self._codebook, self._artwork)
        if seen is None:
            return None
        warp: FittedWarp = seen.warp
        if view.camera is not None and spec.surface is not None:
            pose = PoseWarp(view.camera, spec.side_m, spec.surface, seen.warp.pose.T_cam_marker)
            warp = moved_onto(pose, layer_points(KNOTS, LAYERS[seen.layer]), seen.square(KNOTS))
        fit = settle(view.light, warp, self.near(marker_id))
        if spec.surface is None and not self._clearly_bent(view, marker_id, seen, fit):
            flat = HomographyWarp.from_points(OUTER, seen.square(OUTER))
            flat_candidate = replace(candidate, corners_px=flat(OUTER), warp=flat, bent=False)
            return self._confirm_aligned(view, flat_candidate)
        looks = None if fit is None else self._artwork.layer_scores(view.gray, fit.warp, marker_id)
        if fit is not None and looks is not None and looks[0] > LEAST_LIKENESS:
            detection = self.describe(view, marker_id, fit, "cylinder", MANY_WARPS)
            if detection is not None and self._layers_agree(view, detection, fit.warp, looks):
                return detection
        sigma_px = LOOKS_SIGMA_PX + LOOKS_SIGMA * candidate.side_px
        corners = LayerDetection(seen.layer, warp(SQUARES[seen.layer]), sigma_px)
        covariance = covariance_of(warp, layer_points(KNOTS, LAYERS[seen.layer]), sigma_px)
        return self._described(view, seen.reading, warp, (corners,), "cylinder", covariance[:6, :6])

    def _clearly_bent(self, view: View, marker_id: int, seen: Seen, fit: Fit | None) -> bool:
        """Return whether no plane explains what is seen of a print nearly as well as a cylinder."""
        plane = HomographyWarp.from_points(SQUARES[seen.layer], seen.warp(SQUARES[seen.layer]))
        if fit is None:
            return self._more_like(view, marker_id, facing(seen.warp), plane)
        flat = settle(view.light, plane, self.near(marker_id))
        return clearly_bent(fit) and (flat is None or fit.cost < CURVED_GAIN * flat.cost)

    def _confirm_looks(self, view: View, candidate: Candidate) -> Detection | None:
        """Return the marker an aligned candidate is a layer of, its corners where the alignment put them."""
        marker_id = candidate.reading.marker_id
        scores = self._artwork.layer_scores(view.gray, candidate.warp, marker_id, candidate.side_px)
        layer = int(scores.argmax())
        reading = candidate.reading
        least = self._codebook.least_blurred(CHANCE_OF_LOOKS) + MORE_OF_WRONG * (reading.hamming > FEW_WRONG)
        most_wrong = MOST_WRONG if self._codebook.tau_hamming is None else min(MOST_WRONG, self._codebook.tau_hamming)
        if reading.correlation < least or reading.hamming > most_wrong:
            return None
        if scores[layer] < LEAST_LOOKS[layer] or _lead(scores, layer) < CLEARLY_THAT_LAYER:
            return None
        if candidate.bent and layer == len(LAYERS) - 1:
            return None  # nothing inside fixes its bend, and the whole print is over five times as large
        flat = replace(candidate, bent=False)  # a bend does not carry from an inner layer to the whole print
        warp = self._whole_print(candidate if layer == 0 else flat, layer)
        sigma_px = LOOKS_SIGMA_PX + LOOKS_SIGMA * candidate.side_px * candidate.bent
        corners = LayerDetection(layer, candidate.corners_px, sigma_px)
        if not _inside(candidate.corners_px, view.gray.shape):
            return None
        if self.spec(marker_id).surface is None:
            fit = self._curved_fit(view, marker_id, (corners,))
            if fit is not None and self._more_like(view, marker_id, fit.warp, warp):
                detection = self.describe(view, marker_id, fit, "cylinder", MANY_WARPS)
                if detection is not None:
                    return detection
        method = "tps" if candidate.bent else "planar"
        detection = self._described(view, candidate.reading, warp, (corners,), method)
        return self.polished(view, detection, ALIGNED_POLISHED_PX)

    def _more_like(self, view: View, marker_id: int, warp: Warp, other: Warp) -> bool:
        """Return whether the whole print looks clearly more like the marker through one warp than through another."""
        likeness, before = (self._artwork.likeness(view.gray, each, marker_id) for each in (warp, other))
        return likeness > before + MORE_LIKE

    def _confirm_edges(self, view: View, candidate: Candidate) -> Detection | None:
        """Return the marker a candidate is a layer of by its edges, None when these, its code or its looks disagree."""
        marker_id = candidate.reading.marker_id
        guesses = self._artwork.layer_scores(view.gray, candidate.warp, marker_id)
        fits: list[tuple[float, Fit, Array]] = []
        for layer in np.argsort(-guesses).tolist():
            if guesses[layer] < LEAST_LIKENESS and not candidate.relit:
                break
            fit = self._fit(view, candidate, layer)
            looks = None if fit is None else self._artwork.layer_scores(view.gray, fit.warp, marker_id)
            if fit is not None and looks is not None and looks[0] > LEAST_LIKENESS:
                fits.append((_lead(looks, 0), fit, looks))
                if looks[0] > CERTAIN_LIKENESS and _lead(looks, 0) >= LIKELY_THAT_LAYER:
                    break
        for _, fit, looks in sorted(fits, key=lambda found: -found[0]):
            detection = self._fitted(view, candidate, fit, looks)
            if detection is not None:
                return detection
        return None

    def _fitted(self, view: View, candidate: Candidate, fit: Fit, looks: Array) -> Detection | None:
        """Return the marker that a candidate is by a fit, None when it does not read or look so."""
        marker_id = candidate.reading.marker_id
        if self.spec(marker_id).surface is None and not isinstance(fit.warp, PoseWarp | CylinderWarp):
            as_seen = self._as_bent_as_seen(view, marker_id, fit, float(looks[0]))
            if as_seen is not fit:
                fit, looks = as_seen, self._artwork.layer_scores(view.gray, as_seen.warp, marker_id)
            if fit.cost >= COST_LIMIT and not candidate.relit:
                return None  # neither flat nor bent so gently
        if isinstance(fit.warp, CylinderWarp):
            method = "cylinder"
        elif isinstance(fit.warp, PoseWarp):
            method = "cylinder" if fit.warp.curved else "planar"
        else:
            bent = isinstance(fit.warp, BentWarp) and (candidate.bent or _bend_fraction(fit.warp) > NOTICEABLE_BEND)
            method = "tps" if bent else "planar"
        detection = self.describe(view, marker_id, fit, method, MANY_WARPS if candidate.bent else WARPS)
        if detection is None or not self._layers_agree(view, detection, fit.warp, looks):
            return None
        if not detection.layers and not follows_all_sides(fit):
            return None  # nothing says where it is
        return self.polished(view, self.with_other_pose(view, detection, fit))

    def polished(self, view: View, detection: Detection, below_px: float = POLISHED_PX) -> Detection:
        """Return a detection measured again by all its pixels when it looks small: from each pose its corners allow."""
        sides_px = np.linalg.norm(np.roll(detection.corners_px, -1, axis=0) - detection.corners_px, axis=1)
        if detection.method in ("tps", "cylinder") and self.spec(detection.marker_id).surface is None:
            return detection
        if sides_px.sum() / 4 >= below_px:
            return detection
        spec = self.spec(detection.marker_id)
        starts: list[FittedWarp] = [HomographyWarp.from_points(OUTER, detection.corners_px)]
        if view.camera is not None and spec.surface is not None and detection.T_cam_marker is not None:
            mirrored = [
                planar.T_cam_marker
                for planar in detection.planar_poses
                if planar.probability > IMPOSSIBLE and _apart(planar.T_cam_marker, detection.T_cam_marker)
            ]
            poses = [detection.T_cam_marker, *mirrored]
            starts = [PoseWarp(view.camera, spec.side_m, spec.surface, T_cam_marker) for T_cam_marker in poses]
        aligned = [self._synthesis.align(view.light, start, detection.marker_id, PIXEL_BLUR) for start in starts]
        best = max((one for one in aligned if one is not None), key=lambda one: one.correlation, default=None)
        if best is None or best.correlation < LEAST_POLISHED:
            return detection
        again = self._described_by_pixels(view, detection.marker_id, best, 0, detection.correlation, detection.method)
        if again is None:
            return detection
        both = detection.planar_poses or again.planar_poses
        return replace(again, planar_poses=both, hamming=detection.hamming, cells=detection.cells)

    def _as_bent_as_seen(self, view: View, marker_id: int, fit: Fit, likeness: float) -> Fit:
        """Return the simplest fit that explains a print on an unknown surface: a plane's, a cylinder's, or as it was.

        What is more bent must explain the edges clearly better, for it always does so a little.
        """
        bent = isinstance(fit.warp, BentWarp)
        if not bent and fit.cost < FLAT_COST and likeness > FLAT_LIKENESS:
            return fit
        plane = HomographyWarp.from_points(OUTER, fit.warp(OUTER))
        flat = settle(view.light, plane, self.near(marker_id)) if bent else fit
        curved = self._curved_fit(view, marker_id, measure_layers(fit, view.gray.shape))
        if curved is not None:
            better = flat is None or curved.cost < CURVED_GAIN * flat.cost
            explains = self._artwork.likeness(view.gray, curved.warp, marker_id)
            if explains > likeness + (-SAME_LIKENESS if better else SAME_LIKENESS):
                return curved
        if not bent or flat is None or fit.cost < CURVED_GAIN * flat.cost:
            return fit
        return flat if self._artwork.likeness(view.gray, flat.warp, marker_id) > likeness - SAME_LIKENESS else fit

    def _curved_fit(self, view: View, marker_id: int, layers: Sequence[LayerDetection]) -> Fit | None:
        """Return the fit of a whole print on a cylinder, begun at measured layers; None when poor or hardly bent."""
        like = PrintLike(view.some_camera, self.spec(marker_id).side_m, self.near(marker_id))
        fit = on_cylinder(view.light, view.gray, layers, marker_id, self._artwork, like)
        return fit if fit is not None and fit.cost < COST_LIMIT and clearly_bent(fit) else None

    def _layers_agree(self, view: View, detection: Detection, warp: FittedWarp, looks: Array) -> bool:
        """Return whether a measured layer looks like itself and not like another, which may have the same edges.

        Of a marker none of whose layers shows all four edges, any layer.  ``looks`` (3,) is how much the whole print
        looks like each, which will do where its outer square was measured.
        """
        for layer in [seen.layer for seen in detection.layers] or range(len(LAYERS)):
            if layer == 0 and looks[0] >= LIKELY_LOOKS and _lead(looks, 0) >= LIKELY_THAT_LAYER:
                return True
            inside = partial(_inside_layer, warp, LAYERS[layer])
            scores = self._artwork.layer_scores(view.gray, inside, detection.marker_id, layer_side_px(warp, layer))
            if scores[layer] >= LIKELY_LOOKS and _lead(scores, layer) >= LIKELY_THAT_LAYER:
                return True
        return False

    def _whole_print(self, candidate: Candidate, layer: int) -> FittedWarp:
        """Return the warp of the whole print when the candidate is ``layer`` of it."""
        if isinstance(candidate.warp, CylinderWarp):
            return candidate.warp.of_whole(self.spec(candidate.reading.marker_id).side_m, LAYERS[layer].scale)
        if candidate.bent:
            return BentWarp.from_points(layer_points(KNOTS, LAYERS[layer]), candidate.warp(KNOTS))
        return HomographyWarp.from_points(square(*LAYERS[layer].black), candidate.corners_px)

    def _fit(self, view: View, candidate: Candidate, layer: int) -> Fit | None:
        """Return the fit of a whole marker begun at one layer, None as soon as its code is not read there."""
        marker_id = candidate.reading.marker_id
        starts = list(self._starts(view, candidate, layer))
        if candidate.bent and starts and isinstance(starts[0], BentWarp):
            return grow(view.light, starts[0], layer, self.near(marker_id))
        for start in starts:
            begun = fit_own_edges(view.light, start, layer)
            if begun is not None or candidate.aligned:  # with a side covered, a layer alone cannot be fitted
                warp = start if begun is None else begun.warp
                reading = self._read_layer(view, warp, layer, marker_id, candidate.relit)
                if reading.correlation >= self._codebook.likely(reading.cells):
                    if layer == 0 and isinstance(warp, PoseWarp) and not warp.curved:
                        settled = settle(view.light, warp, self.near(marker_id))  # others should be near, too
                        if settled is not None and settled.cost < COST_LIMIT:
                            return settled
                    return grow(view.light, warp, layer, self.near(marker_id))
        return None

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
    ) -> Detection:
        """Return a detection; ``covariance`` is of a warp that is a pose."""
        spec = self.spec(reading.marker_id)
        seen_from = warp.pose if isinstance(warp, CylinderWarp) else warp
        surface = seen_from.surface if isinstance(seen_from, PoseWarp) else spec.surface or Flat()
        curved = method == "tps" or (isinstance(seen_from, PoseWarp) and seen_from.curved)
        measured = [seen.corners_px for seen in layers if seen.layer == 0]
        T_cam_marker = rms_px = None
        poses: tuple[PlanarPose, ...] = ()
        if view.camera is not None:
            fitted = seen_from.T_cam_marker if isinstance(seen_from, PoseWarp) else None
            poses = planar_poses(view.camera, layers, spec.side_m, surface, fitted)
            if isinstance(seen_from, PoseWarp):
                T_cam_marker = seen_from.T_cam_marker
                rms_px = next((pose.reprojection_rms_px for pose in poses if pose.T_cam_marker is fitted), None)
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

    def _read_through(self, view: View, warp: FittedWarp, marker_id: int, relit: bool) -> Reading | None:
        """Return the surest reading of one identity among the layers whose cells are all in the image.

        The larger layers come first, and one that is sure will do.
        """
        best: Reading | None = None
        for layer, corners in zip(LAYERS, warp(CELLS_WITHIN), strict=True):
            if _inside(corners, view.gray.shape):
                reading = self._read_layer(view, warp, layer.index, marker_id, relit)
                best = reading if best is None else max(best, reading, key=self._codebook.excess)
                if best.correlation >= SURE:
                    break
        return best

    def _read_layer(self, view: View, warp: FittedWarp, layer: int, marker_id: int, relit: bool) -> Reading:
        """Return how well one layer reads as a marker, through a warp of the print; in even light, or ``relit``."""
        if relit:
            cells, seen = relit_layer(view.light, warp, layer_points(RELIT_SAMPLES, LAYERS[layer]))
            return self._codebook.read_seen_as(cells, seen, marker_id)
        return self._codebook.read_as(layer_cells(view.light, warp, layer), marker_id)


def _inside(corners_px: Array, shape: tuple[int, ...]) -> bool:
    """Return whether all corners (4, 2) are inside an image of a shape."""
    return bool((corners_px >= 0).all() and (corners_px <= (shape[1] - 1, shape[0] - 1)).all())


def _inside_layer(warp: FittedWarp, layer: Layer, points: Array) -> Array:
    """Return the pixels of points (..., 2) given as if ``layer`` were the outermost square."""
    return warp(layer_points(points, layer))


def _lead(scores: Array, layer: int) -> float:
    """Return how much better one layer's score (3,) is than the best of the others."""
    return float(scores[layer] - np.delete(scores, layer).max())


def _apart(T_cam_marker: Array, other: Array) -> bool:
    """Return whether two poses are turned so differently that they are two."""
    return float(np.linalg.norm(difference(T_cam_marker, other)[3:])) > SAME_POSE_RAD


def _sure(found: Sequence[Detection]) -> bool:
    """Return whether markers were found, and all of them surely and measured."""
    return bool(found) and all(seen.layers and seen.correlation >= SURE for seen in found)


def _bend_fraction(warp: FittedWarp) -> float:
    """Return how far a print is bent, as a fraction of its side."""
    return float(np.abs(warp.bend).max()) / layer_side_px(warp, 0) if isinstance(warp, BentWarp) else 0.0


def as_gray(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return a gray (H, W) or BGR (H, W, 3) image as gray.  Raises ValueError for anything else."""
    image = picture(image)
    return np.ascontiguousarray(image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))


def _covered(gray: NDArray[np.uint8], found: Sequence[Detection]) -> NDArray[np.uint8]:
    """Return a copy of an image with one grey over the markers found in it, so that they are not found again."""
    gray = gray.copy()
    for seen in found:
        corners = np.clip(np.round(seen.corners_px), -COVER_REACH_PX, COVER_REACH_PX).astype(np.int32)
        cv2.fillConvexPoly(gray, corners, int(gray[0].mean()))
    return gray


def _listed(markers: Mapping[int, MarkerSpec] | None, dictionary: Dictionary) -> dict[int, MarkerSpec]:
    """Return the markers a detector was told of.  Raises ValueError for an unknown id or what is no such list."""
    if markers is not None and not isinstance(markers, Mapping):
        raise ValueError(f"markers must map ids to MarkerSpec, got {type(markers).__name__}")
    listed = dict(markers or {})
    for marker_id, spec in listed.items():
        dictionary.row(marker_id)
        instance(spec, MarkerSpec, f"markers[{marker_id}]", "MarkerSpec(side_m, surface) makes one")
    return listed


def outer_corners(warp: FittedWarp) -> Array:
    """Return the print's outer corners (4, 2) in the image; one behind the camera is where its sides' lines meet."""
    corners_px = warp(OUTER)
    if (corners_px > OUTSIDE_PX).all():
        return corners_px
    inside_px = warp(SQUARES[-1])
    H = cv2.getPerspectiveTransform(SQUARES[-1].astype(np.float32), inside_px.astype(np.float32))
    return cv2.perspectiveTransform(OUTER[None], H)[0]


def warp_grid(warp: FittedWarp) -> Array:
    """Return the print's regular grid (9, 9, 2) in the image, rows from the top."""
    return warp(GRID)


def surest(found: Sequence[Detection], first: Sequence[Detection] = ()) -> list[Detection]:
    """Return ``first`` and the detections that overlap neither these nor a surer one, the surest first.

    One with a layer measured is surer than any without.
    """
    kept = list(first)
    for seen in sorted(found, key=lambda seen: (not seen.layers, _chance(seen))):
        if not _inside_any(seen.corners_px, kept):
            kept.append(seen)
    return sorted(kept, key=_chance)


def _chance(seen: Detection) -> float:
    """Return how seldom chance correlates as well with a code."""
    return float(chance_of_correlation(min(seen.correlation, CREDIBLE), EFFECTIVE_SHARE * seen.cells))


def _inside_any(corners_px: Array, found: Sequence[Detection]) -> bool:
    """Return whether a square's centre lies inside a marker already found, or a found marker's centre inside it."""

    def holds(outer: Array, inner: Array) -> bool:
        return cv2.pointPolygonTest(outer.astype(np.float32), inner.mean(axis=0).tolist(), False) >= 0

    return any(holds(seen.corners_px, corners_px) or holds(corners_px, seen.corners_px) for seen in found)
