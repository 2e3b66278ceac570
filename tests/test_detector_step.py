"""The detector's step: what comes out for each frame, and what it refuses."""

from collections.abc import Iterator

import cv2
import numpy as np
import pytest
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from foxglove_schemas_protobuf.PointsAnnotation_pb2 import PointsAnnotation

from astratag.camera import Camera
from astratag.dictionary import load_dictionary
from astratag.surface import Cylinder
from astratag.transforms import exp_so3, pose
from pipeline.convert import calibration_message, points_array, pose_matrix
from pipeline.detector import DetectorStep
from pipeline.mission import CylinderSection, MarkerSection, Mission
from pipeline.render import render_marker
from schemas import Detections, encode

CAMERA = Camera([[800, 0, 319.5], [0, 800, 239.5], [0, 0, 1]], width=640, height=480)
MARKER_ID = 7
RADIUS_M = 0.15
T_CAM_MARKER = pose(exp_so3((np.pi, 0, 0)) @ exp_so3((0.1, 0.3, 0.2)), (0.01, -0.02, 0.45))
FLAT = Mission(markers=(MarkerSection(id=MARKER_ID),))
CURVED = Mission(markers=(MarkerSection(id=MARKER_ID, surface=CylinderSection(radius_m=RADIUS_M)),))
T_CAPTURE_NS = 1_700_000_000_123_456_789


def picture(surface=None, T_cam_marker=T_CAM_MARKER) -> np.ndarray:
    signature = load_dictionary().signature(MARKER_ID)
    return render_marker(CAMERA, T_cam_marker, signature=signature, side_m=0.1, surface=surface, seed=1)


def frame(image: np.ndarray, kind: str = "png", t_capture_ns: int = T_CAPTURE_NS) -> CompressedImage:
    suffix = {"png": ".png", "jpeg": ".jpg"}[kind]
    message = CompressedImage(frame_id="nav", format=kind, data=cv2.imencode(suffix, image)[1].tobytes())
    message.timestamp.FromNanoseconds(t_capture_ns)
    return message


def calibration() -> CameraCalibration:
    return calibration_message(CAMERA, frame_id="nav", t_capture_ns=0)


def run(mission: Mission, *messages) -> Iterator[tuple[Detections, ImageAnnotations]]:
    step = DetectorStep(mission)
    for message in messages:
        answer = list(step.step(message))
        if answer:
            detections, annotations = answer
            assert isinstance(detections, Detections)
            assert isinstance(annotations, ImageAnnotations)
            yield detections, annotations


@pytest.mark.parametrize("kind", ["png", "jpeg"])
def test_finds_the_marker_where_it_is(kind):
    ((found, _),) = run(FLAT, calibration(), frame(picture(), kind))
    assert (found.camera, found.width_px, found.height_px) == ("nav", 640, 480)
    assert found.t_capture_ns == T_CAPTURE_NS
    (detection,) = found.detections
    assert detection.marker_id == MARKER_ID
    assert detection.T_cam_marker is not None
    assert pose_matrix(detection.T_cam_marker) == pytest.approx(T_CAM_MARKER, abs=0.02)


def test_a_frame_without_a_marker_has_an_answer_too():
    ((found, annotations),) = run(FLAT, calibration(), frame(np.full((480, 640), 60, np.uint8)))
    assert found.detections == []
    assert len(annotations.points) == len(annotations.texts) == 0
    assert annotations.timestamp.ToNanoseconds() == T_CAPTURE_NS


def test_before_the_calibration_markers_are_found_without_poses():
    (before, _), (after, _) = run(FLAT, frame(picture()), calibration(), frame(picture()))
    assert [d.marker_id for d in before.detections] == [d.marker_id for d in after.detections] == [MARKER_ID]
    assert before.detections[0].T_cam_marker is None
    assert before.detections[0].covariance is None
    assert after.detections[0].T_cam_marker is not None


def test_annotations_are_one_loop_a_layer_and_the_id():
    ((found, annotations),) = run(FLAT, calibration(), frame(picture()))
    (detection,) = found.detections
    loops = [p for p in annotations.points if p.type == PointsAnnotation.LINE_LOOP]
    assert len(loops) == len(detection.layers) > 0
    for loop, seen in zip(loops, detection.layers, strict=True):
        assert np.array([(p.x, p.y) for p in loop.points]) == pytest.approx(points_array(seen.corners_px))
        assert loop.timestamp == annotations.timestamp
    assert [text.text for text in annotations.texts] == [str(MARKER_ID)]


def test_a_curved_print_is_shown_with_its_grid():
    ((found, annotations),) = run(CURVED, calibration(), frame(picture(Cylinder(RADIUS_M))))
    (grid,) = (d.warp_grid for d in found.detections)
    assert grid is not None
    (lines,) = (p for p in annotations.points if p.type == PointsAnnotation.LINE_LIST)
    assert len(lines.points) == 2 * (grid.rows * (grid.columns - 1) + grid.columns * (grid.rows - 1))


@pytest.mark.parametrize("data", [b"", b"not an image", cv2.imencode(".jpg", picture())[1].tobytes()[:4000]])
def test_a_damaged_image_is_refused_and_the_next_one_is_not(data):
    step = DetectorStep(FLAT)
    with pytest.raises(ValueError, match=f"{len(data)} bytes are not a whole image"):
        step.step(CompressedImage(format="jpeg", data=data))
    found = next(iter(step.step(frame(picture()))))
    assert len(found.detections) == 1


def test_a_frame_of_another_size_than_the_calibration_is_refused():
    step = DetectorStep(FLAT)
    step.step(calibration())
    with pytest.raises(ValueError, match="the calibration is for 640x480, the images are 320x240"):
        step.step(frame(cv2.resize(picture(), (320, 240))))


def test_the_same_frames_give_the_same_bytes():
    """Nothing that depends on the clock is in the answer, also while tracking."""
    moved = [picture(T_cam_marker=pose(T_CAM_MARKER[:3, :3], (0.01 + 1e-3 * k, -0.02, 0.45))) for k in range(4)]
    frames = [frame(image, t_capture_ns=T_CAPTURE_NS + k * 50_000_000) for k, image in enumerate(moved)]
    first, second = (
        [encode(message) for answer in run(FLAT, calibration(), *frames) for message in answer] for _ in range(2)
    )
    assert first == second


def test_an_unknown_dictionary_is_refused_at_once():
    with pytest.raises(ValueError, match="unknown dictionary 'tag36h11'"):
        DetectorStep(Mission(dictionary="tag36h11"))
