"""The viewer as a node: everything that passes is shown in Rerun and kept in ``run.rrd``."""

from __future__ import annotations

from collections.abc import Iterable

from nodes.bus import Received
from pipeline.steps import Sink
from schemas import Envelope


class ViewerWork:
    """Hands each envelope to a viewer."""

    def __init__(self, viewer: Sink) -> None:
        self._viewer = viewer

    def handle(self, received: Received) -> Iterable[Envelope]:
        """Show one envelope."""
        self._viewer.write(received.envelope, received.t_receipt_ns)
        return []

    def refuse(self, envelope: Envelope) -> Iterable[Envelope]:
        """Nothing follows."""
        return []

    def idle(self, t_ns: int) -> Iterable[Envelope]:
        """Nothing is due."""
        return []

    def close(self) -> None:
        """Finish the .rrd file."""
        self._viewer.close()
