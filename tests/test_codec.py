"""The codec: what is encoded is decoded again, equal messages give equal bytes, and damage is refused."""

from typing import Any

import numpy as np
import pytest
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.Log_pb2 import Log
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from schemas import (
    CodecError,
    Detection,
    Detections,
    LayerCorners,
    Message,
    Mode,
    Point2,
    RelativeState,
    Stamp,
    Vector3,
    decode,
    encode,
)
from schemas.codec import all_models, file_descriptor, proto_class, schema_name
from tests.message_strategies import INT64, messages

EVERY_MODEL = pytest.mark.parametrize("model", all_models(), ids=lambda model: model.__name__)
UNHURRIED = settings(max_examples=30, suppress_health_check=list(HealthCheck))
SQUARE = [Point2(x_px=x, y_px=y) for x, y in ((0, 0), (9, 0), (9, 9), (0, 9))]


@EVERY_MODEL
@UNHURRIED
@given(data=st.data())
def test_decode_undoes_encode(model: type[Message], data: st.DataObject) -> None:
    message = data.draw(messages(model))
    again = decode(model, encode(message))
    assert again == message
    assert encode(again) == encode(message)


@EVERY_MODEL
@UNHURRIED
@given(data=st.data(), where=st.integers(0, 10_000), flip=st.integers(0, 255))
def test_damaged_bytes_are_refused_or_still_a_valid_message(model, data: st.DataObject, where: int, flip: int) -> None:
    """Damage raises CodecError in one line and nothing else, or happens to spell another message."""
    payload = bytearray(encode(data.draw(messages(model))) or b"\x08")
    payload[where % len(payload)] ^= flip
    for damaged in (bytes(payload), bytes(payload[: where % len(payload)])):
        try:
            message = decode(model, damaged)
        except CodecError as error:
            assert schema_name(model) in str(error)
            assert "\n" not in str(error)
        else:
            assert decode(model, encode(message)) == message


@pytest.mark.parametrize("schema", [Detections, RelativeState, CompressedImage, Log], ids=schema_name)
@pytest.mark.parametrize("payload", [b"\xff", b"\x0a\x05ab", b"\x07\x07\x07", bytes(range(255, 0, -1))])
def test_bytes_that_are_no_message(schema: Any, payload: bytes) -> None:
    with pytest.raises(CodecError, match=f"not a {schema_name(schema)} of {len(payload)} bytes: damaged protobuf"):
        decode(schema, payload)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_not_a_number_is_refused_on_both_sides(value: float) -> None:
    with pytest.raises(ValueError, match="finite"):
        Vector3(x=value, y=0, z=0)
    proto: Any = proto_class(Vector3)()
    proto.x = value
    with pytest.raises(CodecError, match="finite"):
        decode(Vector3, proto.SerializeToString())


def test_what_is_out_of_bounds_is_refused_on_both_sides() -> None:
    good = LayerCorners(layer=2, corners_px=SQUARE, sigma_px=0.1)
    proto: Any = proto_class(LayerCorners).FromString(encode(good))  # type: ignore[attr-defined]
    proto.layer = 3
    with pytest.raises(CodecError, match="less than or equal to 2"):
        decode(LayerCorners, proto.SerializeToString())
    with pytest.raises(ValueError, match="at least 4 items"):
        LayerCorners(layer=0, corners_px=SQUARE[:3], sigma_px=0.1)
    with pytest.raises(ValueError, match="greater than 0"):
        LayerCorners(layer=0, corners_px=SQUARE, sigma_px=0)


def test_an_unknown_mode_is_refused() -> None:
    proto: Any = proto_class(RelativeState)()
    proto.mode = 9
    with pytest.raises(CodecError, match="RelativeState"):
        decode(RelativeState, proto.SerializeToString())


def test_absent_is_not_zero() -> None:
    absent = RelativeState(t_capture_ns=1, mode=Mode.INIT)
    zero = RelativeState(t_capture_ns=1, mode=Mode.INIT, nis=0.0, age_s=0.0, hypothesis_probability=0.0)
    assert (decode(RelativeState, encode(absent)).nis, decode(RelativeState, encode(absent)).age_s) == (None, None)
    assert (decode(RelativeState, encode(zero)).nis, decode(RelativeState, encode(zero)).age_s) == (0.0, 0.0)
    assert decode(RelativeState, encode(zero)).hypothesis_probability == 0.0


def test_fields_of_a_newer_program_are_passed_over() -> None:
    """A field added later, number 900, does not trouble a reader that does not know it."""
    payload = encode(Point2(x_px=1, y_px=2))
    assert decode(Point2, payload + b"\xa0\x38\x01") == Point2(x_px=1, y_px=2)


def test_messages_are_immutable_and_closed() -> None:
    point = Point2(x_px=1, y_px=2)
    with pytest.raises(ValueError, match="frozen"):
        point.x_px = 3
    with pytest.raises(ValueError, match="Extra inputs"):
        Point2(x_px=1, y_px=2, z_px=3)  # type: ignore[call-arg]


@pytest.mark.parametrize("seed", range(3))
def test_doubles_survive_exactly(seed: int) -> None:
    values = np.random.default_rng(seed).integers(0, 2**64, 36, dtype=np.uint64).view(np.float64)
    covariance = np.where(np.isfinite(values), values, 5e-324).tolist()
    seen = LayerCorners(layer=0, corners_px=SQUARE, sigma_px=0.1)
    detection = Detection(
        family="f",
        marker_id=0,
        corners_px=SQUARE,
        layers=[seen],
        correlation=-0.0,
        hamming=0,
        method="planar",
        covariance=covariance,
    )
    again = decode(Detection, encode(detection))
    assert again.covariance == covariance
    assert np.signbit(again.correlation)


def test_every_message_model_is_in_the_descriptor() -> None:
    assert list(file_descriptor().message_types_by_name) == [model.__name__ for model in all_models()]


@given(*[st.integers(-INT64, INT64 - 1)] * 3)
def test_stamps_come_back(sequence: int, t_capture_ns: int, t_origin_ns: int) -> None:
    stamp = Stamp(sequence, t_capture_ns, t_origin_ns)
    assert Stamp.unpack(stamp.pack()) == stamp


@pytest.mark.parametrize("attachment", [b"", bytes(23), bytes(25)])
def test_other_bytes_are_no_stamp(attachment: bytes) -> None:
    with pytest.raises(CodecError, match=f"a stamp has 24 bytes, got {len(attachment)}"):
        Stamp.unpack(attachment)
