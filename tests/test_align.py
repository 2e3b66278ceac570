"""Alignment: a print found again from some cells off, in any light, and pixels sampled with their gradients."""

from __future__ import annotations

import numpy as np
import pytest

from astratag import Camera, Cylinder, Flat, Surface, load_dictionary
from astratag.align import COARSE_BLUR, COARSE_STEPS, FINE_STEPS, _sampled, align
from astratag.cylinder import CylinderWarp
from astratag.geometry import square
from astratag.sampling import sample
from astratag.signature import Artwork
from astratag.transforms import pose
from astratag.warp import HomographyWarp, PoseWarp
from pipeline.render import render_marker

CAMERA = Camera([[500, 0, 319.5], [0, 500, 239.5], [0, 0, 1]], width=640, height=480)
T_CAM_MARKER = pose(np.diag([1.0, -1.0, -1.0]), [0.1, -0.05, 4.0])  # 125 pixels to the side
OUTER = square(0, 700)
DICTIONARY = load_dictionary()
ARTWORK = Artwork(DICTIONARY)
BEND = 0.8


def photograph(surface: Surface) -> np.ndarray:
    """Return marker 7, lit twice as brightly on the right as on the left."""
    image = render_marker(CAMERA, T_CAM_MARKER, signature=DICTIONARY.signature(7), side_m=1.0, surface=surface, seed=3)
    return (image * np.linspace(0.5, 1.0, image.shape[1])).astype(np.uint8)


def moved(image: np.ndarray, warp):
    """Return a warp after the coarse and the fine steps that the detector takes."""
    expected = ARTWORK.expected(7, 125.0)[0]
    for blur, steps in ((COARSE_BLUR, COARSE_STEPS), (0.0, FINE_STEPS)):
        warp = align(image, warp, ARTWORK.points, expected, blur=blur, steps=steps)
    return warp


@pytest.mark.parametrize("shift_px", [(4.0, -3.0), (-5.0, 2.0), (0.0, 6.0)])
def test_a_plane_some_pixels_off_is_brought_home(shift_px: tuple[float, float]) -> None:
    corners_px = PoseWarp(CAMERA, 1.0, Flat(), T_CAM_MARKER)(OUTER)
    start = HomographyWarp.from_points(OUTER, corners_px + shift_px)
    assert moved(photograph(Flat()), start)(OUTER) == pytest.approx(corners_px, abs=1.0)


def test_a_cylinder_of_another_radius_is_brought_home() -> None:
    true = CylinderWarp.of(CAMERA, 1.0, BEND, 0.0, T_CAM_MARKER)
    start = CylinderWarp.of(CAMERA, 1.0, BEND - 0.3, 0.0, pose(T_CAM_MARKER[:3, :3], [0.13, -0.07, 4.1]))
    found = moved(photograph(Cylinder(1.0 / BEND)), start)
    assert found(OUTER) == pytest.approx(true(OUTER), abs=1.0)
    assert found.curvature == pytest.approx(BEND, abs=0.1)


def test_a_print_mostly_out_of_the_picture_stays_where_it_is() -> None:
    start = HomographyWarp.from_points(OUTER, np.array([[-90.0, 50], [35, 50], [35, 175], [-90, 175]]))
    assert (moved(photograph(Flat()), start)(OUTER) == start(OUTER)).all()


def test_values_and_gradients_are_those_of_the_interpolated_image() -> None:
    image = np.random.default_rng(0).integers(0, 256, (20, 30)).astype(np.uint8)
    at_px = np.random.default_rng(1).uniform(1, (28, 18), (200, 2))
    value, gradient, inside = _sampled(image, at_px)
    assert inside.all()
    assert value == pytest.approx(sample(image, at_px))
    for axis, step in enumerate(np.eye(2)):
        assert gradient[axis] == pytest.approx((sample(image, at_px + step) - sample(image, at_px - step)) / 2)


def test_places_outside_or_that_are_none_are_told() -> None:
    image = np.full((8, 8), 7, np.uint8)
    nowhere = np.array([[np.nan, 4.0], [4.0, np.inf], [-np.inf, np.nan], [1e300, 1.0], [0.5, 3.0], [3.0, 6.5]])
    value, gradient, inside = _sampled(image, nowhere)
    assert not inside.any()
    assert (value == 7).all()
    assert (gradient == 0).all()
