"""Fitting a warp to the edges of a marker, robustly.

Residuals are distances across the edges, in pixels.  Besides the warp's own parameters the fit carries one
*edge bias*: how far all edges lie towards the paper.  What is left of a camera's response curve moves every
black-white edge the same way, and black squares and white frames feel it with opposite signs.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from astratag.compiled import FLAG_MATRIX, FLAGS, INDICES, INT, MATRIX, REAL, VECTOR, compiled
from astratag.edges import POINTS_PER_EDGE, template_of
from astratag.locate import SMOOTHING_PX, EdgePoints, locate
from astratag.neighbours import Crossings, narrowing, pull
from astratag.normal import dot, factored, inverse, ranked
from astratag.warp import FittedWarp

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
W = TypeVar("W", bound=FittedWarp)

BIAS_SIGMA_PX = 0.04
"""Prior standard deviation of the edge bias: what a known response curve leaves."""
NOISE_FLOOR_PX = 0.01
"""No edge point is believed to be better than this."""
FIRST_SIGMA_PX = 0.3
"""What the noise is taken for at first: so much that all points count alike."""
CORRELATION_LENGTH_PX = 1.6
"""Edge points nearer than this along an edge share their noise (blur, JPEG blocks)."""
PULL_PX, PULL_FLOOR_PX = 0.023, 0.002
"""How far a whole edge may be off when its neighbours are as near as ``SHARP_REACH_PX``, and at least."""
NUISANCE_SIGMA = np.array([BIAS_SIGMA_PX, 0.15])
"""Prior standard deviations of the edge bias, and of how wrong what is known of all pulls is, as a fraction of them."""
NUISANCES = len(NUISANCE_SIGMA)
_PARAMETERS = slice(0, -NUISANCES)
OUTERMOST = 4
"""The first so many edges are those of the outermost square."""
PULL_REST, PULL_GROWTH = 0.05, 2.0
"""How wrong a single pull is besides; how much faster than a weak pull a strong one grows with blur."""
BACKGROUND = 0.5
"""How much darker or brighter than paper what is behind the print may be, over what ink is."""
FAR_MARGIN, FAR_REACH = 5.0, 4.0
"""What is behind the print, and neighbours, do not pull from this many times the blur away."""
MOST_BLUR_STEPS, SAME_BLUR = 3, 0.03
"""Blur and pull are found from each other until the blur changes by no more than this fraction."""
MOST_PULL, LOST_PX = 0.4, 0.3
"""A pull by more than this fraction of the blur is not believed; the edge may then be off by so much."""
SMOOTHING_OF_LENS, REACH_OF_SMOOTHING, WORTHWHILE = 0.8, 5.0, 1.4
"""Width of the filter for blurred edges: over the blur's, at most a part of their reach, and from which gain on."""
SMOOTHING_STEP_PX = 0.25
LEAST_CURVING = 0.3
TUKEY = 4.685
"""Residuals beyond this many standard deviations weigh nothing (95 % efficiency on Gaussian noise)."""
REWEIGHTINGS, SAME_SPREAD = 5, 0.02
"""Weights are found again until the residuals' spread changes by no more than this fraction."""
MAX_STEPS, LINEAR_PX = 6, 0.01
"""Gauss-Newton steps end when the last did what its derivative promised, to this many pixels."""
SHARP_REACH_PX, LEAST_REACH_PX = 4.0, 1.2
"""An edge this far from its neighbours is sharp; nearer, they pull, and below the least it is no edge of its own."""
LEAST_FOUND, LEAST_IN_VIEW, LEAST_ON_SIDE = 0.4, 0.15, 5
"""Fraction of an edge's points that must be found for it to count; of them all that must be in view; points a side."""
COST_UNIT_PX, COST_CAP = 0.5, 9.0


@dataclass(frozen=True, eq=False)
class EdgeFit(Generic[W]):
    """A warp fitted to edges.

    ``covariance`` (P, P) is of the warp's own parameters, bias and pulls marginalised.  ``weight`` (E, M) is each
    point's final weight in 1 / px^2, 0 where it was not used; ``offset_px`` (E, M) its distance from ``before``, the
    warp the edges were looked for with, bias and pulls removed, and ``shared_px2`` (E, M) the variance of what was
    removed.  ``cost`` is the mean truncated squared residual over every point in view: what alternatives are compared
    by.  ``moved_px`` is how far the step moved the edge that moved most.
    """

    warp: W
    before: W
    points: EdgePoints
    weight: Array
    offset_px: Array
    shared_px2: Array
    sigma_px: float
    covariance: Array
    cost: float
    moved_px: float


def fit_edges(
    light: NDArray[np.float32],
    warp: W,
    edges: NDArray[np.int64],
    search_px: float,
    near: Crossings | None = None,
) -> EdgeFit[W] | None:
    """Return ``warp`` moved onto the edges seen near it; None when too few are seen.

    ``near`` is what lies beside the edges in the print of a known code: what it pulls them by is taken off.
    """
    seen = _located(light, warp, edges, search_px)
    use = _usable(seen.found, seen.in_view, seen.lie.reach_px)
    if not _on_all_sides(edges, use):
        return None
    known = _pulls(seen, near, use)
    use = clear if _on_all_sides(edges, clear := use & ~known.lost) else use
    moved = _gauss_newton(warp, seen, known, use)
    if moved is None:
        return None
    fitted, A, left, solution = moved
    offset = (seen.offset_px - known.pull_px)[use]
    residual, cost = _cost(A, left, solution.x, seen.in_view, seen.lie.reach_px)
    return EdgeFit(
        warp=fitted,
        before=warp,
        points=seen,
        weight=_at_points(use, solution.weight),
        offset_px=_at_points(use, offset - left + residual),
        shared_px2=_at_points(use, _variance_of_nuisance(A, solution.covariance)),
        sigma_px=solution.sigma_px,
        covariance=solution.covariance[_PARAMETERS, _PARAMETERS],
        cost=cost,
        moved_px=float(np.abs(offset - left).max()),
    )


@compiled(MATRIX, VECTOR, VECTOR, FLAG_MATRIX, VECTOR)
def _cost(A: Array, left: Array, x: Array, in_view: Mask, reach_px: Array) -> tuple[Array, float]:
    """Return what is left (N,) once the nuisance's part is taken off, and the mean of its truncated squares.

    Points (E, M) in view on sharp edges that were not used count as far off.
    """
    residual, truncated, sharp = np.empty(len(left)), 0.0, 0
    for i in range(len(left)):
        residual[i] = left[i]
        for p in range(len(x) - NUISANCES, len(x)):
            residual[i] -= x[p] * A[p, i]
        truncated += min((residual[i] / COST_UNIT_PX) ** 2, COST_CAP)
    for e in range(len(reach_px)):
        if reach_px[e] >= SHARP_REACH_PX:
            sharp += int(np.count_nonzero(in_view[e]))
    in_all = max(sharp, len(left))
    return residual, (truncated + COST_CAP * (in_all - len(left))) / in_all


@compiled(MATRIX, MATRIX)
def _variance_of_nuisance(A: Array, covariance: Array) -> Array:
    """Return the variance (N,) of what the nuisance does to each point."""
    first, size = len(A) - NUISANCES, len(A)
    variance = np.zeros(A.shape[1])
    for i in range(A.shape[1]):
        for p in range(first, size):
            for q in range(first, size):
                variance[i] += A[p, i] * covariance[p, q] * A[q, i]
    return variance


@compiled(FLAG_MATRIX, VECTOR)
def _at_points(use: Mask, values: Array) -> Array:
    """Return values (N,) of the points to use at their places (E, M), 0 elsewhere."""
    at, i = np.zeros(use.shape), 0
    for e in range(use.shape[0]):
        for m in range(use.shape[1]):
            if use[e, m]:
                at[e, m] = values[i]
                i += 1
    return at


def _located(light: NDArray[np.float32], warp: W, edges: NDArray[np.int64], search_px: float) -> EdgePoints:
    """Return where edges are, the blurred ones through a wider filter, as far as neighbours leave room for it."""
    seen = locate(light, warp, edges, search_px)
    wider_px = min(SMOOTHING_OF_LENS * seen.lens_px, float(seen.lie.reach_px.max()) / REACH_OF_SMOOTHING)
    if wider_px < WORTHWHILE * SMOOTHING_PX:
        return seen
    return locate(light, warp, edges, search_px, round(wider_px / SMOOTHING_STEP_PX) * SMOOTHING_STEP_PX)


def _gauss_newton(warp: W, seen: EdgePoints, known: _Pulls, use: Mask) -> tuple[W, Array, Array, _Solution] | None:
    """Return the warp that brings the N points to ``use`` to where they were measured; None when it goes astray.

    Also what they feel (P, N) of the parameters and the nuisance, what is left of their offsets (N,), and the last
    solution.  One step does where the warp is as good as linear; a small square seen nearly square-on needs more, for
    its tilt shows in the second order.
    """
    template, lie = template_of(seen.edge).points, seen.lie
    normal, at_px = lie.normal.reshape(2, -1), lie.predicted_px.reshape(2, -1)
    places_px = _moved(at_px, normal, seen.offset_px, known.pull_px)
    used, parts = _kept(use, seen.offset_px, lie.length_px, *known[:-1])
    left, keen, share, variance, growth = parts
    prior_sigma = np.concatenate([warp.step_sigma(), NUISANCE_SIGMA])
    for _ in range(MAX_STEPS):
        A = _felt(warp.slopes(template, normal), used, growth)
        solution = _Solution(*_robust_least_squares(A, left, keen, share, variance, prior_sigma))
        step = solution.x[_PARAMETERS]
        if not np.isfinite(step).all():
            return None
        warp = warp.stepped(step)
        left, surprise_px = _left(places_px, warp(template), normal, used, left, A, step)
        if surprise_px < LINEAR_PX:
            break
    return warp, A, left, solution


@compiled(MATRIX, MATRIX, MATRIX, MATRIX)
def _moved(at_px: Array, normal: Array, offset_px: Array, pull_px: Array) -> Array:
    """Return where all points (2, E M) were measured: moved along normals (2, E M) by their offsets (E, M)."""
    places_px, points = np.empty(at_px.shape), offset_px.shape[1]
    for k in range(at_px.shape[1]):
        moved = offset_px[k // points, k % points] - pull_px[k // points, k % points]
        places_px[0, k], places_px[1, k] = at_px[0, k] + moved * normal[0, k], at_px[1, k] + moved * normal[1, k]
    return places_px


@compiled(FLAG_MATRIX, MATRIX, VECTOR, MATRIX, MATRIX, MATRIX, MATRIX)
def _kept(
    use: Mask, offset_px: Array, length_px: Array, pull_px: Array, variance: Array, keen: Array, growth: Array
) -> tuple[NDArray[np.int64], Array]:
    """Return which N of all points are used, and their offsets, keenness, shares, variances and growth (5, N).

    The share is of what a point of an edge that looks short tells for itself.
    """
    edges, points = use.shape
    count, i = np.count_nonzero(use), 0
    used, parts = np.empty(count, np.int64), np.empty((5, count))
    for e in range(edges):
        for m in range(points):
            if use[e, m]:
                used[i], parts[0, i] = points * e + m, offset_px[e, m] - pull_px[e, m]
                parts[1, i], parts[3, i], parts[4, i] = keen[e, m], variance[e, m], growth[e, m]
                parts[2, i] = min(1.0, length_px[e] / (points * CORRELATION_LENGTH_PX))
                i += 1
    return used, parts


@compiled(MATRIX, INDICES, VECTOR)
def _felt(slopes: Array, used: NDArray[np.int64], growth: Array) -> Array:
    """Return what N of all points feel of the parameters (P, all), and of the nuisance: bias and wrong pulls."""
    size = len(slopes)
    A = np.empty((size + NUISANCES, len(used)))
    for i in range(len(used)):
        for p in range(size):
            A[p, i] = slopes[p, used[i]]
        A[size, i], A[size + 1, i] = 1.0, growth[i]
    return A


@compiled(MATRIX, MATRIX, MATRIX, INDICES, VECTOR, MATRIX, VECTOR)
def _left(
    places_px: Array, at_px: Array, normal: Array, used: NDArray[np.int64], before: Array, A: Array, step: Array
) -> tuple[Array, float]:
    """Return how far N points now are (all, 2) from their places (2, all), and most by how much that is a surprise.

    It was ``before`` (N,), and should have changed by ``step`` (P,).
    """
    left, surprise_px = np.empty(len(used)), 0.0
    for i in range(len(used)):
        k = used[i]
        dx, dy = places_px[0, k] - at_px[k, 0], places_px[1, k] - at_px[k, 1]
        left[i] = dx * normal[0, k] + dy * normal[1, k]
        expected = before[i]
        for p in range(len(step)):
            expected -= step[p] * A[p, i]
        surprise_px = max(surprise_px, abs(left[i] - expected))
    return left, surprise_px


class _Solution(NamedTuple):
    """Unknowns (P,), final weights (N,) in 1 / px^2, standard deviation of one point, covariance (P, P)."""

    x: Array
    weight: Array
    sigma_px: float
    covariance: Array


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


@compiled(VECTOR)
def followed(weight: Array) -> bool:
    """Return whether a fit follows an edge, by the weights of its points (M,)."""
    return bool(np.count_nonzero(weight) >= LEAST_FOUND * POINTS_PER_EDGE)


def follows_all_sides(fit: EdgeFit[W]) -> bool:
    """Return whether a fit follows an edge on each of the four sides, of one square or of several."""
    sides = {int(edge) % 4 for edge, weight in zip(fit.points.edge, fit.weight, strict=True) if followed(weight)}
    return len(sides) == 4


class _Pulls(NamedTuple):
    """What is known (E, M) of how neighbours pull each point.

    ``variance`` is of what is not known of it, in points: what all points of an edge have in common does not average
    out, so each carries it as many times as there are points.  The keener a point, the less noise moves it: neighbours
    make the top of the slope rounder or flatter.  ``growth`` is how the pull grows with blur, and where it is ``lost``
    nothing is known.
    """

    pull_px: Array
    variance: Array
    keen: Array
    growth: Array
    lost: Mask


def _pulls(seen: EdgePoints, near: Crossings | None, use: Mask) -> _Pulls:
    """Return what is known of the pulls on points to ``use`` (E, M), nothing without ``near``."""
    lie = seen.lie
    if near is None:
        return _Pulls(*_unknown(lie.reach_px, seen.clipped_px))
    blur_px = _blur_alone(seen, near)
    pulled = np.flatnonzero(use.any(axis=1) & (lie.reach_px < FAR_REACH * blur_px))
    pull_px, keen = np.zeros(use.shape), np.ones(use.shape)
    if len(pulled):
        pull_px[pulled], keen[pulled] = pull(near, seen.edge[pulled], lie.unit_px[pulled], blur_px)
    return _Pulls(*_known(pull_px, keen, blur_px, seen.edge, lie.margin_px, seen.clipped_px))


@compiled(VECTOR, MATRIX)
def _unknown(reach_px: Array, clipped_px: Array) -> tuple[Array, Array, Array, Array, Mask]:
    """Return that no pull (E, M) is known, but how large it may be: the fields of ``_Pulls``."""
    variance = np.empty(clipped_px.shape)
    for e in range(len(reach_px)):
        off_px = PULL_PX * (SHARP_REACH_PX / max(reach_px[e], 1e-3)) ** 2 + PULL_FLOOR_PX
        for m in range(clipped_px.shape[1]):
            variance[e, m] = POINTS_PER_EDGE * (off_px**2 + clipped_px[e, m] ** 2)
    none = np.zeros(clipped_px.shape)
    return none, variance, np.ones(clipped_px.shape), none, np.zeros(clipped_px.shape, np.bool_)


@compiled(MATRIX, MATRIX, REAL, INDICES, MATRIX, MATRIX)
def _known(
    pull_px: Array, keen: Array, blur_px: float, edges: NDArray[np.int64], margin_px: Array, clipped_px: Array
) -> tuple[Array, Array, Array, Array, Mask]:
    """Return what pulls (E, M), NaN where there is no knowing, tell: the fields of ``_Pulls``."""
    believed, variance, growth = np.zeros(pull_px.shape), np.empty(pull_px.shape), np.zeros(pull_px.shape)
    lost = np.zeros(pull_px.shape, np.bool_)
    for e in range(pull_px.shape[0]):
        for m in range(pull_px.shape[1]):
            size_px = abs(pull_px[e, m])
            if size_px <= MOST_PULL * blur_px:
                believed[e, m] = pull_px[e, m]
                growth[e, m] = pull_px[e, m] * (1 + PULL_GROWTH / blur_px * size_px)
                wrong_px2 = (PULL_REST * size_px) ** 2 + PULL_FLOOR_PX**2
                margin = margin_px[e, m] / blur_px
                if edges[e] < OUTERMOST and margin < FAR_MARGIN:
                    margin = max(margin, 1.0)
                    wrong_px2 += (BACKGROUND * blur_px * margin * np.exp(-0.5 * margin * margin)) ** 2
            else:
                lost[e, m], wrong_px2 = True, LOST_PX**2
            variance[e, m] = POINTS_PER_EDGE * (wrong_px2 + clipped_px[e, m] ** 2)  # glare moves a whole edge alike
    return believed, variance, keen.copy(), growth, lost


def _blur_alone(seen: EdgePoints, near: Crossings) -> float:
    """Return the blur that edges would show without neighbours, which narrow or widen them."""
    edges = np.flatnonzero(seen.alone.any(axis=1))
    if len(edges) == 0 or seen.lie.reach_px[edges].min() > FAR_REACH * seen.blur_px:
        return seen.blur_px
    blur_px, use = seen.blur_px, seen.alone[edges]
    for _ in range(MOST_BLUR_STEPS):
        narrowed = narrowing(near, seen.edge[edges], seen.lie.unit_px[edges], blur_px)[use]
        before_px, blur_px = blur_px, seen.blur_px * float(np.sqrt(narrowed.sum() / len(narrowed)))
        if abs(blur_px - before_px) < SAME_BLUR * before_px:
            break
    return blur_px


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
    return max(promised, 1.0)


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
) -> tuple[Array, Array, float, Array]:
    """Solve x A = offset (N,) with Tukey's weights, each unknown known to be 0 within ``prior_sigma`` (P,) beforehand.

    ``A`` (P, N) has a row for each unknown.  Returns the fields of ``_Solution``.
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
            u2[i] = min(residual[i] ** 2 / (TUKEY**2 * (sigma_px**2 + common[i] / POINTS_PER_EDGE)), 1.0)
        if reweighted and abs(sigma_px - before_px) <= SAME_SPREAD * before_px:
            break
        for i in range(points):
            weight[i] = (1 - u2[i]) ** 2 / (sigma_px**2 / share[i] + common[i])
    inflated = _of_tukey(u2, size)
    for p in range(size):
        for q in range(size):
            covariance[p, q] *= inflated / (scale[p] * scale[q])
    return x / scale, weight * (keen * keen / inflated), sigma_px, covariance
