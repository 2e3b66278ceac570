"""The bus: how nodes meet without knowing each other.  The only module that imports Zenoh.

By default all sessions are peers on this machine: one, the hub, listens at a known endpoint; the others
connect to it, hear of each other by gossip and link up directly.  Multicast is off.  Through a router the
same sessions are its clients.

A message travels as its protobuf bytes with its stamp as the attachment.  Beside the topics every node has
two keys of its own: a liveliness token ``relnav/<vehicle>/@node/<name>/alive``, and
``relnav/<vehicle>/@node/<name>/credit``, JSON, by which replays are lossless.

Zenoh's threads only fill the mailbox: all work is done by the one thread that empties it.
"""

from __future__ import annotations

import json
import socket
import threading
import time
from collections import deque
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from types import TracebackType
from typing import Any, Literal

import zenoh
from zenoh import ext

from schemas import CodecError, Envelope, Stamp, Topic
from schemas.codec import schema_name

DEFAULT_PORT = 7447
"""Zenoh's own, where a live run can be joined."""
_RETRY = {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 1.5}
_ROUTER_PATIENCE_MS = 10_000
# The library's own type stubs want arguments that it has no use for.
_RECOVERY = ext.RecoveryConfig(heartbeat=True)  # type: ignore[call-arg]
_MISS_DETECTION = ext.MissDetectionConfig(heartbeat=0.2)  # type: ignore[call-arg]


class BusError(ValueError):
    """The bus cannot be opened; the message says why and what to do."""


@dataclass(frozen=True)
class Link:
    """How a session reaches the others: as the hub itself, as a peer of the hub, or as a client of a router."""

    endpoint: str
    """Such as "tcp/127.0.0.1:7447"."""
    role: Literal["hub", "peer", "client"]

    def config(self) -> dict[str, Any]:
        """Return Zenoh's configuration, as key and JSON-like value."""
        config: dict[str, Any] = {
            "mode": "client" if self.role == "client" else "peer",
            "scouting/multicast/enabled": False,
            "scouting/gossip/enabled": True,
            "timestamping/enabled": True,
        }
        if self.role == "hub":
            return config | {"listen/endpoints": [self.endpoint]}
        config |= {"connect/endpoints": [self.endpoint], "connect/retry": _RETRY}
        if self.role == "client":
            return config | {"connect/timeout_ms": _ROUTER_PATIENCE_MS}
        return config | {"listen/endpoints": ["tcp/127.0.0.1:0"]}


@dataclass(frozen=True)
class Received:
    """An envelope and when it arrived here, UTC."""

    envelope: Envelope
    t_receipt_ns: int


@dataclass(frozen=True)
class Presence:
    """A node came or went."""

    node: str
    alive: bool


@dataclass(frozen=True)
class Credit:
    """What a node has dealt with: every frame up to ``sequence``, so many latched values; and all it published,
    once it has ended.
    """

    node: str
    sequence: int = -1
    latched: int = 0
    ended: bool = False
    published: dict[str, int] = field(default_factory=dict)
    """Messages by topic name; counted by the others before they end in their turn."""


Event = Received | Presence | Credit


class Mailbox:
    """Events in the order of their arrival; of a newest-wins topic only the newest is kept."""

    def __init__(self) -> None:
        self._events: deque[Event | str] = deque()
        self._newest: dict[str, Received] = {}
        self._filled = threading.Condition()

    def put(self, event: Event) -> None:
        """Add an event at the end."""
        with self._filled:
            self._events.append(event)
            self._filled.notify()

    def put_newest(self, received: Received) -> None:
        """Add an envelope, in the place of an unread one with the same key if there is one."""
        key = received.envelope.key
        with self._filled:
            if key not in self._newest:
                self._events.append(key)
            self._newest[key] = received
            self._filled.notify()

    def get(self, timeout_s: float) -> Event | None:
        """Return the next event, or None when there is none within ``timeout_s``."""
        with self._filled:
            if not self._filled.wait_for(lambda: self._events, timeout_s):
                return None
            event = self._events.popleft()
            return self._newest.pop(event) if isinstance(event, str) else event


class Bus:
    """One node's session.

    ``lossless``: publishing waits for room instead of dropping, and every frame is kept; for replays.
    Otherwise a slow reader is given the newest frame and gaps show in the sequence numbers.
    """

    def __init__(self, link: Link, *, vehicle: str, node: str, lossless: bool) -> None:
        self.mailbox = Mailbox()
        self._vehicle, self._node, self._lossless = vehicle, node, lossless
        self._session = _open(link)
        self._publishers: dict[str, Any] = {}
        self._kept: list[Any] = []  # subscribers and tokens live as long as something holds them
        self._last_latched: dict[str, tuple[Stamp, bytes]] = {}

    def publish(self, envelope: Envelope) -> None:
        """Send an envelope to whoever subscribed."""
        publisher = self._publishers.get(envelope.key)
        if publisher is None:
            publisher = self._publishers[envelope.key] = self._declare_publisher(envelope.topic, envelope.key)
        publisher.put(envelope.payload, attachment=envelope.stamp.pack())

    def subscribe(self, topics: Iterable[Topic], *, camera: str = "*", keep_all: bool = False) -> None:
        """Have the topics' envelopes put in the mailbox; of latched topics, the last value at once.

        ``keep_all``: every frame of a live run too, not only the newest.
        """
        for topic in topics:
            key = topic.key(vehicle=self._vehicle, camera=camera)
            newest_wins = topic.newest_wins and not self._lossless and not keep_all

            def on_sample(sample: zenoh.Sample, topic: Topic = topic, newest_wins: bool = newest_wins) -> None:
                self._receive(topic, sample, newest_wins=newest_wins)

            if topic.latched:
                history = ext.HistoryConfig(max_samples=1, detect_late_publishers=True)
                self._kept.append(
                    ext.declare_advanced_subscriber(self._session, key, on_sample, history=history, recovery=_RECOVERY)
                )
            else:
                self._kept.append(self._session.declare_subscriber(key, on_sample))

    def watch(self, nodes: Iterable[str] | None = None) -> None:
        """Have nodes' comings, goings and credits put in the mailbox; all nodes' by default."""
        for node in ["*"] if nodes is None else nodes:
            alive = self._node_key(node, "alive")
            self._kept.append(
                self._session.liveliness().declare_subscriber(alive, self._receive_presence, history=True)
            )
            credit = self._node_key(node, "credit")
            self._kept.append(self._session.declare_subscriber(credit, self._receive_credit))

    def announce(self) -> None:
        """Tell the others that this node is ready: to be called when all subscriptions are made."""
        self._kept.append(self._session.liveliness().declare_token(self._node_key(self._node, "alive")))

    def send(self, credit: Credit) -> None:
        """Tell the others what a node has dealt with: this one, or one that can no longer speak for itself."""
        key = self._node_key(credit.node, "credit")
        publisher = self._publishers.get(key)
        if publisher is None:
            publisher = self._publishers[key] = self._session.declare_publisher(
                key, congestion_control=zenoh.CongestionControl.BLOCK, express=True
            )
        publisher.put(json.dumps(asdict(credit)).encode())

    @property
    def session_id(self) -> str:
        """Return the session's Zenoh id, as it is written in the keys of others' liveliness tokens."""
        return str(self._session.zid())

    def declare_foreign(self, token: str) -> None:
        """Be known to another system, such as ROS 2, by a liveliness token of its own kind."""
        self._kept.append(self._session.liveliness().declare_token(token))

    def publish_foreign(self, key: str, payload: bytes, attachment: bytes | None = None) -> None:
        """Send bytes under a key that is not in our table of topics; they are dropped where a reader is slow."""
        publisher = self._publishers.get(key)
        if publisher is None:
            publisher = self._publishers[key] = self._session.declare_publisher(
                key, congestion_control=zenoh.CongestionControl.DROP, express=True
            )
        publisher.put(payload, attachment=attachment)

    def close(self) -> None:
        """Leave the bus; without this a process can hang at its exit."""
        self._session.close()

    def __enter__(self) -> Bus:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.close()

    def _node_key(self, node: str, what: str) -> str:
        return f"relnav/{self._vehicle}/@node/{node}/{what}"

    def _declare_publisher(self, topic: Topic, key: str) -> Any:
        may_drop = not self._lossless and not topic.latched
        options: dict[str, Any] = {
            "encoding": zenoh.Encoding("application/protobuf").with_schema(schema_name(topic.schema)),
            "congestion_control": zenoh.CongestionControl.DROP if may_drop else zenoh.CongestionControl.BLOCK,
            "reliability": zenoh.Reliability.RELIABLE,
            "express": True,
        }
        if not topic.latched:
            return self._session.declare_publisher(key, **options)
        return ext.declare_advanced_publisher(
            self._session,
            key,
            cache=ext.CacheConfig(max_samples=1),
            publisher_detection=True,
            sample_miss_detection=_MISS_DETECTION,
            **options,
        )

    def _receive(self, topic: Topic, sample: zenoh.Sample, *, newest_wins: bool) -> None:
        t_receipt_ns = time.time_ns()
        attachment = sample.attachment
        try:
            stamp = Stamp.unpack(b"" if attachment is None else attachment.to_bytes())
        except CodecError:
            return  # a stranger's sample on our key: without a stamp it has no place in the sequence
        # Bytes at once: a kept sample would hold its sender's shared memory.
        envelope = Envelope(topic, str(sample.key_expr), sample.payload.to_bytes(), stamp)
        if topic.latched:
            value = (stamp, envelope.payload)
            if self._last_latched.get(envelope.key) == value:
                return  # history and the live value are the same one
            self._last_latched[envelope.key] = value
        received = Received(envelope, t_receipt_ns)
        if newest_wins:
            self.mailbox.put_newest(received)
        else:
            self.mailbox.put(received)

    def _receive_presence(self, sample: zenoh.Sample) -> None:
        node = str(sample.key_expr).split("/")[-2]
        self.mailbox.put(Presence(node, alive=sample.kind == zenoh.SampleKind.PUT))

    def _receive_credit(self, sample: zenoh.Sample) -> None:
        self.mailbox.put(Credit(**json.loads(sample.payload.to_bytes())))


def free_endpoint() -> str:
    """Return an endpoint on this machine whose port nobody uses at the moment."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def _open(link: Link) -> zenoh.Session:
    config = zenoh.Config()
    try:
        for key, value in link.config().items():
            config.insert_json5(key, json.dumps(value))
        return zenoh.open(config)
    except zenoh.ZError as error:
        if link.role == "hub":
            raise BusError(
                f"cannot listen on {link.endpoint}: is the port in use? Stop the other run, or choose another "
                "port, 65535 at most, with --listen tcp/127.0.0.1:PORT"
            ) from error
        raise BusError(
            f"cannot reach a Zenoh router at {link.endpoint}. Is it running, and is the address of the form "
            "tcp/HOST:7447?"
        ) from error
