"""``relnav replay``, ``relnav live`` and ``relnav dock``: plan a run, run it, score it."""

from __future__ import annotations

import argparse
import contextlib
import math
import socket
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from rich.console import Console
from rich.markup import escape

from astratag.dictionary import load_dictionary
from nodes.bus import Link, free_endpoint
from nodes.cli import EXIT_INTERRUPTED
from nodes.processes import PROCESSES
from nodes.progress import RunProgress
from nodes.recorder import join_parts
from nodes.results import DOCKING, RRD, finish_results, folder_for_results
from nodes.supervisor import Hooks, Outcome, Plan, RunError, Supervisor
from pipeline.mission import Mission
from pipeline.sources import Source, open_source
from pipeline.steps import Sink

if TYPE_CHECKING:
    from pipeline.dock_scenario import DockScenario

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
    spec = args.recording or _shipped_recording()
    console = _console()
    source = _open(args, spec)
    if source.live:
        raise ValueError(f"{spec} is a camera: use `relnav live --source {spec}`")
    subject = _subject(source, spec)
    view = _view(args, console)
    speed = args.speed or (math.inf if view == "none" else 1.0)
    speed_text = "max" if math.isinf(speed) else f"{speed:g}"
    with folder_for_results(args.out, spec, overwrite=True):
        _print_header(console, subject, args, view, f"speed {speed_text}")
        if args.direct:
            outcome = _run_direct(args, source, view, speed, console)
        else:
            del source
            links = _links(args.connect, free_endpoint())
            with _plan(args, subject, view, links, ["--speed", speed_text], lossless=True) as plan:
                outcome = _run(plan, subject, args.out, console)
        return _conclude(args.out, subject, outcome, console)


def live(args: argparse.Namespace) -> int:
    """Navigate on a camera, or on a file as if it were one, until it ends, the time is up or Ctrl-C."""
    console = _console()
    subject = _subject(_open(args, args.source), args.source)
    view = _view(args, console)
    args.out = args.out or Path("out/live", time.strftime("%Y%m%dT%H%M%SZ", time.gmtime()))
    with folder_for_results(args.out, args.source, overwrite=False):
        _print_header(console, subject, args, view, f"router {args.connect}" if args.connect else f"bus {args.listen}")
        links = _links(args.connect, args.listen)
        with _plan(args, subject, view, links, ["--loop"] if args.loop else [], lossless=False) as plan:
            outcome = _run(plan, subject, args.out, console)
        if (subject.live or args.loop) and args.duration is None:
            outcome = Outcome(completed=True, died=outcome.died)  # Ctrl-C is how such a run ends
        return _conclude(args.out, subject, outcome, console)


def dock(args: argparse.Namespace) -> int:
    """Fly a docking in closed loop with the simulator, and tell how it went."""
    from pipeline.dock import require_basilisk
    from pipeline.dock_report import print_docking, report_docking
    from pipeline.dock_scenario import DockScenario

    if args.direct and args.real_time:
        raise ValueError("--direct is lockstep: leave out --real-time")
    require_basilisk()
    scenario = DockScenario() if args.scenario is None else DockScenario.load(args.scenario)
    scenario = scenario if args.seed is None else scenario.model_copy(update={"seed": args.seed})
    load_dictionary(scenario.mission.dictionary)
    console, view = _console(), _view(args, _console())
    with folder_for_results(args.out, str(args.scenario or ""), overwrite=True), _scenario_file(scenario) as path:
        subject = Subject(f"dock:{path}", scenario.mission, None, args.real_time, ())
        pace = "real time" if args.real_time else "lockstep"
        _print_header(console, replace(subject, spec=f"docking {args.scenario or ''}".strip()), args, view, pace)
        if args.direct:
            outcome = _run_direct(args, _open(args, subject.spec), view, math.inf, console)
        else:
            links = _links(args.connect, free_endpoint())
            speed = [] if args.real_time else ["--speed", "max"]
            with _plan(args, subject, view, links, speed, lossless=not args.real_time) as plan:
                outcome = _run(plan, subject, args.out, console)
        if (code := _conclude(args.out, subject, outcome, console)) != 0:
            return code
        docking = report_docking(args.out / "run.mcap", scenario)
        (args.out / DOCKING).write_text(docking.model_dump_json(indent=2) + "\n")
        print_docking(docking, console)
    if not docking.docked:
        raise ValueError(f"not docked: the flight ended in {docking.end}, {docking.closest_m:.2f} m away at the least")
    return 0


@contextlib.contextmanager
def _scenario_file(scenario: DockScenario) -> Iterator[Path]:
    """Yield a file that holds a scenario, for as long as the run lasts."""
    with tempfile.TemporaryDirectory(prefix="relnav-") as directory:
        path = Path(directory) / "scenario.json"
        path.write_text(scenario.to_json())
        yield path


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
    if args.view == "auto":
        from pipeline.view import has_display

        if has_display():
            return "native"
        if not console.is_terminal:
            return "none"
        args.web_port, args.grpc_port = (
            port if _is_free(port) else int(free_endpoint().rpartition(":")[2])
            for port in (args.web_port, args.grpc_port)
        )
        return "web"
    if args.view == "web":
        for flag, port in (("--web-port", args.web_port), ("--grpc-port", args.grpc_port)):
            if not _is_free(port):
                raise ValueError(f"port {port} is in use: stop the other viewer, or choose another port with {flag}")
    view: View = args.view
    return view


def _is_free(port: int) -> bool:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", port))
        except OSError:
            return False
    return True


def _links(connect: str | None, listen: str) -> tuple[Link, Link]:
    """Return the supervisor's link and the nodes'."""
    if connect:
        return Link(connect, "client"), Link(connect, "client")
    return Link(listen, "hub"), Link(listen, "peer")


@contextlib.contextmanager
def _plan(
    args: argparse.Namespace,
    subject: Subject,
    view: View,
    links: tuple[Link, Link],
    source_arguments: Sequence[str],
    *,
    lossless: bool,
) -> Iterator[Plan]:
    """Yield the plan of a run; the nodes' mission file lasts as long."""
    source = ["--source", subject.spec, *source_arguments]
    for flag, value in (("--camera", args.camera), ("--fps", args.fps)):
        source += [flag, str(value)] if value else []
    source += ["--scale-camera"] if args.scale_camera else []
    ports = ["--web-port", str(args.web_port), "--grpc-port", str(args.grpc_port)]
    out = ["--out", str(args.out)]
    own_link, node_link = links
    with tempfile.TemporaryDirectory(prefix="relnav-") as directory:
        mission_path = Path(directory) / "mission.json"
        mission_path.write_text(subject.mission.to_json())
        yield Plan(
            processes=PROCESSES,
            arguments={"source": source, "recorder": out, "viewer": [*out, "--view", view, *ports]},
            node_link=node_link,
            own_link=own_link,
            vehicle=subject.mission.vehicle,
            lossless=lossless,
            mission_path=str(mission_path),
            duration_s=None if lossless else args.duration,
        )


def _print_header(console: Console, subject: Subject, args: argparse.Namespace, view: View, how: str) -> None:
    endless = "live" if subject.live else "closed loop"
    frames = endless if subject.frame_count is None else f"{subject.frame_count} frames"
    console.print(f"[bold]{escape(subject.spec)}[/bold]: {frames}, {how}, results in {escape(str(args.out))}")
    if view == "native":
        console.print("Rerun's window opens beside this")
    elif view == "web":
        from pipeline.view import web_url

        console.print(f"watch it at {web_url(args.web_port, args.grpc_port)}", markup=False)
    for warning in subject.warnings:
        console.print(f"warning: {warning}", style="yellow", markup=False)


def _run(plan: Plan, subject: Subject, out: Path, console: Console) -> Outcome:
    endless = not plan.lossless and ("--loop" in plan.arguments["source"] or plan.duration_s is not None)
    try:
        with RunProgress(console, None if endless else subject.frame_count) as progress:
            return Supervisor(plan, Hooks(progress.on_state, progress.on_note)).run()
    except RunError:
        with contextlib.suppress(ValueError):
            join_parts(out, subject.mission)  # what was recorded until then stays readable
        raise


def _run_direct(args: argparse.Namespace, source: Source, view: View, speed: float, console: Console) -> Outcome:
    from pipeline.recording import RecordingWriter
    from pipeline.replay import replay_direct
    from pipeline.view import Viewer

    with RunProgress(console, source.frame_count) as progress, contextlib.ExitStack() as stack:

        def warn(text: str) -> None:
            progress.on_note(f"warning: {text}")

        source.on_warning = warn
        ports = {"web_port": args.web_port, "grpc_port": args.grpc_port}
        viewer = Viewer(source.mission, rrd_path=args.out / RRD, mode=view, warn=warn, **ports)
        recorder = RecordingWriter(args.out / "run.mcap", source.mission)
        sinks: list[Sink] = [stack.enter_context(viewer), stack.enter_context(recorder), progress]
        try:
            replay_direct(source, sinks, speed="max" if math.isinf(speed) else speed, on_refused=warn)
        except KeyboardInterrupt:
            return Outcome(completed=False, died=frozenset())
    return Outcome(completed=True, died=frozenset())


def _conclude(out: Path, subject: Subject, outcome: Outcome, console: Console) -> int:
    """Write and print the results; of a run that was interrupted, what there is of them."""
    if outcome.completed:
        finish_results(out, subject.mission, outcome, console)
        return 0
    with contextlib.suppress(ValueError):  # interrupted before there was anything to score
        finish_results(out, subject.mission, outcome, console)
    print("relnav: error: interrupted; what was recorded until then is kept", file=sys.stderr)
    return EXIT_INTERRUPTED
