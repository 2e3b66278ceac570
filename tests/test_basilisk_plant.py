"""Basilisk's plant against the linear theory of relative motion and of rigid bodies, and a docking flown on it."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("Basilisk", reason="Basilisk is not installed: make setup EXTRAS=dock")

from astratag.transforms import exp_so3, inverse, rotation_from_wxyz
from pipeline.basilisk_plant import BasiliskPlant
from pipeline.convert import NS_PER_S
from pipeline.dock import DockSource, fly_on_truth
from pipeline.dock_report import judge
from pipeline.dock_scenario import BlindSection, DockScenario, FaultSection, StartSection
from pipeline.hill import clohessy_wiltshire
from pipeline.plant import Departure
from pipeline.replay import differences, replay_direct
from schemas import Guidance, Truth

SCENARIO = DockScenario()
R_HILL_TARGET = rotation_from_wxyz(SCENARIO.target.R_hill_target_wxyz)
R0, V0 = np.array([1.0, 20.0, -2.0]), np.array([0.01, -0.03, 0.02])


def plant(R_hill_chaser: np.ndarray | None = None) -> BasiliskPlant:
    R = np.eye(3) if R_hill_chaser is None else R_hill_chaser
    return BasiliskPlant(SCENARIO, Departure(R0, V0, R, R_HILL_TARGET, np.zeros(3)))


def test_departs_where_it_was_told():
    flight = plant().flight()
    np.testing.assert_allclose(flight.r_hill_m, R0, atol=1e-6)
    np.testing.assert_allclose(flight.v_hill_m_s, V0, atol=1e-8)
    np.testing.assert_allclose(flight.R_hill_target, R_HILL_TARGET, atol=1e-9)
    np.testing.assert_allclose(inverse(flight.relative.T_a_b)[:3, 3], R_HILL_TARGET.T @ R0, atol=1e-6)


def test_drifts_as_clohessy_and_wiltshire_say():
    """Over 200 s to a millimetre: what is left is the curvature of the orbit."""
    flown = plant()
    flown.advance(200 * NS_PER_S, np.zeros(3), np.zeros(3))
    expected = clohessy_wiltshire(SCENARIO.orbit.rate_rad_s, 200.0)[0] @ np.concatenate([R0, V0])
    flight = flown.flight()
    np.testing.assert_allclose(np.concatenate([flight.r_hill_m, flight.v_hill_m_s]), expected, atol=1e-3)
    np.testing.assert_allclose(flight.R_hill_target, R_HILL_TARGET, atol=1e-6)


def test_force_accelerates_along_the_chasers_own_axes():
    R_hill_chaser = exp_so3(np.array([0.3, -0.2, 0.9]))
    pushed, drifting = plant(R_hill_chaser), plant(R_hill_chaser)
    force = np.array([10.0, 0.0, 0.0])
    pushed.advance(2 * NS_PER_S, force, np.zeros(3))
    drifting.advance(2 * NS_PER_S, np.zeros(3), np.zeros(3))
    gained = pushed.flight().v_hill_m_s - drifting.flight().v_hill_m_s
    np.testing.assert_allclose(gained, R_hill_chaser @ force / SCENARIO.chaser.mass_kg * 2, rtol=2e-3, atol=2e-4)


def test_torque_turns_the_chaser():
    turned = plant()
    turned.advance(1 * NS_PER_S, np.zeros(3), np.array([0.0, 0.3, 0.0]))
    rate = turned.flight().omega_hill_chaser_in_chaser_rad_s[1]
    assert rate == pytest.approx(0.3 / SCENARIO.chaser.inertia_kg_m2[1], rel=1e-2)


def test_velocities_are_the_derivatives_of_positions():
    """Central differences of the relative pose agree with the velocity that the truth states."""
    flown, h_ns = plant(exp_so3(np.array([0.1, 0.2, 3.0]))), 50_000_000
    torque = np.array([0.5, -0.4, 0.3])
    poses = []
    for k in range(1, 4):
        flown.advance(20 * NS_PER_S + k * h_ns, np.zeros(3), torque)
        poses.append(flown.flight().relative)
    numeric = (poses[2].T_a_b[:3, 3] - poses[0].T_a_b[:3, 3]) / (2 * h_ns / NS_PER_S)
    np.testing.assert_allclose(poses[1].v_a_b_m_s, numeric, atol=2e-4)


def test_docks_on_truth_for_less_than_a_metre_a_second():
    docking = judge(fly_on_truth(SCENARIO), SCENARIO.mission)
    assert docking.docked
    assert docking.delta_v_m_s < 1.0


@pytest.mark.slow
def test_docks_from_20_m_on_pictures_and_blinded_holds_safely():
    """The whole of it: 2 % dropped frames, noise, contact inside the box; blinded at 3 m, a retreat."""
    for blind in (None, BlindSection(below_m=3.0)):
        scenario = SCENARIO.model_copy(update={"faults": FaultSection(blind=blind)})
        tape = _Logbook()
        replay_direct(DockSource(scenario), [tape])
        docking = judge(list(zip(tape.truths, tape.guidance, strict=True)), scenario.mission, fly_on_truth(scenario))
        assert docking.outside_corridor_s == 0
        if blind is None:
            assert docking.docked
            assert docking.delta_v_ratio is not None
            assert docking.delta_v_ratio < 1.5
        else:
            assert docking.end == "SAFE"
            assert docking.closest_m > 2.0


class _Logbook:
    """A sink that keeps truth and guidance."""

    def __init__(self) -> None:
        self.truths: list[Truth] = []
        self.guidance: list[Guidance] = []

    def write(self, envelope, t_receipt_ns: int) -> None:
        if envelope.topic.schema is Truth:
            self.truths.append(envelope.message())
        elif envelope.topic.schema is Guidance:
            self.guidance.append(envelope.message())

    def close(self) -> None: ...


@pytest.mark.slow
def test_over_the_bus_and_in_one_process_a_docking_is_the_same(tmp_path: Path):
    scenario = DockScenario(start=StartSection(axial_m=0.5, position_sigma_m=0.02))
    path = tmp_path / "near.json"
    path.write_text(scenario.to_json())
    for name, flags in (("bus", []), ("direct", ["--direct"])):
        command = [sys.executable, "-m", "nodes", "dock", str(path), "--view", "none", "--out", str(tmp_path / name)]
        subprocess.run([*command, *flags], cwd=Path(__file__).parents[1], check=True, capture_output=True)
        assert json.loads((tmp_path / name / "docking.json").read_text())["docked"]
    assert differences(tmp_path / "bus" / "run.mcap", tmp_path / "direct" / "run.mcap") == []
