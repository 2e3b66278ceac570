"""Render the shipped approach-corridor recording: ``.venv/bin/python recordings/make_corridor.py [FILE]``.

A chaser brakes from 1.5 m to 6 cm before a slowly tumbling station module with one marker.  Every picture, its truth,
the calibration and the mission go into one MCAP file.  The same seed gives the same messages, whatever the processes.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from functools import cache
from multiprocessing import get_context
from pathlib import Path

import cv2
import numpy as np
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from mockup import MODULE_RADIUS_M, sky, target
from numpy.typing import NDArray
from rich.progress import track

from astratag.camera import Camera
from astratag.dictionary import load_dictionary
from pipeline.convert import NS_PER_S, calibration_message
from pipeline.mission import CameraSection, CylinderSection, MarkerSection, Mission, PoseSection
from pipeline.recording import RecordingWriter
from pipeline.render import finer_camera, pixel_rays
from pipeline.scenario import Approach, frame_stamps_ns, truth_message
from pipeline.scene import Scene, Sun
from pipeline.sensor import Sensor
from schemas import Envelope, Stamp
from schemas.codec import AnyMessage

SEED = 20260712
START_NS = 1_783_814_400 * NS_PER_S  # 2026-07-12T00:00:00Z
FRAME_RATE_HZ = 15.0
EXPOSURE_S = 0.006
RAYS = 3
JPEG_QUALITY = 83
PROCESSES = 2

CAMERA = Camera(
    [[1002.4, 0.0, 636.2], [0.0, 1003.1, 364.1], [0.0, 0.0, 1.0]],
    (-0.082, 0.051, 0.0006, -0.0004, 0.0),
    width=1280,
    height=720,
)
APPROACH = Approach(
    duration_s=22.0, sway_rad=(0.035, 0.025), tilt_rad=(0.05, -0.07, 0.06), tumble_rad=(0.05, 0.06, 0.05)
)
"""Off the port's axis by 8.2 degrees at most: inside the mission's corridor all the way."""
MARKER_ID, SIDE_M = 7, 0.1
LOOKING_FORWARD = PoseSection(translation_m=(0.25, 0.0, 0.0), rotation_wxyz=(0.5, 0.5, 0.5, 0.5))
"""The camera in the middle of the chaser's port; its z along the chaser's x, its x to the chaser's y."""
FACE = PoseSection(translation_m=(0.0, 0.0, MODULE_RADIUS_M))
"""The marker in the middle of the target's port; the target's origin on the module's axis below it."""
MISSION = Mission(
    camera=CameraSection(T_chaser_cam=LOOKING_FORWARD),
    markers=(
        MarkerSection(
            id=MARKER_ID, side_m=SIDE_M, surface=CylinderSection(radius_m=MODULE_RADIUS_M), T_target_marker=FACE
        ),
    ),
    T_chaser_port=LOOKING_FORWARD,
    T_target_port=FACE,
)
TO_SUN_CAM = np.array([-0.30, -0.60, -0.74])
SUN_IRRADIANCE = 1.05


def main() -> None:
    """Render every frame and write the recording."""
    path = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).with_name("corridor.mcap")
    stamps_ns = frame_stamps_ns(START_NS, FRAME_RATE_HZ, round(APPROACH.duration_s * FRAME_RATE_HZ) + 1)
    with get_context("spawn").Pool(PROCESSES) as pool:
        pictures = list(track(pool.imap(jpeg, stamps_ns), description="Rendering", total=len(stamps_ns)))
    with RecordingWriter(path, MISSION) as recording:
        calibration = calibration_message(CAMERA, frame_id=MISSION.camera.name, t_capture_ns=START_NS)
        write(recording, calibration, 0, START_NS)
        for sequence, (stamp_ns, picture) in enumerate(zip(stamps_ns, pictures, strict=True)):
            for message in frame_messages(stamp_ns, picture):
                write(recording, message, sequence, stamp_ns)
    print(f"{path}: {len(stamps_ns)} frames, {path.stat().st_size / 2**20:.1f} MiB")


def write(recording: RecordingWriter, message: AnyMessage, sequence: int, stamp_ns: int) -> None:
    """Write one message as if it had arrived at mid-exposure."""
    stamp = Stamp(sequence=sequence, t_capture_ns=stamp_ns, t_origin_ns=stamp_ns)
    recording.write(Envelope.wrap(message, stamp, vehicle=MISSION.vehicle, camera=MISSION.camera.name), stamp_ns)


def frame_messages(stamp_ns: int, picture: bytes) -> Iterator[AnyMessage]:
    """Yield the truth of an instant, then the picture."""
    marker = MISSION.markers[0]
    yield truth_message(
        APPROACH.at((stamp_ns - START_NS) / NS_PER_S),
        T_chaser_cam=MISSION.camera.T_chaser_cam.matrix(),
        T_target_marker=marker.T_target_marker.matrix(),
        t_capture_ns=stamp_ns,
    )
    image = CompressedImage(frame_id=MISSION.camera.name, data=picture, format="jpeg")
    image.timestamp.FromNanoseconds(stamp_ns)
    yield image


def jpeg(stamp_ns: int) -> bytes:
    """Return the camera's picture, mid-exposure at ``stamp_ns``."""
    encoded, data = cv2.imencode(
        ".jpg",
        cv2.cvtColor(picture(stamp_ns), cv2.COLOR_RGB2BGR),
        [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY, cv2.IMWRITE_JPEG_OPTIMIZE, 1],
    )
    assert encoded
    return data.tobytes()


def picture(stamp_ns: int) -> NDArray[np.uint8]:
    """Return the camera's picture (height, width, 3), RGB, mid-exposure at ``stamp_ns``."""
    middle_s = (stamp_ns - START_NS) / NS_PER_S
    instants_s = middle_s + EXPOSURE_S * ((np.arange(RAYS) + 0.5) / RAYS - 0.5)
    light = scene().light(finer_camera(CAMERA), [APPROACH.at(float(t_s)).T_a_b for t_s in instants_s])
    range_m = APPROACH.at(middle_s).T_a_b[2, 3]
    return Sensor().expose(light, CAMERA, range_m=range_m, rng=np.random.default_rng((SEED, stamp_ns - START_NS)))


@cache
def scene() -> Scene:
    """Return the scene, built once a process."""
    cv2.setNumThreads(1)
    fine = finer_camera(CAMERA)
    pixel_rays(fine)
    rng = np.random.default_rng(SEED)
    bodies = target(load_dictionary(MISSION.dictionary).signature(MARKER_ID), SIDE_M, rng)
    behind = cv2.resize(sky(CAMERA, rng), (fine.width, fine.height), interpolation=cv2.INTER_LINEAR)
    return Scene(bodies, Sun(TO_SUN_CAM / np.linalg.norm(TO_SUN_CAM), SUN_IRRADIANCE), behind)


if __name__ == "__main__":
    main()
