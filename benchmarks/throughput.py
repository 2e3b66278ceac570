"""How fast a replay runs and where the time goes.

``python -m benchmarks.throughput [RECORDING]`` replays the shipped recording three times: over the bus with all
nodes and over one process (`--direct`), whole commands with their start-up, and once more in this process with a
clock around every stage.  It prints both tables and saves ``out/throughput.png``.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import resource
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table

from pipeline.recording import RecordingWriter
from pipeline.replay import replay_direct
from pipeline.sources import open_source
from pipeline.steps import STEPS, Sink, Step, StepSpec
from pipeline.view import Viewer
from schemas import Envelope
from schemas.codec import AnyMessage

RECORDING = Path(__file__).resolve().parent.parent / "recordings" / "corridor.mcap"
PLOT = Path("out/throughput.png")


class Stopwatch:
    """CPU seconds of this process by stage."""

    def __init__(self) -> None:
        self.cpu_s: defaultdict[str, float] = defaultdict(float)

    def clocked(self, stage: str, work: Any) -> Any:
        """Call ``work`` and charge it to ``stage``."""
        start_s = time.process_time()
        try:
            return work()
        finally:
            self.cpu_s[stage] += time.process_time() - start_s

    def step(self, spec: StepSpec) -> StepSpec:
        """Return the row of the table with a clock around its step."""

        def build(mission: Any) -> Step:
            return _ClockedStep(self, spec.name, spec.build(mission))

        return replace(spec, build=build)


class _ClockedStep:
    def __init__(self, watch: Stopwatch, name: str, step: Step) -> None:
        self._watch, self._name, self._step = watch, name, step

    def step(self, message: AnyMessage) -> Iterable[AnyMessage]:
        return self._watch.clocked(self._name, lambda: list(self._step.step(message)))

    def refused(self, t_capture_ns: int) -> Iterable[AnyMessage]:
        return self._watch.clocked(self._name, lambda: list(self._step.refused(t_capture_ns)))


class _ClockedSink:
    def __init__(self, watch: Stopwatch, name: str, sink: Sink) -> None:
        self._watch, self._name, self._sink = watch, name, sink

    def write(self, envelope: Envelope, t_receipt_ns: int) -> None:
        self._watch.clocked(self._name, lambda: self._sink.write(envelope, t_receipt_ns))

    def close(self) -> None:
        self._watch.clocked(self._name, self._sink.close)


def stages(recording: Path) -> tuple[int, dict[str, float]]:
    """Return the number of frames, and the CPU milliseconds a frame of every stage in one process."""
    watch = Stopwatch()
    source = open_source(str(recording))
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        sinks = [
            _ClockedSink(watch, "recorder", RecordingWriter(out / "run.mcap", source.mission)),
            _ClockedSink(watch, "viewer (to file)", Viewer(source.mission, rrd_path=out / "run.rrd", mode="none")),
        ]
        start_s = time.process_time()
        frames = replay_direct(source, sinks, steps=[watch.step(spec) for spec in STEPS]).frames
        for sink in sinks:
            sink.close()
        total_s = time.process_time() - start_s
    watch.cpu_s["reading, encoding, decoding"] = total_s - sum(watch.cpu_s.values())
    return frames, {name: 1e3 * cpu_s / frames for name, cpu_s in watch.cpu_s.items()}


def whole_run(recording: Path, *options: str) -> dict[str, float]:
    """Run ``relnav replay`` at full speed as a user would; return its frames a second and its seconds."""
    with tempfile.TemporaryDirectory() as folder:
        before, start_s = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
        command = [sys.executable, "-m", "nodes", "replay", str(recording), "--out", folder]
        subprocess.run([*command, "--view", "none", "--speed", "max", *options], check=True, capture_output=True)
        wall_s, after = time.perf_counter() - start_s, resource.getrusage(resource.RUSAGE_CHILDREN)
        summary = json.loads((Path(folder) / "summary.json").read_text())
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {"rate_hz": summary["frames"] / summary["wall_s"], "wall_s": wall_s, "cpu_s": cpu_s}


def plot(frames: int, by_stage: dict[str, float], runs: dict[str, dict[str, float]]) -> None:
    """Save the stages and the frame rates as bars."""
    figure = Figure(figsize=(11, 3.6), layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2, width_ratios=(3, 2))
    names = sorted(by_stage, key=lambda name: by_stage[name])
    bars = left.barh(names, [by_stage[name] for name in names], color="#4c78a8")
    left.bar_label(bars, fmt=" %.1f")
    left.set(title="Where the time goes", xlabel=f"CPU ms a frame, mean of {frames}")
    bars = right.barh(list(runs), [run["rate_hz"] for run in runs.values()], color="#f58518")
    right.bar_label(bars, fmt=" %.0f")
    right.axvline(30, color="grey", linestyle="--", linewidth=1)
    right.set(title="Replay at full speed", xlabel="frames a second (dashed: 30)")
    for axes in (left, right):
        axes.spines[["top", "right"]].set_visible(False)
        axes.margins(x=0.15)
    PLOT.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(PLOT, dpi=130)


def main() -> None:
    """Measure, print and plot."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recording", nargs="?", type=Path, default=RECORDING)
    recording = parser.parse_args().recording
    cv2.setNumThreads(1)
    console = Console(highlight=False)
    runs = {"over the bus": whole_run(recording), "--direct": whole_run(recording, "--direct")}
    frames, by_stage = stages(recording)
    machine = f"{os.cpu_count()} cores, {platform.machine()}, Python {platform.python_version()}"
    table = Table("replay", "frames/s", "whole command, s", "its CPU, s", title=f"{recording.name}, {machine}")
    for name, run in runs.items():
        table.add_row(name, f"{run['rate_hz']:.0f}", f"{run['wall_s']:.1f}", f"{run['cpu_s']:.1f}")
    console.print(table)
    table = Table("stage", "CPU ms a frame", "share")
    total = sum(by_stage.values())
    for name, ms in sorted(by_stage.items(), key=lambda item: -item[1]):
        table.add_row(name, f"{ms:.2f}", f"{ms / total:.0%}")
    console.print(table)
    plot(frames, by_stage, runs)
    console.print(f"written: {PLOT}")


if __name__ == "__main__":
    main()
