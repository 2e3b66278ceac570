"""Poses from corners: exact without noise, both planar solutions kept, covariance that holds in Monte Carlo."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.stats import chi2

from astratag.camera import Camera
from astratag.detection import LayerDetection
from astratag.geometry import LAYERS, square
from astratag.ippe import plane_poses
from astratag.pose import mirrored, planar_poses, poses_from_square, refine_on_corners
from astratag.surface import Cylinder, Flat, Surface
from astratag.transforms import difference, exp_so3, pose
from astratag.warp import PoseWarp

CAMERA = Camera([[1000, 0, 640], [0, 1000, 360], [0, 0, 1]], (0.05, -0.1, 0.001, 0.0, 0.0), width=1280, height=720)
FACING = np.diag([1.0, -1.0, -1.0])
SURFACES = {"flat": Flat(), "cylinder": Cylinder(0.15), "askew": Cylinder(0.15, 0.5)}


def seen_layers(
    T: np.ndarray, surface: Surface, layers: tuple[int, ...], sigma_px: float = 0.05
) -> list[LayerDetection]:
    warp = PoseWarp(CAMERA, 0.1, surface, T)
    return [LayerDetection(layer, warp(square(*LAYERS[layer].black)), sigma_px) for layer in layers]


@pytest.mark.parametrize("layers", [(0,), (0, 1), (2,)])
@pytest.mark.parametrize("surface", SURFACES)
def test_corners_without_noise_give_the_pose_back(surface: str, layers: tuple[int, ...]) -> None:
    """Whatever layers are seen: depth is never wrong by the ratio of two layers."""
    T = pose(FACING @ exp_so3([0.3, -0.4, 0.9]), [0.03, -0.02, 0.4])
    best, *_ = planar_poses(CAMERA, seen_layers(T, SURFACES[surface], layers), 0.1, SURFACES[surface])
    np.testing.assert_allclose(difference(T, best.T_cam_marker), 0, atol=2e-4 if layers == (2,) else 2e-5)
    refined = refine_on_corners(
        PoseWarp(CAMERA, 0.1, SURFACES[surface], best.T_cam_marker), seen_layers(T, SURFACES[surface], layers)
    )
    np.testing.assert_allclose(difference(T, refined.T_cam_marker), 0, atol=1e-7)
    assert refined.reprojection_rms_px < 1e-5


def test_a_far_flat_marker_has_two_poses_and_one_is_true() -> None:
    T = pose(FACING @ exp_so3([0.35, 0.0, 0.0]), [0.0, 0.0, 1.5])
    poses = planar_poses(CAMERA, seen_layers(T, Flat(), (0,)), 0.1, Flat())
    assert len(poses) == 2
    off = [np.linalg.norm(difference(T, planar.T_cam_marker)[3:]) for planar in poses]
    assert min(off) < 1e-3 < 0.3 < max(off)
    assert poses[0].reprojection_rms_px <= poses[1].reprojection_rms_px < 1.0


@pytest.mark.parametrize("seed", range(8))
def test_the_two_poses_of_a_plane_are_those_of_opencv(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points_m = 0.1 * np.array([(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)]) + rng.normal(0, 0.02, (4, 2))
    seen = points_m @ exp_so3(rng.normal(0, 0.8, 3))[:, :2].T + (*rng.normal(0, 0.2, 2), rng.uniform(0.5, 3))
    rays = np.ascontiguousarray(seen[:, :2] / seen[:, 2:]) + rng.normal(0, 1e-3, (4, 2))
    flat = np.append(points_m, np.zeros((4, 1)), axis=1)
    _, rotations, translations, _ = cv2.solvePnPGeneric(
        flat, rays.reshape(-1, 1, 2), np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
    )
    theirs = [pose(exp_so3(r), t) for r, t in zip(rotations, translations, strict=True)]
    np.testing.assert_allclose(plane_poses(points_m, rays), theirs, atol=1e-7)


def test_corners_on_one_line_give_no_pose() -> None:
    line = np.array([(100.0, 100.0), (200.0, 100.0), (300.0, 100.0), (400.0, 100.0)])
    for T in poses_from_square(CAMERA, square(0, 700), line, 0.1, Flat()):
        assert np.isfinite(T).all()


def test_without_layers_there_is_no_pose() -> None:
    assert planar_poses(CAMERA, [], 0.1, Flat()) == ()


@pytest.mark.parametrize("seed", [0])
@pytest.mark.parametrize("surface", ["flat", "cylinder"])
def test_covariance_is_consistent(surface: str, seed: int) -> None:
    """NEES of 150 draws with the corner noise that is claimed lies in its 99.9 % band.

    Misfit only ever enlarges the covariance, by 14 % on average with 18 degrees of freedom.
    """
    rng, sigma_px, draws = np.random.default_rng(seed), 0.05, 150
    T = pose(FACING @ exp_so3([0.5, 0.2, 0.1]), [0.02, 0.01, 0.5])
    truth = seen_layers(T, SURFACES[surface], (0, 1, 2), sigma_px)
    nees = []
    for _ in range(draws):
        noisy = [LayerDetection(s.layer, s.corners_px + rng.normal(0, sigma_px, (4, 2)), sigma_px) for s in truth]
        found = refine_on_corners(PoseWarp(CAMERA, 0.1, SURFACES[surface], T), noisy)
        error = difference(T, found.T_cam_marker)
        nees.append(error @ np.linalg.solve(found.covariance, error))
    low, high = chi2.ppf([0.0005, 0.9995], 6 * draws) / draws
    assert 0.8 * low < np.mean(nees) < high


@pytest.mark.parametrize("tilt_rad", [0.1, 0.2, 0.35])
def test_probabilities_of_the_two_poses_are_what_they_claim(tilt_rad: float) -> None:
    """Of draws with the noise that is claimed, the true pose comes first as often as its probability says."""
    rng, sigma_px = np.random.default_rng(1), 0.2
    T = pose(FACING @ exp_so3([tilt_rad, 0.0, 0.0]), [0.0, 0.0, 1.5])
    truth = seen_layers(T, Flat(), (0,), sigma_px)[0]
    first, claimed = [], []
    for _ in range(60):
        noisy = LayerDetection(0, truth.corners_px + rng.normal(0, sigma_px, (4, 2)), sigma_px)
        poses = planar_poses(CAMERA, [noisy], 0.1, Flat())
        off = [np.linalg.norm(difference(T, planar.T_cam_marker)[3:]) for planar in poses]
        first.append(off[0] == min(off))
        claimed.append(poses[0].probability)
        assert sum(planar.probability for planar in poses) == pytest.approx(1)
        assert claimed[-1] >= 0.5 - 1e-9
    assert np.mean(first) == pytest.approx(np.mean(claimed), abs=0.2)


def test_a_fitted_pose_finds_its_mirror_image() -> None:
    """Begun from either of the two poses, the same two are found."""
    T = pose(FACING @ exp_so3([0.35, 0.1, 0.0]), [0.02, 0.0, 1.2])
    layers = seen_layers(T, Flat(), (0,))
    both = planar_poses(CAMERA, layers, 0.1, Flat())
    again = planar_poses(CAMERA, layers, 0.1, Flat(), T)
    for one, other in zip(both, again, strict=True):
        np.testing.assert_allclose(difference(one.T_cam_marker, other.T_cam_marker), 0, atol=2e-3)
    assert again[0].T_cam_marker is T
    np.testing.assert_allclose(mirrored(mirrored(T)), T, atol=1e-12)
