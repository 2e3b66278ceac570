"""What a filter was at its last frames, so that a frame which comes late is taken at its own time.

A late frame puts the filter back to what it was before it; then it, and all that had come since, are taken in the order
of their stamps.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass
from typing import Generic, TypeVar

Message = TypeVar("Message")
State = TypeVar("State")


@dataclass(frozen=True, eq=False)
class Record(Generic[Message, State]):
    """One frame, and what the filter was after it."""

    t_ns: int
    message: Message
    after: State


class History(Generic[Message, State]):
    """Records of the last frames in the order of their stamps, no longer than ``length_ns``."""

    def __init__(self, length_ns: int):
        self._length_ns = length_ns
        self._records: list[Record[Message, State]] = []

    def __len__(self) -> int:
        return len(self._records)

    def append(self, t_ns: int, message: Message, after: State) -> None:
        """Add the newest frame; forget what is too long before it."""
        assert not self._records or t_ns > self._records[-1].t_ns
        self._records.append(Record(t_ns, message, after))
        oldest_ns = t_ns - self._length_ns
        while self._records[0].t_ns < oldest_ns:
            del self._records[0]

    def holds(self, t_ns: int) -> bool:
        """Tell whether a frame of this stamp was taken."""
        return any(record.t_ns == t_ns for record in self._records)

    def reaches(self, t_ns: int) -> bool:
        """Tell whether it is known what the filter was before ``t_ns``."""
        return bool(self._records) and self._records[0].t_ns < t_ns

    def rewind(self, t_ns: int) -> tuple[State, list[tuple[int, Message]]]:
        """Return what the filter was before ``t_ns``, and stamps and messages of later frames, which are forgotten."""
        at = bisect_right(self._records, t_ns, key=lambda record: record.t_ns)
        later = [(record.t_ns, record.message) for record in self._records[at:]]
        del self._records[at:]
        return self._records[-1].after, later

    def clear(self) -> None:
        """Forget everything."""
        self._records.clear()
