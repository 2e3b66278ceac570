"""One node in this process: what the supervisor starts, and what a service of compose.yaml runs."""

from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path

from nodes.bus import Bus, Link
from nodes.processes import Process, process_named
from nodes.shell import NodeOptions, Shell, StopSignal, Work
from nodes.source import Pace, Resume, SourceNode
from pipeline.mission import Mission
from pipeline.steps import STEPS


def main(args: argparse.Namespace) -> None:
    """Run the node ``args.name`` until it is stopped."""
    stop = StopSignal(supervised=args.supervised)
    process = process_named(args.name)
    link = Link(args.hub, "peer") if args.hub else Link(args.connect, "client")
    if process.name == "source":
        _run_source(args, link, stop)
        return
    mission = _mission(args.mission)
    options = _options(args, mission)
    if process.name == "relay":
        _run_relay(args, process, link, options, stop)
        return
    work = _work(args, options)
    with Bus(link, vehicle=mission.vehicle, node=process.name, lossless=options.lossless) as bus:
        Shell(process, work, options, bus, stop).run()


def _mission(path: Path | None) -> Mission:
    """Return the mission of a file, which may be a recording that carries one."""
    if path is None:
        return Mission()
    if path.suffix == ".mcap":
        from pipeline.recording import Recording

        return Recording(path).mission
    return Mission.load(path)


def _options(args: argparse.Namespace, mission: Mission) -> NodeOptions:
    companions = tuple(args.companions.split(",")) if args.companions else ()
    return NodeOptions(mission=mission, lossless=args.lossless, companions=companions)


def _run_source(args: argparse.Namespace, link: Link, stop: StopSignal) -> None:
    from pipeline.sources import open_source

    if args.source is None:
        raise ValueError("the source node needs --source: a recording, video, folder of images, or camera")
    source = open_source(
        args.source, camera=args.camera, mission=args.mission, fps=args.fps, scale_camera=args.scale_camera
    )
    source.on_warning = _warn
    if source.closed_loop:
        source.live = not args.lossless
    options = _options(args, source.mission)
    pace = Pace(speed=None if math.isinf(args.speed) else args.speed, loop=args.loop, resume=_resume(args.resume))
    with Bus(link, vehicle=source.mission.vehicle, node="source", lossless=options.lossless) as bus:
        SourceNode(source, pace, options, bus, stop).run()


def _run_relay(args: argparse.Namespace, process: Process, link: Link, options: NodeOptions, stop: StopSignal) -> None:
    from nodes.relay import RelayWork, open_outlet, parse_destination

    if not args.to:
        raise ValueError("the relay node needs --to: where states go, such as udp://127.0.0.1:5600 or ros2")
    destinations = [parse_destination(text) for text in args.to]
    vehicle = options.mission.vehicle
    with Bus(link, vehicle=vehicle, node=process.name, lossless=False) as bus:
        outlets = [(to.text, open_outlet(to, vehicle, bus)) for to in destinations]
        Shell(process, RelayWork(outlets, _warn), options, bus, stop).run()


def _resume(text: str | None) -> Resume | None:
    if text is None:
        return None
    sequence, t_capture_ns = (int(part) for part in text.split(":"))
    return Resume(sequence, t_capture_ns)


def _work(args: argparse.Namespace, options: NodeOptions) -> Work:
    out: Path = args.out
    if args.name == "recorder":
        from nodes.recorder import RecorderWork

        return RecorderWork(out, options.mission)
    if args.name == "viewer":
        from nodes.viewer import ViewerWork
        from pipeline.view import Viewer

        viewer = Viewer(
            options.mission,
            rrd_path=out / "run.rrd",
            mode=args.view,
            web_port=args.web_port,
            grpc_port=args.grpc_port,
            host=args.bind,
            warn=_warn,
        )
        return ViewerWork(viewer)
    from nodes.step_host import StepWork

    spec = next(spec for spec in STEPS if spec.name == args.name)
    return StepWork(spec, options.mission, lossless=options.lossless)


def _warn(text: str) -> None:
    """Tell the supervisor, which shows what its children print to standard error."""
    print(f"relnav: warning: {text}", file=sys.stderr, flush=True)
