"""Recordings: what goes in comes out, and what a kill, a full disk or a flipped bit leaves is made whole."""

import resource
import signal
import subprocess
import sys
import time
from collections.abc import Iterable
from dataclasses import replace
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import pytest
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf import descriptor_pool, message_factory
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from pipeline.mission import Mission
from pipeline.recording import MAGIC, Recording, RecordingError, RecordingWriter, recover
from schemas import Envelope, Mode, RelativeState, Stamp, decode
from schemas.codec import descriptor_of, file_descriptor_set
from schemas.topics import CALIBRATION, EVENTS, FRAME, STATE, TOPICS, TRUTH
from tests.small_run import MISSION, START_NS, image_message, run_envelopes, wrap, write_run

FRAMES = 20


def plain(recording: Recording) -> list[tuple[str, bytes, int, int, int]]:
    """Return everything that a recording says about its messages."""
    return [(e.key, e.payload, e.stamp.sequence, e.stamp.t_capture_ns, t) for e, t in recording.envelopes()]


def plain_of(envelopes: Iterable[tuple[Envelope, int]]) -> list[tuple[str, bytes, int, int, int]]:
    """Return what a recording of these envelopes must say."""
    return [
        (e.key, e.payload, e.stamp.sequence, e.stamp.t_capture_ns, e.stamp.t_origin_ns if e.topic is FRAME else t)
        for e, t in envelopes
    ]


@pytest.fixture
def run(tmp_path: Path) -> Path:
    return write_run(tmp_path / "run.mcap", run_envelopes(FRAMES))


def test_every_message_comes_back_byte_for_byte_in_order(run: Path) -> None:
    assert plain(Recording(run)) == plain_of(run_envelopes(FRAMES))


def test_knows_its_mission_calibration_and_counts(run: Path) -> None:
    recording = Recording(run)
    assert recording.mission == MISSION
    assert recording.calibration is not None
    assert recording.calibration.width == 160
    assert recording.frame_count == FRAMES
    assert recording.message_count == 4 * FRAMES + 2
    assert recording.topics()["relnav/probe/state"] == FRAMES
    assert recording.ignored == {}


def test_selects_topics(run: Path) -> None:
    recording = Recording(run)
    assert [s.t_capture_ns for s in recording.messages(STATE)] == [t.t_capture_ns for t in recording.messages(TRUTH)]
    assert {e.topic for e, _ in recording.envelopes((EVENTS, CALIBRATION))} == {EVENTS, CALIBRATION}


def test_log_time_is_receipt_and_for_frames_their_entry_into_the_pipeline(run: Path) -> None:
    recording = Recording(run)
    entered = {e.stamp.sequence: t for e, t in recording.envelopes((FRAME,))}
    received = {e.stamp.sequence: t for e, t in recording.envelopes((STATE,))}
    assert entered[3] == START_NS + 3 * 50_000_000 + 1_000
    assert {received[k] - entered[k] for k in range(FRAMES)} == {1_003}


def test_the_same_messages_give_the_same_file(run: Path, tmp_path: Path) -> None:
    again = write_run(tmp_path / "again.mcap", run_envelopes(FRAMES))
    assert again.read_bytes() == run.read_bytes()


def test_closing_twice_is_harmless(tmp_path: Path) -> None:
    writer = RecordingWriter(tmp_path / "run.mcap", MISSION)
    writer.close()
    writer.close()
    assert Recording(tmp_path / "run.mcap").message_count == 0
    assert recover(tmp_path / "run.mcap").whole


def test_a_file_without_a_mission_has_the_default_one(tmp_path: Path) -> None:
    path = foreign(tmp_path / "x.mcap", {"/image": [image_message(0)]})
    assert not Recording(path).has_mission
    assert Recording(path).mission == Mission()


def test_schemas_are_self_contained(run: Path) -> None:
    """The file alone is enough to decode it: a fresh pool reads our state from the recorded descriptors."""
    with run.open("rb") as file:
        rows = [(s, m.data) for s, c, m in make_reader(file).iter_messages() if c.topic.endswith("/state")]
    schema, data = rows[7]
    assert schema is not None
    assert (schema.name, schema.encoding) == ("relnav.RelativeState", "protobuf")
    pool = descriptor_pool.DescriptorPool()
    for described in FileDescriptorSet.FromString(schema.data).file:
        pool.Add(described)
    state = message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name)).FromString(data)
    assert state.T_chaser_target.translation_m.z == pytest.approx(1.43)


@pytest.mark.parametrize("topic", TOPICS, ids=lambda topic: topic.name)
def test_descriptor_sets_hold_all_imports_in_order(topic) -> None:
    known: set[str] = set()
    for described in FileDescriptorSet.FromString(file_descriptor_set(descriptor_of(topic.schema))).file:
        assert set(described.dependency) <= known
        known.add(described.name)
    assert descriptor_of(topic.schema).file.name in known


def test_rerun_finds_nothing_wrong(run: Path) -> None:
    rerun = Path(sys.executable).with_name("rerun")
    if not rerun.exists():
        pytest.skip(f"no {rerun}")
    checked = subprocess.run([rerun, "mcap", "check", run], capture_output=True, text=True, timeout=60)
    assert checked.returncode == 0, checked.stderr
    rows = [line for line in checked.stdout.splitlines() if "relnav/probe" in line]
    assert len(rows) == 6
    assert all(row.split()[0] == "ok" for row in rows)


RECORDER = """
import sys, time
from tests.small_run import MISSION, run_envelopes
from pipeline.recording import RecordingWriter
writer = RecordingWriter(sys.argv[1], MISSION)
for number, (envelope, t_ns) in enumerate(run_envelopes(100_000)):
    print(number, time.monotonic_ns(), flush=True)
    writer.write(envelope, t_ns)
    time.sleep(0.001)
"""


@pytest.mark.parametrize("life_s", [0.6, 1.1, 1.7])
def test_a_killed_recorder_loses_less_than_a_second(tmp_path: Path, life_s: float) -> None:
    path = tmp_path / "run.mcap"
    command = [sys.executable, "-c", RECORDER, str(path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=Path(__file__).parents[1]) as recorder:
        assert recorder.stdout is not None
        started = int(recorder.stdout.readline().split()[1])
        time.sleep(life_s)
        recorder.kill()
        written_ns = [started, *(int(line.split()[1]) for line in recorder.stdout if len(line.split()) == 2)]
    assert recorder.returncode == -signal.SIGKILL
    with pytest.raises(RecordingError, match="relnav recover"):
        Recording(path)
    report = recover(path)
    assert not report.whole
    lost_ns = written_ns[report.messages :]
    assert not lost_ns or lost_ns[-1] - lost_ns[0] < 1e9
    recovered = Recording(report.out)
    assert plain(recovered) == plain_of(islice(run_envelopes(100_000), report.messages))
    assert recovered.mission == MISSION


def test_any_truncation_recovers_a_prefix(run: Path, tmp_path: Path) -> None:
    """At every offset near the ends and at many between: a prefix of the messages, or nothing to recover."""
    data, whole = run.read_bytes(), plain(Recording(run))
    cut = tmp_path / "cut.mcap"
    offsets = {*range(0, 600, 7), *range(0, len(data), len(data) // 150), *range(len(data) - 300, len(data), 7)}
    longest = 0
    for offset in sorted(offsets):
        cut.write_bytes(data[:offset])
        with pytest.raises(RecordingError):
            Recording(cut)
        try:
            report = recover(cut)
        except RecordingError as error:
            assert longest == 0, f"lost at {offset}: {error}"
            continue
        recovered = Recording(report.out)
        assert plain(recovered) == whole[: report.messages], f"cut at {offset}"
        assert recovered.mission == MISSION
        assert report.messages >= longest
        assert report.lost_bytes > 0 or report.messages == len(whole)
        longest = report.messages
    assert longest == len(whole)


def test_says_what_to_do(run: Path) -> None:
    run.write_bytes(run.read_bytes()[:-5000])
    with pytest.raises(RecordingError, match=rf"truncated or still being written: run `relnav recover {run}`"):
        Recording(run)


def test_what_was_recovered_is_whole(run: Path) -> None:
    run.write_bytes(run.read_bytes()[:-5000])
    first = recover(run)
    assert first.out == run.with_suffix(".recovered.mcap")
    again = recover(first.out)
    assert again.whole
    assert (again.messages, again.lost_bytes, again.out) == (first.messages, 0, first.out)


def test_recovers_in_place(run: Path) -> None:
    run.write_bytes(run.read_bytes()[:-5000])
    assert recover(run, run).messages == Recording(run).message_count


def test_a_whole_file_is_left_alone(run: Path) -> None:
    before = run.read_bytes()
    report = recover(run)
    assert report.whole
    assert report.out == run
    assert report.messages == 4 * FRAMES + 2
    assert run.read_bytes() == before
    assert list(run.parent.iterdir()) == [run]


@pytest.mark.parametrize("seed", range(40))
def test_a_flipped_bit_never_passes_unnoticed(run: Path, seed: int) -> None:
    """One clear line when reading; recovery gives up the damaged chunk at most, and invents nothing."""
    rng = np.random.default_rng(seed)
    whole = plain(Recording(run))
    data = bytearray(run.read_bytes())
    data[rng.integers(len(data))] ^= 1 << rng.integers(8)
    run.write_bytes(data)
    with pytest.raises(RecordingError) as caught:
        plain(Recording(run))
    assert "\n" not in str(caught.value)
    recovered = plain(Recording(recover(run).out))
    assert set(recovered) <= set(whole)
    assert len(recovered) >= len(whole) - 20


def test_refuses_what_is_no_recording(tmp_path: Path) -> None:
    cases = {"absent.mcap": "no such recording", "empty.mcap": "is empty", "text.mcap": "is not an MCAP recording"}
    (tmp_path / "empty.mcap").touch()
    (tmp_path / "text.mcap").write_text("hello\n" * 100)
    (tmp_path / "folder.mcap").mkdir()
    for name, reason in {**cases, "folder.mcap": "cannot read"}.items():
        with pytest.raises(RecordingError, match=reason):
            Recording(tmp_path / name)
        with pytest.raises(RecordingError):
            recover(tmp_path / name)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["empty.mcap", "folder.mcap", "text.mcap"]


def test_nothing_but_magic(tmp_path: Path) -> None:
    for data in (MAGIC, MAGIC + MAGIC, MAGIC + bytes(40) + MAGIC):
        (tmp_path / "x.mcap").write_bytes(data)
        with pytest.raises(RecordingError):
            Recording(tmp_path / "x.mcap")
        with pytest.raises(RecordingError, match="nothing to recover"):
            recover(tmp_path / "x.mcap")


def test_one_clear_error_and_no_second_one() -> None:
    if not Path("/dev/full").exists():
        pytest.skip("no /dev/full")
    with pytest.raises(RecordingError, match="cannot write /dev/full: No space left on device"):
        RecordingWriter("/dev/full", MISSION)


def test_what_was_written_stays_readable(tmp_path: Path) -> None:
    """The recorder meets a limit on the size of files, as if the disk were full."""
    limit = 100_000
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    writer = RecordingWriter(tmp_path / "run.mcap", MISSION)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, before[1]))
        with pytest.raises(RecordingError, match="What was written until then is kept: run `relnav recover"):
            for envelope, t_ns in run_envelopes(200):
                writer.write(envelope, t_ns)
                writer.flush()
        with pytest.raises(RecordingError):
            writer.flush()
        writer.close()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    report = recover(tmp_path / "run.mcap")
    assert report.messages > 10
    assert plain(Recording(report.out))[:11] == plain_of(run_envelopes(200))[:11]


def test_a_folder_that_does_not_exist(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="No such file or directory"):
        RecordingWriter(tmp_path / "no" / "run.mcap", MISSION)


def foreign(path: Path, topics: dict[str, list], **options) -> Path:
    """Write a recording as another program would: own topic names, no mission, zero sequence numbers."""
    with path.open("wb") as file:
        writer = Writer(file, **options)
        writer.start()
        for topic, messages in topics.items():
            descriptor = type(messages[0]).DESCRIPTOR
            schema = writer.register_schema(descriptor.full_name, "protobuf", file_descriptor_set(descriptor))
            channel = writer.register_channel(topic, "protobuf", schema)
            for k, message in enumerate(messages):
                writer.add_message(channel, START_NS + k, message.SerializeToString(), START_NS + k)
        writer.finish()
    return path


@pytest.mark.parametrize(
    "options",
    [{}, {"compression": CompressionType.LZ4}, {"use_chunking": False}, {"chunk_size": 1}],
    ids=["zstd", "lz4", "unchunked", "tiny chunks"],
)
def test_the_only_images_are_the_frames(tmp_path: Path, options: dict) -> None:
    images = [image_message(k) for k in range(5)]
    calibration = CameraCalibration(frame_id="cam", width=160, height=120)
    path = foreign(tmp_path / "x.mcap", {"/cam/image": images, "/cam/info": [calibration]}, **options)
    recording = Recording(path)
    assert recording.frame_count == 5
    assert recording.ignored == {}
    assert recording.calibration == calibration
    frames = [e for e, _ in recording.envelopes((FRAME,))]
    assert [e.payload for e in frames] == [image.SerializeToString() for image in images]
    assert [e.stamp for e in frames] == [Stamp(k, i.timestamp.ToNanoseconds(), 0) for k, i in enumerate(images)]
    assert {e.key for e in frames} == {"relnav/chaser/camera/nav/frame"}


def test_two_topics_of_images_are_not_guessed_at(tmp_path: Path) -> None:
    recording = Recording(foreign(tmp_path / "x.mcap", {"/a": [image_message(0)], "/b": [image_message(1)]}))
    assert recording.frame_count == 0
    assert recording.ignored == {"/a": 1, "/b": 1}


def test_our_own_frames_come_first(tmp_path: Path) -> None:
    own = foreign(tmp_path / "x.mcap", {"/a": [image_message(0)], "relnav/p/camera/c/frame": [image_message(1)]})
    recording = Recording(own)
    assert recording.frame_keys == ["relnav/p/camera/c/frame"]
    assert recording.ignored == {"/a": 1}


def test_our_name_with_another_schema_is_ignored(tmp_path: Path) -> None:
    recording = Recording(foreign(tmp_path / "x.mcap", {"relnav/p/state": [CameraCalibration()]}))
    assert STATE not in {e.topic for e, _ in recording.envelopes()}


@pytest.mark.parametrize(("encoding", "channels"), [("mono8", 1), ("rgb8", 3), ("bgr8", 3), ("bgra8", 4)])
def test_raw_images_become_png(tmp_path: Path, encoding: str, channels: int) -> None:
    pixels = np.random.default_rng(0).integers(0, 255, (12, 20, channels), dtype=np.uint8)
    padded = np.concatenate([pixels.reshape(12, -1), np.zeros((12, 5), np.uint8)], axis=1)
    raw = RawImage(width=20, height=12, encoding=encoding, step=padded.shape[1], data=padded.tobytes())
    raw.timestamp.FromNanoseconds(77)
    recording = Recording(foreign(tmp_path / "x.mcap", {"/image": [raw]}))
    ((envelope, _),) = recording.envelopes((FRAME,))
    image = decode(CompressedImage, envelope.payload)
    assert (envelope.stamp.t_capture_ns, image.format) == (77, "png")
    read = cv2.imdecode(np.frombuffer(image.data, np.uint8), cv2.IMREAD_UNCHANGED).reshape(12, 20, -1)
    expected = pixels[:, :, ::-1] if encoding == "rgb8" else pixels[:, :, :3]
    np.testing.assert_array_equal(read, expected)


@pytest.mark.parametrize(
    ("raw", "reason"),
    [
        (RawImage(width=4, height=4, encoding="16UC1", step=8, data=bytes(32)), "encoding '16UC1'"),
        (
            RawImage(width=4, height=4, encoding="mono8", step=4, data=bytes(15)),
            "15 bytes are no mono8 image of 4x4",
        ),
    ],
)
def test_raw_images_that_cannot_be_read(tmp_path: Path, raw: RawImage, reason: str) -> None:
    recording = Recording(foreign(tmp_path / "x.mcap", {"/image": [raw]}))
    with pytest.raises(RecordingError, match=f"/image: .*{reason}"):
        list(recording.envelopes())


def test_a_file_without_summary_is_recovered(tmp_path: Path) -> None:
    bare = {"use_statistics": False, "repeat_channels": False, "repeat_schemas": False}
    path = foreign(tmp_path / "x.mcap", {"/image": [image_message(0)]}, **bare)
    with pytest.raises(RecordingError, match="no summary: run `relnav recover"):
        Recording(path)
    assert Recording(recover(path).out).frame_count == 1


@pytest.mark.parametrize("compression", list(CompressionType))
def test_recovery_keeps_what_it_does_not_know(tmp_path: Path, compression: CompressionType) -> None:
    path = foreign(tmp_path / "x.mcap", {"/a": [image_message(0)], "/b": [image_message(1)]}, compression=compression)
    path.write_bytes(path.read_bytes()[:-20])
    assert Recording(recover(path).out).ignored == {"/a": 1, "/b": 1}


def test_messages_of_topics_that_are_not_recorded_stay_out(tmp_path: Path) -> None:
    envelope = wrap(RelativeState(t_capture_ns=1, mode=Mode.INIT), Stamp(0, 1, 1))
    with RecordingWriter(tmp_path / "x.mcap", MISSION) as writer:
        writer.write(replace(envelope, topic=replace(STATE, recorded=False)), 1)
    assert Recording(tmp_path / "x.mcap").message_count == 0


@pytest.mark.parametrize("stamp", [Stamp(-1, 1, 1), Stamp(2**32, 1, 1), Stamp(0, -1, 1)])
def test_a_stamp_that_cannot_be_recorded_is_refused_and_harms_nothing(tmp_path: Path, stamp: Stamp) -> None:
    state = RelativeState(t_capture_ns=1, mode=Mode.INIT)
    with RecordingWriter(tmp_path / "x.mcap", MISSION) as writer:
        writer.write(wrap(state, Stamp(0, 1, 1)), 1)
        with pytest.raises(ValueError, match=r"cannot record relnav/probe/state: .* is out of MCAP's range"):
            writer.write(wrap(state, stamp), 1)
        writer.write(wrap(state, Stamp(1, 2, 2)), 2)
    assert [row[2] for row in plain(Recording(tmp_path / "x.mcap"))] == [0, 1]


def test_a_foreign_image_without_a_stamp_is_given_the_time_of_its_publication(tmp_path: Path) -> None:
    """In its message as in its envelope, for the filter goes by the message."""
    bare = CompressedImage(frame_id="cam", format="jpeg", data=image_message(0).data)
    recording = Recording(foreign(tmp_path / "x.mcap", {"/cam/image": [bare]}))
    ((envelope, _),) = recording.envelopes([FRAME])
    assert envelope.stamp.t_capture_ns > 0
    assert envelope.message().timestamp.ToNanoseconds() == envelope.stamp.t_capture_ns
