"""Laws of the surfaces: a print is wrapped without stretching and its frame is tangent at its centre."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from astratag.surface import Cylinder, Flat

radii_m = st.floats(-2.0, 3.0).map(lambda exponent: 10.0**exponent)
cylinders = st.builds(Cylinder, radii_m, st.floats(-np.pi, np.pi))
surfaces = st.one_of(cylinders, st.just(Flat()))
print_points = st.tuples(st.floats(-0.1, 0.1), st.floats(-0.1, 0.1)).map(np.array)


@given(surfaces, print_points, print_points)
def test_length_along_the_print_is_length_along_the_surface(surface, start, end):
    """A straight line on the paper keeps its length: chords of a fine polyline, to their own sagitta."""
    line = start + np.linspace(0.0, 1.0, 4001)[:, None] * (end - start)
    length = np.linalg.norm(np.diff(surface.points(line), axis=0), axis=1).sum()
    assert length == pytest.approx(np.linalg.norm(end - start), rel=1e-5, abs=1e-12)


@given(surfaces)
def test_marker_frame_is_the_tangent_frame_at_the_centre(surface):
    step = 1e-6
    np.testing.assert_array_equal(surface.points(np.zeros(2)), np.zeros(3))
    np.testing.assert_array_equal(surface.normals(np.zeros(2)), [0.0, 0.0, 1.0])
    np.testing.assert_allclose(surface.points(step * np.eye(2)) / step, np.eye(3)[:2], atol=1e-4)


@given(surfaces, print_points)
def test_normals_are_unit_and_perpendicular_to_the_print_and_right_handed(surface, point):
    step = 1e-6 * np.eye(2)
    tangents = (surface.points(point + step) - surface.points(point - step)) / 2e-6
    np.testing.assert_allclose(np.cross(*tangents), surface.normals(point), atol=1e-5)
    assert np.linalg.norm(surface.normals(point)) == pytest.approx(1.0)


@given(cylinders, print_points)
def test_cylinder_points_are_at_the_radius_from_an_axis_behind_the_print(cylinder, point):
    along = np.array([np.cos(cylinder.axis_rad), np.sin(cylinder.axis_rad), 0.0])
    from_axis = cylinder.points(point) - np.array([0.0, 0.0, -cylinder.radius_m])
    assert np.linalg.norm(np.cross(from_axis, along)) == pytest.approx(cylinder.radius_m)


@given(print_points, st.floats(-np.pi, np.pi))
def test_a_cylinder_grows_flat_with_its_radius(point, axis_rad):
    """The sagitta of 0.14 m on a kilometre is 10 micrometres."""
    np.testing.assert_allclose(Cylinder(1000.0, axis_rad).points(point), Flat().points(point), atol=1.1e-5)


def test_axis_zero_bends_over_top_and_bottom():
    cylinder = Cylinder(0.5, 0.0)
    assert cylinder.points(np.array([0.1, 0.0]))[2] == 0.0
    assert cylinder.points(np.array([0.0, 0.1]))[2] < 0.0


@pytest.mark.parametrize("surface", [Flat(), Cylinder(0.2, 0.3)])
def test_any_leading_shape(surface):
    points = np.random.default_rng(1).uniform(-0.1, 0.1, (3, 4, 2))
    assert surface.points(points).shape == surface.normals(points).shape == (3, 4, 3)
    np.testing.assert_array_equal(surface.points(points)[2, 1], surface.points(points[2, 1]))
    assert surface.points(np.zeros((0, 2))).shape == (0, 3)


@pytest.mark.parametrize("radius_m", [0.0, -1.0, np.inf, np.nan])
def test_refuses_a_radius_that_is_not_positive_and_finite(radius_m):
    with pytest.raises(ValueError, match="radius_m must be a positive length"):
        Cylinder(radius_m)


def test_refuses_an_axis_that_is_not_finite():
    with pytest.raises(ValueError, match="axis_rad must be a finite number"):
        Cylinder(1.0, np.nan)
