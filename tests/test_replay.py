"""Direct replay: the order of messages, what is refused, and that two replays are identical byte for byte."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import pytest
from foxglove_schemas_protobuf.Log_pb2 import Log

from pipeline.mission import Mission
from pipeline.recording import Recording, RecordingWriter
from pipeline.replay import differences, first_difference, paced, replay_direct
from pipeline.sources import open_source
from pipeline.steps import StepSpec
from schemas import Detections, Envelope, Mode, RelativeState
from schemas.codec import AnyMessage
from schemas.topics import CALIBRATION, DETECTIONS, EVENTS, FRAME, STATE, TRUTH
from tests.small_run import MISSION, PERIOD_NS, run_envelopes, wrap, write_run

FRAMES = 6


class StubDetector:
    """Says the size of each image; refuses images below 100 bytes."""

    def __init__(self, mission: Mission):
        self._camera = mission.camera.name
        self._width_px = 0

    def step(self, message: AnyMessage) -> Iterable[AnyMessage]:
        """Take a calibration or a frame."""
        if hasattr(message, "K"):
            self._width_px = message.width
            return
        if len(message.data) < 100:
            raise ValueError("no image")
        t_ns = message.timestamp.ToNanoseconds()
        yield Detections(t_capture_ns=t_ns, camera=self._camera, width_px=self._width_px, height_px=1, detections=[])

    def refused(self, t_capture_ns: int) -> Iterable[AnyMessage]:
        """Say that nothing was seen."""
        yield Detections(t_capture_ns=t_capture_ns, camera=self._camera, width_px=0, height_px=0, detections=[])


class StubFilter:
    """Counts detections; logs the first."""

    def __init__(self, mission: Mission):
        self._count = 0

    def step(self, message: AnyMessage) -> Iterable[AnyMessage]:
        """Take detections."""
        self._count += 1
        yield RelativeState(t_capture_ns=message.t_capture_ns, mode=Mode.TRACK, nis=float(self._count))
        if self._count == 1:
            yield Log(level=Log.INFO, message="acquired")

    def refused(self, t_capture_ns: int) -> Iterable[AnyMessage]:
        """Say nothing."""
        return []


STUBS = (
    StepSpec("detector", (CALIBRATION, FRAME), (DETECTIONS,), StubDetector),
    StepSpec("pose_filter", (DETECTIONS,), (STATE, EVENTS), StubFilter),
)


class Collector:
    """A sink that keeps everything."""

    def __init__(self) -> None:
        self.got: list[tuple[Envelope, int]] = []

    def write(self, envelope: Envelope, t_receipt_ns: int) -> None:
        """Keep."""
        self.got.append((envelope, t_receipt_ns))

    def close(self) -> None:
        """Fail: sinks belong to the caller."""
        raise AssertionError("replay closed a sink that is not its own")


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    return write_run(tmp_path / "source.mcap", run_envelopes(FRAMES))


def test_messages_come_in_the_order_of_the_bus(recording: Path) -> None:
    """Calibration; then for each frame its truth, itself, its detections, its state and what happened."""
    sink = Collector()
    counts = replay_direct(open_source(recording), [sink], steps=STUBS)
    expected = [CALIBRATION] + [TRUTH, FRAME, DETECTIONS, STATE] * FRAMES
    expected.insert(5, EVENTS)
    assert [envelope.topic for envelope, _ in sink.got] == expected
    assert (counts.frames, counts.refused) == (FRAMES, 0)
    assert {envelope.key.split("/")[1] for envelope, _ in sink.got} == {MISSION.vehicle}


def test_answers_carry_the_stamp_of_their_frame(recording: Path) -> None:
    sink = Collector()
    replay_direct(open_source(recording), [sink], steps=STUBS)
    stamps = {e.stamp.sequence: e.stamp for e, _ in sink.got if e.topic is FRAME}
    for envelope, t_receipt_ns in sink.got:
        if envelope.topic in (DETECTIONS, STATE, EVENTS):
            assert envelope.stamp == stamps[envelope.stamp.sequence]
        assert t_receipt_ns >= envelope.stamp.t_origin_ns > envelope.stamp.t_capture_ns
    payloads = [e.message() for e, _ in sink.got if e.topic is DETECTIONS]
    assert {message.width_px for message in payloads} == {160}


def test_every_sink_is_given_everything_and_progress_is_told(recording: Path) -> None:
    sinks, through = [Collector(), Collector()], []
    replay_direct(open_source(recording), sinks, steps=STUBS, on_frame=lambda e: through.append(e.stamp.sequence))
    assert [e for e, _ in sinks[0].got] == [e for e, _ in sinks[1].got]
    assert through == list(range(FRAMES))


def test_what_a_step_refuses_is_counted_told_and_answered(tmp_path: Path) -> None:
    def damage(e: Envelope) -> Envelope:
        if e.topic is not FRAME or e.stamp.sequence not in (2, 4):
            return e
        image = e.message()
        image.data = image.data[:50]
        broken = wrap(image, e.stamp).payload
        return replace(e, payload=broken if e.stamp.sequence == 2 else broken[:30])

    run = write_run(tmp_path / "run.mcap", ((damage(e), t_ns) for e, t_ns in run_envelopes(FRAMES)))
    sink = Collector()
    told: list[str] = []
    counts = replay_direct(open_source(run), [sink], steps=STUBS, on_refused=told.append)
    assert (counts.frames, counts.refused) == (FRAMES, 2)
    assert [e.stamp.sequence for e, _ in sink.got if e.topic is STATE] == list(range(FRAMES))
    assert told[0] == "detector refused frame 2: no image"


def test_pace_is_the_recorded_one_divided_by_speed(recording: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clock, slept = [0.0], []

    def sleep(duration_s: float) -> None:
        slept.append(round(duration_s, 6))
        clock[0] += duration_s

    monkeypatch.setattr("pipeline.replay.time.monotonic", lambda: clock[0])
    monkeypatch.setattr("pipeline.replay.time.sleep", sleep)
    list(paced(open_source(recording).envelopes(), 2.0))
    assert slept == [0.0] + [PERIOD_NS / 1e9 / 2] * (FRAMES - 1)
    slept.clear()
    list(paced(open_source(recording).envelopes(), "max"))
    assert slept == []
    with pytest.raises(ValueError, match="positive factor"):
        list(paced(open_source(recording).envelopes(), 0.0))


def replayed(source: Path, out: Path, steps: tuple[StepSpec, ...] | None = None) -> Path:
    """Replay a recording, image or folder into a recording."""
    opened = open_source(source)
    with RecordingWriter(out, opened.mission) as writer:
        replay_direct(opened, [writer], **({} if steps is None else {"steps": steps}))
    return out


def test_two_replays_and_a_replay_of_a_replay_are_identical(recording: Path, tmp_path: Path) -> None:
    first = replayed(recording, tmp_path / "first.mcap", STUBS)
    second = replayed(recording, tmp_path / "second.mcap", STUBS)
    third = replayed(first, tmp_path / "third.mcap", STUBS)
    assert differences(first, second) == differences(first, third) == []
    assert Recording(first).topics() == Recording(third).topics()
    originals = [e.payload for e, _ in Recording(recording).envelopes((FRAME, TRUTH, CALIBRATION))]
    assert [e.payload for e, _ in Recording(third).envelopes((FRAME, TRUTH, CALIBRATION))] == originals


def test_the_real_steps_repeat_themselves(shared: Path, tmp_path: Path) -> None:
    """Detector and pose filter on real frames, twice, and again from the recorded run."""
    first = replayed(shared / "reference" / "frames", tmp_path / "first.mcap")
    second = replayed(shared / "reference" / "frames", tmp_path / "second.mcap")
    third = replayed(first, tmp_path / "third.mcap")
    assert differences(first, second) == differences(first, third) == []
    assert any(detections.detections for detections in Recording(first).messages(DETECTIONS))
    assert len(list(Recording(first).messages(STATE))) == 6


def test_differences_are_found_and_named(tmp_path: Path) -> None:
    rows = list(run_envelopes(FRAMES))

    def changed(row: tuple[Envelope, int]) -> tuple[Envelope, int] | None:
        envelope, t_ns = row
        if envelope.topic is DETECTIONS and envelope.stamp.sequence == 1:
            return None
        if envelope.topic is STATE and envelope.stamp.sequence == 3:
            message = envelope.message()
            assert isinstance(message, RelativeState)
            return wrap(message.model_copy(update={"age_s": 0.5, "nis_dof": 8}), envelope.stamp), t_ns
        if envelope.topic is EVENTS:
            return wrap(Log(level=Log.WARNING, message="end"), envelope.stamp), t_ns
        return envelope, t_ns + 77

    a = write_run(tmp_path / "a.mcap", rows)
    b = write_run(tmp_path / "b.mcap", [row for row in map(changed, rows) if row is not None])
    assert differences(a, b) == [
        f"detections of frame 1: only in {a}",
        "state of frame 3: nis_dof is 0 and 8",
        "events of frame 5: level is 'INFO' and 'WARNING'",
    ]


@pytest.mark.parametrize(
    ("a", "b", "expected"),
    [
        ({"x": 1}, {"x": 1}, None),
        ({"x": 1}, {}, "x is 1 and None"),
        ({"x": {"y": [1, 2]}}, {"x": {"y": [1, 3]}}, "x.y[1] is 2 and 3"),
        ({"x": [1]}, {"x": [1, 2]}, "x is [1] and [1, 2]"),
        ([{"a": 1}], [{"a": 2}], "[0].a is 1 and 2"),
    ],
)
def test_first_difference(a: object, b: object, expected: str | None) -> None:
    assert first_difference(a, b) == expected
