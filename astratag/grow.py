"""Growing: from one layer of a marker to the whole, by fitting edges from it outwards and inwards."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from astratag.edges import EDGE_LAYER, EDGES
from astratag.fit import EdgeFit, fit_edges
from astratag.geometry import SQUARES
from astratag.neighbours import Crossings
from astratag.sampling import Light
from astratag.warp import BentWarp, FittedWarp, HomographyWarp, PoseWarp, sides_of

Fit = EdgeFit[FittedWarp]
Posed = Callable[[FittedWarp], PoseWarp | None]
"""From a warp of a plane to the pose that sees it so, None if there is none."""

ALL_EDGES = np.arange(len(EDGES))
SETTLE_PX = 2.0
"""How far from its prediction an edge is looked for once the fit has settled."""
SETTLED_PX, MAX_SETTLING = 0.2, 4
"""A fit that moves no edge further than this has settled."""
MAX_SEARCH_PX = 12.0
CURVED_GAIN = 0.6
"""A bend is believed when it lowers the cost of the fit below this fraction."""
SURELY_FLAT = 0.02
"""Cost of a plane's fit, 0.07 pixels RMS, below which no bend is looked for."""


def layer_side_px(warp: FittedWarp, layer: int) -> float:
    """Return the mean length of a layer's sides in the image."""
    return sides_of(warp(SQUARES[layer]))[0]


def fit_own_edges(light: Light, warp: FittedWarp, layer: int) -> Fit | None:
    """Return a warp that is right to a few pixels fitted to the edges of one layer, None when they are not there."""
    return fit_edges(light, warp, ALL_EDGES[layer == EDGE_LAYER], _search_px(warp, layer, 0.03))


def grow(light: Light, warp: FittedWarp, layer: int, near: Crossings, posed: Posed | None = None) -> Fit | None:
    """Return the fit to all edges in view, begun with a warp fitted to one layer.

    On a surface that is not known the warp may bend as it grows, and stays flat if that explains the edges, or if only
    one layer is seen: its edges do not tell how the inside lies.  A flat one is ``posed`` where a pose explains them.
    """
    search_px = _search_px(warp, layer, 0.02)
    flat = _grow_through(light, warp, layer, search_px, near, posed)
    if not isinstance(warp, HomographyWarp) or (flat is not None and flat.cost < SURELY_FLAT):
        return flat
    bent = _grow_through(light, BentWarp(warp, np.zeros((2, 3))), layer, search_px, near)
    if flat is None or bent is None:
        return flat or bent
    several = len(set(EDGE_LAYER[bent.edges[bent.weight.any(axis=1)]].tolist())) > 1
    return bent if several and bent.cost < CURVED_GAIN * flat.cost else flat


def _grow_through(
    light: Light, warp: FittedWarp, layer: int, search_px: float, near: Crossings, posed: Posed | None = None
) -> Fit | None:
    """Return the settled fit after taking in the nearest layers, then all; that of the ``posed`` warp if it is one."""
    nearest = ALL_EDGES[np.abs(EDGE_LAYER - layer) <= 1]
    for edges in (nearest, ALL_EDGES) if layer > 0 else (ALL_EDGES,):
        fit = fit_edges(light, warp, edges, search_px)
        if fit is None:
            return None
        warp = fit.warp
    pose = posed(warp) if posed is not None else None
    as_pose = settle(light, pose, near) if pose is not None else None
    if as_pose is not None and as_pose.cost < SURELY_FLAT:
        return as_pose
    fit = settle(light, warp, near)
    return as_pose if fit is None or (as_pose is not None and CURVED_GAIN * as_pose.cost < fit.cost) else fit


def settle(light: Light, warp: FittedWarp, near: Crossings) -> Fit | None:
    """Return the final fit to all edges from a warp that is right to a pixel or two.

    ``near`` is what lies beside the edges in the marker's print.
    """
    for _ in range(MAX_SETTLING):
        fit = fit_edges(light, warp, ALL_EDGES, SETTLE_PX, near)
        if fit is None or fit.moved_px < SETTLED_PX:
            break
        warp = fit.warp
    return fit


def _search_px(warp: FittedWarp, layer: int, fraction: float) -> float:
    """Return how far to look for edges when the warp is known to a fraction of a layer's side."""
    return min(max(2.5, fraction * layer_side_px(warp, layer)), MAX_SEARCH_PX)
