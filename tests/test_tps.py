"""Thin-plate splines: they interpolate, reproduce affine maps, and bend as a cylinder does."""

from __future__ import annotations

import numpy as np
import pytest

from astratag.camera import Camera
from astratag.geometry import TEMPLATE_UNITS
from astratag.surface import Cylinder
from astratag.tps import KNOTS, ThinPlate
from astratag.transforms import pose
from astratag.warp import HomographyWarp, PoseWarp

OUTER = KNOTS[:4]


def test_a_spline_passes_through_its_knots() -> None:
    places = np.random.default_rng(0).uniform(0, 500, KNOTS.shape)
    np.testing.assert_allclose(ThinPlate(KNOTS).basis(KNOTS) @ places, places, atol=1e-8)


def test_an_affine_map_is_reproduced_everywhere() -> None:
    A, b = np.array([[0.3, 0.1], [-0.2, 0.4]]), np.array([100.0, 50.0])
    points = np.random.default_rng(1).uniform(-100, 800, (50, 2))
    warped = ThinPlate(KNOTS).basis(points) @ (KNOTS @ A.T + b)
    np.testing.assert_allclose(warped, points @ A.T + b, atol=1e-8)


def test_knots_on_one_line_are_refused() -> None:
    with pytest.raises(ValueError, match="not on one line"):
        ThinPlate(np.array([(0.0, 0.0), (350.0, 350.0), (700.0, 700.0)]))


@pytest.mark.parametrize("axis_rad", [0.0, np.pi / 2])
def test_it_bends_as_a_tilted_cylinder_does(axis_rad: float) -> None:
    """Radius 1.5 sides, 50 degrees of tilt: right to 2 % of the side everywhere on the print, as flat is not."""
    camera = Camera([[1000, 0, 640], [0, 1000, 360], [0, 0, 1]], width=1280, height=720)
    c, s = np.cos(np.radians(50.0)), np.sin(np.radians(50.0))
    about_x, about_y = [[1, 0, 0], [0, -c, -s], [0, s, -c]], [[c, 0, s], [0, -1, 0], [s, 0, -c]]
    R = np.array(about_x if axis_rad == 0.0 else about_y)
    truth = PoseWarp(camera, 0.1, Cylinder(0.15, axis_rad), pose(R, [0.0, 0.0, 0.8]))
    u = np.linspace(0.0, TEMPLATE_UNITS, 15)
    points = np.stack(np.meshgrid(u, u), axis=-1).reshape(-1, 2)
    spline = ThinPlate(KNOTS).basis(points) @ truth(KNOTS)
    flat = HomographyWarp.from_points(OUTER, truth(OUTER))(points)
    allowed_px = 0.02 * 1000 * 0.1 / 0.8
    assert np.abs(spline - truth(points)).max() < allowed_px < np.abs(flat - truth(points)).max()
