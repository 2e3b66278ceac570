"""A few frames with everything a run records, made without the detector or the filter: quick material for tests."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import cv2
import numpy as np
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.Log_pb2 import Log

from astratag.camera import Camera
from pipeline.convert import calibration_message, pose_message, vector_message
from pipeline.mission import Mission
from pipeline.recording import RecordingWriter
from schemas import Detections, Envelope, Mode, RelativeState, Stamp, Truth
from schemas.codec import AnyMessage

CAMERA = Camera([[120, 0, 79.5], [0, 120, 59.5], [0, 0, 1]], width=160, height=120)
MISSION = Mission(vehicle="probe", default_side_m=0.07)
START_NS = 1_700_000_000_000_000_000
PERIOD_NS = 50_000_000


def picture(k: int) -> bytes:
    """Return frame k as JPEG: noise, so that it does not compress away."""
    return cv2.imencode(".jpg", np.random.default_rng(k).integers(0, 255, (120, 160), dtype=np.uint8))[1].tobytes()


def wrap(message: AnyMessage, stamp: Stamp) -> Envelope:
    return Envelope.wrap(message, stamp, vehicle=MISSION.vehicle, camera=MISSION.camera.name)


def image_message(k: int) -> CompressedImage:
    message = CompressedImage(frame_id="nav", format="jpeg", data=picture(k))
    message.timestamp.FromNanoseconds(START_NS + k * PERIOD_NS)
    return message


def run_envelopes(frames: int) -> Iterator[tuple[Envelope, int]]:
    """Yield envelopes and their times of receipt: calibration, then truth, frame, detections, state, an event."""
    first = Stamp(0, START_NS, START_NS)
    yield wrap(calibration_message(CAMERA, frame_id="nav", t_capture_ns=START_NS), first), START_NS
    for k in range(frames):
        t_ns = START_NS + k * PERIOD_NS
        stamp = Stamp(k, t_ns, t_ns + 1_000)
        T_chaser_target = np.eye(4)
        T_chaser_target[2, 3] = 1.5 - 0.01 * k
        truth = Truth(
            t_capture_ns=t_ns,
            T_chaser_target=pose_message(T_chaser_target),
            v_chaser_target_m_s=vector_message((0, 0, -0.2)),
            omega_chaser_target_in_target_rad_s=vector_message((0, 0, 0)),
        )
        messages = (
            truth,
            image_message(k),
            Detections(t_capture_ns=t_ns, camera="nav", width_px=160, height_px=120, detections=[]),
            RelativeState(t_capture_ns=t_ns, mode=Mode.COAST, T_chaser_target=truth.T_chaser_target, age_s=0.1 * k),
        )
        for order, message in enumerate(messages):
            yield wrap(message, stamp), t_ns + 2_000 + order
    yield wrap(Log(level=Log.INFO, message="end"), stamp), t_ns + 3_000


def write_run(path: Path, envelopes: Iterable[tuple[Envelope, int]], *, flush_every: int = 20) -> Path:
    """Record envelopes, closing a chunk every few messages as a flush does."""
    with RecordingWriter(path, MISSION) as writer:
        for number, (envelope, t_receipt_ns) in enumerate(envelopes, start=1):
            writer.write(envelope, t_receipt_ns)
            if number % flush_every == 0:
                writer.flush()
    return path
