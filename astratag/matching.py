"""Matching: from a rough square in the image to the marker it is a layer of, by all pixels at once.

For squares whose edges or cells cannot be measured one by one: a dozen pixels wide, seen at a grazing angle, or
blurred.  What the square reads is aligned until it looks right, read again, and believed when its cells fit one
identity far better than chance or any other would, and its surroundings fit one layer better than the others.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from astratag.codes import acceptance_threshold
from astratag.codes.acceptance import FALSE_ACCEPT_RATE
from astratag.geometry import LAYERS, TEMPLATE_UNITS, renamed, square
from astratag.synthesis import Alignment, Synthesis
from astratag.warp import HomographyWarp

Array = NDArray[np.float64]
Light = NDArray[np.float32]

WORTH_ALIGNING, SHARE_OF_NEXT = 0.24, 0.5
"""How much more than a share of the next best the cells through a rough square must correlate to be worth aligning.

Of 90 markers so found none had less than 0.25; of 160 squares in pictures without one, 35 in a hundred had more.
"""
INDEPENDENT_CELLS = 36
"""Chance squares correlate with codes as so many independent cells would: of 2700 of real texture, the best at 0.66."""
LEAST_LEAD = 1.5
"""How many times more of the cells' brightness the next best identity must leave unexplained."""
LEAST_LAYER_LEAD = 1.5
"""The same of a square and its surroundings for the next likely layer."""
LEAST_LIKENESS = 0.7
"""Correlation of a square with what it reads, borders and all, below which it is something else."""
HOPELESS = 0.7
"""Correlation of a square after a step below which it is not moved on: of 135 that were markers the least had 0.84."""
MOST_BLUR = 0.1
"""Blur, as a fraction of a square's apparent side, at which its cells can still be told apart."""
LEAST_SIDE_PX = 7.0
READINGS = 2
"""How often a square that reads otherwise once aligned may change its mind."""
OUTER = square(0.0, TEMPLATE_UNITS)


class Match(NamedTuple):
    """A marker found by its pixels: ``layer`` is the square it was found by, ``alignment`` of its whole print."""

    marker_id: int
    layer: int
    correlation: float
    alignment: Alignment[HomographyWarp]


def acceptance_of_pixels(readings: int, false_accept_rate: float = FALSE_ACCEPT_RATE) -> float:
    """Return the correlation of the cells, aligned, that chance squares exceed at a false-accept rate."""
    return acceptance_threshold(readings, false_accept_rate=false_accept_rate, cells=INDEPENDENT_CELLS)


class Rough(NamedTuple):
    """A rough square as if it were the outermost, and how its cells correlate (I, 4) with each identity, turned."""

    warp: HomographyWarp
    scores: Array


def rough_matches(synthesis: Synthesis, light: Light, quads: Array, blur_px: float) -> list[Rough]:
    """Return those of rough squares (Q, 4, 2) that are worth aligning, the best first."""
    warps = [HomographyWarp.from_points(OUTER, quad) for quad in quads]
    rough = [
        Rough(warp, synthesis.read(light, warp, blur_px, glance=True))
        for warp in warps
        if _side_px(warp) >= LEAST_SIDE_PX
    ]
    ahead = [_ahead(one.scores) for one in rough]
    return [rough[i] for i in sorted(range(len(rough)), key=lambda i: -ahead[i]) if ahead[i] >= WORTH_ALIGNING]


def _ahead(scores: Array) -> float:
    """Return how far the best of the scores (I, 4) is ahead of a share of the next."""
    next_best, best = np.partition(scores, scores.size - 2, axis=None)[-2:]
    return float(best - SHARE_OF_NEXT * next_best)


def match(synthesis: Synthesis, light: Light, rough: Rough, blur_px: float, accept: float) -> Match | None:
    """Return the marker that a rough square is a layer of, None when it is none for sure.

    ``accept`` is the correlation of the cells from which they are believed.
    """
    warp, scores = rough
    for _ in range(READINGS):
        row, turns = divmod(int(scores.argmax()), 4)
        marker_id = synthesis.ids[row]
        warp = HomographyWarp.from_points(OUTER, renamed(warp(OUTER), turns))
        aligned = synthesis.align(light, warp, marker_id, blur_px, hopeless=HOPELESS)
        if aligned is None or aligned.blur_px > MOST_BLUR * _side_px(aligned.warp):
            return None
        warp, blur_px = aligned.warp, aligned.blur_px
        scores = synthesis.read(light, warp, blur_px)
        if scores.argmax() == 4 * row:
            break
    correlation = float(scores[row, 0])
    scores[row, 0] = 0.0
    if correlation < accept or _lead(correlation, float(scores.max())) < LEAST_LEAD:
        return None
    by_layer = synthesis.layer_scores(light, warp, marker_id, blur_px)
    layer = int(by_layer.argmax())
    likeness = float(by_layer[layer])
    if likeness < LEAST_LIKENESS or _lead(likeness, float(np.delete(by_layer, layer).max())) < LEAST_LAYER_LEAD:
        return None
    if layer > 0:
        whole = HomographyWarp.from_points(square(*LAYERS[layer].black), warp(OUTER))
        aligned = synthesis.align(light, whole, marker_id, blur_px)
    if aligned is None:
        return None
    return Match(marker_id, layer, correlation, aligned)


def _lead(best: float, next_best: float) -> float:
    """Return how many times more variance a lower correlation leaves unexplained."""
    return (1 - max(next_best, 0.0) ** 2) / max(1 - best**2, 1e-9)


def _side_px(warp: HomographyWarp) -> float:
    """Return the root of the area of a print's black square in the image."""
    p0, p1, p2, p3 = warp(OUTER)
    (ax, ay), (bx, by) = p2 - p0, p3 - p1
    return float(np.sqrt(abs(ax * by - ay * bx) / 2))
