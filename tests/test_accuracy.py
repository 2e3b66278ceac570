"""How exact corners and poses are, and whether their standard deviations say so: Monte Carlo over rendered pictures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from astratag import Camera, Cylinder, Detector, Flat, Tracker, load_dictionary
from astratag.fit import fit_edges
from astratag.geometry import square
from astratag.grow import ALL_EDGES, SETTLE_PX, settle
from astratag.layers import measure_layers
from astratag.surface import Surface
from astratag.transforms import difference, exp_so3, perturb, pose
from astratag.warp import PoseWarp
from pipeline.render import render_marker

MARKER_ID, SIDE_M = 7, 0.1
SIGNATURE = load_dictionary().signature(MARKER_ID)
CAMERA = Camera([[400, 0, 119.5], [0, 400, 119.5], [0, 0, 1]], width=240, height=240)
FACING = np.diag([1.0, -1.0, -1.0])
START_SIGMA = np.array([3e-4, 3e-4, 1e-3, 5e-3, 5e-3, 5e-3])
"""How far from the truth fits begin, metres and radians."""
SURFACES: dict[str, Surface] = {"flat": Flat(), "cylinder": Cylinder(0.15, 0.4)}


@dataclass
class Errors:
    """What came out of one cell of scenes: squares of corner errors over their sigmas squared, and of poses' errors."""

    corner_rms_px: float
    corner_nees: float
    pose_nees: float


def photograph(
    T_cam_marker: np.ndarray, surface: Surface, seed: int, noise_sigma: float = 2.0, samples: int = 8
) -> np.ndarray:
    return render_marker(
        CAMERA,
        T_cam_marker,
        signature=SIGNATURE,
        side_m=SIDE_M,
        surface=surface,
        noise_sigma=noise_sigma,
        background=60,
        seed=seed,
        samples=samples,
    )


def measured(surface: Surface, side_px: float, tilt_deg: float, draws: int = 16) -> Errors:
    """Return the errors at one apparent size and tilt, for any roll and direction of the tilt."""
    detector = Detector(side_m=SIDE_M, surface=surface)
    squared, corner_nees, pose_nees = [], [], []
    for seed in range(draws):
        rng = np.random.default_rng(seed)
        azimuth, roll = rng.uniform(0, 2 * np.pi, 2)
        tilt = np.radians(tilt_deg) * np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
        R = FACING @ exp_so3([0, 0, roll]) @ exp_so3(tilt)
        T_cam_marker = pose(R, [*rng.uniform(-0.02, 0.02, 2), 400 * SIDE_M / side_px])
        view = detector.view(photograph(T_cam_marker, surface, seed), CAMERA)
        start = perturb(T_cam_marker, START_SIGMA * rng.standard_normal(6))
        fit = settle(view.light, PoseWarp(CAMERA, SIDE_M, surface, start), detector.near(MARKER_ID))
        assert fit is not None and isinstance(fit.warp, PoseWarp)
        error = difference(T_cam_marker, fit.warp.T_cam_marker)
        pose_nees.append(error @ np.linalg.solve(fit.covariance, error) / 6)
        true_px = PoseWarp(CAMERA, SIDE_M, surface, T_cam_marker)(square(0, 700))
        for seen in measure_layers(fit, view.gray.shape):
            if seen.layer == 0:
                squared.append(np.mean((seen.corners_px - true_px) ** 2))
                corner_nees.append(squared[-1] / seen.sigma_px**2)
    return Errors(float(np.sqrt(np.mean(squared))), float(np.mean(corner_nees)), float(np.mean(pose_nees)))


@pytest.mark.parametrize("surface", SURFACES)
@pytest.mark.parametrize(("side_px", "tilt_deg"), [(150, 5), (80, 5), (80, 30), (48, 30), (32, 5)])
def test_corners_and_poses_are_as_exact_as_they_say(surface: str, side_px: float, tilt_deg: float) -> None:
    """Corners to 0.04 px from 48 px on and 0.05 px at 32; NEES near 1: never far above, not far below."""
    errors = measured(SURFACES[surface], side_px, tilt_deg)
    assert errors.corner_rms_px < (0.04 if side_px >= 48 else 0.05)
    assert 0.15 < errors.corner_nees < 1.3
    assert 0.5 < errors.pose_nees < 1.5


def test_steeply_tilted_corners_are_exact_too() -> None:
    errors = measured(Flat(), 100, 60)
    assert errors.corner_rms_px < 0.04
    assert errors.pose_nees < 1.5


@pytest.mark.parametrize("tilt_rad", [0.05, 0.15])
def test_a_slow_approach_near_frontal_never_flips(tilt_rad: float) -> None:
    """Where both planar poses explain the corners, the pose that is followed stays the one it was."""
    tracker = Tracker(Detector(side_m=SIDE_M, surface=Flat()))
    turned = []
    for frame in range(15):
        R = FACING @ exp_so3([0, 0, 0.3]) @ exp_so3([tilt_rad * (1 - frame / 40), 0, 0])
        T_cam_marker = pose(R, [0.02, -0.01, 0.9 - 0.015 * frame])
        (seen,) = tracker.detect(photograph(T_cam_marker, Flat(), frame, noise_sigma=5.0), CAMERA)
        assert sum(planar.probability for planar in seen.planar_poses) == pytest.approx(1)
        turned.append(np.degrees(np.linalg.norm(difference(T_cam_marker, seen.T_cam_marker)[3:])))
    assert max(turned[3:]) < 4.0


SLANTED = {
    "flat, tilted": (Flat(), (1.0, 0.4), 75),
    "cylinder, turned": (Cylinder(0.15, 0.0), (1.0, 0.0), 60),
    "tight cylinder, tilted": (Cylinder(0.077, 0.0), (0.5, 1.0), 50),
}


@pytest.mark.parametrize("scene", SLANTED)
def test_edges_are_where_the_true_pose_has_them(scene: str) -> None:
    """At a slant neighbours pull, units grow along the edges as well as across, and curved edges move inwards."""
    surface, about, tilt_deg = SLANTED[scene]
    detector, means = Detector(side_m=SIDE_M, surface=surface), []
    axis = np.radians(tilt_deg) * np.array([*about, 0.0]) / np.hypot(*about)
    for roll_rad in (0.3, 1.1, 1.9, 2.6):
        T_cam_marker = pose(FACING @ exp_so3([0, 0, roll_rad]) @ exp_so3(axis), [0.004, -0.003, 0.25])
        image = photograph(T_cam_marker, surface, 0, noise_sigma=0.0, samples=64)
        light, truth = detector.view(image, CAMERA).light, PoseWarp(CAMERA, SIDE_M, surface, T_cam_marker)
        fit = fit_edges(light, truth, ALL_EDGES, SETTLE_PX, detector.near(MARKER_ID))
        assert fit is not None
        seen = fit.weight.sum(axis=1) > 0
        means += list((fit.weight * fit.offset_px).sum(axis=1)[seen] / fit.weight.sum(axis=1)[seen])
    assert len(means) > 40
    assert np.median(np.abs(means)) < 0.004
