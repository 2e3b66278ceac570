"""Light that varies over a print moves its edges to where it is brighter: how far, from paper and ink around the print.

What the print sends back of it varies as paper less ink does: a sheen lies on both alike, and moves nothing.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from astratag.backdrop import OUTERMOST
from astratag.compiled import CUBE, FLAG_MATRIX, GRAY, INDICES, MATRIX, REAL, VECTOR, compiled
from astratag.edges import BORDER_UNITS, EDGE_DIRECTION, EDGE_POINTS, INK_TO_PAPER, MARGIN_UNITS
from astratag.geometry import TEMPLATE_UNITS
from astratag.normal import dot, factored, gram, ranked, solved
from astratag.sampling import light_between

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

WIDE_MARGIN = 4.0
"""The middle of the quiet margin shows paper alone where the margin is so many blurs wide, that of the border ink."""
FEWEST, SIDES = 40, 4
"""Points that tell how light varies, and the sides they must lie on."""
UNKNOWNS, PASSES, FAR_OFF = 6, 3, 3.0
"""Light is a second-order surface over the print, found again without points so many times further off than most."""
MOST_UNEVEN = 0.05
"""Light that a smooth surface leaves so much of unexplained, as a share, is not smooth: a hard shadow, or glare."""
REST, OF_UNEVEN_PX = 0.2, 8.0
"""How wrong a shift is, as a fraction of it: 0.2 on the shipped approach.  And within how many pixels light that is not
smooth may vary by as much as is unexplained of it."""
DARKEST, LITTLE = 1.0, 1e-9


@compiled(GRAY, VECTOR, INDICES, CUBE, CUBE, MATRIX, MATRIX, REAL, FLAG_MATRIX)
def _surface(
    gray: NDArray[np.uint8],
    of_gray: Array,
    edges: NDArray[np.int64],
    predicted_px: Array,
    normal: Array,
    margin_px: Array,
    unit_px: Array,
    lens_px: float,
    use: Mask,
) -> tuple[Array, float]:
    """Return the terms (6,) of the logarithm of light around the print, and what they leave unexplained.

    Zeros where light is not smooth.
    """
    columns, level, count, sides = np.empty((UNKNOWNS, use.size)), np.empty(use.size), 0, np.zeros(4, np.int64)
    for e in range(len(edges)):
        if edges[e] >= OUTERMOST:
            continue
        for m in range(use.shape[1]):
            border_px = BORDER_UNITS * unit_px[e, m]
            if use[e, m] and min(margin_px[e, m], border_px) >= WIDE_MARGIN * lens_px:
                edge, x, y = edges[e], predicted_px[0, e, m], predicted_px[1, e, m]
                right, down = normal[0, e, m], normal[1, e, m]
                outside_px, inside_px = margin_px[e, m] / 2, -border_px / 2
                paper = light_between(gray, of_gray, x + outside_px * right, y + outside_px * down)
                ink = light_between(gray, of_gray, x + inside_px * right, y + inside_px * down)
                at = EDGE_POINTS[edge, m] + MARGIN_UNITS / 2 * INK_TO_PAPER[edge]
                u, v = at[0] / TEMPLATE_UNITS - 0.5, at[1] / TEMPLATE_UNITS - 0.5
                columns[0, count], columns[1, count], columns[2, count] = 1.0, u, v
                columns[3, count], columns[4, count], columns[5, count] = u * u, u * v, v * v
                level[count] = math.log(max(paper - ink, DARKEST))
                count += 1
                sides[edge] = 1
    if count < FEWEST or sides.sum() < SIDES:
        return np.zeros(UNKNOWNS), 0.0
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
    return (found, 0.0) if spread < MOST_UNEVEN else (np.zeros(UNKNOWNS), spread)


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
) -> tuple[Array, Array]:
    """Return how far towards the paper the steepest places of E ``edges`` lie, and how wrong that may be (E, M).

    Light that grows by a share a pixel makes the slope of an edge, a bell, grow as well: its top moves by that share of
    the variance of all blur, ``blur_px`` (E,) squared.  How the edges lie are fields of ``locate.Edges``; the paper
    beside the points to ``use`` (E, M) of the outermost tells how light varies.
    """
    shift_px, wrong_px = np.zeros(margin_px.shape), np.zeros(margin_px.shape)
    light, uneven = _surface(gray, of_gray, edges, predicted_px, normal, margin_px, unit_px, lens_px, use)
    for e in range(len(edges)):
        ahead, across = EDGE_DIRECTION[edges[e]], INK_TO_PAPER[edges[e]]
        for m in range(margin_px.shape[1]):
            at = EDGE_POINTS[edges[e], m] / TEMPLATE_UNITS - 0.5
            by_u = light[1] + 2 * light[3] * at[0] + light[4] * at[1]
            by_v = light[2] + light[4] * at[0] + 2 * light[5] * at[1]
            along_normal = across + lean[e, m] * ahead
            growth = (by_u * along_normal[0] + by_v * along_normal[1]) / TEMPLATE_UNITS
            shift_px[e, m] = growth / max(unit_px[e, m], 1e-3) * blur_px[e] ** 2
            wrong_px[e, m] = math.hypot(REST * shift_px[e, m], uneven / OF_UNEVEN_PX * blur_px[e] ** 2)
    return shift_px, wrong_px
