"""The commands that need no bus: detect, marker, dictionary, score, smooth, recover, export."""

from __future__ import annotations

import argparse
import json
import sys
import time
from typing import Any

from rich.console import Console


def detect(args: argparse.Namespace) -> None:
    """Find markers in pictures, list them, and write them as JSON and as annotated pictures."""
    from pipeline.detect import detect_paths

    console = Console(highlight=False, soft_wrap=True)
    found = detect_paths(
        args.paths,
        dictionary=args.dictionary,
        side_m=args.side_m,
        camera_path=args.camera,
        scale_camera=args.scale_camera,
        annotate_dir=args.annotate,
        on_progress=lambda image: console.print(image_line(image), markup=False),
    )
    for skipped in found["skipped"]:
        print(f"relnav: warning: skipped {skipped['path']}: {skipped['reason']}", file=sys.stderr)
    if args.json is not None:
        args.json.parent.mkdir(parents=True, exist_ok=True)
        args.json.write_text(json.dumps(found, indent=2) + "\n")


def image_line(image: dict[str, Any]) -> str:
    """Return one line for an image's entry."""
    markers = []
    for detection in image["detections"]:
        layers = "+".join(str(layer["layer"]) for layer in detection["layers"])
        pose = detection["T_cam_marker"]
        where = "" if pose is None else f" at {sum(x * x for x in pose['translation_m']) ** 0.5:.3f} m"
        markers.append(
            f"{detection['family']} {detection['marker_id']} (layers {layers}, {detection['method']}){where}"
        )
    return f"{image['path']}: {'; '.join(markers) or 'no marker'}"


def marker(args: argparse.Namespace) -> None:
    """Write the artwork of markers and list the files."""
    from astratag.artwork import write_artwork
    from astratag.dictionary import load_dictionary
    from astratag.geometry import MarkerGeometry

    dictionary = load_dictionary(args.family, ids=sorted(set(args.ids)))
    asked = {name: getattr(args, name) for name in ("contraction", "border", "layers")}
    changed = {name: value for name, value in asked.items() if value is not None}
    geometry = MarkerGeometry(**changed)
    variant = "".join(f"_{name}{value:.4g}" for name, value in changed.items())
    for marker_id in dictionary.ids:
        path = args.out / f"{dictionary.family}_{marker_id:02d}_{args.side_mm:g}mm{variant}.{args.format}"
        print(write_artwork(dictionary, marker_id, path, side_m=args.side_mm / 1000.0, geometry=geometry))


def dictionary(args: argparse.Namespace) -> None:
    """Choose identities of a family and write them as a dictionary."""
    from astratag.codes import FAMILIES, select_identities
    from astratag.dictionary import load_dictionary, write_dictionary

    ids = select_identities(FAMILIES[args.family], args.count, args.seed)
    chosen = load_dictionary(args.family, ids=ids)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    path = write_dictionary(chosen, args.out)
    print(f"{path}: {len(chosen)} identities of {args.family}, {chosen.minimum_distance} cells apart")


def smooth(args: argparse.Namespace) -> None:
    """Write a recorded run again, with every state told by all frames, those after it too."""
    from pipeline.smoother import write_smoothed

    out = args.out or args.recording.with_suffix(".smoothed.mcap")
    print(f"{out}: {write_smoothed(args.recording, out)} states smoothed; `relnav score {out}` judges them")


def score(args: argparse.Namespace) -> None:
    """Print a recorded run's score, and draw it beside the recording."""
    from pipeline.report import write_report
    from pipeline.scoring import print_table
    from pipeline.scoring import score as score_recording

    summary = score_recording(args.recording)
    print_table(summary, Console(highlight=False))
    report = args.recording.with_suffix(".report.png")
    write_report(args.recording, summary, report)
    print(f"written: {report}")


def export(args: argparse.Namespace) -> None:
    """Write a recording's states as CSV, Parquet, OEM or AEM."""
    from pipeline.adapters.ccsds import Names
    from pipeline.exports import KINDS
    from pipeline.exports import export as export_recording

    kind = args.kind or args.out.suffix.removeprefix(".").lower()
    if kind not in KINDS:
        raise ValueError(f"cannot tell from its name what {args.out} is to be: say --as {', '.join(KINDS)}")
    names = Names(chaser=args.chaser, target=args.target, originator=args.originator)
    done = export_recording(args.recording, args.out, kind, names, created_ns=time.time_ns())
    print(f"{args.out}: {done.written} of {done.states} states")


def recover(args: argparse.Namespace) -> None:
    """Make a recording whole."""
    from pipeline.recording import recover as recover_recording

    report = recover_recording(args.recording, args.out)
    if report.whole:
        print(f"{report.out} is whole: {report.messages} messages, nothing to recover")
    else:
        print(f"{report.out}: {report.messages} messages recovered, {report.lost_bytes} bytes lost")
