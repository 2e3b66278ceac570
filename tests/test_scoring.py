"""Scoring against runs whose errors are known because they were put there."""

import io
import json
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from astratag.transforms import perturb
from pipeline.expected import visible_layers
from pipeline.recording import RecordingWriter
from pipeline.run import Run, gather_run, state_error
from pipeline.scoring import print_table, score, score_run, seconds_by_mode, write_summary
from schemas import Detection, Mode
from schemas.topics import FRAME, STATE
from tests.fake_run import CAMERA, MISSION, make_run, seen_detection, true_pose

CONSTANT = np.array([1e-3, 2e-3, -2e-3, 0.01, -0.02, 0.02, 0.1, 0, 0, 0, 0, 0.1])


def run_of(**kwargs) -> Run:
    return gather_run(MISSION, make_run(**kwargs))


def test_a_constant_error_is_its_own_rms():
    summary = score_run(run_of(error=lambda k: CONSTANT))
    assert summary.position_rms_m == pytest.approx(3e-3, rel=1e-9)
    assert summary.attitude_rms_rad == pytest.approx(0.03, rel=1e-9)
    assert summary.states_scored == summary.frames == 100
    assert summary.nees_mean == pytest.approx((9 + 900) / 6, rel=1e-6)
    assert summary.nees_12_mean == pytest.approx((9 + 900 + 2e4) / 12, rel=1e-6)


def test_a_proportional_error_is_its_own_fraction_of_range():
    frames = 60

    def error(k: int) -> np.ndarray:
        far = np.linalg.norm(true_pose(k, frames)[:3, 3])
        return np.concatenate([[4e-3 * far if far >= 0.5 else 1e-3], np.zeros(11)])

    bands = score_run(run_of(frames=frames, error=error)).bands
    assert bands is not None
    assert bands.beyond_0_5_m.position_rms_fraction == pytest.approx(4e-3, rel=1e-9)
    assert bands.below_0_5_m.position_rms_m == pytest.approx(1e-3, rel=1e-9)
    assert bands.below_0_5_m.states + bands.beyond_0_5_m.states == frames


@pytest.mark.parametrize("seed", [1, 2])
def test_errors_drawn_from_the_covariance_have_nees_near_one(seed):
    rng = np.random.default_rng(seed)
    sigma = np.array([1e-3, 1e-3, 5e-3, 0.02, 0.02, 5e-3] + [1e-2] * 6)
    summary = score_run(run_of(frames=400, error=lambda k: sigma * rng.standard_normal(12), sigma=lambda k: sigma))
    assert summary.nees_mean == pytest.approx(1, abs=4 * np.sqrt(2 / 6 / 400))
    assert summary.nees_12_mean == pytest.approx(1, abs=4 * np.sqrt(2 / 12 / 400))
    assert summary.covariances_invalid == 0


def test_only_states_that_claim_to_be_right_are_scored():
    """Ambiguous and lost states may be wrong; a coasting one may not."""
    modes = [Mode.INIT, Mode.AMBIGUOUS, Mode.TRACK, Mode.COAST, Mode.LOST]
    wrong = np.array([0, 0, 0, 0.6, 0, 0] + [0] * 6)
    summary = score_run(run_of(mode=lambda k: modes[k // 20], error=lambda k: wrong * (modes[k // 20] != Mode.TRACK)))
    assert summary.states_scored == 40
    assert summary.states_wrong == 20
    assert summary.modes == pytest.approx({mode.name: 1.0 for mode in Mode})
    assert [event.text for event in summary.events] == [f"mode {mode.name}" for mode in modes]


def test_a_state_is_judged_by_truth_of_its_own_time():
    """The filter answers a late frame with the state that it has already: that is no error."""
    run = run_of(frames=3)
    state, truth = run.rows[1].state, run.rows[2].truth
    assert state is not None and truth is not None
    assert state_error(truth, state) is None


def test_a_mode_lasts_until_the_next_state():
    seconds = seconds_by_mode([(0.0, Mode.TRACK), (0.1, Mode.COAST), (2.1, Mode.TRACK), (2.2, Mode.TRACK)])
    assert seconds["TRACK"] == pytest.approx(0.3)
    assert seconds["COAST"] == pytest.approx(2.0)


def test_an_identity_that_is_not_on_the_target_is_counted():
    def detect(k: int, T: np.ndarray) -> list[Detection]:
        found = [seen_detection(T)] if k != 5 else [seen_detection(T), seen_detection(T, marker_id=3)]
        return [d for d in found if d is not None]

    summary = score_run(run_of(detect=detect))
    assert summary.wrong_identities == 1
    assert summary.false_markers == 0


def test_a_marker_that_is_not_where_truth_says_is_counted():
    """The right id on another spot, and an inner layer taken for the outer one, are both false."""

    def detect(k: int, T: np.ndarray) -> list[Detection]:
        elsewhere = seen_detection(perturb(T, [0.03, 0, 0, 0, 0, 0]) if k == 5 else T)
        if elsewhere is None:
            return []
        if k == 9:
            middle = next(seen for seen in elsewhere.layers if seen.layer == 1)
            return [elsewhere.model_copy(update={"layers": [middle.model_copy(update={"layer": 0})]})]
        return [elsewhere]

    assert score_run(run_of(detect=detect)).false_markers == 2


def test_share_of_visible_frames_detected():
    summary = score_run(run_of(frames=100, detect=lambda k, T: [] if k % 4 == 0 else [seen_detection(T)]))
    assert summary.frames_visible == 100
    assert summary.frames_detected == 75
    assert summary.visible_detected == pytest.approx(0.75)


def test_the_outer_layer_leaves_the_picture_before_the_inner_ones():
    seen = [{e.layer for e in visible_layers(true_pose(k, 100), MISSION, CAMERA)} for k in (0, 99)]
    assert seen == [{0, 1, 2}, {2}]


def test_a_marker_seen_from_behind_is_not_visible():
    assert visible_layers(perturb(true_pose(0, 10), [0, 0, 0, 0, np.pi, 0]), MISSION, CAMERA) == []


def test_latency_drops_and_wall_time():
    lost = {(STATE, 10), (STATE, 11), (FRAME, 12), (STATE, 12)}
    kept = [(e, t) for e, t in make_run(frames=50) if (e.topic, e.stamp.sequence) not in lost]
    summary = score_run(gather_run(MISSION, kept))
    assert summary.dropped == 3
    assert summary.latency_ms.p50 == pytest.approx(8.0)
    assert summary.latency_ms.p99 == pytest.approx(8.0)
    assert summary.wall_s == pytest.approx(49 * 0.05 + 0.008)


def test_without_truth_only_what_needs_it_is_null():
    summary = score_run(run_of(truth=False))
    assert summary.position_rms_m is None
    assert summary.nees_mean is None
    assert summary.bands is None
    assert summary.frames_visible is None
    assert summary.false_markers is None
    assert summary.wrong_identities == 0
    assert summary.nis_mean == pytest.approx(1.0)
    assert summary.range_m.first == pytest.approx(1.5, abs=1e-3)


def test_a_covariance_that_is_always_zero_is_reported_not_trusted():
    summary = score_run(run_of(frames=10, sigma=lambda k: np.zeros(12)))
    assert summary.covariances_invalid == 10
    assert summary.nees_mean is None


def test_files_of_a_run(tmp_path: Path):
    """Scoring a file gives the numbers of the messages in it, and summary.json holds them under their names."""
    with RecordingWriter(tmp_path / "run.mcap", MISSION) as writer:
        for envelope, t_ns in make_run(frames=20, error=lambda k: CONSTANT):
            writer.write(envelope, t_ns)
    summary = score(tmp_path / "run.mcap")
    assert summary == score_run(run_of(frames=20, error=lambda k: CONSTANT))
    write_summary(summary, tmp_path / "summary.json")
    written = json.loads((tmp_path / "summary.json").read_text())
    asked = "frames frames_detected detections_by_layer range_m position_rms_m attitude_rms_rad nees_mean"
    assert {*asked.split(), "modes", "latency_ms", "dropped", "wall_s"} <= written.keys()
    assert written["detections_by_layer"].keys() == {"0", "1", "2"}


def test_a_recording_with_nothing_to_score_is_refused(tmp_path: Path):
    with RecordingWriter(tmp_path / "raw.mcap", MISSION) as writer:
        for envelope, t_ns in make_run(frames=3):
            if envelope.topic is FRAME:
                writer.write(envelope, t_ns)
    with pytest.raises(ValueError, match="replay it first"):
        score(tmp_path / "raw.mcap")


@pytest.mark.parametrize("truth", [True, False])
def test_the_table_fits_a_screen(truth):
    console = Console(file=io.StringIO(), width=100, height=40)
    print_table(score_run(run_of(truth=truth, error=lambda k: CONSTANT)), console)
    text = console.file.getvalue()
    assert ("3.00 mm" in text) == truth
    assert "marker in 100" in text
    assert len(text.splitlines()) < 30


def test_an_empty_run_has_a_summary():
    summary = score_run(gather_run(MISSION, []))
    assert summary.frames == summary.dropped == 0
    assert summary.latency_ms.p50 is None
