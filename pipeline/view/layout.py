"""How it looks: where each thing is drawn, its colour, and the windows it is drawn in.

One colour means one thing everywhere: blue is estimated, green is true, grey is a bound, violet the corridor;
warm colours are the marker's layers.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from pipeline.mission import CorridorSection
from pipeline.view.geometry import ELLIPSOID_SCALE, SIGMAS
from schemas import Mode, Phase

Array = NDArray[np.float64]

SCENE = "scene"
ESTIMATE, TRUTH = f"{SCENE}/estimate", f"{SCENE}/truth"
CHASER = f"{ESTIMATE}/chaser"
CAMERA = f"{CHASER}/camera"
IMAGE = f"{CAMERA}/image"
OVERLAY = f"{CAMERA}/overlay"
PATHS = (f"{ESTIMATE}/path", f"{TRUTH}/path")
STATUS = "status"
MODE, LARGEST_LAYER, IN_CORRIDOR = f"{STATUS}/filter_mode", f"{STATUS}/largest_layer", f"{STATUS}/corridor"
GUIDANCE_PHASE = f"{STATUS}/guidance"

ESTIMATE_COLOR, TRUTH_COLOR, BOUND_COLOR, CORRIDOR_COLOR = 0x4CB8FFFF, 0x8CE05AFF, 0x8B93A3FF, 0x9B7BFFFF
ALARM_COLOR, NOTHING_COLOR, GRID_COLOR, BODY_COLOR = 0xFF4040FF, 0x3A3F4AFF, 0xFFFFFF50, 0x5A6475FF
LAYER_COLORS = (0xFFD23FFF, 0xFF8C42FF, 0xFF4D6DFF)
LAYER_NAMES = ("outer", "middle", "inner")
AXIS_COLORS = (0xFF5050FF, 0x50E050FF, 0x5090FFFF)
MODE_COLORS = {
    Mode.INIT: 0x6B7280FF,
    Mode.AMBIGUOUS: 0xC77DFFFF,
    Mode.TRACK: ESTIMATE_COLOR,
    Mode.COAST: 0xFFB020FF,
    Mode.LOST: ALARM_COLOR,
}

PHASE_COLORS = {
    Phase.ACQUIRE: 0x6B7280FF,
    Phase.APPROACH: ESTIMATE_COLOR,
    Phase.HOLD_POINT: CORRIDOR_COLOR,
    Phase.HOLD: 0xFFB020FF,
    Phase.RETREAT: ALARM_COLOR,
    Phase.SAFE: 0xC77DFFFF,
    Phase.CONTACT: TRUTH_COLOR,
}

PLOTS = (
    ("range_m", "Range, port to port [m]"),
    ("lateral_mm", "Lateral offset [mm]"),
    ("closing_mm_s", "Closing speed [mm/s]"),
    ("seen", "Seen in the picture"),
    ("position_error_mm", "Position error [mm]"),
    ("attitude_error_deg", "Attitude error [deg]"),
    ("nis", "NIS per degree of freedom"),
    ("latency_ms", "Latency, frame to state [ms]"),
)
LEGENDS: dict[str, rrb.components.Corner2DLike] = {
    "range_m": "RightTop",
    "seen": "LeftTop",
    "position_error_mm": "RightTop",
    "nis": "RightTop",
}
"""In which corner a plot says what its lines are; the others have the same."""

LEGEND = f"""\
A **chaser** comes in to a **target** and measures where it is from the printed markers.

- **blue** estimated, **green** true, **grey** {SIGMAS:.0f}-sigma and 95 % bounds
- **ellipsoid** {SIGMAS:.0f} sigma, {ELLIPSOID_SCALE:.0f} times enlarged; **violet** corridor
- layers **yellow** outer, **orange** middle, **red** inner
- *dashed* predicted, *white grid* curved print
"""


def rgba(colors: Iterable[int]) -> NDArray[np.uint32]:
    """Return colours 0xRRGGBBAA as Rerun reads them without doubt."""
    return np.fromiter(colors, dtype=np.uint32)


def faint(color: int, alpha: int) -> int:
    """Return a colour 0xRRGGBBAA with another alpha, 0 to 255."""
    return color & ~0xFF | alpha


def series_styles() -> dict[str, rr.SeriesLines]:
    """Return the lines of each plot's entities."""
    thin, plain, thick = 1.0, 2.0, 3.0
    sigma = f"{SIGMAS:.0f} sigma"
    banded = [ESTIMATE_COLOR, BOUND_COLOR, BOUND_COLOR]
    styles = {
        "nis": _lines(["NIS", "95 % band", "95 % band"], banded, [plain, thin, thin]),
        "latency_ms": _lines(["frame to state"], [ESTIMATE_COLOR], [plain]),
        "seen": _lines(["markers", "layers"], [ESTIMATE_COLOR, LAYER_COLORS[0]], [plain, plain]),
    }
    for name in ("range_m", "lateral_mm", "closing_mm_s"):
        styles[f"{name}/estimate"] = _lines(["estimate", f"+{sigma}", f"-{sigma}"], banded, [thick, thin, thin])
        styles[f"{name}/truth"] = _lines(["truth"], [TRUTH_COLOR], [thin])
    for name in ("position_error_mm", "attitude_error_deg"):
        styles[f"{name}/bound"] = _lines([sigma], [BOUND_COLOR], [thin])
        styles[f"{name}/error"] = _lines(["error"], [ESTIMATE_COLOR], [plain])
    return styles


def _lines(names: list[str], colors: list[int], widths: list[float]) -> rr.SeriesLines:
    return rr.SeriesLines(names=names, colors=rgba(colors), widths=widths)


def status_styles() -> dict[str, rr.StateConfiguration]:
    """Return the colours of each lane of the status."""
    return {
        MODE: rr.StateConfiguration(values=[mode.name for mode in Mode], colors=rgba(MODE_COLORS.values())),
        GUIDANCE_PHASE: rr.StateConfiguration(
            values=[phase.name for phase in Phase], colors=rgba(PHASE_COLORS.values())
        ),
        LARGEST_LAYER: rr.StateConfiguration(
            values=[*LAYER_NAMES, "none"], colors=rgba((*LAYER_COLORS, NOTHING_COLOR))
        ),
        IN_CORRIDOR: rr.StateConfiguration(values=["inside", "outside"], colors=rgba((CORRIDOR_COLOR, ALARM_COLOR))),
    }


def overlay_styles() -> dict[str, rr.AsComponents]:
    """Return how the picture's overlay is drawn; radii are in points of the screen, whatever the zoom."""
    ui_points = rr.Radius.ui_points
    return {
        "quads": rr.LineStrips2D.from_fields(radii=ui_points(2.0)),
        "predicted": rr.LineStrips2D.from_fields(colors=[LAYER_COLORS[0]], radii=ui_points(0.75)),
        "grid": rr.LineStrips2D.from_fields(colors=[GRID_COLOR], radii=ui_points(0.5)),
        "axes": rr.LineStrips2D.from_fields(radii=ui_points(1.5)),
        "labels": rr.Points2D.from_fields(colors=[0xFFFFFFFF], radii=[0.0], show_labels=True),
    }


def blueprint(corridor: CorridorSection) -> rrb.Blueprint:
    """Return the layout: camera and scene above, status beside them, plots below."""
    wide = _scene_view("Approach", corridor.start_m, eye=(0.95, 0.6, 1.0), target=(0.0, 0.0, 0.45))
    near = _scene_view("Close-up", corridor.start_m, eye=(0.26, 0.16, 0.3), target=(0.0, 0.0, 0.06))
    status = rrb.Vertical(
        rrb.TextDocumentView(origin="legend", name="What you see"),
        rrb.StateTimelineView(origin=STATUS, name="Status"),
        rrb.TextLogView(origin="events", name="Events", columns=rrb.TextLogColumns(text_log_columns=["Body"])),
        row_shares=[0.36, 0.38, 0.26],
    )
    above = rrb.Horizontal(
        rrb.Spatial2DView(origin=CAMERA, name="Camera", background=[0, 0, 0]),
        rrb.Tabs(wide, near),
        status,
        column_shares=[0.42, 0.31, 0.27],
    )
    plots = [
        rrb.TimeSeriesView(
            origin=f"plots/{name}",
            name=title,
            plot_legend=rrb.PlotLegend(LEGENDS.get(name), visible=name in LEGENDS),
        )
        for name, title in PLOTS
    ]
    return rrb.Blueprint(
        rrb.Vertical(above, rrb.Grid(*plots, grid_columns=4), row_shares=[0.5, 0.5]),
        rrb.TimePanel(state="collapsed", timeline="capture_time"),
        collapse_panels=True,
    )


def _scene_view(
    name: str, start_m: float, *, eye: tuple[float, float, float], target: tuple[float, float, float]
) -> rrb.Spatial3DView:
    """Return a view of the scene; eye and target are in the port frame, in lengths of the approach."""
    past = [
        rrb.VisibleTimeRange(
            timeline, start=rrb.TimeRangeBoundary.infinite(), end=rrb.TimeRangeBoundary.cursor_relative()
        )
        for timeline in ("frame", "capture_time")
    ]
    return rrb.Spatial3DView(
        origin=SCENE,
        contents=["$origin/**", f"- {OVERLAY}/**"],
        name=name,
        background=[18, 20, 26],
        line_grid=False,
        eye_controls=rrb.EyeControls3D(
            position=start_m * np.array(eye), look_target=start_m * np.array(target), eye_up=(0.0, 1.0, 0.0)
        ),
        overrides={path: rrb.archetypes.VisibleTimeRanges(past) for path in PATHS},
    )
