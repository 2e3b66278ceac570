"""How good a run was: detections, accuracy, consistency, latency and losses, from its recording alone.

Errors are those of ``astratag.transforms.difference`` (translation in metres, rotation in radians, the convention of
every covariance), over states in TRACK or COAST, where truth of the same time is recorded.  Range is as in
``pipeline.run``.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from pipeline.convert import pose_matrix
from pipeline.expected import is_false, visible_layers
from pipeline.run import POSE_DOF, STATE_DOF, Row, Run, load_run
from pipeline.run_bound import BoundBin, bound_bins, nis_correlation
from schemas import Mode

NEAR_M = 0.5
"""Below this range position is judged in metres, beyond it as a share of range."""
WRONG_POSITION_M = 0.01
WRONG_POSITION_FRACTION = 0.05
WRONG_ATTITUDE_RAD = float(np.deg2rad(15.0))
"""A state that claims to be right is wrong when it is off by more than these: the larger position bound holds."""
EVENTS_SHOWN = 8


class Section(BaseModel):
    """Base of the summary's parts: closed and immutable."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class RangeSpan(Section):
    """Range at the first and the last frame that has one."""

    first: float | None
    last: float | None


class Latency(Section):
    """From a frame's start in the pipeline to the recorder's receipt of its state."""

    p50: float | None
    p99: float | None


class Accuracy(Section):
    """Errors over states in TRACK or COAST; null where there are none."""

    states: int
    position_rms_m: float | None
    position_rms_fraction: float | None
    """Of the range."""
    attitude_rms_rad: float | None


class Bands(Section):
    """Accuracy near and far."""

    below_0_5_m: Accuracy
    beyond_0_5_m: Accuracy


class LoggedEvent(Section):
    """One line of the run's log; ``t_s`` counts from the first frame."""

    t_s: float
    level: str
    text: str


class Summary(Section):
    """The contents of summary.json.  What cannot be known, for want of truth or of a marker map, is null."""

    frames: int
    frames_detected: int
    """Frames with at least one marker."""
    frames_visible: int | None
    """Frames in which truth puts at least one layer of the map wholly into the image."""
    visible_detected: float | None
    """Share of those with at least one marker detected."""
    detections_by_layer: dict[str, int]
    detections_by_method: dict[str, int]
    wrong_identities: int | None
    """Detections of ids that are not in the mission's map."""
    false_markers: int | None
    """Detections of ids of the map that lie grossly elsewhere than truth says."""
    range_m: RangeSpan
    states_scored: int
    """States in TRACK or COAST with truth: all errors are over these."""
    position_rms_m: float | None
    attitude_rms_rad: float | None
    bands: Bands | None
    nees_mean: float | None
    """Normalised error squared of the 6-dof pose, mean, per degree of freedom: 1 when the covariance is right."""
    nees_12_mean: float | None
    """The same of pose, velocity and rate together."""
    nis_mean: float | None
    """Normalised innovation squared per degree of freedom."""
    nis_correlation: float | None = None
    """Of NIS from one frame to the next: near 0 when innovations are white."""
    bound: list[BoundBin] | None = None
    """By range: errors beside the posterior Cramer-Rao bound of the measured corners."""
    states_wrong: int | None
    """States in TRACK or COAST that were grossly wrong."""
    covariances_invalid: int
    """States whose covariance is not positive definite."""
    modes: dict[str, float]
    """Seconds spent in each mode."""
    outside_corridor_s: float | None = None
    """Time in which states put the chaser inside the keep-out sphere and outside the corridor."""
    latency_ms: Latency
    dropped: int
    """Frames, by their sequence numbers, that no state followed."""
    rejections: dict[str, int]
    """Measurements that the filter refused, by reason."""
    wall_s: float
    """Between the recorder's first and last receipt."""
    events: list[LoggedEvent]


def score(path: str | Path) -> Summary:
    """Score a recorded run.  Raises ValueError when it is not a readable recording, or holds nothing to score."""
    run = load_run(path)
    if all(row.state is None and row.detections is None for row in run.rows):
        raise ValueError(f"{path} holds no detections and no states: replay it first, then score the run it writes")
    return score_run(run)


def score_run(run: Run) -> Summary:
    """Return the summary of a run."""
    scored = [row for row in run.rows if row.scored]
    states = [row.state for row in run.rows if row.state is not None]
    nis = [(state.nis, state.nis_dof) for state in states if state.nis is not None and state.nis_dof > 0]
    ranges_m = [row.range_m for row in run.rows if row.range_m is not None]
    overall = _accuracy(scored)
    return Summary(
        **_detection_scores(run),
        range_m=RangeSpan(first=ranges_m[0] if ranges_m else None, last=ranges_m[-1] if ranges_m else None),
        states_scored=overall.states,
        position_rms_m=overall.position_rms_m,
        attitude_rms_rad=overall.attitude_rms_rad,
        bands=_bands(scored) if run.has_truth else None,
        nees_mean=_mean(row.nees_per_dof(POSE_DOF) for row in scored),
        nees_12_mean=_mean(row.nees_per_dof(STATE_DOF) for row in scored),
        nis_mean=sum(value for value, _ in nis) / sum(dof for _, dof in nis) if nis else None,
        nis_correlation=nis_correlation(run),
        bound=bound_bins(run),
        states_wrong=sum(_is_wrong(row) for row in scored) if run.has_truth else None,
        covariances_invalid=sum(row.covariance_valid is False for row in run.rows),
        modes=seconds_by_mode(run.modes),
        outside_corridor_s=_outside_corridor_s(run.rows),
        latency_ms=_latency(run.rows),
        dropped=_dropped(run.rows),
        rejections=_counts(reason.split(":")[0] for state in states for reason in state.rejections),
        wall_s=run.wall_s,
        events=[LoggedEvent(t_s=event.t_s, level=event.level, text=event.text) for event in run.events],
    )


def _detection_scores(run: Run) -> dict[str, Any]:
    """Return the fields of Summary that tell how well markers were found."""
    mapped = {marker.id for marker in run.mission.markers}
    found = [(row, detection) for row in run.rows if row.detections for detection in row.detections.detections]
    detected = [row.detections is not None and len(row.detections.detections) > 0 for row in run.rows]
    scores: dict[str, Any] = {
        "frames": len(run.rows),
        "frames_detected": sum(detected),
        "frames_visible": None,
        "visible_detected": None,
        "detections_by_layer": _counts(str(seen.layer) for _, detection in found for seen in detection.layers),
        "detections_by_method": _counts(detection.method for _, detection in found),
        "wrong_identities": sum(d.marker_id not in mapped for _, d in found) if mapped else None,
        "false_markers": None,
    }
    if run.camera is None or not mapped or not run.has_truth:
        return scores
    poses = [None if row.truth is None else pose_matrix(row.truth.T_chaser_target) for row in run.rows]
    visible = [T is not None and len(visible_layers(T, run.mission, run.camera)) > 0 for T in poses]
    scores["frames_visible"] = sum(visible)
    scores["visible_detected"] = _mean(float(d) for d, v in zip(detected, visible, strict=True) if v)
    scores["false_markers"] = sum(
        is_false(detection, pose_matrix(row.truth.T_chaser_target), run.mission, run.camera)
        for row, detection in found
        if row.truth is not None and detection.marker_id in mapped
    )
    return scores


def _accuracy(rows: Sequence[Row]) -> Accuracy:
    fractions = (row.position_error_m / row.range_m for row in rows if row.position_error_m is not None and row.range_m)
    return Accuracy(
        states=len(rows),
        position_rms_m=_rms(row.position_error_m for row in rows),
        position_rms_fraction=_rms(fractions),
        attitude_rms_rad=_rms(row.attitude_error_rad for row in rows),
    )


def _bands(rows: Sequence[Row]) -> Bands:
    near = [row.range_m is not None and row.range_m < NEAR_M for row in rows]
    return Bands(
        below_0_5_m=_accuracy([row for row, is_near in zip(rows, near, strict=True) if is_near]),
        beyond_0_5_m=_accuracy([row for row, is_near in zip(rows, near, strict=True) if not is_near]),
    )


def _is_wrong(row: Row) -> bool:
    """Tell whether a state is grossly off."""
    if row.position_error_m is None or row.attitude_error_rad is None:
        return False
    bound_m = max(WRONG_POSITION_M, WRONG_POSITION_FRACTION * (row.range_m or 0.0))
    return row.position_error_m > bound_m or row.attitude_error_rad > WRONG_ATTITUDE_RAD


def seconds_by_mode(modes: Sequence[tuple[float, Mode]]) -> dict[str, float]:
    """Return the seconds spent in each mode: a mode holds until the next state, the last for a median interval."""
    seconds = {mode.name: 0.0 for mode in Mode}
    times = [t_s for t_s, _ in modes]
    if len(times) > 1:
        ends = [*times[1:], times[-1] + float(np.median(np.diff(times)))]
        for (t_s, mode), end_s in zip(modes, ends, strict=True):
            seconds[mode.name] += end_s - t_s
    return seconds


def _outside_corridor_s(rows: Sequence[Row]) -> float | None:
    """Return for how long states were where no chaser may be; None when none tells where it was."""
    ports = [(row.t_s, row.state.port) for row in rows if row.state is not None and row.state.port is not None]
    if len(ports) < 2:
        return None
    period_s = float(np.median(np.diff([t_s for t_s, _ in ports])))
    return period_s * sum(port.in_keep_out_sphere and not port.in_corridor for _, port in ports)


def _latency(rows: Sequence[Row]) -> Latency:
    latencies_ms = [row.latency_s * 1e3 for row in rows if row.latency_s is not None]
    if not latencies_ms:
        return Latency(p50=None, p99=None)
    p50, p99 = np.percentile(latencies_ms, (50, 99)).tolist()
    return Latency(p50=p50, p99=p99)


def _dropped(rows: Sequence[Row]) -> int:
    """Count the frames between the first and the last that no state followed, those never recorded included."""
    if not rows:
        return 0
    return rows[-1].sequence - rows[0].sequence + 1 - sum(row.state is not None for row in rows)


def _counts(names: Iterable[str]) -> dict[str, int]:
    return dict(sorted(Counter(names).items()))


def _mean(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def _rms(values: Iterable[float | None]) -> float | None:
    mean_square = _mean(None if value is None else value**2 for value in values)
    return None if mean_square is None else float(np.sqrt(mean_square))


def write_summary(summary: Summary, path: str | Path) -> None:
    """Write summary.json."""
    Path(path).write_text(summary.model_dump_json(indent=2) + "\n")


def print_table(summary: Summary, console: Console) -> None:
    """Print the summary for people: one screen, what is unknown left out."""
    table = Table(show_header=False, box=box.SIMPLE_HEAVY, padding=(0, 1))
    table.add_column(style="bold")
    table.add_column()
    for title, text in _table_rows(summary):
        if text:
            table.add_row(title, text)
    console.print(table)
    for event in summary.events[:EVENTS_SHOWN]:
        console.print(f"  [dim]{event.t_s:8.2f} s[/dim]  {escape(event.text)}", highlight=False)
    if len(summary.events) > EVENTS_SHOWN:
        console.print(f"  [dim]... and {len(summary.events) - EVENTS_SHOWN} more events[/dim]", highlight=False)


def _table_rows(s: Summary) -> list[tuple[str, str]]:
    """Return title and text of each line; the text is empty when there is nothing to say."""
    share = "" if s.visible_detected is None else f", {s.visible_detected:.1%} of the {s.frames_visible} that show one"
    false = "" if s.false_markers is None else f", {s.false_markers} false markers"
    wrong = "" if not s.states_wrong else f", [red]{s.states_wrong} grossly wrong[/red]"
    latency = s.latency_ms
    lines = [
        ("frames", f"{s.frames}, a marker in {s.frames_detected}{share}"),
        ("detections by layer", _listed(s.detections_by_layer)),
        ("detections by method", _listed(s.detections_by_method)),
        ("identities", "" if s.wrong_identities is None else f"{s.wrong_identities} wrong{false}"),
        ("range", "" if s.range_m.first is None else f"{s.range_m.first:.3f} m to {s.range_m.last:.3f} m"),
        ("seconds by mode", ", ".join(f"{name} {t_s:.1f}" for name, t_s in s.modes.items() if t_s > 0)),
        ("outside the corridor", f"{s.outside_corridor_s:.1f} s" if s.outside_corridor_s else ""),
        ("error, rms", _accuracy_text(s.position_rms_m, None, s.attitude_rms_rad) + wrong),
    ]
    if s.bands is not None:
        near, far = s.bands.below_0_5_m, s.bands.beyond_0_5_m
        lines += [
            (f"  below {NEAR_M} m", _accuracy_text(near.position_rms_m, None, near.attitude_rms_rad)),
            (f"  beyond {NEAR_M} m", _accuracy_text(None, far.position_rms_fraction, far.attitude_rms_rad)),
        ]
    return [
        *lines,
        ("NEES per dof", "" if s.nees_mean is None else f"{s.nees_mean:.2f} pose, {s.nees_12_mean or 0:.2f} state"),
        ("NIS per dof", _nis_text(s)),
        *(("  position and bound", _bound_text(part)) for part in s.bound or ()),
        ("latency", "" if latency.p50 is None else f"p50 {latency.p50:.1f} ms, p99 {latency.p99:.1f} ms"),
        ("refused by the filter", _listed(s.rejections)),
        ("dropped frames", f"{s.dropped}"),
        ("wall time", f"{s.wall_s:.1f} s, {s.frames / s.wall_s:.0f} frames/s" if s.wall_s > 0 else ""),
    ]


def _nis_text(s: Summary) -> str:
    if s.nis_mean is None:
        return ""
    return f"{s.nis_mean:.2f}" + ("" if s.nis_correlation is None else f", correlated by {s.nis_correlation:+.2f}")


def _bound_text(part: BoundBin) -> str:
    return (
        f"{part.farthest_m:.3g} to {part.nearest_m:.3g} m: {part.position_rms_m * 1e3:.3f} mm, "
        f"{part.position_bound_m * 1e3:.3f} mm allowed"
    )


def _listed(counts: dict[str, int]) -> str:
    return ", ".join(f"{escape(name)}: {count}" for name, count in counts.items())


def _accuracy_text(position_m: float | None, fraction: float | None, attitude_rad: float | None) -> str:
    parts = []
    if position_m is not None:
        parts.append(f"{position_m * 1e3:.2f} mm")
    if fraction is not None:
        parts.append(f"{fraction:.2%} of range")
    if attitude_rad is not None:
        parts.append(f"{np.degrees(attitude_rad):.2f}°")
    return ", ".join(parts)
