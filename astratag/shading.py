"""Light that varies over a print moves its edges to where it is brighter: how far, from the paper around the print."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from astratag.backdrop import OUTERMOST
from astratag.compiled import CUBE, FLAG_MATRIX, GRAY, INDICES, MATRIX, REAL, VECTOR, compiled
from astratag.edges import EDGE_DIRECTION, EDGE_POINTS, INK_TO_PAPER, MARGIN_UNITS
from astratag.geometry import TEMPLATE_UNITS
from astratag.normal import dot, factored, gram, ranked, solved
from astratag.sampling import light_between

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

WIDE_MARGIN = 4.0
"""The middle of the quiet margin shows paper alone where the margin is so many blurs wide."""
FEWEST, SIDES = 40, 4
"""Points that tell how light varies, and the sides they must lie on."""
UNKNOWNS, PASSES, FAR_OFF = 6, 3, 3.0
"""Light is a second-order surface over the print, found again without points so many times further off than most."""
LEAST_EVEN = 0.05
"""Light that a smooth surface leaves so much of unexplained, as a share, is not smooth: a hard shadow, or glare."""
DARKEST, LITTLE = 1.0, 1e-9


@compiled(GRAY, VECTOR, INDICES, CUBE, CUBE, MATRIX, REAL, FLAG_MATRIX)
def _surface(
    gray: NDArray[np.uint8],
    of_gray: Array,
    edges: NDArray[np.int64],
    predicted_px: Array,
    normal: Array,
    margin_px: Array,
    lens_px: float,
    use: Mask,
) -> Array:
    """Return the terms (6,) of the logarithm of light on the paper around the print; zeros where it is not smooth."""
    columns, level, count, sides = np.empty((UNKNOWNS, use.size)), np.empty(use.size), 0, np.zeros(4, np.int64)
    for e in range(len(edges)):
        if edges[e] >= OUTERMOST:
            continue
        for m in range(use.shape[1]):
            if use[e, m] and margin_px[e, m] >= WIDE_MARGIN * lens_px:
                half_px, edge = margin_px[e, m] / 2, edges[e]
                x = predicted_px[0, e, m] + half_px * normal[0, e, m]
                y = predicted_px[1, e, m] + half_px * normal[1, e, m]
                at = EDGE_POINTS[edge, m] + MARGIN_UNITS / 2 * INK_TO_PAPER[edge]
                u, v = at[0] / TEMPLATE_UNITS - 0.5, at[1] / TEMPLATE_UNITS - 0.5
                columns[0, count], columns[1, count], columns[2, count] = 1.0, u, v
                columns[3, count], columns[4, count], columns[5, count] = u * u, u * v, v * v
                level[count] = math.log(max(light_between(gray, of_gray, x, y), DARKEST))
                count += 1
                sides[edge] = 1
    if count < FEWEST or sides.sum() < SIDES:
        return np.zeros(UNKNOWNS)
    columns, level = columns[:, :count].copy(), level[:count].copy()
    kept, off, spread = np.ones(count), np.empty(count), 0.0
    found, right = np.zeros(UNKNOWNS), np.empty(UNKNOWNS)
    for _ in range(PASSES):
        weighted = columns * kept
        products = gram(weighted)
        for p in range(UNKNOWNS):
            products[p, p] += LITTLE
            right[p] = dot(weighted[p], level)
        found = solved(factored(products), right)
        for i in range(count):
            off[i] = level[i]
            for p in range(UNKNOWNS):
                off[i] -= found[p] * columns[p, i]
            off[i] = abs(off[i])
        spread = 1.4826 * ranked(off.copy(), count // 2)
        for i in range(count):
            kept[i] = 1.0 if off[i] <= FAR_OFF * spread else 0.0
    return found if spread < LEAST_EVEN else np.zeros(UNKNOWNS)


@compiled(GRAY, VECTOR, INDICES, CUBE, CUBE, MATRIX, MATRIX, MATRIX, REAL, FLAG_MATRIX, VECTOR)
def shading(
    gray: NDArray[np.uint8],
    of_gray: Array,
    edges: NDArray[np.int64],
    predicted_px: Array,
    normal: Array,
    margin_px: Array,
    unit_px: Array,
    lean: Array,
    lens_px: float,
    use: Mask,
    blur_px: Array,
) -> Array:
    """Return how far towards the paper (E, M) the steepest places of E ``edges`` lie from them.

    Light that grows by a share a pixel makes the slope of an edge, a bell, grow as well: its top moves by that share of
    the variance of all blur, ``blur_px`` (E,) squared.  How the edges lie are fields of ``locate.Edges``; the paper
    beside the points to ``use`` (E, M) of the outermost tells how light varies.
    """
    shift_px = np.zeros(margin_px.shape)
    light = _surface(gray, of_gray, edges, predicted_px, normal, margin_px, lens_px, use)
    for e in range(len(edges)):
        ahead, across = EDGE_DIRECTION[edges[e]], INK_TO_PAPER[edges[e]]
        for m in range(margin_px.shape[1]):
            at = EDGE_POINTS[edges[e], m] / TEMPLATE_UNITS - 0.5
            by_u = light[1] + 2 * light[3] * at[0] + light[4] * at[1]
            by_v = light[2] + light[4] * at[0] + 2 * light[5] * at[1]
            along_normal = across + lean[e, m] * ahead
            growth = (by_u * along_normal[0] + by_v * along_normal[1]) / TEMPLATE_UNITS
            shift_px[e, m] = growth / max(unit_px[e, m], 1e-3) * blur_px[e] ** 2
    return shift_px
