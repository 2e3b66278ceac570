"""Two more approaches than the shipped one, rendered by the same simulated camera: other markers, other light.

A plain dark wall behind the markers, one sun, noise, blur, glow and JPEG as in ``recordings/make_corridor.py``.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from numpy.typing import NDArray
from rich.progress import track

from astratag.camera import Camera
from astratag.dictionary import load_dictionary
from astratag.surface import Cylinder
from astratag.transforms import exp_so3, inverse, pose
from pipeline.bodies import Body, Material, Plate, Print, Tube
from pipeline.convert import NS_PER_S, calibration_message
from pipeline.mapping.estimate import pose_section
from pipeline.mission import CameraSection, CylinderSection, MarkerSection, Mission, PoseSection
from pipeline.recording import RecordingWriter
from pipeline.render import finer_camera
from pipeline.scenario import Approach, frame_stamps_ns, truth_message
from pipeline.scene import Scene, Sun
from pipeline.sensor import Sensor
from pipeline.texture import print_texture
from schemas import Envelope, Stamp
from schemas.codec import AnyMessage

Array = NDArray[np.float64]

START_NS = 1_783_814_400 * NS_PER_S  # 2026-07-12T00:00:00Z, as the shipped recording
EXPOSURE_S = 0.006
RAYS = 3
JPEG_QUALITY = 85
WALL = Material((0.10, 0.10, 0.11), gloss=0.02)
PAINT = Material((0.30, 0.30, 0.28), gloss=0.03)
WALL_M = 0.6
CAMERA = Camera(
    [[1002.4, 0.0, 636.2], [0.0, 1003.1, 364.1], [0.0, 0.0, 1.0]],
    (-0.082, 0.051, 0.0006, -0.0004, 0.0),
    width=1280,
    height=720,
)
LOOKING_FORWARD = PoseSection(translation_m=(0.25, 0.0, 0.0), rotation_wxyz=(0.5, 0.5, 0.5, 0.5))


@dataclass(frozen=True)
class Corridor:
    """An approach to a target: ``approach`` is the motion of the first marker past the camera."""

    name: str
    mission: Mission
    approach: Approach
    to_sun_cam: tuple[float, float, float]
    irradiance: float
    rate_hz: float
    seed: int


def _mission(*markers: MarkerSection) -> Mission:
    return Mission(camera=CameraSection(T_chaser_cam=LOOKING_FORWARD), markers=markers, T_chaser_port=LOOKING_FORWARD)


TILTED = Corridor(
    name="flat, tilted 15 degrees",
    mission=_mission(MarkerSection(id=12, side_m=0.1)),
    approach=Approach(
        duration_s=22.0,
        start_m=1.3,
        end_m=0.15,
        end_speed_m_s=0.02,
        sway_rad=(0.03, 0.02),
        tilt_rad=(0.26, 0.03, -0.2),
        tumble_rad=(0.05, 0.06, 0.05),
    ),
    to_sun_cam=(0.75, -0.25, -0.45),
    irradiance=0.8,
    rate_hz=5.0,
    seed=1,
)
BUNDLE = Corridor(
    name="three markers",
    mission=_mission(
        MarkerSection(id=7, side_m=0.1, T_target_marker=PoseSection(translation_m=(0.0, 0.0, 0.10))),
        MarkerSection(
            id=3, side_m=0.06, T_target_marker=pose_section(pose(exp_so3([0, -0.35, 0]), [-0.15, 0.01, 0.08]))
        ),
        MarkerSection(
            id=11,
            side_m=0.08,
            surface=CylinderSection(radius_m=0.15),
            T_target_marker=pose_section(pose(exp_so3([0, 0.3, 0]), [0.17, -0.01, 0.07])),
        ),
    ),
    approach=Approach(
        duration_s=22.0,
        start_m=1.4,
        end_m=0.2,
        end_speed_m_s=0.02,
        sway_rad=(0.02, 0.02),
        tilt_rad=(0.03, -0.05, 0.06),
        tumble_rad=(0.05, 0.06, 0.05),
    ),
    to_sun_cam=(-0.2, 0.5, -0.8),
    irradiance=1.0,
    rate_hz=5.0,
    seed=2,
)
RENDERED = (TILTED, BUNDLE)


def render(corridor: Corridor, path: Path) -> Path:
    """Render a corridor into a recording with truth, and return its path.  The same seed gives the same messages."""
    cv2.setNumThreads(1)
    mission, scene = corridor.mission, scene_of(corridor)
    T_target_marker = mission.markers[0].T_target_marker.matrix()
    stamps_ns = frame_stamps_ns(START_NS, corridor.rate_hz, round(corridor.approach.duration_s * corridor.rate_hz) + 1)
    path.parent.mkdir(parents=True, exist_ok=True)
    with RecordingWriter(path, mission) as recording:

        def write(message: AnyMessage, sequence: int, t_ns: int) -> None:
            envelope = Envelope.wrap(message, Stamp(sequence, t_ns, t_ns), vehicle="chaser", camera=mission.camera.name)
            recording.write(envelope, t_ns)

        write(calibration_message(CAMERA, frame_id=mission.camera.name, t_capture_ns=START_NS), 0, START_NS)
        for sequence, t_ns in enumerate(track(stamps_ns, description=f"Rendering {corridor.name}")):
            t_s = (t_ns - START_NS) / NS_PER_S
            motion = corridor.approach.at(t_s)
            T_chaser_cam = mission.camera.T_chaser_cam.matrix()
            truth = truth_message(motion, T_chaser_cam=T_chaser_cam, T_target_marker=T_target_marker, t_capture_ns=t_ns)
            write(truth, sequence, t_ns)
            image = CompressedImage(frame_id=mission.camera.name, data=picture_at(corridor, scene, t_s), format="jpeg")
            image.timestamp.FromNanoseconds(t_ns)
            write(image, sequence, t_ns)
    return path


def picture_at(corridor: Corridor, scene: Scene, t_s: float) -> bytes:
    """Return the picture taken with mid-exposure at ``t_s``."""
    T_marker_target = inverse(corridor.mission.markers[0].T_target_marker.matrix())
    instants_s = t_s + EXPOSURE_S * ((np.arange(RAYS) + 0.5) / RAYS - 0.5)
    poses = [corridor.approach.at(float(t)).T_a_b @ T_marker_target for t in instants_s]
    light = scene.light(finer_camera(CAMERA), poses)
    rng = np.random.default_rng((corridor.seed, round(t_s * 1e6)))
    picture = Sensor().expose(light, CAMERA, range_m=corridor.approach.at(t_s).T_a_b[2, 3], rng=rng)
    quality = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
    encoded, data = cv2.imencode(".jpg", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), quality)
    assert encoded
    return data.tobytes()


def scene_of(corridor: Corridor) -> Scene:
    """Return markers, each on a plate or a tube of its own, before a wall; scene axes are the target's."""
    dictionary = load_dictionary(corridor.mission.dictionary)
    bodies = [Body(Plate(WALL_M, WALL_M), WALL, pose(np.eye(3), [0.0, 0.0, -0.08]))]
    for marker in corridor.mission.markers:
        texture = print_texture(dictionary.signature(marker.id), marker.side_m)
        half_m, surface = texture.width_m / 2, marker.surface.surface()
        paint = Material(PAINT.albedo, PAINT.gloss, PAINT.sharpness, marker=Print(texture, half_m))
        if isinstance(surface, Cylinder):
            assert surface.axis_rad == 0.0  # a tube's axis is its x
            shape: Plate | Tube = Tube(surface.radius_m, 1.1 * half_m)
        else:
            shape = Plate(1.1 * half_m, 1.1 * half_m)
        bodies.append(Body(shape, paint, marker.T_target_marker.matrix()))
    fine = finer_camera(CAMERA)
    sky = np.zeros((fine.height, fine.width, 3), np.float32)
    to_sun = np.array(corridor.to_sun_cam)
    return Scene(bodies, Sun(to_sun / np.linalg.norm(to_sun), corridor.irradiance), sky)
