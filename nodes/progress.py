"""What the user sees while a run lasts: a bar with range, mode and frame rate."""

from __future__ import annotations

import time
from types import TracebackType

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from pipeline.convert import vector_array
from schemas import Envelope, RelativeState, Stamp
from schemas.topics import STATE

RATE_WINDOW_S = 1.0


class RunProgress:
    """A bar on a terminal; elsewhere only the notes.  ``frame_count`` is None when nobody knows it."""

    def __init__(self, console: Console, frame_count: int | None) -> None:
        self._console = console
        self._progress = Progress(
            SpinnerColumn(),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.description}"),
            TimeElapsedColumn(),
            console=console,
            disable=not console.is_terminal,
        )
        self._task = self._progress.add_task("starting", total=frame_count)
        self._rate_since_s = time.monotonic()
        self._rate_frames = 0
        self._rate_text = ""

    def __enter__(self) -> RunProgress:
        self._progress.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self._progress.stop()

    def write(self, envelope: Envelope, t_receipt_ns: int) -> None:
        """Show the states among what passes: in a direct replay this is a sink like others."""
        if envelope.topic is STATE:
            state = envelope.message()
            assert isinstance(state, RelativeState)
            self.on_state(envelope.stamp, state)

    def close(self) -> None:
        """Nothing to finish."""

    def on_state(self, stamp: Stamp, state: RelativeState) -> None:
        """Show a state."""
        self._rate_frames += 1
        elapsed_s = time.monotonic() - self._rate_since_s
        if elapsed_s >= RATE_WINDOW_S:
            self._rate_text = f"{self._rate_frames / elapsed_s:.0f} frames/s"
            self._rate_since_s, self._rate_frames = time.monotonic(), 0
        description = f"{_range_text(state)}  {state.mode.name:<9}  {self._rate_text}"
        self._progress.update(self._task, completed=stamp.sequence + 1, description=description)

    def on_note(self, note: str) -> None:
        """Show a line above the bar."""
        style = "yellow" if note.startswith("warning") else "dim"
        self._console.print(note, style=style, highlight=False, markup=False)


def _range_text(state: RelativeState) -> str:
    if state.port is not None:
        return f"range {state.port.range_m:6.3f} m"
    if state.T_chaser_target is None:
        return "no range yet  "
    return f"range {float(np.linalg.norm(vector_array(state.T_chaser_target.translation_m))):6.3f} m"
