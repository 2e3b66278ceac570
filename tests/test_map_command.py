"""``relnav map`` on pictures: a recording of three markers in, a mission out that the same recording is flown with."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from astratag.transforms import difference, exp_so3, pose
from nodes.cli import main
from pipeline.mapping.estimate import pose_section
from pipeline.mission import CylinderSection, MarkerSection, Mission, PoseSection
from pipeline.recording import Recording, RecordingWriter
from pipeline.scenario import Approach
from pipeline.sim_camera import SimCameraSection
from pipeline.sim_source import SIM_MISSION, SimScenario, SimSource
from schemas.topics import DETECTIONS
from tests.test_cli import refusal

MARKERS = (
    MarkerSection(id=7, side_m=0.1, T_target_marker=PoseSection(translation_m=(0.0, 0.0, 0.1))),
    MarkerSection(id=3, side_m=0.06, T_target_marker=pose_section(pose(exp_so3([0, -0.35, 0]), [-0.16, 0.02, 0.08]))),
    MarkerSection(
        id=11,
        side_m=0.08,
        surface=CylinderSection(radius_m=0.15),
        T_target_marker=pose_section(pose(exp_so3([0.2, 0.4, 0.1]), [0.20, -0.02, 0.06])),
    ),
)
BLIND = (MARKERS[0], *(m.model_copy(update={"T_target_marker": PoseSection()}) for m in MARKERS[1:]))
"""What is known beforehand: sides, surfaces, and where the first one is."""
SCENARIO = SimScenario(
    mission=SIM_MISSION.model_copy(update={"markers": MARKERS}),
    approach=Approach(
        duration_s=4.0,
        start_m=0.85,
        end_m=0.5,
        end_speed_m_s=0.085,
        sway_rad=(0.02, 0.02),
        tumble_rad=(0.4, 0.4, 0.1),
        tumble_period_s=(28.0, 32.0, 25.0),
    ),
    camera=SimCameraSection(width_px=800, height_px=600, focal_px=900.0, rate_hz=10.0),
)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Frames and truth, with a mission that has the markers' sides and surfaces, all at one place."""
    path = tmp_path_factory.mktemp("map") / "three.mcap"
    source = SimSource(SCENARIO, paced=False)
    with RecordingWriter(path, SCENARIO.mission.model_copy(update={"markers": BLIND})) as writer:
        for envelope in source.envelopes():
            writer.write(envelope, envelope.stamp.t_capture_ns)
    return path


@pytest.fixture(scope="module")
def mapped(recording: Path) -> Path:
    out = recording.with_name("mission.yaml")
    assert main(["map", str(recording), "--out", str(out)]) == 0
    return out


def test_the_map_is_true_within_its_covariance(mapped: Path):
    mission, details = Mission.load(mapped), json.loads(mapped.with_suffix(".map.json").read_text())
    assert mission.marker(7) == MARKERS[0]
    for true, found in zip(MARKERS[1:], details["markers"][1:], strict=True):
        marker = mission.marker(true.id)
        assert marker is not None and found["id"] == true.id
        error = difference(true.T_target_marker.matrix(), marker.T_target_marker.matrix())
        covariance = np.array(found["covariance"])
        print(true.id, error, error @ np.linalg.solve(covariance, error) / 6)
        assert np.linalg.norm(error[:3]) < 1.5e-4
        assert np.linalg.norm(error[3:]) < np.radians(0.1)
        assert error @ np.linalg.solve(covariance, error) / 6 < 3.0
    assert mapped.with_suffix(".map.png").stat().st_size > 10_000
    assert "# Marker 7 is the reference" in mapped.read_text()


def test_the_recording_is_flown_with_its_map(mapped: Path, recording: Path, tmp_path: Path):
    """No marker is refused for where it is: with the map all three carry the state; detections are then recorded."""
    arguments = ["replay", str(recording), "--mission", str(mapped), "--direct", "--view", "none"]
    assert main([*arguments, "--out", str(tmp_path)]) == 0
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["position_rms_m"] < 1.5e-3
    assert summary["states_wrong"] == 0
    assert sum(summary["rejections"].values()) < 0.1 * sum(summary["detections_by_layer"].values())

    run = tmp_path / "run.mcap"
    assert Recording(run).topics()[DETECTIONS.key(vehicle="chaser", camera="nav")] > 0
    assert main(["map", str(run), "--reference", "3", "--out", str(tmp_path / "again.yaml")]) == 0
    first, again = Mission.load(mapped), Mission.load(tmp_path / "again.yaml")
    for marker in first.markers:
        same = again.marker(marker.id)
        assert same is not None
        apart = difference(marker.T_target_marker.matrix(), same.T_target_marker.matrix())
        assert np.abs(apart).max() < 1e-3


def test_nothing_is_overwritten_unless_asked(mapped: Path, recording: Path, capsys: pytest.CaptureFixture[str]):
    before = mapped.read_bytes()
    assert "exists: choose another file with --out, or say --overwrite" in refusal(
        capsys, "map", recording, "--out", mapped
    )
    assert mapped.read_bytes() == before
    assert main(["map", str(recording), "--out", str(mapped), "--overwrite", "--views", "20"]) == 0
    assert "20 of" in capsys.readouterr().out


def test_what_cannot_be_mapped_is_one_line(recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    out = tmp_path / "mission.yaml"
    assert "no such recording" in refusal(capsys, "map", tmp_path / "gone.mcap", "--out", out)
    (tmp_path / "notes.txt").write_text("no recording")
    refusal(capsys, "map", tmp_path / "notes.txt", "--out", out)
    assert "wanted are" in refusal(capsys, "map", recording, "--out", out, "--within-sides", "1e-5")
    more = tmp_path / "more.yaml"
    more.write_text("markers: [{id: 7}, {id: 3, side_m: 0.06}, {id: 5}]\n")
    assert main(["map", str(recording), "--mission", str(more), "--out", str(out)]) == 1
    *warnings, error = capsys.readouterr().err.splitlines()
    assert all("warning: marker 11, seen in" in warning for warning in warnings)
    assert "marker 5 is never seen together with any other" in error
    assert not out.exists()
