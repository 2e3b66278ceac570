"""``relnav map``: where the markers of a target are, from a recording that shows them together."""

from __future__ import annotations

import argparse
import sys

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from pipeline.mapping.estimate import MarkerMap, Wanted, estimate_map
from pipeline.mapping.reading import Sightings, read_sightings
from pipeline.mapping.results import print_map, require_free, write_map

LEAST_EDGE_BIAS_PX = 0.05
"""What each corner is off by, alike in every view, is taken to be at least so much: it does not average out.  Maps from
rendered pictures then have 0.6 to 2.7 times the squared error that they promise, by marker."""
DOUBTFUL_MISFIT = 4.0
"""Residuals twice what the corners' sigmas promise are worth a word."""


def marker_map(args: argparse.Namespace) -> None:
    """Estimate the marker map, print it, and write the mission with it."""
    require_free(args.out, overwrite=args.overwrite)
    console = Console(highlight=False)
    sightings = _read(args, console)
    _warn_of_others(sightings)
    settings = sightings.mission.filter
    found = estimate_map(
        sightings.views,
        sightings.markers,
        edge_bias_px=max(settings.edge_bias_px, LEAST_EDGE_BIAS_PX),
        ambiguity_ratio=settings.ambiguity_ratio,
        reference=args.reference,
        wanted=Wanted(args.within_sides, float(np.deg2rad(args.within_deg))),
        most_views=args.views,
    )
    sources = [str(recording) for recording in args.recordings]
    paths = write_map(found, sightings.mission, args.out, sources=sources, overwrite=args.overwrite)
    print_map(found, console)
    _warn_of_misfit(found)
    print("written: " + ", ".join(str(path) for path in paths))
    print(f"fly on it: relnav replay {sources[0]} --mission {args.out}")


def _read(args: argparse.Namespace, console: Console) -> Sightings:
    """Return what the recordings show, with a bar while the detector looks at them."""
    columns = (TextColumn("Detecting"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, disable=not console.is_terminal, transient=True) as progress:
        task = progress.add_task("", total=None, visible=False)

        def on_frame(done: int, total: int | None) -> None:
            progress.update(task, completed=done, total=total, visible=True)

        return read_sightings(
            args.recordings,
            mission_path=args.mission,
            camera_path=args.camera,
            scale_camera=args.scale_camera,
            on_frame=on_frame,
        )


def _warn_of_others(sightings: Sightings) -> None:
    for marker_id, count in sorted(sightings.others.items()):
        print(
            f"relnav: warning: marker {marker_id}, seen in {count} frames, is left out: the mission does not list it",
            file=sys.stderr,
        )


def _warn_of_misfit(found: MarkerMap) -> None:
    if found.misfit > DOUBTFUL_MISFIT:
        print(
            f"relnav: warning: corners fit {found.misfit**0.5:.1f} times worse than they promise, and the covariances "
            "are larger by that: check the calibration, and the markers' sides and surfaces",
            file=sys.stderr,
        )
