"""The source's timelines: a recording repeated, retimed as if the camera looked now, and replayed in a window."""

import itertools
from collections.abc import Iterator
from dataclasses import replace

import pytest
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage

from nodes import source as source_module
from nodes.bus import Credit, Event, Presence, Received
from nodes.shell import NodeError, NodeOptions
from nodes.source import WINDOW, Pace, Resume, SourceNode, repeated, retimed
from pipeline.mission import Mission
from schemas import Envelope, Pose, Quaternion, Stamp, Truth, Vector3, encode
from schemas.topics import CALIBRATION, FRAME, STATE, TRUTH

PERIOD_NS = 50_000_000
START_NS = 1_000_000_000_000


def recording(frames: int) -> Iterator[Envelope]:
    """Yield a calibration and bare frames at 20 Hz."""
    yield Envelope(CALIBRATION, "k", b"", Stamp(0, START_NS, 0))
    for k in range(frames):
        yield Envelope(FRAME, "f", b"", Stamp(k, START_NS + k * PERIOD_NS, 0))


def changed(envelopes: Iterator[Envelope], later: int) -> Iterator[Envelope]:
    """Yield envelopes with their sequence numbers moved."""
    for envelope in envelopes:
        yield replace(envelope, stamp=replace(envelope.stamp, sequence=envelope.stamp.sequence + later))


def test_a_recording_played_once_is_itself():
    assert list(repeated(lambda: recording(3), loop=False)) == list(recording(3))


def test_a_recording_repeated_goes_on_in_number_and_time():
    played = list(itertools.islice(repeated(lambda: recording(3), loop=True), 12))
    frames = [envelope.stamp for envelope in played if envelope.topic is FRAME]
    assert [stamp.sequence for stamp in frames] == list(range(9))
    assert [stamp.t_capture_ns - START_NS for stamp in frames] == [k * PERIOD_NS for k in range(9)]
    assert [k for k, envelope in enumerate(played) if envelope.topic is CALIBRATION] == [0, 4, 8]


def test_an_empty_recording_is_not_repeated_for_ever():
    assert len(list(repeated(lambda: recording(0), loop=True))) == 1


def test_retiming_moves_the_stamp_and_the_message():
    image = CompressedImage(data=b"jpeg", format="jpeg")
    origin = Vector3(x=0, y=0, z=0)
    pose = Pose(translation_m=origin, rotation_wxyz=Quaternion(w=1, x=0, y=0, z=0))
    truth = Truth(
        t_capture_ns=5,
        T_chaser_target=pose,
        v_chaser_target_m_s=origin,
        omega_chaser_target_in_target_rad_s=origin,
    )
    t_ns = 1_800_000_000_123_456_789
    for topic, message in ((FRAME, image), (TRUTH, truth)):
        moved = retimed(Envelope(topic, "k", encode(message), Stamp(4, 5, 6)), t_ns)
        assert moved.stamp == Stamp(4, t_ns, 6)
        message = moved.message()
        assert t_ns == (message.timestamp.ToNanoseconds() if topic is FRAME else message.t_capture_ns)


class Others:
    """The rest of a run as the source sees it: a bus on which each node acknowledges when it is asked to."""

    def __init__(self, names: tuple[str, ...]):
        self.mailbox = self
        self.events: list[Event] = [Presence(name, alive=True) for name in names]
        self.published: list[Envelope] = []
        self.last_word: Credit | None = None
        self.names = names
        self.most_in_flight = 0
        self.frames_before_calibrations: list[tuple[int, int]] = []
        """Frames published, and those acknowledged by all, at each calibration."""
        self.acknowledged = dict.fromkeys(names, -1)
        self.latched = 0
        self.answers_with_states = False
        self.states = 0

    def get(self, timeout_s: float) -> Event | None:
        if self.events:
            return self.events.pop(0)
        if self.answers_with_states and self.states < len(self.published):
            self.states += 1
            stamp = Stamp(self.states - 1, 0, 0)
            return Received(Envelope(STATE, "relnav/chaser/state", b"", stamp), 0)
        behind = min(self.names, key=self.acknowledged.__getitem__)
        if self.acknowledged[behind] < len(self.published) - 1:
            self.acknowledged[behind] += 1
            return Credit(behind, self.acknowledged[behind], self.latched)
        return None

    def watch(self, nodes: object) -> None: ...

    def subscribe(self, topics: object) -> None: ...

    def announce(self) -> None: ...

    def publish(self, envelope: Envelope) -> None:
        if envelope.topic is FRAME:
            self.published.append(envelope)
            self.most_in_flight = max(self.most_in_flight, len(self.published) - 1 - min(self.acknowledged.values()))
        elif envelope.topic is CALIBRATION:
            self.latched += 1
            self.frames_before_calibrations.append((len(self.published), min(self.acknowledged.values()) + 1))
            self.events += [Credit(name, self.acknowledged[name], self.latched) for name in self.names]

    def send(self, credit: Credit) -> None:
        self.last_word = credit

    def is_set(self) -> bool:
        return self.last_word is not None


class Film:
    """A source of frames in memory."""

    live = False
    closed_loop = False

    def __init__(self, frames: int):
        self.frames = frames

    def envelopes(self) -> Iterator[Envelope]:
        return recording(self.frames)


def play(frames: int, others: Others, *, lossless: bool = True, pace: Pace) -> None:
    options = NodeOptions(Mission(), lossless, others.names)
    SourceNode(Film(frames), pace, options, others, others).run()  # type: ignore[arg-type]


def test_a_replay_keeps_a_window_of_frames_in_flight_and_counts_what_it_published():
    others = Others(("detector", "recorder"))
    play(40, others, pace=Pace(speed=None))
    assert [envelope.stamp.sequence for envelope in others.published] == list(range(40))
    assert others.most_in_flight == WINDOW
    assert others.last_word == Credit("source", 39, ended=True, published={"calibration": 1, "frame": 40})
    assert all(envelope.stamp.t_origin_ns > 0 for envelope in others.published)


def test_a_calibration_that_changes_finds_everybody_at_the_same_frame():
    """What came before it is dealt with before it is published, so that no node mixes the two."""
    others = Others(("detector", "recorder"))
    film = Film(20)
    film.envelopes = lambda: itertools.chain(recording(20), changed(recording(5), 20))  # type: ignore[method-assign]
    options = NodeOptions(Mission(), True, others.names)
    SourceNode(film, Pace(speed=None), options, others, others).run()  # type: ignore[arg-type]
    assert others.frames_before_calibrations == [(0, 0), (20, 20)]
    assert len(others.published) == 25


def test_a_damaged_message_is_passed_on_for_the_detector_to_refuse():
    damaged = Envelope(FRAME, "f", b"\xff\xff\xff", Stamp(4, 5, 6))
    assert retimed(damaged, 7) == Envelope(FRAME, "f", b"\xff\xff\xff", Stamp(4, 7, 6))


class Loop(Film):
    """A closed loop that makes a frame for every state that is written to it, and is one ahead."""

    closed_loop = True

    def __init__(self, frames: int):
        super().__init__(frames)
        self.written = 0
        self.made = 0

    @property
    def waits(self) -> bool:
        return self.written < self.made - 1

    def write(self, envelope: Envelope, t_receipt_ns: int) -> None:
        self.written += 1

    def envelopes(self) -> Iterator[Envelope]:
        for envelope in recording(self.frames):
            assert not self.waits
            self.made += envelope.topic is FRAME
            yield envelope


def test_a_closed_loop_waits_for_the_states_of_its_own_frames():
    """Each frame goes out when the state of the one before the last is back."""
    others = Others(("detector", "recorder"))
    others.answers_with_states = True
    loop = Loop(30)
    options = NodeOptions(Mission(), True, others.names)
    SourceNode(loop, Pace(speed=None), options, others, others).run()  # type: ignore[arg-type]
    assert [envelope.stamp.sequence for envelope in others.published] == list(range(30))
    assert loop.written >= 29


def test_a_flight_is_not_taken_up_again_after_the_simulator_died():
    options = NodeOptions(Mission(), False, ())
    others = Others(("detector",))
    with pytest.raises(NodeError, match="cannot be taken up again"):
        SourceNode(Loop(3), Pace(resume=Resume(3, 0)), options, others, others).run()  # type: ignore[arg-type]


def test_a_viewer_that_dies_is_not_waited_for():
    """It acknowledges nothing and is gone: the replay goes on to its end."""
    others = Others(("recorder", "viewer"))
    others.names = ("recorder",)
    others.events += [Presence("viewer", alive=False)]
    others.acknowledged.pop("viewer")
    options = NodeOptions(Mission(), True, ("recorder", "viewer"))
    SourceNode(Film(20), Pace(speed=None), options, others, others).run()  # type: ignore[arg-type]
    assert len(others.published) == 20


def test_a_source_started_again_goes_on_where_the_camera_would_be(monkeypatch):
    """Killed after frame 3, back 0.3 s later: frames 4 to 7 are overdue, frame 8 is due in 0.05 s."""
    clock_ns = 2_000_000_000_000_000_000
    monkeypatch.setattr(source_module.time, "time_ns", lambda: clock_ns)
    monkeypatch.setattr(SourceNode, "_wait_until", lambda self, due_s: None)
    others = Others(("detector",))
    resume = Resume(3, clock_ns - 4 * PERIOD_NS - source_module.OVERDUE_NS)
    monkeypatch.setattr(source_module, "retimed", lambda envelope, t_ns: envelope)
    play(12, others, lossless=False, pace=Pace(resume=resume))
    assert [envelope.stamp.sequence for envelope in others.published] == [7, 8, 9, 10, 11]
