"""A small recording for the tests of the nodes, and runs of it: a flat marker comes in, in pictures cheap to make."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import cv2
import numpy as np
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from numpy.typing import NDArray

from astratag.camera import Camera
from astratag.dictionary import load_dictionary
from astratag.transforms import exp_so3, pose
from nodes.bus import Link, free_endpoint
from nodes.processes import PROCESSES
from nodes.supervisor import Plan
from pipeline.convert import calibration_message, pose_message, vector_message
from pipeline.mission import MarkerSection, Mission
from pipeline.recording import RecordingWriter
from pipeline.render import render_marker
from schemas import Envelope, Stamp, Truth
from schemas.codec import AnyMessage

START_NS = 1_800_000_000_000_000_000
PERIOD_NS = 50_000_000
MISSION = Mission(markers=(MarkerSection(id=7, side_m=0.1),))
CAMERA = Camera([[600, 0, 319.5], [0, 600, 179.5], [0, 0, 1]], width=640, height=360)
SPEED_M_S = 0.1
"""Of the approach; the marker turns slowly, RATE_RAD_S, as it comes."""
RATE_RAD_S = np.array([0.0, 0.0, 0.05])


def marker_pose(range_m: float, t_s: float) -> NDArray[np.float64]:
    """Return T_cam_marker."""
    R_cam_marker = exp_so3((np.pi, 0, 0)) @ exp_so3((0.3, 0.2, 0.0)) @ exp_so3(RATE_RAD_S * t_s)
    return pose(R_cam_marker, (0.01, -0.01, range_m))


@cache
def picture(range_m: float, t_s: float) -> bytes:
    """Return the JPEG of one frame; rendered once for all tests of a session."""
    signature = load_dictionary("astratag20").signature(7)
    image = render_marker(CAMERA, marker_pose(range_m, t_s), signature=signature, side_m=0.1, samples=2)
    return cv2.imencode(".jpg", image)[1].tobytes()


def write_small_recording(path: Path, *, frames: int) -> Path:
    """Write ``frames`` frames at 20 Hz, ending 0.3 m from the marker."""
    with RecordingWriter(path, MISSION) as writer:

        def write(message: AnyMessage, k: int) -> None:
            stamp = Stamp(k, START_NS + k * PERIOD_NS, 0)
            writer.write(Envelope.wrap(message, stamp, vehicle="chaser", camera="nav"), stamp.t_capture_ns)

        write(calibration_message(CAMERA, frame_id="nav", t_capture_ns=START_NS), 0)
        for k in range(frames):
            t_s = k * PERIOD_NS * 1e-9
            range_m = 0.3 + SPEED_M_S * (frames * PERIOD_NS * 1e-9 - t_s)
            truth = Truth(
                t_capture_ns=START_NS + k * PERIOD_NS,
                T_chaser_target=pose_message(marker_pose(range_m, t_s)),
                v_chaser_target_m_s=vector_message((0, 0, -SPEED_M_S)),
                omega_chaser_target_in_target_rad_s=vector_message(RATE_RAD_S),
            )
            write(truth, k)
            frame = CompressedImage(frame_id="nav", format="jpeg", data=picture(range_m, t_s))
            frame.timestamp.FromNanoseconds(START_NS + k * PERIOD_NS)
            write(frame, k)
    return path


def plan(recording: Path, out: Path, *, lossless: bool, speed: str = "1", viewer: bool = False) -> Plan:
    """Return the plan of a run of the recording into ``out``."""
    out.mkdir(parents=True, exist_ok=True)
    mission_path = out / "mission.json"
    mission_path.write_text(MISSION.to_json())
    endpoint = free_endpoint()
    return Plan(
        processes=tuple(process for process in PROCESSES if process.required or viewer),
        arguments={
            "source": ["--source", str(recording), "--speed", speed],
            "recorder": ["--out", str(out)],
            "viewer": ["--out", str(out)],
        },
        node_link=Link(endpoint, "peer"),
        own_link=Link(endpoint, "hub"),
        vehicle=MISSION.vehicle,
        lossless=lossless,
        mission_path=str(mission_path),
    )
