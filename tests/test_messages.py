"""Conventions of the messages, held as tests: every physical quantity says its unit, every transform its frames."""

import re

import pytest

from schemas import Message, Mode, Point2, Quaternion, Vector3
from schemas.codec import FieldPlan, all_models, field_plans
from schemas.messages import Pose

UNIT = re.compile(r"\w+_(m|px|rad|s|ns|m_s|m_s2|rad_s|n|n_m)")
TRANSFORM = re.compile(r"T_[a-z]+_[a-z]+")
LAYOUT = {("ChaserMotion", "rotation_hill_chaser_wxyz"): Quaternion, ("Pose", "rotation_wxyz"): Quaternion}
"""Fields whose name ends in the layout of their numbers instead of a unit."""
DIMENSIONLESS = {
    "Detection.correlation": "of bits, -1 to 1",
    "RelativeState.nis": "a chi-square value",
    "RelativeState.hypothesis_probability": "0 to 1",
    "Quaternion.w": "unit quaternion",
    "Quaternion.x": "unit quaternion",
    "Quaternion.y": "unit quaternion",
    "Quaternion.z": "unit quaternion",
}
UNIT_SAID_ELSEWHERE = {
    "Vector3.x": "by the field that holds the vector",
    "Vector3.y": "by the field that holds the vector",
    "Vector3.z": "by the field that holds the vector",
    "Detection.covariance": "mixed, metres then radians, said once in schemas",
    "RelativeState.covariance": "mixed, m, rad, m/s, rad/s, said once in schemas",
}
COUNTS_AND_NAMES = {
    "LayerCorners.layer",
    "WarpGrid.rows",
    "WarpGrid.columns",
    "Detection.marker_id",
    "Detection.hamming",
    "RelativeState.nis_dof",
    "RelativeState.marker_ids",
    "RelativeState.layers",
    "NodeHealth.pid",
    "NodeHealth.received",
    "NodeHealth.published",
    "NodeHealth.dropped",
    "NodeHealth.refused",
}
EXCEPTIONS = {*DIMENSIONLESS, *UNIT_SAID_ELSEWHERE, *COUNTS_AND_NAMES}
FIELDS = [(model, plan) for model in all_models() for plan in field_plans(model)]
EVERY_FIELD = pytest.mark.parametrize(
    ("model", "plan"), FIELDS, ids=[f"{model.__name__}.{plan.name}" for model, plan in FIELDS]
)


@EVERY_FIELD
def test_every_physical_field_ends_in_a_unit(model: type[Message], plan: FieldPlan) -> None:
    if plan.type is Pose:
        assert TRANSFORM.fullmatch(plan.name), "a pose is named T_a_b after its two frames"
    elif (model.__name__, plan.name) in LAYOUT:
        assert plan.type is LAYOUT[model.__name__, plan.name]
    elif plan.type in (float, int, Point2, Vector3, Quaternion):
        assert UNIT.fullmatch(plan.name) or f"{model.__name__}.{plan.name}" in EXCEPTIONS


def test_no_exception_is_stale() -> None:
    assert {f"{model.__name__}.{plan.name}" for model, plan in FIELDS} >= EXCEPTIONS


@EVERY_FIELD
def test_a_name_means_one_kind_of_thing_everywhere(model: type[Message], plan: FieldPlan) -> None:
    """But for ``layers``: with their corners in a detection, their numbers in a state."""
    same = {(other.type, other.repeated) for _, other in FIELDS if other.name == plan.name}
    assert len(same) == (2 if plan.name == "layers" else 1)


@pytest.mark.parametrize("model", all_models(), ids=lambda model: model.__name__)
def test_every_message_is_documented_and_numbered_once(model: type[Message]) -> None:
    numbers = [plan.number for plan in field_plans(model)]
    assert model.__doc__
    assert numbers == sorted(set(numbers))
    assert min(numbers) >= 1


def test_modes_keep_their_numbers() -> None:
    assert {mode.name: mode.value for mode in Mode} == {"INIT": 0, "AMBIGUOUS": 1, "TRACK": 2, "COAST": 3, "LOST": 4}
