"""Bundle adjustment: the marker map and the camera's place in every view that explain all corners best.

Unknown are ``T_target_marker`` of every marker but the reference, ``T_cam_target`` of every view, and for each marker
how far its corners are measured beside their place in all views alike, by its print, its light or the lens: together
and each by itself, kept near zero.  Poses are perturbed on the right, metres then radians.  The views are eliminated
first (Schur complement), so that the effort grows with their number only linearly: Triggs et al., "Bundle adjustment:
a modern synthesis", 2000, section 6.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from astratag.transforms import perturb, transform
from pipeline.mapping.views import View

Array = NDArray[np.float64]

POSE_DOF, BIAS_DOF = 6, 11
LAYER_DOF = 8
"""Image coordinates of the four corners of one black square."""
HUBER2 = float(chi2.ppf(0.99, LAYER_DOF))
"""Squared residual of a layer, in sigmas, from which on it counts less and less: P. Huber, 1964."""
GATE = float(chi2.ppf(0.9999, LAYER_DOF))
"""A layer that fits worse than this, in units of the usual misfit, is taken for something else and left out."""
LEAST_FITTING = 0.7
"""Share of a marker's layers."""
MEDIAN = float(chi2.ppf(0.5, LAYER_DOF))
NEAREST_M = 1e-3
MOST_STEPS = 60
ROUNDS = (100.0, 10.0, 1.0, 1.0)
"""By how much the gate is wider in each round of leaving layers out: the worst first, since they pull at the others,
which come back when they fit without them."""
FIRST_DAMPING, MOST_DAMPING = 1e-3, 1e8
CONVERGED = 1e-7
"""Stop when the squared residuals no longer fall by this share."""


@dataclass(frozen=True, eq=False)
class MapState:
    """All that is unknown, as it is believed: the map, the views' poses and the markers' edge biases."""

    T_target_marker: Mapping[int, Array]
    T_cam_target: Sequence[Array]
    """One a view."""
    bias_px: Mapping[int, Array]
    """(11,) of each marker, as in ``Corners.by_bias``."""


@dataclass(frozen=True, eq=False)
class Bundle:
    """The result: ``covariance`` (6 M, 6 M) of the poses of ``ids``, right perturbations one after another."""

    state: MapState
    ids: tuple[int, ...]
    """The markers that were estimated: all but the reference."""
    covariance: Array
    cost: float
    """Squared residuals of the layers kept, in sigmas."""
    misfit: float
    """The same a degree of freedom: 1 when the corners' sigmas are right."""
    residuals_px: Mapping[int, Array] = field(repr=False)
    """Of each marker's corners that were kept (N, 2), seen minus explained."""
    dropped: Mapping[int, int]
    """Layers of each marker that were left out."""
    doubted: frozenset[int]
    """Markers most of whose layers do not fit: theirs are not left out."""
    normalised2: Sequence[Array] = field(repr=False)
    """Squared residuals of every layer of every view, in sigmas."""

    def covariance_of(self, marker_id: int) -> Array:
        """Return the covariance (6, 6) of one marker's T_target_marker: zero for the reference."""
        if marker_id not in self.ids:
            return np.zeros((POSE_DOF, POSE_DOF))
        rows = slice(POSE_DOF * self.ids.index(marker_id), POSE_DOF * (self.ids.index(marker_id) + 1))
        return self.covariance[rows, rows]


@dataclass(frozen=True, eq=False)
class _Fit:
    """A view under a state: residuals (N, 2) in sigmas and what moves them."""

    residual: Array
    by_view: Array
    """(N, 2, 6)"""
    by_marker: Array
    """(N, 2, 6) by the pose of the marker that each corner belongs to."""
    by_bias: Array
    """(N, 2, 11) by the bias of that marker."""

    def layers2(self) -> Array:
        """Return the squared residual of each layer."""
        return np.sum(self.residual.reshape(-1, LAYER_DOF) ** 2, axis=1)


def adjust(views: Sequence[View], start: MapState, reference: int, edge_bias_px: float, *, drop: bool = True) -> Bundle:
    """Return the map that explains the views best, from a start nearby.

    ``edge_bias_px`` is the standard deviation of each component of a marker's bias.  With ``drop``, layers that do not
    fit are left out and the rest is adjusted again.
    """
    doubted: frozenset[int] = frozenset()
    kept = [np.ones(len(view.corners.slot) // 4) for view in views]
    state = _minimised(views, start, reference, edge_bias_px, kept)
    for wider in ROUNDS if drop else ():
        squares = [_fit(view, state, k).layers2() for k, view in enumerate(views)]
        usual = max(1.0, float(np.median(np.concatenate(squares))) / MEDIAN)
        fitting = [squared <= wider * GATE * usual for squared in squares]
        doubted = _doubted(views, fitting, state.T_target_marker)
        before, kept = kept, [(f | _of(view, doubted)).astype(float) for view, f in zip(views, fitting, strict=True)]
        if any(not np.array_equal(a, b) for a, b in zip(before, kept, strict=True)):
            state = _minimised(views, state, reference, edge_bias_px, kept)
    return _bundle(views, state, reference, edge_bias_px, kept, doubted)


def _doubted(views: Sequence[View], fitting: Sequence[NDArray[np.bool_]], marker_ids: Iterable[int]) -> frozenset[int]:
    """Return the markers most of whose layers do not fit: then it is not the layers that are wrong."""
    shares = {
        marker_id: np.concatenate([f[_of(view, {marker_id})] for view, f in zip(views, fitting, strict=True)]).mean()
        for marker_id in marker_ids
    }
    return frozenset(marker_id for marker_id, share in shares.items() if share < LEAST_FITTING)


def _of(view: View, marker_ids: Collection[int]) -> NDArray[np.bool_]:
    """Tell which layers of a view are those of some markers."""
    return np.isin(np.array(view.ids)[view.corners.slot[::4]], list(marker_ids))


def cost_of_view(view: View, T_cam_target: Array, T_target_marker: Mapping[int, Array]) -> float:
    """Return the robust squared residuals of a view under a map, infinite when a corner would be behind the camera."""
    state = MapState(T_target_marker, [T_cam_target], dict.fromkeys(view.ids, np.zeros(BIAS_DOF)))
    fit = _fit(view, state, 0)
    return float(_huber(fit.layers2()).sum()) if np.isfinite(fit.residual).all() else np.inf


def _minimised(
    views: Sequence[View], state: MapState, reference: int, edge_bias_px: float, kept: Sequence[Array]
) -> MapState:
    """Return the least robust cost by Levenberg-Marquardt, from a state nearby."""
    ids = _estimated(state, reference)
    fits = [_fit(view, state, k) for k, view in enumerate(views)]
    cost, damping = _cost(fits, state, edge_bias_px, kept), FIRST_DAMPING
    for _ in range(MOST_STEPS):
        system = _Normal(views, fits, state, ids, edge_bias_px, kept)
        while damping < MOST_DAMPING:
            moved = system.step(damping)
            if moved is not None:
                fits_moved = [_fit(view, moved, k) for k, view in enumerate(views)]
                cost_moved = _cost(fits_moved, moved, edge_bias_px, kept)
                if cost_moved <= cost:
                    break
            damping *= 10
        else:
            return state
        gain, state, fits, cost = cost - cost_moved, moved, fits_moved, cost_moved
        damping = max(damping / 10, 1e-12)
        if gain <= CONVERGED * (1 + cost):
            break
    return state


def _estimated(state: MapState, reference: int) -> tuple[int, ...]:
    return tuple(marker_id for marker_id in state.T_target_marker if marker_id != reference)


def _fit(view: View, state: MapState, index: int) -> _Fit:
    """Return a view's residuals in sigmas and their derivatives; not finite when a corner is behind the camera."""
    corners, T_cam_target = view.corners, state.T_cam_target[index]
    T_target_marker = np.array([state.T_target_marker[marker_id] for marker_id in view.ids])[corners.slot]
    R_target_marker = T_target_marker[:, :3, :3]
    points_target = np.einsum("nij,nj->ni", R_target_marker, corners.points_marker) + T_target_marker[:, :3, 3]
    points_cam = transform(T_cam_target, points_target)
    if not points_cam[:, 2].min() > NEAREST_M:
        nothing = np.full((len(points_cam), 2, POSE_DOF), np.inf)
        return _Fit(nothing[..., 0], nothing, nothing, corners.by_bias)
    weight = 1 / corners.sigma_px[:, None]
    bias_px = np.array([state.bias_px[marker_id] for marker_id in view.ids])[corners.slot]
    moved_px = np.einsum("nij,nj->ni", corners.by_bias, bias_px)
    residual = (corners.seen_px - view.camera.project(points_cam) - moved_px) * weight
    in_target = view.camera.projection_jacobian(points_cam) @ T_cam_target[:3, :3] * weight[..., None]
    in_marker = in_target @ R_target_marker
    return _Fit(
        residual,
        np.concatenate([in_target, np.cross(points_target[:, None], in_target)], axis=2),
        np.concatenate([in_marker, np.cross(corners.points_marker[:, None], in_marker)], axis=2),
        corners.by_bias * weight[..., None],
    )


def _huber(squared: Array) -> Array:
    """Return what squared residuals of layers count."""
    return np.where(squared <= HUBER2, squared, 2 * np.sqrt(HUBER2 * squared) - HUBER2)


def _cost(fits: Sequence[_Fit], state: MapState, edge_bias_px: float, kept: Sequence[Array]) -> float:
    biases = sum(float(bias @ bias) for bias in state.bias_px.values()) / edge_bias_px**2
    squares = sum(float(_huber(fit.layers2()) @ use) for fit, use in zip(fits, kept, strict=True))
    return squares + biases if np.isfinite(squares) else np.inf


class _Normal:
    """The normal equations at a state, by view, with the views eliminated on demand."""

    def __init__(
        self,
        views: Sequence[View],
        fits: Sequence[_Fit],
        state: MapState,
        ids: tuple[int, ...],
        edge_bias_px: float,
        kept: Sequence[Array],
    ):
        self._state, self._ids, self._biased = state, ids, tuple(state.bias_px)
        size = POSE_DOF * len(ids) + BIAS_DOF * len(self._biased)
        biases = np.concatenate([state.bias_px[marker_id] for marker_id in self._biased])
        prior = np.zeros(size)
        prior[POSE_DOF * len(ids) :] = edge_bias_px**-2
        self._A, self._b = np.diag(prior), np.zeros(size)
        self._b[POSE_DOF * len(ids) :] = -biases / edge_bias_px**2
        self._views: list[tuple[int, Array, Array, Array]] = []
        for k, (view, fit, use) in enumerate(zip(views, fits, kept, strict=True)):
            if not use.any():  # nothing left to say where it was taken from
                continue
            squared = fit.layers2()
            weight = use * np.minimum(1.0, np.sqrt(HUBER2 / np.maximum(squared, HUBER2)))
            root = np.sqrt(np.repeat(weight, LAYER_DOF))
            G = self._by_map(view, fit, size).reshape(-1, size) * root[:, None]
            V = fit.by_view.reshape(-1, POSE_DOF) * root[:, None]
            r = fit.residual.ravel() * root
            self._A += G.T @ G
            self._b += G.T @ r
            self._views.append((k, G.T @ V, V.T @ V, V.T @ r))

    def _by_map(self, view: View, fit: _Fit, size: int) -> Array:
        """Return how residuals follow the map and the biases, (N, 2, size)."""
        J = np.zeros((*fit.residual.shape, size))
        for slot, marker_id in enumerate(view.ids):
            own = view.corners.slot == slot
            if marker_id in self._ids:
                first = POSE_DOF * self._ids.index(marker_id)
                J[own, :, first : first + POSE_DOF] = fit.by_marker[own]
            first = POSE_DOF * len(self._ids) + BIAS_DOF * self._biased.index(marker_id)
            J[own, :, first : first + BIAS_DOF] = fit.by_bias[own]
        return J

    def step(self, damping: float) -> MapState | None:
        """Return the state after a damped step, None when there is none to take."""
        A = self._A + damping * np.diag(np.diag(self._A))
        try:
            eliminated = [(k, B, np.linalg.inv(C + damping * np.diag(np.diag(C))), d) for k, B, C, d in self._views]
            S = A - sum(B @ C_inverse @ B.T for _, B, C_inverse, _ in eliminated)
            by_map = _solve_scaled(S, self._b - sum(B @ C_inverse @ d for _, B, C_inverse, d in eliminated))
        except np.linalg.LinAlgError:
            return None
        T_cam_target = list(self._state.T_cam_target)
        for k, B, C_inverse, d in eliminated:
            T_cam_target[k] = perturb(T_cam_target[k], C_inverse @ (d - B.T @ by_map))
        T_target_marker = dict(self._state.T_target_marker)
        for k, marker_id in enumerate(self._ids):
            T_target_marker[marker_id] = perturb(T_target_marker[marker_id], by_map[POSE_DOF * k : POSE_DOF * (k + 1)])
        change = by_map[POSE_DOF * len(self._ids) :].reshape(-1, BIAS_DOF)
        biases = {m: self._state.bias_px[m] + by for m, by in zip(self._biased, change, strict=True)}
        return MapState(T_target_marker, T_cam_target, biases)

    def covariance(self) -> Array:
        """Return the covariance of the map, with everything else unknown.  Raises LinAlgError when it is not fixed."""
        S = self._A - sum(B @ np.linalg.solve(C, B.T) for _, B, C, _ in self._views)
        size = POSE_DOF * len(self._ids)
        scale = np.sqrt(np.maximum(np.diag(S), np.finfo(float).tiny))
        covariance = (np.linalg.inv(S / np.outer(scale, scale)) / np.outer(scale, scale))[:size, :size]
        return (covariance + covariance.T) / 2


def _solve_scaled(A: Array, b: Array) -> Array:
    """Solve A x = b with unknowns in their own units: metres and radians differ by orders."""
    scale = np.sqrt(np.maximum(np.diag(A), np.finfo(float).tiny))
    return np.linalg.solve(A / np.outer(scale, scale), b / scale) / scale


def _bundle(
    views: Sequence[View],
    state: MapState,
    reference: int,
    edge_bias_px: float,
    kept: Sequence[Array],
    doubted: frozenset[int],
) -> Bundle:
    """Return a bundle of a state that has converged.  Raises LinAlgError when the views do not fix the map."""
    ids = _estimated(state, reference)
    fits = [_fit(view, state, k) for k, view in enumerate(views)]
    residuals: dict[int, list[Array]] = {marker_id: [] for marker_id in state.T_target_marker}
    dropped = dict.fromkeys(state.T_target_marker, 0)
    for view, fit, use in zip(views, fits, kept, strict=True):
        off_px = fit.residual * view.corners.sigma_px[:, None]
        used = np.repeat(use > 0, 4)
        for slot, marker_id in enumerate(view.ids):
            own = view.corners.slot == slot
            residuals[marker_id].append(off_px[own & used])
            dropped[marker_id] += int(np.count_nonzero(own & ~used)) // 4
    cost = float(sum(fit.layers2() @ use for fit, use in zip(fits, kept, strict=True)))
    layers = sum(float(use.sum()) for use in kept)
    dof = LAYER_DOF * layers - POSE_DOF * (len(views) + len(ids))
    misfit = cost / max(dof, 1.0)
    normal = _Normal(views, fits, state, ids, edge_bias_px, kept)
    return Bundle(
        state=state,
        ids=ids,
        covariance=max(1.0, misfit) * normal.covariance(),
        cost=cost,
        misfit=misfit,
        residuals_px={marker_id: np.concatenate(parts) for marker_id, parts in residuals.items()},
        dropped=dropped,
        doubted=doubted,
        normalised2=[fit.layers2() for fit in fits],
    )
