"""Thin-plate splines: they interpolate, reproduce affine maps, and bend as a cylinder does."""

from __future__ import annotations

import numpy as np
import pytest

from astratag.camera import Camera
from astratag.geometry import TEMPLATE_UNITS
from astratag.surface import Cylinder
from astratag.tps import BEND_SHIFTS, KNOTS, ThinPlate, ThinPlateWarp, bent_places
from astratag.transforms import pose
from astratag.warp import HomographyWarp, PoseWarp

OUTER = KNOTS[:4]


def test_a_spline_passes_through_its_knots() -> None:
    places = np.random.default_rng(0).uniform(0, 500, KNOTS.shape)
    np.testing.assert_allclose(ThinPlateWarp(ThinPlate(KNOTS), places)(KNOTS), places, atol=1e-8)


def test_an_affine_map_is_reproduced_everywhere() -> None:
    A, b = np.array([[0.3, 0.1], [-0.2, 0.4]]), np.array([100.0, 50.0])
    points = np.random.default_rng(1).uniform(-100, 800, (50, 2))
    warp = ThinPlateWarp(ThinPlate(KNOTS), KNOTS @ A.T + b)
    np.testing.assert_allclose(warp(points), points @ A.T + b, atol=1e-8)


def test_knots_on_one_line_are_refused() -> None:
    with pytest.raises(ValueError, match="not on one line"):
        ThinPlate(np.array([(0.0, 0.0), (350.0, 350.0), (700.0, 700.0)]))


@pytest.mark.parametrize("axis_rad", [0.0, np.pi / 2])
def test_some_bend_of_the_search_comes_near_a_tilted_cylinder(axis_rad: float) -> None:
    """Radius 1.5 sides, 50 degrees of tilt: the best bend is right to 4 % of the side, as flat is not."""
    camera = Camera([[1000, 0, 640], [0, 1000, 360], [0, 0, 1]], width=1280, height=720)
    tilt = np.radians(50.0)
    c, s = np.cos(tilt), np.sin(tilt)
    R = (
        np.array([[1, 0, 0], [0, -c, -s], [0, s, -c]])
        if axis_rad == 0.0
        else np.array([[c, 0, s], [0, -1, 0], [s, 0, -c]])
    )
    warp = PoseWarp(camera, 0.1, Cylinder(0.15, axis_rad), pose(R, [0.0, 0.0, 0.8]))
    flat = HomographyWarp.from_points(OUTER, warp(OUTER))
    candidates = bent_places(flat(KNOTS), warp(OUTER))
    errors = np.abs(candidates - warp(KNOTS)).max(axis=(1, 2))
    side_px = 1000 * 0.1 / 0.8
    assert errors.min() < 0.04 * side_px < np.abs(flat(KNOTS) - warp(KNOTS)).max()


def test_bends_leave_the_corners_in_place() -> None:
    np.testing.assert_allclose(BEND_SHIFTS[:, :4], 0.0)
    assert KNOTS.max() == TEMPLATE_UNITS
