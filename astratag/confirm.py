"""Confirming: from a square that reads like a marker to that marker, or to nothing.

Decide which layer was seen; fit the whole marker's edges, from that layer outwards and inwards; read it again
through the fit and accept it or not.  Where edges cannot be measured, move the square until it looks as it reads.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from astratag.candidates import (
    LEAST_LIKENESS,
    MANY_WARPS,
    OUTER,
    Candidate,
    aligned,
)
from astratag.curved import (
    PrintLike,
    Seen,
    clearly_bent,
    covariance_of,
    moved_onto,
    on_cylinder,
    seen_whole,
)
from astratag.cylinder import CylinderWarp
from astratag.describe import LEAST_POLISHED, PIXEL_BLUR, POLISHED_PX, WARPS, Describer, inside, lead
from astratag.detection import Detection, LayerDetection
from astratag.fit import follows_all_sides
from astratag.geometry import LAYERS, SQUARES, Layer, layer_points
from astratag.grow import CURVED_GAIN, Fit, fit_own_edges, grow, layer_side_px, settle
from astratag.layers import measure_layers
from astratag.matching import Rough, match
from astratag.pose import poses_from_square
from astratag.signature import Warp
from astratag.surface import Flat
from astratag.tps import KNOTS
from astratag.view import View
from astratag.warp import BentWarp, FittedWarp, HomographyWarp, PoseWarp

Array = NDArray[np.float64]

COST_LIMIT = 1.0
"""Mean truncated squared residual (of 9 at most) above which a fit that was begun near its end is not believed."""
CYLINDER_COST_LIMIT = 0.4
"""The same of a cylinder of unknown radius: a wrong radius leaves more, where noise of 20 grey levels leaves 0.2."""
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
LEAST_WHOLE = 0.55
"""Correlation of the whole print, flat, with what is seen, without which an inner layer alone is not believed.

On cylinders where corners of the outer square were some ten pixels off it is 0.18 to 0.48.
"""
LIKELY_THAT_LAYER, LIKELY_LOOKS = 0.05, 0.5
"""The same where its edges agree too, of the clearest layer measured; and how well that layer must look."""
MOVED_PX, MOVED = 4.0, 0.1
"""How far an alignment may move corners: pixels, or a fraction of the square's side if that is more."""
LOOKS_SIGMA_PX, LOOKS_SIGMA, MUCH_SLANTED = 0.35, 0.01, 2.5
"""Standard deviation of corners that were aligned, not measured: in pixels, and more as a fraction of a bent side.

Of flat ones it grows with how many times longer than wide they look, from so many on: 0.37 px were measured of those
seen square-on, 1.2 px at 82 degrees.
"""
FLAT_COST, FLAT_LIKENESS = 0.05, 0.93
"""A plane that explains edges and looks as well as this needs no rival."""
SAME_LIKENESS, MORE_LIKE = 0.01, 0.05
"""A print looks the same through two warps, and clearly more like the marker through one, from these differences on."""
NOTICEABLE_BEND = 0.02
"""A print of unknown surface is called curved from this bend on, as a fraction of its side."""


class Confirmer(Describer):
    """What makes a marker of a candidate: its edges, else its looks, else all its pixels."""

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
        by_pixels = self._synthesis.align(view.lit, warp, marker_id, PIXEL_BLUR)
        if by_pixels is not None and by_pixels.correlation > LEAST_POLISHED:
            return self._described_by_pixels(
                view, marker_id, by_pixels, seen.layer, seen.reading.correlation, "cylinder"
            )
        sigma_px = LOOKS_SIGMA_PX + LOOKS_SIGMA * candidate.side_px
        corners = LayerDetection(seen.layer, warp(SQUARES[seen.layer]), sigma_px)
        covariance = covariance_of(warp, layer_points(KNOTS, LAYERS[seen.layer]), sigma_px)
        return self._described(view, seen.reading, warp, (corners,), "cylinder", covariance[:6, :6])

    def _clearly_bent(self, view: View, marker_id: int, seen: Seen, fit: Fit | None) -> bool:
        """Return whether no plane explains what is seen of a print nearly as well as a cylinder."""
        plane = HomographyWarp.from_points(SQUARES[seen.layer], seen.warp(SQUARES[seen.layer]))
        if fit is None:
            return self._more_like(view, marker_id, seen.warp.facing, plane)
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
        if scores[layer] < LEAST_LOOKS[layer] or lead(scores, layer) < CLEARLY_THAT_LAYER:
            return None
        if candidate.bent and layer == len(LAYERS) - 1:
            return None  # nothing inside fixes its bend, and the whole print is over five times as large
        flat = replace(candidate, bent=False)  # a bend does not carry from an inner layer to the whole print
        warp = self._whole_print(candidate if layer == 0 else flat, layer)
        bent_px = LOOKS_SIGMA * candidate.side_px * candidate.bent
        sigma_px = LOOKS_SIGMA_PX * max(1.0, _slant(candidate.corners_px) / MUCH_SLANTED) + bent_px
        corners = LayerDetection(layer, candidate.corners_px, sigma_px)
        if not inside(candidate.corners_px, view.gray.shape):
            return None
        if self.spec(marker_id).surface is None:
            fit = self._curved_fit(view, marker_id, (corners,))
            if fit is not None and self._more_like(view, marker_id, fit.warp, warp):
                detection = self.describe(view, marker_id, fit, "cylinder", MANY_WARPS)
                if detection is not None:
                    return detection
            if layer > 0 and self._artwork.likeness(view.gray, warp, marker_id) < LEAST_WHOLE:
                return None  # what is around it bends away, and would be pixels from where a plane has it
        method = "tps" if candidate.bent else "planar"
        detection = self._described(view, candidate.reading, warp, (corners,), method)
        return self.polished(view, detection, np.inf)  # what was not measured by edges

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
                fits.append((lead(looks, 0), fit, looks))
                if looks[0] > CERTAIN_LIKENESS and lead(looks, 0) >= LIKELY_THAT_LAYER:
                    break
        for _, fit, looks in sorted(fits, key=lambda found: -found[0]):
            detection = self._fitted(view, candidate, fit, looks)
            if detection is not None:
                return detection
        return None

    def _fitted(self, view: View, candidate: Candidate, fit: Fit, looks: Array) -> Detection | None:
        """Return the marker that a candidate is by a fit, None when it does not read or look so."""
        marker_id = candidate.reading.marker_id
        if self.spec(marker_id).surface is None and not isinstance(fit.warp, CylinderWarp):
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
        surface = fit.warp.surface if isinstance(fit.warp, PoseWarp) else None
        return self.polished(view, self.with_other_pose(view, detection, fit), POLISHED_PX, surface)

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
        return fit if fit is not None and fit.cost < CYLINDER_COST_LIMIT and clearly_bent(fit) else None

    def _layers_agree(self, view: View, detection: Detection, warp: FittedWarp, looks: Array) -> bool:
        """Return whether a measured layer looks like itself and not like another, which may have the same edges.

        Of a marker none of whose layers shows all four edges, any layer.  ``looks`` (3,) is how much the whole print
        looks like each, which will do where its outer square was measured.
        """
        for layer in [seen.layer for seen in detection.layers] or range(len(LAYERS)):
            if layer == 0 and looks[0] >= LIKELY_LOOKS and lead(looks, 0) >= LIKELY_THAT_LAYER:
                return True
            inside = partial(_inside_layer, warp, LAYERS[layer])
            scores = self._artwork.layer_scores(view.gray, inside, detection.marker_id, layer_side_px(warp, layer))
            if scores[layer] >= LIKELY_LOOKS and lead(scores, layer) >= LIKELY_THAT_LAYER:
                return True
        return False

    def _whole_print(self, candidate: Candidate, layer: int) -> FittedWarp:
        """Return the warp of the whole print when the candidate is ``layer`` of it."""
        if isinstance(candidate.warp, CylinderWarp):
            return candidate.warp.of_whole(self.spec(candidate.reading.marker_id).side_m, LAYERS[layer].scale)
        if candidate.bent:
            return BentWarp.from_points(layer_points(KNOTS, LAYERS[layer]), candidate.warp(KNOTS))
        return HomographyWarp.from_points(SQUARES[layer], candidate.corners_px)

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
                    posed = partial(self.pose_of_plane, view, marker_id)
                    return grow(view.light, warp, layer, self.near(marker_id), posed)
        return None

    def _starts(self, view: View, candidate: Candidate, layer: int) -> Iterator[FittedWarp]:
        """Yield warps to start fitting from when the candidate is ``layer`` of its marker."""
        spec = self.spec(candidate.reading.marker_id)
        template = SQUARES[layer]
        if view.camera is not None and spec.surface is not None:
            knots = layer_points(KNOTS, LAYERS[layer])
            for T in poses_from_square(view.camera, template, candidate.corners_px, spec.side_m, spec.surface):
                start = PoseWarp(view.camera, spec.side_m, spec.surface, T)
                yield moved_onto(start, knots, candidate.warp(KNOTS)) if candidate.bent else start
        else:
            yield self._whole_print(candidate, layer)

    def _confirm_pixels(self, view: View, rough: Rough) -> Detection | None:
        """Return the marker that a rough square is a layer of."""
        seen = match(self._synthesis, view.lit, rough, PIXEL_BLUR, self._accept_of_pixels)
        if seen is None:
            return None
        detection = self._described_by_pixels(
            view, seen.marker_id, seen.alignment, seen.layer, seen.correlation, "planar"
        )
        return None if detection is None else self.polished(view, detection, np.inf, Flat())


def _inside_layer(warp: FittedWarp, layer: Layer, points: Array) -> Array:
    """Return the pixels of points (..., 2) given as if ``layer`` were the outermost square."""
    return warp(layer_points(points, layer))


def _bend_fraction(warp: FittedWarp) -> float:
    """Return how far a print is bent, as a fraction of its side."""
    return float(np.abs(warp.bend).max()) / layer_side_px(warp, 0) if isinstance(warp, BentWarp) else 0.0


def _slant(corners_px: Array) -> float:
    """Return how many times longer than wide a square (4, 2) looks in the middle."""
    across = corners_px[1] + corners_px[2] - corners_px[0] - corners_px[3]
    down = corners_px[2] + corners_px[3] - corners_px[0] - corners_px[1]
    return float(np.linalg.cond(np.stack([across, down])))
