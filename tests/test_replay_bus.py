"""One recording, three replays: over Zenoh by the command line, over Zenoh again, and direct: the same messages."""

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from astratag.camera import Camera
from nodes.processes import PROCESSES
from nodes.supervisor import Supervisor
from pipeline.convert import calibration_message
from pipeline.recording import Recording, RecordingWriter
from pipeline.replay import REPEATABLE, differences
from schemas import Envelope
from schemas.topics import CALIBRATION, DETECTIONS, FRAME, HEALTH, STATE, TRUTH
from tests.small_recording import CAMERA, plan, write_small_recording

FRAMES = 40


def relnav(*arguments: str | Path, timeout_s: float = 120.0) -> subprocess.CompletedProcess[str]:
    """Run the command line as a user does."""
    command = [sys.executable, "-m", "nodes", *map(str, arguments)]
    return subprocess.run(
        command, capture_output=True, text=True, timeout=timeout_s, env=os.environ | {"COLUMNS": "120"}, check=False
    )


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_small_recording(tmp_path_factory.mktemp("recording") / "small.mcap", frames=FRAMES)


@pytest.fixture(scope="module")
def by_command_line(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("command_line")
    done = relnav("replay", recording, "--out", out, "--view", "none", "--speed", "max")
    assert done.returncode == 0, done.stderr
    assert f"{FRAMES} frames" in done.stdout
    assert "try next" in done.stdout
    assert done.stderr == ""
    return out


def test_the_results_are_all_there(by_command_line: Path):
    names = {path.name for path in by_command_line.iterdir()}
    assert names == {"run.mcap", "run.rrd", "summary.json", "report.png"}
    summary = json.loads((by_command_line / "summary.json").read_text())
    assert (summary["frames"], summary["frames_detected"], summary["dropped"]) == (FRAMES, FRAMES, 0)


def test_nothing_is_lost(by_command_line: Path, recording: Path):
    """Every frame, truth, detections and state is recorded, once; what came from the source, byte for byte."""
    run, source = Recording(by_command_line / "run.mcap"), Recording(recording)
    for topic in (FRAME, TRUTH, DETECTIONS, STATE):
        sequences = [envelope.stamp.sequence for envelope, _ in run.envelopes([topic])]
        assert sorted(sequences) == list(range(FRAMES)), topic.name
    for topic in (CALIBRATION, FRAME, TRUTH):
        recorded = [envelope.payload for envelope, _ in run.envelopes([topic])]
        assert recorded == [envelope.payload for envelope, _ in source.envelopes([topic])], topic.name
    assert {health.node for health in run.messages(HEALTH)} >= {process.name for process in PROCESSES[:3]}


def test_two_replays_over_the_bus_are_identical(by_command_line: Path, recording: Path, tmp_path: Path):
    """The second without a viewer."""
    outcome = Supervisor(plan(recording, tmp_path, lossless=True, speed="max")).run()
    assert outcome.completed
    assert not outcome.died
    assert differences(by_command_line / "run.mcap", tmp_path / "run.mcap", REPEATABLE) == []


def test_a_direct_replay_is_identical(by_command_line: Path, recording: Path, tmp_path: Path):
    done = relnav("replay", recording, "--direct", "--out", tmp_path, "--view", "none")
    assert done.returncode == 0, done.stderr
    assert differences(by_command_line / "run.mcap", tmp_path / "run.mcap", REPEATABLE) == []


@pytest.mark.slow
def test_a_damaged_frame_and_a_calibration_that_changes_are_replayed_alike(recording: Path, tmp_path: Path):
    """Frame 10 is no message, and from frame 20 on the focal length is another: over the bus as direct."""
    odd = tmp_path / "odd.mcap"
    source = Recording(recording)
    with RecordingWriter(odd, source.mission) as writer:
        for envelope, t_ns in source.envelopes():
            if envelope.topic is TRUTH and envelope.stamp.sequence == 20:
                longer = Camera(CAMERA.K * np.array([[1.01], [1.01], [1.0]]), width=CAMERA.width, height=CAMERA.height)
                message = calibration_message(longer, frame_id="nav", t_capture_ns=envelope.stamp.t_capture_ns)
                writer.write(Envelope.wrap(message, envelope.stamp, vehicle="chaser", camera="nav"), t_ns)
            damaged = envelope.topic is FRAME and envelope.stamp.sequence == 10
            writer.write(replace(envelope, payload=b"\xff\xff\xff") if damaged else envelope, t_ns)
    bus = relnav("replay", odd, "--out", tmp_path / "bus", "--view", "none")
    direct = relnav("replay", odd, "--out", tmp_path / "direct", "--view", "none", "--direct")
    for done in (bus, direct):
        assert done.returncode == 0, done.stderr
        assert "detector refused frame 10" in done.stdout
    runs = [tmp_path / name / "run.mcap" for name in ("bus", "direct")]
    assert differences(*runs, REPEATABLE) == []
    assert len(list(Recording(runs[0]).messages(STATE))) == FRAMES
