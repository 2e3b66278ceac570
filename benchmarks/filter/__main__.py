"""Monte Carlo of the pose filter against the posterior Cramer-Rao bound: table, and the plot ``out/filter.png``.

Truth is drawn from the filter's own process model.  NEES and NIS are per degree of freedom: 1 is honest, more is
overconfident.  Everything is seeded.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import cv2
import matplotlib
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from scipy.stats import chi2

from benchmarks.filter import branches
from benchmarks.filter.simulate import MATCHED, Case, Samples, simulate

matplotlib.use("Agg")
from matplotlib import pyplot as plt

Array = NDArray[np.float64]
STATE_DOF = 12
CONFIDENCE = 0.95
HEADINGS = (
    "case",
    "range m",
    "lateral mm",
    "axial mm",
    "tilt deg",
    "largest",
    "limit",
    "own",
    "ideal",
    "NEES/12",
    "NIS",
    "CPU ms",
)
SMALL = Case(
    "10 cm marker",
    side_m=0.1,
    tilt_rad=0.1,
    ranges_m=(1.5, 1.2, 0.6, 0.3, 0.1),
    rate_hz=25.0,
    duration_s=28.0,
    noise=MATCHED.model_copy(update={"acceleration_m_s2": 0.001, "angular_acceleration_rad_s2": 0.002}),
    limits=(1.15,) * 4,
)
LARGE = Case(
    "0.5 m marker, tilted 20 deg",
    side_m=0.5,
    tilt_rad=float(np.deg2rad(20)),
    ranges_m=(30.0, 25.0, 20.0, 10.0, 5.0, 1.0),
    rate_hz=20.0,
    duration_s=116.0,
    noise=MATCHED.model_copy(
        update={"acceleration_m_s2": 0.002, "angular_acceleration_rad_s2": 0.0003, "initial_speed_m_s": 0.3}
    ),
    limits=(1.25, 1.25, 1.25, 1.15, 1.15),
)


def but(case: Case, name: str, *, considers: dict[str, float], **wrong: float) -> Case:
    """Return a case whose camera is wrong by something that the filter is told may be so large."""
    noise = case.noise.model_copy(update=considers)
    return replace(case, name=name, noise=noise, limits=(), **wrong)  # type: ignore[arg-type]


LASTING = {"edge_bias_px": 0.1, "edge_bias_correlation_s": 1000.0}
WRONG = (
    but(SMALL, "focal length 0.1 % off", considers={"scale_sigma": 0.001}, focal_error=0.001),
    but(SMALL, "edges 0.1 px outside", considers=LASTING, edge_px=0.1),
    but(SMALL, "pictures shifted 0.1 px", considers={"image_shift_px": 0.1}, shift_px=0.1),
    but(SMALL, "focal 0.1 % off, filter not told", considers={}, focal_error=0.001),
)


def main() -> None:
    cv2.setNumThreads(1)
    parser = argparse.ArgumentParser(prog="python -m benchmarks.filter", description=__doc__)
    parser.add_argument("--runs", type=int, default=48, help="of each approach")
    parser.add_argument("--branch-runs", type=int, default=100, help="of far, nearly frontal markers")
    parser.add_argument("--only", choices=("bound", "wrong", "branches"), help="one part of it")
    parser.add_argument("--seed", type=int, default=0, help="of the first run")
    parser.add_argument("--plot", type=Path, default=Path("out/filter.png"))
    args = parser.parse_args()
    console = Console(width=165)
    print(f"seeds {args.seed} to {args.seed + args.runs - 1}")
    if args.only in (None, "bound"):
        found = [(case, simulate(case, args.runs, args.seed)) for case in (SMALL, LARGE)]
        console.print(bound_table(found))
        for case, samples in found:
            print(consistency(case, samples, args.runs))
        plot(found, args.plot)
        print(f"saved {args.plot}")
    if args.only in (None, "wrong"):
        for case in WRONG:
            print(consistency(case, simulate(case, args.runs, args.seed), args.runs))
    if args.only in (None, "branches"):
        for name, tilts_rad in (("far", branches.TILTS_RAD), ("far, nearly frontal", branches.HARDER_TILTS_RAD)):
            flown = [branches.fly(args.seed + k, tilts_rad=tilts_rad) for k in range(args.branch_runs)]
            times_s = [run.to_track_s for run in flown]
            print(
                f"{name}: {sum(run.wrong > 0 for run in flown)} of {len(flown)} runs in TRACK on the wrong branch "
                f"({sum(run.wrong for run in flown)} of {sum(run.tracked for run in flown)} states; "
                f"{sum(run.ambiguous for run in flown)} were AMBIGUOUS); in TRACK after {np.median(times_s):.1f} s, "
                f"{np.percentile(times_s, 90):.1f} s in nine of ten runs"
            )


def bound_table(found: list[tuple[Case, Samples]]) -> Table:
    """Return RMS beside the bound, a row a bin.

    The largest ratio comes with its standard error, from how runs differ; "own" is the largest of the standard
    deviations that the filter claims, beside the bound.  "ideal" is the largest ratio to the RMS, on the same draws, of
    the linear filter that reaches the bound: what the filter loses, without the luck of a few runs.
    """
    table = Table(title="Pose filter: RMS, and its ratio to the posterior Cramer-Rao bound")
    for heading in HEADINGS:
        table.add_column(heading, justify="left" if heading == "case" else "right")
    for case, samples in found:
        name = case.name
        for (far_m, near_m), limit in zip(pairwise(case.ranges_m), case.limits, strict=True):
            chosen = within(samples, near_m, far_m)
            if not chosen.any():
                continue
            rms = np.sqrt(np.mean(np.array(samples.squares)[chosen], axis=0))
            bound = np.sqrt(np.mean(np.array(samples.bounds)[chosen], axis=0))
            ratio, own = rms / bound, np.sqrt(np.mean(np.array(samples.variances)[chosen], axis=0)) / bound
            beside_ideal = rms / np.sqrt(np.mean(np.array(samples.ideal)[chosen], axis=0))
            scaled = rms * (1e3, 1e3, np.rad2deg(1))
            nis, dof = np.array(samples.nis)[chosen].sum(axis=0)
            table.add_row(
                name,
                f"{far_m:g} to {near_m:g}",
                *(f"{value:.3f} ({r:.2f})" for value, r in zip(scaled, ratio, strict=True)),
                f"{ratio.max():.2f} ± {ratio_errors(samples, chosen)[ratio.argmax()]:.2f}",
                f"{limit:.2f}",
                f"{own.max():.2f}",
                f"{beside_ideal.max():.2f}",
                f"{np.mean(np.array(samples.nees)[chosen]) / STATE_DOF:.2f}",
                f"{nis / dof:.2f}",
                f"{np.median(np.array(samples.cpu_s)[chosen]) * 1e3:.2f}",
            )
            name = ""
        table.add_section()
    return table


def ratio_errors(samples: Samples, chosen: NDArray[np.bool_]) -> Array:
    """Return the standard errors (3,) of the ratios of RMS to bound; runs are independent, frames of one are not."""
    run, squares = np.array(samples.run)[chosen], np.array(samples.squares)[chosen]
    bounds = np.array(samples.bounds)[chosen].mean(axis=0)
    means = np.array([squares[run == one].mean(axis=0) for one in np.unique(run)]) / bounds
    if len(means) < 2:
        return np.full(3, np.nan)
    of_square = means.std(axis=0, ddof=1) / np.sqrt(len(means))
    return np.asarray(of_square / (2 * np.sqrt(means.mean(axis=0))))


def within(samples: Samples, near_m: float, far_m: float) -> NDArray[np.bool_]:
    """Tell which frames were taken between two ranges."""
    ranges = np.array(samples.range_m)
    return (ranges >= near_m) & (ranges < far_m)


def ensemble(samples: Samples, runs: int) -> tuple[NDArray[np.intp], Array]:
    """Return the frames that every run tracked, and the mean NEES per degree of freedom over the runs at each."""
    frames, nees = np.array(samples.frame), np.array(samples.nees)
    count, total = np.bincount(frames), np.bincount(frames, weights=nees)
    whole: NDArray[np.intp] = np.flatnonzero(count == runs)
    return whole, total[whole] / (runs * STATE_DOF)


def consistency(case: Case, samples: Samples, runs: int) -> str:
    """Return a line: NEES with its band, NIS, and how white the innovations are."""
    _, means = ensemble(samples, runs)
    tails = np.array([(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    low, high = chi2.ppf(tails, STATE_DOF * runs) / (STATE_DOF * runs)
    inside = float(np.mean((means > low) & (means < high))) if len(means) else float("nan")
    nis, dof = np.array(samples.nis).sum(axis=0)
    product, square, count = np.array(samples.correlation).sum(axis=0)
    return (
        f"{case.name}: NEES {np.mean(samples.nees) / STATE_DOF:.2f} ({CONFIDENCE:.0%} of instants of {runs} runs "
        f"belong in {low:.2f} to {high:.2f}: {inside:.0%} are), NIS {nis / dof:.3f}, innovations correlated by "
        f"{product / square:+.4f} from frame to frame (95 % of white ones by less than {1.96 / np.sqrt(count):.4f})"
    )


def plot(found: list[tuple[Case, Samples]], path: Path) -> None:
    """Save RMS and bound over range, and the ensemble's NEES over time."""
    figure, axes = plt.subplots(len(found), 4, figsize=(18, 4 * len(found)), layout="constrained", squeeze=False)
    for line, (case, samples) in zip(axes, found, strict=True):
        ranges = np.array(samples.range_m)
        edges = np.geomspace(case.ranges_m[-1], case.ranges_m[0], 25)
        at = np.digitize(ranges, edges)
        kept = [k for k in range(1, len(edges)) if (at == k).any()]
        middle = [float(np.sqrt(edges[k - 1] * edges[k])) for k in kept]
        for axis, index, scale, label in zip(
            line, range(3), (1e3, 1e3, np.rad2deg(1)), ("lateral mm", "axial mm", "tilt deg"), strict=False
        ):
            for values, style, name in ((samples.squares, "o-", "filter, RMS"), (samples.bounds, "k--", "PCRLB")):
                squares = np.array(values)[:, index]
                axis.plot(middle, [scale * np.sqrt(squares[at == k].mean()) for k in kept], style, ms=3, label=name)
            axis.set(xscale="log", yscale="log", xlabel="range m", ylabel=label, title=case.name)
            axis.grid(alpha=0.3, which="both")
        line[0].legend()
        runs = len(set(samples.run))
        frames, means = ensemble(samples, runs)
        low, high = chi2.ppf([0.025, 0.975], STATE_DOF * runs) / (STATE_DOF * runs)
        line[3].axhspan(low, high, color="tab:green", alpha=0.2, label="95 % band")
        line[3].plot(frames / case.rate_hz, means, lw=0.6)
        line[3].set(xlabel="s", ylabel=f"NEES per dof, mean of {runs} runs", title=case.name)
        line[3].legend()
    path.parent.mkdir(exist_ok=True)
    figure.savefig(path, dpi=100)


if __name__ == "__main__":
    main()
