"""Bad input to the pose filter: refused or gated for a reason that can be counted, and never a NaN published."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError

from astratag.transforms import inverse
from pipeline.convert import points_array
from pipeline.corner_filter import CornerFilter
from pipeline.corners import Eye, SeenLayer
from pipeline.dynamics import STATES, Motion
from pipeline.hypotheses import HypothesisBank
from pipeline.pose_filter import PoseFilter, corners_on_target
from schemas import Detection, Detections, LayerCorners, Mode, Point2, RelativeState
from tests.approach import CALIBRATION, CAMERA, T0_NS, approach, detection, detections, mission, truth

HZ, SIGMA_PX = 15.0, 0.1
MISSION = mission()
EYE = Eye(CAMERA, inverse(MISSION.camera.T_chaser_cam.matrix()))
MOTION = approach(4)
NAN, INF = float("nan"), float("inf")


def seen(t_s: float) -> Detection:
    found = detection(MISSION, truth(MISSION, MOTION.at(t_s)).T_a_b, sigma_px=SIGMA_PX)
    assert found is not None
    return found


def step(pose_filter: PoseFilter, message: Detections) -> RelativeState:
    """Return the state, of which nothing may be NaN."""
    state = next(iter(pose_filter.step(message)))
    assert isinstance(state, RelativeState)
    RelativeState.model_validate(state.model_dump())
    if state.covariance is not None:
        assert np.isfinite(state.covariance).all()
        np.linalg.cholesky(np.array(state.covariance).reshape(12, 12))
    return state


def tracking(until_s: float = 11.0) -> PoseFilter:
    pose_filter = PoseFilter(MISSION)
    pose_filter.step(CALIBRATION)
    for t_s in np.arange(round(10 * HZ), round(until_s * HZ)) / HZ:
        state = step(pose_filter, detections(t_s, seen(t_s)))
    assert state.mode == Mode.TRACK
    return pose_filter


def kinds(state: RelativeState) -> list[str]:
    return [reason.split(":")[0] for reason in state.rejections]


@pytest.mark.parametrize("bad", [NAN, INF, -INF])
def test_a_message_does_not_carry_corners_that_are_no_numbers(bad):
    """Nor a noise, nor a place in the image: such a message is refused before any step sees it."""
    point = {"x_px": bad, "y_px": 1.0}
    with pytest.raises(ValidationError):
        Point2.model_validate(point)
    with pytest.raises(ValidationError):
        LayerCorners.model_validate({"layer": 0, "corners_px": [point] * 4, "sigma_px": 0.1})
    with pytest.raises(ValidationError):
        LayerCorners.model_validate({"layer": 0, "corners_px": [{"x_px": 0.0, "y_px": 0.0}] * 4, "sigma_px": bad})


@pytest.mark.parametrize("bad", [NAN, INF, -INF])
@pytest.mark.parametrize("where", ["corner", "sigma"])
def test_corners_that_are_no_numbers_are_refused_by_layer(bad, where):
    """Even past the message's own check: the layer is named and left out, the others are used."""
    pose_filter, t_s = tracking(), 11.0
    good = seen(t_s)
    first = good.layers[0]
    point = first.corners_px[0].model_copy(update={"x_px": bad})
    changed = {"corners_px": [point, *first.corners_px[1:]]} if where == "corner" else {"sigma_px": bad}
    broken = good.model_copy(update={"layers": [first.model_copy(update=changed), *good.layers[1:]]})
    state = step(pose_filter, detections(t_s, broken))
    assert kinds(state) == ["corners"]
    assert state.mode == Mode.TRACK and state.layers == [layer.layer for layer in good.layers[1:]]


def test_without_a_number_at_all_the_state_is_propagated():
    """COAST, with a reason for each layer."""
    pose_filter, t_s = tracking(), 11.0
    nowhere = [Point2.model_construct(x_px=NAN, y_px=NAN)] * 4
    good = seen(t_s)
    layers = [layer.model_copy(update={"corners_px": nowhere}) for layer in good.layers]
    state = step(pose_filter, detections(t_s, good.model_copy(update={"layers": layers})))
    assert state.mode == Mode.COAST and kinds(state) == ["corners"] * len(layers)


@pytest.mark.parametrize("back_s", [0.5, 30.0])
def test_a_negative_step_of_time_never_runs_the_filter_backwards(back_s):
    """A little late: taken at its own time.  Older than all that is remembered: refused as "stamp"."""
    pose_filter = tracking(13.0)
    before = step(pose_filter, detections(13.0, seen(13.0)))
    t_s = 13.03 - back_s
    state = step(pose_filter, detections(t_s, seen(max(t_s, 0.0))))
    assert state.t_capture_ns == before.t_capture_ns
    assert kinds(state) == ([] if back_s < MISSION.filter.history_s else ["stamp"])
    assert state.mode == Mode.TRACK
    assert list(pose_filter.tick(T0_NS)) == []


SINGULAR = {
    "zero": np.zeros((STATES, STATES)),
    "rank one": np.ones((STATES, STATES)),
    "negative": -np.eye(STATES),
    "no number": np.full((STATES, STATES), NAN),
    "infinite": np.diag(np.full(STATES, INF)),
}


@pytest.mark.parametrize("P", SINGULAR.values(), ids=SINGULAR.keys())
def test_a_singular_covariance_is_refused(P):
    """The update is refused, nothing changes, and a bank of such filters says so too."""
    T, found = truth(MISSION, MOTION.at(10.0)).T_a_b, seen(10.0)
    layers = [
        SeenLayer(
            found.marker_id,
            one.layer,
            points_array(one.corners_px),
            one.sigma_px,
            corners_on_target(MISSION.markers[0], one.layer),
        )
        for one in found.layers
    ]
    one = CornerFilter(Motion.at_rest(T), P, MISSION.filter)
    bank = HypothesisBank([one], [0.0], MISSION.filter, MISSION.markers[0].T_target_marker.matrix(), EYE)
    with np.errstate(all="ignore"):
        assert one.update(layers, EYE) is None
        assert bank.update(layers, EYE) is None
    np.testing.assert_array_equal(one.covariance[:STATES, :STATES], P)
