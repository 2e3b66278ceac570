"""The frame source as a node: what sets the pace.

Replay: a few frames in flight, at most ``WINDOW`` ahead of what every companion has acknowledged.
Live: frames when they are due, never waiting for anybody.  A recording played live is retimed, as if the
camera looked at it now, and what is overdue is left out.
Closed loop: a simulator that flies on the states of its own frames, which come back over the bus; in lockstep as a
replay with two frames in flight, or in real time.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Protocol

from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage

from nodes.bus import Bus, Credit, Presence, Received
from nodes.health import Health
from nodes.processes import process_named
from nodes.shell import JOIN_PATIENCE_S, POLL_S, NodeError, NodeOptions, StopSignal
from schemas import CodecError, Envelope, Stamp, Truth, encode
from schemas.topics import CALIBRATION, FRAME, STATE

WINDOW = 8
"""Frames in flight in a replay: enough to keep every node busy, few enough to bound memory and latency."""
STALL_PATIENCE_S = 60.0
OVERDUE_NS = 100_000_000
NS_PER_S = 1_000_000_000


class Frames(Protocol):
    """What the node needs of a source."""

    @property
    def live(self) -> bool:
        """Tell whether it is a camera, which sets the pace itself."""
        ...

    @property
    def closed_loop(self) -> bool:
        """Tell whether it flies on the states of its own frames."""
        ...

    @property
    def waits(self) -> bool:
        """Tell whether a closed loop cannot go on before another state has been written to it."""
        ...

    def envelopes(self) -> Iterator[Envelope]:
        """Yield the calibration, then frame by frame."""
        ...

    def write(self, envelope: Envelope, t_receipt_ns: int) -> None:
        """Take a state back."""
        ...


@dataclass(frozen=True)
class Resume:
    """Where a source that was killed had got to: the last frame's number, and when it was captured."""

    sequence: int
    t_capture_ns: int


@dataclass(frozen=True)
class Pace:
    """How fast frames are published, and how often the recording is played."""

    speed: float | None = 1.0
    """Times real time; None: as fast as the others can follow (replay only)."""
    loop: bool = False
    resume: Resume | None = None


class SourceNode:
    """Publishes one source from its first frame to its last."""

    def __init__(self, source: Frames, pace: Pace, options: NodeOptions, bus: Bus, stop: StopSignal) -> None:
        self._source, self._pace, self._options, self._bus, self._stop = source, pace, options, bus, stop
        self._health = Health("source", options.mission.vehicle)
        self._absent = set(options.companions)
        self._credits: dict[str, Credit] = {}
        self._published: dict[str, int] = {}

    def run(self) -> None:
        """Publish, then wait to be stopped.  Raises NodeError when a replay cannot go on."""
        if self._source.closed_loop:
            self._bus.subscribe([STATE])
        self._bus.watch(self._options.companions)
        self._await_companions()
        self._bus.announce()
        if self._source.closed_loop:
            self._run_closed_loop()
        elif self._source.live:
            self._run_camera()
        elif self._options.lossless:
            self._run_replay()
        else:
            self._run_as_camera()
        self._bus.send(Credit("source", self._health.last_sequence, ended=True, published=self._published))
        while not self._stop.is_set():
            self._turn(POLL_S)

    def _await_companions(self) -> None:
        ready = self._turn_until(lambda: not self._absent, JOIN_PATIENCE_S)
        if not ready and self._options.lossless and not self._stop.is_set():
            raise NodeError(f"waited {JOIN_PATIENCE_S:.0f} s for {', '.join(sorted(self._absent))}")

    def _run_replay(self) -> None:
        start_s = t_first_ns = None
        newest = -1
        for envelope in self._source.envelopes():
            stamp = envelope.stamp
            if envelope.topic is not CALIBRATION and stamp.sequence > newest:
                newest = stamp.sequence
                self._await_credit(newest)
                if self._pace.speed is not None:
                    if start_s is None or t_first_ns is None:
                        start_s, t_first_ns = time.monotonic(), stamp.t_capture_ns
                    due_s = start_s + (stamp.t_capture_ns - t_first_ns) / NS_PER_S / self._pace.speed
                    self._wait_until(due_s)
            if self._stop.is_set():
                return
            if envelope.topic is CALIBRATION and newest >= 0:
                self._await_credit(newest + WINDOW)  # frames before it are seen with the calibration before it
            self._publish(envelope)
            if envelope.topic is CALIBRATION:
                self._await_latched()

    def _run_as_camera(self) -> None:
        shift_ns = None
        for envelope in repeated(self._source.envelopes, loop=self._pace.loop):
            stamp = envelope.stamp
            resume = self._pace.resume
            if envelope.topic is CALIBRATION:
                self._publish(retimed(envelope, time.time_ns()))
                continue
            if shift_ns is None:
                if resume is None:
                    shift_ns = time.time_ns() - stamp.t_capture_ns
                elif stamp.sequence < resume.sequence:
                    self._turn(0.0)
                    continue
                else:
                    shift_ns = resume.t_capture_ns - stamp.t_capture_ns
            t_live_ns = stamp.t_capture_ns + shift_ns
            wait_ns = t_live_ns - time.time_ns()
            if wait_ns < -OVERDUE_NS:
                self._turn(0.0)
                continue
            self._wait_until(time.monotonic() + wait_ns / NS_PER_S)
            if self._stop.is_set():
                return
            self._publish(retimed(envelope, t_live_ns))

    def _run_camera(self) -> None:
        # After a restart, past the frames that were on their way: the gap is counted.
        first = 0 if self._pace.resume is None else self._pace.resume.sequence + 1 + WINDOW
        for envelope in self._source.envelopes():
            if self._stop.is_set():
                return
            stamp = replace(envelope.stamp, sequence=envelope.stamp.sequence + first)
            self._publish(replace(envelope, stamp=stamp))
            self._turn(0.0)

    def _run_closed_loop(self) -> None:
        if self._pace.resume is not None:
            raise NodeError("the simulator died, and a flight cannot be taken up again")
        for envelope in self._source.envelopes():
            if self._source.live:
                self._wait_until(time.monotonic() + (envelope.stamp.t_capture_ns - time.time_ns()) / NS_PER_S)
            elif envelope.topic is FRAME:
                self._await_credit(envelope.stamp.sequence)
            if self._stop.is_set():
                return
            self._publish(envelope)
            if self._options.lossless and envelope.topic is CALIBRATION:
                self._await_latched()
            elif not self._turn_until(lambda: not self._source.waits, STALL_PATIENCE_S) and not self._stop.is_set():
                raise NodeError(f"no state for {STALL_PATIENCE_S:.0f} s after frame {envelope.stamp.sequence}")

    def _publish(self, envelope: Envelope) -> None:
        stamp = replace(envelope.stamp, t_origin_ns=time.time_ns())
        self._bus.publish(replace(envelope, stamp=stamp))
        name = envelope.topic.name
        self._published[name] = self._published.get(name, 0) + 1
        self._health.published += 1
        if envelope.topic is FRAME:
            self._health.last_sequence = stamp.sequence

    def _await_credit(self, sequence: int) -> None:
        """Wait until frame ``sequence`` may be published."""

        def laggards() -> list[str]:
            return [node for node, credit in self._credits.items() if credit.sequence < sequence - WINDOW]

        if not self._turn_until(lambda: not laggards(), STALL_PATIENCE_S) and not self._stop.is_set():
            raise NodeError(
                f"no progress for {STALL_PATIENCE_S:.0f} s before frame {sequence}: waiting for {', '.join(laggards())}"
            )

    def _await_latched(self) -> None:
        """Wait until every companion has the calibrations published so far."""
        published = self._published[CALIBRATION.name]

        def laggards() -> list[str]:
            return [
                node
                for node, credit in self._credits.items()
                if CALIBRATION in process_named(node).consumes and credit.latched < published
            ]

        if not self._turn_until(lambda: not laggards(), STALL_PATIENCE_S) and not self._stop.is_set():
            raise NodeError(f"the calibration never reached {', '.join(laggards())}")

    def _wait_until(self, due_s: float) -> None:
        while not self._stop.is_set() and (left_s := due_s - time.monotonic()) > 0:
            self._turn(min(left_s, POLL_S))

    def _turn_until(self, condition: Callable[[], bool], patience_s: float) -> bool:
        deadline_s = time.monotonic() + patience_s
        while not condition():
            if self._stop.is_set() or time.monotonic() > deadline_s:
                return False
            self._turn(POLL_S)
        return True

    def _turn(self, timeout_s: float) -> None:
        match self._bus.mailbox.get(timeout_s):
            case Received(envelope=envelope, t_receipt_ns=t_receipt_ns):
                self._source.write(envelope, t_receipt_ns)
            case Presence(node=node, alive=True) if node in self._absent:
                self._absent.discard(node)
                self._credits[node] = Credit(node)
            case Presence(node=node, alive=False) if not process_named(node).required:
                self._credits.pop(node, None)  # missed, not waited for
            case Credit(node=node, ended=True) if node in self._absent:
                self._absent.discard(node)  # it died before it came up
            case Credit(node=node) as credit if node in self._credits:
                self._credits[node] = credit
        self._health.publish_when_due(self._bus)


def repeated(envelopes: Callable[[], Iterable[Envelope]], *, loop: bool) -> Iterator[Envelope]:
    """Yield a recording once, or for ever with sequence numbers and stamps that go on."""
    sequence_offset = t_offset_ns = 0
    while True:
        first: Stamp | None = None
        last: Stamp | None = None
        for envelope in envelopes():
            if envelope.topic is CALIBRATION:
                yield envelope
                continue
            if envelope.topic is FRAME:
                first, last = first or envelope.stamp, envelope.stamp
            stamp = replace(
                envelope.stamp,
                sequence=envelope.stamp.sequence + sequence_offset,
                t_capture_ns=envelope.stamp.t_capture_ns + t_offset_ns,
            )
            yield replace(envelope, stamp=stamp)
        if not loop or first is None or last is None:
            return
        frames = last.sequence - first.sequence
        duration_ns = last.t_capture_ns - first.t_capture_ns
        sequence_offset += frames + 1
        t_offset_ns += duration_ns + (duration_ns // frames if frames else NS_PER_S)


def retimed(envelope: Envelope, t_capture_ns: int) -> Envelope:
    """Return an envelope as if captured at ``t_capture_ns``, in its stamp and, unless damaged, in its message."""
    envelope = replace(envelope, stamp=replace(envelope.stamp, t_capture_ns=t_capture_ns))
    try:
        message = envelope.message()
    except CodecError:
        return envelope  # for the detector to refuse
    if isinstance(message, CompressedImage | CameraCalibration):
        message.timestamp.FromNanoseconds(t_capture_ns)
    elif isinstance(message, Truth):
        message = message.model_copy(update={"t_capture_ns": t_capture_ns})
    return replace(envelope, payload=encode(message))
