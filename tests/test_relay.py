"""The relay: what consumers get through real sockets and sessions, and that an absent one costs the others nothing."""

import json
import socket
import subprocess
import sys
import time
from collections.abc import Iterator

import pytest
import zenoh

from nodes.bus import Bus, Link, Presence, Received, free_endpoint
from nodes.outlets import Address, FortyTwoOutlet, Outlet
from nodes.relay import Destination, RelayWork, open_outlet, parse_destination
from pipeline.adapters import fortytwo, udp
from pipeline.adapters.ros2 import Ros2Encoder
from schemas import Envelope, Mode, RelativeState, Stamp
from tests.some_states import load_example, some_state

PATIENCE_S = 10.0


def received(state: RelativeState, sequence: int = 0) -> Received:
    return Received(Envelope.wrap(state, Stamp(sequence, state.t_capture_ns, 0), vehicle="chaser"), 0)


@pytest.fixture
def listening() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
        listener.bind(("127.0.0.1", 0))
        listener.settimeout(PATIENCE_S)
        yield listener


@pytest.fixture
def server() -> Iterator[socket.socket]:
    """Where 42 listens."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        listener.settimeout(PATIENCE_S)
        yield listener


@pytest.fixture
def bus() -> Iterator[Bus]:
    with Bus(Link(free_endpoint(), "hub"), vehicle="chaser", node="supervisor", lossless=False) as hub:
        yield hub


def opened(text: str, bus: Bus) -> Outlet:
    return open_outlet(parse_destination(text), "chaser", bus)


def relay_to(*outlets: tuple[str, Outlet]) -> tuple[RelayWork, list[str]]:
    warnings: list[str] = []
    return RelayWork(outlets, warnings.append), warnings


@pytest.mark.parametrize("kind", ["udp", "udp+json"])
def test_every_state_is_a_datagram(listening, bus, kind):
    decode = load_example("udp_listen").decode
    work, warnings = relay_to((kind, opened(f"{kind}://127.0.0.1:{listening.getsockname()[1]}", bus)))
    for k, mode in enumerate(Mode):
        work.handle(received(some_state(mode), k))
    got = [decode(listening.recv(65535)) for _ in Mode]
    assert [(one["sequence"], one["mode"], one["valid"]) for one in got] == [
        (k, mode.name, mode == Mode.TRACK) for k, mode in enumerate(Mode)
    ]
    work.close()
    assert not warnings


def send_until(outlet: FortyTwoOutlet, state: RelativeState) -> None:
    """Send a state as soon as the outlet takes one."""
    deadline_s = time.monotonic() + PATIENCE_S
    while not outlet.send(state, Stamp(0, 0, 0)):
        assert time.monotonic() < deadline_s
        time.sleep(0.01)


def forty_two(server: socket.socket) -> FortyTwoOutlet:
    return FortyTwoOutlet(Address(socket.AF_INET, server.getsockname()), 0, fortytwo.CURRENT)


def test_42_gets_one_message_for_each_answer(server):
    """While 42 thinks, states are let go; after its answer it gets the newest."""
    outlet = forty_two(server)
    first, skipped, newest = (some_state(seed=k) for k in range(3))
    send_until(outlet, first)
    connection, _ = server.accept()
    with connection:
        assert connection.recv(16384) == fortytwo.message(first)
        assert not outlet.send(skipped, Stamp(1, 0, 0))
        connection.sendall(b"Ack\n")
        send_until(outlet, newest)
        assert connection.recv(16384) == fortytwo.message(newest)
    outlet.close()


def test_42_may_come_late_and_go(server, monkeypatch):
    monkeypatch.setattr("nodes.outlets.CALL_PERIOD_S", 0.0)
    outlet = forty_two(server)
    send_until(outlet, some_state())
    server.accept()[0].close()
    with pytest.raises(OSError, match=r"hung up|reset"):
        send_until(outlet, some_state())
    send_until(outlet, some_state())
    connection, _ = server.accept()
    assert connection.recv(16384) == fortytwo.message(some_state())
    connection.close()
    outlet.close()


def test_an_absent_42_is_told_once_and_costs_the_others_nothing(listening, bus, server, monkeypatch):
    monkeypatch.setattr("nodes.outlets.CALL_PERIOD_S", 0.0)
    address = server.getsockname()
    server.close()
    here = f"udp://127.0.0.1:{listening.getsockname()[1]}"
    there = f"42://127.0.0.1:{address[1]}"
    work, warnings = relay_to(*((name, opened(name, bus)) for name in (there, here)))
    for k in range(20):
        work.handle(received(some_state(), k))
        time.sleep(0.005)
    assert [listening.recv(2000) for _ in range(20)] == [udp.packet(some_state(), k) for k in range(20)]
    assert warnings == [f"{there}: Connection refused; it is tried again"]
    with socket.create_server(address) as back:
        deadline_s = time.monotonic() + PATIENCE_S
        while len(warnings) < 2 and time.monotonic() < deadline_s:
            work.handle(received(some_state(), 20))
            time.sleep(0.01)
        back.settimeout(PATIENCE_S)
        back.accept()[0].close()
    assert warnings[1:] == [f"{there}: states go out again"]
    work.close()


def test_a_state_that_one_consumer_cannot_hold_reaches_the_others(listening, bus):
    """A clock beyond 2038, which ROS cannot stamp."""
    pytest.importorskip("rosbags", reason="the extra `ros2` is not installed")
    here = f"udp://127.0.0.1:{listening.getsockname()[1]}"
    work, warnings = relay_to(*((name, opened(name, bus)) for name in ("ros2", here)))
    state = some_state(t_ns=2**62)
    for k in range(2):
        work.handle(received(state, k))
    assert [listening.recv(2000) for _ in range(2)] == [udp.packet(state, k) for k in range(2)]
    work.close()
    (warning,) = warnings
    assert warning.startswith("ros2: t_capture_ns") and "2038" in warning


@pytest.mark.parametrize("kind", ["ros2", "ros2dds"])
def test_ros_hears_tracked_states_on_its_own_keys(bus, monkeypatch, kind):
    pytest.importorskip("rosbags", reason="the extra `ros2` is not installed")
    monkeypatch.setenv("ROS_DOMAIN_ID", "3")
    outlet = opened(kind, bus)
    samples: list[zenoh.Sample] = []
    subscriber = bus._session.declare_subscriber("3/**" if kind == "ros2" else "**", samples.append)
    work, _ = relay_to((kind, outlet))
    for mode in Mode:
        work.handle(received(some_state(mode)))
    deadline_s = time.monotonic() + PATIENCE_S
    while len(samples) < 2 and time.monotonic() < deadline_s:
        time.sleep(0.01)
    time.sleep(0.1)
    expected = {
        topic.key(3) if kind == "ros2" else topic.name: cdr
        for topic, cdr in Ros2Encoder("chaser").messages(some_state())
    }
    assert {str(sample.key_expr): sample.payload.to_bytes() for sample in samples} == expected
    assert len(samples) == 2, "one of each, for the state in TRACK alone"
    for sample in samples:
        if kind == "ros2":
            number, t_ns, gid = zenoh.ext.z_deserialize(
                tuple[zenoh.ext.Int64, zenoh.ext.Int64, bytes], sample.attachment
            )
            assert number == 1 and abs(t_ns - time.time_ns()) < 60e9 and len(gid) == 16
        else:
            assert sample.attachment is None
    tokens = [str(reply.ok.key_expr) for reply in bus._session.liveliness().get("@ros2_lv/3/**")]
    assert len(tokens) == (3 if kind == "ros2" else 0)
    assert all(bus.session_id in token and "/relnav_relay" in token for token in tokens)
    subscriber.undeclare()


def test_a_ros_domain_that_is_no_number_is_refused(bus, monkeypatch):
    pytest.importorskip("rosbags", reason="the extra `ros2` is not installed")
    monkeypatch.setenv("ROS_DOMAIN_ID", "mars")
    with pytest.raises(ValueError, match="ROS_DOMAIN_ID must be a number, got 'mars'"):
        opened("ros2", bus)


def test_without_rosbags_the_repair_is_named(bus, monkeypatch):
    monkeypatch.setitem(sys.modules, "rosbags.typesys", None)
    with pytest.raises(ValueError, match="make setup EXTRAS=ros2"):
        opened("ros2", bus)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "udp",
        "udp://nowhere",
        "udp://:5",
        "udp://h:5/1",
        "tcp://h:5",
        "42",
        "42://h",
        "ros2://h",
        "ros2/1",
        "udp://h:99999999",
    ],
)
def test_a_destination_of_no_known_form_is_refused(text):
    with pytest.raises(ValueError, match="the forms are udp://HOST:PORT"):
        parse_destination(text)


def test_a_destination_is_read():
    assert parse_destination("42+brackets://[::1]:10001/2") == Destination(
        "42+brackets://[::1]:10001/2", "42+brackets", "[::1]", 10001, 2
    )
    assert parse_destination("ros2").host == ""


@pytest.mark.parametrize("text", ["udp://no.such.host.invalid:5", "42://127.0.0.1:99999"])
def test_a_host_or_port_that_is_none_is_refused(bus, text):
    with pytest.raises(ValueError, match="cannot find"):
        opened(text, bus)


@pytest.mark.slow
def test_the_relay_node_joins_a_run(listening):
    """A process of its own, as users start it: a state on the bus becomes a datagram, and it stops when told."""
    endpoint = free_endpoint()
    with Bus(Link(endpoint, "hub"), vehicle="chaser", node="pose_filter", lossless=False) as hub:
        hub.watch(["relay"])
        where = f"udp+json://127.0.0.1:{listening.getsockname()[1]}"
        command = [sys.executable, "-m", "nodes", "node", "relay", "--connect", endpoint, "--to", where]
        process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        try:
            assert hub.mailbox.get(60.0) == Presence("relay", alive=True)
            hub.publish(received(some_state(), 5).envelope)
            line = json.loads(listening.recv(65535))
        finally:
            process.terminate()
            _, errors = process.communicate(timeout=30)
    assert (line["sequence"], line["valid"]) == (5, True)
    assert (process.returncode, errors) == (0, "")
