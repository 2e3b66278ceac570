"""The shell around a node's work: gaps, refusals, held frames, acknowledgements and the end, without a bus."""

from collections import deque
from typing import Any

import pytest

from nodes import shell as shell_module
from nodes.bus import Credit, Event, Presence, Received
from nodes.processes import process_named
from nodes.shell import NodeError, NodeOptions, Shell
from pipeline.mission import Mission
from schemas import Envelope, NodeHealth, Stamp, Topic
from schemas.topics import CALIBRATION, DETECTIONS, FRAME, HEALTH, STATE


class ScriptedBus:
    """A bus that plays events, then stops the node; it keeps what the node says."""

    def __init__(self, *events: Event):
        self.events = deque(events)
        self.mailbox = self
        self.published: list[Envelope] = []
        self.credits: list[Credit] = []
        self.announced = False
        self.linger = 50

    def get(self, timeout_s: float) -> Event | None:
        if self.events:
            return self.events.popleft()
        self.linger -= 1
        return None

    def is_set(self) -> bool:
        return self.linger <= 0

    def subscribe(self, topics: Any, *, camera: str, keep_all: bool) -> None: ...

    def watch(self, nodes: Any) -> None: ...

    def announce(self) -> None:
        self.announced = True

    def publish(self, envelope: Envelope) -> None:
        self.published.append(envelope)

    def send(self, credit: Credit) -> None:
        self.credits.append(credit)

    def health(self) -> NodeHealth:
        """Return the last health published."""
        return [e.message() for e in self.published if e.topic is HEALTH][-1]

    def answers(self, topic: Topic) -> list[Envelope]:
        return [e for e in self.published if e.topic is topic]


class Echo:
    """Work that answers each frame under another topic, and refuses the payload "refuse"."""

    def __init__(self, answer: Topic):
        self.answer = answer
        self.seen: list[Envelope] = []
        self.closed = False

    def handle(self, received: Received) -> list[Envelope]:
        if received.envelope.payload == b"refuse":
            raise ValueError("not for me")
        self.seen.append(received.envelope)
        if not received.envelope.topic.per_frame:
            return []
        return [Envelope(self.answer, self.answer.key(vehicle="chaser"), b"answer", received.envelope.stamp)]

    def refuse(self, envelope: Envelope) -> list[Envelope]:
        return [Envelope(self.answer, self.answer.key(vehicle="chaser"), b"nothing seen", envelope.stamp)]

    def idle(self, t_ns: int) -> list[Envelope]:
        return []

    def close(self) -> None:
        self.closed = True


def arrived(topic: Topic, sequence: int, payload: bytes = b"x") -> Received:
    return Received(Envelope(topic, topic.key(vehicle="chaser", camera="nav"), payload, Stamp(sequence, 0, 0)), 0)


def run(*events: Event, node: str = "detector", lossless: bool = True, companions: tuple[str, ...] = ()):
    bus, work = ScriptedBus(*events), Echo(STATE if node == "pose_filter" else DETECTIONS)
    options = NodeOptions(Mission(), lossless, companions)
    shell = Shell(process_named(node), work, options, bus, bus)  # type: ignore[arg-type]
    shell._health._due_s = 0.0
    shell.run()
    return bus, work


def test_every_frame_is_acknowledged_in_a_replay():
    bus, _ = run(arrived(CALIBRATION, 0), *(arrived(FRAME, k) for k in range(3)))
    assert bus.credits == [Credit("detector", k, latched=1) for k in range(-1, 3)]
    assert [e.stamp.sequence for e in bus.answers(DETECTIONS)] == [0, 1, 2]


def test_a_gap_in_a_replay_is_an_error():
    with pytest.raises(NodeError, match="frame 1 never arrived: next came 2"):
        run(arrived(CALIBRATION, 0), arrived(FRAME, 0), arrived(FRAME, 2))


def test_a_lost_beginning_of_a_replay_is_an_error():
    with pytest.raises(NodeError, match="frame 0 never arrived: next came 5"):
        run(arrived(CALIBRATION, 0), arrived(FRAME, 5))


def test_live_gaps_are_counted_and_a_source_that_starts_over_is_not_a_gap(monkeypatch):
    monkeypatch.setattr("nodes.health.PERIOD_S", 0.0)
    frames = [arrived(FRAME, k) for k in (5, 6, 9, 0, 1)]
    bus, work = run(arrived(CALIBRATION, 0), *frames, lossless=False)
    assert bus.health().dropped == 2
    assert len([e for e in work.seen if e.topic is FRAME]) == 5
    assert not bus.credits


def test_frames_wait_for_the_calibration():
    """The calibration came second: the work sees it first."""
    _, work = run(arrived(FRAME, 0), arrived(CALIBRATION, 0), arrived(FRAME, 1))
    assert [e.topic for e in work.seen] == [CALIBRATION, FRAME, FRAME]


def test_frames_without_a_calibration_are_an_error_after_a_while(monkeypatch):
    monkeypatch.setattr(shell_module, "LATCH_PATIENCE_S", -1.0)
    with pytest.raises(NodeError, match="frames came, but no calibration"):
        run(arrived(FRAME, 0))


def test_a_refused_frame_is_counted_told_and_answered(monkeypatch):
    """A broken image: those behind hear that nothing was seen in it, and the next frame goes on."""
    monkeypatch.setattr("nodes.health.PERIOD_S", 0.0)
    bus, _ = run(arrived(CALIBRATION, 0), arrived(FRAME, 0, b"refuse"), arrived(FRAME, 1))
    assert [e.payload for e in bus.answers(DETECTIONS)] == [b"nothing seen", b"answer"]
    assert bus.health().refused == 1
    assert bus.health().note == "detector refused frame 0: not for me"
    assert bus.credits[-1] == Credit("detector", 1, latched=1)


def test_a_node_ends_when_all_that_was_published_has_arrived():
    """The source's last word overtakes its last frame."""
    last_word = Credit("source", 1, ended=True, published={"frame": 2, "calibration": 1})
    bus, work = run(arrived(CALIBRATION, 0), arrived(FRAME, 0), last_word, arrived(FRAME, 1))
    assert bus.credits[-1] == Credit("detector", 1, latched=1, ended=True, published={"detections": 2})
    assert work.closed


def test_a_message_missing_at_the_end_of_a_replay_is_an_error(monkeypatch):
    monkeypatch.setattr(shell_module, "END_PATIENCE_S", 0.0)
    last_word = Credit("source", 1, ended=True, published={"frame": 2})
    with pytest.raises(NodeError, match="1 of 2 frame never arrived"):
        run(arrived(CALIBRATION, 0), arrived(FRAME, 0), last_word)


def test_in_a_replay_a_node_is_ready_only_when_those_behind_it_are():
    behind = ("pose_filter", "recorder", "viewer")
    bus, _ = run(*(Presence(name, alive=True) for name in behind[:2]), companions=("detector", *behind))
    assert not bus.announced
    bus, _ = run(*(Presence(name, alive=True) for name in behind), companions=("detector", *behind))
    assert bus.announced


def test_a_node_that_died_before_it_came_up_is_not_waited_for():
    bus, _ = run(
        Presence("pose_filter", alive=True),
        Presence("recorder", alive=True),
        Credit("viewer", ended=True),
        companions=("detector", "pose_filter", "recorder", "viewer"),
    )
    assert bus.announced


def test_the_work_is_closed_when_the_node_is_stopped():
    _, work = run(lossless=False)
    assert work.closed
