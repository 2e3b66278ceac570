"""The report draws whatever a run holds, and says so where it holds nothing."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline.recording import RecordingWriter
from pipeline.report import draw_report, write_report
from pipeline.run import gather_run
from pipeline.scoring import score, score_run
from schemas import Mode
from tests.fake_run import MISSION, make_run

NOISE = np.random.default_rng(3).standard_normal((200, 12)) * 1e-3

RUNS = {
    "truth": {"error": lambda k: NOISE[k]},
    "no truth": {"truth": False},
    "no detections": {"truth": False, "detect": lambda k, T: [], "mode": lambda k: Mode.INIT},
    "no error at all": {},
    "one frame": {"frames": 1},
    "a covariance of zero": {"sigma": lambda k: np.zeros(12)},
}


def texts_of(figure) -> set[str]:
    return {text.get_text() for ax in figure.axes for text in ax.texts}


@pytest.mark.parametrize("name", RUNS)
def test_draws(name, tmp_path: Path):
    run = gather_run(MISSION, make_run(**{"frames": 60, **RUNS[name]}))
    draw_report(run, score_run(run)).savefig(tmp_path / "report.png")
    picture = cv2.imread(str(tmp_path / "report.png"))
    assert picture.shape == (1210, 1650, 3)
    assert picture.std() > 10


def test_says_that_there_is_no_state():
    run = gather_run(MISSION, make_run(frames=20, **RUNS["no detections"]))
    assert {"no state", "no range"} <= texts_of(draw_report(run, score_run(run)))


def test_nothing_at_all_is_drawn_too(tmp_path: Path):
    run = gather_run(MISSION, [])
    draw_report(run, score_run(run)).savefig(tmp_path / "report.png")


def test_shades_each_mode_once():
    """Six stretches of time give six patches, however many frames they have."""
    modes = [Mode.INIT, Mode.AMBIGUOUS, Mode.TRACK, Mode.COAST, Mode.TRACK, Mode.LOST]
    run = gather_run(MISSION, make_run(frames=60, mode=lambda k: modes[k // 10]))
    strip = draw_report(run, score_run(run)).axes[0]
    assert len(strip.patches) == len(modes)
    assert strip.get_xlim() == pytest.approx((0.0, 3.0))


def test_of_a_file(tmp_path: Path):
    with RecordingWriter(tmp_path / "run.mcap", MISSION) as writer:
        for envelope, t_ns in make_run(frames=10):
            writer.write(envelope, t_ns)
    write_report(tmp_path / "run.mcap", score(tmp_path / "run.mcap"), tmp_path / "report.png")
    assert (tmp_path / "report.png").stat().st_size > 10_000
