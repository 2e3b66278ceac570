"""The figures: recall and corner error over each condition, and CPU time a frame."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from textwrap import fill

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from benchmarks.detection.peers import ENTRANTS, TRACKED
from benchmarks.detection.recall import SIZES
from benchmarks.detection.scenes import CONDITIONS, Condition

STYLES = {
    "AstraTag": ("#0072B2", "o", "-"),
    "AstraTag, surface unknown": ("#56B4E9", "o", "--"),
    "tag36h11, decimate 1": ("#D55E00", "^", "-"),
    "tag36h11, decimate 2": ("#D55E00", "^", "--"),
    "tagCustom48h12, decimate 1": ("#CC79A7", "v", "-"),
    "tagCustom48h12, decimate 2": ("#CC79A7", "v", "--"),
    "ArUco 4x4": ("#E69F00", "s", "-"),
    "Fractal ArUco, 3 levels": ("#009E73", "D", "-"),
}
TITLES = {"equal": "equal printed area", "nominal": "nominal 100 mm, as in the paper"}


def rows_of(rows: Sequence[dict], condition: str, entrant: str, size: str) -> list[dict]:
    """Return an entrant's rows in order of the value; AstraTag's sheet is the same at both sizes."""
    mine = [row for row in rows if row["condition"] == condition and row["entrant"] == entrant]
    return sorted([row for row in mine if row["size"] == size] or mine, key=lambda row: row["value"])


def draw_condition(condition: Condition, rows: Sequence[dict], folder: Path) -> Path:
    """Save recall, with 95 % bounds for AstraTag, and corner error, over one condition at both sizes."""
    figure = Figure(figsize=(12, 7.5), layout="constrained")
    panels = figure.subplots(2, len(SIZES), sharex=True, sharey="row")
    for column, size in enumerate(SIZES):
        recall, corners = panels[:, column]
        for entrant in ENTRANTS:
            mine = rows_of(rows, condition.name, entrant.name, size)
            if not mine:
                continue
            colour, mark, line = STYLES[entrant.name]
            values = [row["value"] for row in mine]
            style = {"color": colour, "marker": mark, "linestyle": line, "markersize": 4}
            recall.plot(values, [100 * row["recall"] for row in mine], label=entrant.name, **style)
            if entrant.marker == "AstraTag":  # bands of all would hide each other
                low, high = zip(*[[100 * bound for bound in row["recall_95"]] for row in mine], strict=True)
                recall.fill_between(values, low, high, color=colour, alpha=0.12, lw=0)
            errors = [row["corner_rms_px"] if row["corner_rms_px"] is not None else float("nan") for row in mine]
            corners.plot(values, errors, **style)
        recall.plot(list(condition.asked), list(condition.asked.values()), "k_", label="asked of AstraTag")
        recall.set_title(TITLES[size])
        corners.set(xlabel=condition.label)
    panels[0, 0].set(ylabel="found, %", ylim=(-3, 103))
    if any(row["corner_rms_px"] for row in rows):
        panels[1, 0].set_yscale("log")
    panels[1, 0].set_ylabel("corner RMS a coordinate, px")
    figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=5, fontsize=8)
    return save(figure, folder / f"{condition.name}.png")


def draw_covariance(rows: Sequence[dict], folder: Path) -> Path:
    """Save the mean NEES of poses over each condition, with its chi-square band."""
    figure = Figure(figsize=(13, 4), layout="constrained")
    conditions = {condition.name: condition for condition in CONDITIONS}
    names = list(dict.fromkeys(row["condition"] for row in rows))
    panels = figure.subplots(1, len(names), sharey=True, squeeze=False)[0]
    for axes, name in zip(panels, names, strict=True):
        for surface, entrant in (("told", "AstraTag"), ("unknown", "AstraTag, surface unknown")):
            mine = [row for row in rows if (row["condition"], row["surface"]) == (name, surface)]
            colour, mark, line = STYLES[entrant]
            at = range(len(mine))
            axes.plot(at, [row["nees"] for row in mine], color=colour, marker=mark, linestyle=line, label=entrant)
            if surface == "told":
                low, high = zip(*(row["nees_95"] for row in mine), strict=True)
                axes.fill_between(at, low, high, color="#999999", alpha=0.25, lw=0, label="95 % band of honest ones")
                axes.set_xticks(at, [f"{row['value']:g}" for row in mine])
        axes.set_xlabel(fill(conditions[name].label, width=30), fontsize=8)
    panels[0].set(ylabel="NEES a degree of freedom", ylim=(0, None))
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=8)
    return save(figure, folder / "covariance.png")


def draw_cost(rows: Sequence[dict], folder: Path) -> Path:
    """Save CPU time a frame at each image size."""
    figure = Figure(figsize=(11, 4), layout="constrained")
    sizes = list(dict.fromkeys(row["image"] for row in rows))
    names = [entrant.name for entrant in (*ENTRANTS, TRACKED)]
    for axes, size in zip(figure.subplots(1, len(sizes), sharey=True), sizes, strict=True):
        mine = {row["entrant"]: row["cpu_ms"] for row in rows if row["image"] == size}
        shown = [name for name in reversed(names) if name in mine]
        bars = axes.barh(shown, [mine[name] for name in shown], color="#999999")
        axes.bar_label(bars, fmt="%.2f", padding=2, fontsize=8)
        axes.set(title=size, xlabel="CPU ms a frame, one thread")
        axes.margins(x=0.2)
    return save(figure, folder / "cost.png")


def save(figure: Figure, path: Path) -> Path:
    """Write a figure without a display."""
    FigureCanvasAgg(figure).print_figure(path, dpi=110)
    return path
