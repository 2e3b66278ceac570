"""Fitting a warp to the edges of a marker, robustly.

Residuals are distances across the edges, in pixels.  Besides the warp's own parameters the fit carries an
*edge bias*: how far all edges lie towards the paper.  What is left of a camera's response curve moves every
black-white edge the same way, and black squares and white frames feel it with opposite signs.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from astratag.backdrop import backdrop
from astratag.bells import around
from astratag.compiled import (
    CUBE,
    FLAG_MATRIX,
    FLAGS,
    GRAY,
    INDICES,
    INT,
    LINE_NUMBERS,
    LINES,
    MATRIX,
    REAL,
    VECTOR,
    compiled,
)
from astratag.edges import POINTS_PER_EDGE, template_of
from astratag.locate import ROW_PX, locate
from astratag.neighbours import UNKNOWN, Crossings
from astratag.normal import dot, factored, inverse, ranked
from astratag.pulls import SHARP_REACH_PX, pulls_on, within_reach
from astratag.sampling import Light
from astratag.shading import shading
from astratag.warp import FittedWarp

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
W = TypeVar("W", bound=FittedWarp)

BIAS_SIGMA_PX = 0.02
"""Prior standard deviation of the edge bias: what a known response curve leaves.  Chosen on renders, whose curve is
known exactly; a real camera may leave more."""
NOISE_FLOOR_PX = 0.01
"""No edge point is believed to be better than this."""
FIRST_SIGMA_PX = 0.3
"""What the noise is taken for at first: so much that all points count alike."""
CORRELATION_LENGTH_PX = ROW_PX
"""Edge points nearer than this along an edge share their noise (blur, JPEG blocks)."""
NUISANCE_SIGMA = np.array([BIAS_SIGMA_PX, 0.15, 0.03])
"""Prior standard deviations of the edge bias, of how wrong what is known of all pulls is, as a fraction of them, and of
how far edges that are pulled by ``WHOLLY_PX`` or more lie towards the paper besides: they do not tell the bias."""
WHOLLY_PX = 0.1
NUISANCES = len(NUISANCE_SIGMA)
_PARAMETERS = slice(0, -NUISANCES)
LEAST_CURVING = 0.3
TUKEY, OF_GAUSSIAN = 4.685, 0.963
"""Residuals beyond this many standard deviations weigh nothing (95 % efficiency on Gaussian noise); and how much larger
the variance then is than weights promise, for these are less than 1 on average."""
REWEIGHTINGS, SAME_SPREAD = 5, 0.02
"""Weights are found again until the residuals' spread changes by no more than this fraction."""
MAX_STEPS, LINEAR_PX = 6, 0.01
"""Gauss-Newton steps end when the last did what its derivative promised, to this many pixels."""
LEAST_REACH_PX = 1.2
"""An edge nearer to its neighbours than this is no edge of its own."""
LEAST_FOUND, LEAST_IN_VIEW, LEAST_ON_SIDE = 0.4, 0.15, 5
"""Fraction of an edge's points that must be found for it to count; of them all that must be in view; points a side."""
COST_UNIT_PX, COST_CAP = 0.5, 9.0


@dataclass(frozen=True, eq=False)
class EdgeFit(Generic[W]):
    """A warp fitted to E edges, M points on each.

    ``edges`` (E,) index ``EDGES``, and ``reach_px`` (E,) is how far each is from its neighbours.  ``covariance`` (P, P)
    is of the warp's own parameters, bias and pulls marginalised.  ``weight`` (E, M) is each point's final weight in
    1 / px^2, 0 where it was not used; ``offset_px`` (E, M) its distance from ``before``, the warp the edges were looked
    for with, bias and pulls removed, and ``shared_px2`` (E, M) the variance of what was removed.  ``cost`` is the mean
    truncated squared residual over every point in view: what alternatives are compared by.  ``moved_px`` is how far the
    step moved the edge that moved most.
    """

    warp: W
    before: W
    edges: NDArray[np.int64]
    reach_px: Array
    weight: Array
    offset_px: Array
    shared_px2: Array
    covariance: Array
    cost: float
    moved_px: float


def fit_edges(
    light: Light, warp: W, edges: NDArray[np.int64], search_px: float, near: Crossings = UNKNOWN
) -> EdgeFit[W] | None:
    """Return ``warp`` moved onto ``edges`` seen up to ``search_px`` from it; None when too few are, or it goes astray.

    ``near`` is what lies beside the edges in the print of a known code: what it pulls them by is taken off.

    Gauss-Newton: one step does where the warp is as good as linear; a small square seen nearly square-on needs more,
    for its tilt shows in the second order.
    """
    template, before = template_of(edges), warp
    probes_px, facing = warp(template.probes), warp.visible(template.few)
    found = _measured(*light, probes_px, facing, edges, *template[3:], near.places, near.which, near.jump, search_px)
    used, points, places_px, normal, reach_px, sharp = found
    if len(used) == 0:
        return None
    left, limits = points[0], warp.step_sigma()
    for _ in range(MAX_STEPS):
        sound, A, x, weight, covariance = _solved(warp.slopes(template.points, normal), used, points, left, limits)
        if not sound:
            return None
        warp = warp.stepped(x[_PARAMETERS])
        left, surprise_px = _left(places_px, warp(template.points), normal, used, left, A, x)
        if surprise_px < LINEAR_PX:
            break
    at_points, cost, moved_px = _judged(A, x, weight, covariance, points[0], left, used, reach_px, sharp)
    weight, offset_px, shared_px2 = at_points
    covariance = covariance[_PARAMETERS, _PARAMETERS]
    return EdgeFit(warp, before, edges, reach_px, weight, offset_px, shared_px2, covariance, cost, moved_px)


@compiled(FLAG_MATRIX, FLAG_MATRIX, VECTOR)
def _usable(found: Mask, in_view: Mask, reach_px: Array) -> Mask:
    """Return which points (E, M) to use: those of edges mostly found and not too near their neighbours."""
    use = np.zeros(found.shape, np.bool_)
    for e in range(len(found)):
        least = LEAST_FOUND * max(float(np.count_nonzero(in_view[e])), LEAST_IN_VIEW * POINTS_PER_EDGE)
        if np.count_nonzero(found[e]) >= least and reach_px[e] >= LEAST_REACH_PX:
            use[e] = found[e]
    return use


@compiled(INDICES, FLAG_MATRIX)
def _on_all_sides(edges: NDArray[np.int64], use: Mask) -> bool:
    """Return whether the points to use (E, M) lie on all four sides: edges come in fours, sides of a square."""
    followed = np.zeros(4, np.bool_)
    for e in range(len(edges)):
        if np.count_nonzero(use[e]) >= LEAST_ON_SIDE:
            followed[edges[e] % 4] = True
    return bool(followed.all())


@compiled(GRAY, VECTOR, CUBE, FLAGS, INDICES, VECTOR, VECTOR, VECTOR, VECTOR, LINES, LINE_NUMBERS, VECTOR, REAL)
def _measured(
    gray: NDArray[np.uint8],
    of_gray: Array,
    probes_px: Array,
    facing: Mask,
    edges: NDArray[np.int64],
    to_paper: Array,
    reach: Array,
    spacing: Array,
    outside: Array,
    places: NDArray[np.float32],
    which: NDArray[np.int64],
    jump: Array,
    search_px: float,
) -> tuple[NDArray[np.int64], Array, Array, Array, Array, int]:
    """Return which N of all points of E edges are measured, none when that is too few, and what is known of them.

    That are their offsets less what neighbours pull them by, keenness, shares of what they tell for themselves, being
    on an edge that looks short, variances and growths of pulls, and how far they are pulled ones (6, N).  Then of all
    points where they were measured and the normals there (2, E M); of edges the reach (E,); and how many points on
    sharp ones are in view.
    """
    seen = locate(gray, of_gray, probes_px, facing, to_paper, reach, spacing, outside, search_px)
    use = _usable(seen.found, seen.in_view, seen.reach_px)
    if not _on_all_sides(edges, use):
        use[:] = False
    blur_px = np.hypot(seen.lens_px, seen.smoothing_px)
    beside = around(
        places,
        which,
        jump,
        edges,
        seen.unit_px,
        seen.growth_px,
        seen.lean,
        seen.squeeze,
        seen.margin_px,
        backdrop(gray, of_gray, edges, seen.predicted_px, seen.normal, seen.margin_px, seen.lens_px, blur_px),
        blur_px,
        seen.beside_px,
        within_reach(seen.reach_px, blur_px, use | seen.alone),
    )
    known = pulls_on(
        beside,
        edges,
        seen.reach_px,
        seen.margin_px,
        seen.clipped_px,
        seen.offset_px,
        seen.alone,
        use,
        seen.lens_px,
        seen.smoothing_px,
    )
    if _on_all_sides(edges, use & ~known.lost):
        use &= ~known.lost
    shaded_px, wrong_px = np.zeros(use.shape), np.zeros(use.shape)
    if len(places) > 0:
        shaded_px, wrong_px = shading(
            gray,
            of_gray,
            edges,
            seen.predicted_px,
            seen.normal,
            seen.margin_px,
            seen.unit_px,
            seen.lean,
            seen.lens_px,
            use,
            blur_px,
        )
    count, i, sharp = np.count_nonzero(use), 0, 0
    used, points = np.empty(count, np.int64), np.empty((6, count))
    places_px, normal = np.empty((2, use.size)), np.empty((2, use.size))
    for e in range(use.shape[0]):
        share = min(1.0, seen.length_px[e] / (POINTS_PER_EDGE * CORRELATION_LENGTH_PX))
        quieter = np.sqrt(float(seen.rows[e]))
        for m in range(POINTS_PER_EDGE):
            k, offset_px = e * POINTS_PER_EDGE + m, seen.offset_px[e, m] - known.pull_px[e, m] - shaded_px[e, m]
            for axis in range(2):
                normal[axis, k] = seen.normal[axis, e, m]
                places_px[axis, k] = seen.predicted_px[axis, e, m] + offset_px * normal[axis, k]
            if use[e, m]:
                used[i], points[0, i], points[1, i], points[2, i] = k, offset_px, known.keen[e, m] * quieter, share
                shading_px2 = POINTS_PER_EDGE * wrong_px[e, m] ** 2  # all of an edge are off alike
                points[3, i], points[4, i] = known.variance[e, m] + shading_px2, known.growth[e, m]
                points[5, i] = min(abs(known.pull_px[e, m]) / WHOLLY_PX, 1.0)
                i += 1
        if seen.reach_px[e] >= SHARP_REACH_PX:
            sharp += int(np.count_nonzero(seen.in_view[e]))
    return used, points, places_px, normal, seen.reach_px, sharp


@compiled(VECTOR, INT)
def _of_tukey(u2: Array, unknowns: int) -> float:
    """Return how much larger the variance is than the weights of N points promise.

    ``u2`` (N,) are squared residuals over TUKEY sigma, 1 at most.  Huber, "Robust statistics", 1981, eq. 7.6.2: near 1
    for many Gaussian residuals, more for heavy tails.
    """
    points, curving, felt, weights = len(u2), 0.0, 0.0, 0.0
    for i in range(points):
        less = 1 - u2[i]
        curving += less * (1 - 5 * u2[i]) / points
        felt += TUKEY**2 * u2[i] * less**4 / points
        weights += less**2
    promised = felt * weights / max(curving, LEAST_CURVING) ** 2 / max(points - unknowns, 1)
    return max(promised, OF_GAUSSIAN)


@compiled(VECTOR, FLAGS)
def _spread(residual: Array, quiet: Mask) -> float:
    """Return the robust standard deviation of the quiet residuals: 1.4826 times their median absolute value."""
    size, count = np.empty(len(residual)), 0
    for i in range(len(residual)):
        if quiet[i]:
            size[count] = abs(residual[i])
            count += 1
    return 1.4826 * ranked(size[:count], count // 2)


@compiled(MATRIX, VECTOR, VECTOR, VECTOR, VECTOR, VECTOR)
def _robust_least_squares(
    A: Array, offset: Array, keen: Array, share: Array, common: Array, prior_sigma: Array
) -> tuple[Array, Array, Array]:
    """Solve x A = offset (N,) with Tukey's weights, each unknown known to be 0 within ``prior_sigma`` (P,) beforehand.

    ``A`` (P, N) has a row for each unknown.  Returns them (P,), final weights (N,), and the covariance (P, P).
    """
    size, points = A.shape
    A, offset, common = A.copy(), offset * keen, common * (keen * keen)
    scale, prior = np.empty(size), np.empty(size)
    for p in range(size):  # metres and radians differ by orders: solve in pixels
        for i in range(points):
            A[p, i] *= keen[i]  # now all points are as noisy
        scale[p] = np.sqrt(dot(A[p], A[p])) + 1e-12
        for i in range(points):
            A[p, i] /= scale[p]
        prior[p] = 1 / (prior_sigma[p] * scale[p]) ** 2 + 1e-9
    quiet = common <= ranked(common, points // 2)
    sigma_px = FIRST_SIGMA_PX
    weight, u2, residual, x = 1 / (sigma_px**2 / share + common), np.empty(points), np.empty(points), np.empty(size)
    covariance, weighted = np.empty((size, size)), np.empty(points)
    for reweighted in range(REWEIGHTINGS):
        right = np.zeros(size)
        for p in range(size):
            for i in range(points):
                weighted[i] = A[p, i] * weight[i]
            right[p] = dot(weighted, offset)
            for q in range(p + 1):
                covariance[p, q] = covariance[q, p] = dot(weighted, A[q])
            covariance[p, p] += prior[p]
        covariance = inverse(factored(covariance))
        residual[:] = offset
        for p in range(size):
            x[p] = dot(covariance[p], right)
            for i in range(points):
                residual[i] -= x[p] * A[p, i]
        before_px, sigma_px = sigma_px, max(_spread(residual, quiet), NOISE_FLOOR_PX)
        for i in range(points):
            u2[i] = min(residual[i] ** 2 / (TUKEY**2 * (sigma_px**2 + common[i])), 1.0)
        if reweighted and abs(sigma_px - before_px) <= SAME_SPREAD * before_px:
            break
        for i in range(points):
            weight[i] = (1 - u2[i]) ** 2 / (sigma_px**2 / share[i] + common[i])
    inflated = _of_tukey(u2, size)
    for p in range(size):
        for q in range(size):
            covariance[p, q] *= inflated / (scale[p] * scale[q])
    return x / scale, weight * (keen * keen / inflated), covariance


@compiled(MATRIX, INDICES, MATRIX, VECTOR, VECTOR)
def _solved(
    slopes: Array, used: NDArray[np.int64], points: Array, left: Array, step_sigma: Array
) -> tuple[bool, Array, Array, Array, Array]:
    """Return the step that takes the warp to where N of all points were measured, and whether it is one.

    ``slopes`` (P, all) are what they feel of the parameters, known to be 0 within ``step_sigma`` (P,) beforehand;
    ``points`` is what is known of them and ``left`` (N,) how far they are from their places.  First what they feel
    (P + 3, N) of the parameters and of the nuisance, bias and wrong pulls; then the unknowns (P + 3,), final weights
    (N,) in 1 / px^2, and the covariance (P + 3, P + 3).
    """
    size = len(slopes)
    A, prior_sigma = np.empty((size + NUISANCES, len(used))), np.empty(size + NUISANCES)
    prior_sigma[:size], prior_sigma[size:] = step_sigma, NUISANCE_SIGMA
    for i in range(len(used)):
        for p in range(size):
            A[p, i] = slopes[p, used[i]]
        A[size, i], A[size + 1, i], A[size + 2, i] = 1.0, points[4, i], points[5, i]
    x, weight, covariance = _robust_least_squares(A, left, points[1], points[2], points[3], prior_sigma)
    return bool(np.isfinite(x).all()), A, x, weight, covariance


@compiled(MATRIX, MATRIX, MATRIX, INDICES, VECTOR, MATRIX, VECTOR)
def _left(
    places_px: Array, at_px: Array, normal: Array, used: NDArray[np.int64], before: Array, A: Array, x: Array
) -> tuple[Array, float]:
    """Return how far N points now are (all, 2) from their places (2, all), and most by how much that is a surprise.

    It was ``before`` (N,), and should have changed by a step: the unknowns ``x`` (P + 3,) but for the nuisance.
    """
    left, surprise_px = np.empty(len(used)), 0.0
    for i in range(len(used)):
        k = used[i]
        dx, dy = places_px[0, k] - at_px[k, 0], places_px[1, k] - at_px[k, 1]
        left[i] = dx * normal[0, k] + dy * normal[1, k]
        expected = before[i]
        for p in range(len(x) - NUISANCES):
            expected -= x[p] * A[p, i]
        surprise_px = max(surprise_px, abs(left[i] - expected))
    return left, surprise_px


@compiled(MATRIX, VECTOR, VECTOR, MATRIX, VECTOR, VECTOR, INDICES, VECTOR, INT)
def _judged(
    A: Array,
    x: Array,
    weight: Array,
    covariance: Array,
    offset_px: Array,
    left: Array,
    used: NDArray[np.int64],
    reach_px: Array,
    sharp: int,
) -> tuple[Array, float, float]:
    """Return weights, offsets and shared variances of all points (3, E, M), the cost, and how far the fit moved edges.

    They were ``offset_px`` (N,) away at first, and are ``left`` (N,); what the nuisance explains of both is taken off.
    The cost is the mean of truncated squares; points in view on ``sharp`` edges that were not used count as far off.
    """
    at_points = np.zeros((3, len(reach_px), POINTS_PER_EDGE))
    first, size, truncated, moved_px = len(x) - NUISANCES, len(x), 0.0, 0.0
    for i in range(len(used)):
        nuisance_px, shared_px2 = 0.0, 0.0
        for p in range(first, size):
            nuisance_px += x[p] * A[p, i]
            for q in range(first, size):
                shared_px2 += A[p, i] * covariance[p, q] * A[q, i]
        truncated += min(((left[i] - nuisance_px) / COST_UNIT_PX) ** 2, COST_CAP)
        moved_px = max(moved_px, abs(offset_px[i] - left[i]))
        e, m = used[i] // POINTS_PER_EDGE, used[i] % POINTS_PER_EDGE
        at_points[0, e, m], at_points[1, e, m], at_points[2, e, m] = weight[i], offset_px[i] - nuisance_px, shared_px2
    in_all = max(sharp, len(used))
    return at_points, (truncated + COST_CAP * (in_all - len(used))) / in_all, moved_px


@compiled(VECTOR)
def followed(weight: Array) -> bool:
    """Return whether a fit follows an edge, by the weights of its points (M,)."""
    return bool(np.count_nonzero(weight) >= LEAST_FOUND * POINTS_PER_EDGE)


def follows_all_sides(fit: EdgeFit[W]) -> bool:
    """Return whether a fit follows an edge on each of the four sides, of one square or of several."""
    sides = {int(edge) % 4 for edge, weight in zip(fit.edges, fit.weight, strict=True) if followed(weight)}
    return len(sides) == 4
