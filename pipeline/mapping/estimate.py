"""The marker map from views: what can be known of it, how well, and what is missing when it is not enough."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from numpy.typing import NDArray

from astratag.pose import mirrored
from astratag.transforms import inverse, wxyz_from_rotation
from pipeline.mapping.bundle import Bundle, MapState, adjust
from pipeline.mapping.start import MapError, first_map, is_elsewhere, start_state, together
from pipeline.mapping.views import LEAST_MARKERS, View, chosen_views
from pipeline.mission import MarkerSection, Mission, PoseSection

Array = NDArray[np.float64]

MOST_VIEWS = 120
"""More add little: they are chosen to be different from each other, and their errors are alike."""
LEAST_VIEWS = 5
WORST_RMS_PX, WORST_MISFIT = 1.0, 9.0
"""Corners that fit worse than both are not those of one rigid target as the mission describes its markers."""
POSITION, ATTITUDE = slice(0, 3), slice(3, 6)


@dataclass(frozen=True)
class Wanted:
    """How well each marker must be known, one standard deviation in the worst direction."""

    position_sides: float = 0.01
    """Of where it is, in sides of that marker."""
    attitude_rad: float = float(np.deg2rad(0.5))


@dataclass(frozen=True, eq=False)
class MappedMarker:
    """One marker of the map: ``covariance`` (6, 6) of T_target_marker, metres then radians, right perturbation."""

    section: MarkerSection
    T_target_marker: Array
    covariance: Array
    residuals_px: Array
    """(N, 2) of its corners, seen minus explained."""
    views: int
    dropped_layers: int

    @property
    def residual_rms_px(self) -> float:
        """Return the residual RMS of a corner coordinate."""
        return float(np.sqrt(np.mean(self.residuals_px**2)))

    @property
    def position_sigma_m(self) -> float:
        """Return the standard deviation of its position in the worst direction."""
        return _worst(self.covariance[POSITION, POSITION])

    @property
    def attitude_sigma_rad(self) -> float:
        """Return the standard deviation of its attitude about the worst axis."""
        return _worst(self.covariance[ATTITUDE, ATTITUDE])


@dataclass(frozen=True, eq=False)
class MarkerMap:
    """The map of a target's markers, the reference among them where the mission has it."""

    reference: int
    markers: tuple[MappedMarker, ...]
    views: int
    """Used, of so many that show two markers or more: ``views_seen``."""
    views_seen: int
    misfit: float
    """Squared residuals, in sigmas, a degree of freedom: the covariances are larger by it where it is above 1."""
    joint_covariance: Array = field(repr=False)
    """(6 M, 6 M) of all markers but the reference, in their order."""

    def mission(self, mission: Mission) -> Mission:
        """Return a mission with this map in place of its own."""
        sections = tuple(
            marker.section.model_copy(update={"T_target_marker": pose_section(marker.T_target_marker)})
            for marker in self.markers
        )
        return mission.model_copy(update={"markers": sections})


def estimate_map(
    views: Sequence[View],
    markers: Sequence[MarkerSection],
    *,
    edge_bias_px: float,
    ambiguity_ratio: float,
    reference: int | None = None,
    wanted: Wanted | None = None,
    most_views: int = MOST_VIEWS,
) -> MarkerMap:
    """Return where markers are on the target they share.

    Of ``markers`` the sides and surfaces are used, and T_target_marker of the reference, the first unless said.
    ``edge_bias_px`` is how far the edges of a marker may be measured outside their place; one of two possible maps is
    believed when it is ``ambiguity_ratio`` times likelier.
    Raises MapError, in one line, when the views do not tell all of that as well as wanted.
    """
    sections = {marker.id: marker for marker in markers}
    reference = markers[0].id if reference is None else reference
    if reference not in sections:
        raise MapError(f"the reference, marker {reference}, is not in the mission: it lists {_listed(sections)}")
    views = [of_these for view in views if len((of_these := view.only(sections)).markers) >= LEAST_MARKERS]
    _require_connected(views, sections, reference)
    T_target_reference = sections[reference].T_target_marker.matrix()
    start = first_map(views, reference, T_target_reference, edge_bias_px)
    first = {marker.id: start.T_target_marker[marker.id] for marker in markers}
    used = chosen_views(views, most_views)
    try:
        bundle = adjust(used, start_state(used, first), reference, edge_bias_px)
        _require_one_map(used, bundle, start.elsewhere, reference, edge_bias_px, ambiguity_ratio)
    except np.linalg.LinAlgError as error:
        raise MapError("the views do not fix the map: show the markers from more sides") from error
    mapped = tuple(_mapped(marker, used, bundle) for marker in markers)
    for marker in sorted(mapped, key=lambda marker: -marker.residual_rms_px):
        _require_good(marker, bundle, wanted or Wanted())
    return MarkerMap(reference, mapped, len(used), len(views), bundle.misfit, bundle.covariance)


def _mapped(section: MarkerSection, views: Sequence[View], bundle: Bundle) -> MappedMarker:
    return MappedMarker(
        section=section,
        T_target_marker=bundle.state.T_target_marker[section.id],
        covariance=bundle.covariance_of(section.id),
        residuals_px=bundle.residuals_px[section.id],
        views=sum(section.id in view.ids for view in views),
        dropped_layers=bundle.dropped[section.id],
    )


def _require_connected(views: Sequence[View], sections: Mapping[int, MarkerSection], reference: int) -> None:
    """Raise MapError unless views connect every marker with the reference, and not by a few only."""
    if len(sections) < 2:
        raise MapError(f"a map needs two markers, the mission lists {_listed(sections) or 'none'}")
    if not views:
        raise MapError(f"no picture shows two of the markers {_listed(sections)} together")
    seen = {marker_id for view in views for marker_id in view.ids}
    reached, counts = {reference}, together(views)
    while grown := {m for pair in counts if pair & reached for m in pair} - reached:
        reached |= grown
    for marker_id in sections:
        beside = "any other" if marker_id not in seen else _listed(reached)
        if marker_id not in reached:
            raise MapError(
                f"marker {marker_id} is never seen together with {beside}: record a pass that shows it beside one of "
                "them, or take it out of the mission"
            )
        if (count := sum(marker_id in view.ids for view in views)) < LEAST_VIEWS:
            raise MapError(
                f"marker {marker_id} is seen beside others in {count} frames only, at least {LEAST_VIEWS} are needed"
            )


def _require_one_map(
    views: Sequence[View],
    bundle: Bundle,
    elsewhere: Mapping[int, Array],
    reference: int,
    edge_bias_px: float,
    ambiguity_ratio: float,
) -> None:
    """Raise MapError when a marker in another possible place explains the views almost as well."""
    least = 2 * np.log(ambiguity_ratio)
    for start in _other_starts(views, bundle, elsewhere, reference):
        try:
            other = adjust(views, start(), reference, edge_bias_px)
        except np.linalg.LinAlgError:
            continue
        worse = (other.cost - bundle.cost) / max(1.0, bundle.misfit)
        if worse >= least or sum(other.dropped.values()) > sum(bundle.dropped.values()):
            continue
        for marker_id in bundle.ids:
            there, here = (each.state.T_target_marker[marker_id] for each in (other, bundle))
            if is_elsewhere(there, here, bundle, marker_id):
                raise MapError(
                    f"which way marker {marker_id} is tilted on the target cannot be told: "
                    "show it nearer, or more turned"
                )


def _other_starts(
    views: Sequence[View], bundle: Bundle, elsewhere: Mapping[int, Array], reference: int
) -> Iterator[Callable[[], MapState]]:
    """Yield what makes other maps to begin with: markers elsewhere, or seen as the mirror images of what they are."""
    for marker_id, T_target_marker in elsewhere.items():
        yield partial(start_state, views, {**bundle.state.T_target_marker, marker_id: T_target_marker})
    either_way = {marker_id for marker_id in (reference, *bundle.ids) if _either_way(views, marker_id)}
    for turned in ({reference}, *({one} for one in bundle.ids), *({reference, one} for one in bundle.ids)):
        if turned <= either_way:
            yield partial(_mirrored, views, bundle.state, turned, reference)


def _either_way(views: Sequence[View], marker_id: int) -> bool:
    """Return whether a marker's corners allow two poses in most of the views that show it."""
    two = [len(seen.poses_cam_marker) > 1 for view in views for seen in view.markers if seen.marker.id == marker_id]
    return sum(two) >= len(two) / 2


def _mirrored(views: Sequence[View], state: MapState, turned: Collection[int], reference: int) -> MapState:
    """Return a map in which the ``turned`` markers look alike from afar and are tilted the other way.

    Each is put where the view that is nearest to it has it then.
    """
    T_target_reference = state.T_target_marker[reference]
    T_cam_target = list(state.T_cam_target)
    if reference in turned:
        T_cam_target = [mirrored(T @ T_target_reference) @ inverse(T_target_reference) for T in T_cam_target]
    T_target_marker = {reference: T_target_reference}
    for marker_id in state.T_target_marker.keys() - {reference}:
        seen = [
            (before @ state.T_target_marker[marker_id], after)
            for view, before, after in zip(views, state.T_cam_target, T_cam_target, strict=True)
            if marker_id in view.ids
        ]
        T_cam_marker, T_cam = min(seen, key=lambda pair: float(np.linalg.norm(pair[0][:3, 3])))
        T_target_marker[marker_id] = inverse(T_cam) @ (mirrored(T_cam_marker) if marker_id in turned else T_cam_marker)
    return MapState(T_target_marker, T_cam_target, state.bias_px)


def _require_good(marker: MappedMarker, bundle: Bundle, wanted: Wanted) -> None:
    """Raise MapError when a marker contradicts the others, or is known less well than wanted."""
    marker_id = marker.section.id
    if marker_id in bundle.doubted or (marker.residual_rms_px > WORST_RMS_PX and bundle.misfit > WORST_MISFIT):
        raise MapError(
            f"marker {marker_id} does not fit a rigid target, its corners are {marker.residual_rms_px:.2f} px off: is "
            f"its side {marker.section.side_m} m, its surface {marker.section.surface.kind}, and is it fixed?"
        )
    limit_m = wanted.position_sides * marker.section.side_m
    if marker.position_sigma_m > limit_m or marker.attitude_sigma_rad > wanted.attitude_rad:
        raise MapError(
            f"marker {marker_id} is known to {marker.position_sigma_m * 1e3:.2f} mm and "
            f"{np.degrees(marker.attitude_sigma_rad):.2f} degrees (1 sigma), wanted are {limit_m * 1e3:.2f} mm and "
            f"{np.degrees(wanted.attitude_rad):.2f} degrees: show it nearer, from more sides, or in more frames"
        )


def pose_section(T_a_b: Array) -> PoseSection:
    """Return a transform as the mission writes it, to a nanometre."""
    x, y, z = np.round(T_a_b[:3, 3], 9).tolist()
    w, i, j, k = np.round(wxyz_from_rotation(T_a_b[:3, :3]), 9).tolist()
    return PoseSection(translation_m=(x, y, z), rotation_wxyz=(w, i, j, k))


def _worst(covariance: Array) -> float:
    return float(np.sqrt(max(np.linalg.eigvalsh(covariance)[-1], 0.0)))


def _listed(ids: object) -> str:
    return ", ".join(str(marker_id) for marker_id in sorted(ids))  # type: ignore[call-overload]
