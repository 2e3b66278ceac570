"""What a run leaves behind: one whole recording, its .rrd, its score, its report, and a word on what to try next."""

from __future__ import annotations

import contextlib
import fcntl
import os
import sys
from collections.abc import Iterator
from pathlib import Path

from rich.console import Console
from rich.markup import escape

from nodes.recorder import existing_parts, join_parts
from nodes.supervisor import Outcome
from pipeline.mission import Mission

RRD, SUMMARY, REPORT, DOCKING = "run.rrd", "summary.json", "report.png", "docking.json"


@contextlib.contextmanager
def folder_for_results(out: Path, spec: str, *, overwrite: bool) -> Iterator[None]:
    """Make the folder ours for as long as the run lasts.

    ``overwrite`` takes away the files of an earlier run, and only those: a replay can be had again, a live run
    cannot.  Raises ValueError when the folder cannot be written, is another run's, or holds what may not be lost.
    """
    stale = [*existing_parts(out), *(out / name for name in (RRD, SUMMARY, REPORT, DOCKING))]
    if Path(spec).resolve() in [path.resolve() for path in stale]:
        raise ValueError(f"{spec} would be overwritten by its own replay: choose another folder with --out")
    with contextlib.ExitStack() as stack:
        try:
            out.mkdir(parents=True, exist_ok=True)
            folder = os.open(out, os.O_RDONLY)
            stack.callback(os.close, folder)
            fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if not overwrite and existing_parts(out):
                raise ValueError(f"{out} holds the recording of an earlier run: choose another folder with --out")
            for path in stale:
                path.unlink(missing_ok=True)
        except BlockingIOError as error:
            raise ValueError(f"another run writes to {out}: choose another folder with --out") from error
        except OSError as error:
            raise ValueError(f"cannot write to {out}: {error.strerror}") from error
        yield


def finish_results(out: Path, mission: Mission, outcome: Outcome, console: Console) -> None:
    """Make recording and .rrd whole, score the run, write summary and report, and print the table.

    Raises ValueError when the run left nothing to score.
    """
    from pipeline.report import write_report
    from pipeline.scoring import print_table, score, write_summary

    recording = join_parts(out, mission)
    if "viewer" in outcome.died:
        _draw_again(recording, out / RRD)
    summary = score(recording)
    write_summary(summary, out / SUMMARY)
    write_report(recording, summary, out / REPORT)
    print_table(summary, console)
    written = ", ".join(escape(str(path)) for path in (recording, out / RRD, out / SUMMARY, out / REPORT))
    console.print(f"written: {written}")
    console.print(f"try next: [bold]{escape(_rerun_command(out / RRD))}[/bold]")


def _rerun_command(rrd_path: Path) -> str:
    """Return the command that opens a .rrd: in Rerun's window, or in a browser where no window can open."""
    from pipeline.view import has_display

    program = Path(sys.prefix, "bin", "rerun")
    if program.is_relative_to(Path.cwd()):
        program = program.relative_to(Path.cwd())
    return f"{program} {rrd_path}" if has_display() else f"{program} --web-viewer {rrd_path}"


def _draw_again(recording: Path, rrd_path: Path) -> None:
    """Write the .rrd from the recording: the viewer did not see all of the run."""
    from pipeline.recording import Recording
    from pipeline.view import Viewer

    recorded = Recording(recording)
    with Viewer(recorded.mission, rrd_path=rrd_path, mode="none") as viewer:
        for envelope, t_receipt_ns in recorded.envelopes():
            viewer.write(envelope, t_receipt_ns)
