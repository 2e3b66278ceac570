"""What lies beside edges in a print: the crossings of lines that stand on an edge, and of lines that lean."""

from __future__ import annotations

import numpy as np
import pytest

from astratag.dictionary import load_dictionary
from astratag.edges import EDGE_DIRECTION, EDGE_POINTS, EDGES, INK_TO_PAPER, POINTS_PER_EDGE
from astratag.geometry import CELLS
from astratag.neighbours import LEANS, Crossings, crossings
from pipeline.texture import PRINT_UNITS, TEXELS_PER_UNIT, print_coverage

CODE = load_dictionary().signature(7)
BLACK, WHITE = bytes(CELLS), bytes([1] * CELLS)
MIDDLE_FRAME_UNITS = 180.0 - 1.0
MARGIN_UNITS = (PRINT_UNITS - 700) / 2


def leaning(near: Crossings, lean: float) -> Crossings:
    """Return the crossings (E, M, K) of lines that lean by one of ``LEANS``."""
    first = int(np.flatnonzero(np.isclose(LEANS, lean))[0]) * len(EDGES)
    return Crossings(*(part[first : first + len(EDGES)] for part in near))


def test_a_print_without_white_cells_pulls_no_outermost_edge() -> None:
    """The next edge of the black square is then the frame of the middle layer, far inside."""
    near = leaning(crossings(BLACK), 0)
    assert not near.jump[:4][np.abs(near.distance[:4]) < MIDDLE_FRAME_UNITS].any()


def test_crossings_of_opposite_sides_mirror_in_a_symmetric_print() -> None:
    """All cells white: what the top edge sees at a point, the left edge sees at the mirrored one."""
    near = leaning(crossings(WHITE), 0)
    nearest_top, nearest_left = (np.abs(near.distance[edge]).min(axis=1) for edge in (0, 3))
    np.testing.assert_allclose(np.median(nearest_top), np.median(nearest_left), atol=1.0)
    np.testing.assert_allclose(np.linalg.norm(INK_TO_PAPER, axis=1), 1)


@pytest.mark.parametrize("lean", [-2.0, 0.0, 0.5])
def test_brightness_changes_where_a_line_crosses_an_edge(lean: float) -> None:
    """Beside the outermost edges: what is listed is what the drawn print shows a little before and after."""
    near = leaning(crossings(CODE.tobytes()), lean)
    print_, listed, shown = print_coverage(CODE) / 255.0, [], []
    for edge in range(4):
        line = INK_TO_PAPER[edge] + lean * EDGE_DIRECTION[edge]
        for point in set(range(POINTS_PER_EDGE)) - {POINTS_PER_EDGE // 2}:  # corners of cells are beside the middle
            change = near.jump[edge, point] != 0
            for distance, jump in zip(near.distance[edge, point][change], near.jump[edge, point][change], strict=True):
                places = EDGE_POINTS[edge, point] + (distance + np.array([[-1.0], [1.0]])) * line
                column, row = np.round((places + MARGIN_UNITS) * TEXELS_PER_UNIT).astype(int).T
                before, after = print_[row, column]
                listed.append(jump)
                shown.append(after - before)
    assert len(listed) > 80
    assert np.mean(np.abs(np.subtract(listed, shown)) > 0.01) < 0.02
