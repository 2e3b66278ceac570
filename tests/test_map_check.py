"""A marker that does not lie where the map has it is refused and named once, trusted again when it agrees."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from astratag.transforms import difference, perturb
from pipeline.convert import pose_matrix
from pipeline.map_check import PERSISTENT_FRAMES, MapCheck
from pipeline.mapping.estimate import pose_section
from pipeline.mission import Mission
from pipeline.pose_filter import PoseFilter
from schemas import Detections, Mode, RelativeState
from tests.bundles import CALIBRATION, CAMERA, MISSION, looking, seen_from

SEED = 20260712
ASIDE = (0.004, 0.003, 0.0, 0.0, 0.0, 0.0)
BEHIND_AND_TURNED = (0.0, 0.0, -0.006, 0.0, 0.1, 0.0)


def misplaced(marker_id: int, xi: tuple[float, ...] = ASIDE) -> Mission:
    """Return a mission whose map has one marker elsewhere than it is, by xi in its own axes."""
    return MISSION.model_copy(
        update={
            "markers": tuple(
                marker.model_copy(
                    update={"T_target_marker": pose_section(perturb(marker.T_target_marker.matrix(), xi))}
                )
                if marker.id == marker_id
                else marker
                for marker in MISSION.markers
            )
        }
    )


def pictures(count: int, only: set[int] | None = None, sigma_px: float = 0.1) -> list[Detections]:
    """Return frames of a slow approach, as they truly are."""
    rng = np.random.default_rng(SEED)
    return [seen_from(place(k), MISSION, sigma_px=sigma_px, rng=rng, t_s=k / 15, only=only) for k in range(count)]


def place(k: int) -> np.ndarray:
    """Return T_cam_target of a frame."""
    return looking(0.1 + 0.002 * k, 0.1, 0.9 - 0.003 * k)


@pytest.mark.parametrize("xi", [ASIDE, BEHIND_AND_TURNED])
@pytest.mark.parametrize("marker_id", [3, 7, 11])
def test_the_one_that_is_wrong_is_named_once(marker_id: int, xi: tuple[float, ...]):
    """Whichever it is, of three or more: refused from the first frame on, told after so many with how far it is off."""
    check, told = MapCheck(misplaced(marker_id, xi)), []
    for k, message in enumerate(pictures(3 * PERSISTENT_FRAMES)):
        verdict = check.take(message, CAMERA)
        assert set(verdict.refused) == {marker_id}
        assert verdict.refused[marker_id].startswith(f"map: marker {marker_id} ")
        told += verdict.events
        assert check.untrusted == ({marker_id} if k + 1 >= PERSISTENT_FRAMES else set())
    (event,) = told
    assert event.startswith(f"marker {marker_id} does not lie where the map has it: off by ")
    assert event.endswith("run relnav map")
    distance_mm, angle_deg = (float(word) for word in event.split() if word.replace(".", "").isdigit() and "." in word)
    assert distance_mm == pytest.approx(1e3 * np.linalg.norm(xi[:3]), abs=3.0)
    assert angle_deg == pytest.approx(np.degrees(np.linalg.norm(xi[3:])), abs=2.0)


@pytest.mark.parametrize("sigma_px", [0.03, 0.3])
def test_a_right_map_is_not_doubted(sigma_px: float):
    check = MapCheck(MISSION)
    verdicts = [check.take(message, CAMERA) for message in pictures(60, sigma_px=sigma_px)]
    assert not any(verdict.refused or verdict.events for verdict in verdicts)


def test_of_two_the_one_listed_first_is_believed_until_there_are_three():
    """7 is wrong and listed first: alone with 3 it is believed; with 11 in view it is outvoted, and 3 is taken back."""
    check = MapCheck(misplaced(7))
    for message in pictures(PERSISTENT_FRAMES, only={3, 7}):
        assert set(check.take(message, CAMERA).refused) == {3}
    assert check.untrusted == {3}
    events = [event for message in pictures(5 * PERSISTENT_FRAMES) for event in check.take(message, CAMERA).events]
    assert check.untrusted == {7}
    assert all("\n" not in event for event in events)


def test_it_takes_as_many_frames_to_be_trusted_again():
    """The map was wrong for marker 3 and the marker was put right: it is used again only after a while."""
    check = MapCheck(misplaced(3))
    for message in pictures(PERSISTENT_FRAMES):
        check.take(message, CAMERA)
    assert check.untrusted == {3}
    rng, agreeing = np.random.default_rng(SEED), misplaced(3)
    for k in range(PERSISTENT_FRAMES):
        verdict = check.take(seen_from(place(k), agreeing, sigma_px=0.1, rng=rng), CAMERA)
        assert set(verdict.refused) == {3}
    assert verdict.events == ("marker 3 lies where the map has it again",)
    assert not check.take(seen_from(place(0), agreeing, sigma_px=0.1, rng=rng), CAMERA).refused


def test_a_false_identity_in_one_frame_is_refused_in_that_frame_only():
    check = MapCheck(MISSION)
    messages = pictures(6)
    found = {detection.marker_id: detection for detection in messages[3].detections}
    false = found[11].model_copy(update={"marker_id": 3})
    messages[3] = messages[3].model_copy(update={"detections": [found[7], found[11], false]})
    refused = [set(check.take(message, CAMERA).refused) for message in messages]
    assert refused == [set(), set(), set(), {3}, set(), set()]
    assert not check.untrusted


@settings(max_examples=10, deadline=None)
@given(only=st.sets(st.sampled_from([3, 7, 11]), min_size=1), extra=st.integers(100, 200))
def test_strangers_and_single_markers_say_nothing(only: set[int], extra: int):
    """What is not on the map, and what is seen alone, neither contradicts nor agrees."""
    check = MapCheck(MISSION)
    (message,) = pictures(1, only=only)
    stranger = message.detections[0].model_copy(update={"marker_id": extra})
    verdict = check.take(message.model_copy(update={"detections": [*message.detections, stranger]}), CAMERA)
    assert verdict.refused == {} and verdict.events == ()


@pytest.mark.parametrize("xi", [ASIDE, BEHIND_AND_TURNED])
def test_the_filter_keeps_tracking_on_the_others(xi: tuple[float, ...]):
    """With what the check refuses left out, the state is right all the way; nothing of it rests on the wrong marker."""
    mission = misplaced(3, xi)
    pose_filter, check = PoseFilter(mission), MapCheck(mission)
    pose_filter.step(CALIBRATION)
    for k, message in enumerate(pictures(60)):
        refused = check.take(message, CAMERA).refused
        used = [found for found in message.detections if found.marker_id not in refused]
        state = next(iter(pose_filter.step(message.model_copy(update={"detections": used}))))
        assert isinstance(state, RelativeState) and state.T_chaser_target is not None
        assert state.mode == Mode.TRACK
        assert {7, 11} <= set(state.marker_ids) or k < 10
        error = difference(mission.camera.T_chaser_cam.matrix() @ place(k), pose_matrix(state.T_chaser_target))
        assert np.linalg.norm(error[:3]) < 3e-3
