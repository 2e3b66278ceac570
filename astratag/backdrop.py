"""What is behind a print: seen past its quiet margin, which looks too thin at a slant to keep it from the edges."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from astratag.compiled import CUBE, GRAY, INDICES, MATRIX, REAL, VECTOR, compiled
from astratag.edges import POINTS_PER_EDGE
from astratag.normal import ranked
from astratag.sampling import light_between

Array = NDArray[np.float64]

OUTERMOST = 4
"""The first so many edges are those of the outermost square."""
FAR_MARGIN, THIN_MARGIN = 5.0, 1.0
"""In blurs: what is behind the print does not pull from so far away, and is taken to be at least so far away."""
BESIDE = 2.5
"""Ink and what is behind the print are looked at this many blurs from where they begin."""
MOST_JUMP = 1.5
"""What is behind the print is darker or brighter than paper at most by so many times what ink is darker."""


@compiled(GRAY, VECTOR, INDICES, CUBE, CUBE, MATRIX, REAL, VECTOR)
def backdrop(
    gray: NDArray[np.uint8],
    of_gray: Array,
    edges: NDArray[np.int64],
    predicted_px: Array,
    normal: Array,
    margin_px: Array,
    lens_px: float,
    blur_px: Array,
) -> Array:
    """Return how much brighter it becomes past the quiet margin (E, M), over what paper is brighter than ink.

    See ``sampling.Light`` for the image and ``locate.Edges`` for how E ``edges`` lie in it.  0 beside all but the
    outermost, and past margins so wide that it does not matter where all is blurred by ``blur_px`` (E,).
    """
    jump = np.zeros(margin_px.shape)
    ink, middle, behind = np.empty(POINTS_PER_EDGE), np.empty(POINTS_PER_EDGE), np.empty(POINTS_PER_EDGE)
    for e in range(len(edges)):
        if edges[e] >= OUTERMOST or margin_px[e].min() >= FAR_MARGIN * blur_px[e]:
            continue
        for m in range(POINTS_PER_EDGE):
            x, y = predicted_px[0, e, m], predicted_px[1, e, m]
            nx, ny = normal[0, e, m], normal[1, e, m]
            inside_px, outside_px = -BESIDE * lens_px, margin_px[e, m] + BESIDE * lens_px
            halfway_px = 0.5 * margin_px[e, m]
            ink[m] = light_between(gray, of_gray, x + inside_px * nx, y + inside_px * ny)
            middle[m] = light_between(gray, of_gray, x + halfway_px * nx, y + halfway_px * ny)
            behind[m] = light_between(gray, of_gray, x + outside_px * nx, y + outside_px * ny)
        dark = ranked(ink.copy(), POINTS_PER_EDGE // 4)  # white cells are near some of the points
        for m in range(POINTS_PER_EDGE):
            # the paper's middle is blurred with what is on both sides of it
            share = 0.5 * (1 + math.erf(max(margin_px[e, m] / lens_px, THIN_MARGIN) / math.sqrt(8)))
            paper = (middle[m] - (1 - share) * (dark + behind[m])) / (2 * share - 1)
            contrast = max(paper - dark, 1.0)
            jump[e, m] = min(max((behind[m] - paper) / contrast, -MOST_JUMP), MOST_JUMP)
    return jump
