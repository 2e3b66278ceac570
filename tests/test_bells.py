"""What neighbouring edges do to where an edge is found: nothing from afar, else what a blurred picture shows."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import norm

from astratag.bells import around, narrowing, pull
from astratag.dictionary import load_dictionary
from astratag.edges import EDGE_DIRECTION, EDGE_POINTS, EDGES, INK_TO_PAPER
from astratag.geometry import TEMPLATE_UNITS
from astratag.locate import STEP_PX
from astratag.neighbours import LEANS, UNKNOWN, crossings
from pipeline.texture import PRINT_UNITS, TEXELS_PER_UNIT, print_coverage

Array = NDArray[np.float64]
CODE = load_dictionary().signature(7)
NEAR = crossings(CODE.tobytes())
POINTS = EDGE_POINTS.shape[:2]
EVERY_EDGE, EVERY_POINT, NOTHING = np.arange(len(EDGES)), np.ones(POINTS, dtype=bool), np.zeros(POINTS)
BLUR_PX = 1.15
BLURS = np.full(len(EDGES), BLUR_PX)
SEED = 11


def beside(unit_px: float, lean: float = 0.0, squeeze: float = 1.0, along_px: float = BLUR_PX) -> Array:
    """Return what is around all edges where they look alike; ``along_px`` is what they are blurred by lengthwise."""
    look = (np.full(POINTS, value) for value in (unit_px, 0.0, lean, squeeze, 1e3))
    return around(*NEAR, EVERY_EDGE, *look, NOTHING, BLURS, np.full(len(EDGES), along_px), EVERY_POINT)


def top_of_samples(slopes: Array) -> float:
    """Return where slopes every ``STEP_PX`` about 0 are highest near 0, as edges are located: on a parabola."""
    best = int(slopes[1:-1].argmax()) + 1
    before, top, after = slopes[best - 1 : best + 2]
    return STEP_PX * float(best - len(slopes) // 2 + 0.5 * (after - before) / (2 * top - before - after))


def steepest(edge: int, point: int, px_of_unit: Array, along_px: float) -> float:
    """Return where the blurred picture of a print seen through an affine map (2, 2) is steepest across an edge.

    It is blurred by ``BLUR_PX`` across the edge, and by ``along_px`` along it.
    """
    tangent = px_of_unit @ EDGE_DIRECTION[edge]
    tangent /= np.linalg.norm(tangent)
    across = np.array([-tangent[1], tangent[0]])
    across *= np.sign(across @ px_of_unit @ INK_TO_PAPER[edge])
    at = (np.arange(-60, 60) + 0.5) / 10  # pixels
    places = at[:, None, None] * across + at[None, :, None] * tangent
    units = EDGE_POINTS[edge, point] + places @ np.linalg.inv(px_of_unit).T
    texels = ((units + (PRINT_UNITS - TEMPLATE_UNITS) / 2) * TEXELS_PER_UNIT - 0.5).astype(np.float32)
    picture = cv2.remap(PRINT, texels[..., 0], texels[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    profile = picture @ norm.pdf(at, scale=along_px)
    x = np.arange(-3, 4) * STEP_PX
    weights = (at - x[:, None]) * norm.pdf(at - x[:, None], scale=BLUR_PX)
    return top_of_samples(weights @ profile)


PRINT = print_coverage(CODE).astype(np.float32)


@pytest.mark.parametrize("along_px", [BLUR_PX, 0.85])
@pytest.mark.parametrize("tilt_deg", [0, 60, 75, 80])
def test_pulls_are_what_a_blurred_picture_of_the_print_shows(tilt_deg: float, along_px: float) -> None:
    """Seen at a slant, what is square to an edge in the picture leans in the print, and edges cross at other angles.

    They end, and the profile is blurred less along the edge than across it.
    """
    rng = np.random.default_rng(SEED)
    pulls, errors = [], []
    for turn, azimuth in rng.uniform(0, 2 * np.pi, (6, 2)):
        turned, tilted = (np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]) for a in (turn, azimuth))
        px_of_unit = 0.23 * turned @ tilted @ np.diag([1.0, np.cos(np.radians(tilt_deg))]) @ tilted.T
        for edge in rng.choice(len(EDGES), 7, replace=False).tolist():
            along, across = px_of_unit @ EDGE_DIRECTION[edge], px_of_unit @ INK_TO_PAPER[edge]
            units_along_px = float(np.linalg.norm(along))
            unit_px = abs(np.linalg.det(px_of_unit)) / units_along_px
            lean = -float(along @ across) / units_along_px**2
            if EDGES[edge].reach * unit_px < 1.6 * BLUR_PX or abs(lean) > LEANS[-1]:
                continue
            chosen, seen_px = rng.choice(np.arange(4, POINTS[1] - 4), 3, replace=False).tolist(), np.zeros(POINTS)
            for point in chosen:
                seen_px[edge, point] = steepest(edge, point, px_of_unit, along_px)
            look = beside(unit_px, lean, unit_px / units_along_px, along_px)
            found = pull(look, BLURS, EVERY_POINT, seen_px).px
            errors += [
                found[edge, point] - seen_px[edge, point] for point in chosen if not np.isnan(found[edge, point])
            ]
            pulls += [seen_px[edge, point] for point in chosen]
    assert len(errors) > 20
    assert np.sqrt(np.mean(np.square(errors))) < 0.1 * np.sqrt(np.mean(np.square(pulls)))


def test_nothing_pulls_from_far_away() -> None:
    found = pull(beside(10.0), BLURS, EVERY_POINT, NOTHING)
    np.testing.assert_allclose(found.px, 0, atol=1e-9)
    np.testing.assert_allclose(found.curvature, 1, atol=1e-9)
    np.testing.assert_allclose(narrowing(beside(10.0), BLURS, EVERY_POINT), 1, atol=1e-6)


def test_what_is_behind_a_thin_margin_pulls_like_an_edge() -> None:
    """Dark behind 2.5 pixels of margin: the profile is that of a white bar."""
    x = np.arange(-3, 4) * STEP_PX
    bar_px = top_of_samples(norm.pdf(x, scale=BLUR_PX) - norm.pdf(x - 2.5, scale=BLUR_PX))
    look = (np.full(POINTS, value) for value in (10.0, 0.0, 0.0, 1.0, 2.5))
    dark = around(*NEAR, EVERY_EDGE, *look, np.full(POINTS, -1.0), BLURS, BLURS, EVERY_POINT)
    found = pull(dark, BLURS, EVERY_POINT, np.full(POINTS, bar_px))
    assert bar_px < -0.05
    np.testing.assert_allclose(found.px[:4], bar_px, atol=0.01)


def test_what_is_around_a_print_of_unknown_code_is_not_known() -> None:
    look = (np.full(POINTS, value) for value in (1.0, 0.0, 0.0, 1.0, 1e3))
    assert len(around(*UNKNOWN, EVERY_EDGE, *look, NOTHING, BLURS, BLURS, EVERY_POINT)) == 0
