"""``relnav doctor``: check this installation, and say how to mend what is wrong."""

from __future__ import annotations

import argparse
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Literal

from rich.console import Console
from rich.table import Table

Status = Literal["ok", "note", "wrong"]
LIBRARIES = ("numpy", "scipy", "opencv-python-headless", "eclipse-zenoh", "mcap", "rerun-sdk", "pydantic", "protobuf")
LEAST_PYTHON = (3, 11)
LEAST_DISK_MB = 500
LEAST_SHARED_MB = 64
STYLES = {"ok": "green", "note": "yellow", "wrong": "red"}


@dataclass(frozen=True)
class Finding:
    """What a check found, and what to do about it."""

    status: Status
    text: str
    fix: str = ""


def doctor(args: argparse.Namespace) -> int:
    """Run every check and print a table; return 0 when nothing is wrong."""
    findings = {name: _run(check) for name, check in CHECKS.items()}
    table = Table("", "check", "found", "what to do")
    for name, finding in findings.items():
        style = STYLES[finding.status]
        table.add_row(f"[{style}]{finding.status}[/{style}]", name, finding.text, finding.fix)
    Console(highlight=False).print(table)
    wrong = [name for name, finding in findings.items() if finding.status == "wrong"]
    if wrong:
        print(f"relnav: error: {', '.join(wrong)}: see the table", file=sys.stderr)
    return 1 if wrong else 0


def _run(check: Callable[[], Finding]) -> Finding:
    try:
        return check()
    except Exception as error:
        return Finding("wrong", f"{type(error).__name__}: {' '.join(str(error).split())}", "make setup")


def check_python() -> Finding:
    """Tell whether the interpreter is new enough."""
    text = ".".join(map(str, sys.version_info[:3]))
    if sys.version_info < LEAST_PYTHON:
        return Finding("wrong", text, f"use Python {'.'.join(map(str, LEAST_PYTHON))} or newer: make setup PYTHON=...")
    return Finding("ok", text)


def check_libraries() -> Finding:
    """Tell whether the libraries are installed and load."""
    found, missing = [], []
    for name in LIBRARIES:
        try:
            found.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            missing.append(name)
    if missing:
        return Finding("wrong", f"missing: {', '.join(missing)}", "make setup")
    import cv2  # noqa: F401 - loading it is the check

    return Finding("ok", ", ".join(found))


def check_bus() -> Finding:
    """Tell whether two Zenoh sessions on this machine hear each other."""
    from nodes.bus import Bus, Link, Presence, free_endpoint

    endpoint = free_endpoint()
    with (
        Bus(Link(endpoint, "hub"), vehicle="doctor", node="hub", lossless=True) as hub,
        Bus(Link(endpoint, "peer"), vehicle="doctor", node="peer", lossless=True) as peer,
    ):
        hub.watch(["peer"])
        start_s = time.monotonic()
        peer.announce()
        if hub.mailbox.get(5.0) != Presence("peer", alive=True):
            return Finding("wrong", "two sessions on 127.0.0.1 do not hear each other", "allow TCP on the loopback")
        return Finding("ok", f"two sessions met in {1e3 * (time.monotonic() - start_s):.0f} ms")


def check_port() -> Finding:
    """Tell whether the port of a live run's bus is free."""
    from nodes.bus import DEFAULT_PORT, Bus, BusError, Link

    try:
        Bus(Link(f"tcp/127.0.0.1:{DEFAULT_PORT}", "hub"), vehicle="doctor", node="hub", lossless=True).close()
    except BusError:
        return Finding("note", f"{DEFAULT_PORT} is in use", "a live run needs --listen tcp/127.0.0.1:PORT or --connect")
    return Finding("ok", f"{DEFAULT_PORT} is free")


def check_recorder() -> Finding:
    """Tell whether a recording can be written and read back."""
    from pipeline.mission import Mission
    from pipeline.recording import Recording, RecordingWriter
    from schemas import Envelope, NodeHealth, Stamp

    health = NodeHealth(
        t_publish_ns=1, node="doctor", pid=1, uptime_s=0, cpu_s=0, received=0, published=0, dropped=0, refused=0
    )
    with tempfile.TemporaryDirectory() as directory:
        path = Path(directory) / "doctor.mcap"
        with RecordingWriter(path, Mission()) as writer:
            writer.write(Envelope.wrap(health, Stamp(0, 1, 1), vehicle="doctor", node="doctor"), 1)
        count = sum(1 for _ in Recording(path).envelopes())
    return Finding("ok", "a recording is read back whole") if count == 1 else Finding("wrong", "message lost")


def check_display() -> Finding:
    """Tell whether Rerun's window can open."""
    from pipeline.view import has_display

    if has_display():
        return Finding("ok", os.environ.get("WAYLAND_DISPLAY") or os.environ.get("DISPLAY") or "native")
    return Finding("note", "none: no window", "--view web serves a page; run.rrd can be opened elsewhere")


def check_disk() -> Finding:
    """Tell whether there is room for a run."""
    free_mb = shutil.disk_usage(Path.cwd()).free / 1e6
    if free_mb < LEAST_DISK_MB:
        return Finding("wrong", f"{free_mb:.0f} MB free here", "make room, or write elsewhere with --out")
    return Finding("ok", f"{free_mb / 1e3:.1f} GB free here")


def check_shared_memory() -> Finding:
    """Tell whether there is shared memory for large frames."""
    directory = Path("/dev/shm")
    if not directory.is_dir():
        return Finding("note", "no /dev/shm", "frames travel by TCP")
    free_mb = shutil.disk_usage(directory).free / 1e6
    if free_mb < LEAST_SHARED_MB:
        return Finding("note", f"{free_mb:.0f} MB free in /dev/shm", "docker: --shm-size=256m; else frames go by TCP")
    return Finding("ok", f"{free_mb:.0f} MB free in /dev/shm")


def check_cameras() -> Finding:
    """Tell which cameras are there, and whether we may read them."""
    devices = sorted(Path("/dev").glob("video*"))
    closed = [str(device) for device in devices if not os.access(device, os.R_OK | os.W_OK)]
    if closed:
        return Finding("note", f"no access to {', '.join(closed)}", "sudo usermod -aG video $USER, then log in again")
    return Finding("ok" if devices else "note", ", ".join(map(str, devices)) or "none: replays work without")


def check_shipped_recording() -> Finding:
    """Tell whether the shipped recording is there and whole."""
    from nodes.run import SHIPPED_RECORDING
    from pipeline.recording import Recording

    if not SHIPPED_RECORDING.exists():
        return Finding("wrong", f"{SHIPPED_RECORDING} is missing", "git checkout recordings")
    return Finding("ok", f"{Recording(SHIPPED_RECORDING).frame_count} frames")


CHECKS: dict[str, Callable[[], Finding]] = {
    "Python": check_python,
    "libraries": check_libraries,
    "bus": check_bus,
    "live port": check_port,
    "recorder": check_recorder,
    "shipped recording": check_shipped_recording,
    "display": check_display,
    "disk": check_disk,
    "shared memory": check_shared_memory,
    "cameras": check_cameras,
}
