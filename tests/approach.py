"""A simulated approach for the filter's tests and benchmark: exact motion, and corners as a detector would send them.

The motion is ``pipeline.scenario``'s; there are no pictures, corners come from ``Camera.project`` with Gaussian noise.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from astratag.camera import Camera
from astratag.geometry import LAYERS
from astratag.transforms import inverse, transform
from pipeline.convert import calibration_message, points_message, pose_message
from pipeline.corners import SeenLayer, corner_noise, edge_shifts, outward_shift
from pipeline.lasting import EDGES, OUTWARD
from pipeline.mission import CameraSection, CylinderSection, FlatSection, MarkerSection, Mission, PoseSection
from pipeline.pose_filter import corners_on_target
from pipeline.scenario import Approach, RelativeMotion
from schemas import Detection, Detections, LayerCorners, PlanarPose

Array = NDArray[np.float64]

CAMERA = Camera(np.array([[1000.0, 0, 639.5], [0, 1000.0, 359.5], [0, 0, 1]]), width=1280, height=720)
T0_NS = 1_750_000_000_000_000_000
SMALLEST_SIDE_PX = 12.0

CYLINDER = CylinderSection(radius_m=0.15, axis_rad=float(np.pi / 2))
MARKER = 19


def mission(surface: FlatSection | CylinderSection = CYLINDER, side_m: float = 0.1, **kwargs: Any) -> Mission:
    """Return a mission with one marker away from the target's origin and a camera away from the chaser's."""
    chaser_cam = PoseSection(translation_m=(0.05, -0.02, 0.10), rotation_wxyz=(0.5, 0.5, 0.5, 0.5))
    target_marker = PoseSection(translation_m=(0.02, 0.03, 0.15))
    return Mission(
        camera=CameraSection(T_chaser_cam=chaser_cam),
        markers=(MarkerSection(id=MARKER, side_m=side_m, surface=surface, T_target_marker=target_marker),),
        **kwargs,
    )


def approach(seed: int, **kwargs: Any) -> Approach:
    """Return an approach whose sway and tumble begin anywhere in their periods."""
    phases = np.random.default_rng(seed).uniform(0, 2 * np.pi, 5).tolist()
    return Approach(sway_phase_rad=tuple(phases[:2]), tumble_phase_rad=tuple(phases[2:]), **kwargs)


def truth(mission_: Mission, marker_motion: RelativeMotion) -> RelativeMotion:
    """Return the target's motion past the chaser for a marker's motion past the camera."""
    return marker_motion.mounted(
        mission_.camera.T_chaser_cam.matrix(), inverse(mission_.markers[0].T_target_marker.matrix())
    )


def visible_layers(mission_: Mission, T_chaser_target: Array) -> dict[int, Array]:
    """Return the true corners (4, 2) of each layer that is wholly in the image and large enough to be read."""
    T_cam_target = inverse(mission_.camera.T_chaser_cam.matrix()) @ T_chaser_target
    seen = {}
    for layer in range(len(LAYERS)):
        corners = CAMERA.project(transform(T_cam_target, corners_on_target(mission_.markers[0], layer)))
        inside = (corners > 3).all() and (corners < (CAMERA.width - 4, CAMERA.height - 4)).all()
        if inside and np.ptp(corners, axis=0).min() > SMALLEST_SIDE_PX:
            seen[layer] = corners
    return seen


def detection(
    mission_: Mission,
    T_chaser_target: Array,
    *,
    sigma_px: float,
    rng: np.random.Generator | None = None,
    bias_px: float = 0.0,
    lasting_px: Mapping[int, Array] | None = None,
) -> Detection | None:
    """Return what a detector makes of a true pose, with noise when there is an ``rng``.

    The noise is what the mission's filter takes ``sigma_px`` for, less what lasts: ``lasting_px`` (9,) by layer, as in
    ``pipeline.lasting``, or an edge bias alone.  The detection's pose is the true one, as a refined pose would be to a
    few sigma.
    """
    layers = visible_layers(mission_, T_chaser_target)
    if not layers:
        return None
    marker = mission_.markers[0]
    T_cam_marker = inverse(mission_.camera.T_chaser_cam.matrix()) @ T_chaser_target @ marker.T_target_marker.matrix()
    noise_px = np.zeros((len(layers), 4, 2))
    if rng is not None:
        exact = [SeenLayer(marker.id, layer, px, sigma_px, np.zeros((4, 3))) for layer, px in layers.items()]
        root = np.linalg.cholesky(corner_noise(exact, mission_.filter))
        noise_px = (root @ rng.standard_normal(len(root))).reshape(noise_px.shape)
    measured = []
    for (layer, corners), new_px in zip(layers.items(), noise_px, strict=True):
        off_px = bias_px * outward_shift(corners[None])[0] + new_px
        if lasting_px is not None:
            outside_px = lasting_px[layer][OUTWARD] + lasting_px[layer][EDGES]
            off_px += np.tensordot(outside_px, edge_shifts(corners[None])[0], 1)
        measured.append(LayerCorners(layer=layer, corners_px=points_message(corners + off_px), sigma_px=sigma_px))
    return Detection(
        family="astratag20",
        marker_id=marker.id,
        corners_px=measured[0].corners_px,
        layers=measured,
        correlation=0.95,
        hamming=0,
        method="planar",
        planar_poses=[PlanarPose(T_cam_marker=pose_message(T_cam_marker), reprojection_rms_px=sigma_px)],
        T_cam_marker=pose_message(T_cam_marker),
    )


def detections(t_s: float, *found: Detection | None) -> Detections:
    """Return one frame's message."""
    return Detections(
        t_capture_ns=T0_NS + round(t_s * 1e9),
        camera="nav",
        width_px=CAMERA.width,
        height_px=CAMERA.height,
        detections=[one for one in found if one is not None],
    )


CALIBRATION = calibration_message(CAMERA, frame_id="camera", t_capture_ns=T0_NS)
