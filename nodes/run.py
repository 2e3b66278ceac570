"""``relnav replay`` and ``relnav live``: plan a run, run it, score it."""

from __future__ import annotations

import argparse
import contextlib
import math
import socket
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from rich.console import Console

from astratag.dictionary import load_dictionary
from nodes.bus import Link, free_endpoint
from nodes.cli import EXIT_INTERRUPTED
from nodes.processes import PROCESSES
from nodes.progress import RunProgress
from nodes.recorder import existing_parts, join_parts
from nodes.supervisor import Hooks, Outcome, Plan, RunError, Supervisor
from pipeline.mission import Mission
from pipeline.sources import Source, open_source

SHIPPED_RECORDING = Path(__file__).resolve().parent.parent / "recordings" / "corridor.mcap"

View = Literal["native", "web", "none"]


@dataclass(frozen=True)
class Subject:
    """What is known of a source before the run."""

    spec: str
    mission: Mission
    frame_count: int | None
    live: bool
    warnings: tuple[str, ...]


def replay(args: argparse.Namespace) -> int:
    """Replay a recording without losing a frame, and score it."""
    args.recording = args.recording or _shipped_recording()
    console = _console()
    source = _open(args, args.recording)
    if source.live:
        raise ValueError(f"{args.recording} is a camera: use `relnav live --source {args.recording}`")
    subject = _subject(source, args.recording)
    view = _view(args, console)
    speed = args.speed or (math.inf if view == "none" else 1.0)
    _prepare(args.out, args.recording)
    _print_header(console, subject, args, view, f"speed {'max' if math.isinf(speed) else f'{speed:g}'}")
    if args.direct:
        outcome = _run_direct(args, source, view, speed, console)
    else:
        del source
        own_link, node_link = _links(args.connect, free_endpoint())
        with _mission_file(subject.mission) as mission_path:
            plan = Plan(
                processes=PROCESSES,
                arguments=_arguments(args, args.recording, view)
                | {"source": [*_source_arguments(args, args.recording), "--speed", _speed_text(speed)]},
                node_link=node_link,
                own_link=own_link,
                vehicle=subject.mission.vehicle,
                lossless=True,
                mission_path=mission_path,
            )
            outcome = _run(plan, subject.frame_count, console)
    _finish(args.out, subject.mission, outcome, console)
    if not outcome.completed:
        print("relnav: error: interrupted; what was recorded until then is kept", file=sys.stderr)
        return EXIT_INTERRUPTED
    return 0


def live(args: argparse.Namespace) -> int:
    """Navigate on a camera, or on a file as if it were one, until it ends, the time is up or Ctrl-C."""
    console = _console()
    source = _open(args, args.source)
    subject = _subject(source, args.source)
    del source  # a camera is given back for the source node
    view = _view(args, console)
    _prepare(args.out, args.source)
    own_link, node_link = _links(args.connect, args.listen)
    where = f"router {args.connect}" if args.connect else f"bus {args.listen}"
    _print_header(console, subject, args, view, where)
    with _mission_file(subject.mission) as mission_path:
        loop = ["--loop"] if args.loop else []
        plan = Plan(
            processes=PROCESSES,
            arguments=_arguments(args, args.source, view) | {"source": [*_source_arguments(args, args.source), *loop]},
            node_link=node_link,
            own_link=own_link,
            vehicle=subject.mission.vehicle,
            lossless=False,
            mission_path=mission_path,
            duration_s=args.duration,
        )
        outcome = _run(plan, None if args.loop or args.duration else subject.frame_count, console)
    _finish(args.out, subject.mission, outcome, console)
    endless = (subject.live or args.loop) and args.duration is None  # ends no other way
    return 0 if outcome.completed or endless else EXIT_INTERRUPTED


def _console() -> Console:
    return Console(highlight=False, soft_wrap=True)


def _shipped_recording() -> str:
    if not SHIPPED_RECORDING.exists():
        raise ValueError(f"the shipped recording {SHIPPED_RECORDING} is missing: name one, `relnav replay FILE`")
    try:
        return str(SHIPPED_RECORDING.relative_to(Path.cwd()))
    except ValueError:
        return str(SHIPPED_RECORDING)


def _open(args: argparse.Namespace, spec: str) -> Source:
    """Open the source and check what the nodes will need, so that what is wrong is said before they start."""
    source = open_source(spec, camera=args.camera, mission=args.mission, fps=args.fps, scale_camera=args.scale_camera)
    load_dictionary(source.mission.dictionary)
    return source


def _subject(source: Source, spec: str) -> Subject:
    return Subject(spec, source.mission, source.frame_count, source.live, tuple(source.warnings))


def _view(args: argparse.Namespace, console: Console) -> View:
    """Decide where the run is shown.  Raises ValueError when a page is asked for and its ports are taken."""
    view: str = args.view
    if view == "auto":
        from pipeline.view import has_display

        view = "native" if has_display() else "web" if console.is_terminal else "none"
        if view == "web":
            args.web_port, args.grpc_port = (
                port if _is_free(port) else int(free_endpoint().rpartition(":")[2])
                for port in (args.web_port, args.grpc_port)
            )
    if view == "web":
        for flag, port in (("--web-port", args.web_port), ("--grpc-port", args.grpc_port)):
            if not _is_free(port):
                raise ValueError(f"port {port} is in use: stop the other viewer, or choose another port with {flag}")
    return view  # type: ignore[return-value]


def _is_free(port: int) -> bool:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", port))
        except OSError:
            return False
    return True


def _prepare(out: Path, spec: str) -> None:
    """Make the folder and take away the files of an earlier run, and only those."""
    stale = [*existing_parts(out), *(out / name for name in ("run.rrd", "summary.json", "report.png"))]
    if Path(spec).resolve() in [path.resolve() for path in stale]:
        raise ValueError(f"{spec} would be overwritten by its own replay: choose another folder with --out")
    try:
        out.mkdir(parents=True, exist_ok=True)
        for path in stale:
            path.unlink(missing_ok=True)
    except OSError as error:
        raise ValueError(f"cannot write to {out}: {error.strerror}") from error


def _links(connect: str | None, listen: str) -> tuple[Link, Link]:
    """Return the supervisor's link and the nodes'."""
    if connect:
        return Link(connect, "client"), Link(connect, "client")
    return Link(listen, "hub"), Link(listen, "peer")


@contextlib.contextmanager
def _mission_file(mission: Mission) -> Iterator[str]:
    with tempfile.TemporaryDirectory(prefix="relnav-") as directory:
        path = Path(directory) / "mission.json"
        path.write_text(mission.to_json())
        yield str(path)


def _source_arguments(args: argparse.Namespace, spec: str) -> list[str]:
    arguments = ["--source", spec]
    if args.camera:
        arguments += ["--camera", str(args.camera)]
    if args.fps:
        arguments += ["--fps", str(args.fps)]
    return arguments + (["--scale-camera"] if args.scale_camera else [])


def _arguments(args: argparse.Namespace, spec: str, view: View) -> dict[str, list[str]]:
    ports = ["--web-port", str(args.web_port), "--grpc-port", str(args.grpc_port)]
    return {"recorder": ["--out", str(args.out)], "viewer": ["--out", str(args.out), "--view", view, *ports]}


def _speed_text(speed: float) -> str:
    return "max" if math.isinf(speed) else str(speed)


def _print_header(console: Console, subject: Subject, args: argparse.Namespace, view: View, how: str) -> None:
    frames = "live" if subject.frame_count is None else f"{subject.frame_count} frames"
    console.print(f"[bold]{subject.spec}[/bold]: {frames}, {how}, results in {args.out}")
    if view == "native":
        console.print("Rerun's window opens beside this")
    elif view == "web":
        data = f"rerun%2Bhttp%3A%2F%2Flocalhost%3A{args.grpc_port}%2Fproxy"
        console.print(f"watch it at http://localhost:{args.web_port}/?url={data}")
    for warning in subject.warnings:
        console.print(f"warning: {warning}", style="yellow")


def _run(plan: Plan, frame_count: int | None, console: Console) -> Outcome:
    with RunProgress(console, frame_count) as progress:
        return Supervisor(plan, Hooks(progress.on_state, progress.on_note)).run()


def _run_direct(args: argparse.Namespace, source: Source, view: View, speed: float, console: Console) -> Outcome:
    from pipeline.recording import RecordingWriter
    from pipeline.replay import replay_direct
    from pipeline.view import Viewer

    with RunProgress(console, source.frame_count) as progress, contextlib.ExitStack() as stack:
        recorder = stack.enter_context(RecordingWriter(args.out / "run.mcap", source.mission))
        viewer = stack.enter_context(
            Viewer(
                source.mission,
                rrd_path=args.out / "run.rrd",
                mode=view,
                web_port=args.web_port,
                grpc_port=args.grpc_port,
                warn=lambda text: progress.on_note(f"warning: {text}"),
            )
        )
        source.on_warning = lambda text: progress.on_note(f"warning: {text}")
        try:
            replay_direct(source, [recorder, viewer], speed="max" if math.isinf(speed) else speed)
        except KeyboardInterrupt:
            return Outcome(completed=False, died=frozenset())
    return Outcome(completed=True, died=frozenset())


def _finish(out: Path, mission: Mission, outcome: Outcome, console: Console) -> None:
    """Make recording and .rrd whole, score the run, write summary and report, print the table and what to try next."""
    from pipeline.report import write_report
    from pipeline.scoring import print_table, score, write_summary

    recording = join_parts(out, mission)
    if "viewer" in outcome.died:
        _draw_again(recording, out / "run.rrd")
    try:
        summary = score(recording)
    except ValueError as error:
        raise RunError(f"the run cannot be scored: {error}") from error
    write_summary(summary, out / "summary.json")
    write_report(recording, summary, out / "report.png")
    print_table(summary, console)
    console.print(f"written: {recording}, {out / 'run.rrd'}, {out / 'summary.json'}, {out / 'report.png'}")
    console.print(f"try next: [bold]{Path(sys.prefix, 'bin', 'rerun')} {out / 'run.rrd'}[/bold]")


def _draw_again(recording: Path, rrd_path: Path) -> None:
    """Write the .rrd from the recording: the viewer did not see all of the run."""
    from pipeline.recording import Recording
    from pipeline.view import Viewer

    recorded = Recording(recording)
    with Viewer(recorded.mission, rrd_path=rrd_path, mode="none") as viewer:
        for envelope, t_receipt_ns in recorded.envelopes():
            viewer.write(envelope, t_receipt_ns)
