"""What lies beside edges in a print: what lines that stand on an edge, and lines that lean, cross and pass."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from astratag.dictionary import load_dictionary
from astratag.edges import ALONG, EDGE_DIRECTION, EDGE_POINTS, EDGES, INK_TO_PAPER, POINTS_PER_EDGE
from astratag.geometry import CELLS, LAYERS, SQUARES, square
from astratag.neighbours import (
    CELLS_OF_LAYERS,
    CLOSENESS,
    DISTANCE,
    END,
    LEANS,
    SKEW,
    START,
    Crossings,
    crossings,
)
from pipeline.texture import PRINT_UNITS, TEXELS_PER_UNIT, print_coverage

Array = NDArray[np.float64]
CODE = load_dictionary().signature(7)
BLACK, WHITE = bytes(CELLS), bytes([1] * CELLS)
MIDDLE_FRAME_UNITS = 180.0 - 1.0
MARGIN_UNITS = (PRINT_UNITS - 700) / 2


def leaning(near: Crossings, lean: float) -> tuple[Array, Array]:
    """Return places (E, M, K, 5) and changes of brightness (E, M, K) of lines that lean by one of ``LEANS``."""
    first = int(np.flatnonzero(np.isclose(LEANS, lean))[0]) * len(EDGES)
    places, which = near.places[first : first + len(EDGES)], near.which[first : first + len(EDGES)]
    return places, np.sign(which) * near.jump[np.abs(which)]


def crossed(places: Array) -> Array:
    """Return which of places (..., 5) a line crosses, and does not just pass."""
    return (places[..., START] < 0) & (places[..., END] > 0)


def test_a_print_without_white_cells_pulls_no_outermost_edge() -> None:
    """The next edge of the black square is then the frame of the middle layer, far inside."""
    places, jump = leaning(crossings(BLACK), 0)
    others = np.abs(places[:4, ..., DISTANCE]) > 1e-3
    near = np.abs(places[:4, ..., DISTANCE]) < MIDDLE_FRAME_UNITS
    assert not jump[:4][others & near & crossed(places[:4])].any()


def test_an_edge_is_beside_itself() -> None:
    """It begins and ends where its outermost points are, in units of its own change."""
    places, jump = leaning(crossings(CODE.tobytes()), 1.5)
    for edge, (of_points, changes) in enumerate(zip(places, jump, strict=True)):
        for point, (of_point, change) in enumerate(zip(of_points, changes, strict=True)):
            own = (of_point[:, CLOSENESS] < 1e-6) & (np.abs(of_point[:, SKEW]) < 1e-6) & (change != 0)
            assert own.sum() == 1
            length = np.linalg.norm(np.subtract(EDGES[edge].end, EDGES[edge].start))
            np.testing.assert_allclose(change[own], 1)
            np.testing.assert_allclose(of_point[own, START], -ALONG[point] * length, atol=1e-3)
            np.testing.assert_allclose(of_point[own, END], (1 - ALONG[point]) * length, atol=1e-3)


def test_crossings_of_opposite_sides_mirror_in_a_symmetric_print() -> None:
    """All cells white: what the top edge sees at a point, the left edge sees at the mirrored one."""
    places, jump = leaning(crossings(WHITE), 0)
    beside = (jump != 0) & crossed(places) & (np.abs(places[..., DISTANCE]) > 1e-3)
    distance = np.where(beside, np.abs(places[..., DISTANCE]), np.inf)
    nearest_top, nearest_left = (distance[edge].min(axis=1) for edge in (0, 3))
    np.testing.assert_allclose(np.median(nearest_top), np.median(nearest_left), atol=1.0)
    np.testing.assert_allclose(np.linalg.norm(INK_TO_PAPER, axis=1), 1)


@pytest.mark.parametrize("lean", [-2.0, 0.0, 0.5])
def test_brightness_changes_where_a_line_crosses_an_edge(lean: float) -> None:
    """Beside the outermost edges: what is listed is what the drawn print shows a little before and after."""
    places, jump = leaning(crossings(CODE.tobytes()), lean)
    print_, listed, shown = print_coverage(CODE) / 255.0, [], []
    for edge in range(4):
        line = INK_TO_PAPER[edge] + lean * EDGE_DIRECTION[edge]
        for point in set(range(POINTS_PER_EDGE)) - {POINTS_PER_EDGE // 2}:  # corners of cells are beside the middle
            change = (jump[edge, point] != 0) & crossed(places[edge, point])
            distances = places[edge, point][change, DISTANCE].astype(float)
            for distance, change_there in zip(distances, jump[edge, point][change], strict=True):
                two = EDGE_POINTS[edge, point] + (distance + np.array([[-1.0], [1.0]])) * line
                column, row = np.round((two + MARGIN_UNITS) * TEXELS_PER_UNIT).astype(int).T
                before, after = print_[row, column]
                listed.append(change_there)
                shown.append(after - before)
    assert len(listed) > 80
    assert np.mean(np.abs(np.subtract(listed, shown)) > 0.01) < 0.02


@pytest.mark.parametrize("lean", [-1.5, 0.0, 2.0])
def test_an_edge_ends_where_it_is_said_to(lean: float) -> None:
    """Both ends of what is beside an edge, the side of a cell or of a square, are corners of the drawn print."""
    places, _ = leaning(crossings(CODE.tobytes()), lean)
    squares = [square(*layer.frame) for layer in LAYERS if layer.frame is not None]
    corners = np.concatenate([CELLS_OF_LAYERS.reshape(-1, 2), *SQUARES, *squares])
    for edge, point in ((0, 3), (6, 10), (9, 17), (13, 5), (19, 12)):
        beside = places[edge, point][places[edge, point, :, END] > places[edge, point, :, START]].astype(float)
        assert len(beside) > 3
        for along in (beside[:, START], beside[:, END]):
            across = beside[:, DISTANCE] - along * beside[:, SKEW]
            at = EDGE_POINTS[edge, point] + np.outer(along + lean * across, EDGE_DIRECTION[edge])
            at = at + np.outer(across, INK_TO_PAPER[edge])
            assert np.linalg.norm(at[:, None] - corners, axis=2).min(axis=1).max() < 0.02
