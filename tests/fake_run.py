"""A run made up message by message, with known errors: the oracle of scoring and the material of the report."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.Log_pb2 import Log
from numpy.typing import NDArray

from astratag.camera import Camera
from astratag.geometry import layer_corners_print
from astratag.transforms import exp_so3, inverse, perturb, pose, transform
from pipeline.convert import calibration_message, points_message, pose_message, vector_message
from pipeline.expected import visible_layers
from pipeline.mission import MarkerSection, Mission
from schemas import Detection, Detections, Envelope, LayerCorners, Mode, PortToPort, RelativeState, Stamp, Truth
from schemas.codec import AnyMessage

Array = NDArray[np.float64]
START_NS = 1_800_000_000_000_000_000
REPLAY_NS = 1_900_000_000_000_000_000
PERIOD_NS = 50_000_000
LATENCY_NS = 8_000_000
MARKER_ID = 7
MISSION = Mission(markers=(MarkerSection(id=MARKER_ID, side_m=0.1),))
CAMERA = Camera([[1100, 0, 639.5], [0, 1100, 359.5], [0, 0, 1]], width=1280, height=720)
FACING = exp_so3((np.pi, 0, 0))
"""Attitude of a marker that looks straight at the camera, upright."""


def true_pose(k: int, frames: int) -> Array:
    """Return T_chaser_target at frame k: from 1.5 m to 0.06 m, with a small tumble."""
    share = k / max(frames - 1, 1)
    range_m = 1.5 * (0.06 / 1.5) ** share
    tumble = exp_so3(np.array([0.05 * np.sin(6 * share), 0.08 * np.cos(5 * share), 0.3 * share]))
    return pose(FACING @ tumble, (0.004 * np.sin(9 * share), 0.004 * np.cos(9 * share), range_m))


def seen_detection(T_chaser_target: Array, *, marker_id: int = MARKER_ID) -> Detection | None:
    """Return the detection of all layers wholly in sight, at their true corners."""
    layers = visible_layers(T_chaser_target, MISSION, CAMERA)
    if not layers:
        return None
    corners = np.column_stack([layer_corners_print(0, 0.1), np.zeros(4)])
    return Detection(
        family="astratag20",
        marker_id=marker_id,
        corners_px=points_message(CAMERA.project(transform(T_chaser_target, corners))),
        layers=[
            LayerCorners(layer=seen.layer, corners_px=points_message(seen.corners_px), sigma_px=0.1) for seen in layers
        ],
        correlation=0.95,
        hamming=0,
        method="planar" if T_chaser_target[2, 3] > 1.4 else "tracked",
        T_cam_marker=pose_message(T_chaser_target),
    )


def make_run(
    frames: int = 100,
    *,
    error: Callable[[int], Array] = lambda k: np.zeros(12),
    sigma: Callable[[int], Array] = lambda k: np.full(12, 1e-3),
    mode: Callable[[int], Mode] = lambda k: Mode.TRACK,
    detect: Callable[[int, Array], list[Detection]] | None = None,
    truth: bool = True,
) -> Iterator[tuple[Envelope, int]]:
    """Yield envelopes and their times of receipt.

    ``error(k)`` is truth minus estimate (12,) in the convention of ``schemas``, ``sigma(k)`` (12,) the standard
    deviations that the states claim.
    """
    start = Stamp(0, START_NS, 0)
    yield _wrap(calibration_message(CAMERA, frame_id="nav", t_capture_ns=START_NS), start), REPLAY_NS
    for k in range(frames):
        t_ns, entered_ns = START_NS + k * PERIOD_NS, REPLAY_NS + k * PERIOD_NS
        stamp, T_chaser_target = Stamp(k, t_ns, 0), true_pose(k, frames)
        v_m_s = (true_pose(k + 1, frames) - true_pose(k, frames))[:3, 3] / (PERIOD_NS * 1e-9)
        image = CompressedImage(frame_id="nav", format="jpeg", data=b"")
        image.timestamp.FromNanoseconds(t_ns)
        if truth:
            yield _wrap(_truth(t_ns, T_chaser_target, v_m_s), stamp), entered_ns
        yield _wrap(image, stamp), entered_ns
        seen = seen_detection(T_chaser_target)
        found = detect(k, T_chaser_target) if detect else [] if seen is None else [seen]
        yield _wrap(_detections(t_ns, found), stamp), entered_ns + LATENCY_NS // 2
        state = _state(t_ns, mode(k), T_chaser_target, v_m_s, error(k), sigma(k), found)
        yield _wrap(state, stamp), entered_ns + LATENCY_NS
        if k == 0 or mode(k) != mode(k - 1):
            log = Log(level=Log.Level.INFO, message=f"mode {mode(k).name}", name="pose_filter")
            log.timestamp.FromNanoseconds(t_ns)
            yield _wrap(log, stamp), entered_ns + LATENCY_NS


def _wrap(message: AnyMessage, stamp: Stamp) -> Envelope:
    return Envelope.wrap(message, stamp, vehicle="chaser", camera="nav")


def _truth(t_ns: int, T_chaser_target: Array, v_m_s: Array) -> Truth:
    return Truth(
        t_capture_ns=t_ns,
        T_chaser_target=pose_message(T_chaser_target),
        v_chaser_target_m_s=vector_message(v_m_s),
        omega_chaser_target_in_target_rad_s=vector_message(np.zeros(3)),
    )


def _detections(t_ns: int, found: list[Detection]) -> Detections:
    return Detections(t_capture_ns=t_ns, camera="nav", width_px=1280, height_px=720, detections=found)


def _state(
    t_ns: int, mode: Mode, T_chaser_target: Array, v_m_s: Array, error: Array, sigma: Array, found: list[Detection]
) -> RelativeState:
    if mode == Mode.INIT:
        return RelativeState(t_capture_ns=t_ns, mode=mode)
    R_error = exp_so3(error[3:6])
    # truth = estimate * (Exp(theta), rho), so estimate = truth * its inverse
    T_hat = T_chaser_target @ inverse(pose(R_error, error[:3]))
    assert np.allclose(perturb(T_hat, error[:6]), T_chaser_target)
    return RelativeState(
        t_capture_ns=t_ns,
        mode=mode,
        T_chaser_target=pose_message(T_hat),
        v_chaser_target_m_s=vector_message(v_m_s - error[6:9]),
        omega_chaser_target_in_target_rad_s=vector_message(-error[9:12]),
        covariance=np.diag(sigma**2).ravel().tolist(),
        nis=8.0 * max(len(found), 1),
        nis_dof=8 * max(len(found), 1),
        marker_ids=[d.marker_id for d in found for _ in d.layers],
        layers=[seen.layer for d in found for seen in d.layers],
        port=_port(T_hat, v_m_s),
    )


def _port(T_chaser_target: Array, v_m_s: Array) -> PortToPort:
    range_m = float(np.linalg.norm(T_chaser_target[:3, 3]))
    return PortToPort(
        range_m=range_m,
        axial_m=range_m,
        lateral_m=0.0,
        closing_speed_m_s=-float(v_m_s @ T_chaser_target[:3, 3]) / range_m,
        lateral_speed_m_s=0.0,
        misalignment_rad=0.0,
        roll_rad=0.0,
        corridor_angle_rad=0.0,
        in_corridor=True,
    )
