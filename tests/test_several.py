"""Several markers in one image, several cameras, several sides of one target: each with its own size and surface."""

from __future__ import annotations

import numpy as np
import pytest

from astratag import Camera, Cylinder, Detection, Detector, Flat, MarkerSpec, Tracker, load_dictionary
from astratag.geometry import square
from astratag.tracker import SEARCH_EVERY
from astratag.transforms import difference, exp_so3, pose
from astratag.warp import PoseWarp
from pipeline.convert import calibration_message, pose_matrix
from pipeline.detector import DetectorStep
from pipeline.mission import CylinderSection, MarkerSection, Mission, PoseSection
from pipeline.render import develop, lay_print, light_behind
from tests.test_detector_step import frame

DICTIONARY = load_dictionary()
CAMERA = Camera([[800, 0, 479.5], [0, 800, 299.5], [0, 0, 1]], width=960, height=600)
WIDE = Camera([[300, 0, 159.5], [0, 300, 119.5], [0, 0, 1]], (-0.2, 0.05, 0, 0, 0), width=320, height=240)
FACING = np.diag([1.0, -1.0, -1.0])

MARKERS = {
    3: MarkerSpec(0.20, Flat()),
    7: MarkerSpec(0.05, Cylinder(0.075, 0.4)),
    11: MarkerSpec(0.10, Cylinder(0.15)),
    15: MarkerSpec(0.02, Flat()),
    19: MarkerSpec(0.04, Flat()),
}
POSES = {
    3: pose(FACING @ exp_so3([0.5, 0.1, 0.2]), [-0.25, -0.08, 0.9]),
    7: pose(FACING @ exp_so3([0.1, -0.4, 2.0]), [0.12, -0.10, 0.45]),
    11: pose(FACING @ exp_so3([-0.3, 0.2, 4.0]), [0.30, 0.15, 0.9]),
    15: pose(FACING @ exp_so3([0.2, 0.3, 1.0]), [0.0, 0.08, 0.35]),
    19: pose(FACING @ exp_so3([0.4, -0.2, 5.5]), [-0.22, 0.22, 0.8]),
}
"""T_cam_marker of each: 178, 89, 89, 46 and 40 pixels large."""


def picture(poses: dict[int, np.ndarray], seed: int = 0, camera: Camera = CAMERA) -> np.ndarray:
    light = light_behind(camera, 90.0)
    for marker_id, T_cam_marker in sorted(poses.items(), key=lambda item: -item[1][2, 3]):
        spec = MARKERS[marker_id]
        light = lay_print(
            light,
            camera,
            T_cam_marker,
            signature=DICTIONARY.signature(marker_id),
            side_m=spec.side_m,
            surface=spec.surface or Flat(),
        )
    return develop(light, seed=seed)


def assert_right(seen: Detection, T_cam_marker: np.ndarray) -> None:
    """Assert a position to a fiftieth of the range, and the attitude to 5 degrees in one of the two planar poses."""
    assert seen.T_cam_marker is not None and seen.covariance is not None
    error = difference(T_cam_marker, seen.T_cam_marker)
    assert np.linalg.norm(error[:3]) < 0.02 * T_cam_marker[2, 3]
    attitudes = [seen.T_cam_marker, *(planar.T_cam_marker for planar in seen.planar_poses)]
    assert min(np.linalg.norm(difference(T_cam_marker, T)[3:]) for T in attitudes) < np.radians(5.0)


@pytest.mark.parametrize("seed", range(3))
def test_five_markers_of_their_own_sizes_and_surfaces_in_one_image(seed: int) -> None:
    found = Detector(markers=MARKERS).detect(picture(POSES, seed), CAMERA)
    assert sorted(seen.marker_id for seen in found) == sorted(MARKERS)
    for seen in found:
        assert_right(seen, POSES[seen.marker_id])
        assert seen.method == ("planar" if MARKERS[seen.marker_id].surface == Flat() else "cylinder")


def test_a_listed_marker_beside_one_ten_times_as_large_is_found() -> None:
    """30 pixels beside 300: the search that finds the large one at half resolution does not see the small one."""
    poses = {3: pose(FACING @ exp_so3([0.2, 0.1, 0.3]), [-0.1, 0.0, 0.53]), 15: pose(FACING, [0.2, 0.1, 0.53])}
    found = Detector(markers=MARKERS).detect(picture(poses), CAMERA)
    assert {seen.marker_id for seen in found} == {3, 15}
    for seen in found:
        assert_right(seen, poses[seen.marker_id])


def test_markers_that_are_not_listed_have_the_common_size() -> None:
    poses = {marker_id: POSES[marker_id] for marker_id in (3, 11)}
    found = Detector(side_m=0.2, surface=Flat(), markers={11: MARKERS[11]}).detect(picture(poses), CAMERA)
    assert {seen.marker_id for seen in found} == set(poses)
    for seen in found:
        assert_right(seen, poses[seen.marker_id])


def inside(poses: dict[int, np.ndarray], margin_px: float) -> set[int]:
    """Return the markers whose black square is inside the image by a margin."""
    limits = np.array([CAMERA.width - 1, CAMERA.height - 1]) - margin_px
    whole = set()
    for marker_id, T_cam_marker in poses.items():
        spec = MARKERS[marker_id]
        corners = PoseWarp(CAMERA, spec.side_m, spec.surface or Flat(), T_cam_marker)(square(0.0, 700.0))
        if (corners > margin_px).all() and (corners < limits).all():
            whole.add(marker_id)
    return whole


def test_a_tracker_keeps_all_and_takes_back_those_that_leave_and_return() -> None:
    """The camera pans a field of view aside and back: whole markers are followed, each is back within the searches.

    A search comes every tenth frame, and three are needed to look in every way.
    """
    tracker = Tracker(Detector(markers=MARKERS))
    unseen_since: dict[int, int] = {}
    seen_again = set()
    for k in range(32):
        aside_m = 0.5 * np.sin(np.pi * min(k, 14) / 14) ** 2
        poses = {i: pose(T[:3, :3], T[:3, 3] + (aside_m, 0.0, 0.0)) for i, T in POSES.items()}
        found = tracker.detect(picture(poses, seed=k), CAMERA)
        assert len({seen.marker_id for seen in found}) == len(found)
        assert {seen.marker_id for seen in found} <= set(MARKERS)
        whole = inside(poses, margin_px=12.0)
        for seen in found:
            if seen.marker_id in whole:
                assert_right(seen, poses[seen.marker_id])
        for marker_id in MARKERS:
            if marker_id in {seen.marker_id for seen in found} or marker_id not in whole:
                if marker_id in whole and unseen_since.get(marker_id, k) < k:
                    seen_again.add(marker_id)
                unseen_since[marker_id] = k
            assert k - unseen_since.get(marker_id, 0) <= 3 * SEARCH_EVERY + 1
    assert {seen.marker_id for seen in found} == set(MARKERS)
    assert seen_again


def test_one_detector_serves_the_trackers_of_two_cameras() -> None:
    """Frames of cameras of two sizes in turn give what each gives alone."""

    def poses(k: int) -> dict[int, np.ndarray]:
        return {i: pose(POSES[i][:3, :3], POSES[i][:3, 3] + (0.0, 0.0, -0.01 * k)) for i in (3, 7)}

    images = {camera: [picture(poses(k), k, camera) for k in range(4)] for camera in (CAMERA, WIDE)}
    alone = {camera: [Tracker(Detector(markers=MARKERS))] for camera in images}
    shared = Detector(markers=MARKERS)
    together = {camera: Tracker(shared) for camera in images}
    for k in range(4):
        for camera, frames in images.items():
            expected = alone[camera][0].detect(frames[k], camera)
            found = together[camera].detect(frames[k], camera)
            assert [seen.marker_id for seen in found] == [seen.marker_id for seen in expected]
            assert 3 in {seen.marker_id for seen in found}
            for seen, same in zip(found, expected, strict=True):
                np.testing.assert_array_equal(seen.T_cam_marker, same.T_cam_marker)
                assert_right(seen, poses(k)[seen.marker_id])


def test_the_step_takes_each_markers_size_and_surface_from_the_mission() -> None:
    """Two sides of one target: where the markers are on it does not matter to the detector, how they were made does."""
    sides = (PoseSection(), PoseSection(translation_m=(0, 0, -0.5), rotation_wxyz=(0, 0, 1, 0)))
    mission = Mission(
        markers=(
            MarkerSection(id=3, side_m=0.2, T_target_marker=sides[0]),
            MarkerSection(id=11, side_m=0.1, surface=CylinderSection(radius_m=0.15), T_target_marker=sides[1]),
        )
    )
    step = DetectorStep(mission)
    step.step(calibration_message(CAMERA, frame_id="nav", t_capture_ns=0))
    found, _ = step.step(frame(picture({i: POSES[i] for i in (3, 11)})))
    poses = {seen.marker_id: pose_matrix(seen.T_cam_marker) for seen in found.detections}
    assert set(poses) == {3, 11}
    for marker_id, T_cam_marker in poses.items():
        assert np.linalg.norm(difference(POSES[marker_id], T_cam_marker)[:3]) < 0.01 * POSES[marker_id][2, 3]
