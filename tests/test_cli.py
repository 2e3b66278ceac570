"""The command line as scripts see it: exit codes, one line on standard error, files where they were asked for."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from astratag.dictionary import load_dictionary
from nodes.cli import main
from nodes.run import SHIPPED_RECORDING
from pipeline.convert import calibration_message
from pipeline.recording import Recording, RecordingWriter, recover
from schemas import Envelope, Stamp
from schemas.topics import FRAME
from tests.small_recording import CAMERA, MISSION, write_small_recording

COMMANDS = ("replay", "live", "detect", "marker", "dictionary", "map", "score", "recover", "export", "doctor", "node")


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_small_recording(tmp_path_factory.mktemp("recording") / "small.mcap", frames=20)


@pytest.fixture
def truncated(recording: Path, tmp_path: Path) -> Path:
    path = tmp_path / "truncated.mcap"
    path.write_bytes(recording.read_bytes()[:-5000])
    return path


def refusal(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> str:
    """Return the one line with which a command that cannot do its job ends."""
    assert main([str(argument) for argument in arguments]) == 1
    captured = capsys.readouterr()
    lines = captured.err.splitlines()
    assert len(lines) == 1, captured.err
    assert lines[0].startswith("relnav: error: ")
    return lines[0].removeprefix("relnav: error: ")


@pytest.mark.parametrize("arguments", [[], *([command] for command in COMMANDS)], ids=["relnav", *COMMANDS])
def test_help_explains_with_an_example(arguments, capsys):
    with pytest.raises(SystemExit) as stopped:
        main([*arguments, "--help"])
    assert stopped.value.code == 0
    text = capsys.readouterr().out
    assert (f"relnav {arguments[0]}" in text.split("example")[1]) if arguments else all(c in text for c in COMMANDS)


def test_help_needs_no_library_of_ours():
    """Help comes at once: nothing heavy is imported for it."""
    code = "import sys, nodes.cli; nodes.cli._parser(); print(sorted({'numpy', 'cv2', 'zenoh'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize(
    "arguments",
    [["nonsense"], ["live"], ["replay", "--speed", "0"], ["replay", "--view", "cinema"], ["detect"], ["marker", "x"]],
    ids=" ".join,
)
def test_a_wrong_usage_is_one_line_and_exit_2(arguments, capsys):
    with pytest.raises(SystemExit) as stopped:
        main(arguments)
    assert stopped.value.code == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_a_recording_that_does_not_exist(capsys, tmp_path):
    assert "no such recording" in refusal(capsys, "replay", tmp_path / "gone.mcap")


def test_a_truncated_recording_is_refused_and_recovered(capsys, truncated, tmp_path):
    assert f"run `relnav recover {truncated}`" in refusal(capsys, "replay", truncated, "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()
    assert main(["recover", str(truncated), "--out", str(tmp_path / "whole.mcap")]) == 0
    assert Recording(tmp_path / "whole.mcap").frame_count > 0


def test_a_recording_without_frames(capsys, tmp_path):
    path = tmp_path / "no_frames.mcap"
    with RecordingWriter(path, MISSION) as writer:
        calibration = calibration_message(CAMERA, frame_id="nav", t_capture_ns=1)
        writer.write(Envelope.wrap(calibration, Stamp(0, 1, 0), vehicle="chaser", camera="nav"), 1)
    assert "no camera frames" in refusal(capsys, "replay", path, "--out", tmp_path / "out")


def test_a_recording_without_calibration(capsys, recording, tmp_path):
    path = tmp_path / "no_calibration.mcap"
    with RecordingWriter(path, MISSION) as writer:
        for envelope, t_ns in Recording(recording).envelopes([FRAME]):
            writer.write(envelope, t_ns)
    assert "no camera calibration" in refusal(capsys, "replay", path, "--out", tmp_path / "out")


def test_a_calibration_of_another_size(capsys, recording, tmp_path):
    camera = tmp_path / "camera.json"
    matrix = [[900, 0, 640], [0, 900, 360], [0, 0, 1]]
    camera.write_text(
        json.dumps({"camera_matrix": matrix, "distortion_coefficients": [0] * 5, "width": 1280, "height": 720})
    )
    assert "1280x720" in refusal(capsys, "replay", recording, "--camera", camera, "--out", tmp_path / "out")


def test_an_unknown_dictionary(capsys, recording, tmp_path):
    mission = tmp_path / "mission.yaml"
    mission.write_text("dictionary: runes\n")
    assert "runes" in refusal(capsys, "detect", recording, "--dictionary", "runes")
    assert "runes" in refusal(capsys, "marker", "1", "--family", "runes", "--out", tmp_path)
    assert "runes" in refusal(capsys, "replay", recording, "--mission", mission, "--out", tmp_path / "out")


def test_an_unknown_marker(capsys, tmp_path):
    assert "marker 99 is not in dictionary" in refusal(capsys, "marker", "99", "--out", tmp_path)


def test_a_bus_port_in_use(capsys, recording, tmp_path):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        endpoint = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
        line = refusal(capsys, "live", "--source", recording, "--listen", endpoint, "--view", "none", "--out", tmp_path)
    assert f"cannot listen on {endpoint}: is the port in use?" in line


def test_a_web_port_in_use(capsys, recording, tmp_path):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = str(taken.getsockname()[1])
        line = refusal(capsys, "replay", recording, "--view", "web", "--web-port", port, "--out", tmp_path)
    assert f"port {port} is in use" in line


def test_a_replay_never_overwrites_what_it_replays(capsys, recording, tmp_path):
    """`relnav replay out/run.mcap --out out` would delete its own input first."""
    own = tmp_path / "run.mcap"
    own.write_bytes(recording.read_bytes())
    assert "would be overwritten" in refusal(capsys, "replay", own, "--out", tmp_path)
    assert recover(own).whole


def test_an_unwritable_folder_for_the_results(capsys, recording, tmp_path):
    (tmp_path / "file").write_text("")
    assert "cannot write to" in refusal(capsys, "replay", recording, "--out", tmp_path / "file" / "out")


def test_a_camera_is_not_replayed(capsys, recording, monkeypatch):
    monkeypatch.setattr("pipeline.sources.RecordingSource.live", True)
    assert "use `relnav live" in refusal(capsys, "replay", recording)


def test_a_run_that_was_not_scored_yet(capsys, recording):
    assert "replay it first" in refusal(capsys, "score", recording)


def test_markers_are_written_and_listed(capsys, tmp_path):
    assert main(["marker", "0", "7", "--side-mm", "80", "--format", "svg", "--out", str(tmp_path)]) == 0
    paths = [Path(line) for line in capsys.readouterr().out.splitlines()]
    assert [path.name for path in paths] == ["astratag20_00_80mm.svg", "astratag20_07_80mm.svg"]
    assert all(path.stat().st_size > 0 for path in paths)


def test_a_marker_of_another_geometry_says_so_in_its_name(capsys, tmp_path):
    assert main(["marker", "7", "--layers", "2", "--contraction", "0.6", "--out", str(tmp_path)]) == 0
    assert Path(capsys.readouterr().out.strip()).name == "astratag20_07_100mm_contraction0.6_layers2.svg"
    assert "9 layers with a border of" in refusal(capsys, "marker", "7", "--layers", "9", "--out", tmp_path)


def test_chosen_identities_are_written_as_a_dictionary(capsys, tmp_path):
    fleet = tmp_path / "fleet.json"
    assert main(["dictionary", "astratag48h16", "--count", "20", "--out", str(fleet)]) == 0
    assert "20 identities" in capsys.readouterr().out
    assert len(load_dictionary(fleet)) == 20
    assert "1008" in refusal(capsys, "dictionary", "astratag48h16", "--count", "2000", "--out", fleet)


def test_detections_are_listed_and_written_as_json(capsys, recording, tmp_path):
    picture = tmp_path / "frame.jpg"
    picture.write_bytes(next(iter(Recording(recording).messages(FRAME))).data)
    broken = tmp_path / "broken.png"
    broken.write_bytes(b"not a picture")
    found = tmp_path / "found.json"
    assert main(["detect", str(picture), str(broken), "--json", str(found), "--annotate", str(tmp_path / "drawn")]) == 0
    captured = capsys.readouterr()
    assert f"{picture}: astratag20 7 (layers 0" in captured.out
    assert captured.err.startswith(f"relnav: warning: skipped {broken}")
    (image,) = json.loads(found.read_text())["images"]
    assert {"path", "width", "height", "seconds", "detections"} <= image.keys()
    (detection,) = image["detections"]
    assert detection["marker_id"] == 7
    assert np.shape(detection["corners_px"]) == (4, 2)
    (drawn,) = (tmp_path / "drawn").iterdir()
    assert cv2.imread(str(drawn)).shape == (CAMERA.height, CAMERA.width, 3)


def test_a_replay_in_this_process(capsys, recording, tmp_path):
    assert main(["replay", str(recording), "--direct", "--view", "none", "--out", str(tmp_path)]) == 0
    assert {path.name for path in tmp_path.iterdir()} == {"run.mcap", "run.rrd", "summary.json", "report.png"}
    assert main(["score", str(tmp_path / "run.mcap")]) == 0
    assert "latency" in capsys.readouterr().out


def test_the_doctor_finds_nothing_wrong(capsys):
    code = main(["doctor"])
    captured = capsys.readouterr()
    assert "two sessions met" in captured.out
    assert code == (0 if SHIPPED_RECORDING.exists() else 1), captured.out


@pytest.mark.slow
def test_ctrl_c_keeps_what_was_recorded(recording, tmp_path):
    """At a twentieth of real time: interrupted after the first frames, exit 130, recording and score are whole."""
    command = [sys.executable, "-m", "nodes", "replay", str(recording), "--speed", "0.05", "--view", "none"]
    process = subprocess.Popen(
        [*command, "--out", str(tmp_path)], stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True
    )
    run = tmp_path / "run.mcap"
    deadline_s = time.monotonic() + 60
    while not (run.exists() and run.stat().st_size > 100_000):
        assert time.monotonic() < deadline_s
        time.sleep(0.1)
    os.kill(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 130
    assert errors == "relnav: error: interrupted; what was recorded until then is kept\n"
    assert recover(run).whole
    assert json.loads((tmp_path / "summary.json").read_text())["frames"] > 0
