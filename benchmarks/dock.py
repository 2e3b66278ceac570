"""Dockings in closed loop, many of them: ``python -m benchmarks.dock [--runs 20] [--blind M] [--json FILE]``.

Each run flies the default scenario with another seed, in lockstep in this process, and once more on truth.  A blinded
run loses its camera to the sun for good when the ports are first nearer than so many metres: it must end in a safe
hold without contact.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import cv2
import numpy as np

from nodes import ONE_THREAD
from pipeline.dock import DockSource, fly_on_truth, require_basilisk
from pipeline.dock_report import Docking, judge
from pipeline.dock_scenario import BlindSection, DockScenario
from pipeline.replay import replay_direct
from schemas import Envelope, Guidance, Truth


class Logbook:
    """A sink that keeps truth and guidance, tick by tick."""

    def __init__(self) -> None:
        self.truths: list[Truth] = []
        self.guidance: list[Guidance] = []

    def write(self, envelope: Envelope, t_receipt_ns: int) -> None:
        """Keep what is of interest."""
        if envelope.topic.schema in (Truth, Guidance):
            message = envelope.message()
            if isinstance(message, Truth):
                self.truths.append(message)
            elif isinstance(message, Guidance):
                self.guidance.append(message)

    def close(self) -> None:
        """Nothing to finish."""


def fly(scenario: DockScenario) -> Docking:
    """Return how a docking in closed loop goes, judged against the same one on truth."""
    logbook = Logbook()
    replay_direct(DockSource(scenario), [logbook])
    return judge(list(zip(logbook.truths, logbook.guidance, strict=True)), scenario.mission, fly_on_truth(scenario))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--blind", type=float, metavar="M", help="blind the camera when nearer than this")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write every run's report")
    args = parser.parse_args()
    require_basilisk()
    cv2.setNumThreads(int(ONE_THREAD["OMP_NUM_THREADS"]))

    scenario = DockScenario()
    if args.blind is not None:
        faults = scenario.faults.model_copy(update={"blind": BlindSection(below_m=args.blind)})
        scenario = scenario.model_copy(update={"faults": faults})
    dockings: list[Docking] = []
    print("seed  end      docked  closest   lateral  closing  misalign  delta-v  ratio  speed")
    for seed in range(args.first_seed, args.first_seed + args.runs):
        began_s = time.process_time()
        docking = fly(scenario.model_copy(update={"seed": seed}))
        dockings.append(docking)
        print_run(seed, docking, docking.duration_s / (time.process_time() - began_s))
        if args.json is not None:
            args.json.write_text(json.dumps([d.model_dump() for d in dockings], indent=2) + "\n")
    docked, safe = sum(docking.docked for docking in dockings), sum(docking.end == "SAFE" for docking in dockings)
    ratios = [docking.delta_v_ratio for docking in dockings if docking.delta_v_ratio is not None]
    print(f"{docked} of {len(dockings)} docked inside the box, {safe} ended in a safe hold")
    print(f"delta-v at most {max(ratios):.2f} times that on truth")


def print_run(seed: int, docking: Docking, times_real: float) -> None:
    """Print one line; the speed is in flown seconds a second of one core, both flights counted."""
    contact = docking.contact
    at_contact = (
        f"{contact.lateral_m * 1e3:5.1f} mm {contact.axial_closing_speed_m_s * 1e3:4.0f} mm/s "
        f"{np.degrees(contact.misalignment_rad):6.2f} deg"
        if contact is not None
        else f"{'':27}"
    )
    print(
        f"{seed:4}  {docking.end:8} {docking.docked!s:6} {docking.closest_m:7.3f} m {at_contact}  "
        f"{docking.delta_v_m_s:5.3f}  {docking.delta_v_ratio or float('nan'):5.2f} {times_real:5.1f}x",
        flush=True,
    )


if __name__ == "__main__":
    main()
