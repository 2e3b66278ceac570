"""Growing: from one layer of a marker to the whole, by fitting edges from it outwards and inwards."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from astratag.edges import EDGE_LAYER, EDGES
from astratag.fit import EdgeFit, fit_edges
from astratag.geometry import LAYERS, square
from astratag.warp import BentWarp, FittedWarp, HomographyWarp

Light = NDArray[np.float32]
Fit = EdgeFit[FittedWarp]

ALL_EDGES = np.arange(len(EDGES))
SETTLE_PX = 2.0
"""How far from its prediction an edge is looked for once the fit has settled."""
MAX_SEARCH_PX = 12.0
CURVED_GAIN = 0.6
"""A bend is believed when it lowers the cost of the fit below this fraction."""


def layer_side_px(warp: FittedWarp, layer: int) -> float:
    """Return the mean length of a layer's sides in the image."""
    corners = warp(square(*LAYERS[layer].black))
    return float(np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1).mean())


def fit_own_edges(light: Light, warp: FittedWarp, layer: int) -> FittedWarp | None:
    """Return a warp that is right to a few pixels fitted to the edges of one layer, None when they are not there."""
    own = ALL_EDGES[layer == EDGE_LAYER]
    for search_px in (max(2.5, 0.03 * layer_side_px(warp, layer)), SETTLE_PX):
        fit = fit_edges(light, warp, own, min(search_px, MAX_SEARCH_PX))
        if fit is None:
            return None
        warp = fit.warp
    return warp


def grow(light: Light, warp: FittedWarp, layer: int) -> Fit | None:
    """Return the fit to all edges in view, begun with a warp fitted to one layer.

    On a surface that is not known the warp may bend as it grows, and stays flat if that explains the edges.
    """
    search_px = min(max(2.5, 0.02 * layer_side_px(warp, layer)), MAX_SEARCH_PX)
    near = ALL_EDGES[np.abs(EDGE_LAYER - layer) <= 1]
    plans: list[FittedWarp] = [warp]
    if isinstance(warp, HomographyWarp):
        plans.append(BentWarp(warp, np.zeros((2, 3))))
    grown = [fit for plan in plans if (fit := _grow_through(light, plan, (near, ALL_EDGES), search_px)) is not None]
    if not grown:
        return None
    flat = grown[0]
    return min(grown, key=lambda fit: fit.cost / (CURVED_GAIN if fit is flat else 1.0))


def _grow_through(
    light: Light, warp: FittedWarp, stages: tuple[NDArray[np.int64], ...], search_px: float
) -> Fit | None:
    """Return the settled fit after taking in the edges of each stage."""
    for edges in stages:
        fit = fit_edges(light, warp, edges, search_px)
        if fit is None:
            return None
        warp = fit.warp
    return settle(light, warp)


def settle(light: Light, warp: FittedWarp) -> Fit | None:
    """Return the final fit to all edges from a warp that is right to a pixel or two."""
    fit = fit_edges(light, warp, ALL_EDGES, SETTLE_PX)
    return None if fit is None else fit_edges(light, fit.warp, ALL_EDGES, SETTLE_PX)
