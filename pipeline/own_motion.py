"""What the chaser has told of its own motion, and letting time pass by it."""

from __future__ import annotations

from bisect import bisect_right, insort
from collections.abc import Iterator
from dataclasses import dataclass

from astratag.transforms import rotation_from_wxyz
from pipeline.convert import NS_PER_S, vector_array
from pipeline.dynamics import OwnMotion
from pipeline.mission import DriftSection
from schemas import ChaserMotion

KEPT = 256


@dataclass(frozen=True, eq=False)
class Stretch:
    """A time over which what the chaser knows of its own motion stays the same."""

    dt_s: float
    own: OwnMotion | None
    """None: it has told nothing yet."""
    then: OwnMotion | None
    """What it knows at the end; None: the stretch ends with no change."""


class OwnMotions:
    """The chaser's own motion from each time on, in the order of time."""

    def __init__(self, drift: DriftSection, kept: int | None = KEPT):
        """Remember the last ``kept`` messages, all of them if None."""
        self._drift, self._kept = drift, kept
        self._known: list[tuple[int, OwnMotion]] = []

    def take(self, message: ChaserMotion) -> None:
        """Note a message; what it says of times gone by counts for late frames only."""
        q = message.rotation_hill_chaser_wxyz
        own = OwnMotion(
            OwnMotion.of(self._drift).R_hill_chaser if q is None else rotation_from_wxyz((q.w, q.x, q.y, q.z)),
            vector_array(message.omega_hill_chaser_in_chaser_rad_s),
            vector_array(message.acceleration_chaser_m_s2),
        )
        insort(self._known, (message.t_capture_ns, own), key=lambda known: known[0])
        if self._kept is not None:
            del self._known[: -self._kept]

    def stretches(self, from_ns: int, to_ns: int) -> Iterator[Stretch]:
        """Yield the stretches of a time, one after another."""
        at = bisect_right(self._known, from_ns, key=lambda known: known[0])
        own = self._known[at - 1][1] if at else None
        for change_ns, then in self._known[at:]:
            if change_ns >= to_ns:
                break
            yield Stretch((change_ns - from_ns) / NS_PER_S, own, then)
            from_ns, own = change_ns, then
        yield Stretch((to_ns - from_ns) / NS_PER_S, own, None)
