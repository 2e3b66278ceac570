"""Cylinders nobody measured: their warp's derivatives, the poses through quads and sides, and what is seen of them."""

from __future__ import annotations

import numpy as np
import pytest

from astratag import Camera, Cylinder, Detector, Flat, Surface, load_dictionary
from astratag.cylinder import HALF_ANGLES_RAD, LEANS_RAD, TURNS_RAD, CylinderWarp, bent_beside, bent_through
from astratag.geometry import square
from astratag.transforms import difference, exp_so3, pose
from pipeline.render import render_marker

CAMERA = Camera([[500, 0, 319.5], [0, 500, 239.5], [0, 0, 1]], width=640, height=480)
FACING = np.diag([1.0, -1.0, -1.0])
OUTER = square(0, 700)


def warps() -> list[CylinderWarp]:
    """Return squares of side 1 anywhere in view, each bent about x or y."""
    rng = np.random.default_rng(0)
    poses = [
        pose(FACING @ exp_so3(rng.uniform(-1, 1, 3)), [*rng.uniform(-1, 1, 2), rng.uniform(3, 5)]) for _ in range(6)
    ]
    return [CylinderWarp.of(CAMERA, 1.0, 2 * HALF_ANGLES_RAD[i % 3], i % 2 * np.pi / 2, T) for i, T in enumerate(poses)]


@pytest.mark.parametrize("warp", warps())
def test_jacobian_is_the_derivative(warp: CylinderWarp) -> None:
    points = np.random.default_rng(1).uniform(0, 700, (20, 2))
    J = warp.jacobian(points)
    for column, step in enumerate(1e-6 * np.eye(8)):
        numeric = (warp.stepped(step)(points) - warp.stepped(-step)(points)) / 2e-6
        np.testing.assert_allclose(J[:, :, column], numeric, atol=1e-5 * (1 + np.abs(numeric).max()))


@pytest.mark.parametrize("warp", warps())
def test_points_are_seen_as_through_a_pose_on_that_cylinder(warp: CylinderWarp) -> None:
    points = np.random.default_rng(2).uniform(-200, 900, (200, 2))
    np.testing.assert_allclose(warp(points), warp.pose(points), atol=1e-9)
    np.testing.assert_array_equal(warp.visible(points), warp.pose.visible(points))
    np.testing.assert_allclose(warp.jacobian(points)[:, :, :6], warp.pose.jacobian(points), atol=1e-7)


@pytest.mark.parametrize("warp", warps())
def test_one_of_the_squares_through_its_corners_is_itself(warp: CylinderWarp) -> None:
    bent = bent_through(CAMERA, warp(OUTER)[None])
    found = [bent.warp(*which).pose.T_cam_marker for which in bent.all.tolist()]
    assert min(np.abs(T - warp.pose.T_cam_marker).max() for T in found) < 1e-6


def test_one_of_the_squares_beside_its_top_is_itself() -> None:
    turn, lean = TURNS_RAD[1], LEANS_RAD[2]
    leant, turned = exp_so3([0.0, lean, 0.0]), exp_so3([turn, 0.0, 0.0])
    R = exp_so3([0.0, 0.0, 0.7]) @ leant @ FACING @ turned
    warp = CylinderWarp.of(CAMERA, 1.0, 2 * HALF_ANGLES_RAD[1], 0.0, pose(R, [0.0, 0.0, 20.0]))
    bent = bent_beside(CAMERA, warp(OUTER)[None, :2])
    apart_px = np.abs(bent.project(OUTER, bent.all) - warp(OUTER)).max(axis=(1, 2))
    assert apart_px.min() < 0.5


@pytest.mark.parametrize("quarter_turns", range(4))
def test_turning_a_print_renames_its_corners(quarter_turns: int) -> None:
    warp = warps()[0]
    np.testing.assert_allclose(warp.turned(quarter_turns)(OUTER), np.roll(warp(OUTER), -quarter_turns, axis=0))


def photograph(T_cam_marker: np.ndarray, surface: Surface) -> np.ndarray:
    signature = load_dictionary().signature(7)
    return render_marker(CAMERA, T_cam_marker, signature=signature, side_m=0.1, surface=surface, seed=3)


def turned(deg: float, axis_rad: float) -> np.ndarray:
    """Return the pose of a print 0.31 m away, rolled, and turned about the axis of the cylinder it is on."""
    tilt = np.radians(deg) * np.array([np.cos(axis_rad), np.sin(axis_rad), 0.0])
    return pose(FACING @ exp_so3([0.0, 0.0, 0.4]) @ exp_so3(tilt), [0.01, 0.0, 0.3125])


@pytest.mark.parametrize("axis_rad", [0.0, np.pi / 2])
def test_radius_axis_and_pose_are_found_together(axis_rad: float) -> None:
    """Nobody tells the radius of 1.5 sides: it is found to 2 %, the pose to a millimetre, both within their sigmas."""
    surface, T = Cylinder(0.15, axis_rad), turned(30.0, axis_rad)
    (seen,) = Detector(side_m=0.1).detect(photograph(T, surface), CAMERA)
    assert (seen.marker_id, seen.method) == (7, "cylinder")
    assert seen.surface.radius_m == pytest.approx(0.15, rel=0.02)
    assert abs(np.sin(seen.surface.axis_rad - axis_rad)) < 0.02
    error = difference(T, seen.T_cam_marker)
    assert np.abs(error[:3]).max() < 1e-3
    assert error @ np.linalg.solve(seen.covariance, error) < 22.5  # chi-square of 6, one in a thousand


@pytest.mark.parametrize("surface", [None, Cylinder(0.15)], ids=["unknown", "known"])
def test_a_print_whose_far_side_is_at_the_limb_is_read(surface: Surface | None) -> None:
    """At 75 degrees about the axis a tenth of the print is past the limb of a cylinder of radius 1.5 sides."""
    T = turned(75.0, 0.0)
    (seen,) = Detector(side_m=0.1, surface=surface).detect(photograph(T, Cylinder(0.15)), CAMERA)
    assert (seen.marker_id, seen.method) == (7, "cylinder")
    truth = CylinderWarp.of(CAMERA, 0.1, 0.1 / 0.15, 0.0, T)(OUTER)
    assert np.abs(seen.corners_px - truth).max() < 5.0
    error = difference(T, seen.T_cam_marker)
    assert error @ np.linalg.solve(seen.covariance, error) < 22.5


@pytest.mark.parametrize("deg", [0.0, 60.0])
def test_a_flat_print_on_an_undescribed_surface_stays_flat(deg: float) -> None:
    (seen,) = Detector(side_m=0.1).detect(photograph(turned(deg, 0.3), Flat()), CAMERA)
    assert (seen.method, seen.surface, seen.warp_grid_px) == ("planar", None, None)
