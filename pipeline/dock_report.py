"""How a docking went: its end, the contact against the docking box, and what it cost against a flight on truth."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from pydantic import BaseModel, ConfigDict
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from pipeline.convert import NS_PER_S, pose_matrix, vector_array
from pipeline.corridor import box_violations, port_to_port
from pipeline.dock import fly_on_truth
from pipeline.dock_scenario import DockScenario
from pipeline.mission import Mission
from pipeline.recording import Recording
from schemas import Guidance, Phase, PortToPort, Truth
from schemas.topics import GUIDANCE, TRUTH


class PhaseChange(BaseModel):
    """When guidance went to another phase, and why."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    t_s: float
    phase: str
    reason: str


class Docking(BaseModel):
    """The contents of docking.json: all from truth and guidance, none from the pose filter."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    docked: bool
    """Contact was made, inside the docking box."""
    end: str
    """The last phase."""
    violations: list[str]
    """What the contact broke of the docking box."""
    contact: PortToPort | None
    """True motion of the chaser's port at contact."""
    angular_rate_rad_s: float | None
    closest_m: float
    """Least distance of the ports along the target port's axis."""
    outside_corridor_s: float
    """Time inside the keep-out sphere and outside the corridor, until contact."""
    duration_s: float
    delta_v_m_s: float
    delta_v_on_truth_m_s: float | None
    delta_v_ratio: float | None
    phases: list[PhaseChange]


def report_docking(recording: Path, scenario: DockScenario, *, fly_truth: bool = True) -> Docking:
    """Return how the recorded docking of a scenario went.  Raises ValueError when the recording is not one."""
    recorded = Recording(recording)
    truths = {truth.t_capture_ns: truth for truth in recorded.messages(TRUTH)}
    flown = [(truths[g.t_capture_ns], g) for g in recorded.messages(GUIDANCE) if g.t_capture_ns in truths]
    reference = fly_on_truth(scenario) if fly_truth else None
    return judge(flown, recorded.mission, reference)


def judge(
    flown: Sequence[tuple[Truth, Guidance]],
    mission: Mission,
    reference: Sequence[tuple[Truth, Guidance]] | None = None,
) -> Docking:
    """Return how a flight went, tick by tick, against the same one on truth."""
    if not flown:
        raise ValueError("the recording holds no guidance: it is not that of a docking")
    ports = [true_port(truth, mission) for truth, _ in flown]
    tick_s = float(np.median(np.diff([g.t_capture_ns for _, g in flown]))) / NS_PER_S if len(flown) > 1 else 0.0
    last_truth, last = flown[-1]
    is_contact = last.phase is Phase.CONTACT
    rate_rad_s = float(np.linalg.norm(vector_array(last_truth.omega_chaser_target_in_target_rad_s)))
    violations = box_violations(mission.corridor.docking_box, ports[-1], rate_rad_s) if is_contact else []
    on_truth_m_s = None if reference is None else reference[-1][1].delta_v_m_s
    start_ns = flown[0][1].t_capture_ns
    return Docking(
        docked=is_contact and not violations,
        end=last.phase.name,
        violations=violations,
        contact=ports[-1] if is_contact else None,
        angular_rate_rad_s=rate_rad_s if is_contact else None,
        closest_m=min(port.axial_m for port in ports),
        outside_corridor_s=tick_s * sum(p.in_keep_out_sphere and not p.in_corridor and p.axial_m > 0 for p in ports),
        duration_s=(last.t_capture_ns - start_ns) / NS_PER_S,
        delta_v_m_s=last.delta_v_m_s,
        delta_v_on_truth_m_s=on_truth_m_s,
        delta_v_ratio=None if not on_truth_m_s else last.delta_v_m_s / on_truth_m_s,
        phases=[
            PhaseChange(t_s=(g.t_capture_ns - start_ns) / NS_PER_S, phase=g.phase.name, reason=g.reason)
            for k, (_, g) in enumerate(flown)
            if k == 0 or g.phase is not flown[k - 1][1].phase
        ],
    )


def true_port(truth: Truth, mission: Mission) -> PortToPort:
    """Return the true motion of the chaser's port past the target's."""
    v, omega = vector_array(truth.v_chaser_target_m_s), vector_array(truth.omega_chaser_target_in_target_rad_s)
    return port_to_port(mission, pose_matrix(truth.T_chaser_target), v, omega)


def print_docking(docking: Docking, console: Console) -> None:
    """Print it for people."""
    table = Table(show_header=False, box=box.SIMPLE_HEAVY, padding=(0, 1))
    table.add_column(style="bold")
    table.add_column()
    for title, text in _lines(docking):
        table.add_row(title, text)
    console.print(table)
    for change in docking.phases:
        console.print(f"  [dim]{change.t_s:8.2f} s[/dim]  {change.phase}: {escape(change.reason)}", highlight=False)


def _lines(docking: Docking) -> list[tuple[str, str]]:
    """Return title and text of each line of the table."""
    verdict = "docked, inside the docking box" if docking.docked else f"[red]not docked[/red], ended in {docking.end}"
    if docking.violations:
        verdict = "[red]contact outside the docking box[/red]: " + "; ".join(docking.violations)
    lines = [("docking", f"{verdict}, after {docking.duration_s:.1f} s")]
    if (contact := docking.contact) is not None:
        lines += [
            (
                "contact",
                f"closing {contact.axial_closing_speed_m_s * 1e3:.1f} mm/s, lateral {contact.lateral_m * 1e3:.1f} mm "
                f"and {contact.lateral_speed_m_s * 1e3:.1f} mm/s, misalignment "
                f"{np.degrees(contact.misalignment_rad):.2f}°, roll {np.degrees(contact.roll_rad):.2f}°, "
                f"{np.degrees(docking.angular_rate_rad_s or 0.0):.3f}°/s",
            )
        ]
    else:
        lines += [("closest", f"{docking.closest_m:.2f} m from port to port")]
    ratio = "" if docking.delta_v_ratio is None else f", {docking.delta_v_ratio:.2f} times that on truth"
    lines += [
        ("delta-v", f"{docking.delta_v_m_s:.3f} m/s{ratio}"),
        ("outside the corridor", f"{docking.outside_corridor_s:.1f} s inside the keep-out sphere"),
    ]
    return lines
