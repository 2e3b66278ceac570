"""A marker map for people and programs: a mission file, its covariances as JSON, a table, and a plot beside it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from rich import box
from rich.console import Console
from rich.table import Table

from pipeline.mapping.estimate import MappedMarker, MarkerMap, pose_section
from pipeline.mapping.figure import draw_map
from pipeline.mission import Mission


def paths_beside(mission_path: Path) -> tuple[Path, Path]:
    """Return where the covariances and the plot go that belong to a mission file."""
    return mission_path.with_suffix(".map.json"), mission_path.with_suffix(".map.png")


def write_map(
    found: MarkerMap, mission: Mission, mission_path: Path, *, sources: Sequence[str], overwrite: bool
) -> tuple[Path, Path, Path]:
    """Write the mission with the map, and beside it covariances and plot; return the three paths.

    Raises ValueError when one exists and is not to be overwritten, or cannot be written.
    """
    paths = (mission_path, *paths_beside(mission_path))
    require_free(mission_path, overwrite=overwrite)
    try:
        mission_path.parent.mkdir(parents=True, exist_ok=True)
        paths[0].write_text(mission_yaml(found, mission, sources))
        paths[1].write_text(json.dumps(map_json(found), indent=2) + "\n")
        draw_map(found).savefig(paths[2])
    except OSError as error:
        raise ValueError(f"cannot write {error.filename or mission_path}: {error.strerror}") from error
    return paths


def require_free(mission_path: Path, *, overwrite: bool) -> None:
    """Raise ValueError when a result exists and is not to be overwritten."""
    for path in (mission_path, *paths_beside(mission_path)):
        if path.exists() and not overwrite:
            raise ValueError(f"{path} exists: choose another file with --out, or say --overwrite")


def mission_yaml(found: MarkerMap, mission: Mission, sources: Sequence[str]) -> str:
    """Return the mission with the map as YAML that says where it comes from and how well it is known."""
    mapped = found.mission(mission)
    lines = [
        f"# Marker map estimated by `relnav map` from {', '.join(sources)}: {found.views} of {found.views_seen} views.",
        f"# Marker {found.reference} is the reference. One standard deviation of the others, in the worst direction:",
        *(
            f"#   marker {marker.section.id}: {marker.position_sigma_m * 1e3:.3f} mm, "
            f"{np.degrees(marker.attitude_sigma_rad):.3f} degrees"
            for marker in found.markers
            if marker.section.id != found.reference
        ),
    ]
    data = mapped.model_dump(mode="json", include=mapped.model_fields_set)
    return "\n".join(lines) + "\n" + yaml.safe_dump(data, sort_keys=False, default_flow_style=None, width=120)


def map_json(found: MarkerMap) -> dict[str, Any]:
    """Return the map with covariances (6, 6), metres then radians, right perturbation in the marker's axes."""
    return {
        "reference": found.reference,
        "views": found.views,
        "views_seen": found.views_seen,
        "misfit": found.misfit,
        "markers": [_marker_json(marker) for marker in found.markers],
        "joint_ids": [m.section.id for m in found.markers if m.section.id != found.reference],
        "joint_covariance": found.joint_covariance.tolist(),
    }


def _marker_json(marker: MappedMarker) -> dict[str, Any]:
    return {
        "id": marker.section.id,
        "T_target_marker": pose_section(marker.T_target_marker).model_dump(mode="json"),
        "covariance": marker.covariance.tolist(),
        "views": marker.views,
        "corners": len(marker.residuals_px),
        "dropped_layers": marker.dropped_layers,
        "residual_rms_px": marker.residual_rms_px,
    }


def print_map(found: MarkerMap, console: Console) -> None:
    """Print the map for people."""
    title = f"Marker map from {found.views} of {found.views_seen} views"
    table = Table(box=box.SIMPLE_HEAVY, title=title, title_justify="left", padding=0, pad_edge=False)
    table.add_column("marker", no_wrap=True)
    for heading in ("x mm", "y mm", "z mm", "1σ mm", "turn deg", "1σ deg", "views", "layers out", "rms px"):
        table.add_column(heading, justify="right", no_wrap=len(heading) < 6)
    for marker in found.markers:
        fixed = marker.section.id == found.reference
        cosine = np.clip((np.trace(marker.T_target_marker[:3, :3]) - 1) / 2, -1, 1)
        table.add_row(
            f"{marker.section.id} {marker.section.surface.kind} {marker.section.side_m * 1e3:g} mm",
            *(f"{x:.2f}" for x in marker.T_target_marker[:3, 3] * 1e3),
            "-" if fixed else f"{marker.position_sigma_m * 1e3:.3f}",
            f"{np.degrees(np.arccos(cosine)):.2f}",
            "-" if fixed else f"{np.degrees(marker.attitude_sigma_rad):.3f}",
            f"{marker.views}",
            f"{marker.dropped_layers}",
            f"{marker.residual_rms_px:.3f}",
        )
    console.print(table)
