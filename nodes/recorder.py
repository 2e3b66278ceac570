"""The recorder as a node: everything that passes goes into ``run.mcap``."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable
from pathlib import Path

from nodes.bus import Received
from nodes.shell import NodeError
from pipeline.mission import Mission
from pipeline.recording import RecordingError, RecordingWriter, recover
from schemas import Envelope

FLUSH_PERIOD_NS = 250_000_000


class RecorderWork:
    """Writes; never over a recording that is there.

    A recorder that is started again makes the part that was cut off whole, in its place, and goes on in the
    next: ``run.mcap``, ``run.1.mcap``, ``run.2.mcap``.
    """

    def __init__(self, directory: Path, mission: Mission) -> None:
        directory.mkdir(parents=True, exist_ok=True)
        parts = existing_parts(directory)
        if parts:
            with contextlib.suppress(RecordingError):  # killed before its first message
                recover(parts[-1], parts[-1])
        self._writer = RecordingWriter(_part(directory, len(parts)), mission)
        self._flushed_ns = 0

    def handle(self, received: Received) -> Iterable[Envelope]:
        """Write one envelope."""
        try:
            self._writer.write(received.envelope, received.t_receipt_ns)
        except RecordingError as error:
            raise NodeError(str(error)) from error
        return []

    def idle(self, t_ns: int) -> Iterable[Envelope]:
        """Flush, so that a kill loses less than a second even when nothing more comes."""
        if t_ns - self._flushed_ns >= FLUSH_PERIOD_NS:
            self._flushed_ns = t_ns
            try:
                self._writer.flush()
            except RecordingError as error:
                raise NodeError(str(error)) from error
        return []

    def close(self) -> None:
        """Finish the file."""
        self._writer.close()


def existing_parts(directory: Path) -> list[Path]:
    """Return the recordings of a run in their order."""
    parts: list[Path] = []
    while (part := _part(directory, len(parts))).exists():
        parts.append(part)
    return parts


def _part(directory: Path, number: int) -> Path:
    return directory / ("run.mcap" if number == 0 else f"run.{number}.mcap")
