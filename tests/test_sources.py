"""Sources: every kind gives calibration, truth and frames in order, and refuses what it cannot use in one line."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage

from astratag.camera import Camera
from pipeline.camera_device import Grabbed, OpenCvDevice, capture_time_ns
from pipeline.convert import calibration_message, camera_from_calibration
from pipeline.mission import CameraSection, Mission
from pipeline.picture_sources import EPOCH_NS, CameraSource, assumed_camera
from pipeline.recording import RecordingError
from pipeline.source import SourceError, SourceOptions
from pipeline.sources import Source, natural_order, open_source
from schemas import Envelope, Stamp, decode
from schemas.topics import CALIBRATION, FRAME, TRUTH
from tests.small_run import CAMERA, MISSION, PERIOD_NS, START_NS, run_envelopes, wrap, write_run

CAMERA_YAML = """\
image_width: {width}
image_height: {height}
camera_matrix: {{rows: 3, cols: 3, data: [200, 0, 99.5, 0, 200, 74.5, 0, 0, 1]}}
distortion_model: plumb_bob
distortion_coefficients: {{rows: 1, cols: 5, data: [0.1, 0, 0, 0, 0]}}
"""


def frames_of(source: Source) -> list[Envelope]:
    return [envelope for envelope in source.envelopes() if envelope.topic is FRAME]


def camera_file(folder: Path, width: int, height: int) -> Path:
    path = folder / "camera.yaml"
    path.write_text(CAMERA_YAML.format(width=width, height=height))
    return path


def gray(k: int, width: int = 160, height: int = 120) -> np.ndarray:
    return cv2.GaussianBlur(np.random.default_rng(k).integers(0, 255, (height, width), dtype=np.uint8), (0, 0), 2)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Twelve PNG files whose names do not sort as text, and a file that is no image."""
    folder = tmp_path / "frames"
    folder.mkdir()
    for k in range(12):
        cv2.imwrite(str(folder / f"frame_{k}.png"), gray(k))
    (folder / "notes.txt").write_text("not an image")
    return folder


@pytest.fixture
def recorded(tmp_path: Path) -> Callable[..., Path]:
    """Record a small run, its envelopes changed or left out (None) by a function."""

    def record(change: Callable[[Envelope], Envelope | None] = lambda envelope: envelope) -> Path:
        kept = ((change(envelope), t_ns) for envelope, t_ns in run_envelopes(10))
        return write_run(tmp_path / "run.mcap", ((e, t_ns) for e, t_ns in kept if e is not None))

    return record


# A recording


def test_a_recording_passes_through_byte_for_byte(recorded) -> None:
    source = open_source(recorded())
    wanted = [e for e, _ in run_envelopes(10) if e.topic in (CALIBRATION, TRUTH, FRAME)]
    got = list(source.envelopes())
    assert [(e.key, e.payload) for e in got] == [(e.key, e.payload) for e in wanted]
    assert [e.stamp for e in got] == [replace(e.stamp, t_origin_ns=0) for e in wanted]
    assert (source.mission, source.frame_count, source.live, source.warnings) == (MISSION, 10, False, [])
    assert camera_from_calibration(source.calibration).K.tolist() == CAMERA.K.tolist()


def test_calibration_comes_first_wherever_it_was_recorded(recorded, tmp_path: Path) -> None:
    first, *rest = run_envelopes(4)
    late = write_run(tmp_path / "late.mcap", [*rest[:6], first, *rest[6:]])
    topics = [e.topic for e in open_source(late).envelopes()]
    assert topics == [CALIBRATION] + [TRUTH, FRAME] * 4


def test_a_calibration_that_changes_is_passed_on_in_its_place(tmp_path: Path) -> None:
    rows = list(run_envelopes(4))
    zoomed = Camera([[240, 0, 79.5], [0, 240, 59.5], [0, 0, 1]], width=160, height=120)
    calibration = calibration_message(zoomed, frame_id="nav", t_capture_ns=START_NS)
    rows.insert(9, (wrap(calibration, Stamp(2, START_NS, 0)), START_NS))
    got = list(open_source(write_run(tmp_path / "run.mcap", rows)).envelopes())
    assert [e.topic.name[0] for e in got] == list("ctftfctftf")


def test_frames_are_numbered_from_zero_whatever_was_lost(recorded) -> None:
    """Frames 3 and 4 were never recorded: the others keep their times, and truth goes with the next frame."""
    source = open_source(recorded(lambda e: None if e.topic is FRAME and e.stamp.sequence in (3, 4) else e))
    frames = frames_of(source)
    assert [e.stamp.sequence for e in frames] == list(range(8))
    assert [(e.stamp.t_capture_ns - START_NS) // PERIOD_NS for e in frames] == [0, 1, 2, 5, 6, 7, 8, 9]
    truths = [e for e in source.envelopes() if e.topic is TRUTH]
    assert [e.stamp.sequence for e in truths] == [0, 1, 2, 3, 3, 3, 4, 5, 6, 7]


def test_truth_recorded_after_its_frame_comes_before_it(tmp_path: Path) -> None:
    rows = sorted(run_envelopes(5), key=lambda row: (row[0].stamp.sequence, row[0].topic is TRUTH))
    got = list(open_source(write_run(tmp_path / "run.mcap", rows)).envelopes())
    assert [e.topic for e in got] == [CALIBRATION] + [TRUTH, FRAME] * 5


def test_stamps_that_go_backwards_keep_file_order_and_are_counted(recorded) -> None:
    def jump(e: Envelope) -> Envelope:
        back_ns = 3 * PERIOD_NS if e.stamp.sequence in (4, 8) else 0
        return replace(e, stamp=replace(e.stamp, t_capture_ns=e.stamp.t_capture_ns - back_ns))

    source = open_source(recorded(jump))
    times = [(e.stamp.t_capture_ns - START_NS) // PERIOD_NS for e in frames_of(source)]
    assert times == [0, 1, 2, 3, 1, 5, 6, 7, 5, 9]
    assert source.backwards == 2
    assert source.warnings == ["2 frames were captured before their predecessor"]


def test_a_mission_file_wins_and_renames_the_topics(recorded, tmp_path: Path) -> None:
    mission = Mission(vehicle="other", camera=CameraSection(name="aft"))
    (tmp_path / "mission.json").write_text(mission.to_json())
    source = open_source(recorded(), mission=tmp_path / "mission.json")
    assert source.mission == mission
    keys = {"relnav/other/camera/aft/calibration", "relnav/other/camera/aft/frame", "relnav/other/truth"}
    assert {e.key for e in source.envelopes()} == keys


def test_a_camera_file_wins_over_the_recorded_calibration(recorded, tmp_path: Path) -> None:
    source = open_source(recorded(), camera=camera_file(tmp_path, 160, 120))
    assert source.calibration.K[0] == 200
    sent = [decode(CameraCalibration, e.payload) for e in source.envelopes() if e.topic is CALIBRATION]
    assert sent == [source.calibration]


def test_the_mission_names_one_camera_of_several(tmp_path: Path) -> None:
    rows = list(run_envelopes(3))
    for envelope, t_ns in run_envelopes(3):
        if envelope.topic in (FRAME, CALIBRATION):
            rows.append((replace(envelope, key=envelope.key.replace("/nav/", "/aft/")), t_ns))
    run = write_run(tmp_path / "run.mcap", rows)
    source = open_source(run)
    assert (source.frame_count, len(frames_of(source))) == (3, 3)
    (tmp_path / "m.json").write_text(Mission(camera=CameraSection(name="bow")).to_json())
    with pytest.raises(RecordingError, match=r"several cameras \(.*nav/frame.*aft/frame\)"):
        open_source(run, mission=tmp_path / "m.json")


def test_a_damaged_frame_passes_on_to_be_counted_by_the_detector(recorded) -> None:
    def damage(e: Envelope) -> Envelope:
        return replace(e, payload=e.payload[:40]) if e.topic is FRAME and e.stamp.sequence == 0 else e

    assert len(frames_of(open_source(recorded(damage)))) == 10


def test_recordings_that_cannot_be_replayed(recorded, tmp_path: Path) -> None:
    def refuses(reason: str, **options) -> None:
        with pytest.raises(RecordingError, match=reason) as caught:
            open_source(tmp_path / "run.mcap", **options)
        assert "\n" not in str(caught.value)

    recorded(lambda e: None if e.topic is FRAME else e)
    refuses("no camera frames: expected relnav/probe/camera/nav/frame or one topic of foxglove images, found relnav")
    recorded(lambda e: None)
    refuses("found no topic")
    recorded(lambda e: None if e.topic is CALIBRATION else e)
    refuses("has no camera calibration: give one with --camera FILE")
    assert open_source(tmp_path / "run.mcap", camera=camera_file(tmp_path, 160, 120)).frame_count == 10
    recorded(lambda e: replace(e, payload=b"") if e.topic is FRAME else e)
    refuses("has no camera frame that can be decoded")
    recorded().write_bytes(recorded().read_bytes()[:-100])
    refuses("is truncated or still being written: run `relnav recover")
    fisheye = CameraCalibration(width=160, height=120, distortion_model="equidistant")
    recorded(lambda e: wrap(fisheye, e.stamp) if e.topic is CALIBRATION else e)
    refuses("equidistant")


def test_a_calibration_of_another_size_is_refused_or_scaled(recorded, folder: Path, tmp_path: Path) -> None:
    double = calibration_message(CAMERA.scaled(320, 240), frame_id="nav", t_capture_ns=START_NS)
    run = recorded(lambda e: wrap(double, e.stamp) if e.topic is CALIBRATION else e)
    with pytest.raises(ValueError, match="the calibration is for 320x240, the images are 160x120"):
        open_source(run)
    np.testing.assert_allclose(camera_from_calibration(open_source(run, scale_camera=True).calibration).K, CAMERA.K)
    camera = camera_file(tmp_path, 320, 240)
    for spec in (run, folder):
        with pytest.raises(ValueError, match="the calibration is for 320x240, the images are 160x120"):
            open_source(spec, camera=camera)
        scaled = open_source(spec, camera=camera, scale_camera=True).calibration
        assert (scaled.K[0], scaled.width, scaled.height) == (100, 160, 120)


def test_a_frame_rate_does_not_retime_a_recording(recorded) -> None:
    source = open_source(recorded(), fps=5)
    assert frames_of(source)[1].stamp.t_capture_ns == START_NS + PERIOD_NS
    assert source.warnings == ["a frame rate was given: recorded frames keep their own time stamps"]


# A folder of images


def test_a_folder_in_natural_order_with_its_bytes_as_they_are(folder: Path, tmp_path: Path) -> None:
    source = open_source(folder, camera=camera_file(tmp_path, 160, 120), fps=4)
    frames = frames_of(source)
    images = [decode(CompressedImage, e.payload) for e in frames]
    assert [image.data for image in images] == [(folder / f"frame_{k}.png").read_bytes() for k in range(12)]
    assert {(image.format, image.frame_id) for image in images} == {("png", "nav")}
    assert [e.stamp for e in frames] == [Stamp(k, EPOCH_NS + k * 250_000_000, 0) for k in range(12)]
    assert [image.timestamp.ToNanoseconds() for image in images] == [e.stamp.t_capture_ns for e in frames]
    assert (source.frame_count, source.skipped, source.warnings, source.mission) == (12, 0, [], Mission())


def test_two_replays_of_a_folder_are_identical(folder: Path) -> None:
    assert list(open_source(folder).envelopes()) == list(open_source(folder).envelopes())


def test_broken_images_are_skipped_counted_and_named(folder: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """A gap in time, none in the numbering."""
    whole = (folder / "frame_0.png").read_bytes()
    (folder / "frame_0.png").write_bytes(whole[: len(whole) // 2])
    (folder / "frame_3.png").write_bytes(b"")
    cv2.imwrite(str(folder / "frame_5.png"), gray(5, width=80))
    source = open_source(folder, fps=10)
    heard: list[str] = []
    source.on_warning = heard.append
    frames = frames_of(source)
    assert [e.stamp.sequence for e in frames] == list(range(9))
    assert [(e.stamp.t_capture_ns - EPOCH_NS) // 100_000_000 for e in frames] == [1, 2, 4, 6, 7, 8, 9, 10, 11]
    assert source.skipped == 3
    assert (
        heard
        == source.warnings[1:]
        == [
            f"skipped {folder / 'frame_0.png'}: it is not an image that can be decoded",
            f"skipped {folder / 'frame_3.png'}: it is not an image that can be decoded",
            f"skipped {folder / 'frame_5.png'}: it is 80x120, the first one 160x120",
            "3 of 12 images were skipped",
        ]
    )


@pytest.mark.parametrize(("suffix", "kind"), [(".jpg", "jpeg"), (".png", "png"), (".bmp", "png"), (".tif", "png")])
def test_other_formats_become_png_without_loss(tmp_path: Path, suffix: str, kind: str) -> None:
    path = tmp_path / f"one{suffix}"
    cv2.imwrite(str(path), gray(1))
    image = decode(CompressedImage, frames_of(open_source(path))[0].payload)
    assert image.format == kind
    stored = cv2.imdecode(np.frombuffer(image.data, np.uint8), cv2.IMREAD_GRAYSCALE)
    np.testing.assert_array_equal(stored, cv2.imread(str(path), cv2.IMREAD_GRAYSCALE))


def test_the_format_is_what_the_bytes_are_not_what_the_name_says(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "one.jpg"), gray(1))
    (tmp_path / "one.jpg").rename(tmp_path / "one.png")
    assert decode(CompressedImage, frames_of(open_source(tmp_path / "one.png"))[0].payload).format == "jpeg"


def test_without_a_calibration_a_lens_is_assumed_and_said(folder: Path) -> None:
    source = open_source(folder)
    assert len(source.warnings) == 1
    assert "not to scale" in source.warnings[0]
    edge = camera_from_calibration(source.calibration).undistort(np.array([[-0.5, 59.5], [159.5, 59.5]]))
    np.testing.assert_allclose(np.degrees(np.arctan(edge[:, 0])), (-30, 30))


def test_natural_order() -> None:
    names = ["a2", "a10", "a1", "b", "a1b", "a01", "10", "9", "a"]
    ordered = [path.name for path in sorted(map(Path, names), key=natural_order)]
    assert ordered == ["9", "10", "a", "a1", "a01", "a1b", "a2", "a10", "b"]


def test_the_reference_frames_are_a_source(shared: Path) -> None:
    source = open_source(shared / "reference" / "frames")
    assert len(frames_of(source)) == source.frame_count == 6
    assert source.skipped == 0


# A video


@pytest.fixture
def video(tmp_path: Path) -> Path:
    path = tmp_path / "video.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 25, (160, 120))
    for k in range(9):
        writer.write(cv2.cvtColor(gray(k), cv2.COLOR_GRAY2BGR))
    writer.release()
    return path


def test_a_video_frame_by_frame_at_its_own_rate(video: Path) -> None:
    source = open_source(video)
    frames = frames_of(source)
    assert [e.stamp for e in frames] == [Stamp(k, EPOCH_NS + k * 40_000_000, 0) for k in range(9)]
    images = [decode(CompressedImage, e.payload) for e in frames]
    assert {image.format for image in images} == {"jpeg"}
    for k, image in enumerate(images):
        pixels = cv2.imdecode(np.frombuffer(image.data, np.uint8), cv2.IMREAD_GRAYSCALE)
        assert np.abs(pixels.astype(int) - gray(k)).mean() < 3
    assert list(open_source(video).envelopes()) == list(source.envelopes())


def test_a_video_at_a_rate_that_the_user_knows_better(video: Path) -> None:
    assert frames_of(open_source(video, fps=100))[8].stamp.t_capture_ns == EPOCH_NS + 80_000_000


# A live camera


class FakeDevice:
    """A camera whose driver stamps frame k at 1000 + 40 k ms, handed over 7 ms later; unplugged after a while."""

    def __init__(self, frames: int):
        self._left = iter(range(frames))
        self.closed = False

    def grab(self) -> Grabbed:
        """Return the next frame."""
        k = next(self._left, None)
        if k is None:
            raise ValueError("camera stopped giving frames")
        t_ns = (1_007 + 40 * k) * 1_000_000
        image = cv2.cvtColor(gray(k), cv2.COLOR_GRAY2BGR)
        return Grabbed(image, START_NS + t_ns, t_ns, t_driver_ms=1_000 + 40.0 * k, exposure_s=0.010)

    def close(self) -> None:
        """Remember that it was given back."""
        self.closed = True


def drain(envelopes: Iterator[Envelope]) -> Iterator[Envelope]:
    with pytest.raises(ValueError, match="stopped giving frames"):
        yield from envelopes


def test_a_camera_is_live_and_stamped_at_mid_exposure() -> None:
    device = FakeDevice(5)
    source = CameraSource(device, SourceOptions())
    assert (source.live, source.frame_count) == (True, None)
    calibration, *frames = drain(source.envelopes())
    assert calibration.topic is CALIBRATION
    assert [e.stamp for e in frames] == [Stamp(k, START_NS + (1_045 + 40 * k) * 1_000_000, 0) for k in range(4)]
    assert device.closed


@pytest.mark.parametrize("t_driver_ms", [0.0, 5_000.0, -1.0], ids=["none", "older than believable", "negative"])
def test_a_driver_stamp_that_cannot_be_believed_gives_way_to_the_receipt(t_driver_ms: float) -> None:
    grabbed = Grabbed(np.zeros((2, 2, 3), np.uint8), START_NS, 9_000_000_000, t_driver_ms, exposure_s=0.01)
    assert capture_time_ns(grabbed) == START_NS
    in_the_future = replace(grabbed, t_driver_ms=9_001.0)
    assert capture_time_ns(in_the_future) == START_NS


class FakeCapture:
    """What OpenCV says of a V4L2 camera in manual exposure, 100 units of 100 us; it has two frames."""

    settings: dict[int, float]

    def __init__(self, index: int, backend: int):
        FakeCapture.settings = {}
        assert (index, backend) == (2, cv2.CAP_V4L2)
        self._left = 2

    def isOpened(self) -> bool:  # noqa: N802
        """Say yes."""
        return True

    def set(self, setting: int, value: float) -> None:
        """Remember what was asked for."""
        FakeCapture.settings[setting] = value

    def get(self, setting: int) -> float:
        """Answer."""
        return {cv2.CAP_PROP_AUTO_EXPOSURE: 1.0, cv2.CAP_PROP_EXPOSURE: 100.0, cv2.CAP_PROP_POS_MSEC: 5.5}[setting]

    def read(self) -> tuple[bool, np.ndarray | None]:
        """Return a frame, None when there are no more."""
        self._left -= 1
        return self._left >= 0, cv2.cvtColor(gray(0), cv2.COLOR_GRAY2BGR) if self._left >= 0 else None

    def release(self) -> None:
        """Do nothing."""


def test_a_v4l2_camera_by_opencv(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pipeline.camera_device.cv2.VideoCapture", FakeCapture)
    source = open_source("v4l2:/dev/video2", fps=20)
    assert isinstance(source, CameraSource)
    assert FakeCapture.settings == {cv2.CAP_PROP_BUFFERSIZE: 1, cv2.CAP_PROP_FPS: 20}
    with pytest.raises(ValueError, match=r"camera /dev/video2 stopped giving frames: was it unplugged\?"):
        frames_of(source)
    monkeypatch.setattr("pipeline.camera_device.time.time_ns", lambda: START_NS)
    monkeypatch.setattr("pipeline.camera_device.time.monotonic_ns", lambda: 9_500_000)
    grabbed = OpenCvDevice(2).grab()
    assert grabbed.exposure_s == pytest.approx(0.010)
    assert capture_time_ns(grabbed) == START_NS - 4_000_000 + 5_000_000


# What is not there


@pytest.mark.parametrize("spec", ["v4l2:/dev/video97", "/dev/video97", "97"])
def test_a_camera_that_is_not_there(spec: str, capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(ValueError, match="cannot open camera /dev/video97: is it plugged in"):
        open_source(spec)
    assert capfd.readouterr().err == ""


def test_one_line_for_each_source_that_is_none(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "a.png").write_bytes(b"no image")
    (tmp_path / "noise.mp4").write_bytes(np.random.default_rng(0).bytes(5000))
    (tmp_path / "empty.mp4").touch()
    (tmp_path / "empty.mcap").touch()
    cases = {
        "absent": "no such recording, video, folder or camera",
        "absent.mcap": "no such recording",
        "empty": r"has no images \(.png",
        "broken": "none of the 1 images in .*broken can be read",
        "noise.mp4": "not a recording, an image or a video that OpenCV reads",
        "empty.mp4": "not a recording, an image or a video that OpenCV reads",
        "empty.mcap": "is empty",
    }
    for name, reason in cases.items():
        with pytest.raises(ValueError, match=reason) as caught:
            open_source(str(tmp_path / name))
        assert "\n" not in str(caught.value)
    with pytest.raises(SourceError, match="frame rate must be positive, got 0"):
        open_source(tmp_path, fps=0)
    assert capfd.readouterr().err == ""


def test_a_recording_is_known_by_its_beginning_whatever_its_name(recorded) -> None:
    run = recorded()
    assert open_source(run.rename(run.with_suffix(".log"))).frame_count == 10


def test_assumed_camera_is_centred() -> None:
    camera = assumed_camera(1280, 720)
    assert (camera.K[0, 2], camera.K[1, 2]) == (639.5, 359.5)
