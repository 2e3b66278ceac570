"""A map to begin with: markers join one by one, each where the views that show it beside known ones agree it is.

A small flat marker allows two poses, of which only one is the same on the target in all views.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, product

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from astratag.transforms import difference, inverse
from pipeline.mapping.bundle import BIAS_DOF, POSE_DOF, Bundle, MapState, adjust, cost_of_view
from pipeline.mapping.views import View, chosen_views

Array = NDArray[np.float64]

TRIED_VIEWS = 24
"""So many are enough to tell which of the possible places of a marker is right."""
TRIED_PLACES = 3
SAME_ANGLE_RAD, SAME_SHARE = 0.2, 0.1
"""Two places of a marker are one when they are nearer than this angle, and this share of the distance between them
and the camera."""
ONE_MODE = float(chi2.ppf(0.9999, POSE_DOF))


class MapError(ValueError):
    """A map that cannot be estimated from what was seen, in one line that says what to do."""


@dataclass(frozen=True, eq=False)
class Start:
    """A first map, and where else each marker might be, the place that fits the views next best."""

    T_target_marker: Mapping[int, Array]
    elsewhere: Mapping[int, Array]


def together(views: Sequence[View]) -> dict[frozenset[int], int]:
    """Return in how many views each pair of markers is seen together."""
    counts: dict[frozenset[int], int] = {}
    for view in views:
        for pair in combinations(view.ids, 2):
            counts[frozenset(pair)] = counts.get(frozenset(pair), 0) + 1
    return counts


def first_map(views: Sequence[View], reference: int, T_target_reference: Array, edge_bias_px: float) -> Start:
    """Return a map of all markers that are connected with the reference through views."""
    placed: dict[int, Array] = {reference: T_target_reference}
    elsewhere: dict[int, Array] = {}
    counts = together(views)
    while True:
        edges = [(counts[pair], pair) for pair in counts if len(pair & placed.keys()) == 1]
        if not edges:
            return Start(placed, elsewhere)
        _, pair = max(edges, key=lambda edge: (edge[0], sorted(edge[1], reverse=True)))
        (beside,), (joins,) = pair & placed.keys(), pair - placed.keys()
        bundles = _ways_to_join(views, placed, beside, joins, edge_bias_px)
        if not bundles:
            raise MapError(
                f"marker {joins} is not in one place beside marker {beside}: are its side and surface right, "
                "and is it fixed to the target?"
            )
        if len(bundles) > 1:
            elsewhere[joins] = bundles[1].state.T_target_marker[joins]
        placed[joins] = bundles[0].state.T_target_marker[joins]


def _ways_to_join(
    views: Sequence[View], placed: Mapping[int, Array], beside: int, joins: int, edge_bias_px: float
) -> list[Bundle]:
    """Return small bundles with a marker in each of the places that it may have beside a known one, the best first."""
    known = {*placed, joins}
    showing = chosen_views([view.only(known) for view in views if {beside, joins} <= set(view.ids)], TRIED_VIEWS)
    present = {marker_id for view in showing for marker_id in view.ids} & placed.keys()
    bundles: list[Bundle] = []
    for T_beside_joins in _places_beside(showing, beside, joins):
        T_target_marker = {m: placed[m] for m in present} | {joins: placed[beside] @ T_beside_joins}
        try:
            start = start_state(showing, T_target_marker)
            bundle = adjust(showing, start, beside, edge_bias_px, drop=False)
        except np.linalg.LinAlgError:
            continue
        found = bundle.state.T_target_marker[joins]
        if all(is_elsewhere(found, other.state.T_target_marker[joins], bundle, joins) for other in bundles):
            bundles.append(bundle)
    return sorted(bundles, key=lambda bundle: sum(np.sqrt(squares).sum() for squares in bundle.normalised2))


def is_elsewhere(T_a: Array, T_b: Array, bundle: Bundle, marker_id: int) -> bool:
    """Tell whether two places of a marker are apart by more than the bundle's uncertainty of it."""
    apart = difference(T_a, T_b)
    return float(apart @ np.linalg.solve(bundle.covariance_of(marker_id), apart)) > ONE_MODE


def start_state(views: Sequence[View], T_target_marker: Mapping[int, Array]) -> MapState:
    """Return a map with, for every view, the best of the poses that its markers allow.

    Raises LinAlgError when a view cannot show these markers so.
    """
    T_cam_target = []
    for view in views:
        guesses = [
            T_cam_marker @ inverse(T_target_marker[seen.marker.id])
            for seen in view.markers
            for T_cam_marker in seen.poses_cam_marker
        ]
        costs = [cost_of_view(view, guess, T_target_marker) for guess in guesses]
        if not np.isfinite(min(costs)):
            raise np.linalg.LinAlgError("a marker is behind the camera")
        T_cam_target.append(guesses[int(np.argmin(costs))])
    return MapState(T_target_marker, T_cam_target, dict.fromkeys(T_target_marker, np.zeros(BIAS_DOF)))


def _places_beside(views: Sequence[View], beside: int, joins: int) -> list[Array]:
    """Return T_beside_joins of the few places that most views allow, the most agreed on first."""
    per_view: list[tuple[float, list[Array]]] = []
    for view in views:
        poses = {seen.marker.id: seen.poses_cam_marker for seen in view.markers}
        range_m = float(np.linalg.norm(poses[joins][0][:3, 3]))
        per_view.append((range_m, [inverse(a) @ b for a, b in product(poses[beside], poses[joins])]))
    candidates = [T for _, allowed in per_view for T in allowed]
    support = np.array([sum(_nearness(T, allowed, range_m) for range_m, allowed in per_view) for T in candidates])
    places: list[Array] = []
    for index in np.argsort(-support, kind="stable"):
        if len(places) < TRIED_PLACES and all(_nearness(candidates[index], [T], 1e6) == 0 for T in places):
            places.append(candidates[index])
    return places


def _nearness(T: Array, allowed: Sequence[Array], range_m: float) -> float:
    """Return how near a place is to the nearest allowed one: 1 when it is the same, 0 when it is another."""
    off = [difference(other, T) for other in allowed]
    squared = [
        np.sum(xi[:3] ** 2) / (SAME_SHARE * range_m) ** 2 + np.sum(xi[3:] ** 2) / SAME_ANGLE_RAD**2 for xi in off
    ]
    return max(0.0, 1.0 - float(min(squared)))
