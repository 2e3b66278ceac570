"""Warps: their derivatives are those of what they compute, and their points come back."""

from __future__ import annotations

import numpy as np
import pytest

from astratag.camera import Camera
from astratag.geometry import square
from astratag.surface import Cylinder, Flat
from astratag.transforms import exp_so3, pose
from astratag.warp import OUTSIDE_PX, BentWarp, FittedWarp, HomographyWarp, PoseWarp

T_CAM_MARKER = pose(exp_so3([np.pi - 0.2, 0.3, 0.1]), [0.02, 0.03, 0.5])
QUAD_PX = np.array([(100.0, 100.0), (200.0, 110.0), (205.0, 220.0), (90.0, 200.0)])


def camera(*distortion: float) -> Camera:
    return Camera([[1000, 0, 640], [0, 1010, 360], [0, 0, 1]], distortion, width=1280, height=720)


HOMOGRAPHY = HomographyWarp.from_points(square(0, 700), QUAD_PX)
WARPS: dict[str, FittedWarp] = {
    "homography": HOMOGRAPHY,
    "bent": BentWarp(HOMOGRAPHY, np.array([[1.0, -2.0, 3.0], [0.5, 0.2, -4.0]])),
    "flat": PoseWarp(camera(), 0.1, Flat(), T_CAM_MARKER),
    "cylinder": PoseWarp(camera(), 0.1, Cylinder(0.15, 0.4), T_CAM_MARKER),
    "distorted": PoseWarp(camera(0.1, -0.05, 0.001, 0.002, 0.01), 0.1, Cylinder(0.15, 0.4), T_CAM_MARKER),
}


@pytest.mark.parametrize("name", WARPS)
def test_jacobian_is_the_derivative(name: str) -> None:
    warp = WARPS[name]
    points = np.random.default_rng(0).uniform(0, 700, (20, 2))
    J = warp.jacobian(points)
    for column in range(J.shape[2]):
        step = 1e-6 * np.eye(J.shape[2])[column]
        numeric = (warp.stepped(step)(points) - warp.stepped(-step)(points)) / 2e-6
        np.testing.assert_allclose(J[:, :, column], numeric, atol=1e-5 * (1 + np.abs(J[:, :, column]).max()))


def test_a_homography_goes_through_its_points() -> None:
    np.testing.assert_allclose(HOMOGRAPHY(square(0, 700)), QUAD_PX, atol=1e-3)


def test_a_bent_warp_is_found_again_from_its_points() -> None:
    points = np.stack(np.meshgrid(*[np.linspace(0, 700, 5)] * 2), axis=-1).reshape(-1, 2)
    np.testing.assert_allclose(
        BentWarp.from_points(points, WARPS["bent"](points))(points), WARPS["bent"](points), atol=1e-3
    )


def test_points_behind_the_camera_are_outside_every_image() -> None:
    behind = PoseWarp(camera(), 0.1, Flat(), pose(np.diag([1.0, -1.0, -1.0]), [0, 0, -0.5]))
    assert (behind(square(0, 700)) == OUTSIDE_PX).all()


def test_the_far_side_of_a_cylinder_is_not_visible() -> None:
    tight = PoseWarp(camera(), 0.1, Cylinder(0.03), pose(np.diag([1.0, -1.0, -1.0]), [0, 0, 0.5]))
    assert tight.visible(np.array([(350.0, 350.0), (350.0, 0.0)])).tolist() == [True, False]


@pytest.mark.parametrize("name", WARPS)
def test_slopes_are_the_jacobian_along_directions(name: str) -> None:
    warp, rng = WARPS[name], np.random.default_rng(0)
    points, angles = rng.uniform(0, 700, (20, 2)), rng.uniform(0, 2 * np.pi, 20)
    along = np.stack([np.cos(angles), np.sin(angles)])
    expected = np.einsum("in,nip->pn", along, warp.jacobian(points))
    np.testing.assert_allclose(warp.slopes(points, along), expected, rtol=1e-9, atol=1e-9)
