# ruff: noqa: E402
"""Run the detection benchmark: tables on the console, ``results.json`` and figures in ``out/detection``.

Everything is seeded; the seeds are printed and saved.  Times are CPU milliseconds of one thread: BLAS and OpenCV are
held to one, and so are the peers.
"""

from __future__ import annotations

import os

for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")

import argparse
import json
import multiprocessing
import platform
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path

from rich.console import Console
from rich.progress import MofNCompleteColumn, Progress, TimeElapsedColumn
from rich.table import Table

from benchmarks.detection.clutter import measure_clutter
from benchmarks.detection.cost import measure_cost
from benchmarks.detection.covariance import CELLS, CONFIDENCE, SURFACES, measure_covariance
from benchmarks.detection.false_accepts import FIRST_SEED, measure_false_accepts
from benchmarks.detection.figures import draw_condition, draw_cost, draw_covariance, rows_of
from benchmarks.detection.peers import ENTRANTS, TRACKED, Entrant
from benchmarks.detection.profile import measure_profile
from benchmarks.detection.recall import SIZES, measure
from benchmarks.detection.scenes import CONDITIONS, Condition

REAL_FRAMES = Path(__file__).resolve().parents[3] / "shared" / "reference" / "frames"
PARTS = (*(condition.name for condition in CONDITIONS), "covariance", "cost", "clutter", "profile", "false-accepts")
CONSOLE = Console(width=200)


def recall(
    conditions: Sequence[Condition], images: int, processes: int, entrants: tuple[Entrant, ...]
) -> Iterator[tuple[Condition, list[dict]]]:
    """Yield each condition with its rows as soon as all its cells are measured, by several processes."""
    if not conditions:
        return
    names = tuple(entrant.name for entrant in entrants)
    rows: dict[str, list[dict]] = {condition.name: [] for condition in conditions}
    cells = [(c.name, value, images, names) for c in conditions for value in c.values]
    left = Counter(name for name, *_ in cells)
    named = {condition.name: condition for condition in conditions}
    for (name, *_), measured in side_by_side(measure, cells, processes, f"recall, {images} images a cell"):
        rows[name] += measured
        left[name] -= 1
        if not left[name]:
            yield named[name], rows[name]


def covariances(images: int, processes: int) -> list[dict]:
    """Return the rows of all cells whose covariances are looked at, in their order."""
    cells = [(name, value, images) for name, values in CELLS.items() for value in values]
    description = f"covariances, {images} images a cell"
    rows = dict(side_by_side(measure_covariance, cells, processes, description))
    return [row for cell in cells for row in rows[cell]]


def side_by_side(
    measure: Callable[..., list[dict]], cells: Sequence[tuple], processes: int, description: str
) -> Iterator[tuple[tuple, list[dict]]]:
    """Yield each cell, the arguments it is measured with, and its rows, as soon as one of the processes has them."""
    context = multiprocessing.get_context("spawn")
    with (
        ProcessPoolExecutor(processes, mp_context=context) as pool,
        Progress(*Progress.get_default_columns(), MofNCompleteColumn(), TimeElapsedColumn(), console=CONSOLE) as bar,
    ):
        jobs = {pool.submit(measure, *cell): cell for cell in cells}
        for job in bar.track(as_completed(jobs), len(jobs), description=description):
            yield jobs[job], job.result()


def show_condition(condition: Condition, rows: Sequence[dict], entrants: Iterable[Entrant]) -> None:
    """Print an entrant's per cent found, wrong and misplaced readings and corner error, a line for each size."""
    seeds = sorted({(row["value"], row["first_seed"]) for row in rows if row["condition"] == condition.name})
    table = Table(title=f"{condition.name}: {condition.label}", title_justify="left", box=None)
    table.add_column("found, % !wrong ?misplaced (corner RMS, px)", no_wrap=True)
    for value in condition.values:
        table.add_column(f"{value:g}", justify="right", no_wrap=True)
    for size in SIZES:
        for entrant in entrants:
            mine = rows_of(rows, condition.name, entrant.name, size)
            if size == SIZES[0] or mine[0]["size"] == size:
                table.add_row(f"{entrant.name} ({size})", *(cell_text(row) for row in mine))
    if condition.asked:
        table.add_row("asked of AstraTag", *(f"{condition.asked.get(value, ''):}" for value in condition.values))
    CONSOLE.print(table)
    CONSOLE.print(f"first seeds: {', '.join(f'{value:g}: {seed}' for value, seed in seeds)}\n", style="dim")


def cell_text(row: dict) -> str:
    """Return one cell of the table."""
    wrong = (f"!{row['wrong']} " if row["wrong"] else "") + (f"?{row['misplaced']} " if row["misplaced"] else "")
    corner = f" ({row['corner_rms_px']:.2f})" if row["corner_rms_px"] is not None else ""
    return f"{wrong}{100 * row['recall']:.0f}{corner}"


def show_covariance(rows: Sequence[dict]) -> None:
    """Print the mean NEES of each cell beside its band, how often the other planar pose was right, and errors' size."""
    title = (
        f"NEES a degree of freedom, ! outside its {CONFIDENCE:.0%} band (other planar pose right, of so many expected)"
    )
    table = Table(title=title, title_justify="left", box=None)
    for heading in ("", "", *(f"surface {surface}" for surface in SURFACES), "band", "error / bound"):
        table.add_column(heading)
    for name, values in CELLS.items():
        for value in values:
            mine = [row for row in rows if (row["condition"], row["value"]) == (name, value)]
            low, high = mine[0]["nees_95"]
            band, bound = f"{low:.2f} to {high:.2f}", f"{mine[0]['times_bound']:.1f}"
            table.add_row(name, f"{value:g}", *(nees_text(row) for row in mine), band, bound)
    CONSOLE.print(table)
    CONSOLE.print(f"first seeds: {', '.join(str(row['first_seed']) for row in rows[:: len(SURFACES)])}\n", style="dim")


def nees_text(row: dict) -> str:
    """Return one cell of that table."""
    low, high = row["nees_95"]
    other = f" ({row['other_pose']} of {row['other_pose_expected']:.1f})" if row["other_pose_expected"] >= 0.05 else ""
    return f"{'' if low <= row['nees'] <= high else '!'}{row['nees']:.2f}{other}"


def show_cost(rows: Sequence[dict]) -> None:
    """Print CPU milliseconds a frame, and how many times those of AstraTag's search."""
    table = Table(title="CPU ms a frame, one thread (times AstraTag's search)", title_justify="left", box=None)
    sizes = list(dict.fromkeys(row["image"] for row in rows))
    table.add_column("")
    for size in sizes:
        table.add_column(size, justify="right")
    for name in dict.fromkeys(row["entrant"] for row in rows):
        mine = {row["image"]: row for row in rows if row["entrant"] == name}
        cells = (f"{mine[size]['cpu_ms']:.2f} ({mine[size]['of_astratag']:.2f}x)" for size in sizes)
        table.add_row(name, *cells)
    CONSOLE.print(table)


def show_clutter(rows: Sequence[dict]) -> None:
    """Print CPU milliseconds of pictures without a marker, and how many times those of a plain one with one."""
    title = "Pictures without a marker: CPU ms of the median and of the worst (times a plain one with a marker)"
    table = Table(title=title, title_justify="left", box=None)
    sizes = list(dict.fromkeys(row["image"] for row in rows))
    table.add_column("")
    for size in sizes:
        table.add_column(size, justify="right")
    for name in dict.fromkeys(row["entrant"] for row in rows):
        mine = {row["image"]: row for row in rows if row["entrant"] == name}
        cells = (
            f"{row['median_ms']:.1f} ({row['median_times']:.1f}x), {row['worst_ms']:.1f} ({row['worst_times']:.1f}x)"
            for row in (mine[size] for size in sizes)
        )
        table.add_row(name, *cells)
    CONSOLE.print(table)


def show_profile(rows: Sequence[dict]) -> None:
    """Print how a search's CPU time divides between OpenCV, the compiled functions, and the Python around them."""
    table = Table(title="A search, CPU ms", title_justify="left", box=None)
    for heading in ("", "all", "OpenCV", "compiled", "Python", "most of OpenCV's", "most of the compiled"):
        table.add_column(heading)
    for row in rows:
        native = [sum(row[kind].values()) for kind in ("OpenCV", "compiled")]
        parts = (f"{ms:.2f} ({ms / row['cpu_ms']:.0%})" for ms in (*native, row["cpu_ms"] - sum(native)))
        most = (", ".join(f"{f} {ms:.2f}" for f, ms in list(row[kind].items())[:3]) for kind in ("OpenCV", "compiled"))
        table.add_row(row["image"], f"{row['cpu_ms']:.2f}", *parts, *most)
    CONSOLE.print(table)


def show_false_accepts(result: dict) -> None:
    """Print who saw markers where there were none."""
    CONSOLE.print(
        f"\nFalse accepts: {result['candidates']} candidates in {result['frames']} pictures without a marker, from "
        f"{len(result['textures'])} textures, first seed {FIRST_SEED}.  Counted: {result['counted']}."
    )
    for row in result["entrants"]:
        CONSOLE.print(f"  {row['entrant']:28} {row['reports']}")


def save(results: dict[str, object], folder: Path) -> Path:
    """Write what there is so far, and return where."""
    path = folder / "results.json"
    path.write_text(json.dumps(results, indent=1) + "\n")
    return path


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.detection", description=__doc__)
    parser.add_argument("--images", type=int, default=50, help="images a cell (50)")
    parser.add_argument("--candidates", type=int, default=100_000, help="false-accept candidates (100000)")
    parser.add_argument("--only", default=",".join(PARTS), help=f"parts, of {','.join(PARTS)}")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--textures", type=Path, default=REAL_FRAMES if REAL_FRAMES.is_dir() else None)
    parser.add_argument("--out", type=Path, default=Path("out/detection"))
    options = parser.parse_args()
    parts = options.only.split(",")
    if unknown := set(parts) - set(PARTS):
        parser.error(f"--only: no part is called {', '.join(sorted(unknown))}; there are {', '.join(PARTS)}")
    entrants = tuple(entrant for entrant in ENTRANTS if not entrant.absent)
    for entrant in ENTRANTS:
        if entrant.absent:
            CONSOLE.print(f"{entrant.name}: left out, {entrant.needs} is not installed (make setup EXTRAS=peers)")
    options.out.mkdir(parents=True, exist_ok=True)
    results: dict[str, object] = {"machine": platform.processor() or platform.machine(), "images": options.images}
    conditions = [condition for condition in CONDITIONS if condition.name in parts]
    if "cost" in parts:
        results["cost"] = cost = measure_cost(options.images, (*entrants, TRACKED))
        show_cost(cost)
        draw_cost(cost, options.out)
    if "clutter" in parts:
        results["clutter"] = cluttered = measure_clutter(entrants)
        show_clutter(cluttered)
    if "profile" in parts:
        results["profile"] = profile = measure_profile(options.images)
        show_profile(profile)
    if "covariance" in parts:
        results["covariance"] = consistency = covariances(options.images, options.processes)
        show_covariance(consistency)
        draw_covariance(consistency, options.out)
    results["recall"] = measured = []
    for condition, rows in recall(conditions, options.images, options.processes, entrants):
        show_condition(condition, rows, entrants)
        draw_condition(condition, rows, options.out)
        measured += rows
        save(results, options.out)
    if "false-accepts" in parts:
        results["false_accepts"] = accepts = measure_false_accepts(options.candidates, options.textures, entrants)
        show_false_accepts(accepts)
    CONSOLE.print(f"saved in {save(results, options.out)}")


if __name__ == "__main__":
    main()
