"""Frames that come late, out of order or twice: each is taken once, at its own time, whatever the order."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.history import History
from pipeline.mission import FilterSection
from pipeline.pose_filter import PoseFilter
from schemas import Detections, Mode, RelativeState, encode
from tests.approach import CALIBRATION, approach, detection, detections, mission, truth

HZ = 10.0
FRAMES = 25


def messages(seed: int = 3) -> list[Detections]:
    mission_, motion, rng = mission(), approach(seed), np.random.default_rng(seed)
    times_s = 8 + np.arange(FRAMES) / HZ
    return [
        detections(t, detection(mission_, truth(mission_, motion.at(t)).T_a_b, sigma_px=0.1, rng=rng)) for t in times_s
    ]


def last_state(sent: list[Detections], **settings_) -> RelativeState:
    pose_filter = PoseFilter(mission(filter=FilterSection(**settings_)))
    pose_filter.step(CALIBRATION)
    for message in sent:
        state = next(iter(pose_filter.step(message)))
    assert isinstance(state, RelativeState)
    return state


def test_a_late_frame_counts_as_if_it_had_come_in_time():
    """Half a second late: the state is of the newest frame, and afterwards as if nothing had been late."""
    sent = messages()
    late = [*sent[:10], *sent[11:16], sent[10], *sent[16:]]
    assert encode(last_state(late)) == encode(last_state(sent))
    answer = last_state(late[:16])
    assert answer.t_capture_ns == sent[15].t_capture_ns and answer.mode == Mode.TRACK
    assert not answer.rejections and answer.age_s == 0
    assert answer.covariance == last_state(sent[:16]).covariance


@settings(deadline=None, max_examples=15)
@given(order=st.permutations(range(8)), twice=st.integers(0, 7))
def test_the_order_of_arrival_does_not_matter(order, twice):
    """Any order of eight frames after the first, one of them sent twice: the same state, to the byte."""
    sent = messages()[:10]
    shuffled = [sent[0], *(sent[1 + k] for k in order), sent[1 + twice], sent[9]]
    assert encode(last_state(shuffled)) == encode(last_state(sent))


def test_older_frames_and_duplicates_are_refused_by_name():
    sent = messages()
    assert last_state([*sent[1:], sent[0]]).rejections == ["stamp: 2.400000 s before the last frame's"]
    assert last_state([*sent, sent[20]]).rejections == ["stamp: the same as that of a frame before"]
    assert last_state([*sent[1:5], sent[0]], history_s=0).rejections[0].startswith("stamp: 0.4")


def test_a_history_is_no_longer_than_it_should_be():
    history: History[str, int] = History(100)
    for t_ns in range(0, 1000, 30):
        history.append(t_ns, f"at {t_ns}", t_ns)
    assert len(history) == 4 and history.holds(990) and not history.holds(870)
    assert history.reaches(901) and not history.reaches(900)
    state, later = history.rewind(945)
    assert state == 930 and later == [(960, "at 960"), (990, "at 990")]
    with pytest.raises(AssertionError):
        history.append(930, "again", 0)
