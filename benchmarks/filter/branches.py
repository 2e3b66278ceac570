"""Flat markers far away and nearly frontal, which look the same tilted either way: how often one is wrongly sure."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from astratag.transforms import difference, inverse
from pipeline.convert import pose_matrix
from pipeline.hypotheses import mirrored_pose
from pipeline.mission import FilterSection, FlatSection
from pipeline.pose_filter import PoseFilter
from schemas import Mode, RelativeState
from tests.approach import CALIBRATION, approach, detection, detections, mission, truth

SIGMA_PX = 0.15
RATE_HZ = 10.0
DURATION_S = 20.0
RANGES_M = (13.0, 20.0)
TILTS_RAD = (0.0, float(np.deg2rad(25)))
HARDER_TILTS_RAD = (0.0, float(np.deg2rad(12)))
"""So nearly frontal that which way a print is tilted can hardly be seen."""
GATE = float(chi2.ppf(0.999, df=3))
NOISE = FilterSection(angular_acceleration_rad_s2=0.001, picture_shift_px=0.0)


@dataclass
class Branches:
    """Frames in TRACK and AMBIGUOUS, and those in TRACK on the wrong branch, of one run."""

    tracked: int = 0
    ambiguous: int = 0
    wrong: int = 0
    to_track_s: float = DURATION_S
    """When the first state was in TRACK; all of the run's duration when none was."""


def fly(seed: int, noise: FilterSection = NOISE, tilts_rad: tuple[float, float] = TILTS_RAD) -> Branches:
    """Follow a half-metre marker; wrong is nearer to the mirror image than to truth, which the covariance excludes."""
    rng, mission_ = np.random.default_rng(seed), mission(FlatSection(), side_m=0.5, filter=noise)
    range_m, tilt_rad, azimuth = rng.uniform(*RANGES_M), rng.uniform(*tilts_rad), rng.uniform(0, 2 * np.pi)
    motion = approach(
        seed,
        start_m=range_m,
        end_m=range_m - 2,
        duration_s=DURATION_S,
        end_speed_m_s=0.05,
        tilt_rad=(tilt_rad * np.cos(azimuth), tilt_rad * np.sin(azimuth), 0.0),
        tumble_rad=(0.005, 0.005, 0.005),
        sway_rad=(2e-3, 2e-3),
    )
    pose_filter, counts = PoseFilter(mission_), Branches()
    pose_filter.step(CALIBRATION)
    T_cam_chaser = inverse(mission_.camera.T_chaser_cam.matrix())
    T_target_marker = mission_.markers[0].T_target_marker.matrix()
    for t_s in np.arange(round(DURATION_S * RATE_HZ)) / RATE_HZ:
        marker = motion.at(t_s)
        T = truth(mission_, marker).T_a_b
        seen = detection(mission_, T, sigma_px=SIGMA_PX, rng=rng)
        state = next(iter(pose_filter.step(detections(t_s, seen))))
        assert isinstance(state, RelativeState)
        counts.ambiguous += state.mode == Mode.AMBIGUOUS
        if state.mode != Mode.TRACK or state.T_chaser_target is None:
            continue
        estimate, P = pose_matrix(state.T_chaser_target), np.array(state.covariance).reshape(12, 12)[3:6, 3:6]
        off = difference(T, estimate)[3:]
        off_mirror = difference(mirrored_pose(marker.T_a_b), T_cam_chaser @ estimate @ T_target_marker)[3:]
        is_nearer = np.linalg.norm(off_mirror) < np.linalg.norm(off)
        counts.to_track_s = min(counts.to_track_s, float(t_s))
        counts.tracked += 1
        counts.wrong += bool(is_nearer and off @ np.linalg.solve(P, off) > GATE)
    return counts
