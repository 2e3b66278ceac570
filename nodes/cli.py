"""The command line: ``relnav``.

Only argparse is imported here: each command imports what it needs, so that help and errors come at once.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path

from nodes import ONE_THREAD

EXIT_ERROR, EXIT_USAGE, EXIT_INTERRUPTED = 1, 2, 130
DESCRIPTION = "Relative navigation for spacecraft rendezvous on AstraTag markers."
EPILOG = """\
Start with `relnav replay`: it flies the shipped approach and scores it.
`relnav COMMAND --help` explains a command, with an example.
RELNAV_DEBUG=1 shows where an error comes from.
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command and return the exit code: 0 only when the job was done."""
    args = _parser().parse_args(arguments)
    os.environ.update(ONE_THREAD)
    module, function = args.run.split(":")
    try:
        code = getattr(import_module(module), function)(args)
    except KeyboardInterrupt:
        return _fail("interrupted", EXIT_INTERRUPTED)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # the reader of our output left
        return EXIT_ERROR
    except Exception as error:
        if os.environ.get("RELNAV_DEBUG"):
            raise
        text = " ".join(str(error).split()) or type(error).__name__
        expected = isinstance(error, ValueError | OSError) or type(error).__name__ == "NodeError"
        return _fail(text if expected else f"{type(error).__name__}: {text}; RELNAV_DEBUG=1 shows where", EXIT_ERROR)
    return int(code or 0)


def _fail(text: str, code: int) -> int:
    print(f"relnav: error: {text}", file=sys.stderr, flush=True)
    return code


class _Parser(argparse.ArgumentParser):
    """Errors in one line, like all our errors."""

    def error(self, message: str) -> None:  # type: ignore[override]
        self.exit(EXIT_USAGE, f"relnav: error: {message} (see `{self.prog} --help`)\n")


def _parser() -> argparse.ArgumentParser:
    raw = argparse.RawDescriptionHelpFormatter
    parser = _Parser(prog="relnav", description=DESCRIPTION, epilog=EPILOG, formatter_class=raw)
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True, parser_class=_Parser)

    def command(name: str, run: str, text: str, example: str) -> argparse.ArgumentParser:
        added = commands.add_parser(
            name, help=text, description=text, epilog=f"example:\n  {example}", formatter_class=raw
        )
        added.set_defaults(run=run)
        return added

    _replay(command("replay", "nodes.run:replay", "Replay a recording, video or folder and score it.", "relnav replay"))
    example = "relnav live --source /dev/video0 --camera camera.yaml --mission mission.yaml"
    _live(command("live", "nodes.run:live", "Navigate on a camera, or on a file as if it were one.", example))
    example = "relnav dock --seed 3 --out out/dock"
    _dock(command("dock", "nodes.run:dock", "Fly a docking in closed loop with the simulator Basilisk.", example))
    example = "relnav detect images/ --camera camera.json --side-m 0.1 --json found.json"
    _detect(command("detect", "nodes.tools:detect", "Find markers in images, folders, videos and recordings.", example))
    example = "relnav marker 0 1 2 --side-mm 100 --format pdf --out markers"
    _marker(command("marker", "nodes.tools:marker", "Draw markers to print, at their exact size.", example))
    example = "relnav dictionary astratag48h12 --count 100 --out fleet.json"
    _dictionary(command("dictionary", "nodes.tools:dictionary", "Choose identities that are far apart.", example))
    example = "relnav map out/live/run.mcap --mission markers.yaml --out mission.yaml"
    text = "Estimate where a target's markers are, from a recording that shows them together."
    _map(command("map", "nodes.mapping:marker_map", text, example))
    score = command("score", "nodes.tools:score", "Score a recorded run.", "relnav score out/replay/run.mcap")
    score.add_argument("recording", metavar="RUN", type=Path, help="the run.mcap of a replay or a live run")
    smooth = command("smooth", "nodes.tools:smooth", "Smooth the states of a recorded run.", "relnav smooth run.mcap")
    smooth.add_argument("recording", metavar="RUN", type=Path, help="the run.mcap of a replay or a live run")
    smooth.add_argument("--out", type=Path, help="where it goes (default: RUN.smoothed.mcap beside it)")
    example = "relnav recover run.mcap"
    recover = command("recover", "nodes.tools:recover", "Make a recording whole that was cut off.", example)
    recover.add_argument("recording", metavar="FILE", type=Path, help="the truncated recording")
    recover.add_argument("--out", type=Path, help="where the whole one goes (default: FILE.recovered.mcap beside it)")
    example = "relnav export out/replay/run.mcap states.csv"
    _export(command("export", "nodes.tools:export", "Write a recording's states as a file of another kind.", example))
    command("doctor", "nodes.doctor:doctor", "Check this installation, and say how to mend it.", "relnav doctor")
    example = "relnav node detector --mission mission.yaml --connect tcp/router:7447"
    _node(command("node", "nodes.node:main", "Run one node against a Zenoh router.", example))
    return parser


def _replay(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "recording", nargs="?", help="MCAP recording, video or folder of images (default: the shipped corridor)"
    )
    parser.add_argument(
        "--speed", type=_speed, help="times real time, or max (default: 1 when a viewer is shown, else max)"
    )
    parser.add_argument("--direct", action="store_true", help="in this process, without the bus: same results")
    _run_options(parser, out="out/replay")
    _source_options(parser)


def _live(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--source", required=True, help="/dev/video0, a recording, video or folder, or sim[:FILE]")
    parser.add_argument("--duration", type=_positive, metavar="S", help="stop after so many seconds")
    parser.add_argument("--loop", action="store_true", help="play a file again and again")
    parser.add_argument(
        "--listen",
        metavar="ENDPOINT",
        default="tcp/127.0.0.1:7447",
        help="where others can join the bus (default: %(default)s)",
    )
    _run_options(parser, out=None)
    _source_options(parser)


def _dock(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "scenario", nargs="?", type=Path, help="what is flown, YAML (default: 20 m along the velocity to the port)"
    )
    parser.add_argument("--seed", type=_natural, metavar="N", help="another seed, another flight (default: 0)")
    parser.add_argument("--real-time", action="store_true", help="as time passes (default: lockstep, repeatable)")
    parser.add_argument("--direct", action="store_true", help="in this process, without the bus: same results")
    _run_options(parser, out="out/dock")
    parser.set_defaults(camera=None, mission=None, fps=None, scale_camera=False, duration=None)


def _run_options(parser: argparse.ArgumentParser, *, out: str | None) -> None:
    default = out or "out/live/ and the time"
    parser.add_argument("--out", type=Path, default=out and Path(out), help=f"folder for the results ({default})")
    parser.add_argument(
        "--view",
        choices=("auto", "native", "web", "none"),
        default="auto",
        help="Rerun's window, a page in the browser, or only run.rrd (default: what this machine can show)",
    )
    parser.add_argument("--connect", metavar="ENDPOINT", help="through a Zenoh router, such as tcp/127.0.0.1:7447")
    _viewer_ports(parser)


def _viewer_ports(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--web-port", type=int, default=9090, help="of the page (default: %(default)s)")
    parser.add_argument("--grpc-port", type=int, default=9876, help="of the page's data (default: %(default)s)")


def _source_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--camera", type=Path, metavar="FILE", help="calibration: JSON, or ROS camera_info YAML")
    parser.add_argument("--mission", type=Path, metavar="FILE", help="markers, camera mounting, ports, filter (YAML)")
    parser.add_argument("--scale-camera", action="store_true", help="scale a calibration of another image size")
    parser.add_argument("--fps", type=_positive, metavar="X", help="frame rate of a folder or video")


def _detect(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("paths", nargs="+", metavar="PATH", help="images, folders, videos, MCAP recordings")
    parser.add_argument("--camera", type=Path, metavar="FILE", help="calibration: without it there are no poses")
    parser.add_argument("--side-m", type=_positive, metavar="S", help="side of the outer black square in metres")
    parser.add_argument("--dictionary", metavar="NAME|FILE", help="default: the recording's, else astratag20")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all that was found")
    parser.add_argument("--annotate", type=Path, metavar="DIR", help="write the pictures with what was found drawn in")
    parser.add_argument("--scale-camera", action="store_true", help="scale a calibration of another image size")


def _marker(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("ids", nargs="+", type=int, metavar="ID", help="numbers in the dictionary")
    parser.add_argument(
        "--family",
        default="astratag20",
        metavar="F",
        help="astratag20, astratag48h16, astratag48h12, astratag48h9 or a dictionary's JSON (default: %(default)s)",
    )
    parser.add_argument("--side-mm", type=_positive, default=100.0, metavar="S", help="outer square (%(default)s mm)")
    variant = parser.add_argument_group("another geometry", "to print and study; the detector reads the published one")
    variant.add_argument("--contraction", type=_positive, metavar="X", help="of the triangles (default: 4/7)")
    variant.add_argument(
        "--border", type=_positive, metavar="X", help="of the outermost frame, in sides (default: 1/35)"
    )
    variant.add_argument("--layers", type=int, metavar="N", help="copies of the pattern (default: 3)")
    parser.add_argument("--format", choices=("svg", "pdf", "png"), default="svg", help="default: %(default)s")
    parser.add_argument("--out", type=Path, default=Path("out/markers"), help="folder (default: %(default)s)")


def _dictionary(parser: argparse.ArgumentParser) -> None:
    families = ("astratag48h16", "astratag48h12", "astratag48h9")
    parser.add_argument("family", choices=families, help="1008, 64512 or 4193280 identities, 16, 12 or 9 cells apart")
    parser.add_argument("--count", type=int, required=True, metavar="N", help="how many identities")
    parser.add_argument("--seed", type=int, default=0, help="another seed, another choice (default: %(default)s)")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="JSON that --dictionary reads")


def _map(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "recordings", nargs="+", metavar="RECORDING", help="recordings, videos or folders of images of one target"
    )
    out = Path("out/map/mission.yaml")
    parser.add_argument("--out", type=Path, default=out, metavar="FILE", help="the mission to write (%(default)s)")
    parser.add_argument("--overwrite", action="store_true", help="write over an earlier map")
    mission = "sides and surfaces of the markers, and the rest (default: the recording's)"
    parser.add_argument("--mission", type=Path, metavar="FILE", help=mission)
    parser.add_argument("--camera", type=Path, metavar="FILE", help="calibration (default: the recording's)")
    parser.add_argument("--scale-camera", action="store_true", help="scale a calibration of another image size")
    reference = "marker that stays where the mission has it (default: the first it lists)"
    parser.add_argument("--reference", type=_natural, metavar="ID", help=reference)
    wanted = "largest 1 sigma of a marker's position, in its sides (%(default)s)"
    parser.add_argument("--within-sides", type=_positive, default=0.01, metavar="X", help=wanted)
    wanted = "largest 1 sigma of a marker's attitude, degrees (%(default)s)"
    parser.add_argument("--within-deg", type=_positive, default=0.5, metavar="X", help=wanted)
    views = "most frames used; they are chosen to show the target from all sides (%(default)s)"
    parser.add_argument("--views", type=_natural, default=120, metavar="N", help=views)


def _export(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("recording", metavar="RUN", type=Path, help="the run.mcap of a replay or a live run")
    parser.add_argument("out", metavar="OUT", type=Path, help="the file to write")
    kinds = ("csv", "parquet", "oem", "aem")
    parser.add_argument("--as", dest="kind", choices=kinds, help="default: as the name of OUT ends")
    parser.add_argument("--chaser", default="CHASER", metavar="NAME", help="OEM, AEM: its name (%(default)s)")
    parser.add_argument("--target", default="TARGET", metavar="NAME", help="OEM, AEM: its name (%(default)s)")
    parser.add_argument("--originator", default="RELNAV", metavar="NAME", help="OEM, AEM: who made it (%(default)s)")


def _node(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("name", choices=("source", "detector", "pose_filter", "recorder", "viewer", "relay"))
    parser.add_argument("--connect", metavar="ENDPOINT", default="tcp/127.0.0.1:7447", help="default: %(default)s")
    parser.add_argument("--out", type=Path, default=Path("out/live"), help="recorder, viewer: folder (%(default)s)")
    parser.add_argument("--source", help="source: /dev/video0, or a recording, video or folder")
    parser.add_argument("--loop", action="store_true", help="source: play a file again and again")
    parser.add_argument("--view", choices=("native", "web", "none"), default="none", help="viewer (%(default)s)")
    parser.add_argument("--bind", default="127.0.0.1", help="viewer: address of the page (%(default)s)")
    parser.add_argument(
        "--to",
        action="append",
        metavar="WHERE",
        help="relay: udp://HOST:PORT, udp+json://HOST:PORT, 42://HOST:PORT[/SC], ros2 or ros2dds, also as "
        "ros2://HOST:PORT for another router; may be given several times",
    )
    _viewer_ports(parser)
    _source_options(parser)
    # What only the supervisor says.
    for flag in ("--hub", "--companions", "--resume"):
        parser.add_argument(flag, help=argparse.SUPPRESS)
    for flag in ("--lossless", "--supervised"):
        parser.add_argument(flag, action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--speed", type=_speed, default=1.0, help=argparse.SUPPRESS)


def _positive(text: str) -> float:
    value = float(text)
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"must be positive, got {text}")
    return value


def _natural(text: str) -> int:
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"must not be negative, got {text}")
    return value


def _speed(text: str) -> float:
    """Return a speed; max is infinity."""
    return float("inf") if text == "max" else _positive(text)
