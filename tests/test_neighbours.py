"""What neighbouring edges do to where an edge is found: nothing from afar, else what a blurred profile shows."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import ndtr

from astratag.dictionary import load_dictionary
from astratag.edges import EDGE_POINTS, EDGES, INK_TO_PAPER
from astratag.geometry import CELLS
from astratag.neighbours import crossings, narrowing, pull

CODE = load_dictionary().signature(7).tobytes()
BLACK = bytes(CELLS)
OUTERMOST = np.arange(4)
EVERY_POINT = np.ones(EDGE_POINTS.shape[:2], dtype=bool)
MIDDLE_FRAME_UNITS = 180.0 - 1.0


def steepest(distances: np.ndarray, jumps: np.ndarray, blur_px: float) -> float:
    """Return where a step at 0 and others at ``distances`` rise most near 0 once blurred: a dense search."""
    x = np.linspace(-1.5, 1.5, 30_001)
    blurred = ndtr(x / blur_px) + sum(j * ndtr((x - d) / blur_px) for d, j in zip(distances, jumps, strict=True))
    return float(x[np.gradient(blurred, x).argmax()])


@pytest.mark.parametrize("unit_px", [0.06, 0.1, 0.2])
def test_the_pull_is_where_a_blurred_profile_is_steepest(unit_px: float) -> None:
    """Where all crossings are square to the line, the profile is known in closed form."""
    near, blur_px = crossings(CODE), 1.15
    found = pull(*near, OUTERMOST, np.full((4, EDGE_POINTS.shape[1]), unit_px), blur_px, EVERY_POINT[OUTERMOST])
    compared = 0
    for edge in OUTERMOST.tolist():
        for point in range(EDGE_POINTS.shape[1]):
            distance, jump, cosine = (np.asarray(part)[:, edge, point] for part in near)
            close = np.abs(distance * cosine) * unit_px < 5 * blur_px
            if np.isnan(found.px[edge, point]) or (cosine[close & (jump != 0)] < 0.999).any():
                continue
            expected = steepest(distance[close] * unit_px, jump[close], blur_px)
            assert found.px[edge, point] == pytest.approx(expected, abs=0.03 * blur_px)
            compared += 1
    assert compared > 10


def test_nothing_pulls_from_far_away() -> None:
    every = np.arange(len(EDGES))
    unit_px = np.full((len(EDGES), EDGE_POINTS.shape[1]), 10.0)
    found = pull(*crossings(CODE), every, unit_px, 1.2, EVERY_POINT)
    np.testing.assert_allclose(found.px, 0, atol=1e-9)
    np.testing.assert_allclose(found.curvature, 1, atol=1e-9)
    np.testing.assert_allclose(narrowing(*crossings(CODE), every, unit_px, 1.2, EVERY_POINT), 1, atol=1e-6)


def test_a_print_without_white_cells_pulls_no_outermost_edge() -> None:
    """The next edge of the black square is then the frame of the middle layer, far inside."""
    near = crossings(BLACK)
    assert not near.jump[:, OUTERMOST][np.abs(near.distance[:, OUTERMOST]) < MIDDLE_FRAME_UNITS].any()


def test_crossings_of_opposite_sides_mirror_in_a_symmetric_print() -> None:
    """All cells white: what the top edge sees at a point, the left edge sees at the mirrored one."""
    near = crossings(bytes([1] * CELLS))
    top, left = near.distance[:, 0], near.distance[:, 3]
    nearest_top, nearest_left = np.abs(top).min(axis=0), np.abs(left).min(axis=0)
    np.testing.assert_allclose(np.median(nearest_top), np.median(nearest_left), atol=1.0)
    np.testing.assert_allclose(np.linalg.norm(INK_TO_PAPER, axis=1), 1)
