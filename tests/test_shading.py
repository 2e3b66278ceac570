"""Light that varies over a print: its edges are where they are, in sunlight that falls off as beside a hard shadow."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from astratag import Camera, Detector, Flat, load_dictionary
from astratag.transforms import exp_so3, pose
from pipeline.render import FINER, develop, finer_camera, lay_print, light_behind

CAMERA = Camera([[600, 0, 159.5], [0, 600, 119.5], [0, 0, 1]], width=320, height=240)
T_CAM_MARKER = pose(np.diag([1.0, -1.0, -1.0]) @ exp_so3([0.1, 0.2, 0.3]), [0.005, -0.01, 0.5])
SIDE_M = 0.1


def corner_errors_px(brightness: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return how far corners (4, 2) are off in light that is so bright at each fine pixel."""
    fine = finer_camera(CAMERA)
    light = cv2.resize(light_behind(CAMERA, 40.0), (fine.width, fine.height))
    signature = load_dictionary().signature(7)
    light = lay_print(light, fine, T_CAM_MARKER, signature=signature, side_m=SIDE_M, surface=Flat(), samples=16)
    image = develop(light * brightness, noise_sigma=0.5, finer=FINER)
    found = Detector(side_m=SIDE_M, surface=Flat()).detect(image, CAMERA)
    assert [seen.marker_id for seen in found] == [7]
    half = SIDE_M / 2
    square = np.array([(-half, half, 0), (half, half, 0), (half, -half, 0), (-half, -half, 0)])
    return found[0].corners_px - CAMERA.project(square @ T_CAM_MARKER[:3, :3].T + T_CAM_MARKER[:3, 3])


def ahead_px() -> NDArray[np.float32]:
    """Return how far fine pixels are from the middle of the picture, down and a little to the right."""
    rows, columns = np.indices((FINER * CAMERA.height, FINER * CAMERA.width), dtype=np.float32) / np.float32(FINER)
    return 0.8 * (rows - 119.5) + 0.6 * (columns - 159.5)


@pytest.mark.parametrize("growth", [-0.012, 0.0, 0.008])
def test_light_that_grows_over_a_print_does_not_move_it(growth: float) -> None:
    """By 1.2 % a pixel: through all blur, edges then look 0.03 px from where they are."""
    errors_px = corner_errors_px(0.5 * np.exp(growth * ahead_px()))
    assert np.sqrt(np.mean(errors_px**2)) < 0.01


def test_light_that_bends_over_a_print_does_not_stretch_it() -> None:
    """As on a cylinder turned away from the sun: darker on both sides."""
    errors_px = corner_errors_px(0.9 * np.exp(-((ahead_px() / 90) ** 2)))
    assert np.sqrt(np.mean(errors_px**2)) < 0.01


def test_a_hard_shadow_is_not_taken_for_light_that_grows() -> None:
    errors_px = corner_errors_px(np.where(ahead_px() > 10, np.float32(0.15), np.float32(0.9)))
    assert np.sqrt(np.mean(errors_px**2)) < 0.03
