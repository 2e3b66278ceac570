"""Port-to-port quantities and corridor flags, against cases worked out by hand and against finite differences."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from astratag.transforms import exp_so3, pose, wxyz_from_rotation
from pipeline.corridor import box_violations, in_corridor, next_hold_point_m, port_to_port
from pipeline.mission import CorridorSection, DockingBoxSection, Mission, PoseSection
from schemas import PortToPort

FACING = np.diag([1.0, -1.0, -1.0])
"""R_chaser_target when both vehicles' z axes, and so their default ports, face each other with x parallel."""
STILL = np.zeros(3)


def at(t_chaser_target, R_chaser_target=FACING, v=STILL, omega=STILL, mission=None) -> PortToPort:
    T_chaser_target = pose(R_chaser_target, t_chaser_target)
    return port_to_port(mission or Mission(), T_chaser_target, np.asarray(v), np.asarray(omega))


def test_straight_ahead():
    """One metre before the port, closing at 5 cm/s."""
    port = at((0, 0, 1), v=(0, 0, -0.05))
    assert port.range_m == port.axial_m == pytest.approx(1.0)
    assert port.closing_speed_m_s == pytest.approx(0.05)
    for zero in (port.lateral_m, port.lateral_speed_m_s, port.misalignment_rad, port.roll_rad, port.corridor_angle_rad):
        assert zero == pytest.approx(0.0, abs=1e-12)
    assert port.in_corridor


def test_offset_to_the_side():
    """A target 0.3 m to the chaser's right at 0.4 m ahead is 0.5 m away, at 36.9 degrees off the axis."""
    port = at((0.3, 0, 0.4), v=(0.03, 0, 0))
    assert (port.range_m, port.axial_m, port.lateral_m) == pytest.approx((0.5, 0.4, 0.3))
    assert port.corridor_angle_rad == pytest.approx(np.arctan2(3, 4))
    assert port.lateral_speed_m_s == pytest.approx(0.03)
    assert port.closing_speed_m_s == pytest.approx(-0.03 * 0.6)
    assert not port.in_corridor


def test_a_turning_target_sweeps_its_port_past_the_chaser():
    """The chaser hangs 2 m before a target that turns at 0.01 rad/s: seen from the port it moves at 20 mm/s."""
    port = at((0, 0, 2), omega=(0, 0.01, 0))
    assert port.lateral_speed_m_s == pytest.approx(0.02)
    assert port.closing_speed_m_s == pytest.approx(0.0, abs=1e-12)


def test_ports_are_measured_not_origins():
    """Ports 0.2 m and 0.3 m ahead of their origins shorten one metre to a half."""
    mission = Mission(
        T_chaser_port=PoseSection(translation_m=(0, 0, 0.2)), T_target_port=PoseSection(translation_m=(0, 0, 0.3))
    )
    assert at((0, 0, 1), mission=mission).range_m == pytest.approx(0.5)


def test_a_port_on_the_side_faces_sideways():
    """A target port out of the target's x, seen from 1 m along it by a chaser whose port looks back, is aligned."""
    quarter = exp_so3((0, np.pi / 2, 0))  # z of the port along x of the target
    mission = Mission(T_target_port=PoseSection(rotation_wxyz=tuple(wxyz_from_rotation(quarter))))
    port = at((0, 0, 1), FACING @ quarter.T, mission=mission)
    assert port.axial_m == pytest.approx(1.0)
    assert port.misalignment_rad == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("roll_deg", [-120.0, -5.0, 0.0, 30.0, 175.0])
@pytest.mark.parametrize("tilt_deg", [0.0, 4.0])
def test_roll_and_misalignment(roll_deg, tilt_deg):
    """The chaser rolled about the target port's z, then tilted about its own x."""
    R_target_chaser = exp_so3((0, 0, np.deg2rad(roll_deg))) @ FACING @ exp_so3((np.deg2rad(tilt_deg), 0, 0))
    port = at((0, 0, 1), R_target_chaser.T)
    assert port.roll_rad == pytest.approx(np.deg2rad(roll_deg))
    assert port.misalignment_rad == pytest.approx(np.deg2rad(tilt_deg), abs=1e-7)


@pytest.mark.parametrize(
    ("axial_m", "lateral_m", "inside"),
    [(1.0, 0.0, True), (1.0, 0.196, True), (1.0, 0.197, False), (0.0, 0.02, True), (0.0, 0.021, False)]
    + [(-0.01, 0.0, False), (50.0, 8.8, True)],
)
def test_corridor_is_a_cone_with_a_mouth(axial_m, lateral_m, inside):
    """10 degrees about the axis, 20 mm wide at the port: 196.3 mm at one metre."""
    assert in_corridor(CorridorSection(), axial_m=axial_m, lateral_m=lateral_m) is inside


def test_in_contact_nothing_is_nan():
    """Ports on top of each other: the range has no direction, the closing speed is along the axis."""
    port = at((0, 0, 0), v=(0, 0, -0.05))
    assert port.range_m == 0.0
    assert port.closing_speed_m_s == pytest.approx(0.05)


numbers = st.floats(-1.0, 1.0)
vectors = st.tuples(numbers, numbers, numbers).map(np.array)


@settings(deadline=None, max_examples=60)
@given(position=vectors, theta=vectors, v=vectors, omega=vectors, chaser_port=vectors, target_port=vectors)
def test_speeds_are_rates_of_change(position, theta, v, omega, chaser_port, target_port):
    """Closing speed is the range's rate of change, whatever moves: the chaser, the target, or its turning."""
    mission = Mission(
        T_chaser_port=PoseSection(translation_m=tuple(chaser_port)),
        T_target_port=PoseSection(
            translation_m=tuple(target_port), rotation_wxyz=tuple(wxyz_from_rotation(exp_so3(theta[::-1])))
        ),
    )
    position = position + (0, 0, 5)
    h = 1e-5

    def later(t):
        return at(position + v * t, exp_so3(theta) @ exp_so3(omega * t), v, omega, mission)

    rate = (later(h).range_m - later(-h).range_m) / (2 * h)
    assert later(0).closing_speed_m_s == pytest.approx(-rate, abs=1e-6)


def test_the_keep_out_sphere_is_about_the_target_not_its_port():
    mission = Mission(
        T_target_port=PoseSection(translation_m=(0.0, 0.0, 2.0)), corridor=CorridorSection(keep_out_radius_m=5.0)
    )
    assert not at((0, 0, 5.5), mission=mission).in_keep_out_sphere
    assert at((0, 0, 4.5), mission=mission).in_keep_out_sphere


@pytest.mark.parametrize(("axial_m", "ahead_m"), [(25.0, 20.0), (20.0, 20.0), (19.9, 2.0), (1.9, None)])
def test_the_next_hold_point_is_the_nearest_one_ahead(axial_m, ahead_m):
    assert next_hold_point_m(CorridorSection(hold_points_m=(20.0, 2.0)), axial_m) == ahead_m


def test_hold_points_come_farthest_first():
    with pytest.raises(ValueError, match="farthest first"):
        CorridorSection(hold_points_m=(2.0, 20.0))
    with pytest.raises(ValueError, match="must be nearer than start_m"):
        CorridorSection(stop_m=2.0)


GOOD = {"R_chaser_target": FACING, "v": (0.0, 0.0, -0.07)}
TILTED, ROLLED = (FACING @ exp_so3(np.deg2rad(5.0) * np.array(axis)) for axis in ((1, 0, 0), (0, 0, 1)))


@pytest.mark.parametrize(
    ("contact", "broken"),
    [
        (GOOD, []),
        (GOOD | {"v": (0.0, 0.0, -0.04)}, ["closing speed"]),
        (GOOD | {"v": (0.0, 0.0, -0.11)}, ["closing speed"]),
        (GOOD | {"v": (0.05, 0.0, -0.07)}, ["lateral speed"]),
        (GOOD | {"t_chaser_target": (0.11, 0.0, 0.0)}, ["lateral"]),
        (GOOD | {"R_chaser_target": TILTED}, ["misalignment"]),
        (GOOD | {"R_chaser_target": ROLLED}, ["roll"]),
        (GOOD | {"omega": (0.0, 0.0, np.deg2rad(0.3))}, ["angular rate"]),
    ],
)
def test_the_docking_box_is_the_standards(contact, broken):
    """International Docking System Standard: each limit by itself, and the flag of the state with it."""
    port = at(**({"t_chaser_target": (0.0, 0.0, 0.0)} | contact))
    rate_rad_s = float(np.linalg.norm(contact.get("omega", STILL)))
    violations = box_violations(DockingBoxSection(), port, rate_rad_s)
    assert [line[: len(name)] for line, name in zip(violations, broken, strict=True)] == broken
    assert port.in_docking_box == (not broken)
