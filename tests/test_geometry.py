"""The Spidron template: against the reference's key points and artworks, and by its own symmetry."""

from itertools import pairwise

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from astratag.geometry import (
    CELLS,
    DRAWN_OFFSET,
    LAYERS,
    PUBLISHED,
    PUBLISHED_GEOMETRY,
    REGIONS,
    SPIDRON,
    TEMPLATE_UNITS,
    TURN_CLOCKWISE,
    MarkerGeometry,
    cell_polygons,
    layer_corners_print,
    layer_points,
    midpoint_square,
    print_from_template,
    renamed,
    square,
    turn_clockwise,
)

signatures = st.lists(st.integers(0, 1), min_size=48, max_size=48).map(lambda bits: np.array(bits, np.uint8))


def turned_on_the_template(points):
    """Template points after the print turns clockwise by 90 degrees (y is down): right becomes down."""
    x, y = np.moveaxis(points, -1, 0)
    return np.stack([TEMPLATE_UNITS - y, x], axis=-1)


def test_cells_against_the_reference_key_points(shared):
    """keypoints.txt lists x1 y1 x2 y2 x3 y3 and a truncated centroid for each cell, in order."""
    rows = np.loadtxt(shared / "reference/keypoints.txt")
    assert rows.shape == (CELLS, 8)
    for polygon, row in zip(cell_polygons(), rows, strict=True):
        assert sorted(map(tuple, polygon)) == sorted(map(tuple, row[:6].reshape(3, 2)))
        np.testing.assert_allclose(polygon.mean(axis=0), row[6:], atol=1.0)


@pytest.mark.parametrize("marker_id", [0, 7, 19])
@pytest.mark.parametrize("layer", LAYERS[1:], ids=["layer 1", "layer 2"])
def test_layer_edges_against_the_published_artwork(shared, marker_id, layer):
    """Black square and white frame change colour exactly at the declared edges, along all four sides."""
    image = cv2.imread(str(shared / f"reference/markers/marker_{marker_id}.png"), cv2.IMREAD_GRAYSCALE)
    (near, far), (black_near, black_far) = map(int, layer.frame), map(int, layer.black)
    middle = slice(near + 30, far - 30)
    for side in (image, image.T):
        for outside, frame, inside in (
            (near - 1, near, black_near - 1),
            (far, far - 1, black_far),
        ):
            assert (side[outside, middle] == 0).all()
            assert (side[frame, middle] == 255).all()
            assert (side[inside, middle] == 255).all()
        assert (side[[black_near, black_far - 1], middle] == 0).all()


def test_cells_tile_their_regions():
    """48 triangles of the template's area: six make an encoding triangle, and none is degenerate."""
    x, y = np.moveaxis(cell_polygons(), -1, 0)
    areas = 0.5 * np.abs((x[:, 1] - x[:, 0]) * (y[:, 2] - y[:, 0]) - (x[:, 2] - x[:, 0]) * (y[:, 1] - y[:, 0]))
    assert areas.min() > 500
    for region, cells in zip(SPIDRON, areas.reshape(REGIONS, 6), strict=True):
        a, b, c = (np.array(p) for p in (region.a, region.b, region.c))
        assert cells.sum() == pytest.approx(0.5 * np.linalg.norm(b - a) * np.linalg.norm(c - a))
        assert (b - a) @ (c - a) == 0


def test_the_turn_permutation_is_the_turn_of_the_cells():
    """Each cell, turned with the print, lies on the cell the permutation names.

    But for the published centroids: 115 from one side and 123 from the other, which moves the mean of a cell by 8/3.
    """
    turned = turned_on_the_template(cell_polygons()).mean(axis=1)
    np.testing.assert_allclose(turned, cell_polygons()[TURN_CLOCKWISE].mean(axis=1), atol=2.7)


def test_the_turn_permutation_has_order_four_and_no_fixed_cell():
    power = np.arange(CELLS)
    for order in (1, 2, 3):
        power = TURN_CLOCKWISE[power]
        assert not (power == np.arange(CELLS)).any(), order
    assert (TURN_CLOCKWISE[power] == np.arange(CELLS)).all()


@given(signatures, st.integers(-8, 8), st.integers(-8, 8))
def test_turns_add_up(signature, first, second):
    np.testing.assert_array_equal(
        turn_clockwise(turn_clockwise(signature, first), second), turn_clockwise(signature, (first + second) % 4)
    )


def test_inner_layers_are_the_pattern_again_inside_their_black_square():
    for layer in LAYERS:
        cells = layer_points(cell_polygons() + DRAWN_OFFSET, layer)
        assert layer.black[0] < cells.min() and cells.max() < layer.black[1]
        np.testing.assert_allclose(layer_points(square(0, TEMPLATE_UNITS), layer)[0], layer.origin)
    for outer, inner in pairwise(LAYERS):
        cells = layer_points(cell_polygons() + DRAWN_OFFSET, outer)
        in_frame = ((cells > inner.frame[0]) & (cells < inner.frame[1])).all(axis=-1)
        assert not in_frame.any()


def test_print_frame_is_x_right_y_up_with_corners_from_the_top_left():
    corners = layer_corners_print(0, side_m=0.2)
    np.testing.assert_allclose(corners, [(-0.1, 0.1), (0.1, 0.1), (0.1, -0.1), (-0.1, -0.1)])
    np.testing.assert_allclose(print_from_template(np.array([350.0, 0.0]), 0.2), [0.0, 0.1])


@pytest.mark.parametrize(("layer", "side_mm"), [(0, 100.0), (1, 100 * 299 / 700), (2, 100 * 124 / 700)])
def test_layer_sides_of_a_hundred_millimetre_marker(layer, side_mm):
    """The inner squares are a unit smaller than the pattern pasted there: the frame covers its first unit."""
    corners_mm = 1000 * layer_corners_print(layer, side_m=0.1)
    np.testing.assert_allclose(np.linalg.norm(np.roll(corners_mm, -1, axis=0) - corners_mm, axis=1), side_mm)


geometries = st.builds(
    lambda contraction, border, layers: MarkerGeometry(contraction, border / max(layers - 1, 1), layers),
    contraction=st.floats(0.05, 0.95),
    border=st.floats(0.001, 0.19),
    layers=st.integers(1, 6),
)


def test_midpoint_squares_follow_the_nesting_law():
    """Equation 3 of the paper: sides fall by the root of two, areas by two."""
    for level in range(6):
        corners = midpoint_square(level)
        sides = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
        np.testing.assert_allclose(sides, TEMPLATE_UNITS * 2 ** (-level / 2))
        np.testing.assert_allclose(corners.mean(axis=0), TEMPLATE_UNITS / 2)


def test_the_published_marker_follows_from_its_parameters_but_for_its_rounding():
    """Vertices and middles of sides exactly; centroids to 5/3, 4 and 19/3 units; squares and frames to one unit."""
    for derived, published in zip(PUBLISHED_GEOMETRY.regions(), SPIDRON, strict=True):
        np.testing.assert_allclose(
            [derived.a, derived.b, derived.c], [published.a, published.b, published.c], atol=1e-9
        )
        off = np.subtract(derived.centroid, published.centroid)
        expected = {115.0: 5 / 3, 346.0: 4.0, 577.0: 19 / 3}
        np.testing.assert_allclose(off, [expected[v] for v in published.centroid])
    derived = PUBLISHED_GEOMETRY.derived()
    assert PUBLISHED_GEOMETRY.template() is PUBLISHED
    for exact, drawn in zip(derived.layers, PUBLISHED.layers, strict=True):
        assert exact.scale == pytest.approx(drawn.scale)
        assert exact.frame_corner_radius == pytest.approx(drawn.frame_corner_radius)
        np.testing.assert_allclose(exact.black, drawn.black, atol=1.0)
        np.testing.assert_allclose(exact.origin, drawn.origin, atol=0.5)
        assert (exact.frame is None) == (drawn.frame is None)
        if exact.frame is not None:
            np.testing.assert_allclose(exact.frame, drawn.frame, atol=1.0)
    assert np.abs(derived.cells + DRAWN_OFFSET - PUBLISHED.cells).max() == pytest.approx(19 / 3)


@given(geometries)
def test_every_geometry_turns_as_the_published_one(geometry):
    """The permutation of the cells belongs to the construction: with true centroids it is exact."""
    cells = geometry.derived().cells
    turned = turned_on_the_template(cells)[np.argsort(TURN_CLOCKWISE)]
    for there, cell in zip(turned, cells, strict=True):
        np.testing.assert_allclose(sorted(there.round(6).tolist()), sorted(cell.round(6).tolist()), atol=1e-5)


@given(geometries)
def test_nothing_touches_in_any_geometry(geometry):
    """Cells keep off the edge of their black square, off other regions and off the frame of the layer inside."""
    template = geometry.derived()
    regions = template.cells.reshape(REGIONS, -1, 2)
    room = TEMPLATE_UNITS / 6 * (1 - geometry.contraction)
    assert regions.min() == pytest.approx(room) and regions.max() == pytest.approx(TEMPLATE_UNITS - room)
    corner, edge = regions[0], regions[4]  # top left and left, either side of the line x + y = 350
    assert corner.sum(axis=1).max() < TEMPLATE_UNITS / 2 < edge.sum(axis=1).min()
    for outer, inner in pairwise(template.layers):
        cells = layer_points(template.cells, outer)
        near, far = inner.frame
        assert outer.black[0] < near < inner.black[0] < inner.black[1] < far < outer.black[1]
        assert inner.black[0] - near == pytest.approx(geometry.border * TEMPLATE_UNITS / 2 ** (inner.index - 1))
        assert not ((cells > near) & (cells < far)).all(axis=-1).any()
        np.testing.assert_allclose(layer_points(square(0, TEMPLATE_UNITS), inner), square(*inner.black))


@pytest.mark.parametrize("quarter_turns", [-1, 0, 1, 2, 3, 5])
def test_corners_are_renamed_as_if_rolled(quarter_turns):
    corners = square(3.0, 5.0)
    np.testing.assert_array_equal(renamed(corners, quarter_turns), np.roll(corners, -quarter_turns, axis=0))
