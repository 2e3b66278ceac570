"""Outlets: how states leave for consumers that are not on the bus.  None ever waits for its consumer."""

from __future__ import annotations

import os
import select
import socket
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from nodes.bus import Bus
from pipeline.adapters import fortytwo
from pipeline.adapters.ros2 import Ros2Encoder, RosTopic, attachment, node_token
from schemas import RelativeState, Stamp

CALL_PERIOD_S = 1.0
"""How often an absent 42 is called."""


class Outlet(Protocol):
    """One consumer."""

    def send(self, state: RelativeState, stamp: Stamp) -> bool:
        """Hand on one state; False when the consumer is not ready for it, or is not told of it.

        Raises OSError when it cannot be reached, ValueError when its format cannot hold the state; the next state is
        tried all the same.
        """
        ...

    def close(self) -> None:
        """Let go of what it holds."""
        ...


@dataclass(frozen=True)
class Address:
    """A resolved host and port."""

    family: socket.AddressFamily
    sockaddr: Any

    @classmethod
    def resolve(cls, host: str, port: int) -> Address:
        """Look up a host.  Raises ValueError when it is unknown, or the port is none."""
        if not 0 < port < 65536:
            raise ValueError(f"cannot find {host}:{port}: ports are 1 to 65535")
        try:
            family, _, _, _, sockaddr = socket.getaddrinfo(host.strip("[]"), port, type=socket.SOCK_STREAM)[0]
        except (OSError, UnicodeError) as error:
            raise ValueError(f"cannot find {host}:{port}: {error}") from error
        return cls(family, sockaddr)


class UdpOutlet:
    """One datagram a state."""

    def __init__(self, address: Address, encode: Callable[[RelativeState, int], bytes]) -> None:
        self._address, self._encode = address, encode
        self._socket = socket.socket(address.family, socket.SOCK_DGRAM)
        self._socket.setblocking(False)

    def send(self, state: RelativeState, stamp: Stamp) -> bool:
        """Send one datagram."""
        self._socket.sendto(self._encode(state, stamp.sequence), self._address.sockaddr)
        return True

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class FortyTwoOutlet:
    """A TCP connection to 42, which listens (``RX``, ``SERVER`` in its Inp_IPC.txt).

    42 reads one message at a time and answers it: while an answer is due, states are let go, so that the next to be
    sent is the newest.
    """

    def __init__(self, address: Address, spacecraft: int, dialect: fortytwo.Dialect) -> None:
        self._address, self._spacecraft, self._dialect = address, spacecraft, dialect
        self._socket: socket.socket | None = None
        self._connected = False
        self._ack_bytes_due = 0
        self._call_due_s = 0.0

    def send(self, state: RelativeState, stamp: Stamp) -> bool:
        """Send one message if 42 is there and ready for it."""
        try:
            connection = self._connection()
            if connection is None or not self._is_answered(connection):
                return False
            message = fortytwo.message(state, spacecraft=self._spacecraft, dialect=self._dialect)
            if connection.send(message) != len(message):
                raise ConnectionError("42 does not read")
        except OSError:
            self.close()
            raise
        self._ack_bytes_due = fortytwo.ACK_BYTES
        return True

    def close(self) -> None:
        """Hang up."""
        if self._socket is not None:
            self._socket.close()
        self._socket, self._connected, self._ack_bytes_due = None, False, 0

    def _connection(self) -> socket.socket | None:
        """Return the connection once it stands; call again from time to time while it does not."""
        if self._socket is None:
            if time.monotonic() < self._call_due_s:
                return None
            self._call_due_s = time.monotonic() + CALL_PERIOD_S
            self._socket = socket.socket(self._address.family, socket.SOCK_STREAM)
            self._socket.setblocking(False)
            self._socket.connect_ex(self._address.sockaddr)
        if not self._connected:
            _, writable, _ = select.select([], [self._socket], [], 0)
            if not writable:
                return None
            code = self._socket.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
            if code:
                raise ConnectionError(code, os.strerror(code))
            self._connected = True
        return self._socket

    def _is_answered(self, connection: socket.socket) -> bool:
        while self._ack_bytes_due > 0:
            try:
                answer = connection.recv(self._ack_bytes_due)
            except BlockingIOError:
                return False
            if not answer:
                raise ConnectionError("42 hung up")
            self._ack_bytes_due -= len(answer)
        return True


class Ros2Outlet:
    """A publisher for each ROS 2 topic, in a session that ROS 2's router, or its bridge to DDS, hears."""

    def __init__(self, encoder: Ros2Encoder, bus: Bus, *, bridged: bool, owned: Bus | None) -> None:
        self._encoder, self._bus, self._bridged, self._owned = encoder, bus, bridged, owned
        self._domain = _ros_domain()
        self._sent: Counter[RosTopic] = Counter()
        self._tokens: dict[RosTopic, str] = {}
        if not bridged:
            bus.declare_foreign(node_token(self._domain, bus.session_id))
            for entity, topic in enumerate((encoder.pose_topic, encoder.tf_topic), start=1):
                self._tokens[topic] = topic.token(self._domain, bus.session_id, entity)
                bus.declare_foreign(self._tokens[topic])

    def send(self, state: RelativeState, stamp: Stamp) -> bool:
        """Publish the state's messages; none when it is not trusted."""
        messages = self._encoder.messages(state)
        for topic, cdr in messages:
            if self._bridged:
                self._bus.publish_foreign(topic.name, cdr)
                continue
            self._sent[topic] += 1
            beside = attachment(self._sent[topic], time.time_ns(), self._tokens[topic])
            self._bus.publish_foreign(topic.key(self._domain), cdr, beside)
        return bool(messages)

    def close(self) -> None:
        """Close the session if it is the outlet's own."""
        if self._owned is not None:
            self._owned.close()


def _ros_domain() -> int:
    """Return ROS_DOMAIN_ID.  Raises ValueError when it is no number."""
    text = os.environ.get("ROS_DOMAIN_ID") or "0"
    if not text.isdigit():
        raise ValueError(f"ROS_DOMAIN_ID must be a number, got {text!r}")
    return int(text)
