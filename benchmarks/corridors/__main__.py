"""``python -m benchmarks.corridors``: the filter's position errors over what the measured corners allow, and NEES.

The shipped corridor and two rendered ones (a minute or two each) go through detector and filter.  Prints a table by
range and saves ``out/corridors/corridors.png`` and ``.json``.  ``--reuse`` takes the recordings that an earlier run
rendered, ``--only NAME`` one corridor.

A rendering knows its focal length exactly, and no mission does: the filter reckons with an error of ``scale_sigma``
that is not there, and seems too cautious by that much.  So NEES is judged with focal lengths that are off as the
mission says: as a square of errors it has the mean over all of them that two flights have, one told a focal length a
standard deviation too long and one too short.  What it is with the exact one stands beside it, and so do errors and
bound, which are of the corners.  All approaches are as smooth as they were drawn, where the filter reckons with
accelerations that change at any time: of velocities and rates it knows more than it claims.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from matplotlib.figure import Figure
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from benchmarks.corridors.bound import (
    CornerNoise,
    Frame,
    measured_layers,
    measured_noise,
    mode_residuals,
    posterior_bound,
)
from benchmarks.corridors.scenes import RENDERED, render
from pipeline.convert import NS_PER_S, camera_from_calibration, pose_matrix
from pipeline.detector import DetectorStep
from pipeline.mission import Mission
from pipeline.pose_filter import PoseFilter
from pipeline.recording import Recording
from pipeline.run import POSE_DOF, SCORED_MODES, STATE_DOF, marker_range_m, state_error
from schemas import Detections, RelativeState, Truth
from schemas.topics import CALIBRATION, FRAME, TRUTH

Array = NDArray[np.float64]

OUT = Path("out/corridors")
SHIPPED = Path(__file__).resolve().parents[2] / "recordings" / "corridor.mcap"
RANGE_EDGES_M = (2.0, 1.0, 0.7, 0.5, 0.3, 0.2, 0.05)
SETTLED_S = 1.5
"""The filter's first look is not judged."""
TARGET_RATIO, TARGET_NEES = 1.5, (0.7, 1.4)


@dataclass(frozen=True, eq=False)
class Flight:
    """A corridor flown: one entry a frame; NaN where the filter claimed nothing."""

    name: str
    frames: list[Frame]
    range_m: Array
    position_error_m: Array
    """(K, 3)"""
    nees_pose: Array
    nees_state: Array
    """With focal lengths that are off as the mission says."""
    nees_pose_exact: Array
    nees_state_exact: Array
    bound_white_m: Array
    """Least RMS distance that corners allow whose noise is new in every frame."""
    bound_m: Array
    """The same with noise that is correlated in time as it was measured."""
    noise: Mapping[tuple[int, int, int], CornerNoise]
    gross_layers: list[int]


@dataclass(frozen=True)
class Row:
    """A bin of range of a corridor."""

    corridor: str
    far_m: float
    near_m: float
    frames: int
    gross_layers: int
    """Layers whose corners were grossly off: the filter has to refuse them, and they count in nothing else here."""
    corner_rms_px: float
    correlation: float
    rms_mm: float
    bound_mm: float
    ratio: float
    bound_white_mm: float
    ratio_white: float
    nees_pose: float
    nees_state: float
    nees_pose_exact: float
    nees_state_exact: float


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--reuse", action="store_true", help="take the recordings rendered before")
    parser.add_argument("--only", metavar="NAME", help="only corridors whose name contains this")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    corridors = [("shipped", SHIPPED), *((c.name, OUT / f"{_file_name(c.name)}.mcap") for c in RENDERED)]
    flights = []
    for name, path in corridors:
        if args.only and args.only not in name:
            continue
        corridor = next((c for c in RENDERED if c.name == name), None)
        if corridor is not None and not (args.reuse and path.exists()):
            render(corridor, path)
        flights.append(fly(name, path))
    rows = [row for flight in flights for row in rows_of(flight)]
    print_rows(rows, Console(width=155))
    OUT.mkdir(parents=True, exist_ok=True)
    (OUT / "corridors.json").write_text(json.dumps([asdict(row) for row in rows], indent=2) + "\n")
    draw(flights).savefig(OUT / "corridors.png")
    print(f"saved {OUT / 'corridors.png'} and corridors.json")


def fly(name: str, path: Path) -> Flight:
    """Run a recording through detector and filter, and bound what they could have achieved."""
    recording = Recording(path)
    mission = recording.mission
    assert recording.calibration is not None
    camera = camera_from_calibration(recording.calibration)
    frames, flown = _flown(recording, mission)
    noise = measured_noise(mode_residuals(frames, mission, camera))
    white, bound = (
        np.sqrt(np.trace(posterior_bound(frames, mission, camera, each)[:, :3, :3], axis1=1, axis2=2))
        for each in (noise.white(), noise)
    )
    pose, state = (
        np.array([[_nees(frame, each, dof) for frame, each in zip(frames, states, strict=True)] for states in flown])
        for dof in (POSE_DOF, STATE_DOF)
    )
    errors = [_error(frame, each) for frame, each in zip(frames, flown[0], strict=True)]
    return Flight(
        name=name,
        frames=frames,
        range_m=np.array([marker_range_m(pose_matrix(f.truth.T_chaser_target), mission) for f in frames]),
        position_error_m=np.array([np.full(3, np.nan) if e is None else e[:3] for e in errors]),
        nees_pose=pose[1:].mean(axis=0),
        nees_state=state[1:].mean(axis=0),
        nees_pose_exact=pose[0],
        nees_state_exact=state[0],
        bound_white_m=white,
        bound_m=bound,
        noise=noise.layers,
        gross_layers=[sum(seen.is_gross for seen in measured_layers(frame, mission, camera)) for frame in frames],
    )


def _flown(recording: Recording, mission: Mission) -> tuple[list[Frame], list[list[RelativeState]]]:
    """Return the frames with truth, and the states at each by filters of exact, longer and shorter focal length."""
    truths: dict[int, Truth] = {truth.t_capture_ns: truth for truth in recording.messages(TRUTH)}
    detector, start_ns = DetectorStep(mission), min(truths)
    sigma = mission.filter.scale_sigma
    filters = {off: PoseFilter(mission) for off in (0.0, sigma, -sigma)} if sigma else {0.0: PoseFilter(mission)}
    frames: list[Frame] = []
    states: dict[float, list[RelativeState]] = {off: [] for off in filters}
    for envelope, _ in recording.envelopes((CALIBRATION, FRAME)):
        message = envelope.message()
        if isinstance(message, CameraCalibration):
            for off, pose_filter in filters.items():
                list(pose_filter.step(with_longer_focus(message, off)))
        for found in detector.step(message):
            if not isinstance(found, Detections):
                continue
            for off, pose_filter in filters.items():
                state = next(iter(pose_filter.step(found)))
                assert isinstance(state, RelativeState)
                states[off].append(state)
            truth = truths[found.t_capture_ns]
            range_m = marker_range_m(pose_matrix(truth.T_chaser_target), mission)
            range_bin = int(np.searchsorted(-np.array(RANGE_EDGES_M), -range_m))
            frames.append(Frame((found.t_capture_ns - start_ns) / NS_PER_S, found, truth, range_bin))
    exact, *wrong = states.values()
    return frames, [exact, *(wrong or [exact])]


def with_longer_focus(calibration: CameraCalibration, share: float) -> CameraCalibration:
    """Return the calibration of a camera whose focal length is longer by a share."""
    longer = CameraCalibration()
    longer.CopyFrom(calibration)
    for matrix, places in ((longer.K, (0, 4)), (longer.P, (0, 5))):
        for place in places if len(matrix) else ():
            matrix[place] *= 1 + share
    return longer


def _error(frame: Frame, state: RelativeState) -> Array | None:
    return state_error(frame.truth, state) if state.mode in SCORED_MODES else None


def _nees(frame: Frame, state: RelativeState, dof: int) -> float:
    """Return the normalised error squared of the first ``dof`` components, a degree of freedom; NaN without."""
    error = _error(frame, state)
    if error is None or state.covariance is None:
        return float("nan")
    P = np.array(state.covariance).reshape(STATE_DOF, STATE_DOF)[:dof, :dof]
    return float(error[:dof] @ np.linalg.solve(P, error[:dof])) / dof


def rows_of(flight: Flight) -> list[Row]:
    """Return a row for every bin of range, and one for all together."""
    settled = np.array([frame.t_s >= SETTLED_S for frame in flight.frames])
    settled &= ~np.isnan(flight.position_error_m[:, 0])
    rows = []
    for far_m, near_m in [*pairwise(RANGE_EDGES_M), (RANGE_EDGES_M[0], RANGE_EDGES_M[-1])]:
        chosen = settled & (flight.range_m < far_m) & (flight.range_m >= near_m)
        if chosen.any():
            rows.append(_row(flight, chosen, far_m, near_m))
    return rows


def _row(flight: Flight, chosen: NDArray[np.bool_], far_m: float, near_m: float) -> Row:
    bins = {flight.frames[k].range_bin for k in np.flatnonzero(chosen)}
    noise = [(n.samples, n.rms_px, n.correlation) for key, n in flight.noise.items() if key[2] in bins]
    samples, rms_px, correlation = (np.array(column) for column in zip(*noise, strict=True))
    rms_m = float(np.sqrt(np.mean(np.sum(flight.position_error_m[chosen] ** 2, axis=1))))
    bound_m, white_m = (float(np.sqrt(np.mean(b[chosen] ** 2))) for b in (flight.bound_m, flight.bound_white_m))
    return Row(
        corridor=flight.name,
        far_m=far_m,
        near_m=near_m,
        frames=int(chosen.sum()),
        gross_layers=sum(flight.gross_layers[k] for k in np.flatnonzero(chosen)),
        corner_rms_px=float(np.sqrt(np.average(rms_px**2, weights=samples))),
        correlation=float(np.average(correlation, weights=samples * rms_px**2)),
        rms_mm=rms_m * 1e3,
        bound_mm=bound_m * 1e3,
        ratio=rms_m / bound_m,
        bound_white_mm=white_m * 1e3,
        ratio_white=rms_m / white_m,
        nees_pose=float(np.nanmean(flight.nees_pose[chosen])),
        nees_state=float(np.nanmean(flight.nees_state[chosen])),
        nees_pose_exact=float(np.nanmean(flight.nees_pose_exact[chosen])),
        nees_state_exact=float(np.nanmean(flight.nees_state_exact[chosen])),
    )


def print_rows(rows: list[Row], console: Console) -> None:
    """Print the table; what misses its target is red."""
    table = Table(
        title="Position RMS over the posterior Cramer-Rao bound, NEES per degree of freedom",
        caption=f"targets: ratio at most {TARGET_RATIO}, NEES {TARGET_NEES[0]} to {TARGET_NEES[1]}; "
        "white: corner noise taken as new in every frame; exact: NEES with the focal length that was rendered",
    )
    table.add_column("corridor")
    for heading in (
        "range m",
        "frames",
        "gross",
        "corners px",
        "correlated",
        "RMS mm",
        "bound mm",
        "ratio",
        "white",
        "NEES pose",
    ):
        table.add_column(heading, justify="right")
    for heading in ("state", "exact", "state"):
        table.add_column(heading, justify="right")
    before = ""
    for row in rows:
        overall = (row.far_m, row.near_m) == (RANGE_EDGES_M[0], RANGE_EDGES_M[-1])
        low, high = TARGET_NEES
        table.add_row(
            "" if row.corridor == before else row.corridor,
            "all" if overall else f"{row.far_m:g} to {row.near_m:g}",
            f"{row.frames}",
            f"{row.gross_layers}",
            f"{row.corner_rms_px:.3f}",
            f"{row.correlation:.2f}",
            f"{row.rms_mm:.3f}",
            f"{row.bound_mm:.3f}",
            _judged(row.ratio, row.ratio <= TARGET_RATIO),
            f"{row.ratio_white:.2f}",
            _judged(row.nees_pose, low <= row.nees_pose <= high),
            _judged(row.nees_state, low <= row.nees_state <= high),
            f"{row.nees_pose_exact:.2f}",
            f"{row.nees_state_exact:.2f}",
            end_section=overall,
        )
        before = row.corridor
    console.print(table)


def _judged(value: float, good: bool) -> str:
    return f"{value:.2f}" if good else f"[red]{value:.2f}[/red]"


def draw(flights: list[Flight]) -> Figure:
    """Return errors with their bounds, and NEES, over range: a row a corridor."""
    figure = Figure(figsize=(14, 3.6 * len(flights)), layout="constrained")
    axes = figure.subplots(len(flights), 2, squeeze=False)
    for (left, right), flight in zip(axes, flights, strict=True):
        error_mm = np.linalg.norm(flight.position_error_m, axis=1) * 1e3
        left.plot(flight.range_m, error_mm, ".", ms=3, color="#1f6fb4", label="error")
        left.plot(flight.range_m, flight.bound_m * 1e3, color="#e07b00", label="bound, noise correlated as measured")
        left.plot(flight.range_m, flight.bound_white_m * 1e3, color="#9fb8cc", label="bound, white noise")
        left.set(yscale="log", ylabel="position mm", title=flight.name)
        right.plot(flight.range_m, flight.nees_pose, ".", ms=3, color="#1f6fb4", label="pose")
        right.plot(flight.range_m, flight.nees_state, ".", ms=3, color="#e07b00", label="state")
        right.axhspan(*TARGET_NEES, color="#3fae6a", alpha=0.2, label="target of the mean")
        right.set(yscale="log", ylabel="NEES per degree of freedom", ylim=(0.05, 20))
        for ax in (left, right):
            ax.set(xscale="log", xlabel="range m")
            ax.invert_xaxis()
            ax.grid(alpha=0.3, which="both")
    axes[0, 0].legend()
    axes[0, 1].legend()
    return figure


def _file_name(name: str) -> str:
    return name.replace(",", "").replace(" ", "_")


if __name__ == "__main__":
    main()
