"""Sessions meet over Zenoh: what is published arrives byte for byte, latched values wait, the newest frame wins."""

import json
import time

import pytest
import zenoh

from nodes import bus as bus_module
from nodes.bus import Bus, BusError, Credit, Event, Link, Mailbox, Presence, Received, free_endpoint
from schemas import Envelope, Stamp, Topic
from schemas.topics import CALIBRATION, DETECTIONS, FRAME

PATIENCE_S = 10.0


def envelope(topic: Topic, sequence: int, payload: bytes = b"payload") -> Envelope:
    key = topic.key(vehicle="v", camera="nav")
    return Envelope(topic, key, payload, Stamp(sequence, 1_000 + sequence, 2_000 + sequence))


def received(bus: Bus) -> Received:
    event = bus.mailbox.get(PATIENCE_S)
    assert isinstance(event, Received), event
    return event


@pytest.fixture
def endpoint():
    """A hub's endpoint; the hub is there as long as the test."""
    where = free_endpoint()
    with Bus(Link(where, "hub"), vehicle="v", node="supervisor", lossless=True):
        yield where


def open_peer(endpoint: str, node: str, *, lossless: bool = True, role: str = "peer") -> Bus:
    return Bus(Link(endpoint, role), vehicle="v", node=node, lossless=lossless)


def introduce(publisher: Bus, subscriber: Bus, name: str) -> None:
    """Wait until the publisher knows the subscriber and its subscriptions."""
    subscriber.announce()
    publisher.watch([name])
    assert publisher.mailbox.get(PATIENCE_S) == Presence(name, alive=True)


def test_envelopes_arrive_byte_for_byte_and_in_order(endpoint):
    """A hundred frames of 100 kB between two peers that never heard of each other but through the hub."""
    with open_peer(endpoint, "a") as a, open_peer(endpoint, "b") as b:
        b.subscribe([FRAME], camera="nav")
        introduce(a, b, "b")
        sent = [envelope(FRAME, k, bytes([k]) * 100_000) for k in range(100)]
        for one in sent:
            a.publish(one)
        assert [received(b).envelope for _ in sent] == sent


def test_a_late_subscriber_is_given_the_latched_value_once(endpoint):
    """The calibration was published before the subscriber was there, and again when it is: one arrives."""
    with open_peer(endpoint, "a") as a, open_peer(endpoint, "b") as b:
        a.publish(envelope(CALIBRATION, 0))
        time.sleep(0.2)
        b.subscribe([CALIBRATION], camera="nav")
        assert received(b).envelope == envelope(CALIBRATION, 0)
        a.publish(envelope(CALIBRATION, 0))
        assert b.mailbox.get(0.5) is None


def test_a_session_that_closes_is_missed(endpoint):
    with open_peer(endpoint, "a") as a, open_peer(endpoint, "b") as b:
        introduce(a, b, "b")
        b.close()
        assert a.mailbox.get(PATIENCE_S) == Presence("b", alive=False)


def test_credits_arrive_whole(endpoint):
    with open_peer(endpoint, "a") as a, open_peer(endpoint, "b") as b:
        b.watch(["a"])
        introduce(a, b, "b")
        credit = Credit("a", 41, ended=True, published={"detections": 42})
        a.send(credit)
        assert b.mailbox.get(PATIENCE_S) == credit


def test_a_sample_without_a_stamp_is_ignored(endpoint):
    """A stranger publishes on our key: it has no place in the sequence and does not get in."""
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    with open_peer(endpoint, "a") as a, open_peer(endpoint, "b") as b, zenoh.open(config) as stranger:
        b.subscribe([DETECTIONS])
        introduce(a, b, "b")
        stranger.put(DETECTIONS.key(vehicle="v"), b"no stamp")
        time.sleep(0.2)
        a.publish(envelope(DETECTIONS, 3))
        assert received(b).envelope == envelope(DETECTIONS, 3)


def test_the_same_nodes_meet_through_a_router():
    """One option makes every node a client of a router: frames, latched values, presence and credits pass."""
    where = free_endpoint()
    config = zenoh.Config()
    config.insert_json5("mode", '"router"')
    config.insert_json5("listen/endpoints", json.dumps([where]))
    config.insert_json5("scouting/multicast/enabled", "false")
    with zenoh.open(config), open_peer(where, "a", role="client") as a, open_peer(where, "b", role="client") as b:
        b.subscribe([FRAME, CALIBRATION], camera="nav")
        introduce(a, b, "b")
        a.publish(envelope(CALIBRATION, 0))
        assert received(b).envelope == envelope(CALIBRATION, 0)
        for k in range(20):
            a.publish(envelope(FRAME, k, bytes(100_000)))
        assert [received(b).envelope.stamp.sequence for _ in range(20)] == list(range(20))


def test_a_port_in_use_is_one_clear_error(endpoint):
    with pytest.raises(BusError, match=r"port in use\?.*--listen"):
        Bus(Link(endpoint, "hub"), vehicle="v", node="other", lossless=True)


def test_a_router_that_is_not_there_is_one_clear_error(monkeypatch):
    monkeypatch.setattr(bus_module, "_ROUTER_PATIENCE_MS", 300)
    with pytest.raises(BusError, match="cannot reach a Zenoh router"):
        open_peer(free_endpoint(), "a", role="client")


def test_live_the_newest_frame_wins_and_small_topics_queue(endpoint):
    """A reader that slept finds every detection, and of the frames the last one."""
    with open_peer(endpoint, "a", lossless=False) as a, open_peer(endpoint, "b", lossless=False) as b:
        b.subscribe([FRAME, DETECTIONS], camera="nav")
        introduce(a, b, "b")
        for k in range(10):
            a.publish(envelope(FRAME, k))
            a.publish(envelope(DETECTIONS, k))
        time.sleep(0.5)
        got: list[Event] = []
        while (event := b.mailbox.get(0.2)) is not None:
            got.append(event)
        sequences = [(e.envelope.topic, e.envelope.stamp.sequence) for e in got if isinstance(e, Received)]
        assert [k for topic, k in sequences if topic is FRAME] == [9]
        assert [k for topic, k in sequences if topic is DETECTIONS] == list(range(10))


def test_the_mailbox_keeps_the_place_of_a_replaced_frame():
    mailbox = Mailbox()
    first, second = Received(envelope(FRAME, 0), 0), Received(envelope(FRAME, 1), 1)
    small = Received(envelope(DETECTIONS, 0), 0)
    mailbox.put_newest(first)
    mailbox.put(small)
    mailbox.put_newest(second)
    assert [mailbox.get(0), mailbox.get(0), mailbox.get(0)] == [second, small, None]
