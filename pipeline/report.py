"""The picture of a run: approach, errors with their bounds, consistency, layers, latency and modes on one page."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter
from numpy.typing import NDArray
from scipy.stats import chi2

from pipeline.convert import pose_matrix
from pipeline.run import ATTITUDE, POSE_DOF, POSITION, Row, Run, load_run, marker_range_m
from pipeline.scoring import Summary
from schemas import Mode

Array = NDArray[np.float64]

INK, MUTED, GRID = "#22303c", "#6b7a88", "#dfe5ea"
ESTIMATE, TRUTH, BOUND = "#1f6fb4", "#e07b00", "#9fb8cc"
LAYER_INKS = ("#1b9e5a", "#d98200", "#b0369b")
MODE_INKS = {
    Mode.INIT: "#c3ccd4",
    Mode.AMBIGUOUS: "#f0b429",
    Mode.TRACK: "#3fae6a",
    Mode.COAST: "#4a90d9",
    Mode.LOST: "#d64545",
}
LAYER_NAMES = ("outer", "middle", "inner")
BAND_PROBABILITY = 0.95
RANGE_BINS = 40
LATENCY_BINS = 50
LABELLED_DECADES = 2.5
"""A logarithmic axis longer than this has no room for labels between tenfolds."""


@dataclass(frozen=True, eq=False)
class Columns:
    """A run as arrays, one entry a frame; NaN where a frame has no such value."""

    t_s: Array
    range_true_m: Array
    range_estimated_m: Array
    closing_m_s: Array
    position_error_m: Array
    position_3sigma_m: Array
    attitude_error_rad: Array
    attitude_3sigma_rad: Array
    nees_per_dof: Array
    nis: Array
    nis_dof: Array
    latency_s: Array


def write_report(run_path: str | Path, summary: Summary, out_png: str | Path) -> None:
    """Draw the run recorded in ``run_path``.  Raises RecordingError (a ValueError) when it cannot be read."""
    draw_report(load_run(run_path), summary).savefig(out_png)


def draw_report(run: Run, summary: Summary) -> Figure:
    """Return the page for a run and its summary; without truth it shows bounds only, without states it says so."""
    figure = Figure(figsize=(15, 11), dpi=110, facecolor="white")
    grid = figure.add_gridspec(
        4, 2, height_ratios=(0.16, 1, 1, 0.8), left=0.06, right=0.955, top=0.895, bottom=0.055, hspace=0.42, wspace=0.14
    )
    columns = _columns(run)
    strip = figure.add_subplot(grid[0, :])
    _draw_modes(strip, run)
    panels: tuple[tuple[Callable[[Axes, Run, Columns], None], tuple[int, int]], ...] = (
        (_draw_approach, (1, 0)),
        (_draw_position, (1, 1)),
        (_draw_consistency, (2, 0)),
        (_draw_attitude, (2, 1)),
        (_draw_layers, (3, 0)),
        (_draw_latency, (3, 1)),
    )
    for draw, (row, column) in panels:
        ax = figure.add_subplot(grid[row, column])
        _style(ax)
        draw(ax, run, columns)
    figure.text(0.06, 0.962, "Relative navigation run", fontsize=20, weight="bold", color=INK)
    figure.text(0.06, 0.935, _headline(summary), fontsize=11.5, color=MUTED)
    return figure


def _columns(run: Run) -> Columns:
    def column(value: Callable[[Row], float | None]) -> Array:
        values = (value(row) for row in run.rows)
        return np.array([np.nan if v is None else v for v in values], dtype=float)

    def estimated_range_m(row: Row) -> float | None:
        if row.state is None or row.state.T_chaser_target is None:
            return None
        return marker_range_m(pose_matrix(row.state.T_chaser_target), run.mission)

    def three_sigma(row: Row, part: slice) -> float | None:
        if row.covariance is None:
            return None
        return 3 * float(np.sqrt(max(np.trace(row.covariance[part, part]), 0.0)))

    return Columns(
        t_s=column(lambda row: row.t_s),
        range_true_m=column(lambda row: row.range_m if row.truth is not None else None),
        range_estimated_m=column(estimated_range_m),
        closing_m_s=column(lambda row: row.state.port.closing_speed_m_s if row.state and row.state.port else None),
        position_error_m=column(lambda row: row.position_error_m),
        position_3sigma_m=column(lambda row: three_sigma(row, POSITION)),
        attitude_error_rad=column(lambda row: row.attitude_error_rad),
        attitude_3sigma_rad=column(lambda row: three_sigma(row, ATTITUDE)),
        nees_per_dof=column(lambda row: row.nees_per_dof(POSE_DOF)),
        nis=column(lambda row: row.state.nis if row.state else None),
        nis_dof=column(lambda row: row.state.nis_dof or None if row.state else None),
        latency_s=column(lambda row: row.latency_s),
    )


def _headline(summary: Summary) -> str:
    parts = [f"{summary.frames} frames, a marker in {summary.frames_detected}"]
    if summary.position_rms_m is not None and summary.attitude_rms_rad is not None:
        parts.append(f"rms {summary.position_rms_m * 1e3:.2f} mm, {np.degrees(summary.attitude_rms_rad):.2f}°")
    if summary.nees_mean is not None:
        parts.append(f"NEES {summary.nees_mean:.2f} per dof")
    if summary.nis_mean is not None:
        parts.append(f"NIS {summary.nis_mean:.2f} per dof")
    if summary.latency_ms.p50 is not None:
        parts.append(f"latency {summary.latency_ms.p50:.1f} ms (p99 {summary.latency_ms.p99:.1f})")
    parts.append(f"{summary.dropped} dropped")
    return "   ·   ".join(parts)


def _style(ax: Axes) -> None:
    ax.set_axisbelow(True)
    ax.grid(True, color=GRID, linewidth=0.8)
    ax.tick_params(which="both", colors=MUTED, labelsize=9.5, length=0)
    for side in ax.spines.values():
        side.set_visible(False)


def _title(ax: Axes, text: str, note: str = "") -> None:
    ax.set_title(text, loc="left", fontsize=12.5, weight="bold", color=INK, pad=8)
    if note:
        ax.set_title(note, loc="right", fontsize=9.5, color=MUTED, pad=8)


def _legend(ax: Axes) -> None:
    ax.legend(loc="upper right", ncols=3, frameon=False, fontsize=9.5, labelcolor=INK)


def _say_nothing(ax: Axes, why: str) -> None:
    ax.text(0.5, 0.5, why, transform=ax.transAxes, ha="center", va="center", fontsize=11, color=MUTED)
    ax.set_xticks([])
    ax.set_yticks([])


def _draw_modes(ax: Axes, run: Run) -> None:
    """Draw the mode over time as one strip."""
    times = np.array([t_s for t_s, _ in run.modes])
    if len(times):
        step_s = float(np.median(np.diff(times))) if len(times) > 1 else 1.0
        modes = [mode for _, mode in run.modes]
        ends = np.append(times[1:], times[-1] + step_s)
        starts = [0, *(k for k in range(1, len(modes)) if modes[k] != modes[k - 1])]
        for first, after in zip(starts, [*starts[1:], len(modes)], strict=True):
            ax.axvspan(times[first], ends[after - 1], color=MODE_INKS[modes[first]], linewidth=0)
        ax.set_xlim(times[0], ends[-1])
    _style(ax)
    ax.grid(False)
    ax.set_yticks([])
    _title(ax, "Mode")
    seen = [mode for mode in Mode if any(mode == m for _, m in run.modes)]
    handles = [Patch(color=MODE_INKS[mode], label=mode.name) for mode in seen]
    ax.legend(
        handles=handles, loc="lower right", bbox_to_anchor=(1, 1), ncols=5, frameon=False, fontsize=9.5, labelcolor=INK
    )


def _draw_approach(ax: Axes, run: Run, c: Columns) -> None:
    """Draw range and, on the right, closing speed."""
    _title(ax, "Range, m", "grey, on the right: closing speed, mm/s")
    if np.isnan(c.range_true_m).all() and np.isnan(c.range_estimated_m).all():
        _say_nothing(ax, "no state")
        return
    ax.plot(c.t_s, c.range_true_m, color=TRUTH, linewidth=4, alpha=0.35, label=_if_any("range, truth", c.range_true_m))
    ax.plot(c.t_s, c.range_estimated_m, color=ESTIMATE, linewidth=1.6, label="range, estimated")
    ax.set_ylim(bottom=0)
    _time_axis(ax, c.t_s)
    _legend(ax)
    if not np.isnan(c.closing_m_s).all():
        right = ax.twinx()
        _style(right)
        right.grid(False)
        right.plot(c.t_s, c.closing_m_s * 1e3, color=MUTED, linewidth=1)
        low, high = np.nanpercentile(c.closing_m_s * 1e3, (2, 98))
        right.set_ylim(min(1.5 * low, 0.0), 1.5 * max(high, 1.0))


def _draw_position(ax: Axes, run: Run, c: Columns) -> None:
    _title(ax, "Position error, mm", "norm; 3σ from the trace of the covariance")
    _draw_error(ax, c.t_s, c.position_error_m * 1e3, c.position_3sigma_m * 1e3)


def _draw_attitude(ax: Axes, run: Run, c: Columns) -> None:
    _title(ax, "Attitude error, degrees", "angle; 3σ from the trace of the covariance")
    _draw_error(ax, c.t_s, np.degrees(c.attitude_error_rad), np.degrees(c.attitude_3sigma_rad))


def _draw_error(ax: Axes, t_s: Array, error: Array, bound: Array) -> None:
    """Draw an error and its bound over time on a logarithmic axis, where zero has no place."""
    error, bound = (np.where(values > 0, values, np.nan) for values in (error, bound))
    if np.isnan(bound).all() and np.isnan(error).all():
        _say_nothing(ax, "no state")
        return
    floor = np.nanmin(np.concatenate([error, bound / 100])) / 2
    ax.fill_between(t_s, floor, bound, color=BOUND, alpha=0.35, linewidth=0, label=_if_any("3σ", bound))
    ax.plot(t_s, bound, color=BOUND, linewidth=1.2)
    ax.plot(t_s, error, color=ESTIMATE, linewidth=1.2, label=_if_any("error", error))
    ax.set_yscale("log")
    ax.set_ylim(*_log_limits(np.concatenate([error, bound])))
    _plain_numbers(ax.yaxis)
    _time_axis(ax, t_s)
    _legend(ax)


def _draw_consistency(ax: Axes, run: Run, c: Columns) -> None:
    """Draw NEES and NIS per degree of freedom with the chi-square band that they should stay in."""
    _title(ax, "Consistency", f"per degree of freedom; bands hold {BAND_PROBABILITY:.0%} when the covariance is right")
    if np.isnan(c.nees_per_dof).all() and np.isnan(c.nis).all():
        _say_nothing(ax, "no update and no truth")
        return
    nis_per_dof = c.nis / c.nis_dof
    tails = ((1 - BAND_PROBABILITY) / 2, (1 + BAND_PROBABILITY) / 2)
    low, high = (chi2.ppf(tail, c.nis_dof) / c.nis_dof for tail in tails)
    ax.fill_between(c.t_s, low, high, step="mid", color=ESTIMATE, alpha=0.15, linewidth=0)
    ax.plot(c.t_s, nis_per_dof, ".", markersize=3, color=ESTIMATE, label=_if_any("NIS", nis_per_dof))
    if not np.isnan(c.nees_per_dof).all():
        for tail in tails:
            ax.axhline(chi2.ppf(tail, POSE_DOF) / POSE_DOF, color=TRUTH, linewidth=1, linestyle=(0, (4, 3)))
        ax.plot(c.t_s, c.nees_per_dof, color=TRUTH, linewidth=1.1, label="NEES of the pose")
    ax.axhline(1, color=MUTED, linewidth=0.8)
    ax.set_yscale("log")
    least, most = _log_limits(np.concatenate([c.nees_per_dof, nis_per_dof]))
    ax.set_ylim(min(least, 0.2), 2 * max(most, 4.0))
    _plain_numbers(ax.yaxis)
    _time_axis(ax, c.t_s)
    _legend(ax)


def _draw_layers(ax: Axes, run: Run, c: Columns) -> None:
    """Draw, for bins of range, the share of frames in which each layer was measured."""
    _title(ax, "Layers measured over range", "share of frames")
    known = [
        (row.range_m, {seen.layer for found in row.detections.detections for seen in found.layers})
        for row in run.rows
        if row.range_m is not None and row.detections is not None
    ]
    if not known:
        _say_nothing(ax, "no range")
        return
    ranges_m = np.array([range_m for range_m, _ in known])
    edges = np.geomspace(ranges_m.min() * 0.999, ranges_m.max() * 1.001, RANGE_BINS + 1)
    frames = np.histogram(ranges_m, edges)[0]
    for layer, ink in enumerate(LAYER_INKS):
        seen = np.array([layer in layers for _, layers in known])
        share = np.histogram(ranges_m[seen], edges)[0] / np.maximum(frames, 1)
        base = 2 - layer
        ax.bar(edges[:-1], 0.86 * share, np.diff(edges), base, align="edge", color=ink, alpha=0.85, linewidth=0)
    ax.set_xscale("log")
    ax.set_xlim(edges[-1], edges[0])
    _plain_numbers(ax.xaxis)
    ax.set_ylim(0, 3)
    ax.set_yticks([2.43, 1.43, 0.43], LAYER_NAMES)
    ax.grid(False, axis="y")
    ax.set_xlabel("m, closing to the right", color=MUTED)


def _draw_latency(ax: Axes, run: Run, c: Columns) -> None:
    """Draw the histogram of latency with its median and 99th percentile."""
    _title(ax, "Latency", "from the frame's start in the pipeline to its recorded state")
    latency_ms = c.latency_s[~np.isnan(c.latency_s)] * 1e3
    if not len(latency_ms):
        _say_nothing(ax, "no state")
        return
    p50, p99 = np.percentile(latency_ms, (50, 99))
    top = max(1.3 * p99, latency_ms.min() + 1.0)
    ax.hist(np.minimum(latency_ms, top), LATENCY_BINS, range=(0, top), color=ESTIMATE, alpha=0.75)
    for value, name, height in ((p50, "p50", 0.98), (p99, "p99", 0.86)):
        ax.axvline(value, color=INK, linewidth=1, linestyle=(0, (4, 3)))
        ax.annotate(
            f"{name} {value:.1f} ms",
            (value, height),
            xytext=(4, 0),
            xycoords=("data", "axes fraction"),
            textcoords="offset points",
            va="top",
            color=INK,
            bbox={"facecolor": "white", "alpha": 0.8, "edgecolor": "none", "pad": 2},
        )
    ax.set_xlim(0, top)
    ax.set_xlabel("ms" + (", later ones in the last bar" if latency_ms.max() > top else ""), color=MUTED)
    ax.set_ylabel("frames", color=MUTED)


def _time_axis(ax: Axes, t_s: Array) -> None:
    ax.set_xlim(t_s[0], max(t_s[-1], t_s[0] + 1e-3))
    ax.set_xlabel("s", color=MUTED)


def _plain_numbers(axis: Axis) -> None:
    """Label a logarithmic axis 0.1, 0.2, 0.5, 1, ... instead of with powers; a long one with tenfolds only."""
    low, high = axis.get_view_interval()
    digits = "25" if abs(np.log10(high / low)) < LABELLED_DECADES else ""
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(FuncFormatter(lambda value, _: f"{value:g}" if f"{value:.0e}"[0] in digits else ""))


def _if_any(label: str, values: Array) -> str:
    """Return a legend label, or matplotlib's name for none when there is nothing to explain."""
    return "_nolegend_" if np.isnan(values).all() else label


def _log_limits(values: Array) -> tuple[float, float]:
    """Return limits of a logarithmic axis for positive values, outliers of either side left out."""
    positive = values[np.isfinite(values) & (values > 0)]
    if not len(positive):
        return 0.1, 10.0
    low, high = np.percentile(positive, (1, 99.7))
    return low / 1.6, high * 1.8
