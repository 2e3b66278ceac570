"""Finding prints on cylinders nobody measured: bent squares that read like a code, and what confirms them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from astratag.align import COARSE_BLUR, COARSE_STEPS, FINE_STEPS, align
from astratag.camera import Camera
from astratag.candidates import LEAST_FRAMED, OUTER, Candidate
from astratag.codes import Reading
from astratag.codes.acceptance import chance_of_correlation
from astratag.codes.soft import correlations, hamming
from astratag.compiled import INDICES, MATRIX, REAL, VECTOR, compiled
from astratag.cylinder import Bent, CylinderWarp, bent_through
from astratag.detection import LayerDetection
from astratag.fit import fit_edges
from astratag.geometry import (
    CELLS,
    LAYERS,
    cell_polygons,
    layer_points,
    renamed,
)
from astratag.grow import ALL_EDGES, Fit, layer_side_px, settle
from astratag.neighbours import Crossings
from astratag.polygons import turn
from astratag.sampling import AS_GRAY, Light
from astratag.search import Outlines
from astratag.signature import (
    CELL_MIDDLES,
    SAMPLES,
    Artwork,
    Codebook,
    cell_values,
    layer_cells,
    sample,
    unit,
)
from astratag.simplify import no_splits, simplified_into
from astratag.warp import FittedWarp

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
W = TypeVar("W", bound=FittedWarp)

LEAST_SIDE_PX = 24.0
"""Smaller squares do not show a bend."""
PROMISING, MAX_CANDIDATES, MAX_READ, MAX_GLANCED_AT = 0.44, 4, 5, 200
"""Correlation from which a bent square is worth a look; at most so many are moved, of so many read.

Of so many whose cells are glanced at, the likeliest: of 56 bent prints that were found, all were among the first 3.
"""
MAX_PLACES = 3
"""Of near sides that seem a print's, so many are looked at more closely."""
SHARE_OF_LOOKS, AT_ONCE, WORTH_MOVING = 0.25, 0.69, 0.62
"""What the correlation of a bent square, and this share of how it looks, must come to for it to be moved at once, or at
all.

Of 640 bent prints that were found 98 in a hundred came to the first, all to the second; of others that were moved 70.
"""
LEAST_NEAR_PX, LEAST_BESIDE_PX = 24.0, 3.0
"""How long the near side of an open square must look, and the straight beginnings of those beside it."""
LEAST_TURN_RAD, LEAST_ALIKE = 0.4, 0.5
"""How sharp its two corners must be, and how parallel (as a cosine) the sides beside it."""
NEAR_TOLERANCE_PX, NEAR_OUTSET_PX = 1.5, 0.4
MAX_NEAR = 24
SAME_SQUARE = 0.1
"""Squares whose centres and sizes differ by less than this fraction are one."""
UNCLEAR = 0.2
"""A layer is tried whose looks are within so much of the likeliest's."""
LEAST_SCORE, HOPELESS_LOOKS, HOPELESS = 0.35, 0.5, 0.78
"""How a square must look as some layer to be moved at all; and after the first steps to go on, and half of that and
what it reads together.

Of 128 bent prints that were found none came to less; of 91 squares in pictures without one, one in four.
"""
LEAST_LOOKS, CLEARLY_OUTERMOST = 0.7, 0.12
"""How a square must look as the layer it is; and how much better as the outermost, if it is, than as the others."""
INNERMOST = len(LAYERS) - 1
WARPS = 100
"""How many bent squares about one place are read, of which the best counts."""
LEAST_IN_VIEW, LEAST_CELLS = 0.4, 16
LIKELY_ANOTHER, CHANCE_OF_BOTH = 1e-2, 1e-8
"""How rarely chance may read as well as another layer does, and as that and the square itself together.

The latter a hundredth of what is asked of one square read once: an alignment fits cells a little, too.
"""
MOVED_PX, MOVED = 4.0, 0.3
"""How far an alignment may move corners: pixels, or a fraction of the square's side if that is more."""
WHOLE_HALF_ANGLES_RAD = (0.08, 0.2, 0.33, 0.5, 0.7, 0.9)
"""How far a whole print may bend to either side of its middle: radii of 6 to 0.55 sides."""
MAX_STARTS, START_PX = 2, 4.0
"""How many of the places so found are fitted, and how far from there edges are looked for."""
CLEAR_BEND = 5.0
"""A curvature is believed that is so many standard deviations from none."""
MOVES, DAMPING = 8, 0.03
"""Damped Gauss-Newton steps from a plane through a bent square's corners onto the square."""


def near_sides(outlines: Outlines) -> Array:
    """Return sides (Q, 2, 2) of dark shapes that may be a square's, clockwise, however its other sides go on.

    The far side of a print may lie at the limb, or its ink run into what is dark behind it.  Both corners of the near
    side are seen, and how the sides beside it begin.
    """
    others, scale = outlines.others, outlines.scale
    sides, lengths = _near_sides(
        others.points,
        others.starts,
        others.perimeters,
        NEAR_TOLERANCE_PX / scale,
        LEAST_NEAR_PX / scale,
        LEAST_BESIDE_PX / scale,
    )
    longest = np.argsort(-lengths, kind="stable")[:MAX_NEAR]
    along = (sides[longest, 1] - sides[longest, 0]) / lengths[longest, None]
    outward = np.stack([along[:, 1], -along[:, 0]], axis=1)
    outset = NEAR_OUTSET_PX / scale * np.stack([outward - along, outward + along], axis=1)
    return outlines.in_image(sides[longest] + outset)


@compiled(MATRIX, INDICES, VECTOR, REAL, REAL, REAL)
def _near_sides(
    points: Array,
    starts: NDArray[np.int64],
    perimeters: Array,
    tolerance: float,
    least_near: float,
    least_beside: float,
) -> tuple[Array, Array]:
    """Return sides (Q, 2, 2) of contours, simplified, that lie between two corners, and how long they are (Q,).

    Contour i runs counter-clockwise in the image through ``points`` (P, 2) from ``starts`` (N + 1,) i on, as long as
    its perimeter (N,).
    """
    sides, lengths, found = np.empty((len(points), 2, 2)), np.empty(len(points)), 0
    most = np.diff(starts).max() if len(starts) > 1 else 0
    splits, off, room = no_splits(most, most)
    for i in range(len(starts) - 1):
        contour = points[starts[i] : starts[i + 1]]
        if perimeters[i] < 2 * least_near or max(np.ptp(contour[:, 0]), np.ptp(contour[:, 1])) < least_near:
            continue
        count = simplified_into(contour, splits, off, room, tolerance)
        if count < 4:
            continue
        polygon = room[:count][::-1]
        for k in range(count):
            first, second = polygon[k], polygon[(k + 1) % count]
            before, after = first - polygon[k - 1], polygon[(k + 2) % count] - second
            if math.hypot(before[0], before[1]) < least_beside:  # a corner that was cut off
                before = first - polygon[k - 2]
            if math.hypot(after[0], after[1]) < least_beside:
                after = polygon[(k + 3) % count] - second
            side = second - first
            length = math.hypot(side[0], side[1])
            beside = math.hypot(before[0], before[1]), math.hypot(after[0], after[1])
            if length < least_near or min(beside) < least_beside:
                continue
            turns = turn(before, side), turn(side, after)
            alike = -(before[0] * after[0] + before[1] * after[1]) / (beside[0] * beside[1])
            if min(turns) > LEAST_TURN_RAD and max(turns) < np.pi - LEAST_TURN_RAD and alike > LEAST_ALIKE:
                sides[found, 0], sides[found, 1], lengths[found] = first, second, length
                found += 1
    return sides[:found].copy(), lengths[:found].copy()


def curved_candidates(gray: Image, bent: Bent, codebook: Codebook, artwork: Artwork) -> list[Candidate]:
    """Return the bent squares that read and look something like a marker, the best about each place, the best first."""
    at, facing = _glanced_at(gray, bent, codebook)
    if len(at) == 0:
        return []
    at, facing = at[:MAX_READ], facing[:MAX_READ]
    cells = _with_middle(cell_values(gray, bent.project(SAMPLES, at)), facing)
    corners_px = bent.project(OUTER, at)
    found: list[Candidate] = []
    for i, reading in codebook.best_readings(cells, np.full(len(at), PROMISING), MAX_READ):
        turns = reading.quarter_turns
        corners = renamed(corners_px[i], turns)
        candidate = Candidate(reading, corners, bent.warp(*at[i].tolist()).turned(turns), bent=True)
        if candidate.side_px >= LEAST_SIDE_PX and not any(_alike(candidate, before) for before in found):
            found.append(candidate)
    found = [replace(candidate, promise=_promise(gray, candidate, artwork)) for candidate in found]
    worth = [candidate for candidate in found if candidate.promise >= WORTH_MOVING - AT_ONCE]
    return sorted(worth, key=lambda candidate: -candidate.promise)[:MAX_CANDIDATES]


def likely_places(gray: Image, bent: Bent, codebook: Codebook) -> list[int]:
    """Return the places, ``MAX_PLACES`` at most, of the bent squares that are most like a code at a glance."""
    at, _ = _glanced_at(gray, bent, codebook)
    return list(dict.fromkeys(at[:, 0].tolist()))[:MAX_PLACES]


def _glanced_at(gray: Image, bent: Bent, codebook: Codebook) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return the bent squares (N, 2) that have a frame, those most like a code first, and which cells face (N, 48)."""
    at = bent.framed(gray, LEAST_FRAMED)[:MAX_GLANCED_AT]
    middles_px, facing = bent.seen(CELL_MIDDLES, at)
    likeliest = codebook.likeliest(_with_middle(sample(gray, middles_px), facing), len(at))
    return at[likeliest], facing[likeliest]


def _with_middle(cells: Array, facing: NDArray[np.bool_]) -> Array:
    """Return cells (N, 48) with those that do not face the viewer replaced by the others' mean: they say nothing."""
    middle = (cells * facing).sum(axis=1) / np.maximum(facing.sum(axis=1), 1)
    return np.where(facing, cells, middle[:, None])


def _promise(gray: Image, candidate: Candidate, artwork: Artwork) -> float:
    """Return how promising a bent square is, by how well it reads, and a share of how it looks as some layer."""
    assert isinstance(candidate.warp, CylinderWarp)
    looks = artwork.layer_scores(gray, candidate.warp.facing, candidate.reading.marker_id, candidate.side_px)
    return candidate.reading.correlation + SHARE_OF_LOOKS * float(looks.max()) - AT_ONCE


def _alike(candidate: Candidate, other: Candidate) -> bool:
    """Return whether two candidates read the same at nearly the same place."""
    if candidate.reading.marker_id != other.reading.marker_id:
        return False
    apart_px = np.linalg.norm(candidate.corners_px.mean(axis=0) - other.corners_px.mean(axis=0))
    size_px = min(candidate.side_px, other.side_px)
    return bool(apart_px < SAME_SQUARE * size_px and abs(candidate.side_px - other.side_px) < SAME_SQUARE * size_px)


class Seen(NamedTuple):
    """A whole print that was moved until one ``layer`` of it looks as it reads, and then read in another as well."""

    warp: CylinderWarp
    square: CylinderWarp
    """The same as if that layer were the outermost."""
    layer: int
    reading: Reading


def seen_whole(gray: Image, candidate: Candidate, side_m: float, codebook: Codebook, artwork: Artwork) -> Seen | None:
    """Return the print a bent square is a layer of; None when it does not look as it reads, or no other layer does.

    The other layer's cells are as good as a second marker with the same code: nothing was fitted to them.
    """
    square, marker_id, side_px = candidate.warp, candidate.reading.marker_id, candidate.side_px
    assert isinstance(square, CylinderWarp)
    scores = artwork.layer_scores(gray, square.facing, marker_id, side_px)
    for layer in np.argsort(-scores).tolist():
        if scores[layer] < max(LEAST_SCORE, scores.max() - UNCLEAR):
            break
        aligned = _aligned(gray, square, scores, artwork, candidate.reading, layer, side_px)
        if aligned is None or np.abs(aligned.warp(OUTER) - square(OUTER)).max() > max(MOVED_PX, MOVED * side_px):
            continue
        if layer == INNERMOST:  # so small that it says little of the bend: go on with the next, where it must be
            layer -= 1
            wider = aligned.warp.of_whole(1.0, LAYERS[INNERMOST].scale / LAYERS[layer].scale)
            looks = artwork.layer_scores(gray, wider.facing, marker_id, side_px)
            aligned = _aligned(gray, wider, looks, artwork, candidate.reading, layer, side_px)
            if aligned is None:
                continue
        moved, looks = aligned
        if looks[layer] < LEAST_LOOKS or (layer == 0 and looks[0] < looks[1:].max() + CLEARLY_OUTERMOST):
            continue
        whole = moved.of_whole(side_m, LAYERS[layer].scale)
        own, other = (_read(gray, whole, each, marker_id, codebook) for each in (layer, 1 - layer))
        readings = len(codebook.dictionary.ids) * 4 * WARPS
        if other.chance <= LIKELY_ANOTHER and own.chance * readings * other.chance <= CHANCE_OF_BOTH:
            return Seen(whole, moved, layer, own.reading)
    return None


class Aligned(NamedTuple):
    """A moved square, and how it looks (3,) as each layer."""

    warp: CylinderWarp
    looks: Array


def _aligned(
    gray: Image, warp: CylinderWarp, looks: Array, artwork: Artwork, reading: Reading, layer: int, side_px: float
) -> Aligned | None:
    """Return a square moved until what is in view of it looks like a layer of the marker it reads as; None if hopeless.

    ``looks`` (3,) are as it is.  The first steps are taken on a coarser grid of points, which does as well on a blurred
    picture.  Where a blur makes one of much that is seen at a slant they lead astray, and are taken back.
    """
    expected, points = artwork.expected(reading.marker_id, side_px)[layer], artwork.points
    coarse = np.arange(len(points)).reshape(artwork.GRID, -1)[::2, ::2].ravel()
    for blur, steps, among in ((COARSE_BLUR, COARSE_STEPS, coarse), (0.0, FINE_STEPS, artwork.half)):
        seen = among[warp.visible(points[among])]
        if len(seen) < LEAST_IN_VIEW * len(among):
            return None
        moved = align(gray, warp, points[seen], expected[seen], blur=blur, steps=steps)
        after = artwork.layer_scores(gray, moved.facing, reading.marker_id, side_px)
        if after[layer] >= looks[layer]:
            warp, looks = moved, after
        if looks[layer] < HOPELESS_LOOKS or reading.correlation + looks[layer] / 2 < HOPELESS:
            return None
    return Aligned(warp, looks)


class LayerReading(NamedTuple):
    """What one layer reads as one marker, and how often chance would read as well in so many cells."""

    reading: Reading
    chance: float


def _read(gray: Image, warp: FittedWarp, layer: int, marker_id: int, codebook: Codebook) -> LayerReading:
    """Return what the cells in view of one layer of a print say."""
    cells, kept = layer_cells(Light(gray, AS_GRAY), warp, layer), cells_in_view(warp, layer, gray.shape)
    count = int(kept.sum())
    if count < LEAST_CELLS:
        return LayerReading(Reading(marker_id, 0, 0.0, CELLS), 1.0)
    code = codebook.dictionary.signature(marker_id)
    correlation = float(correlations(cells, kept[None], code[None])[0, 0])
    if count == CELLS:
        correlation = max(correlation, codebook.read_as(cells, marker_id, layer_side_px(warp, layer)).correlation)
    wrong = hamming(cells, kept, code)
    return LayerReading(Reading(marker_id, 0, correlation, wrong), float(chance_of_correlation(correlation, count)))


def cells_in_view(warp: FittedWarp, layer: int, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Return which cells (48,) of a layer face the viewer and are inside an image of ``shape`` (H, W)."""
    corners = layer_points(cell_polygons(), LAYERS[layer]).reshape(-1, 2)
    at = warp(corners)
    use = warp.visible(corners) & (at >= 0).all(axis=1) & (at <= (shape[1] - 1, shape[0] - 1)).all(axis=1)
    return np.asarray(use.reshape(CELLS, -1).all(axis=1))


def on_cylinder(
    light: Light, gray: Image, layers: Sequence[LayerDetection], marker_id: int, artwork: Artwork, like: PrintLike
) -> Fit | None:
    """Return the fit of a cylinder to all edges of a marker, begun where measured layers look most like it on one."""
    tried: list[tuple[float, CylinderWarp]] = []
    expected = unit(artwork.expected(marker_id)[:1])[0]
    for seen in layers:
        scale, origin = LAYERS[seen.layer].scale, LAYERS[seen.layer].origin
        bent = bent_through(like.camera, seen.corners_px[None], tuple(scale * h for h in WHOLE_HALF_ANGLES_RAD))
        values = sample(gray, bent.project((artwork.points - origin) / scale, bent.all))
        best = int((unit(values) @ expected).argmax())
        likeness = float((unit(values) @ expected)[best])
        tried.append((likeness, bent.warp(*bent.all[best].tolist()).of_whole(like.side_m, scale)))
    fits: list[Fit] = []
    for _, warp in sorted(tried, key=lambda pair: -pair[0])[:MAX_STARTS]:
        begun = fit_edges(light, warp, ALL_EDGES, START_PX)
        fit = settle(light, begun.warp, like.near) if begun is not None else None
        if fit is not None:
            fits.append(fit)
    return min(fits, key=lambda fit: fit.cost, default=None)


class PrintLike(NamedTuple):
    """How a print is made and seen, as far as known."""

    camera: Camera
    side_m: float
    near: Crossings


def clearly_bent(fit: Fit) -> bool:
    """Return whether a fitted cylinder's curvature is more than noise and the pull of neighbouring edges make."""
    assert isinstance(fit.warp, CylinderWarp)
    return bool(fit.warp.curvature > CLEAR_BEND * np.sqrt(fit.covariance[6, 6]))


def moved_onto(warp: W, template: Array, points_px: Array) -> W:
    """Return a warp moved until template points (N, 2) of its print lie nearest to where they are seen (N, 2)."""
    for _ in range(MOVES):
        J = warp.jacobian(template).reshape(2 * len(template), -1)
        scale = np.linalg.norm(J, axis=0) + 1e-12
        left = (points_px - warp(template)).ravel()
        damped = np.vstack([J / scale, DAMPING * np.eye(len(scale))])
        delta = np.linalg.lstsq(damped, np.append(left, np.zeros(len(scale))), rcond=None)[0]
        warp = warp.stepped(delta / scale)
    return warp


def covariance_of(warp: FittedWarp, template: Array, sigma_px: float) -> Array:
    """Return the covariance (P, P) of a warp's parameters when template points (N, 2) are known to ``sigma_px``."""
    J = warp.jacobian(template).reshape(2 * len(template), -1)
    scale = np.linalg.norm(J, axis=0) + 1e-12
    information = (J / scale).T @ (J / scale) / sigma_px**2 + np.diag((warp.step_sigma() * scale) ** -2.0)
    return np.linalg.inv(information) / np.outer(scale, scale)
