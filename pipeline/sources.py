"""Where frames come from: a recording, a video, a folder of images or a camera, all behind one interface.

A source yields the camera's calibration, then for every frame the recorded truth up to it, if any, and the frame.
Frames are numbered 0, 1, 2... as they are yielded.  The frames of videos and folders carry no time: frame k was
taken at EPOCH_NS + k / fps, so that two replays are identical.
"""

from __future__ import annotations

import re
from pathlib import Path

from pipeline.camera_device import OpenCvDevice
from pipeline.mission import Mission
from pipeline.picture_sources import IMAGE_SUFFIXES, CameraSource, FolderSource, VideoSource
from pipeline.recording import MAGIC
from pipeline.recording_source import RecordingSource
from pipeline.source import Source, SourceError, SourceOptions

__all__ = ["Source", "SourceError", "open_source"]

_DEVICE = re.compile(r"(?:v4l2:)?(?:/dev/video)?(\d+)")


def open_source(
    spec: str | Path,
    *,
    camera: Path | None = None,
    mission: Path | None = None,
    fps: float | None = None,
    scale_camera: bool = False,
) -> Source:
    """Open a recording, a video, a folder of images, an image, a camera ("v4l2:/dev/video0", "/dev/video0", "0"), a
    simulated camera ("sim", "sim:scenario.yaml") or a docking in closed loop ("dock", "dock:scenario.yaml").

    ``camera`` is a calibration file, ``mission`` a mission file; both win over recorded ones.  Raises ValueError
    with one line when the source does not exist, is empty, or cannot be read, and when the calibration is for
    another size of images, unless ``scale_camera``.
    """
    if fps is not None and not fps > 0:
        raise SourceError(f"the frame rate must be positive, got {fps}")
    options = SourceOptions(camera, mission, fps, scale_camera)
    kind, _, scenario = str(spec).partition(":")
    if kind in _SIMULATED and not Path(spec).exists():
        return _SIMULATED[kind](Path(scenario) if scenario else None, options)
    path = Path(spec)
    device = _DEVICE.fullmatch(str(spec))
    if device and not path.is_file() and not path.is_dir():
        return CameraSource(OpenCvDevice(int(device[1]), fps), options)
    if not path.exists():
        raise SourceError(f"no such recording, video, folder or camera: {spec}")
    if path.is_dir():
        paths = sorted((p for p in path.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES), key=natural_order)
        if not paths:
            raise SourceError(f"folder {path} has no images ({', '.join(IMAGE_SUFFIXES)})")
        return FolderSource(paths, options)
    if path.suffix.lower() in IMAGE_SUFFIXES:
        return FolderSource([path], options)
    if path.suffix.lower() == ".mcap" or _begins_like_mcap(path):
        return RecordingSource(path, options)
    return VideoSource(path, options)


def _simulated_camera(scenario: Path | None, options: SourceOptions) -> Source:
    from pipeline.sim_source import SimScenario, SimSource

    options.refuse("the scenario of a simulated camera holds it", camera=options.camera)
    seen = SimScenario() if scenario is None else SimScenario.load(scenario)
    if options.mission is not None:
        seen = SimScenario.model_validate({**dict(seen), "mission": Mission.load(options.mission)})
    return SimSource(seen, fps=options.fps)


def _docking(scenario: Path | None, options: SourceOptions) -> Source:
    from pipeline.dock import DockSource
    from pipeline.dock_scenario import DockScenario

    options.refuse("the scenario of a docking holds it", camera=options.camera, fps=options.fps)
    return DockSource(DockScenario() if scenario is None else DockScenario.load(scenario))


_SIMULATED = {"sim": _simulated_camera, "dock": _docking}


def _begins_like_mcap(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            return file.read(len(MAGIC)) == MAGIC
    except OSError as error:
        raise SourceError(f"cannot read {path}: {error.strerror}") from error


def natural_order(path: Path) -> list[tuple[int, str]]:
    """Return a sorting key under which numbers in a name count as numbers."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", path.name)]
