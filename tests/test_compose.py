"""compose.yaml without Docker: its services' own commands, each in a network namespace, around a real router.

The router is a Zenoh session in router mode, which is what the image's ``zenohd`` hosts.
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest
import yaml

from nodes.processes import PROCESSES

ROOT = Path(__file__).resolve().parent.parent
RELNAV = [sys.executable, "-m", "nodes"]
ROUTER = """
import json, time, zenoh
config = zenoh.Config()
config.insert_json5("mode", json.dumps("router"))
config.insert_json5("listen/endpoints", json.dumps(["tcp/0.0.0.0:7447"]))
config.insert_json5("scouting/multicast/enabled", json.dumps(False))
with zenoh.open(config):
    print("ready", flush=True)
    time.sleep(120)
"""


@pytest.fixture(scope="module")
def compose() -> dict[str, Any]:
    return yaml.safe_load((ROOT / "compose.yaml").read_text())


def command_of(service: dict[str, Any]) -> list[str]:
    """Return a service's command as a shell-less list, with the defaults of its ${VARIABLES}."""
    words = shlex.split(re.sub(r"\$\{\w+:-([^}]*)\}", r"\1", service["command"]))
    assert words[0] == "relnav"
    return words[1:]


def test_there_is_one_service_for_each_node_and_a_router(compose: dict[str, Any]) -> None:
    assert set(compose["services"]) == {"router", *(process.name for process in PROCESSES)}


def test_every_node_runs_its_own_name_from_the_one_image_and_meets_at_the_router(compose: dict[str, Any]) -> None:
    for process in PROCESSES:
        service = compose["services"][process.name]
        words = command_of(service)
        assert words[:2] == ["node", process.name]
        assert words[words.index("--connect") + 1] == "tcp/router:7447"
        assert service["image"] == "astratag-relnav"
        assert service["init"] is True


def test_the_image_copies_every_package() -> None:
    dockerfile = (ROOT / "Dockerfile").read_text()
    for package in ("astratag", "schemas", "pipeline", "nodes", "recordings"):
        assert f"COPY {package} {package}" in dockerfile


def run(*words: str) -> None:
    subprocess.run(words, check=True, capture_output=True)


def can_make_namespaces() -> bool:
    if os.geteuid() != 0 or shutil.which("ip") is None:
        return False
    probe = f"relnav-probe-{os.getpid()}"
    made = subprocess.run(["ip", "netns", "add", probe], capture_output=True, check=False).returncode == 0
    if made:
        run("ip", "netns", "delete", probe)
    return made


@contextmanager
def hosts(names: list[str]) -> Iterator[dict[str, str]]:
    """Yield a namespace for each name, all on one bridge, in which ``router`` resolves to the router's address."""
    tag = f"rn{os.getpid() % 10000}"
    switch = f"{tag}-switch"
    namespaces = {name: f"{tag}-{name}" for name in names}
    etc = Path("/etc/netns")
    made_etc = not etc.exists()
    try:
        run("ip", "netns", "add", switch)
        run("ip", "-n", switch, "link", "add", "br0", "type", "bridge")
        run("ip", "-n", switch, "link", "set", "br0", "up")
        for number, namespace in enumerate(namespaces.values(), start=1):
            port = f"p{number}"
            run("ip", "netns", "add", namespace)
            run("ip", "-n", switch, "link", "add", port, "type", "veth", "peer", "name", "eth0", "netns", namespace)
            run("ip", "-n", switch, "link", "set", port, "master", "br0", "up")
            run("ip", "-n", namespace, "address", "add", f"10.77.0.{number}/24", "dev", "eth0")
            run("ip", "-n", namespace, "link", "set", "eth0", "up")
            run("ip", "-n", namespace, "link", "set", "lo", "up")
            (etc / namespace).mkdir(parents=True)
            (etc / namespace / "hosts").write_text(f"127.0.0.1 localhost\n10.77.0.{names.index('router') + 1} router\n")
        yield namespaces
    finally:
        for namespace in (*namespaces.values(), switch):
            subprocess.run(["ip", "netns", "delete", namespace], capture_output=True, check=False)
            shutil.rmtree(etc / namespace, ignore_errors=True)
        if made_etc:
            shutil.rmtree(etc, ignore_errors=True)


@pytest.mark.skipif(not can_make_namespaces(), reason="needs root and network namespaces (ip netns)")
def test_the_services_find_each_other_through_the_router_and_record(compose: dict[str, Any], tmp_path: Path) -> None:
    """Each service alone on its host: states come out at the recorder, which closes its file when stopped."""
    from pipeline.recording import Recording
    from schemas import Mode
    from schemas.topics import STATE

    out = tmp_path / "out"
    with hosts(list(compose["services"])) as namespaces, ExitStack() as stack:

        def start(name: str, words: list[str]) -> subprocess.Popen[str]:
            log = stack.enter_context((tmp_path / f"{name}.log").open("w+"))
            inside = ["ip", "netns", "exec", namespaces[name], *words]
            process = subprocess.Popen(inside, cwd=ROOT, stdout=log, stderr=subprocess.STDOUT, text=True)
            stack.callback(process.wait)
            stack.callback(process.terminate)
            return process

        start("router", [sys.executable, "-c", ROUTER])
        nodes = {}
        for process in reversed(PROCESSES):
            words = [str(out) if word == "/out" else word for word in command_of(compose["services"][process.name])]
            nodes[process.name] = start(process.name, [*RELNAV, *words])
        deadline = time.monotonic() + 60
        while not (out / "run.mcap").exists() and time.monotonic() < deadline:
            time.sleep(0.2)
        time.sleep(8)
        logs = {name: (tmp_path / f"{name}.log").read_text() for name in nodes}
        assert all(process.poll() is None for process in nodes.values()), logs
        nodes["recorder"].terminate()
        assert nodes["recorder"].wait(timeout=15) == 0, logs
    states = list(Recording(out / "run.mcap").messages(STATE))
    assert sum(state.mode == Mode.TRACK for state in states) > 10
