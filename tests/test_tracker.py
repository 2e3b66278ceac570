"""The tracker follows an approach, finds again what it lost, and gives the same answers to the same images."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from astratag import Camera, Cylinder, Detector, Tracker, load_dictionary
from astratag.transforms import difference, exp_so3, pose
from pipeline.render import render_marker

SIGNATURE = load_dictionary().signature(19)
CAMERA = Camera([[500, 0, 319.5], [0, 500, 179.5], [0, 0, 1]], width=640, height=360)
CYLINDER = Cylinder(0.15)
FACING = np.diag([1.0, -1.0, -1.0])
FRAMES = 24


def approach(frame: int) -> np.ndarray:
    """Return T_cam_marker: from 0.7 m to 0.24 m, tumbling by a few degrees."""
    range_m = 0.7 - 0.02 * frame
    R = FACING @ exp_so3(0.08 * np.array([np.sin(0.3 * frame), np.cos(0.2 * frame), np.sin(0.1 * frame)]))
    return pose(R, [0.03 * np.sin(0.15 * frame), 0.01 * np.cos(0.2 * frame), range_m])


@pytest.fixture(scope="module")
def images() -> list[np.ndarray]:
    return [
        render_marker(CAMERA, approach(k), signature=SIGNATURE, side_m=0.1, surface=CYLINDER, seed=k)
        for k in range(FRAMES)
    ]


def test_an_approach_is_followed_frame_by_frame(images: list[np.ndarray]) -> None:
    """Every frame has its marker, once; all after the first are tracked; the pose is as good as a search's."""
    tracker = Tracker(Detector(surface=CYLINDER))
    methods, nees = [], []
    for k, image in enumerate(images):
        (seen,) = tracker.detect(image, CAMERA)
        error = difference(approach(k), seen.T_cam_marker)
        assert seen.marker_id == 19
        assert np.linalg.norm(error[:3]) < 0.003 * approach(k)[2, 3]
        methods.append(seen.method)
        nees.append(error @ np.linalg.solve(seen.covariance, error) / 6)
    assert methods[0] == "cylinder"
    assert methods.count("tracked") >= FRAMES - 2
    assert 0.15 < np.mean(nees) < 2.0  # no JPEG here: the uncertainty allows for it


def test_a_marker_lost_and_moved_is_found_again(images: list[np.ndarray]) -> None:
    """Two dark frames, then the marker elsewhere: nothing is invented, and the search takes over."""
    tracker = Tracker(Detector(surface=CYLINDER))
    tracker.detect(images[0], CAMERA)
    dark = np.zeros_like(images[0])
    assert tracker.detect(dark, CAMERA) == []
    assert tracker.detect(dark, CAMERA) == []
    (again,) = tracker.detect(np.roll(images[1], 120, axis=1), CAMERA)
    assert (again.marker_id, again.method) == (19, "cylinder")


def test_a_jump_beyond_prediction_is_caught_in_the_same_frame(images: list[np.ndarray]) -> None:
    tracker = Tracker(Detector(surface=CYLINDER))
    tracker.detect(images[0], CAMERA)
    tracker.detect(images[1], CAMERA)
    (seen,) = tracker.detect(images[8], CAMERA)
    assert np.linalg.norm(difference(approach(8), seen.T_cam_marker)[:3]) < 2e-3


def test_the_same_images_give_the_same_detections(images: list[np.ndarray]) -> None:
    runs = []
    for _ in range(2):
        tracker = Tracker(Detector(surface=CYLINDER))
        runs.append([tracker.detect(image, CAMERA)[0].T_cam_marker for image in images[:6]])
    np.testing.assert_array_equal(runs[0], runs[1])


def test_reset_forgets(images: list[np.ndarray]) -> None:
    tracker = Tracker(Detector(surface=CYLINDER))
    tracker.detect(images[0], CAMERA)
    tracker.reset()
    assert tracker.detect(images[0], CAMERA)[0].method == "cylinder"


def test_without_a_camera_every_image_is_searched(images: list[np.ndarray]) -> None:
    tracker = Tracker(Detector())
    for image in images[:2]:
        (seen,) = tracker.detect(image)
        assert seen.method != "tracked" and seen.T_cam_marker is None


def test_a_marker_of_unknown_surface_is_followed_too(images: list[np.ndarray]) -> None:
    tracker = Tracker(Detector())
    for image in images[:3]:
        (seen,) = tracker.detect(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), CAMERA)
    assert (seen.marker_id, seen.method) == (19, "tracked")


def test_what_other_images_showed_leaves_no_trace() -> None:
    """A tight cylinder bulges out of the box about its corners: its edges there are this image's, too."""
    tight, found = Cylinder(0.077, np.pi / 2), []
    for other in (0, 255):
        detector = Detector(surface=tight)
        tracker = Tracker(detector)
        for frame in range(2):
            T = pose(FACING @ exp_so3([0.95, -0.45, 0.25]), [0.01 + 0.001 * frame, 0.0, 0.31])
            image = render_marker(CAMERA, T, signature=SIGNATURE, side_m=0.1, surface=tight, seed=frame)
            if frame:
                detector.detect(np.full_like(image, other))
            (seen,) = tracker.detect(image, CAMERA)
        assert seen.method == "tracked"
        found.append(seen.T_cam_marker)
    np.testing.assert_array_equal(*found)
