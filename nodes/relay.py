"""The relay: hands every state on to consumers that are not on the bus.

What is sent, and how a state that is not trusted shows there, is said in ``pipeline.adapters``.  A consumer that is
slow or absent costs the others nothing.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from nodes.bus import Bus, Link, Received
from nodes.outlets import Address, FortyTwoOutlet, Outlet, Ros2Outlet, UdpOutlet
from pipeline.adapters import fortytwo, udp
from pipeline.adapters.ros2 import Ros2Encoder
from schemas import Envelope, RelativeState

DATAGRAMS = {"udp": udp.packet, "udp+json": udp.json_line}
DIALECTS = {"42": fortytwo.CURRENT, "42+brackets": fortytwo.BRACKETS}
ROS_KINDS = ("ros2", "ros2dds")
FORMS = (
    "udp://HOST:PORT, udp+json://HOST:PORT, 42://HOST:PORT[/SC], 42+brackets://HOST:PORT[/SC], "
    "ros2[://HOST:PORT], ros2dds[://HOST:PORT]"
)
_DESTINATION = re.compile(r"([a-z0-9+]+)(?:://(\[[^]]+\]|[^:/]+):(\d{1,5})(?:/(\d{1,3}))?)?")


@dataclass(frozen=True)
class Destination:
    """Where states go."""

    text: str
    """As the user wrote it."""
    kind: str
    host: str
    """Empty: ROS 2 on the relay's own session."""
    port: int
    spacecraft: int


def parse_destination(text: str) -> Destination:
    """Read what follows ``--to``.  Raises ValueError that shows the forms."""
    match = _DESTINATION.fullmatch(text)
    kind, host, port, spacecraft = match.groups(default="") if match else ("", "", "", "")
    ros, forty_two = kind in ROS_KINDS, kind in DIALECTS
    if not (ros or forty_two or kind in DATAGRAMS) or not (host or ros) or (spacecraft and not forty_two):
        raise ValueError(f"cannot send states to {text!r}: the forms are {FORMS}")
    return Destination(text, kind, host, int(port or 0), int(spacecraft or 0))


def open_outlet(destination: Destination, vehicle: str, bus: Bus) -> Outlet:
    """Return the outlet for a destination.  Raises ValueError when its host is unknown, or an extra is missing."""
    kind, host, port = destination.kind, destination.host, destination.port
    if kind in ROS_KINDS:
        encoder = Ros2Encoder(vehicle)
        own = _session(f"tcp/{host}:{port}", vehicle) if host else None
        return Ros2Outlet(encoder, own or bus, bridged=kind == "ros2dds", owned=own)
    address = Address.resolve(host, port)
    if kind in DATAGRAMS:
        return UdpOutlet(address, DATAGRAMS[kind])
    return FortyTwoOutlet(address, destination.spacecraft, DIALECTS[kind])


def _session(endpoint: str, vehicle: str) -> Bus:
    return Bus(Link(endpoint, "client"), vehicle=vehicle, node="relay", lossless=False)


class RelayWork:
    """Takes states off the bus and hands each to all outlets, by the names the user gave them."""

    def __init__(self, outlets: Sequence[tuple[str, Outlet]], warn: Callable[[str], None]) -> None:
        self._outlets, self._warn = outlets, warn
        self._failing: set[str] = set()

    def handle(self, received: Received) -> Iterable[Envelope]:
        """Hand on one state.  Tells when an outlet begins to fail, and when it works again."""
        state = received.envelope.message()
        assert isinstance(state, RelativeState)
        for name, outlet in self._outlets:
            try:
                sent = outlet.send(state, received.envelope.stamp)
            except (OSError, ValueError) as error:
                if name not in self._failing:
                    self._failing.add(name)
                    self._warn(f"{name}: {_reason(error)}; it is tried again")
                continue
            if sent and name in self._failing:
                self._failing.discard(name)
                self._warn(f"{name}: states go out again")
        return []

    def refuse(self, envelope: Envelope) -> Iterable[Envelope]:
        """Nothing follows from a state that could not be read."""
        return []

    def idle(self, t_ns: int) -> Iterable[Envelope]:
        """Nothing is due: no state is made up where none came."""
        return []

    def close(self) -> None:
        """Close all outlets."""
        for _, outlet in self._outlets:
            outlet.close()


def _reason(error: Exception) -> str:
    return (error.strerror if isinstance(error, OSError) else None) or str(error)
