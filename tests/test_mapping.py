"""The marker map at corner level: exact without noise, as good as it says with noise, and refused when it cannot be."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chi2

from astratag.transforms import difference, exp_so3, inverse, pose
from pipeline.mapping.bundle import BIAS_DOF, adjust
from pipeline.mapping.estimate import MarkerMap, Wanted, estimate_map, pose_section
from pipeline.mapping.start import MapError, start_state, together
from pipeline.mapping.views import View, chosen_views
from pipeline.mission import MarkerSection, PoseSection
from tests.bundles import MARKERS, MISSION, looking, round_trip, views

SEED = 20260712
EDGE_BIAS_PX = 0.03
"""Of a map, over a whole recording: not what a filter takes for that of a single layer, for a while."""
UNKNOWN = tuple(
    marker if marker.id == 7 else marker.model_copy(update={"T_target_marker": PoseSection()}) for marker in MARKERS
)
"""What is told: sides, surfaces, and where the reference is."""
LOOSE = Wanted(position_sides=0.1, attitude_rad=0.1)


def estimated(seen: list[View], markers: tuple[MarkerSection, ...] = UNKNOWN, **kwargs: object) -> MarkerMap:
    settings = {"edge_bias_px": EDGE_BIAS_PX, "ambiguity_ratio": MISSION.filter.ambiguity_ratio, **kwargs}
    return estimate_map(seen, markers, **settings)  # type: ignore[arg-type]


def errors(found: MarkerMap) -> dict[int, np.ndarray]:
    """Return what is off (6,) of each marker: metres then radians, in its own axes."""
    true = {marker.id: marker.T_target_marker.matrix() for marker in MARKERS}
    return {m.section.id: difference(true[m.section.id], m.T_target_marker) for m in found.markers}


def test_noiseless_corners_give_the_map_exactly():
    found = estimated(views(MISSION, round_trip(16), sigma_px=1e-9, seed=SEED))
    for error in errors(found).values():
        assert np.abs(error[:3]).max() < 1e-8
        assert np.abs(error[3:]).max() < 1e-7
    assert found.reference == 7
    assert found.mission(MISSION).marker(7) == MISSION.marker(7)


def test_errors_are_what_the_covariance_says():
    """Six targets' worth of noise and biases: the mean error squared, in sigmas, is inside its 99 % band."""
    squared, dof = 0.0, 0
    for seed in range(6):
        rng = np.random.default_rng((SEED, seed))
        bias_px = {marker.id: EDGE_BIAS_PX * rng.standard_normal(BIAS_DOF) for marker in MARKERS}
        found = estimated(views(MISSION, round_trip(16), sigma_px=0.15, seed=seed, bias_px=bias_px))
        joint = np.concatenate([e for marker_id, e in errors(found).items() if marker_id != found.reference])
        squared += float(joint @ np.linalg.solve(found.joint_covariance, joint))
        dof += len(joint)
    print(f"seed {SEED}: {squared / dof:.3f} per degree of freedom")
    assert chi2.ppf(0.005, dof) < squared < chi2.ppf(0.995, dof)


def test_one_bundle_predicts_its_own_spread():
    """The covariance of a marker shrinks as one over the square root of the number of independent views."""
    few = estimated(views(MISSION, round_trip(12), sigma_px=0.5, seed=1), edge_bias_px=1e-4, wanted=LOOSE)
    many = estimated(views(MISSION, round_trip(48), sigma_px=0.5, seed=1), edge_bias_px=1e-4, wanted=LOOSE)
    for a, b in zip(few.markers[1:], many.markers[1:], strict=True):
        assert a.position_sigma_m / b.position_sigma_m == pytest.approx(2.0, rel=0.2)


@settings(max_examples=3, deadline=None)
@given(turn=st.tuples(*[st.floats(-3, 3)] * 3), shift=st.tuples(*[st.floats(-10, 10)] * 3))
def test_the_map_moves_with_its_reference(turn, shift):
    """Where the reference is on the target is the mission's to say; what is between markers is the views'."""
    seen = views(MISSION, round_trip(10), sigma_px=0.1, seed=SEED)
    moved = pose(exp_so3(turn), shift)
    elsewhere = UNKNOWN[0].model_copy(update={"T_target_marker": pose_section(moved)})
    here, there = estimated(seen), estimated(seen, (elsewhere, *UNKNOWN[1:]))
    for a, b in zip(here.markers, there.markers, strict=True):
        beside = inverse(here.markers[0].T_target_marker) @ a.T_target_marker
        beside_moved = inverse(there.markers[0].T_target_marker) @ b.T_target_marker
        assert np.abs(difference(beside, beside_moved)).max() < 1e-5


def test_another_reference_gives_the_same_map():
    seen = views(MISSION, round_trip(16), sigma_px=1e-9, seed=SEED)
    found = estimated(seen, tuple(m for m in MARKERS if m.id in (3, 7, 11, 15)), reference=11)
    assert found.reference == 11
    for error in errors(found).values():
        assert np.abs(error).max() < 1e-6


@pytest.mark.parametrize("seed", range(2))
def test_the_mirror_image_is_not_taken_for_the_map(seed: int):
    """From afar each small marker alone allows two poses in nearly every view; together one map is left."""
    places = [looking(0.5 * np.sin(0.7 * k), 0.35 * np.cos(k), 1.7 - 0.02 * k) for k in range(20)]
    seen = views(MISSION, places, sigma_px=0.15, seed=seed)
    both = [len(marker.poses_cam_marker) for view in seen for marker in view.markers]
    assert np.mean(both) > 1.2
    for error in errors(estimated(seen, tuple(m for m in UNKNOWN if m.id != 15), wanted=LOOSE)).values():
        assert np.linalg.norm(error[3:]) < np.radians(2)


def test_markers_join_that_the_reference_is_never_seen_with():
    """7 with 3, 3 with 11, 11 with 15: a chain is enough."""
    seen = []
    for pair in ({7, 3}, {3, 11}, {11, 15}):
        seen += views(MISSION, round_trip(24), sigma_px=0.1, seed=SEED, only=pair)
    found = estimated(seen)
    assert frozenset((7, 15)) not in together(seen)
    sigmas = {marker.section.id: marker.position_sigma_m for marker in found.markers}
    assert sigmas[7] == 0 < sigmas[3] < sigmas[11] < sigmas[15]
    for marker in found.markers[1:]:
        error = errors(found)[marker.section.id]
        assert error @ np.linalg.solve(marker.covariance, error) < chi2.ppf(0.9999, 6)


def test_a_false_identity_now_and_then_is_left_out():
    """In one view of eight, what is called marker 3 is marker 11's corners: of the other views nothing is lost."""
    seen = views(MISSION, round_trip(40), sigma_px=0.1, seed=SEED)
    spoilt, layers_spoilt = [], 0
    for k, view in enumerate(seen):
        markers = {marker.marker.id: marker for marker in view.markers}
        if k % 8 == 0 and {3, 11} <= markers.keys():
            markers[3] = replace(markers[11], marker=markers[3].marker)
            layers_spoilt += sum(len(marker.layers) for marker in markers.values())
        spoilt.append(View(view.camera, tuple(markers.values())))
    found = estimated(spoilt)
    assert 10 <= sum(marker.dropped_layers for marker in found.markers) <= layers_spoilt
    for marker in found.markers[1:]:
        error = errors(found)[marker.section.id]
        assert error @ np.linalg.solve(marker.covariance, error) < chi2.ppf(0.9999, 6)


def test_a_start_somewhat_off_leads_to_the_same_map():
    seen = views(MISSION, round_trip(16), sigma_px=0.1, seed=SEED)
    rng = np.random.default_rng(SEED)
    true = {marker.id: marker.T_target_marker.matrix() for marker in MARKERS}
    off = {i: T if i == 7 else pose(T[:3, :3] @ exp_so3(rng.normal(0, 0.1, 3)), T[:3, 3]) for i, T in true.items()}
    a, b = (adjust(seen, start_state(seen, T), 7, EDGE_BIAS_PX) for T in (true, off))
    for marker_id in a.ids:
        apart = difference(a.state.T_target_marker[marker_id], b.state.T_target_marker[marker_id])
        assert apart @ np.linalg.solve(a.covariance_of(marker_id), apart) < 1e-3


def test_views_are_chosen_apart_and_every_group_has_its_turn():
    """Of a hundred alike, a few different and a few of other markers, the different ones are taken."""
    alike = views(MISSION, [looking(0.1, 0.1, 0.8)] * 100, sigma_px=0.01, seed=SEED)
    apart = views(MISSION, [looking(0.1, e, 0.6) for e in (-0.4, 0.4)], sigma_px=0.01, seed=SEED)
    others = views(MISSION, round_trip(3), sigma_px=0.01, seed=SEED, only={7, 3})
    chosen = chosen_views([*alike, *apart, *others], 10)
    assert len(chosen) == 10
    assert all(view in chosen for view in (*apart, *others))
    assert chosen == chosen_views([*alike, *apart, *others], 10)


def refusal(seen: list[View], markers: tuple[MarkerSection, ...] = UNKNOWN, **kwargs: object) -> str:
    with pytest.raises(MapError) as refused:
        estimated(seen, markers, **kwargs)
    assert "\n" not in str(refused.value)
    return str(refused.value)


def test_what_is_missing_is_said():
    places = round_trip(12)
    seen = views(MISSION, places, sigma_px=0.1, seed=SEED)
    assert "needs two markers" in refusal(seen, UNKNOWN[:1])
    assert "marker 99, is not in the mission: it lists 3, 7, 11, 15" in refusal(seen, reference=99)
    assert "no picture shows two" in refusal([])
    apart = [v for pair in ({7, 3}, {11, 15}) for v in views(MISSION, places, sigma_px=0.1, seed=SEED, only=pair)]
    assert "marker 11 is never seen together with 3, 7" in refusal(apart)
    alone = [view.only({7, 3, 11}) for view in seen]
    assert "marker 15 is never seen together with any other" in refusal(alone)
    assert "in 4 frames only, at least 5" in refusal(views(MISSION, round_trip(4), sigma_px=0.1, seed=SEED))


def test_a_geometry_too_narrow_says_how_well_the_marker_is_known():
    still = views(MISSION, [looking(0.2, 0.1, 1.6)] * 8, sigma_px=0.3, seed=SEED)
    line = refusal(still, tuple(m for m in UNKNOWN if m.id in (7, 11)), ambiguity_ratio=1.0 + 1e-9)
    assert "marker 11 is known to" in line and "wanted are 0.80 mm and 0.50 degrees" in line


@pytest.mark.parametrize("seed", [SEED, 0, 15, 30])
def test_a_tilt_that_could_be_either_way_is_not_guessed(seed):
    """Two small markers square-on and far away: the second one may lean to either side.

    Of some draws the views, one by one, agree on the wrong side.
    """
    markers = (MARKERS[0].model_copy(update={"side_m": 0.03}), MARKERS[1].model_copy(update={"side_m": 0.03}))
    mission = MISSION.model_copy(update={"markers": markers})
    seen = views(mission, [looking(0.0, -0.17, 1.5)] * 12, sigma_px=0.4, seed=seed)
    assert "cannot be told" in refusal(seen, markers, wanted=Wanted(10.0, 3.0))


@pytest.mark.parametrize("wrong", [{"side_m": 0.066}, {"side_m": 0.055}])
def test_a_wrong_side_is_found_out(wrong):
    told = tuple(m.model_copy(update=wrong) if m.id == 3 else m for m in UNKNOWN)
    seen = views(MISSION, round_trip(30), sigma_px=0.1, seed=SEED, told=told)
    line = refusal(seen, told)
    assert "marker 3 " in line and "is its side 0.0" in line


def test_a_marker_that_moves_on_the_target_is_found_out():
    shaken = MARKERS[1].model_copy(update={"T_target_marker": PoseSection(translation_m=(0.1, -0.2, 0.15))})
    loose = MISSION.model_copy(update={"markers": (MARKERS[0], shaken, *MARKERS[2:])})
    places = round_trip(16)
    seen = views(MISSION, places[::2], sigma_px=0.1, seed=SEED) + views(loose, places[1::2], sigma_px=0.1, seed=SEED)
    assert "does not fit a rigid target" in refusal(seen)
