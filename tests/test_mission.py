"""The mission file: defaults that work, YAML and JSON alike, and errors that name the file and the field."""

import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import BaseModel

from astratag.surface import Cylinder, Flat
from pipeline import mission as module
from pipeline.mission import CylinderSection, MarkerSection, Mission, PoseSection, Section

YAML = """\
vehicle: servicer
camera:
  name: aft
  T_chaser_cam: {translation_m: [0.1, 0, 0.2], rotation_wxyz: [0.5, 0.5, 0.5, 0.5]}
markers:
  - {id: 4, side_m: 0.05, surface: {kind: cylinder, radius_m: 0.2, axis_rad: 1.5}}
  - id: 9
    T_target_marker: {translation_m: [0, 0.3, 0]}
filter: {coast_s: 2}
"""


def test_every_default_works() -> None:
    mission = Mission.parse("", source="nothing")
    assert mission == Mission()
    assert mission.markers == ()
    np.testing.assert_array_equal(mission.camera.T_chaser_cam.matrix(), np.eye(4))


def test_yaml_and_json_say_the_same() -> None:
    mission = Mission.parse(YAML, source="test")
    assert Mission.parse(mission.to_json(), source="test") == mission
    assert (mission.vehicle, mission.camera.name, mission.filter.coast_s) == ("servicer", "aft", 2.0)
    first, second = mission.markers
    assert first.surface.surface() == Cylinder(0.2, 1.5)
    assert second.surface.surface() == Flat()
    assert (second.side_m, second.T_target_marker.translation_m) == (0.1, (0.0, 0.3, 0.0))
    assert (mission.marker(4), mission.marker(5)) == (first, None)


def test_a_pose_is_the_transform_it_says() -> None:
    """A third of a turn about (1, 1, 1) takes x to y, y to z and z to x."""
    T_chaser_cam = Mission.parse(YAML, source="test").camera.T_chaser_cam.matrix()
    np.testing.assert_allclose(T_chaser_cam @ [1, 0, 0, 1], [0.1, 1, 0.2, 1], atol=1e-15)
    np.testing.assert_allclose(T_chaser_cam @ [0, 1, 0, 1], [0.1, 0, 1.2, 1], atol=1e-15)


@given(
    sides_m=st.lists(st.floats(1e-3, 10), max_size=4),
    radius_m=st.floats(1e-3, 100),
    axis_rad=st.floats(-4, 4),
    translation_m=st.tuples(*[st.floats(-1e3, 1e3)] * 3),
)
def test_json_comes_back_exactly(sides_m, radius_m, axis_rad, translation_m) -> None:
    surface = CylinderSection(radius_m=radius_m, axis_rad=axis_rad)
    place = PoseSection(translation_m=translation_m)
    markers = tuple(
        MarkerSection(id=k, side_m=s, surface=surface, T_target_marker=place) for k, s in enumerate(sides_m)
    )
    mission = Mission(markers=markers)
    assert Mission.parse(mission.to_json(), source="test") == mission


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("vehicle: a/b", "vehicle: String should match pattern"),
        ("speed: 3", "speed: Extra inputs are not permitted"),
        ("camera: {transfer: gamma}", "camera.transfer: Input should be 'srgb' or 'linear'"),
        ("markers: [{id: 1}, {id: 1}]", "the file: .*markers lists an id twice: \\[1, 1\\]"),
        ("markers: [{id: -1}]", "markers.0.id: Input should be greater than or equal to 0"),
        ("markers: [{id: 1, side_m: 0}]", "markers.0.side_m: Input should be greater than 0"),
        ("markers: [{id: 1, surface: {kind: sphere}}]", "markers.0.surface: Input tag 'sphere'"),
        ("markers: [{id: 1, surface: {kind: cylinder}}]", "markers.0.surface.cylinder.radius_m: Field required"),
        ("T_target_port: {rotation_wxyz: [1, 1, 0, 0]}", "T_target_port: .*unit quaternion, its norm is 1.414"),
        ("T_target_port: {translation_m: [0, .nan, 0]}", "T_target_port.translation_m.1: Input should be a finite"),
        ("filter: {coast_s: -1}", "filter.coast_s"),
        ("- 1\n- 2", "the file: Input should be a valid dictionary"),
        ("a: [1, 2", "is not YAML or JSON"),
        ("\x00", "is not YAML or JSON"),
    ],
)
def test_errors_name_the_file_and_the_field_in_one_line(tmp_path: Path, text: str, reason: str) -> None:
    path = tmp_path / "mission.yaml"
    path.write_text(text)
    with pytest.raises(ValueError, match=f"mission {re.escape(str(path))}.*{reason}") as caught:
        Mission.load(path)
    assert "\n" not in str(caught.value)


def test_a_file_that_cannot_be_read(tmp_path: Path) -> None:
    for path in (tmp_path / "absent.yaml", tmp_path):
        with pytest.raises(ValueError, match=f"cannot read mission {re.escape(str(path))}"):
            Mission.load(path)


UNITLESS = {
    "gate_probability",
    "ambiguity_ratio",
    "edge_bias_shared",
    "edge_end_correlation",
    "rotation_wxyz",
    "R_hill_chaser_wxyz",
    "scale_sigma",
    "target_inertia",
}
"""Probabilities, ratios, and quaternions, whose names are their layout."""


@pytest.mark.parametrize(
    "section",
    [s for s in vars(module).values() if isinstance(s, type) and issubclass(s, Section) and s is not Section],
    ids=lambda section: section.__name__,
)
def test_every_physical_setting_ends_in_a_unit(section: type[BaseModel]) -> None:
    for name, info in section.model_fields.items():
        kind = str(info.annotation)
        if info.annotation is PoseSection:
            assert re.fullmatch(r"T_[a-z]+_[a-z]+", name)
        elif "float" in kind:
            assert re.fullmatch(r"\w+_(m|rad|s|px|m_s|rad_s|m_s2|rad_s2|hz)", name) or name in UNITLESS, name
