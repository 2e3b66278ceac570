"""Where drawings go: a file, a page that is served, a window that is opened beside the run."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from urllib.parse import quote

import rerun as rr

from pipeline.convert import NS_PER_S

APPLICATION = "relnav"
LOCALHOST = "127.0.0.1"
LIVE_IMAGE_RATE_HZ = 15.0
"""More images a second than this fill a live viewer's memory and show nothing more."""
LIVE_MEMORY = "512MiB"
"""How much of the past is kept for a page that is opened late."""
START_TIMEOUT_S = 20.0
SETTLE_S = 1.0
FLUSH_TIMEOUT_S = 5.0
VIEWER_COMMAND = (sys.executable, "-m", "rerun")

Warn = Callable[[str], None]


def has_display() -> bool:
    """Tell whether a window can be opened here."""
    return sys.platform != "linux" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def web_url(web_port: int, grpc_port: int) -> str:
    """Return where the page is when it is served."""
    return f"http://localhost:{web_port}/?url={quote(f'rerun+http://localhost:{grpc_port}/proxy', safe='')}"


def open_file(path: Path) -> rr.RecordingStream:
    """Return a stream into a new file.  Raises ValueError when it cannot be written."""
    stream = rr.RecordingStream(APPLICATION)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        stream.save(path)
    except (OSError, RuntimeError) as error:
        raise ValueError(f"cannot write {path}: {' '.join(str(error).split())}") from error
    return stream


class Live:
    """A stream to a viewer that someone watches; ``stream`` is None once it is given up."""

    def __init__(self, stream: rr.RecordingStream, url: str):
        self.stream: rr.RecordingStream | None = stream
        self.url = url
        self._next_image_ns = 0

    def wants_image(self, t_receipt_ns: int) -> bool:
        """Tell whether an image received now is to be shown: at most LIVE_IMAGE_RATE_HZ are."""
        if t_receipt_ns < self._next_image_ns:
            return False
        self._next_image_ns = t_receipt_ns + int(NS_PER_S / LIVE_IMAGE_RATE_HZ)
        return True

    def close(self) -> None:
        """Send what is left and disconnect.  Raises RuntimeError when nobody takes it."""
        stream, self.stream = self.stream, None
        if stream is not None:
            stream.flush(timeout_sec=FLUSH_TIMEOUT_S)
            stream.disconnect()


def serve_web(host: str, web_port: int, grpc_port: int) -> Live:
    """Serve the data on ``host``, and the viewer's page.  Raises ValueError when a port is taken.

    The page is Rerun's program and holds no data; Rerun serves it on every interface, whatever ``host``.
    """
    _require_free(host, "web_port", web_port)
    _require_free(host, "grpc_port", grpc_port)
    stream = rr.RecordingStream(APPLICATION)
    stream.set_sinks(rr.GrpcServerSink(host, grpc_port, server_memory_limit=LIVE_MEMORY))
    try:
        rr.serve_web_viewer(web_port=web_port, open_browser=False)
    except RuntimeError as error:
        stream.disconnect()
        raise ValueError(f"web_port {web_port} cannot be used: {' '.join(str(error).split())}") from error
    return Live(stream, web_url(web_port, grpc_port))


def _require_free(host: str, name: str, port: int) -> None:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            raise ValueError(
                f"{name} {port} on {host} cannot be used ({error.strerror}): is another viewer running? "
                f"Give another {name}"
            ) from error


class Window(Live):
    """Rerun's own window: started beside the run and fed as soon as it listens; what comes before waits in memory.

    When it does not open, ``warn`` is told once and the stream is given up.
    """

    def __init__(self, grpc_port: int, warn: Warn):
        super().__init__(rr.RecordingStream(APPLICATION), f"rerun+http://{LOCALHOST}:{grpc_port}/proxy")
        self._port = grpc_port
        self._warn = warn
        self._starter = threading.Thread(target=self._start, name="rerun window", daemon=True)
        self._starter.start()

    def close(self) -> None:
        """Wait for a window that is still opening, send it what is left and leave it open."""
        self._starter.join(START_TIMEOUT_S)
        super().close()

    def _start(self) -> None:
        stream = self.stream
        assert stream is not None
        failure = None if listening(self._port) else self._open()
        if failure is None:
            stream.connect_grpc(self.url)
        else:
            self.stream = None
            self._warn(f"Rerun's window did not open ({failure}); the run goes on without it")

    def _open(self) -> str | None:
        """Start the viewer and wait until it listens.  Return why it does not, None when it does."""
        if not has_display():
            return "there is no display"
        options = ("--port", str(self._port), "--bind", LOCALHOST, "--hide-welcome-screen", "--expect-data-soon")
        quiet = subprocess.DEVNULL
        try:
            process = subprocess.Popen(
                [*VIEWER_COMMAND, *options], stdin=quiet, stdout=quiet, stderr=quiet, start_new_session=True
            )
        except OSError as error:
            return f"it cannot be started: {error.strerror}"
        deadline_s = time.monotonic() + START_TIMEOUT_S
        while time.monotonic() < deadline_s:
            ready = listening(self._port)
            time.sleep(SETTLE_S if ready else 0.1)  # it listens before it opens its window, which may fail
            if process.poll() is not None:
                return f"the viewer ended with code {process.returncode}"
            if ready:
                return None
        process.terminate()
        return f"it did not listen within {START_TIMEOUT_S:.0f} s"


def listening(port: int) -> bool:
    """Tell whether a program on this machine listens on a port."""
    try:
        socket.create_connection((LOCALHOST, port), timeout=0.2).close()
    except OSError:
        return False
    return True
