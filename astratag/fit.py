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

from astratag.edges import POINTS_PER_EDGE, SMOOTHING_PX, EdgePoints, locate, template_of
from astratag.neighbours import Crossings, narrowing, pull
from astratag.warp import FittedWarp

Array = NDArray[np.float64]
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
_PARAMETERS, _NUISANCE = slice(0, -len(NUISANCE_SIGMA)), slice(-len(NUISANCE_SIGMA), None)
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
    use = _usable(seen)
    if not _on_all_sides(seen, use):
        return None
    known = _pulls(seen, near, use)
    use = clear if _on_all_sides(seen, clear := use & ~known.lost) else use
    moved = _gauss_newton(warp, seen, known, use)
    if moved is None:
        return None
    fitted, left, nuisance, solution = moved
    offset = (seen.offset_px - known.pull_px)[use]
    residual = left - solution.x[_NUISANCE] @ nuisance
    by_point = np.zeros((3, *use.shape))
    by_point[:, use] = (
        solution.weight,
        offset - left + residual,
        ((solution.covariance[_NUISANCE, _NUISANCE] @ nuisance) * nuisance).sum(axis=0),
    )
    in_view = max(int(np.count_nonzero(seen.in_view[seen.reach_px >= SHARP_REACH_PX])), len(residual))
    truncated = np.minimum((residual / COST_UNIT_PX) ** 2, COST_CAP).sum() + COST_CAP * (in_view - len(residual))
    return EdgeFit(
        warp=fitted,
        before=warp,
        points=seen,
        weight=by_point[0],
        offset_px=by_point[1],
        shared_px2=by_point[2],
        sigma_px=solution.sigma_px,
        covariance=solution.covariance[_PARAMETERS, _PARAMETERS],
        cost=float(truncated / in_view),
        moved_px=float(np.abs(offset - left).max()),
    )


def _located(light: NDArray[np.float32], warp: W, edges: NDArray[np.int64], search_px: float) -> EdgePoints:
    """Return where edges are, the blurred ones through a wider filter, as far as neighbours leave room for it."""
    seen = locate(light, warp, edges, search_px)
    wider_px = min(SMOOTHING_OF_LENS * seen.lens_px, float(seen.reach_px.max()) / REACH_OF_SMOOTHING)
    if wider_px < WORTHWHILE * SMOOTHING_PX:
        return seen
    return locate(light, warp, edges, search_px, round(wider_px / SMOOTHING_STEP_PX) * SMOOTHING_STEP_PX)


def _gauss_newton(
    warp: W, seen: EdgePoints, known: _Pulls, use: NDArray[np.bool_]
) -> tuple[W, Array, Array, _Solution] | None:
    """Return the warp that brings the N points to ``use`` to where they were measured; None when it goes astray.

    Also what is left of their offsets (N,), what they feel (2, N) of bias and wrong pulls, and the last solution.  One
    step does where the warp is as good as linear; a small square seen nearly square-on needs more, for its tilt shows
    in the second order.
    """
    template, used = template_of(seen.edge).points, use.ravel()
    normal = seen.normal.reshape(2, -1)
    offset_px = seen.offset_px - known.pull_px
    places_px = seen.predicted_px.reshape(2, -1) + offset_px.ravel() * normal
    share = np.minimum(1.0, seen.length_px / (POINTS_PER_EDGE * CORRELATION_LENGTH_PX)).repeat(POINTS_PER_EDGE)
    left, keen, share, variance = offset_px[use], known.keen[use], share[used], known.variance[use]
    prior_sigma = np.concatenate([warp.step_sigma(), NUISANCE_SIGMA])
    A = np.ones((len(prior_sigma), len(left)))
    A[-1] = known.growth[use]
    for _ in range(MAX_STEPS):
        A[_PARAMETERS] = warp.slopes(template, normal)[:, used]
        solution = _robust_least_squares(A, left, keen, share, variance, prior_sigma)
        step = solution.x[_PARAMETERS]
        if not np.isfinite(step).all():
            return None
        expected = left - step @ A[_PARAMETERS]
        warp = warp.stepped(step)
        off = (places_px - warp(template).T) * normal
        left = (off[0] + off[1])[used]
        if np.abs(left - expected).max() < LINEAR_PX:
            break
    return warp, left, A[_NUISANCE], solution


class _Solution(NamedTuple):
    """Unknowns (P,), final weights (N,) in 1 / px^2, standard deviation of one point, covariance (P, P)."""

    x: Array
    weight: Array
    sigma_px: float
    covariance: Array


def _usable(seen: EdgePoints) -> NDArray[np.bool_]:
    """Return which points (E, M) to use: those of edges mostly found and not too near their neighbours."""
    found, in_view = (np.count_nonzero(part, axis=1) for part in (seen.found, seen.in_view))
    mostly = found >= LEAST_FOUND * np.maximum(in_view, LEAST_IN_VIEW * POINTS_PER_EDGE)
    return seen.found & (mostly & (seen.reach_px >= LEAST_REACH_PX))[:, None]


def _on_all_sides(seen: EdgePoints, use: NDArray[np.bool_]) -> bool:
    """Return whether the points to use (E, M) lie on all four sides: edges come in fours, sides of a square."""
    enough = np.count_nonzero(use, axis=1) >= LEAST_ON_SIDE
    return len(set((seen.edge[enough] % 4).tolist())) == 4


def follows_all_sides(fit: EdgeFit[W]) -> bool:
    """Return whether a fit follows an edge on each of the four sides, of one square or of several."""
    used = np.count_nonzero(fit.weight, axis=1) >= LEAST_FOUND * POINTS_PER_EDGE
    return len(set((fit.points.edge[used] % 4).tolist())) == 4


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
    lost: NDArray[np.bool_]


def _pulls(seen: EdgePoints, near: Crossings | None, use: NDArray[np.bool_]) -> _Pulls:
    """Return what is known of the pulls on points to ``use`` (E, M), nothing without ``near``."""
    pull_px, growth, variance = np.zeros((3, *use.shape))
    keen = np.ones(use.shape)
    if near is None:
        off_px = PULL_PX * (SHARP_REACH_PX / np.maximum(seen.reach_px, 1e-3)) ** 2 + PULL_FLOOR_PX
        variance[:] = POINTS_PER_EDGE * (np.square(off_px)[:, None] + np.square(seen.clipped_px))
        return _Pulls(pull_px, variance, keen, growth, pull_px > 0)
    blur_px = _blur_alone(seen, near)
    pulled = np.flatnonzero(use.any(axis=1) & (seen.reach_px < FAR_REACH * blur_px))
    pull_px[pulled], keen[pulled] = pull(near, seen.edge[pulled], seen.unit_px[pulled], blur_px)
    size_px = np.abs(pull_px)
    lost = ~(size_px <= MOST_PULL * blur_px)
    pull_px[lost] = 0.0
    np.multiply(pull_px, 1 + PULL_GROWTH / blur_px * size_px, out=growth)
    np.add(np.square(PULL_REST * pull_px), PULL_FLOOR_PX**2, out=variance)
    outermost = seen.edge < 4
    margin = seen.margin_px[outermost] / blur_px
    if margin.min(initial=np.inf) < FAR_MARGIN:
        margin = np.clip(margin, 1.0, FAR_MARGIN)
        variance[outermost] += np.square(BACKGROUND * blur_px * margin * np.exp(-0.5 * margin * margin))
    variance[lost] = LOST_PX**2
    variance += np.square(seen.clipped_px)  # glare moves all points of an edge alike
    variance *= POINTS_PER_EDGE
    return _Pulls(pull_px, variance, keen, growth, lost)


def _blur_alone(seen: EdgePoints, near: Crossings) -> float:
    """Return the blur that edges would show without neighbours, which narrow or widen them."""
    edges = np.flatnonzero(seen.alone.any(axis=1))
    if len(edges) == 0 or seen.reach_px[edges].min() > FAR_REACH * seen.blur_px:
        return seen.blur_px
    blur_px, use = seen.blur_px, seen.alone[edges]
    for _ in range(MOST_BLUR_STEPS):
        narrowed = narrowing(near, seen.edge[edges], seen.unit_px[edges], blur_px)[use]
        before_px, blur_px = blur_px, seen.blur_px * float(np.sqrt(narrowed.sum() / len(narrowed)))
        if abs(blur_px - before_px) < SAME_BLUR * before_px:
            break
    return blur_px


def _robust_least_squares(
    A: Array, offset: Array, keen: Array, share: Array, common: Array, prior_sigma: Array
) -> _Solution:
    """Solve x A = offset (N,) with Tukey's weights, each unknown known to be 0 within ``prior_sigma`` (P,) beforehand.

    ``A`` (P, N) has a row for each unknown.
    """
    A, offset, common = A * keen, offset * keen, common * (keen * keen)  # now all points are as noisy
    scale = np.sqrt(np.einsum("pn,pn->p", A, A)) + 1e-12  # metres and radians differ by orders: solve in pixels
    A /= scale[:, None]
    prior = np.diag((prior_sigma * scale) ** -2.0 + 1e-9)
    middle = len(offset) // 2
    pulled, quiet = common / POINTS_PER_EDGE, common <= np.partition(common, middle)[middle]
    sigma_px = FIRST_SIGMA_PX
    weight = 1 / (sigma_px**2 / share + common)
    for reweighted in range(REWEIGHTINGS):
        weighted = A * weight
        covariance = np.linalg.inv(weighted @ A.T + prior)
        x = covariance @ (weighted @ offset)
        residual = offset - x @ A
        before_px, sigma_px = sigma_px, max(_spread(residual[quiet]), NOISE_FLOOR_PX)
        u2 = np.minimum(residual * residual / (TUKEY**2 * (sigma_px**2 + pulled)), 1.0)
        if reweighted and abs(sigma_px - before_px) <= SAME_SPREAD * before_px:
            break
        weight = np.square(1 - u2) / (sigma_px**2 / share + common)
    inflated = _of_tukey(u2, len(x))
    weight *= keen * keen / inflated
    return _Solution(x / scale, weight, sigma_px, inflated / np.outer(scale, scale) * covariance)


def _of_tukey(u2: Array, unknowns: int) -> float:
    """Return how much larger the variance is than the weights of N points promise.

    ``u2`` (N,) are squared residuals over TUKEY sigma, 1 at most.  Huber, "Robust statistics", 1981, eq. 7.6.2: near 1
    for many Gaussian residuals, more for heavy tails.
    """
    points = len(u2)
    less = 1 - u2
    robust = less * less
    curving = float(less @ (1 - 5 * u2)) / points
    felt = TUKEY**2 * float((u2 * robust) @ robust) / points
    promised = felt * float(robust.sum()) / max(curving, LEAST_CURVING) ** 2 / max(points - unknowns, 1)
    return max(promised, 1.0)


def _spread(residual: Array) -> float:
    """Return the robust standard deviation: 1.4826 times the median absolute residual."""
    middle = len(residual) // 2
    return float(1.4826 * np.partition(np.abs(residual), middle)[middle])
