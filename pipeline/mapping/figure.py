"""The picture of a marker map: from above and from the side with 3-sigma ellipses, and what the corners leave over."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from numpy.typing import NDArray

from astratag.transforms import transform
from pipeline.mapping.estimate import MappedMarker, MarkerMap
from pipeline.mission import MarkerSection

Array = NDArray[np.float64]

INK, MUTED, GRID = "#22303c", "#6b7a88", "#dfe5ea"
MARKER_INKS = ("#1f6fb4", "#e07b00", "#1b9e5a", "#b0369b", "#d64545", "#7a6a00", "#0f8f96", "#6b4fb8")
SIDES = (("From the front", 0, 1), ("From above", 0, 2), ("From the side", 2, 1))
"""Title, and the target's axes to the right and up."""
EDGE_POINTS = 12
LEAST_SHARE, LARGEST_SHARE = 0.01, 0.25
"""Of the picture: smaller ellipses are drawn larger, all by the same factor, so that they can be seen."""
ENLARGEMENTS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
RESIDUAL_REACH = 4.0


def draw_map(found: MarkerMap) -> Figure:
    """Return the page for a map."""
    figure = Figure(figsize=(14, 9.5), dpi=110, facecolor="white")
    grid = figure.add_gridspec(2, 6, left=0.055, right=0.95, top=0.87, bottom=0.075, hspace=0.33, wspace=0.9)
    inks = [MARKER_INKS[k % len(MARKER_INKS)] for k in range(len(found.markers))]
    outlines = [_outline(marker) for marker in found.markers]
    extent_m = float(np.ptp(np.concatenate(outlines), axis=0).max())
    enlarged = _enlargement(found, extent_m)
    for k, (title, right, up) in enumerate(SIDES):
        ax = figure.add_subplot(grid[0, 2 * k : 2 * k + 2])
        _style(ax, title, f"mm; 3σ{'' if enlarged == 1 else f', {enlarged} times enlarged'}")
        for marker, ink, outline in zip(found.markers, inks, outlines, strict=True):
            _draw_marker(ax, marker, outline, ink, (right, up), enlarged)
        ax.set_aspect("equal", adjustable="datalim")
        ax.margins(0.12)
        ax.set_xlabel(f"target {'xyz'[right]}", color=MUTED)
        ax.set_ylabel(f"target {'xyz'[up]}", color=MUTED)
    _draw_residuals(figure.add_subplot(grid[1, 0:3]), found, inks)
    _draw_sigmas(figure.add_subplot(grid[1, 3:6]), found, inks)
    figure.text(0.055, 0.95, "Marker map", fontsize=20, weight="bold", color=INK)
    figure.text(
        0.055,
        0.918,
        f"{len(found.markers)} markers, {found.reference} is the reference   ·   {found.views} of {found.views_seen} "
        f"views   ·   squared residuals {found.misfit:.2f} times what the corners' sigmas promise",
        fontsize=11.5,
        color=MUTED,
    )
    return figure


def _outline(marker: MappedMarker) -> Array:
    """Return the outline of a marker's black square on its surface (N, 3), target axes, metres."""
    return transform(marker.T_target_marker, marker.section.surface.surface().points(_square(marker.section)))


def _square(section: MarkerSection) -> Array:
    half_m = section.side_m / 2
    corners = half_m * np.array([[-1, 1], [1, 1], [1, -1], [-1, -1], [-1, 1]])
    along = np.linspace(0, 1, EDGE_POINTS)[:, None]
    return np.concatenate([a + along * (b - a) for a, b in pairwise(corners)])


def _covariance_in_target(marker: MappedMarker) -> Array:
    R_target_marker = marker.T_target_marker[:3, :3]
    return R_target_marker @ marker.covariance[:3, :3] @ R_target_marker.T


def _enlargement(found: MarkerMap, extent_m: float) -> int:
    """Return by how much ellipses are drawn larger: the largest one is then between two shares of the picture."""
    largest_m = 6 * max(marker.position_sigma_m for marker in found.markers)
    fitting = [factor for factor in ENLARGEMENTS if factor * largest_m <= LARGEST_SHARE * extent_m]
    return 1 if largest_m >= LEAST_SHARE * extent_m or not fitting else fitting[-1]


def _draw_marker(
    ax: Axes, marker: MappedMarker, outline: Array, ink: str, axes: tuple[int, int], enlarged: int
) -> None:
    right, up = axes
    ax.fill(outline[:, right] * 1e3, outline[:, up] * 1e3, color=ink, alpha=0.25, linewidth=0)
    ax.plot(outline[:, right] * 1e3, outline[:, up] * 1e3, color=ink, linewidth=1.6)
    origin_mm = marker.T_target_marker[:3, 3] * 1e3
    normal_mm = marker.T_target_marker[:3, 2] * marker.section.side_m / 2 * 1e3
    tip_mm = origin_mm + normal_mm
    x, y = (float(origin_mm[axis]) for axis in axes)
    tip = float(tip_mm[right]), float(tip_mm[up])
    ax.annotate("", tip, (x, y), arrowprops={"arrowstyle": "->", "color": ink, "linewidth": 1.2})
    variances, vectors = np.linalg.eigh(_covariance_in_target(marker)[np.ix_(axes, axes)])
    width, height = 6 * enlarged * 1e3 * np.sqrt(np.maximum(variances[::-1], 0.0))
    angle_deg = float(np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1])))
    if width > 0:
        ax.add_patch(Ellipse((x, y), width, height, angle=angle_deg, fill=False, color=INK, linewidth=1))
    text = f"{marker.section.id}"
    ax.annotate(text, (x, y), (6, 4), textcoords="offset points", fontsize=11, weight="bold", color=INK)


def _draw_residuals(ax: Axes, found: MarkerMap, inks: list[str]) -> None:
    """Draw what corners are off, right and down, each marker in its ink."""
    _style(ax, "Residuals of the corners", "")
    reach_px = RESIDUAL_REACH * max(marker.residual_rms_px for marker in found.markers)
    for marker, ink in zip(found.markers, inks, strict=True):
        x, y = marker.residuals_px.T
        label = f"{marker.section.id}: {marker.residual_rms_px:.3f} px rms, {len(x)} corners"
        ax.plot(x, y, ".", markersize=3, color=ink, alpha=0.6, label=label)
    ax.set(xlim=(-reach_px, reach_px), ylim=(reach_px, -reach_px), aspect="equal")
    ax.set_xlabel("right, px, seen minus explained", color=MUTED)
    ax.set_ylabel("down, px", color=MUTED)
    ax.legend(loc="upper left", frameon=False, fontsize=9, labelcolor=INK, markerscale=3)


def _draw_sigmas(ax: Axes, found: MarkerMap, inks: list[str]) -> None:
    """Draw the standard deviations of each marker's pose about its own axes."""
    _style(ax, "One standard deviation", "in the marker's own axes")
    estimated = [(m, ink) for m, ink in zip(found.markers, inks, strict=True) if m.section.id != found.reference]
    width = 0.8 / len(estimated)
    right = ax.twinx()
    for k, (marker, ink) in enumerate(estimated):
        sigma = np.sqrt(np.diag(marker.covariance))
        offset = (k - (len(estimated) - 1) / 2) * width
        ax.bar(np.arange(3) + offset, sigma[:3] * 1e3, 0.9 * width, color=ink, label=f"{marker.section.id}")
        right.bar(np.arange(3, 6) + offset, np.degrees(sigma[3:]), 0.9 * width, color=ink)
    ax.set_xticks(range(6), ["x", "y", "z", "about x", "about y", "about z"])
    ax.axvline(2.5, color=GRID, linewidth=2)
    for axis in (ax, right):
        axis.tick_params(which="both", colors=MUTED, labelsize=9.5, length=0)
        axis.set_ylim(0, None)
    ax.set_ylabel("mm", color=MUTED)
    right.set_ylabel("degrees", color=MUTED)
    for side in right.spines.values():
        side.set_visible(False)
    ax.legend(loc="upper center", ncols=8, frameon=False, fontsize=9.5, labelcolor=INK)
    ax.set_ylim(0, 1.2 * ax.get_ylim()[1])


def _style(ax: Axes, title: str, note: str) -> None:
    ax.set_axisbelow(True)
    ax.grid(True, color=GRID, linewidth=0.8)
    ax.tick_params(which="both", colors=MUTED, labelsize=9.5, length=0)
    for side in ax.spines.values():
        side.set_visible(False)
    ax.set_title(title, loc="left", fontsize=12.5, weight="bold", color=INK, pad=8)
    ax.set_title(note, loc="right", fontsize=9, color=MUTED, pad=8)
