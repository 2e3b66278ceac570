"""Fitting a warp to the edges of a marker, robustly, and measuring each layer's corners with it.

Residuals are distances across the edges, in pixels.  Besides the warp's own parameters the fit carries one
*edge bias*: how far all edges lie towards the paper.  What is left of a camera's response curve moves every
black-white edge the same way, and black squares and white frames feel it with opposite signs.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from astratag.detection import LayerDetection
from astratag.edges import ALONG, EDGE_POINTS, EDGES, POINTS_PER_EDGE, EdgePoints, locate
from astratag.geometry import LAYERS, square
from astratag.warp import FittedWarp

Array = NDArray[np.float64]
W = TypeVar("W", bound=FittedWarp)

BIAS_SIGMA_PX = 0.04
"""Prior standard deviation of the edge bias: what a known response curve leaves."""
NOISE_FLOOR_PX = 0.03
"""No edge point is believed to be better than this."""
CORRELATION_LENGTH_PX = 1.6
"""Edge points nearer than this along an edge share their noise (blur, JPEG blocks)."""
CORNER_FLOOR_PX = 0.015
"""What a corner's standard deviation never falls below: print, lens model, neighbouring edges."""
PULL_PX, PULL_FLOOR_PX = 0.023, 0.005
"""How far a whole edge may be off when its neighbours are as near as ``SHARP_REACH_PX``, and at least."""
TUKEY = 4.685
"""Residuals beyond this many standard deviations weigh nothing (95 % efficiency on Gaussian noise)."""
REWEIGHTINGS, SAME_SPREAD = 4, 0.02
"""Weights are found again until the residuals' spread changes by no more than this fraction."""
MAX_STEPS, LINEAR_PX = 6, 0.01
"""Gauss-Newton steps end when the last did what its derivative promised, to this many pixels."""
SHARP_REACH_PX, LEAST_REACH_PX = 4.0, 1.2
"""An edge this far from its neighbours is sharp; nearer, they pull, and below the least it is no edge of its own."""
LEAST_FOUND = 0.4
"""Fraction of an edge's points that must be found for it to count."""
COST_UNIT_PX, COST_CAP = 0.5, 9.0


@dataclass(frozen=True, eq=False)
class EdgeFit(Generic[W]):
    """A warp fitted to edges.

    ``covariance`` (P, P) is of the warp's own parameters, the bias marginalised.  ``weight`` (E, M) is each
    point's final weight in 1 / px^2, 0 where it was not used; ``offset_px`` (E, M) its distance from ``before``, the
    warp the edges were looked for with, the bias removed.  ``cost`` is the mean truncated squared residual
    over every point in view: what alternatives are compared by.  ``moved_px`` is how far the step moved the edge
    that moved most.
    """

    warp: W
    before: W
    points: EdgePoints
    weight: Array
    offset_px: Array
    sigma_px: float
    covariance: Array
    cost: float
    moved_px: float


def fit_edges(
    light: NDArray[np.float32], warp: W, edges: NDArray[np.int64], search_px: float, *, sharp_only: bool = False
) -> EdgeFit[W] | None:
    """Return ``warp`` moved onto the edges seen near it; None when too few are seen.

    ``sharp_only`` leaves out edges that near neighbours pull: right for the last step, not for finding the way.
    """
    seen = locate(light, warp, edges, search_px)
    use = _usable(seen, sharp_only)
    if len(set((seen.edge[use.any(axis=1)] % 4).tolist())) < 4:  # edges come in fours: sides of a square
        return None
    share, common = (part.repeat(POINTS_PER_EDGE)[use.ravel()] for part in _trust(seen))
    offset = seen.offset_px[use]
    fitted, left, solution = _gauss_newton(warp, seen, use, share, common)
    residual = left - solution.x[-1]
    weights, offsets = np.zeros(use.shape), np.zeros(use.shape)
    weights[use], offsets[use] = solution.weight, offset - solution.x[-1]
    in_view = max(int((seen.in_view & (seen.reach_px >= SHARP_REACH_PX)[:, None]).sum()), len(residual))
    truncated = np.minimum((residual / COST_UNIT_PX) ** 2, COST_CAP).sum() + COST_CAP * (in_view - len(residual))
    return EdgeFit(
        warp=fitted,
        before=warp,
        points=seen,
        weight=weights,
        offset_px=offsets,
        sigma_px=solution.sigma_px,
        covariance=solution.covariance[:-1, :-1],
        cost=float(truncated / in_view),
        moved_px=float(np.abs(offset - left).max()),
    )


def _gauss_newton(
    warp: W, seen: EdgePoints, use: NDArray[np.bool_], share: Array, common: Array
) -> tuple[W, Array, _Solution]:
    """Return the warp that brings the N points to ``use`` to where they were measured.

    Also what is left of their offsets (N,), the bias included, and the last solution.  One step does where the warp
    is as good as linear; a small square seen nearly square-on needs more, for its tilt shows in the second order.
    """
    template, used = EDGE_POINTS[seen.edge].reshape(-1, 2), use.ravel()  # whole: its places on a surface are kept
    normal = seen.normal.reshape(-1, 2)
    places_px = seen.predicted_px.reshape(-1, 2) + seen.offset_px.reshape(-1, 1) * normal
    left = seen.offset_px[use]
    prior_sigma = np.append(warp.step_sigma(), BIAS_SIGMA_PX)
    for _ in range(MAX_STEPS):
        J = warp.jacobian(template)
        by_all = np.ones((len(prior_sigma), len(template)))
        by_all[:-1] = normal[:, 0] * J[:, 0].T + normal[:, 1] * J[:, 1].T
        A = by_all[:, used]
        solution = _robust_least_squares(A, left, share, common, prior_sigma)
        expected = left - solution.x[:-1] @ A[:-1]
        warp = warp.stepped(solution.x[:-1])
        off = (places_px - warp(template)) * normal
        left = (off[:, 0] + off[:, 1])[used]
        if np.abs(left - expected).max() < LINEAR_PX:
            break
    return warp, left, solution


class _Solution(NamedTuple):
    """Unknowns (P,), final weights (N,) in 1 / px^2, standard deviation of one point, covariance (P, P)."""

    x: Array
    weight: Array
    sigma_px: float
    covariance: Array


def _usable(seen: EdgePoints, sharp_only: bool) -> NDArray[np.bool_]:
    """Return which points (E, M) to use: those of edges mostly found and not too near their neighbours.

    With ``sharp_only``, those that neighbours do not pull at all, if there is a square of them.
    """
    mostly = seen.found.mean(axis=1) >= LEAST_FOUND * np.maximum(seen.in_view.mean(axis=1), 0.15)
    sharp = mostly & (seen.reach_px >= SHARP_REACH_PX)
    if sharp_only and len(set((seen.edge[sharp] % 4).tolist())) == 4:
        return seen.found & sharp[:, None]
    return seen.found & (mostly & (seen.reach_px >= LEAST_REACH_PX))[:, None]


def _trust(seen: EdgePoints) -> tuple[Array, Array]:
    """Return how much (E,) one point of an edge counts, and the variance (E,) its whole edge may be off by, in points.

    Points denser than the noise's own length share it.  An edge is pulled by its neighbours the more the nearer
    they are; what all its points have in common does not average out, so each carries it as many times.
    """
    spacing = seen.length_px / POINTS_PER_EDGE
    pull_px = PULL_PX * (SHARP_REACH_PX / np.maximum(seen.reach_px, 1e-3)) ** 2 + PULL_FLOOR_PX
    return np.minimum(1.0, spacing / CORRELATION_LENGTH_PX), POINTS_PER_EDGE * pull_px**2


def _robust_least_squares(A: Array, offset: Array, share: Array, common: Array, prior_sigma: Array) -> _Solution:
    """Solve x A = offset (N,) with Tukey's weights, each unknown known to be 0 within ``prior_sigma`` (P,) beforehand.

    ``A`` (P, N) has a row for each unknown.
    """
    scale = np.sqrt(np.einsum("pn,pn->p", A, A)) + 1e-12  # metres and radians differ by orders: solve in pixels
    A = A / scale[:, None]
    prior = np.diag((prior_sigma * scale) ** -2.0 + 1e-9)
    sigma_px = max(_spread(offset - offset.mean()), 0.3)
    robust: Array | float = 1.0
    for _ in range(REWEIGHTINGS):
        weight = robust / (sigma_px**2 / share + common)
        weighted = A * weight
        information = weighted @ A.T + prior
        x = np.linalg.solve(information, weighted @ offset)
        residual = offset - x @ A
        before_px, sigma_px = sigma_px, max(_spread(residual), NOISE_FLOOR_PX)
        if abs(sigma_px - before_px) <= SAME_SPREAD * before_px:
            break
        robust = np.square(np.maximum(1 - (residual / (TUKEY * sigma_px)) ** 2, 0))
    return _Solution(x / scale, weight, sigma_px, np.linalg.inv(information) / np.outer(scale, scale))


def _spread(residual: Array) -> float:
    """Return the robust standard deviation: 1.4826 times the median absolute residual."""
    middle = len(residual) // 2
    return float(1.4826 * np.partition(np.abs(residual), middle)[middle])


def measure_layers(fit: EdgeFit[W], shape: tuple[int, int]) -> tuple[LayerDetection, ...]:
    """Return the layers whose black square was measured: all four edges located, wholly in an image of ``shape``.

    Each edge is its predicted curve moved by an offset and a tilt of its own; corners are where neighbours meet.
    """
    weight, offset = np.zeros((2, len(EDGES), POINTS_PER_EDGE))
    weight[fit.points.edge], offset[fit.points.edge] = fit.weight, fit.offset_px
    weight, offset = weight[_BLACK_EDGES], offset[_BLACK_EDGES]
    measured = np.flatnonzero((np.count_nonzero(weight, axis=2) >= LEAST_FOUND * POINTS_PER_EDGE).all(axis=1))
    if len(measured) == 0:
        return ()
    corners, sigma_px = _layer_corners(fit.before(_CORNER_PROBES)[:, measured], offset[measured], weight[measured])
    height, width = shape
    return tuple(
        LayerDetection(layer, square_px, sigma)
        for layer, square_px, sigma in zip(measured.tolist(), corners, sigma_px.tolist(), strict=True)
        if square_px.min() >= 0 and (square_px.max(axis=0) <= (width - 1, height - 1)).all()
    )


def _corner_probes() -> Array:
    """Return the layers' corners, and points a little before and after them on the outlines (3, 3 layers, 4, 2)."""
    corners = np.array([square(*layer.black) for layer in LAYERS])
    ahead = 0.02 * (np.roll(corners, -1, axis=1) - corners)
    return np.stack([corners, corners - np.roll(ahead, 1, axis=1), corners + ahead])


_CORNER_PROBES = _corner_probes()


def _layer_corners(around_px: Array, offset: Array, weight: Array) -> tuple[Array, Array]:
    """Return the corners (L, 4, 2) of squares and their standard deviations (L,) from the offsets (L, 4, M) of edges.

    ``around_px`` (3, L, 4, 2) is where the corners are predicted, and the outlines a little before and after each.
    """
    predicted, before, after = around_px
    ends, variances = _edge_lines(offset, weight)
    # two lines meet at a corner: the end of one edge and the start of the next
    nx, ny = _outward(predicted - before)
    mx, my = _outward(after - predicted)
    a, b = ends[..., 1][:, _PREVIOUS], ends[..., 0]
    moved = np.stack([a * my - b * ny, b * nx - a * mx], axis=-1)
    sine = nx * my - ny * mx
    a, b = variances[..., 1][:, _PREVIOUS], variances[..., 0]
    variance = ((a * (my**2 + mx**2) + b * (ny**2 + nx**2)) / (2 * sine**2)).mean(axis=1)
    return predicted + moved / sine[..., None], np.sqrt(variance + CORNER_FLOOR_PX**2)


def _outward(tangent: Array) -> tuple[Array, Array]:
    """Return x and y of the unit normals to the left of clockwise tangents (..., 2), out of the square."""
    dx, dy = tangent[..., 0], tangent[..., 1]
    length = np.sqrt(dx * dx + dy * dy)
    return dy / length, -dx / length


def _edge_lines(offset: Array, weight: Array) -> tuple[Array, Array]:
    """Return the offsets (..., 2) of lines fitted along edges (..., M) at their two ends, and their variances."""
    moments = weight @ _LINE_MOMENTS
    ss, se, ee = moments[..., 0], moments[..., 1], moments[..., 2]
    seen = (weight * offset) @ _LINE
    s, e = seen[..., 0], seen[..., 1]
    determinant = ss * ee - se * se
    variances = np.stack([ee, ss], axis=-1) / determinant[..., None]
    return np.stack([ee * s - se * e, ss * e - se * s], axis=-1) / determinant[..., None], variances


_BLACK_EDGES = np.array([[i for i, e in enumerate(EDGES) if e.layer == k and not e.frame] for k in range(len(LAYERS))])
"""The edges (3, 4) of each layer's black square, clockwise from the top."""
_PREVIOUS = np.array([3, 0, 1, 2])
_LINE = np.stack([1 - ALONG, ALONG], axis=1)
"""What the points of an edge feel (M, 2) of an offset at its start and at its end."""
_LINE_MOMENTS = np.stack([_LINE[:, 0] ** 2, _LINE[:, 0] * _LINE[:, 1], _LINE[:, 1] ** 2], axis=1)
