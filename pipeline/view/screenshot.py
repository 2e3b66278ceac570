"""A picture of a recorded view, without a screen.

    python -m pipeline.view.screenshot out/run.rrd picture.png --frame 120

Needs Vulkan; where there is no graphics card, Debian's mesa-vulkan-drivers computes it.
"""

from __future__ import annotations

import argparse
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
from rerun.experimental import ViewerClient

from pipeline.view.streams import LOCALHOST, VIEWER_COMMAND, listening

SIZE_PX = (1600, 1000)
MENU_PX = 36
"""Height of the viewer's menu bar, which is cut off."""
START_TIMEOUT_S = 60.0
SETTLE_S = 2.0


@contextmanager
def headless_viewer(rrd_path: Path, size_px: tuple[int, int] = SIZE_PX) -> Iterator[ViewerClient]:
    """Open a recording in a viewer without a window.  Raises RuntimeError when it does not start."""
    with socket.socket() as probe:
        probe.bind((LOCALHOST, 0))
        port = probe.getsockname()[1]
    options = ("--headless", "--window-size", f"{size_px[0]}x{size_px[1]}", "--hide-welcome-screen")
    where = ("--port", str(port), "--bind", LOCALHOST)
    quiet = subprocess.DEVNULL
    command = [*VIEWER_COMMAND, str(rrd_path), *options, *where]
    with subprocess.Popen(command, stdout=quiet, stderr=quiet, start_new_session=True) as process:
        try:
            yield _loaded(process, port)
        finally:
            os.killpg(process.pid, signal.SIGKILL)  # the command is a script around the viewer's own process


def _loaded(process: subprocess.Popen[bytes], port: int) -> ViewerClient:
    """Wait until the viewer shows its file."""
    client = None
    deadline_s = time.monotonic() + START_TIMEOUT_S
    while time.monotonic() < deadline_s:
        if process.poll() is not None:
            raise RuntimeError(
                f"Rerun's headless viewer ended with code {process.returncode}: it needs Vulkan (mesa-vulkan-drivers)"
            )
        if client is None and listening(port):
            client = ViewerClient.connect(f"rerun+http://{LOCALHOST}:{port}/proxy")
        if client is not None:
            state = client.get_state()
            if state.views and not state.loading:
                return client
        time.sleep(0.2)
    raise RuntimeError(f"Rerun's headless viewer showed nothing within {START_TIMEOUT_S:.0f} s")


def show_frame(client: ViewerClient, frame: int) -> list[str]:
    """Show one frame and return what the views complain of, empty when all is well."""
    client.set_time("frame", sequence=frame, play_state="paused")
    time.sleep(SETTLE_S)
    return [f"{view.name}: {report.summary}" for view in client.get_state().views for report in view.reports]


def save_screenshots(rrd_path: Path, frames: Iterable[int], png_paths: Iterable[Path]) -> None:
    """Write a picture (PNG) of the whole view at each frame.  Raises RuntimeError when there is no viewer."""
    with headless_viewer(rrd_path) as client:
        for frame, png_path in zip(frames, png_paths, strict=True):
            for complaint in show_frame(client, frame):
                print(f"{complaint} (frame {frame})", file=sys.stderr)
            client.save_screenshot(str(png_path.resolve()))
            picture = cv2.imread(str(png_path))
            assert picture is not None
            cv2.imwrite(str(png_path), picture[MENU_PX:])


def main() -> int:
    """Run the command."""
    parser = argparse.ArgumentParser(description="Save a picture of a recorded view.")
    parser.add_argument("rrd", type=Path)
    parser.add_argument("png", type=Path)
    parser.add_argument("--frame", type=int, default=0)
    args = parser.parse_args()
    try:
        save_screenshots(args.rrd, [args.frame], [args.png])
    except RuntimeError as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
