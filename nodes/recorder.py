"""The recorder as a node: everything that passes goes into ``run.mcap``."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable
from pathlib import Path

from nodes.bus import Received
from nodes.shell import NodeError
from pipeline.mission import Mission
from pipeline.recording import NothingRecordedError, Recording, RecordingError, RecordingWriter, recover
from schemas import Envelope

FLUSH_PERIOD_NS = 250_000_000


class RecorderWork:
    """Writes; never over a recording that is there.

    A recorder that is started again goes on in the next part, ``run.1.mcap`` after ``run.mcap``; ``join_parts``
    makes one recording of them when the run is over.
    """

    def __init__(self, directory: Path, mission: Mission) -> None:
        directory.mkdir(parents=True, exist_ok=True)
        self._writer = RecordingWriter(_part(directory, len(existing_parts(directory))), mission)
        self._flushed_ns = 0

    def handle(self, received: Received) -> Iterable[Envelope]:
        """Write one envelope."""
        try:
            self._writer.write(received.envelope, received.t_receipt_ns)
        except RecordingError as error:
            raise NodeError(str(error)) from error
        return []

    def refuse(self, envelope: Envelope) -> Iterable[Envelope]:
        """Nothing follows."""
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


def join_parts(directory: Path, mission: Mission) -> Path:
    """Make one whole ``run.mcap`` of a run's parts and return its path.

    Raises RecordingError, and leaves all parts where they are, when there is none or one cannot be made whole.
    """
    whole = []
    parts = existing_parts(directory)
    for part in parts:
        with contextlib.suppress(NothingRecordedError):  # killed before its first message
            recover(part, part)
            whole.append(part)
    if not whole:
        raise RecordingError(f"the run left no recording in {directory}")
    if len(parts) > 1:
        joined = directory / "run.joined.mcap"
        with RecordingWriter(joined, mission) as writer:
            for part in whole:
                for envelope, t_receipt_ns in Recording(part).envelopes():
                    writer.write(envelope, t_receipt_ns)
        joined.replace(parts[0])
        for part in parts[1:]:
            part.unlink()
    return parts[0]


def _part(directory: Path, number: int) -> Path:
    return directory / ("run.mcap" if number == 0 else f"run.{number}.mcap")
