"""A target with markers on several sides, and a camera that goes round it: corners as a detector would send them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from astratag.camera import Camera
from astratag.detection import LayerDetection
from astratag.pose import planar_poses
from astratag.transforms import exp_so3, pose
from pipeline.convert import calibration_message, points_message, pose_message
from pipeline.corners import SeenLayer, corner_noise, outward_shift
from pipeline.expected import visible_layers
from pipeline.mapping.bundle import BIAS_DOF
from pipeline.mapping.estimate import pose_section
from pipeline.mapping.views import View, view_of
from pipeline.mission import CameraSection, CylinderSection, FilterSection, MarkerSection, Mission, PoseSection
from pipeline.scenario import FACING
from schemas import Detection, Detections, LayerCorners

Array = NDArray[np.float64]

CAMERA = Camera(
    [[1000.0, 0, 639.5], [0, 1000.0, 359.5], [0, 0, 1]], (-0.08, 0.05, 0.0005, -0.0004, 0.0), width=1280, height=720
)
CALIBRATION = calibration_message(CAMERA, frame_id="nav", t_capture_ns=0)
T0_NS = 1_750_000_000_000_000_000
SMALLEST_SIDE_PX = 16.0
PLAIN = FilterSection(lasting_sigma_px=0.0, edge_end_correlation=0.0, picture_shift_px=0.0)
"""Every coordinate of a corner is off by itself, as maps take it."""


MARKERS = (
    MarkerSection(id=7, side_m=0.10, T_target_marker=pose_section(pose(exp_so3([0, 0, 0.2]), [0.02, -0.01, 0.20]))),
    MarkerSection(id=3, side_m=0.06, T_target_marker=pose_section(pose(exp_so3([0.35, 0, 0]), [-0.02, -0.14, 0.19]))),
    MarkerSection(
        id=11,
        side_m=0.08,
        surface=CylinderSection(radius_m=0.12, axis_rad=float(np.pi / 2)),
        T_target_marker=pose_section(pose(exp_so3([0, 0.3, 0]), [0.17, 0.03, 0.17])),
    ),
    MarkerSection(id=15, side_m=0.05, T_target_marker=pose_section(pose(exp_so3([0, 1.2, 0]), [0.28, 0.0, 0.05]))),
)
"""A large one in front, a tilted one below it, one on a cylinder beside them, and one round the corner."""
MISSION = Mission(
    camera=CameraSection(
        T_chaser_cam=PoseSection(translation_m=(0.1, 0.02, -0.05), rotation_wxyz=(0.5, 0.5, 0.5, 0.5))
    ),
    markers=MARKERS,
)


def looking(azimuth_rad: float, elevation_rad: float, range_m: float, aside_rad: float = 0.0) -> Array:
    """Return T_cam_target of a camera that looks at the target's front, from the side and from above."""
    R_cam_target = FACING @ exp_so3([elevation_rad, 0, 0]) @ exp_so3([0, -azimuth_rad, 0])
    middle_cam = np.array([range_m * np.tan(aside_rad), 0.0, range_m])
    return pose(R_cam_target, middle_cam - R_cam_target @ [0.08, -0.03, 0.15])


def seen_from(
    T_cam_target: Array,
    mission: Mission,
    *,
    sigma_px: float,
    rng: np.random.Generator,
    t_s: float = 0.0,
    bias_px: Mapping[int, Array] | None = None,
    only: set[int] | None = None,
    noise: FilterSection = PLAIN,
) -> Detections:
    """Return one frame's detections, with independent noise or with what a filter section takes ``sigma_px`` for.

    ``bias_px`` (11,) is how far a marker's corners are measured beside their place, as in ``Corners.by_bias``.
    """
    found: dict[int, list[LayerDetection]] = {}
    T_chaser_target = mission.camera.T_chaser_cam.matrix() @ T_cam_target
    visible = [
        expected
        for expected in visible_layers(T_chaser_target, mission, CAMERA)
        if np.ptp(expected.corners_px, axis=0).min() >= SMALLEST_SIDE_PX and (not only or expected.marker_id in only)
    ]
    exact = [SeenLayer(one.marker_id, one.layer, one.corners_px, sigma_px, np.zeros((4, 3))) for one in visible]
    root = np.linalg.cholesky(corner_noise(exact, noise)) if exact else np.zeros((0, 0))
    noise_px = (root @ rng.standard_normal(len(root))).reshape(-1, 4, 2)
    for expected, new_px in zip(visible, noise_px, strict=True):
        bias = (bias_px or {}).get(expected.marker_id, np.zeros(BIAS_DOF))
        outward_px = bias[0] * outward_shift(expected.corners_px[None])[0]
        biased_px = expected.corners_px + outward_px + bias[1:3] + bias[3:].reshape(4, 2)
        layer = LayerDetection(expected.layer, biased_px + new_px, sigma_px)
        found.setdefault(expected.marker_id, []).append(layer)
    return Detections(
        t_capture_ns=T0_NS + round(t_s * 1e9),
        camera=mission.camera.name,
        width_px=CAMERA.width,
        height_px=CAMERA.height,
        detections=[_message(mission, marker_id, layers) for marker_id, layers in found.items()],
    )


def _message(mission: Mission, marker_id: int, layers: list[LayerDetection]) -> Detection:
    marker = mission.marker(marker_id)
    assert marker is not None
    poses = planar_poses(CAMERA, layers, marker.side_m, marker.surface.surface())
    return Detection(
        family=mission.dictionary,
        marker_id=marker_id,
        corners_px=points_message(layers[0].corners_px),
        layers=[
            LayerCorners(layer=seen.layer, corners_px=points_message(seen.corners_px), sigma_px=seen.sigma_px)
            for seen in layers
        ],
        correlation=0.95,
        hamming=0,
        method="planar",
        T_cam_marker=pose_message(poses[0].T_cam_marker) if poses else None,
    )


def round_trip(count: int) -> list[Array]:
    """Return T_cam_target of ``count`` places about the target's front."""
    s = np.linspace(0, 1, count)
    azimuth, elevation = 0.75 * np.sin(2 * np.pi * s) + 0.25, 0.4 * np.sin(4 * np.pi * s + 0.5)
    return [looking(a, e, 0.9 - 0.35 * u) for a, e, u in zip(azimuth, elevation, s, strict=True)]


def views(
    mission: Mission,
    poses_cam_target: list[Array],
    *,
    sigma_px: float,
    seed: int,
    bias_px: Mapping[int, Array] | None = None,
    only: set[int] | None = None,
    told: tuple[MarkerSection, ...] | None = None,
) -> list[View]:
    """Return the views of a mission's markers from places; ``told`` is what is believed of their sides and surfaces."""
    rng = np.random.default_rng(seed)
    sections = {marker.id: marker for marker in told or mission.markers}
    messages = (seen_from(T, mission, sigma_px=sigma_px, rng=rng, bias_px=bias_px, only=only) for T in poses_cam_target)
    found = (view_of(message, CAMERA, sections, mission.filter.corner_floor_px) for message in messages)
    return [view for view in found if view is not None]
