"""A good approach broken on purpose, at the level of corners: what the states may do then, and what never."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from astratag.transforms import difference
from benchmarks.filter import branches
from pipeline.convert import points_array, points_message, pose_matrix, vector_array
from pipeline.mission import FilterSection, FlatSection, MarkerSection, PoseSection
from pipeline.pose_filter import PoseFilter
from schemas import Detections, Mode, RelativeState
from tests.approach import CALIBRATION, MARKER, T0_NS, approach, detection, detections, mission, truth

HZ = 15.0
START_S, END_S = 4.0, 16.0
SIGMA_PX = 0.1
MISSION = mission()


@pytest.fixture(params=[0, 1])
def seed(request: pytest.FixtureRequest) -> int:
    print(f"seed {request.param}")
    return request.param


def good(seed: int) -> list[Detections]:
    """Return an approach as it should be."""
    rng, motion = np.random.default_rng(seed), approach(seed)
    times_s = np.arange(round(START_S * HZ), round(END_S * HZ)) / HZ
    return [
        detections(t, detection(MISSION, truth(MISSION, motion.at(t)).T_a_b, sigma_px=SIGMA_PX, rng=rng))
        for t in times_s
    ]


def states(sent: Sequence[Detections], **settings: float) -> list[RelativeState]:
    pose_filter = PoseFilter(MISSION.model_copy(update={"filter": FilterSection(**settings)}))
    pose_filter.step(CALIBRATION)
    answers = [list(pose_filter.step(message)) for message in sent]
    assert all(isinstance(answer[0], RelativeState) for answer in answers)
    return [answer[0] for answer in answers]


def nees(state: RelativeState, seed: int) -> float:
    """Return the normalised error squared (12 dof, per degree of freedom) at the state's own time."""
    real = truth(MISSION, approach(seed).at((state.t_capture_ns - T0_NS) * 1e-9))
    error = np.concatenate(
        [
            difference(real.T_a_b, pose_matrix(state.T_chaser_target)),
            real.v_a_b_m_s - vector_array(state.v_chaser_target_m_s),
            real.omega_a_b_in_b_rad_s - vector_array(state.omega_chaser_target_in_target_rad_s),
        ]
    )
    P = np.array(state.covariance).reshape(12, 12)
    return float(error @ np.linalg.solve(P, error)) / 12


def spread(state: RelativeState) -> float:
    return float(np.trace(np.array(state.covariance).reshape(12, 12)[:6, :6]))


def assert_honest(found: Sequence[RelativeState], seed: int) -> None:
    """Every state in TRACK or COAST keeps to its covariance, on average and in the worst case."""
    values = [nees(state, seed) for state in found if state.mode in (Mode.TRACK, Mode.COAST)]
    assert len(values) > 50
    assert np.mean(values) < 1.5 and max(values) < 6


def without(sent: Sequence[Detections], kept) -> list[Detections]:
    """Return frames in which only some of the detections were made."""
    return [
        m if kept(k, (m.t_capture_ns - T0_NS) * 1e-9) else m.model_copy(update={"detections": []})
        for k, m in enumerate(sent)
    ]


def test_a_blackout_of_five_seconds(seed):
    """COAST at once and all along, with growing covariance that truth keeps to; TRACK with the first marker."""
    found = states(without(good(seed), lambda _, t_s: not 8 <= t_s < 12.9))
    dark = [state for state in found if state.mode == Mode.COAST]
    assert len(dark) == pytest.approx(4.9 * HZ, abs=1)
    assert [spread(state) for state in dark] == sorted(spread(state) for state in dark)
    assert found[-1].mode == Mode.TRACK
    assert {state.mode for state in found} == {Mode.TRACK, Mode.COAST}
    assert_honest(found, seed)


def test_thirty_per_cent_of_frames_dropped(seed):
    """TRACK in all others, honest, and hardly less exact."""
    rng = np.random.default_rng((seed, 1))
    sent = good(seed)
    found = states([m for m in sent if rng.random() > 0.3])
    assert {state.mode for state in found} == {Mode.TRACK}
    assert_honest(found, seed)
    assert spread(found[-1]) < 2 * spread(states(sent)[-1])


def test_frames_half_a_second_late_reordered_and_doubled(seed):
    """Every fifth comes 0.5 s late, every seventh twice: in the end nothing is different; doubles are refused."""
    sent = good(seed)
    delay_ns = [500_000_000 if k % 5 == 0 and k else 0 for k in range(len(sent))]
    arrivals = sorted(range(len(sent)), key=lambda k: sent[k].t_capture_ns + delay_ns[k])
    arrivals = [k for k in arrivals for _ in range(2 if k % 7 == 0 else 1)]
    found, in_time = states([sent[k] for k in arrivals]), states(sent)
    assert found[-1].covariance == in_time[-1].covariance
    assert found[-1].T_chaser_target == in_time[-1].T_chaser_target
    stamps = [state.t_capture_ns for state in found]
    assert stamps == sorted(stamps)
    refused = [reason for state in found for reason in state.rejections if reason.startswith("stamp: ")]
    assert len(refused) == len(arrivals) - len(sent)
    assert all(reason.startswith("stamp: the same") for reason in refused)
    assert_honest(found, seed)


@pytest.mark.parametrize("step_s", [-100.0, 100.0])
def test_a_step_of_the_clock(seed, step_s):
    """Back: refused for a few frames, then begun anew.  Ahead: lost, and begun anew at once."""
    sent = good(seed)
    stepped = [
        m if k < 60 else m.model_copy(update={"t_capture_ns": m.t_capture_ns + round(step_s * 1e9)})
        for k, m in enumerate(sent)
    ]
    found = states(stepped)
    assert all(state.mode == Mode.TRACK for state in found[65:])
    fresh = [s.model_copy(update={"t_capture_ns": s.t_capture_ns - round(step_s * 1e9)}) for s in found[65:]]
    assert_honest(fresh, seed)


def test_a_false_identity(seed):
    """Another marker read as ours, elsewhere: gated by name in every frame, and nothing moves."""
    rng, sent = np.random.default_rng((seed, 2)), good(seed)
    broken = []
    for k, message in enumerate(sent):
        (seen,) = message.detections
        away_px = rng.uniform(100, 200, 2)
        layers = [
            layer.model_copy(update={"corners_px": points_message(points_array(layer.corners_px) + away_px)})
            for layer in seen.layers
        ]
        false = seen.model_copy(update={"layers": layers})
        broken.append(message.model_copy(update={"detections": [false, seen]}) if k > 10 else message)
    found = states(broken)
    assert all(any(reason.startswith("gate: ") for reason in state.rejections) for state in found[11:])
    np.testing.assert_allclose(found[-1].covariance, states(sent)[-1].covariance, rtol=1e-9, atol=1e-18)


def test_glare_for_two_seconds(seed):
    """Corners five times worse, as they say, and the outer layer gone: TRACK all along, and honest."""
    rng, sent = np.random.default_rng((seed, 3)), good(seed)
    broken = []
    for message in sent:
        t_s = (message.t_capture_ns - T0_NS) * 1e-9
        (seen,) = message.detections
        layers = seen.layers[1:] or seen.layers
        noisy = [
            layer.model_copy(
                update={
                    "corners_px": points_message(
                        points_array(layer.corners_px) + 5 * SIGMA_PX * rng.standard_normal((4, 2))
                    ),
                    "sigma_px": float(np.hypot(5, 1) * SIGMA_PX),
                }
            )
            for layer in layers
        ]
        is_glaring = 9 <= t_s < 11
        broken.append(
            message.model_copy(update={"detections": [seen.model_copy(update={"layers": noisy})]})
            if is_glaring
            else message
        )
    found = states(broken)
    assert {state.mode for state in found} == {Mode.TRACK}
    assert_honest(found, seed)


def test_half_of_the_markers_lost(seed):
    """Of two markers one is covered for four seconds: TRACK on the other, less certain, with no jump."""
    one = mission(FlatSection())
    other = MarkerSection(id=7, surface=FlatSection(), T_target_marker=PoseSection(translation_m=(-0.1, 0.03, 0.15)))
    both = one.model_copy(update={"markers": (*one.markers, other)})
    alone = one.model_copy(update={"markers": (other,)})
    rng, motion = np.random.default_rng(seed), approach(seed)
    pose_filter = PoseFilter(both)
    pose_filter.step(CALIBRATION)
    found = []
    for t_s in np.arange(0, round(9 * HZ)) / HZ:
        T = truth(one, motion.at(t_s)).T_a_b
        seen = [detection(alone, T, sigma_px=SIGMA_PX, rng=rng)]
        assert seen[0] is not None
        seen = [seen[0].model_copy(update={"marker_id": 7})]
        if not 3 <= t_s < 7:
            seen.append(detection(one, T, sigma_px=SIGMA_PX, rng=rng))
        state = next(iter(pose_filter.step(detections(t_s, *seen))))
        assert isinstance(state, RelativeState) and state.T_chaser_target is not None
        error, P = difference(T, pose_matrix(state.T_chaser_target)), np.array(state.covariance).reshape(12, 12)
        if t_s > 1:
            assert state.mode == Mode.TRACK
            assert error @ np.linalg.solve(P[:6, :6], error) < 40
        found.append(state)
    covered = found[round(6.9 * HZ)]
    assert set(covered.marker_ids) == {7} and set(found[-1].marker_ids) == {7, MARKER}


def test_a_flip_at_long_range_is_never_published_as_track():
    """Half-metre markers at 13 to 20 m, frontal to 25 degrees: AMBIGUOUS until one pose wins, the right one."""
    flown = [branches.fly(seed) for seed in range(6)]
    assert sum(run.wrong for run in flown) == 0
    assert sum(run.tracked for run in flown) > 0 and sum(run.ambiguous for run in flown) > 0


def test_a_map_that_contradicts_the_images(seed):
    """A second marker mapped 10 cm from where it is: its layers are refused by name, and the first one is followed."""
    wrong = MarkerSection(id=7, T_target_marker=PoseSection(translation_m=(0.12, 0.03, 0.15)))
    mapped = MISSION.model_copy(update={"markers": (*MISSION.markers, wrong)})
    pose_filter = PoseFilter(mapped)
    pose_filter.step(CALIBRATION)
    found = []
    for k, message in enumerate(good(seed)[:90]):
        (seen,) = message.detections
        if k > 5:  # where marker 7 should be, there is nothing; it is seen where the first one is
            message = message.model_copy(update={"detections": [seen, seen.model_copy(update={"marker_id": 7})]})
        found.append(next(iter(pose_filter.step(message))))
    refused = [reason for state in found[6:] for reason in state.rejections]
    assert refused and all(reason.startswith("map: marker 7") for reason in refused)
    assert all(state.mode == Mode.TRACK and 7 not in state.marker_ids for state in found)
    assert_honest(found, seed)


def test_corners_that_are_not_numbers_are_refused_at_the_door():
    """No message can hold them; and what can be held but not believed leaves the state as it was, and says so."""
    message = good(0)[0]
    layer = message.detections[0].layers[0].model_dump()
    with pytest.raises(ValueError, match="finite"):
        type(message.detections[0].layers[0]).model_validate({**layer, "sigma_px": float("nan")})
    damaged = (
        message.detections[0]
        .layers[0]
        .model_copy(
            update={
                "corners_px": [p.model_copy(update={"x_px": float("nan")}) for p in points_message(np.zeros((4, 2)))]
            }
        )
    )
    seen = message.detections[0].model_copy(update={"layers": [damaged]})
    (state,) = states([message.model_copy(update={"detections": [seen]})])
    assert state.mode == Mode.INIT and state.rejections[0].startswith("corners: ")
