"""``relnav export``: every state of a recording comes out, in each kind of file."""

import csv
from pathlib import Path

import ccsds_ndm
import numpy as np
import pytest
from pyarrow import parquet

from nodes.cli import main
from pipeline.adapters.table import Recorded, row
from pipeline.recording import RecordingWriter
from schemas import Envelope, Mode, Stamp
from schemas.codec import AnyMessage
from tests.fake_run import MISSION, make_run
from tests.some_states import some_state

MODES = [Mode.INIT, Mode.AMBIGUOUS, *[Mode.TRACK] * 5, Mode.COAST, Mode.TRACK, Mode.TRACK, Mode.LOST]


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("run") / "run.mcap"
    with RecordingWriter(path, MISSION) as writer:
        for envelope, t_receipt_ns in make_run(len(MODES), mode=lambda k: MODES[k]):
            writer.write(envelope, t_receipt_ns)
    return path


def exported(recording: Path, out: Path, *more: str) -> Path:
    assert main(["export", str(recording), str(out), *more]) == 0
    return out


def test_csv_has_a_row_for_every_state(recording, tmp_path, capsys):
    path = exported(recording, tmp_path / "new" / "states.csv")
    assert capsys.readouterr().out == f"{path}: 11 of 11 states\n"
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [one["mode"] for one in rows] == [mode.name for mode in MODES]
    assert [one["valid"] for one in rows] == [str(int(mode == Mode.TRACK)) for mode in MODES]
    assert [int(one["sequence"]) for one in rows] == list(range(len(MODES)))
    assert rows[0]["translation_x_m"] == "" and float(rows[3]["translation_z_m"]) > 0
    stamps = [int(one["t_capture_ns"]) for one in rows]
    assert np.diff(stamps).tolist() == [50_000_000] * 10, "nanoseconds survive"


def test_parquet_has_the_same_columns_and_types(recording, tmp_path):
    table = parquet.read_table(exported(recording, tmp_path / "states.parquet"))
    with exported(recording, tmp_path / "states.csv").open(newline="") as file:
        reader = csv.DictReader(file)
        assert table.column_names == reader.fieldnames
        first = [one["translation_x_m"] for one in reader]
    assert ["" if x is None else repr(x) for x in table["translation_x_m"].to_pylist()] == first
    types = {str(table.schema.field(name).type) for name in table.column_names if name.endswith(("_m", "_rad", "_s"))}
    assert types == {"double"}
    assert str(table.schema.field("t_capture_ns").type) == "int64"


def test_columns_hold_what_they_are_named_after():
    state = some_state()
    cells = row(Recorded(state, 5, 7))
    assert (cells["sequence"], cells["t_receipt_ns"], cells["valid"]) == (5, 7, True)
    assert cells["rotation_w"] == state.T_chaser_target.rotation_wxyz.w
    assert cells["omega_chaser_target_in_target_y_rad_s"] == state.omega_chaser_target_in_target_rad_s.y
    covariance = np.array(state.covariance).reshape(12, 12)
    assert cells["sigma_v_z_m_s"] == pytest.approx(covariance[8, 8] ** 0.5)
    assert cells["sigma_omega_x_rad_s"] == pytest.approx(covariance[9, 9] ** 0.5)
    spread = sum(cells[f"sigma_position_{axis}_m"] ** 2 for axis in "xyz")
    assert spread == pytest.approx(np.trace(covariance[:3, :3])), "turned, not changed"
    assert (cells["marker_ids"], cells["port_closing_speed_m_s"]) == ("7 7", 0.05)


def test_all_states_have_the_same_columns():
    bare = row(Recorded(some_state(Mode.INIT, numbers=False), 0, 0))
    assert list(bare) == list(row(Recorded(some_state(), 0, 0)))
    assert bare["sigma_position_x_m"] is None and bare["rejections"] == "pose: none"


@pytest.mark.parametrize("kind", ["oem", "aem"])
def test_ccsds_files_hold_the_tracked_states(recording, tmp_path, capsys, kind):
    path = exported(recording, tmp_path / f"states.{kind}", "--target", "CLIENT")
    assert capsys.readouterr().out == f"{path}: 7 of 11 states\n"
    message = ccsds_ndm.from_file(str(path))
    assert [segment.metadata.object_name for segment in message.segments] == ["CLIENT"] * 2


def refusal(capsys, *arguments: str | Path) -> str:
    assert main(["export", *map(str, arguments)]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    return line


def test_what_cannot_be_exported_is_refused_and_leaves_the_old_file(recording, tmp_path, capsys):
    out = tmp_path / "states.txt"
    assert "say --as csv, parquet, oem, aem" in refusal(capsys, recording, out)
    assert "no such recording" in refusal(capsys, tmp_path / "gone.mcap", out, "--as", "csv")
    out.write_text("old")
    for name, keep in (("empty", lambda message: False), ("lost", lambda message: message.mode == Mode.LOST)):
        path = write_states(tmp_path / f"{name}.mcap", keep)
        expected = "holds no relative states" if name == "empty" else "no state is in TRACK"
        assert expected in refusal(capsys, path, out, "--as", "oem")
        assert out.read_text() == "old"
    assert not list(tmp_path.glob("*.part"))


def write_states(path: Path, keep) -> Path:
    """Record the calibration of a run and the states that are wanted."""
    with RecordingWriter(path, MISSION) as writer:
        for envelope, t_receipt_ns in make_run(len(MODES), mode=lambda k: MODES[k]):
            message: AnyMessage = envelope.message()
            if envelope.topic.name == "calibration" or (envelope.topic.name == "state" and keep(message)):
                writer.write(envelope, t_receipt_ns)
    return path


def test_a_state_s_stamps_are_the_recording_s(tmp_path):
    path = tmp_path / "one.mcap"
    with RecordingWriter(path, MISSION) as writer:
        writer.write(Envelope.wrap(some_state(), Stamp(42, some_state().t_capture_ns, 0), vehicle="chaser"), 1_234)
    with exported(path, tmp_path / "one.csv").open(newline="") as file:
        (only,) = csv.DictReader(file)
    assert (only["sequence"], only["t_receipt_ns"], only["t_capture_ns"]) == ("42", "1234", "1800000000123456789")
