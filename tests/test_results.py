"""A run's folder and its parts: nothing that was recorded is lost."""

from pathlib import Path

import pytest

from nodes import recorder
from nodes.recorder import existing_parts, join_parts
from nodes.results import folder_for_results
from pipeline.mission import Mission
from pipeline.recording import RecordingError
from tests.small_recording import write_small_recording


def test_two_runs_do_not_write_to_one_folder(tmp_path: Path) -> None:
    with (
        folder_for_results(tmp_path, "x.mcap", overwrite=True),
        pytest.raises(ValueError, match="another run writes to"),
        folder_for_results(tmp_path, "x.mcap", overwrite=True),
    ):
        pass
    with folder_for_results(tmp_path, "x.mcap", overwrite=True):
        assert list(tmp_path.iterdir()) == []


def test_a_live_run_never_takes_the_place_of_an_earlier_one(tmp_path: Path) -> None:
    recording = write_small_recording(tmp_path / "run.mcap", frames=3)
    with (
        pytest.raises(ValueError, match="holds the recording of an earlier run"),
        folder_for_results(tmp_path, "/dev/video0", overwrite=False),
    ):
        pass
    assert recording.exists()
    with folder_for_results(tmp_path, "x.mcap", overwrite=True):
        assert not recording.exists()


def test_parts_that_cannot_be_joined_stay_where_they_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The disk is full when the second part is to be made whole."""
    write_small_recording(tmp_path / "run.mcap", frames=3)
    second = write_small_recording(tmp_path / "run.1.mcap", frames=3)
    whole = recorder.recover

    def recover(path: Path, out: Path) -> object:
        if path == second:
            raise RecordingError("cannot recover run.1.mcap: No space left on device")
        return whole(path, out)

    monkeypatch.setattr(recorder, "recover", recover)
    with pytest.raises(RecordingError, match="No space left"):
        join_parts(tmp_path, Mission())
    assert len(existing_parts(tmp_path)) == 2
