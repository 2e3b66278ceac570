"""How accurate, how honest and how fast the pose filter is, beside single-frame poses from the same corners.

``python -m benchmarks.filter`` runs simulated approaches (corners with noise, no pictures), prints a table by range,
and saves ``out/filter.png``.  NEES and NIS are per degree of freedom: 1 is honest, more is overconfident.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import cv2
import matplotlib
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from astratag.transforms import difference, inverse
from pipeline.convert import pose_matrix, vector_array
from pipeline.mission import FlatSection, Mission, PoseSection
from pipeline.pose_filter import PoseFilter, corners_on_target
from pipeline.scenario import RelativeMotion
from schemas import Detections, RelativeState
from tests.approach import CALIBRATION, CAMERA, CYLINDER, approach, detection, detections, mission, truth

matplotlib.use("Agg")
from matplotlib import pyplot as plt

Array = NDArray[np.float64]

RUNS = 6
RATE_HZ = 15.0
SETTLED_S = 1.0
RANGE_EDGES_M = (1.5, 1.0, 0.5, 0.2, 0.06)
CASES = (
    ("cylinder, 0.03 px", CYLINDER, 0.03, 0.0),
    ("cylinder, 0.15 px", CYLINDER, 0.15, 0.0),
    ("cylinder, 0.05 px, bias 0.06 px", CYLINDER, 0.05, 0.06),
    ("flat, 0.15 px", FlatSection(), 0.15, 0.0),
)
PLOT = Path("out/filter.png")


@dataclass
class Samples:
    """What was measured in each settled frame of a case."""

    range_m: list[float] = field(default_factory=list)
    error: list[Array] = field(default_factory=list)
    """Of the marker's pose in the camera (6,): metres in marker axes, then radians."""
    single: list[Array] = field(default_factory=list)
    """The same of the pose refined on this frame's corners alone."""
    sigma: list[Array] = field(default_factory=list)
    nees: list[float] = field(default_factory=list)
    nis: list[tuple[float, int]] = field(default_factory=list)
    cpu_s: list[float] = field(default_factory=list)

    def within(self, near_m: float, far_m: float) -> NDArray[np.bool_]:
        """Tell which frames were taken between two ranges."""
        ranges = np.array(self.range_m)
        return (ranges >= near_m) & (ranges < far_m)


def main() -> None:
    cv2.setNumThreads(1)
    table = Table(title="Pose filter: RMS by range (single frame in brackets)")
    for heading in ("case", "range m", "lateral mm", "axial mm", "tilt deg", "NEES/12", "NIS/dof", "CPU ms p50", "p99"):
        table.add_column(heading, justify="left" if heading == "case" else "right")
    cases = [(name, run(mission(surface), sigma_px, bias_px)) for name, surface, sigma_px, bias_px in CASES]
    for name, samples in cases:
        for far_m, near_m in pairwise(RANGE_EDGES_M):
            table.add_row(name, f"{far_m:g} to {near_m:g}", *row(samples, samples.within(near_m, far_m)))
            name = ""
        table.add_section()
    Console(width=140).print(table)
    plot(cases)
    print(f"saved {PLOT}")


def run(mission_: Mission, sigma_px: float, bias_px: float) -> Samples:
    """Follow ``RUNS`` approaches."""
    samples = Samples()
    for seed in range(RUNS):
        rng, motion = np.random.default_rng(seed), approach(seed)
        pose_filter = PoseFilter(mission_)
        pose_filter.step(CALIBRATION)
        for k in range(int(motion.duration_s * RATE_HZ)):
            t_s = k / RATE_HZ
            marker = motion.at(t_s)
            real = truth(mission_, marker)
            message = detections(t_s, detection(mission_, real.T_a_b, sigma_px=sigma_px, rng=rng, bias_px=bias_px))
            started_s = time.process_time()
            state = next(iter(pose_filter.step(message)))
            cpu_s = time.process_time() - started_s
            assert isinstance(state, RelativeState)
            if t_s < SETTLED_S:
                continue
            samples.cpu_s.append(cpu_s)
            keep(samples, mission_, state, message, marker.T_a_b, real)
    return samples


def keep(
    samples: Samples,
    mission_: Mission,
    state: RelativeState,
    message: Detections,
    T_cam_marker: Array,
    real: RelativeMotion,
) -> None:
    """Add one frame's errors."""
    assert state.T_chaser_target is not None and state.covariance is not None
    assert state.v_chaser_target_m_s is not None and state.omega_chaser_target_in_target_rad_s is not None
    T_target_marker = mission_.markers[0].T_target_marker.matrix()
    T_cam_chaser = inverse(mission_.camera.T_chaser_cam.matrix())
    estimate = pose_matrix(state.T_chaser_target)
    whole = np.concatenate(
        [
            difference(real.T_a_b, estimate),
            real.v_a_b_m_s - vector_array(state.v_chaser_target_m_s),
            real.omega_a_b_in_b_rad_s - vector_array(state.omega_chaser_target_in_target_rad_s),
        ]
    )
    P = np.array(state.covariance).reshape(12, 12)
    J = marker_from_target(T_target_marker)
    samples.range_m.append(T_cam_marker[2, 3])
    samples.error.append(difference(T_cam_marker, T_cam_chaser @ estimate @ T_target_marker))
    samples.single.append(difference(T_cam_marker, single_frame(mission_, message, T_cam_marker)))
    samples.sigma.append(np.sqrt(np.diag(J @ P[:6, :6] @ J.T)))
    samples.nees.append(float(whole @ np.linalg.solve(P, whole)) / 12)
    samples.nis.append((state.nis or 0.0, state.nis_dof))


def marker_from_target(T_target_marker: Array) -> Array:
    """Return how an error of T_chaser_target, right-perturbed, becomes one of the marker's pose (6, 6)."""
    R, (x, y, z) = T_target_marker[:3, :3], T_target_marker[:3, 3]
    lever = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.block([[R.T, -R.T @ lever], [np.zeros((3, 3)), R.T]])


def single_frame(mission_: Mission, message: Detections, T_cam_marker: Array) -> Array:
    """Return the pose refined on one frame's corners by OpenCV, begun at the truth."""
    marker = mission_.markers[0].model_copy(update={"T_target_marker": PoseSection()})
    layers = message.detections[0].layers
    points = np.concatenate([corners_on_target(marker, layer.layer) for layer in layers])
    pixels = np.array([(p.x_px, p.y_px) for layer in layers for p in layer.corners_px])
    rotation, translation = cv2.solvePnPRefineLM(
        points, pixels, CAMERA.K, CAMERA.distortion, cv2.Rodrigues(T_cam_marker[:3, :3])[0], T_cam_marker[:3, 3:].copy()
    )
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = cv2.Rodrigues(rotation)[0], translation.ravel()
    return T


def row(samples: Samples, chosen: NDArray[np.bool_]) -> list[str]:
    """Return a table row of the chosen frames."""
    filtered, single = (np.sqrt(np.mean(np.square(e)[chosen], axis=0)) for e in (samples.error, samples.single))
    cells = []
    for scale, axes in ((1e3, slice(0, 2)), (1e3, slice(2, 3)), (np.rad2deg(1), slice(3, 5))):
        cells.append(f"{scale * np.linalg.norm(filtered[axes]):.3f} ({scale * np.linalg.norm(single[axes]):.3f})")
    nis, dof = np.array(samples.nis)[chosen].sum(axis=0)
    p50, p99 = np.percentile(np.array(samples.cpu_s)[chosen], (50, 99)) * 1e3
    return [*cells, f"{np.mean(np.array(samples.nees)[chosen]):.2f}", f"{nis / dof:.2f}", f"{p50:.2f}", f"{p99:.2f}"]


def plot(cases: list[tuple[str, Samples]]) -> None:
    """Save errors with their 3 sigma over range, a row a case."""
    figure, axes = plt.subplots(len(cases), 3, figsize=(15, 3 * len(cases)), layout="constrained", sharex=True)
    for line, (name, samples) in zip(axes, cases, strict=True):
        ranges, error, sigma = np.array(samples.range_m), np.array(samples.error), np.array(samples.sigma)
        order = np.argsort(ranges)
        for axis, index, scale, label in (
            (line[0], 0, 1e3, "lateral mm"),
            (line[1], 2, 1e3, "axial mm"),
            (line[2], 3, np.rad2deg(1), "tilt deg"),
        ):
            axis.plot(ranges, np.abs(error[:, index]) * scale, ".", ms=1.5, color="tab:blue", label="error")
            axis.plot(ranges[order], 3 * sigma[order, index] * scale, ".", ms=1, color="tab:red", label="3 sigma")
            axis.set(yscale="log", xscale="log", ylabel=label, ylim=(1e-4, None))
            axis.grid(alpha=0.3, which="both")
        line[1].set_title(name)
    axes[0, 0].legend(markerscale=6)
    for axis in axes[-1]:
        axis.set_xlabel("range m")
    PLOT.parent.mkdir(exist_ok=True)
    figure.savefig(PLOT, dpi=110)


if __name__ == "__main__":
    main()
