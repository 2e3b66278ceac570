"""``examples/zenoh_state.py``: the published .proto alone is enough to read a state."""

import sys
from types import SimpleNamespace

import pytest
from google.protobuf import descriptor_pool, message_factory

from schemas import Mode, Stamp, encode, proto
from tests.some_states import NOT_TRUSTED, load_example, some_state
from tests.test_proto import parsed


@pytest.fixture
def example(monkeypatch):
    """The example with the module that protoc would generate, made from the text of the .proto file."""
    pool = descriptor_pool.DescriptorPool()
    file = parsed(proto.PATH.read_text())
    file.name = "parsed.proto"
    pool.Add(file)
    descriptor = pool.FindFileByName(file.name)
    modes = descriptor.enum_types_by_name["Mode"]
    generated = SimpleNamespace(
        RelativeState=message_factory.GetMessageClass(descriptor.message_types_by_name["RelativeState"]),
        Mode=SimpleNamespace(Name=lambda number: modes.values_by_number[number].name),
        **{value.name: value.number for value in modes.values},
    )
    monkeypatch.setitem(sys.modules, "relnav_pb2", generated)
    return load_example("zenoh_state")


def line(example, state) -> str:
    return example.line(encode(state), Stamp(7, state.t_capture_ns, 0).pack())


def test_a_tracked_state_is_read(example):
    state = some_state()
    t = state.T_chaser_target.translation_m
    sigma_mm = 1e3 * max(state.covariance[k] for k in (0, 13, 26)) ** 0.5
    where = f"target at {t.x:+.4f} {t.y:+.4f} {t.z:+.4f} m, 1 sigma {sigma_mm:.2f} mm"
    assert line(example, state) == f"7 TRACK: {where}"


@pytest.mark.parametrize("mode", NOT_TRUSTED, ids=lambda mode: mode.name)
def test_any_other_state_is_held(example, mode):
    assert line(example, some_state(mode)) == f"7 {mode.name}: hold"


def test_a_state_without_a_pose_is_held(example):
    """Protobuf reads an absent message as zeros: the target would be at the camera."""
    assert line(example, some_state(Mode.TRACK, numbers=False)) == "7 TRACK: hold"
