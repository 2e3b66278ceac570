"""Offline detection over images, folders, videos and recordings: the JSON that others script against."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage

from astratag.camera import Camera
from astratag.dictionary import load_dictionary
from astratag.transforms import exp_so3, pose
from pipeline.convert import calibration_message
from pipeline.detect import detect_paths
from pipeline.mission import MarkerSection, Mission
from pipeline.recording import RecordingWriter
from pipeline.render import render_marker
from schemas import Envelope, Stamp

CAMERA = Camera([[500, 0, 199.5], [0, 500, 149.5], [0, 0, 1]], width=400, height=300)
MARKER_ID = 4
SIDE_M = 0.2
RANGE_M = 0.7
T_CAM_MARKER = pose(exp_so3((np.pi, 0, 0)) @ exp_so3((0.3, 0.2, 0.1)), (0, 0, RANGE_M))
KEYS = "family marker_id corners_px layers correlation hamming method T_cam_marker covariance reprojection_rms_px"


@pytest.fixture(scope="module")
def image() -> np.ndarray:
    signature = load_dictionary().signature(MARKER_ID)
    return render_marker(CAMERA, T_CAM_MARKER, signature=signature, side_m=SIDE_M, seed=2)


@pytest.fixture
def camera_file(tmp_path: Path) -> Path:
    path = tmp_path / "camera.yaml"
    K = {"rows": 3, "cols": 3, "data": CAMERA.K.ravel().tolist()}
    path.write_text(json.dumps({"image_width": 400, "image_height": 300, "camera_matrix": K}))
    return path


@pytest.fixture
def folder(tmp_path: Path, image: np.ndarray) -> Path:
    folder = tmp_path / "frames"
    folder.mkdir()
    for k in (10, 2):
        cv2.imwrite(str(folder / f"frame_{k}.png"), image)
    (folder / "notes.txt").write_text("not an image, not meant as one")
    return folder


def range_m(entry: dict) -> float:
    return float(np.linalg.norm(entry["detections"][0]["T_cam_marker"]["translation_m"]))


def write_recording(path: Path, image: np.ndarray, mission: Mission, *, calibrated: bool = True) -> Path:
    with RecordingWriter(path, mission) as writer:
        if calibrated:
            message = calibration_message(CAMERA, frame_id="nav", t_capture_ns=1)
            writer.write(Envelope.wrap(message, Stamp(0, 1, 0), vehicle="chaser", camera="nav"), 1)
        for k in range(3):
            frame = CompressedImage(frame_id="nav", format="jpeg", data=cv2.imencode(".jpg", image)[1].tobytes())
            writer.write(Envelope.wrap(frame, Stamp(k, k + 1, 0), vehicle="chaser", camera="nav"), k + 1)
    return path


def test_json_of_one_image(folder: Path, camera_file: Path):
    path = folder / "frame_2.png"
    answer = detect_paths([path], side_m=SIDE_M, camera_path=camera_file)
    assert json.loads(json.dumps(answer)) == answer
    assert answer["skipped"] == []
    (entry,) = answer["images"]
    assert entry.keys() == {"path", "width", "height", "seconds", "detections"}
    assert (entry["path"], entry["width"], entry["height"]) == (str(path), 400, 300)
    assert entry["seconds"] > 0
    (found,) = entry["detections"]
    assert found.keys() == set(KEYS.split())
    assert (found["family"], found["marker_id"], found["hamming"]) == ("astratag20", MARKER_ID, 0)
    assert np.shape(found["corners_px"]) == (4, 2)
    assert found["layers"][0]["layer"] == 0
    assert all(np.shape(layer["corners_px"]) == (4, 2) for layer in found["layers"])
    assert np.shape(found["covariance"]) == (6, 6)
    assert found["T_cam_marker"]["translation_m"] == pytest.approx([0, 0, RANGE_M], abs=0.01)
    assert np.linalg.norm(found["T_cam_marker"]["rotation_wxyz"]) == pytest.approx(1)


def test_without_a_camera_there_is_no_pose(folder: Path):
    for entry in detect_paths([folder])["images"]:
        assert entry["detections"][0]["marker_id"] == MARKER_ID
        assert entry["detections"][0]["T_cam_marker"] is None
        assert entry["detections"][0]["covariance"] is None


def test_the_side_scales_the_pose(folder: Path, camera_file: Path):
    """The default side is 0.1 m, half of this marker's."""
    (halved, _) = detect_paths([folder], camera_path=camera_file)["images"]
    assert range_m(halved) == pytest.approx(RANGE_M / 2, rel=0.01)


def test_a_broken_image_is_skipped_and_counted(folder: Path):
    whole = (folder / "frame_2.png").read_bytes()
    (folder / "frame_1.png").write_bytes(whole[: len(whole) // 2])
    (folder / "frame_3.jpg").write_bytes(b"")
    seen = []
    answer = detect_paths([folder], on_progress=seen.append)
    assert [Path(entry["path"]).name for entry in answer["images"]] == ["frame_2.png", "frame_10.png"]
    assert [Path(skip["path"]).name for skip in answer["skipped"]] == ["frame_1.png", "frame_3.jpg"]
    assert all("not a whole image" in skip["reason"] for skip in answer["skipped"])
    assert seen == answer["images"]


def test_nothing_readable_is_an_error(tmp_path: Path):
    (tmp_path / "a.png").write_bytes(b"broken")
    (tmp_path / "b.jpg").write_bytes(b"broken too")
    with pytest.raises(ValueError, match=r"no image could be read in .*a\.png: 6 bytes are not a whole image.*1 more$"):
        detect_paths([tmp_path])
    with pytest.raises(ValueError, match="no image could be read in no path at all"):
        detect_paths([])


def test_a_path_that_does_not_exist_is_an_error(tmp_path: Path):
    with pytest.raises(ValueError, match="no such file or folder"):
        detect_paths([tmp_path / "absent.png"])


def test_a_file_that_is_no_picture_is_skipped(folder: Path):
    answer = detect_paths([folder / "frame_2.png", folder / "notes.txt"])
    assert [Path(skip["path"]).name for skip in answer["skipped"]] == ["notes.txt"]


def test_an_unknown_dictionary_is_an_error(folder: Path):
    with pytest.raises(ValueError, match="unknown dictionary 'tag36h11'"):
        detect_paths([folder], dictionary="tag36h11")


def test_a_camera_of_another_size_is_refused_unless_scaled(tmp_path: Path, image: np.ndarray, camera_file: Path):
    larger = tmp_path / "larger.png"
    cv2.imwrite(str(larger), cv2.resize(image, (800, 600), interpolation=cv2.INTER_LINEAR))
    with pytest.raises(ValueError, match=r"larger\.png: the calibration is for 400x300, the images are 800x600"):
        detect_paths([larger], camera_path=camera_file)
    (scaled,) = detect_paths([larger], side_m=SIDE_M, camera_path=camera_file, scale_camera=True)["images"]
    assert range_m(scaled) == pytest.approx(RANGE_M, rel=0.01)


def test_a_recording_brings_its_camera_and_sides(tmp_path: Path, image: np.ndarray):
    mission = Mission(markers=(MarkerSection(id=MARKER_ID, side_m=SIDE_M),))
    path = write_recording(tmp_path / "approach.mcap", image, mission)
    answer = detect_paths([path])
    assert [entry["path"] for entry in answer["images"]] == [f"{path}#{k}" for k in range(3)]
    assert range_m(answer["images"][0]) == pytest.approx(RANGE_M, rel=0.01)
    overridden = detect_paths([path], side_m=SIDE_M / 2)
    assert range_m(overridden["images"][0]) == pytest.approx(RANGE_M / 2, rel=0.01)


def test_a_recording_without_calibration_has_no_poses(tmp_path: Path, image: np.ndarray):
    path = write_recording(tmp_path / "bare.mcap", image, Mission(), calibrated=False)
    assert all(entry["detections"][0]["T_cam_marker"] is None for entry in detect_paths([path])["images"])


def test_frames_of_a_video(tmp_path: Path, image: np.ndarray):
    path = tmp_path / "approach.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 10, (400, 300))
    for _ in range(3):
        writer.write(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
    writer.release()
    images = detect_paths([path])["images"]
    assert [entry["path"] for entry in images] == [f"{path}#{k}" for k in range(3)]
    assert all(entry["detections"][0]["marker_id"] == MARKER_ID for entry in images)


def test_annotated_pictures_on_request(tmp_path: Path, folder: Path, image: np.ndarray):
    recording = write_recording(tmp_path / "approach.mcap", image, Mission())
    detect_paths([folder, recording], annotate_dir=tmp_path / "annotated")
    written = sorted(path.name for path in (tmp_path / "annotated").iterdir())
    assert written == [*(f"approach_{k:06d}.png" for k in range(3)), "frame_10.png", "frame_2.png"]
    drawn = cv2.imread(str(tmp_path / "annotated" / "frame_2.png"))
    assert drawn.shape == (300, 400, 3)
    assert np.ptp(drawn, axis=2).max() > 50


@pytest.mark.parametrize(
    ("number", "layers"), [("0000", {0}), ("0043", {0}), ("0056", {1}), ("0083", {0}), ("0086", {0}), ("0098", set())]
)
def test_real_frames(shared: Path, number: str, layers: set[int]):
    """Marker 19 with the right layers, nothing else; 0098 is a 41 px marker in dark grey that may be missed."""
    (entry,) = detect_paths([shared / "reference" / "frames" / f"frame_{number}.png"])["images"]
    assert {found["marker_id"] for found in entry["detections"]} <= {19}
    if layers:
        (found,) = entry["detections"]
        assert layers <= {layer["layer"] for layer in found["layers"]}
