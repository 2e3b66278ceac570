"""The closed loop without Basilisk: contact inside the box, safe actions, and a lockstep that repeats itself."""

from collections.abc import Callable

import numpy as np
import pytest

from pipeline.bridge import NavigationBridge
from pipeline.convert import NS_PER_S, vector_array
from pipeline.dock import START_NS, DockSource, Loop, depart, fly_on_truth
from pipeline.dock_report import Docking, judge
from pipeline.dock_scenario import BlindSection, DockScenario, FaultSection, StartSection
from pipeline.replay import replay_direct
from schemas import Envelope, Guidance, Mode, Phase, RelativeState, Truth
from schemas.topics import FRAME, GUIDANCE, STATE
from tests.fake_plant import FakePlant

SHORT = DockScenario(start=StartSection(axial_m=4.0, position_sigma_m=0.1), seed=3)
Distort = Callable[[float, RelativeState], RelativeState | None]


def honest(truth: Truth) -> RelativeState:
    """Return a state that is the truth to a hundredth of a millimetre."""
    return RelativeState(
        t_capture_ns=truth.t_capture_ns,
        mode=Mode.TRACK,
        T_chaser_target=truth.T_chaser_target,
        v_chaser_target_m_s=truth.v_chaser_target_m_s,
        omega_chaser_target_in_target_rad_s=truth.omega_chaser_target_in_target_rad_s,
        covariance=(1e-10 * np.eye(12)).ravel().tolist(),
        age_s=0.0,
    )


def fly(scenario: DockScenario, distort: Distort = lambda axial_m, state: state) -> list[tuple[Truth, Guidance]]:
    """Fly a scenario on states that ``distort`` makes of honest ones, knowing how far the ports are apart."""
    loop, ticks, axial_m = Loop(scenario, START_NS, depart(scenario, FakePlant)), [], scenario.start.axial_m
    while True:
        truth = loop.look()
        state = distort(axial_m, honest(truth))
        if state is not None:
            loop.bridge.take_state(state)
        guidance, _ = loop.act()
        ticks.append((truth, guidance))
        axial_m = guidance.p_targetport_chaserport_m.z
        if loop.is_over(guidance):
            return ticks


def test_the_chaser_tells_what_it_commands_and_measures():
    """Not what is true: thrusters give some per cent more or less, gyroscope and star tracker have noise."""
    loop = Loop(SHORT, START_NS, depart(SHORT, FakePlant))
    chaser, pushed = SHORT.chaser, 0
    for _ in range(60):
        loop.bridge.take_state(honest(loop.look()))
        flight, t_ns = loop.flight, loop.t_ns
        guidance, told = loop.act()
        assert told.t_capture_ns == t_ns
        commanded = vector_array(guidance.force_chaser_n) / chaser.mass_kg
        assert vector_array(told.acceleration_chaser_m_s2) == pytest.approx(commanded)
        off = vector_array(told.omega_hill_chaser_in_chaser_rad_s) - flight.omega_hill_chaser_in_chaser_rad_s
        assert 0 < np.abs(off).max() < 6 * chaser.rate_noise_rad_s
        pushed += bool(commanded.any())
    assert pushed


def report(ticks: list[tuple[Truth, Guidance]], scenario: DockScenario = SHORT) -> Docking:
    return judge(ticks, scenario.mission)


def phases(ticks: list[tuple[Truth, Guidance]]) -> list[str]:
    return [change.phase for change in report(ticks).phases]


def below(limit_m: float, mode: Mode) -> Distort:
    """Return a pose filter that says ``mode`` from when the ports are first nearer than a limit."""
    began = []

    def distort(axial_m: float, state: RelativeState) -> RelativeState:
        began.extend([axial_m] if axial_m < limit_m else [])
        if not began:
            return state
        if mode in (Mode.INIT, Mode.LOST):
            return RelativeState(t_capture_ns=state.t_capture_ns, mode=mode)
        return state.model_copy(update={"mode": mode})

    return distort


@pytest.mark.parametrize("seed", range(3))
def test_docks_inside_the_box_on_good_states(seed: int):
    scenario = SHORT.model_copy(update={"seed": seed})
    docking = report(fly(scenario))
    assert docking.docked, docking
    assert docking.outside_corridor_s == 0
    assert [change.phase for change in docking.phases] == ["ACQUIRE", "APPROACH", "HOLD_POINT", "APPROACH", "CONTACT"]


@pytest.mark.parametrize("mode", [Mode.AMBIGUOUS, Mode.COAST, Mode.LOST])
def test_a_state_not_to_be_flown_on_leads_to_a_hold_and_a_retreat(mode: Mode):
    """Whatever the filter says, it is not flown on: the chaser stands, backs off and never touches."""
    ticks = fly(SHORT, below(3.0, mode))
    docking = report(ticks)
    assert phases(ticks)[-3:] == ["HOLD", "RETREAT", "SAFE"]
    assert docking.closest_m > 2.3
    last = docking.phases[-1]
    assert last.phase == Phase.SAFE.name
    assert ticks[-1][1].p_targetport_chaserport_m.z > 4.5


def test_a_loss_near_the_port_ends_without_contact():
    docking = report(fly(SHORT, below(0.6, Mode.LOST)))
    assert docking.end == "SAFE"
    assert docking.closest_m > 0.2


def test_past_the_point_of_no_return_the_chaser_goes_on_to_contact():
    assert report(fly(SHORT, below(0.12, Mode.LOST))).docked


def test_without_any_state_the_chaser_does_not_approach():
    ticks = fly(SHORT, lambda axial_m, state: None)
    assert phases(ticks)[:2] == ["ACQUIRE", "RETREAT"]
    assert report(ticks).closest_m > 3.0


def test_a_hold_ends_when_the_states_come_back():
    """Three seconds without states: hold, then on to contact."""
    began: list[int] = []

    def outage(axial_m: float, state: RelativeState) -> RelativeState | None:
        if axial_m < 3.0 and not began:
            began.append(state.t_capture_ns)
        out = began and state.t_capture_ns - began[0] < 3 * NS_PER_S
        return None if out else state

    ticks = fly(SHORT, outage)
    assert phases(ticks)[2:4] == ["HOLD", "APPROACH"]
    assert report(ticks).docked


def test_a_jump_of_the_state_is_refused():
    """A pose half a metre off that claims to be certain is no measurement: a hold, not a lunge."""

    def jump(axial_m: float, state: RelativeState) -> RelativeState:
        if axial_m > 3.0:
            return state
        T = state.T_chaser_target
        assert T is not None
        moved = T.translation_m.model_copy(update={"x": T.translation_m.x - 0.5})
        return state.model_copy(update={"T_chaser_target": T.model_copy(update={"translation_m": moved})})

    docking = report(fly(SHORT.model_copy(update={"duration_max_s": 40.0}), jump))
    assert "HOLD" in [change.phase for change in docking.phases]
    assert docking.closest_m > 2.3


def test_stale_states_are_not_fresh():
    """States of one instant again and again are one measurement, and it grows old."""
    loop = Loop(SHORT, START_NS, depart(SHORT, FakePlant))
    first = honest(loop.look())
    for _ in range(30):
        loop.bridge.take_state(first)
        loop.act()
        loop.look()
    assert loop.bridge.navigation(loop.t_ns).age_s == pytest.approx(6.0)


def test_the_bridge_never_hands_out_zeros():
    """Before any state it reckons with what it was told at the start, and says so."""
    loop = Loop(SHORT, START_NS, depart(SHORT, FakePlant))
    loop.look()
    navigation = loop.bridge.navigation(loop.t_ns)
    assert isinstance(loop.bridge, NavigationBridge)
    assert navigation.age_s is None
    assert np.linalg.norm(navigation.r_hill_m) > 3.0


def test_the_same_seed_flies_the_same_on_truth():
    one, other = (fly_on_truth(SHORT, FakePlant) for _ in range(2))
    assert one == other
    assert one != fly_on_truth(SHORT.model_copy(update={"seed": 4}), FakePlant)


class Tape:
    """A sink that keeps all but the frames' entry times."""

    def __init__(self) -> None:
        self.envelopes: list[Envelope] = []

    def write(self, envelope: Envelope, t_receipt_ns: int) -> None:
        self.envelopes.append(envelope)

    def close(self) -> None: ...

    def kept(self) -> list[tuple[str, int, bytes]]:
        return [(e.key, e.stamp.sequence, e.payload) for e in self.envelopes]


def flown(scenario: DockScenario) -> Tape:
    tape = Tape()
    replay_direct(DockSource(scenario, build_plant=FakePlant), [tape])
    return tape


NEAR = DockScenario(
    start=StartSection(axial_m=0.35, position_sigma_m=0.01, velocity_sigma_m_s=0.0), faults=FaultSection(drop_share=0.1)
)


def test_pictures_close_the_loop_to_contact_and_repeat_to_the_byte():
    """Rendered, detected, filtered and flown, twice."""
    one = flown(NEAR)
    guidance = [e.message() for e in one.envelopes if e.topic is GUIDANCE]
    assert guidance[-1].phase is Phase.CONTACT
    frames, states = ([e for e in one.envelopes if e.topic is topic] for topic in (FRAME, STATE))
    assert [e.stamp.sequence for e in frames] == [e.stamp.sequence for e in states] == list(range(len(frames)))
    assert len(frames) < len(guidance), "some frames were dropped"
    assert one.kept() == flown(NEAR).kept()


def test_a_blinded_camera_sees_nothing():
    faults = FaultSection(drop_share=0.0, blind=BlindSection(below_m=1.0))
    blind = flown(NEAR.model_copy(update={"faults": faults, "duration_max_s": 2.0}))
    states = [e.message() for e in blind.envelopes if e.topic is STATE]
    assert {state.mode for state in states} == {Mode.INIT}
