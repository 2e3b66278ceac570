"""The shell around a node's work: it reads the mailbox, counts gaps, holds, acknowledges and ends.

The shell knows the bus and no navigation; the work knows navigation and no bus.

Replay (lossless).  The node acknowledges each frame once it has dealt with all it is paced by, and the
source keeps only a few frames in flight.  A gap is an error.  The node ends when those it hears have ended
and every message they published has arrived; then it says so and waits to be stopped.

Live.  Gaps are counted, and the node goes on until it is stopped.

A message that the work refuses is counted and told to the user; the work then answers for its frame without it,
so that the nodes behind hear of every frame.
"""

from __future__ import annotations

import os
import signal
import threading
import time
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol

from nodes.bus import Bus, Credit, Presence, Received
from nodes.health import Health
from nodes.processes import Process, consumers, producers
from pipeline.mission import Mission
from schemas import Envelope, Topic
from schemas.topics import HEALTH

POLL_S = 0.05
IDLE_PERIOD_S = 0.1
JOIN_PATIENCE_S = 60.0
"""For the nodes behind to come up: imports on a small busy machine take seconds."""
END_PATIENCE_S = 10.0
LATCH_PATIENCE_S = 10.0


class NodeError(RuntimeError):
    """A node cannot do its job; the message is one line for the user."""


@dataclass(frozen=True)
class NodeOptions:
    """What every node is told at its start."""

    mission: Mission
    lossless: bool
    companions: tuple[str, ...] = ()
    """Names of the nodes that take part in a replay, and that it waits for."""


class Work(Protocol):
    """What a node does with what comes in."""

    def handle(self, received: Received) -> Iterable[Envelope]:
        """Take one envelope and return what follows.  A ValueError refuses it."""
        ...

    def refuse(self, envelope: Envelope) -> Iterable[Envelope]:
        """Return what follows from an envelope that was refused."""
        ...

    def idle(self, t_ns: int) -> Iterable[Envelope]:
        """Return what is due for the passing of time alone; called some ten times a second, UTC."""
        ...

    def close(self) -> None:
        """Finish: nothing taken so far may be lost."""
        ...


class StopSignal:
    """Set by SIGTERM and SIGINT, and when the supervisor that holds our standard input is gone."""

    def __init__(self, *, supervised: bool = False) -> None:
        self._set = threading.Event()
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda *_: self._set.set())
        if supervised:
            threading.Thread(target=self._wait_for_end_of_stdin, daemon=True).start()

    def is_set(self) -> bool:
        """Tell whether the node is to stop."""
        return self._set.is_set()

    def _wait_for_end_of_stdin(self) -> None:
        while os.read(0, 1):
            pass
        self._set.set()


class Shell:
    """One consuming node from its start to its end."""

    def __init__(self, process: Process, work: Work, options: NodeOptions, bus: Bus, stop: StopSignal) -> None:
        self._process, self._work, self._options, self._bus, self._stop = process, work, options, bus, stop
        self._health = Health(process.name, options.mission.vehicle)
        companions = set(options.companions)
        self._awaited = {p.name for p in consumers(process) if p.name in companions}
        self._producers = {p.name for p in producers(process)}
        self._present: set[str] = set()
        self._sequences: dict[Topic, int] = {}
        self._received: Counter[str] = Counter()
        self._published: Counter[str] = Counter()
        self._ended: dict[str, Credit] = {}
        self._latches = {topic for topic in process.consumes if topic.latched and process.publishes}
        self._held: list[Received] = []
        self._held_since_s = self._idle_due_s = 0.0
        self._idle_period_s: float = getattr(work, "idle_period_s", IDLE_PERIOD_S)
        self._latched = 0
        self._acknowledged = (-1, 0)
        self._done = False
        self._end_deadline_s: float | None = None

    def run(self) -> None:
        """Work until stopped.  Raises NodeError when messages of a replay are lost."""
        mission, lossless = self._options.mission, self._options.lossless
        self._bus.subscribe(self._process.consumes, camera=mission.camera.name, keep_all=self._process.keeps_all)
        self._bus.watch(sorted(self._awaited | self._producers))
        announced = False
        join_deadline_s = time.monotonic() + JOIN_PATIENCE_S
        try:
            while not self._stop.is_set():
                # In a replay a node is ready only when those behind it hear it.
                if not announced and (not lossless or self._awaited <= self._present):
                    self._bus.announce()
                    announced = True
                if not announced and time.monotonic() > join_deadline_s:
                    absent = ", ".join(sorted(self._awaited - self._present))
                    raise NodeError(f"waited {JOIN_PATIENCE_S:.0f} s for {absent}")
                self._turn(min(POLL_S, self._idle_period_s))
            self._drain()
        finally:
            if not self._done:
                self._work.close()

    def _turn(self, timeout_s: float) -> bool:
        event = self._bus.mailbox.get(timeout_s)
        match event:
            case Received() if not self._done:  # afterwards comes nothing but others' health
                self._take(event)
            case Presence(node=node, alive=True):
                self._present.add(node)
                self._ended.pop(node, None)  # it was started again
            case Presence(node=node, alive=False):
                self._present.discard(node)
            case Credit(node=node, ended=True):
                self._ended[node] = event
                self._awaited.discard(node)  # it died before it came up
        self._pass_time()
        return event is not None

    def _drain(self) -> None:
        deadline_s = time.monotonic() + 2.0
        while time.monotonic() < deadline_s and self._turn(0.0):
            pass

    def _take(self, received: Received) -> None:
        topic = received.envelope.topic
        self._received[topic.name] += 1
        self._health.received += 1
        self._count_gap(received.envelope)
        if topic.latched:
            self._latched += 1
        if topic in self._latches:
            self._latches.discard(topic)
            self._handle(received)
            held, self._held = self._held, []
            for earlier in held:
                self._handle(earlier)
        elif self._latches and topic is not HEALTH:
            if not self._held:
                self._held_since_s = time.monotonic()
            self._held.append(received)
        else:
            self._handle(received)

    def _count_gap(self, envelope: Envelope) -> None:
        topic, sequence = envelope.topic, envelope.stamp.sequence
        if not topic.per_frame:
            return
        expected = self._sequences.get(topic, -1 if self._options.lossless else sequence - 1) + 1
        self._sequences[topic] = sequence
        if sequence <= expected:
            return
        if self._options.lossless:
            raise NodeError(f"{topic.name} {expected} never arrived: next came {sequence}; a replay must lose nothing")
        if topic is self._process.paced_by[0]:
            self._health.dropped += sequence - expected

    def _handle(self, received: Received) -> None:
        envelope = received.envelope
        try:
            outputs = list(self._work.handle(received))
        except ValueError as error:
            self._health.refused += 1
            self._health.note = f"{self._process.name} refused {envelope.topic.name} {envelope.stamp.sequence}: {error}"
            outputs = list(self._work.refuse(envelope))
        self._publish(outputs)
        self._health.last_sequence = envelope.stamp.sequence
        self._health.latency_s = (time.time_ns() - envelope.stamp.t_origin_ns) / 1e9
        if self._options.lossless:
            self._acknowledge()

    def _publish(self, outputs: Iterable[Envelope]) -> None:
        for output in outputs:
            self._bus.publish(output)
            self._published[output.topic.name] += 1
            self._health.published += 1

    def _acknowledge(self) -> None:
        dealt_with = min(self._sequences.get(topic, -1) for topic in self._process.paced_by), self._latched
        if dealt_with != self._acknowledged:
            self._acknowledged = dealt_with
            self._bus.send(Credit(self._process.name, *dealt_with))

    def _pass_time(self) -> None:
        now_s = time.monotonic()
        self._health.publish_when_due(self._bus)
        if self._held and now_s - self._held_since_s > LATCH_PATIENCE_S:
            missing = ", ".join(sorted(topic.name for topic in self._latches))
            raise NodeError(f"frames came, but no {missing} within {LATCH_PATIENCE_S:.0f} s")
        if self._done:
            return
        if now_s >= self._idle_due_s and not self._ended:
            self._idle_due_s = now_s + self._idle_period_s
            self._publish(self._work.idle(time.time_ns()))
        if self._options.lossless and self._producers <= self._ended.keys():
            self._end_when_complete(now_s)

    def _end_when_complete(self, now_s: float) -> None:
        owed = {
            topic.name: sum(credit.published.get(topic.name, 0) for credit in self._ended.values())
            for topic in self._process.consumes
            if topic is not HEALTH and not topic.latched
        }
        missing = {name: n - self._received[name] for name, n in owed.items() if n > self._received[name]}
        if missing:
            self._end_deadline_s = self._end_deadline_s or now_s + END_PATIENCE_S
            if now_s > self._end_deadline_s:
                lost = ", ".join(f"{n} of {owed[name]} {name}" for name, n in missing.items())
                raise NodeError(f"{lost} never arrived; a replay must lose nothing")
            return
        self._work.close()
        self._done = True
        self._health.publish(self._bus)
        credit = Credit(self._process.name, *self._acknowledged, ended=True, published=dict(self._published))
        self._bus.send(credit)
