"""The table of topics: every key belongs to exactly one topic, every message class has exactly one."""

import itertools

import pytest

from schemas import TOPICS, Envelope, Mode, RelativeState, Stamp, Topic, topic_of
from schemas.codec import descriptor_of, schema_name
from schemas.topics import STATE, topic_for_key

EVERY_TOPIC = pytest.mark.parametrize("topic", TOPICS, ids=lambda topic: topic.name)
NAMES = ("chaser", "nav", "pose_filter", "a-1", "frame", "state")


@EVERY_TOPIC
def test_keys_belong_to_their_own_topic_only(topic: Topic) -> None:
    for vehicle, camera, node in itertools.product(NAMES, repeat=3):
        key = topic.key(vehicle=vehicle, camera=camera, node=node)
        assert [other for other in TOPICS if other.matches(key)] == [topic]
        assert topic_for_key(key) is topic


@EVERY_TOPIC
def test_keys_are_valid_for_the_bus(topic: Topic) -> None:
    key = topic.key(vehicle="v", camera="c", node="n")
    assert key.startswith("relnav/v/")
    assert not any(chunk == "" or set(chunk) & set("*#?$ {}") for chunk in key.split("/"))


def test_names_patterns_and_schemas_are_distinct() -> None:
    for column in ("name", "pattern", "schema"):
        values = [getattr(topic, column) for topic in TOPICS]
        assert len(set(values)) == len(values), column


@EVERY_TOPIC
def test_every_schema_has_one_topic_and_a_descriptor(topic: Topic) -> None:
    assert topic_of(topic.schema) is topic
    assert schema_name(topic.schema) == descriptor_of(topic.schema).full_name
    assert schema_name(topic.schema).split(".")[0] in ("relnav", "foxglove")


@pytest.mark.parametrize("key", ["", "relnav", "relnav/v", "relnav//state", "relnav/v/state/x", "x/relnav/v/state"])
def test_other_keys_have_no_topic(key: str) -> None:
    assert topic_for_key(key) is None


def test_an_envelope_wraps_and_unwraps() -> None:
    state, stamp = RelativeState(t_capture_ns=5, mode=Mode.LOST), Stamp(1, 5, 6)
    envelope = Envelope.wrap(state, stamp, vehicle="v")
    assert (envelope.topic, envelope.key, envelope.stamp) == (STATE, "relnav/v/state", stamp)
    assert envelope.message() == state
