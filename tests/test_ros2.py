"""ROS 2: CDR read back by rosbags, keys and tokens against rmw_zenoh's own document."""

import struct

import numpy as np
import pytest
import zenoh.ext

from pipeline.adapters.estimate import POSE, trusted_estimate
from schemas import Mode
from tests.some_states import NOT_TRUSTED, T_NS, some_state

pytest.importorskip("rosbags", reason="the extra `ros2` is not installed")

from rosbags.typesys import Stores, get_typestore

from pipeline.adapters.ros2 import POSE_TYPE, TF_TYPE, Ros2Encoder, RosTopic, attachment, node_token

# https://github.com/ros2/rmw_zenoh, docs/design.md
CHATTER = RosTopic(
    "chatter",
    "std_msgs/msg/String",
    "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18",
)
SESSION = "8b20917502ee955ac4476e0266340d5c"


@pytest.fixture(scope="module")
def encoder() -> Ros2Encoder:
    return Ros2Encoder("chaser-1")


@pytest.fixture(scope="module")
def store():
    return get_typestore(Stores.ROS2_JAZZY)


def test_keys_and_tokens_are_those_of_the_document():
    assert CHATTER.key(0) == f"0/chatter/std_msgs::msg::dds_::String_/{CHATTER.type_hash}"
    assert node_token(2, SESSION) == f"@ros2_lv/2/{SESSION}/0/0/NN/%/%/relnav_relay"
    token = CHATTER.token(2, SESSION, 10)
    topic = f"%chatter/std_msgs::msg::dds_::String_/{CHATTER.type_hash}/::,10:,:,:,,"
    assert token == f"@ros2_lv/2/{SESSION}/0/10/MP/%/%/relnav_relay/{topic}"


def test_type_hashes_are_rosidl_s(store):
    """Rosbags computes REP 2016's hash from the definition; the document gives the one of std_msgs/String."""
    assert store.hash_rihs01("std_msgs/msg/String") == CHATTER.type_hash


def test_the_attachment_is_what_zenoh_s_serializer_writes():
    gid = attachment(0, 0, "token")[-16:]
    written = zenoh.ext.z_serialize((zenoh.ext.Int64(5), zenoh.ext.Int64(T_NS), gid))
    assert attachment(5, T_NS, "token") == written.to_bytes()
    assert attachment(5, T_NS, "another") != attachment(5, T_NS, "token")


def test_topics_have_names_that_ros_takes(encoder):
    assert encoder.pose_topic.name == "relnav/chaser_1/target_pose"
    assert encoder.tf_topic.name == "tf"
    assert Ros2Encoder("1a").pose_topic.name == "relnav/v1a/target_pose"


def test_a_trusted_state_is_read_back(encoder, store):
    state = some_state()
    estimate = trusted_estimate(state)
    (pose_topic, pose_cdr), (tf_topic, tf_cdr) = encoder.messages(state)
    assert (pose_topic, tf_topic) == (encoder.pose_topic, encoder.tf_topic)
    assert pose_cdr[:4] == tf_cdr[:4] == struct.pack(">HH", 1, 0), "little-endian CDR, as rmw_zenoh takes it"

    stamped = store.deserialize_cdr(pose_cdr, POSE_TYPE)
    (transform,) = store.deserialize_cdr(tf_cdr, TF_TYPE).transforms
    for header in (stamped.header, transform.header):
        assert header.frame_id == "chaser"
        assert header.stamp.sec * 10**9 + header.stamp.nanosec == T_NS
    assert transform.child_frame_id == "target"
    t, q = state.T_chaser_target.translation_m, state.T_chaser_target.rotation_wxyz
    pose = stamped.pose.pose
    for place in (pose.position, transform.transform.translation):
        assert (place.x, place.y, place.z) == (t.x, t.y, t.z)
    for turn in (pose.orientation, transform.transform.rotation):
        assert (turn.x, turn.y, turn.z, turn.w) == (q.x, q.y, q.z, q.w)
    covariance = stamped.pose.covariance.reshape(6, 6)
    np.testing.assert_array_equal(covariance, estimate.fixed_axes_covariance()[POSE, POSE])


def test_the_quaternion_comes_last_component_last(encoder, store):
    """CDR is positional: the last eight bytes of /tf are w."""
    state = some_state()
    _, (_, tf_cdr) = encoder.messages(state)
    assert struct.unpack("<d", tf_cdr[-8:]) == (state.T_chaser_target.rotation_wxyz.w,)


@pytest.mark.parametrize("t_ns", [-1, 2**31 * 10**9])
def test_a_time_that_ros_cannot_stamp_is_refused(encoder, t_ns):
    with pytest.raises(ValueError, match="outside what a ROS stamp holds"):
        encoder.messages(some_state(t_ns=t_ns))


@pytest.mark.parametrize("mode", NOT_TRUSTED, ids=lambda mode: mode.name)
def test_nothing_is_sent_of_any_other_state(encoder, mode):
    assert encoder.messages(some_state(mode)) == []
    assert encoder.messages(some_state(Mode.TRACK, numbers=False)) == []
