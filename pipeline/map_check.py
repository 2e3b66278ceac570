"""Whether the markers lie where the map has them: one that contradicts the others frame after frame is named.

Each frame is judged by its corners alone: is there one place of the camera from which they all are where they are seen?
If not, the marker is refused without which the others agree best; of two, the one that the mission lists later.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from astratag.camera import Camera
from astratag.transforms import difference, inverse, perturb, transform
from pipeline.corner_filter import gate_limit
from pipeline.corners import CORNER_DOF, NEAREST_M, cross_rows
from pipeline.mapping.views import LEAST_MARKERS, View, view_of
from pipeline.mission import Mission
from schemas import Detections

Array = NDArray[np.float64]

POSE_DOF = 6
AGREEMENT = gate_limit(0.9999, CORNER_DOF)
"""Squared residual of a layer, in sigmas, above which its marker does not agree with the others."""
PERSISTENT_FRAMES = 15
"""Frames in which a marker contradicted the others, less those in which it agreed, before it is no longer trusted."""
KEPT_FRAMES = 50
"""Over so many its place is told, as their median."""
MOST_STEPS, CONVERGED = 8, 1e-3


@dataclass(frozen=True)
class Verdict:
    """What a frame says about the map: why markers are not to be used in it, and what is to be told."""

    refused: Mapping[int, str] = field(default_factory=dict)
    """Reason by marker, as a state's ``rejections`` have it."""
    events: tuple[str, ...] = ()


@dataclass
class _Suspicion:
    """What speaks against one marker."""

    contradictions: int = 0
    untrusted: bool = False
    off: deque[Array] = field(default_factory=lambda: deque(maxlen=KEPT_FRAMES))
    """(6,) how far from its place on the map it was seen, metres then radians in its own axes."""


class MapCheck:
    """Judges frames one after another.  No clock and no state of the target: frames are all that counts.

    A marker that contradicts the others is refused at once.  When it does so persistently it is named, once, and then
    is refused until it has agreed for as many frames as it had contradicted.
    """

    def __init__(self, mission: Mission):
        self._markers = {marker.id: marker for marker in mission.markers}
        self._T_target_marker = {marker.id: marker.T_target_marker.matrix() for marker in mission.markers}
        self._suspicions = {marker_id: _Suspicion() for marker_id in self._markers}
        noise = mission.filter
        self._floor_px = noise.corner_floor_px
        self._common_px = float(np.hypot(noise.edge_bias_px, noise.picture_shift_px))
        """What all corners of a marker may be off together, beside each one's own noise."""

    @property
    def untrusted(self) -> frozenset[int]:
        """Return the markers that do not lie where the map has them."""
        return frozenset(marker_id for marker_id, s in self._suspicions.items() if s.untrusted)

    def take(self, message: Detections, camera: Camera) -> Verdict:
        """Take a frame's detections; return which markers are not to be used in it, and events, one line each."""
        untrusted = self.untrusted
        refused = {m: f"map: marker {m} does not lie where the map has it" for m in untrusted}
        if len(self._markers) < LEAST_MARKERS or len(message.detections) < LEAST_MARKERS:
            return Verdict(refused)
        view = view_of(message, camera, self._markers, self._floor_px)
        if view is None:
            return Verdict(refused)
        agreeing, T_cam_target = self._majority(view)
        others = agreeing - untrusted
        if T_cam_target is None or not others:
            return Verdict(refused)
        events = [event for marker_id in sorted(agreeing) for event in self._agreed(marker_id)]
        for seen in view.markers:
            if seen.marker.id not in agreeing:
                T_target_marker = inverse(T_cam_target) @ seen.poses_cam_marker[0]
                events.extend(self._contradicted(seen.marker.id, T_target_marker, others))
                refused.setdefault(seen.marker.id, f"map: marker {seen.marker.id} contradicts the others")
        return Verdict(refused, tuple(events))

    def _majority(self, view: View) -> tuple[frozenset[int], Array | None]:
        """Return the markers that agree on where the camera is, and T_cam_target (4, 4) as they have it."""
        order = [marker_id for marker_id in self._markers if marker_id in view.ids]
        ids = [m for m in order if m not in self.untrusted] or list(order)
        best, T_cam_target = self._fit(view.only(ids))
        if best > AGREEMENT and len(ids) < len(order):  # all are heard again
            ids = list(order)
            best, T_cam_target = self._fit(view.only(ids))
        while best > AGREEMENT and len(ids) > LEAST_MARKERS:
            fits = {marker_id: self._fit(view.only(set(ids) - {marker_id})) for marker_id in ids}
            worst = min(fits, key=lambda marker_id: fits[marker_id][0])
            ids.remove(worst)
            best, T_cam_target = fits[worst]
        if best > AGREEMENT:
            ids = ids[:1]
            _, T_cam_target = self._fit(view.only(ids))
        agreeing = set(ids)
        for marker_id in set(order) & self.untrusted:  # only to be trusted again
            if marker_id not in agreeing and self._fit(view.only({*ids, marker_id}))[0] <= AGREEMENT:
                agreeing.add(marker_id)
        return frozenset(agreeing), T_cam_target

    def _fit(self, view: View) -> tuple[float, Array | None]:
        """Return the worst layer's squared residual, in sigmas, when the camera is where it is least; and T_cam_target.

        Begun at the poses that the largest marker allows.
        """
        largest = max(view.markers, key=lambda seen: float(np.ptp(seen.layers[0].corners_px, axis=0).max()))
        T_marker_target = inverse(self._T_target_marker[largest.marker.id])
        found: tuple[float, Array | None] = (np.inf, None)
        points = np.concatenate(
            [
                transform(self._T_target_marker[marker_id], view.corners.points_marker[view.corners.slot == slot])
                for slot, marker_id in enumerate(view.ids)
            ]
        )
        sigma_px = np.hypot(view.corners.sigma_px, self._common_px)
        for T_cam_marker in largest.poses_cam_marker:
            worst, T_cam_target = _resected(view, T_cam_marker @ T_marker_target, points, sigma_px)
            found = min(found, (worst, T_cam_target), key=lambda fit: fit[0])
        return found

    def _agreed(self, marker_id: int) -> list[str]:
        suspicion = self._suspicions[marker_id]
        suspicion.contradictions = max(suspicion.contradictions - 1, 0)
        if suspicion.contradictions:
            return []
        suspicion.off.clear()
        if not suspicion.untrusted:
            return []
        suspicion.untrusted = False
        return [f"marker {marker_id} lies where the map has it again"]

    def _contradicted(self, marker_id: int, T_target_marker: Array, others: Iterable[int]) -> list[str]:
        suspicion = self._suspicions[marker_id]
        suspicion.contradictions = min(suspicion.contradictions + 1, PERSISTENT_FRAMES)
        suspicion.off.append(difference(T_target_marker, self._T_target_marker[marker_id]))
        if suspicion.untrusted or suspicion.contradictions < PERSISTENT_FRAMES:
            return []
        suspicion.untrusted = True
        beside = ", ".join(str(other) for other in sorted(others))
        return [
            f"marker {marker_id} does not lie where the map has it: off by {_apart(suspicion.off)} beside marker "
            f"{beside}, run relnav map"
        ]


def _resected(view: View, T_cam_target: Array, points_target: Array, sigma_px: Array) -> tuple[float, Array]:
    """Return the worst layer's squared residual after Gauss-Newton on all corners, infinite when it leads nowhere."""
    seen_px, camera = view.corners.seen_px, view.camera
    cost = np.inf
    for step in range(MOST_STEPS + 1):
        points_cam = transform(T_cam_target, points_target)
        if not points_cam[:, 2].min() > NEAREST_M:
            return np.inf, T_cam_target
        residual = ((seen_px - camera.project(points_cam)) / sigma_px[:, None]).ravel()
        before, cost = cost, float(residual @ residual)
        if step == MOST_STEPS or abs(before - cost) < CONVERGED * (1 + cost):
            break
        rows = camera.projection_jacobian(points_cam) @ T_cam_target[:3, :3] / sigma_px[:, None, None]
        J = np.concatenate([rows, cross_rows(points_target, rows)], axis=2).reshape(-1, POSE_DOF)
        T_cam_target = perturb(T_cam_target, np.linalg.lstsq(J, residual, rcond=None)[0])
    return float(np.sum(residual.reshape(-1, CORNER_DOF) ** 2, axis=1).max()), T_cam_target


def _apart(off: Collection[Array]) -> str:
    """Return how far a marker is from its place, in words."""
    median = np.median(np.array(off), axis=0)
    distance_mm, angle_deg = np.linalg.norm(median[:3]) * 1e3, np.degrees(np.linalg.norm(median[3:]))
    return f"{distance_mm:.1f} mm and {angle_deg:.1f} degrees"
