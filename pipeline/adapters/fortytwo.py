"""The state in the text that NASA's simulator 42 reads from a TCP socket.

Taken from 42's sources (``Source/IPC/SimReadFromSocket.c`` and what it was before), not tried against a running 42.
A message is lines of ``SC[i].PosR = x y z`` between a ``TIME`` line and an end mark, at most 16 kB, read whole; 42
answers with four bytes, ``Ack``, before it reads the next.  Older versions put numbers in brackets and end with
``[ENDMSG]``.

What 42 is told: its reference orbit is the chaser, its inertial axes N are the chaser's body axes, and ``SC[i]`` is
the target as the filter sees it: ``PosR``, ``VelR`` in m and m/s, ``B[0].qn`` (scalar last, N to body: the components
of the target's attitude in the chaser), ``B[0].wn`` in rad/s, body axes.  A relative state knows no inertial attitude,
so this is a picture in the chaser's frame and not an orbit.

A state that is not trusted is told as the time alone: 42 then propagates its own state.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from datetime import UTC, datetime

from pipeline.adapters.estimate import trusted_estimate
from pipeline.convert import NS_PER_S
from schemas import RelativeState

ACK_BYTES = 4


@dataclass(frozen=True)
class Dialect:
    """How numbers are written, and how a message ends."""

    opening: str
    closing: str
    end: str


CURRENT = Dialect("", "", "[EOF]")
BRACKETS = Dialect("[", "]", "[ENDMSG]")
"""Older versions of 42."""


def message(state: RelativeState, *, spacecraft: int = 0, dialect: Dialect = CURRENT) -> bytes:
    """Return the message that sets 42's clock and, when the state is trusted, the target as ``SC[spacecraft]``."""

    def line(key: str, values: Iterable[float]) -> str:
        numbers = " ".join(f"{value:.12e}" for value in values)
        return f"SC[{spacecraft}].{key} = {dialect.opening}{numbers}{dialect.closing}"

    lines = [time_line(state.t_capture_ns)]
    estimate = trusted_estimate(state)
    if estimate is not None and state.T_chaser_target is not None:
        q = state.T_chaser_target.rotation_wxyz
        lines += [
            line("PosR", estimate.position_m),
            line("VelR", estimate.v_chaser_target_m_s),
            line("B[0].qn", (q.x, q.y, q.z, q.w)),
            line("B[0].wn", estimate.omega_chaser_target_in_target_rad_s),
        ]
    return "\n".join([*lines, dialect.end, ""]).encode()


def time_line(t_ns: int) -> str:
    """Return 42's time line, UTC: year, day of the year, hours, minutes, seconds."""
    seconds, fraction_ns = divmod(t_ns, NS_PER_S)
    return f"{datetime.fromtimestamp(seconds, UTC):TIME %Y-%j-%H:%M:%S}.{fraction_ns:09d}"
