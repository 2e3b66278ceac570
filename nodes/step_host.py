"""A step as a node: the detector, the pose filter."""

from __future__ import annotations

from collections.abc import Iterable

from nodes.bus import Received
from nodes.shell import IDLE_PERIOD_S
from pipeline.mission import Mission
from pipeline.steps import StepSpec
from schemas import Envelope, Stamp
from schemas.codec import AnyMessage

QUIET_NS = 200_000_000
"""A live step that can tell the time is told so when nothing came for this long, and then every
``TICK_NS``."""
TICK_NS = 100_000_000
IDLE_SHARE = 0.25
"""Of the period of a mission's output rate: how late a propagated state may be."""


class StepWork:
    """Decode, step, wrap.

    Answers carry the stamp of the message that caused them.  Those caused by time alone carry the last
    frame's sequence number and the time itself.
    """

    def __init__(self, spec: StepSpec, mission: Mission, *, lossless: bool) -> None:
        self._mission = mission
        self._step = spec.build(mission)
        self._tick = None if lossless else getattr(self._step, "tick", None)
        period_s = getattr(self._step, "tick_period_s", None)
        self._quiet_ns, self._tick_ns = QUIET_NS, TICK_NS
        if period_s is not None:
            self._quiet_ns = self._tick_ns = round(period_s * 1e9)
            self.idle_period_s = min(period_s * IDLE_SHARE, IDLE_PERIOD_S)
        self._sequence: int | None = None
        self._t_last_ns = 0

    def handle(self, received: Received) -> Iterable[Envelope]:
        """Take one envelope through the step."""
        envelope = received.envelope
        if envelope.topic.per_frame:
            self._sequence, self._t_last_ns = envelope.stamp.sequence, received.t_receipt_ns
        return self._wrap(self._step.step(envelope.message()), envelope.stamp)

    def refuse(self, envelope: Envelope) -> Iterable[Envelope]:
        """Answer for a frame whose message could not be used."""
        if not envelope.topic.per_frame:
            return []
        return self._wrap(self._step.refused(envelope.stamp.t_capture_ns), envelope.stamp)

    def idle(self, t_ns: int) -> Iterable[Envelope]:
        """Tell a live step the time when its input has dried up."""
        if self._tick is None or self._sequence is None or t_ns - self._t_last_ns < self._quiet_ns:
            return []
        self._t_last_ns = t_ns - self._quiet_ns + self._tick_ns
        return self._wrap(self._tick(t_ns), Stamp(self._sequence, t_ns, t_ns))

    def close(self) -> None:
        """Nothing to finish."""

    def _wrap(self, outputs: Iterable[AnyMessage], stamp: Stamp) -> list[Envelope]:
        mission = self._mission
        return [Envelope.wrap(output, stamp, vehicle=mission.vehicle, camera=mission.camera.name) for output in outputs]
