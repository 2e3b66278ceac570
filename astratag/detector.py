"""The detector: markers in one image, with no memory.

From the fast to the thorough: find quads; read each as if it were flat, then as if bent or unevenly lit; confirm the
promising ones.  What is found surely ends the search.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from astratag.camera import Camera
from astratag.candidates import (
    MAX_BENT_READ,
    SURE,
    Candidate,
    bent_candidates,
    flat_candidates,
    framed,
    looks_large,
    promise_of,
    relightable,
    relit_candidates,
)
from astratag.checks import instance
from astratag.codes.acceptance import FALSE_ACCEPT_RATE, chance_of_correlation
from astratag.codes.soft import CREDIBLE
from astratag.confirm import Confirmer
from astratag.curved import LEAST_SIDE_PX, curved_candidates, likely_places, near_sides
from astratag.cylinder import Bent, CylinderWarp, bent_beside, bent_through
from astratag.describe import PIXEL_BLUR, MarkerSpec
from astratag.detection import Detection
from astratag.dictionary import Dictionary
from astratag.edges import Transfer, inverse_transfer
from astratag.effort import COST, Effort, first_distinct
from astratag.matching import rough_matches
from astratag.sampling import Light
from astratag.search import (
    BROAD,
    COARSE,
    FAINT,
    FINE_PX,
    MAX_BENT_OUTLINES,
    NARROW,
    NONE,
    PLAIN,
    SLANTED,
    STEEP,
    THIN,
    TINY,
    Binarisation,
    Outlines,
    bent_quads_of,
    find_outlines,
    quads_of,
    scaled,
)
from astratag.signature import EFFECTIVE_SHARE
from astratag.surface import Flat, Surface
from astratag.view import View, as_gray

Array = NDArray[np.float64]

LEAST_IMAGE_PX = 8
"""Images narrower than this hold no marker that could be read."""
HALVE_FROM_PX = 500_000
"""Parts of an image with more pixels than this are searched at half resolution; in whole ones thin borders first."""
LIKELY = 0.68
"""Correlation through a rough quad from which it is looked at even where surer ones were markers."""
EVERY_WAY = (PLAIN, NARROW, FAINT)
"""Ways of telling ink from paper in which listed markers are looked for that were not found at once."""
COVER_REACH_PX = 30_000
"""OpenCV draws no further."""
MAX_READ_BY_PIXELS, MAX_MATCHED = 8, 2
"""Squares in one image that are read by all their pixels; and that are aligned with a print.

Of 58 markers found so each was the first to be aligned.
"""
LEAST_CLOSE_PX = 18.0
"""Flat squares smaller than this are left to their pixels.

Of 300 markers found by their edges or an alignment the smallest square was 19 pixels wide; what chance makes read like
a code is mostly smaller.
"""
ANOTHER_LAYER, SAME_PLACE = 1.4, 0.6
"""How many times larger a bent square is, at least, that may be another layer of the same marker; and how far apart
their centres may look, in sides of the larger.
"""
MAX_ALIGNED_AT_ONCE = 4
"""Candidates that are moved until they look as they read, of those found by one way of telling ink from paper."""


class Detector(Confirmer):
    """Finds the markers of a dictionary in single images.

    ``side_m`` and ``surface`` hold for every marker that ``markers`` (id to ``MarkerSpec``) does not list.
    ``surface`` None is unknown: flat, or a cylinder whose radius and axis are estimated; on what neither explains the
    code is read through a thin-plate spline, and the pose is as if flat.  ``transfer`` is how the camera encodes
    light: "srgb" (ordinary 8-bit cameras) or "linear".  ``false_accept_rate`` is the share of candidates without a
    marker that may read as one by chance; which correlation that asks for follows from the dictionary.
    ``tau_hamming`` sets the paper's rule instead: at most so many wrong cells (its 3, 5 and 10), whatever the chance
    of that, and none that cannot be seen.
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
        super().__init__(
            dictionary, side_m, surface, markers, false_accept_rate=false_accept_rate, tau_hamming=tau_hamming
        )
        self._of_gray = inverse_transfer(transfer).astype(float)
        self._lit = np.zeros((0, 0), dtype=np.float32)

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
        found = self.search(view, _outlines(view, COARSE), whole=True)
        large = view.gray.size > HALVE_FROM_PX
        for how in (NARROW, PLAIN, FAINT) if large else (PLAIN, NARROW, FAINT):
            if _sure(found):
                break
            outlines = _outlines(view, how)
            found += self.search(view, outlines)
            if not _sure(found):
                found += self._search_relit(view, quads_of(outlines))
            if not _sure(found) and how == PLAIN:
                found += self._search_bent(view, outlines)
            if found:
                break
        return (
            surest(found)
            or self._search_very_bent(view)
            or self._search_pixels(view)
            or self.search_later(view)
            or self._search_by_spline(view)
        )

    def find_missing(
        self, view: View, found: Sequence[Detection], ways: Sequence[Binarisation] = EVERY_WAY
    ) -> list[Detection]:
        """Return what is found and the listed markers that are missing in it, looked for in one way after another.

        ``find`` ends with something sure, and a small, bent or faint marker beside it may be lost.  Those that were
        listed are worth another look where nothing is found yet, and nothing else is taken from it.
        """
        found = list(found)
        effort = self._effort(view.gray)  # of its own: what was found at once took little, and is worth the rest
        for how in ways if found else ():
            missing = set(self.markers) - {seen.marker_id for seen in found}
            if not missing:
                break
            rest = replace(view, gray=_covered(view.gray, found), effort=effort, later=[], scaled={}, outlines={})
            outlines = _outlines(rest, how)
            others = [*self.search(rest, outlines), *self._search_bent(rest, outlines), *self.search_later(rest)]
            found = surest([seen for seen in others if seen.marker_id in missing], first=found)
        return found

    def view(
        self, image: NDArray[np.uint8], camera: Camera | None, boxes: Sequence[NDArray[np.int64]] | None = None
    ) -> View:
        """Return an image made ready: all of it, or only ``boxes`` ((2, 2) pixels: low and high x, y) of its light.

        The light is kept in one buffer, which the next image's overwrites: fresh memory costs more than the table.
        Raises ValueError as ``detect`` does.
        """
        gray = as_gray(image)
        if camera is not None:
            instance(camera, Camera, "camera", "Camera.load(path) reads one")
            camera.require_size(gray.shape[1], gray.shape[0])
        if self._lit.shape != gray.shape:
            self._lit = np.zeros(gray.shape, dtype=np.float32)
        return View(gray, Light(gray, self._of_gray), camera, self._effort(gray), self._lit, boxes)

    def search(self, view: View, outlines: Outlines, *, whole: bool = False) -> list[Detection]:
        """Return the markers among outlines read as if flat, each once, the surest first; see ``quads_of``."""
        quads = quads_of(outlines, whole=whole)
        return surest(self._confirm_all(view, flat_candidates(view.gray, quads, self._codebook), whole))

    def _search_relit(self, view: View, quads: Array) -> list[Detection]:
        """Return the markers among quads (Q, 4, 2) in glare, hard shadow or half covered."""
        if self._codebook.tau_hamming is not None:
            return []
        quads = relightable(view.gray, quads)
        quads = quads[: view.effort.afford(COST.relit, len(quads))]
        return surest(self._confirm_all(view, relit_candidates(view.lit, quads, self._codebook)))

    def _search_bent(self, view: View, outlines: Outlines) -> list[Detection]:
        """Return the markers among outlines bent about cylinders, none when every marker is on a plane."""
        if not self._bends:
            return []
        if not view.effort.spend(COST.outline * min(outlines.contours.count, MAX_BENT_OUTLINES)):
            return []
        return self._search_bent_about(view, np.concatenate([quads_of(outlines), bent_quads_of(outlines).corners_px]))

    def _search_bent_about(self, view: View, quads: Array) -> list[Detection]:
        """Return the markers among squares bent about cylinders whose corners are those of quads (Q, 4, 2)."""
        quads = quads[looks_large(quads) >= LEAST_SIDE_PX]
        if not self._bends or len(quads) == 0:
            return []
        return self._search_curved(view, bent_through(view.some_camera, quads))

    def _search_very_bent(self, view: View) -> list[Detection]:
        """Return the markers bent about cylinders so much, or so far turned, that none was found otherwise."""
        if not self._bends:
            return []
        outlines = _outlines(view, NARROW)
        found = self._search_bent(view, _outlines(view, THIN)) or self._search_bent_about(view, quads_of(outlines))
        if found or not view.effort.spend(COST.near_pixel * outlines.followed):
            return found
        sides = near_sides(outlines)
        coarse = bent_beside(view.some_camera, sides, coarse=True)
        if not view.effort.spend(COST.bent * coarse.count):
            return []
        likely = likely_places(view.gray, coarse, self._codebook)
        return self._search_curved(view, bent_beside(view.some_camera, sides[likely]))

    def _search_by_spline(self, view: View) -> list[Detection]:
        """Return the markers on surfaces that no cylinder explains."""
        if not self._bends:
            return []
        if not view.effort.spend(COST.spline * MAX_BENT_READ):
            return []
        bent = bent_quads_of(_outlines(view, PLAIN))
        return surest(self._confirm_all(view, bent_candidates(view.gray, bent, self._codebook)))

    def _search_curved(self, view: View, bent: Bent) -> list[Detection]:
        """Return the markers among squares bent about cylinders."""
        if not view.effort.spend(COST.bent * bent.count + COST.bent_read):
            return []
        return surest(self._confirm_all(view, curved_candidates(view.gray, bent, self._codebook, self._artwork)))

    def _search_pixels(self, view: View) -> list[Detection]:
        """Return the markers whose edges or cells cannot be followed, by all their pixels; see ``matching``.

        Before that, those in uneven light are read cell by cell, and those that seem bent as bent squares.
        """
        tried, left = np.zeros((0, 4, 2)), MAX_MATCHED
        for how in (TINY, SLANTED, BROAD, STEEP):
            quads = quads_of(_outlines(view, how))
            found = self._search_relit(view, quads)
            if found:
                return found
            fresh = first_distinct(framed(view.gray, quads), tried, MAX_READ_BY_PIXELS - len(tried))
            found = self._search_bent_about(view, fresh)
            if found:
                return found
            tried = np.concatenate([tried, fresh])
            fresh = fresh[: view.effort.afford(COST.by_pixels, len(fresh))]
            rough = rough_matches(self._synthesis, view.lit, fresh, PIXEL_BLUR)[:left]
            rough = [one for one in rough if view.effort.begin(COST.matched)]
            left -= len(rough)
            found = [seen for seen in (self._confirm_pixels(view, one) for one in rough) if seen is not None]
            if found:
                return found
            if left == 0:
                break
        return []

    @property
    def _bends(self) -> bool:
        """Return whether a marker may be on a curved surface: one that is listed, or any when none is."""
        specs = self.markers.values() or [self.default]
        return any(not isinstance(spec.surface, Flat) for spec in specs)

    def _effort(self, gray: NDArray[np.uint8]) -> Effort:
        """Return what an image is worth."""
        return Effort(gray.size, flat=not self._bends)

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
            if candidate.side_px < LEAST_CLOSE_PX:
                continue
            by_edges = not candidate.bent and view.by_edges.take(candidate) and view.effort.begin(COST.edges)
            if by_edges and take(candidate, self._confirm_edges(view, candidate)):
                view.by_edges.succeed()
            else:
                left.append(candidate)
        for candidate in [] if _sure(found) or quick else left[:MAX_ALIGNED_AT_ONCE]:
            if _inside_any(candidate.corners_px, found):
                continue
            promise = promise_of(view.gray, candidate, self._codebook, self._artwork)
            if promise is None:
                continue
            candidate = replace(candidate, promise=promise)
            if promise >= 0:
                take(candidate, self._move(view, candidate, view.effort.begin))
            else:
                view.later.append(candidate)
        for candidate in _best([one for one in view.later if _seconded(view, one)]):
            if found:
                break
            view.later.remove(candidate)
            take(candidate, self._move(view, candidate, view.effort.begin))
        return found + [seen for seen in surest(unmeasured) if not _inside_any(seen.corners_px, found)]

    def _move(self, view: View, candidate: Candidate, spend: Callable[[float], bool]) -> Detection | None:
        """Return the marker a candidate is once aligned, None when it is none, or enough were tried."""
        curved = isinstance(candidate.warp, CylinderWarp)
        tries, units = (view.curved, COST.curved) if curved else (view.aligned, COST.aligned)
        if not (tries.take(candidate) and spend(units)):
            return None
        found = self._confirm_aligned(view, candidate)
        if found is not None:
            tries.succeed()
        return found

    def search_later(self, view: View) -> list[Detection]:
        """Return the first marker among the candidates that were not promising enough at once, the best first."""
        found = (self._move(view, candidate, view.effort.spend) for candidate in _best(view.later))
        first = next((seen for seen in found if seen is not None), None)
        return [] if first is None else [first]


def _best(candidates: Sequence[Candidate]) -> list[Candidate]:
    return sorted(candidates, key=lambda candidate: -candidate.promise)


def _seconded(view: View, candidate: Candidate) -> bool:
    """Return whether another bent square, about the same place, reads the same: another layer, then.

    Chance seldom reads one code twice.
    """
    return candidate.bent and any(_another_layer(candidate, one) for one in (*view.curved.made, *view.later))


def _another_layer(candidate: Candidate, other: Candidate) -> bool:
    small_px, large_px = sorted((candidate.side_px, other.side_px))
    apart_px = np.linalg.norm(candidate.corners_px.mean(axis=0) - other.corners_px.mean(axis=0))
    same = other.bent and candidate.reading.marker_id == other.reading.marker_id
    return bool(same and large_px >= ANOTHER_LAYER * small_px and apart_px < SAME_PLACE * large_px)


def _outlines(view: View, how: Binarisation) -> Outlines:
    """Return the outlines in an image, found once each way; none when it was looked at enough."""
    if how in view.outlines:
        return view.outlines[how]
    enlarged = how.scale**2 * view.gray.size
    looked_at = min(enlarged, how.scale**2 * FINE_PX) if how.scale > 1 else enlarged
    if not view.effort.spend(COST.look + COST.pixel * looked_at + COST.resized_pixel * enlarged):
        return NONE
    if how.scale not in view.scaled:
        view.scaled[how.scale] = scaled(view.gray, how.scale, view.scaled.get(1.0))
    found = find_outlines(view.gray, how, view.scaled[how.scale])
    borders = COST.border_pixel * found.followed
    view.outlines[how] = found if view.effort.spend(borders + COST.outline * found.contours.count) else NONE
    return view.outlines[how]


def _sure(found: Sequence[Detection]) -> bool:
    """Return whether markers were found, and all of them surely and measured."""
    return bool(found) and all(seen.layers and seen.correlation >= SURE for seen in found)


def _covered(gray: NDArray[np.uint8], found: Sequence[Detection]) -> NDArray[np.uint8]:
    """Return a copy of an image with one grey over the markers found in it, so that they are not found again."""
    gray = gray.copy()
    for seen in found:
        corners = np.clip(np.round(seen.corners_px), -COVER_REACH_PX, COVER_REACH_PX).astype(np.int32)
        cv2.fillConvexPoly(gray, corners, int(gray[0].mean()))
    return gray


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
