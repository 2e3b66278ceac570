"""What a node says of itself once a second."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass, field

from nodes.bus import Bus
from schemas import Envelope, NodeHealth, Stamp

PERIOD_S = 1.0


@dataclass
class Health:
    """A node's counters, and the clock that tells when to publish them."""

    node: str
    vehicle: str
    received: int = 0
    published: int = 0
    dropped: int = 0
    refused: int = 0
    latency_s: float | None = None
    note: str = ""
    last_sequence: int = 0
    _started_s: float = field(default_factory=time.monotonic)
    _due_s: float = field(default_factory=time.monotonic)

    def publish_when_due(self, bus: Bus) -> None:
        """Publish if a second has passed since the last time."""
        if time.monotonic() >= self._due_s:
            self.publish(bus)

    def publish(self, bus: Bus) -> None:
        """Publish now."""
        now_s = time.monotonic()
        self._due_s = now_s + PERIOD_S
        t_ns = time.time_ns()
        message = NodeHealth(
            t_publish_ns=t_ns,
            node=self.node,
            pid=os.getpid(),
            uptime_s=now_s - self._started_s,
            cpu_s=time.process_time(),
            received=self.received,
            published=self.published,
            dropped=self.dropped,
            refused=self.refused,
            latency_s=self.latency_s,
            note=self.note,
        )
        stamp = Stamp(self.last_sequence, t_ns, t_ns)
        bus.publish(Envelope.wrap(message, stamp, vehicle=self.vehicle, node=self.node))
