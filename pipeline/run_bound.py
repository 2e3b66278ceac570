"""What a recorded run's corners allowed: the posterior Cramer-Rao bound by range, beside the errors that were made."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from pydantic import BaseModel, ConfigDict

from astratag.transforms import inverse
from pipeline.bound import posterior_bounds
from pipeline.convert import pose_matrix, vector_array
from pipeline.corners import Eye, SeenLayer
from pipeline.dynamics import Motion
from pipeline.pose_filter import corners_on_target
from pipeline.run import ATTITUDE, POSITION, Row, Run
from schemas import Truth

RANGE_EDGES_M = (np.inf, 30.0, 20.0, 10.0, 5.0, 2.0, 1.0, 0.5, 0.2, 0.0)


class BoundBin(BaseModel):
    """Errors between two ranges, RMS, and the least that the measured corners allowed with the mission's tuning."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    farthest_m: float
    """As it was flown, like ``nearest_m``."""
    nearest_m: float
    states: int
    position_rms_m: float
    position_bound_m: float
    attitude_rms_rad: float
    attitude_bound_rad: float


def bound_bins(run: Run) -> list[BoundBin] | None:
    """Return the bins that a run has states in; None without truth, camera or marker map."""
    rows = [row for row in run.rows if row.truth is not None]
    if not rows or run.camera is None or not run.mission.markers:
        return None
    eye = Eye(run.camera, inverse(run.mission.camera.T_chaser_cam.matrix()))
    looks = ((row.truth.t_capture_ns, _motion(row.truth), _layers(row, run)) for row in rows if row.truth is not None)
    bounds = posterior_bounds(looks, eye, run.mission.filter)
    pairs = [(row, bound) for row, bound in zip(rows, bounds, strict=True) if row.scored and row.range_m is not None]
    bins = []
    for far_m, near_m in pairwise(RANGE_EDGES_M):
        inside = [(row, P) for row, P in pairs if row.range_m is not None and near_m <= row.range_m < far_m]
        if not inside:
            continue
        ranges_m = [row.range_m for row, _ in inside if row.range_m is not None]
        variances = np.mean([np.diag(P)[:6] for _, P in inside], axis=0)
        squares = np.mean([row.error[:6] ** 2 for row, _ in inside if row.error is not None], axis=0)
        bins.append(
            BoundBin(
                farthest_m=max(ranges_m),
                nearest_m=min(ranges_m),
                states=len(inside),
                position_rms_m=float(np.sqrt(squares[POSITION].sum())),
                position_bound_m=float(np.sqrt(variances[POSITION].sum())),
                attitude_rms_rad=float(np.sqrt(squares[ATTITUDE].sum())),
                attitude_bound_rad=float(np.sqrt(variances[ATTITUDE].sum())),
            )
        )
    return bins


def _motion(truth: Truth) -> Motion:
    T = pose_matrix(truth.T_chaser_target)
    v, omega = truth.v_chaser_target_m_s, truth.omega_chaser_target_in_target_rad_s
    return Motion(T[:3, 3], T[:3, :3], vector_array(v), vector_array(omega))


def _layers(row: Row, run: Run) -> list[SeenLayer]:
    """Return the layers that were measured on markers of the map; of their corners only the sigmas count."""
    layers = []
    for detection in row.detections.detections if row.detections is not None else []:
        marker = run.mission.marker(detection.marker_id)
        if marker is None:
            continue
        for layer in detection.layers:
            sigma_px = max(layer.sigma_px, run.mission.filter.corner_floor_px)
            points = corners_on_target(marker, layer.layer)
            layers.append(SeenLayer(marker.id, layer.layer, np.zeros((4, 2)), sigma_px, points))
    return layers


def nis_correlation(run: Run) -> float | None:
    """Return how NIS correlates from one frame to the next: near 0 when the innovations are white; None if unknown."""
    known = [row.state for row in run.rows if row.state is not None and row.state.nis is not None and row.state.nis_dof]
    nis = np.array([(state.nis or 0.0) / state.nis_dof for state in known])
    if len(nis) < 3 or np.ptp(nis) == 0:
        return None
    off = nis - nis.mean()
    return float(off[1:] @ off[:-1] / (off @ off))
