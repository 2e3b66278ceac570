"""The pose filter's step: acquisition, gates, modes, coasting, refusals, and what never happens."""

import itertools

import numpy as np
import pytest
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.Log_pb2 import Log
from hypothesis import given, settings
from hypothesis import strategies as st

from astratag.camera import Camera
from astratag.transforms import difference, exp_so3, inverse, pose, transform
from nodes.bus import Received
from nodes.step_host import StepWork
from pipeline.convert import pose_matrix, pose_message, vector_array
from pipeline.corners import Eye, SeenLayer, edge_shifts, outward_shift, predicted_corners
from pipeline.dynamics import STATES, Motion
from pipeline.hypotheses import mirrored_pose
from pipeline.mission import FilterSection, FlatSection, Mission
from pipeline.pose_filter import PoseFilter, corners_on_target
from pipeline.steps import STEPS
from schemas import Detection, Detections, Envelope, LayerCorners, Mode, Point2, RelativeState, Stamp, encode
from tests.approach import CALIBRATION, CAMERA, MARKER, T0_NS, approach, detection, detections, mission, truth

HZ = 15.0
SIGMA_PX = 0.1


def started(mission_: Mission) -> PoseFilter:
    pose_filter = PoseFilter(mission_)
    assert list(pose_filter.step(CALIBRATION)) == []
    return pose_filter


def state_of(answer) -> RelativeState:
    """Return the one state of an answer, its other messages being of the kinds that may follow it."""
    state, *rest = answer
    assert isinstance(state, RelativeState)
    assert all(isinstance(message, FrameTransforms | Log) for message in rest)
    assert sum(isinstance(message, FrameTransforms) for message in rest) == (state.T_chaser_target is not None)
    return state


def events_of(answer) -> list[str]:
    return [message.message for message in answer if isinstance(message, Log)]


def pose_error(state: RelativeState, T_chaser_target) -> np.ndarray:
    return difference(T_chaser_target, pose_matrix(state.T_chaser_target))


def covariance(state: RelativeState) -> np.ndarray:
    return np.array(state.covariance).reshape(12, 12)


def follow(pose_filter, mission_, motion, times_s, rng=None, **kwargs) -> list[RelativeState]:
    """Feed the filter an approach at some times."""
    states = []
    for t_s in times_s:
        T = truth(mission_, motion.at(t_s)).T_a_b
        seen = detection(mission_, T, sigma_px=SIGMA_PX, rng=rng, **kwargs)
        states.append(state_of(pose_filter.step(detections(t_s, seen))))
    return states


def frames(start_s: float, end_s: float) -> np.ndarray:
    return np.arange(round(start_s * HZ), round(end_s * HZ)) / HZ


def test_noiseless_in_exact_out():
    """Perfect corners of a marker that moves as the model says are followed to the micrometre."""
    mission_ = mission()
    pose_filter = started(mission_)
    T0 = truth(mission_, approach(3).at(5.0)).T_a_b
    start = Motion(T0[:3, 3], T0[:3, :3], np.array([-0.05, 0.004, -0.002]), np.array([0.01, 0.03, -0.02]))
    for t_s in frames(0, 4):
        moved = start.after(t_s, mission_.filter)
        seen = detection(mission_, moved.pose_chaser_target(), sigma_px=SIGMA_PX)
        state = state_of(pose_filter.step(detections(t_s, seen)))
    assert state.mode == Mode.TRACK
    error = pose_error(state, moved.pose_chaser_target())
    assert np.abs(error[:3]).max() < 5e-6
    assert np.abs(error[3:]).max() < 2e-5
    assert vector_array(state.v_chaser_target_m_s) == pytest.approx(start.v_chaser_target_m_s, abs=2e-4)
    rate = start.omega_chaser_target_in_target_rad_s
    assert vector_array(state.omega_chaser_target_in_target_rad_s) == pytest.approx(rate, abs=2e-4)


def test_jacobian_against_finite_differences():
    """D corner / d error state, for a camera with distortion and a marker away from the target's origin."""
    mission_ = mission()
    camera = Camera(CAMERA.K, (-0.2, 0.1, 0.001, -0.002, 0.0), width=1280, height=720)
    eye = Eye(camera, inverse(mission_.camera.T_chaser_cam.matrix()))
    real = truth(mission_, approach(1).at(12.0))
    motion = Motion(real.T_a_b[:3, 3], real.T_a_b[:3, :3], real.v_a_b_m_s, real.omega_a_b_in_b_rad_s, 0.02)
    layers = [SeenLayer(MARKER, k, np.zeros((4, 2)), 0.1, corners_on_target(mission_.markers[0], k)) for k in (1, 2)]
    _, H = predicted_corners(motion, layers, eye)
    for k in range(STATES):
        step = np.zeros(STATES)
        step[k] = 1e-6
        ahead, behind = (predicted_corners(motion.moved(s), layers, eye)[0] for s in (step, -step))
        assert H[:, k] == pytest.approx((ahead - behind) / 2e-6, rel=1e-3, abs=0.05), k


def test_edge_bias_moves_every_edge_by_a_pixel():
    """A quad whose corners shift by one unit of bias has each edge one pixel farther out; or one edge, and no other."""
    quad = np.array([[10.0, 12], [90, 5], [100, 80], [5, 95]])
    shifted = quad + outward_shift(quad[None])[0]
    for k in range(4):
        along = (quad[(k + 1) % 4] - quad[k]) / np.linalg.norm(quad[(k + 1) % 4] - quad[k])
        outward = np.array([along[1], -along[0]])
        assert (shifted[[k, (k + 1) % 4]] - quad[k]) @ outward == pytest.approx([1, 1])
        alone = quad + edge_shifts(quad[None])[0]
        moved = [(alone[edge][[k, (k + 1) % 4]] - quad[k]) @ outward for edge in range(4)]
        assert np.array(moved) == pytest.approx(np.outer(np.arange(4) == k, [1, 1]))


def test_mirrored_pose_looks_the_same_from_afar():
    """Twice mirrored is unchanged; once mirrored, a small flat marker's corners stay within a tenth of a pixel."""
    T = pose(np.diag([1.0, -1, -1]), (0.4, -0.2, 10.0))
    T[:3, :3] = T[:3, :3] @ exp_so3((0.3, -0.2, 0.1))
    other = mirrored_pose(T)
    assert mirrored_pose(other) == pytest.approx(T)
    assert np.linalg.det(other[:3, :3]) == pytest.approx(1)
    corners = np.array([[-0.05, 0.05, 0], [0.05, 0.05, 0], [0.05, -0.05, 0], [-0.05, -0.05, 0]])
    assert CAMERA.project(transform(T, corners)) == pytest.approx(CAMERA.project(transform(other, corners)), abs=0.1)


def test_waits_for_a_calibration_and_a_marker():
    """INIT, one state a frame, and the reason, until both are there."""
    mission_ = mission()
    pose_filter = PoseFilter(mission_)
    seen = detection(mission_, truth(mission_, approach(0).at(0)).T_a_b, sigma_px=SIGMA_PX)
    state = state_of(pose_filter.step(detections(0.0, seen)))
    assert state.mode == Mode.INIT and state.rejections == ["calibration: none yet"]
    pose_filter.step(CALIBRATION)
    assert state_of(pose_filter.step(detections(0.1))).mode == Mode.INIT
    answer = pose_filter.step(detections(0.2, seen))
    state = state_of(answer)
    assert state.mode == Mode.TRACK
    assert set(state.marker_ids) == {MARKER} and len(state.layers) == len(seen.layers)
    assert len(events_of(answer)) == 2


def test_coasts_through_a_blackout():
    """Four seconds without markers: covariance grows, and truth stays inside 3 sigma; then it tracks again."""
    mission_, rng = mission(), np.random.default_rng(1)
    motion = approach(1)
    pose_filter = started(mission_)
    tracked = follow(pose_filter, mission_, motion, frames(8, 12), rng)[-1]
    size = np.trace(covariance(tracked))
    for t_s in frames(12, 16):
        state = state_of(pose_filter.step(detections(t_s)))
        assert state.mode == Mode.COAST
        assert np.trace(covariance(state)) > size
        size = np.trace(covariance(state))
        error = pose_error(state, truth(mission_, motion.at(t_s)).T_a_b)
        assert (np.abs(error) < 3 * np.sqrt(np.diag(covariance(state)[:6, :6]))).all()
    assert state.age_s == pytest.approx(4.0)
    states = follow(pose_filter, mission_, motion, frames(16, 17), rng)
    assert states[-1].mode == Mode.TRACK


def test_loses_and_finds_again():
    """Coasting beyond ``coast_s`` is LOST: no state is published, until a marker starts a new one."""
    mission_, rng, motion = mission(), np.random.default_rng(2), approach(2)
    pose_filter = started(mission_)
    follow(pose_filter, mission_, motion, frames(0, 1), rng)
    answers = [pose_filter.step(detections(t_s)) for t_s in frames(1, 7)]
    modes = [mode for mode, _ in itertools.groupby(state_of(answer).mode for answer in answers)]
    assert modes == [Mode.COAST, Mode.LOST]
    lost = state_of(answers[-1])
    assert lost.T_chaser_target is None and lost.covariance is None and lost.age_s > 5
    assert [message.level for answer in answers for message in answer if isinstance(message, Log)] == [
        Log.WARNING,
        Log.ERROR,
    ]
    assert follow(pose_filter, mission_, motion, frames(7, 8), rng)[-1].mode == Mode.TRACK


def test_a_gap_in_time_is_a_loss():
    """Nothing at all for a minute, then a frame: the old state is dropped and the frame starts a new one."""
    mission_, motion = mission(), approach(2)
    pose_filter = started(mission_)
    follow(pose_filter, mission_, motion, [0.0])
    seen = detection(mission_, truth(mission_, motion.at(20.0)).T_a_b, sigma_px=SIGMA_PX)
    answer = pose_filter.step(detections(60.0, seen))
    assert state_of(answer).mode == Mode.TRACK
    assert events_of(answer)[0].startswith("LOST: no measurement for 60")


def test_tick_coasts_without_moving_the_filter():
    """A tick ahead of a late frame: the state is propagated, and the late frame is still taken."""
    mission_, rng, motion = mission(), np.random.default_rng(4), approach(4)
    pose_filter = started(mission_)
    assert list(pose_filter.tick(T0_NS)) == []
    last = follow(pose_filter, mission_, motion, frames(5, 7), rng)[-1]
    t_ns = last.t_capture_ns + 500_000_000
    state = state_of(pose_filter.tick(t_ns))
    assert (state.mode, state.t_capture_ns, state.age_s) == (Mode.COAST, t_ns, 0.5)
    assert covariance(state)[0, 0] > covariance(last)[0, 0]
    error = pose_error(state, truth(mission_, motion.at((t_ns - T0_NS) * 1e-9)).T_a_b)
    assert (np.abs(error) < 4 * np.sqrt(np.diag(covariance(state)[:6, :6]))).all()
    assert follow(pose_filter, mission_, motion, [7.0], rng)[0].mode == Mode.TRACK
    assert state_of(pose_filter.tick(t_ns + 10_000_000_000)).mode == Mode.LOST
    assert list(pose_filter.tick(t_ns + 11_000_000_000)) == []


def test_coast_means_that_a_frame_is_overdue():
    """At 5 Hz: still TRACK one and two periods after the last frame, with growing covariance; COAST after three."""
    mission_, rng, motion = mission(), np.random.default_rng(4), approach(4)
    pose_filter = started(mission_)
    last = follow(pose_filter, mission_, motion, np.arange(25, 40) / 5, rng)[-1]
    sizes, modes = [], []
    for late_s in (0.2, 0.3, 0.4, 0.6):
        state = state_of(pose_filter.tick(last.t_capture_ns + round(late_s * 1e9)))
        modes.append(state.mode)
        sizes.append(np.trace(covariance(state)))
        assert state.age_s == pytest.approx(late_s)
    assert modes == [Mode.TRACK] * 3 + [Mode.COAST]
    assert sizes == sorted(sizes)
    assert follow(pose_filter, mission_, motion, [8.6], rng)[0].mode == Mode.TRACK


def test_a_live_run_propagates_at_the_rate_of_the_mission():
    """Ten states between two frames at 5 Hz when asked for 50 Hz, none of them a change of mode."""
    mission_ = mission(filter=FilterSection(output_rate_hz=50.0))
    work = StepWork(next(spec for spec in STEPS if spec.name == "pose_filter"), mission_, lossless=False)

    def take(message, t_ns):
        envelope = Envelope.wrap(message, Stamp(0, t_ns, t_ns), vehicle="chaser", camera="nav")
        return list(work.handle(Received(envelope, t_ns)))

    take(CALIBRATION, T0_NS)
    for k in range(5):
        seen = detection(mission_, truth(mission_, approach(4).at(k / 5)).T_a_b, sigma_px=SIGMA_PX)
        take(detections(k / 5, seen), T0_NS + k * 200_000_000)
    t_last_ns = T0_NS + 800_000_000
    between = [e.message() for ms in range(1, 200) for e in work.idle(t_last_ns + ms * 1_000_000)]
    found = [message for message in between if isinstance(message, RelativeState)]
    assert [(s.t_capture_ns - t_last_ns) // 1_000_000 for s in found] == list(range(20, 200, 20))
    assert {s.mode for s in found} == {Mode.TRACK}


def test_an_unknown_marker_is_refused():
    """A false id beside the true marker changes nothing but the rejections."""
    mission_, motion = mission(), approach(5)
    seen = detection(mission_, truth(mission_, motion.at(5.0)).T_a_b, sigma_px=SIGMA_PX)
    false = seen.model_copy(update={"marker_id": 7})
    alone, both = started(mission_), started(mission_)
    state = state_of(both.step(detections(5.0, false, seen)))
    assert state.rejections == ["unknown marker: 7 is not on the target"]
    assert state.covariance == state_of(alone.step(detections(5.0, seen))).covariance
    assert state_of(started(mission_).step(detections(5.0, false))).mode == Mode.INIT


def test_an_outlying_layer_is_gated():
    """One layer a few pixels off is refused by name, the others are used, and the estimate does not move."""
    mission_, rng, motion = mission(), np.random.default_rng(6), approach(6)
    pose_filter = started(mission_)
    follow(pose_filter, mission_, motion, frames(10, 12), rng)
    T = truth(mission_, motion.at(12.0)).T_a_b
    seen = detection(mission_, T, sigma_px=SIGMA_PX, rng=rng)
    assert len(seen.layers) == 3
    moved = [Point2(x_px=p.x_px + 4, y_px=p.y_px) for p in seen.layers[1].corners_px]
    bad = seen.layers[1].model_copy(update={"corners_px": moved})
    state = state_of(
        pose_filter.step(detections(12.0, seen.model_copy(update={"layers": [seen.layers[0], bad, seen.layers[2]]})))
    )
    assert state.layers == [0, 2] and state.nis_dof == 16
    (rejection,) = state.rejections
    assert rejection.startswith(f"gate: marker {MARKER} layer 1, ")
    assert np.linalg.norm(pose_error(state, T)[:3]) < 2e-3


def test_starts_again_when_everything_is_refused():
    """The target jumps (a false start, or a bump): after five frames refused in a row the filter starts afresh."""
    mission_, rng = mission(), np.random.default_rng(7)
    pose_filter = started(mission_)
    follow(pose_filter, mission_, approach(7), frames(5, 6), rng)
    other = approach(8, tilt_rad=(-0.2, 0.2, 0.3))
    states = follow(pose_filter, mission_, other, frames(6, 7), rng)
    assert [state.mode for state in states[:6]] == [Mode.COAST] * 4 + [Mode.TRACK] * 2
    assert all(state.rejections for state in states[:5])
    error = pose_error(states[-1], truth(mission_, other.at(frames(6, 7)[-1])).T_a_b)
    assert np.abs(error[:3]).max() < 5e-3


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_second_pose_resolves(seed):
    """A flat marker, far and tilted, started on the wrong root: AMBIGUOUS first, and never a flipped pose in TRACK."""
    mission_, rng = mission(FlatSection(), side_m=0.5), np.random.default_rng(seed)
    motion = approach(
        seed, start_m=30, end_m=26, duration_s=40, tilt_rad=(0.3, -0.3, 0.0), sway_rad=(1e-3, 1e-3), end_speed_m_s=0.01
    )
    pose_filter = started(mission_)
    states = []
    for t_s in frames(0, 12):
        marker = motion.at(t_s)
        T = truth(mission_, marker).T_a_b
        seen = detection(mission_, T, sigma_px=0.15, rng=rng)
        flipped = pose_message(mirrored_pose(marker.T_a_b))
        seen = seen.model_copy(update={"T_cam_marker": flipped, "planar_poses": []})
        state = state_of(pose_filter.step(detections(t_s, seen)))
        states.append(state)
        if state.mode == Mode.TRACK:
            assert state.hypothesis_probability > 0.9999
            assert np.linalg.norm(pose_error(state, T)[3:]) < np.deg2rad(8)
    assert states[0].mode == Mode.AMBIGUOUS
    assert states[0].hypothesis_probability < 0.9999
    assert states[-1].mode == Mode.TRACK


def test_a_cylinder_is_not_ambiguous():
    """Its curvature tells the two poses apart: TRACK from the first frame, whichever pose comes with it."""
    mission_, marker = mission(), approach(9).at(2.0)
    seen = detection(mission_, truth(mission_, marker).T_a_b, sigma_px=0.05)
    flipped = pose_message(mirrored_pose(marker.T_a_b))
    seen = seen.model_copy(update={"T_cam_marker": flipped, "planar_poses": []})
    state = state_of(started(mission_).step(detections(0.0, seen)))
    assert state.mode == Mode.TRACK
    assert np.linalg.norm(pose_error(state, truth(mission_, marker).T_a_b)[3:]) < 1e-3


def test_without_a_map_the_first_marker_is_the_target():
    """Its frame is the target's, and other markers are refused until it is lost."""
    mission_, motion = mission(FlatSection()), approach(10)
    bare = Mission(default_side_m=0.1)
    pose_filter = started(bare)
    marker = motion.at(8.0)
    seen = detection(mission_, truth(mission_, marker).T_a_b, sigma_px=0.05)
    state = state_of(pose_filter.step(detections(0.0, seen)))
    assert pose_error(state, marker.T_a_b) == pytest.approx(np.zeros(6), abs=1e-3)
    other = seen.model_copy(update={"marker_id": 3})
    state = state_of(pose_filter.step(detections(0.1, other)))
    assert state.rejections == ["unknown marker: 3 is not on the target"]
    assert state_of(pose_filter.step(detections(20.0, other))).marker_ids[0] == 3


def test_stamps_that_do_not_advance_are_refused():
    """A duplicate and a too late frame leave the state as it is, with the reason; a clock set back starts afresh."""
    mission_, rng, motion = mission(), np.random.default_rng(11), approach(11)
    pose_filter = started(mission_)
    last = follow(pose_filter, mission_, motion, frames(4, 6), rng)[-1]
    t_s = float(frames(4, 6)[-1])
    (twice,) = follow(pose_filter, mission_, motion, [t_s], rng)
    (late,) = follow(pose_filter, mission_, motion, [t_s - 1.5], rng)
    for state, reason in ((twice, "stamp: the same as the last frame's"), (late, "stamp: 1.500000 s before")):
        assert state.rejections[0].startswith(reason)
        assert (state.T_chaser_target, state.covariance, state.t_capture_ns, state.mode) == (
            last.T_chaser_target,
            last.covariance,
            last.t_capture_ns,
            Mode.TRACK,
        )
        assert state.nis is None and not state.marker_ids
    states = follow(pose_filter, mission_, motion, frames(0, 1), rng)
    assert states[-1].mode == Mode.TRACK and states[-1].t_capture_ns < last.t_capture_ns
    assert [state.t_capture_ns for state in states].count(last.t_capture_ns) == 3


def test_a_single_wild_stamp_costs_only_a_few_frames():
    """One frame stamped an hour ahead: the filter is back on the right time within the reset count."""
    mission_, rng, motion = mission(), np.random.default_rng(12), approach(12)
    pose_filter = started(mission_)
    follow(pose_filter, mission_, motion, frames(0, 1), rng)
    pose_filter.step(detections(3600.0))
    states = follow(pose_filter, mission_, motion, frames(1, 2), rng)
    assert [state.mode for state in states[:6]] == [Mode.LOST] * 4 + [Mode.TRACK] * 2


def test_a_frame_of_another_size_is_refused():
    """Corners of a resized picture would be a wrong range: none is used."""
    mission_ = mission()
    seen = detection(mission_, truth(mission_, approach(0).at(0)).T_a_b, sigma_px=SIGMA_PX)
    message = detections(0.0, seen).model_copy(update={"width_px": 640, "height_px": 360})
    state = state_of(started(mission_).step(message))
    assert state.mode == Mode.INIT
    assert state.rejections == ["calibration: for 1280x720, the frame is 640x360"]


def test_events_are_stamped_with_the_capture_time():
    """So that replays are identical."""
    mission_ = mission()
    seen = detection(mission_, truth(mission_, approach(0).at(0)).T_a_b, sigma_px=SIGMA_PX)
    answer = started(mission_).step(detections(1.25, seen))
    stamps = [message.timestamp.ToNanoseconds() for message in answer if isinstance(message, Log)]
    assert stamps == [T0_NS + 1_250_000_000] * 2
    (transforms,) = (message for message in answer if isinstance(message, FrameTransforms))
    assert [(t.parent_frame_id, t.child_frame_id) for t in transforms.transforms] == [
        ("chaser", "target"),
        ("chaser", "camera"),
    ]


def test_the_same_frames_give_the_same_bytes():
    """Two filters, one log."""
    mission_ = mission()

    def run() -> list[bytes]:
        pose_filter, rng, out = started(mission_), np.random.default_rng(13), []
        for t_s in frames(0, 3):
            seen = detection(mission_, truth(mission_, approach(13).at(t_s)).T_a_b, sigma_px=SIGMA_PX, rng=rng)
            out += [encode(message) for message in pose_filter.step(detections(t_s, seen))]
        return out

    assert run() == run()


wild = st.one_of(st.floats(-100, 1400), st.floats(allow_nan=False, allow_infinity=False))
wild_corners = st.lists(st.builds(Point2, x_px=wild, y_px=wild), min_size=4, max_size=4)
sigmas = st.one_of(st.floats(0.01, 1.0), st.floats(min_value=5e-324, allow_nan=False, allow_infinity=False))
wild_layers = st.lists(
    st.builds(LayerCorners, layer=st.integers(0, 2), corners_px=wild_corners, sigma_px=sigmas), max_size=3
)
kinds = st.sampled_from(["true", "empty", "wild", "shifted"])


@st.composite
def logs(draw) -> list[tuple[float, str, list, int]]:
    count = draw(st.integers(1, 8))
    steps = st.sampled_from([-1.0, 0.0, 1e-9, 0.05, 0.1, 1.0, 10.0])
    return [(draw(steps), draw(kinds), draw(wild_layers), draw(st.sampled_from([MARKER, 7]))) for _ in range(count)]


@settings(deadline=None, max_examples=80)
@given(log=logs(), sigma_px=sigmas)
def test_nothing_crashes_it_and_nothing_is_nan(log, sigma_px):
    """Any well-formed detections: one state a frame, finite, its covariance symmetric and positive definite."""
    mission_, motion = mission(), approach(14)
    pose_filter, t_s = started(mission_), 10.0
    for step_s, kind, layers, marker_id in log:
        t_s += step_s
        real = detection(mission_, truth(mission_, motion.at(min(max(t_s, 0.0), 27.0))).T_a_b, sigma_px=0.1)
        seen: list[Detection] = [] if kind == "empty" or real is None else [real]
        if kind == "wild" and seen:
            seen = [real.model_copy(update={"layers": layers, "marker_id": marker_id}), real]
        if kind == "shifted" and seen:
            odd = [layer.model_copy(update={"sigma_px": sigma_px}) for layer in real.layers]
            seen = [real.model_copy(update={"layers": odd})]
        message = detections(t_s, *seen)
        state = state_of(pose_filter.step(Detections.model_validate(message.model_dump())))
        encode(state)
        if state.covariance is not None:
            P = covariance(state)
            assert np.isfinite(P).all() and (P == P.T).all()
            np.linalg.cholesky(P)
