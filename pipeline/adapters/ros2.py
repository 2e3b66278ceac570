"""The state as ROS 2 messages in CDR, under the keys by which ROS 2 is reached over Zenoh.

``geometry_msgs/PoseWithCovarianceStamped`` on ``/relnav/<vehicle>/target_pose`` and ``tf2_msgs/TFMessage`` on
``/tf``: the pose of the target (child frame ``target``) in the chaser (frame ``chaser``), stamped with the time of
validity.  ROS's conventions: quaternion x y z w; covariance 6x6 row-major, position along and rotation about the
*fixed* axes of the header's frame, where ours is a right perturbation in the target's.

Neither message has a place for validity, so that only trusted states become messages; a reader takes an old stamp
for a lost target, as it must anyway when a sensor dies.

Keys, liveliness tokens and attachments are those of rmw_zenoh (its ``docs/design.md``; attachments as since 0.2.4);
types, CDR and type hashes come from rosbags, the extra ``ros2``.  That is ROS 2 Jazzy and later: Humble's keys have no
hash.  zenoh-bridge-ros2dds is served by the bare topic name as the key and the same CDR.  All as their documents say,
not tried against a running ROS 2.
"""

from __future__ import annotations

import hashlib
import re
import struct
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.adapters.estimate import POSE, Estimate, trusted_estimate
from pipeline.convert import NS_PER_S
from pipeline.pose_filter import CHASER_FRAME, TARGET_FRAME
from schemas import RelativeState

POSE_TYPE, TF_TYPE = "geometry_msgs/msg/PoseWithCovarianceStamped", "tf2_msgs/msg/TFMessage"
NODE = "relnav_relay"
QUEUE_DEPTH = 10
_ATTACHMENT = struct.Struct("<qqB16s")


@dataclass(frozen=True)
class RosTopic:
    """A topic as rmw_zenoh names it.  ``type_hash`` is REP 2016's, "RIHS01_..."."""

    name: str
    """Without the leading slash."""
    type_name: str
    """Such as "tf2_msgs/msg/TFMessage"."""
    type_hash: str

    @property
    def dds_type(self) -> str:
        """Return the type's name in DDS, such as "tf2_msgs::msg::dds_::TFMessage_"."""
        package, kind, name = self.type_name.split("/")
        return f"{package}::{kind}::dds_::{name}_"

    def key(self, domain: int) -> str:
        """Return the key under which rmw_zenoh publishes the topic."""
        return f"{domain}/{self.name}/{self.dds_type}/{self.type_hash}"

    def token(self, domain: int, session_id: str, entity: int) -> str:
        """Return the liveliness token of our publisher, by which ``ros2 topic list`` knows it: reliable, volatile."""
        topic = f"%{self.name.replace('/', '%')}/{self.dds_type}/{self.type_hash}/::,{QUEUE_DEPTH}:,:,:,,"
        return f"@ros2_lv/{domain}/{session_id}/0/{entity}/MP/%/%/{NODE}/{topic}"


def node_token(domain: int, session_id: str) -> str:
    """Return the liveliness token of our ROS node, of which there is one a session."""
    return f"@ros2_lv/{domain}/{session_id}/0/0/NN/%/%/{NODE}"


def attachment(sequence: int, t_publish_ns: int, token: str) -> bytes:
    """Return what rmw_zenoh wants beside each message: its number, its time and its publisher's 16-byte id."""
    gid = hashlib.blake2b(token.encode(), digest_size=16).digest()
    return _ATTACHMENT.pack(sequence, t_publish_ns, len(gid), gid)


class Ros2Encoder:
    """Writes states as ROS 2 messages.  Raises ValueError when rosbags is not installed."""

    def __init__(self, vehicle: str) -> None:
        try:
            from rosbags.typesys import Stores, get_typestore
        except ImportError as error:
            raise ValueError("ROS 2 messages need rosbags: run `make setup EXTRAS=ros2`") from error
        # The two messages and their hashes are the same in every distribution since Dashing.
        self._store = get_typestore(Stores.ROS2_JAZZY)
        self.pose_topic = self._topic(f"relnav/{_ros_name(vehicle)}/target_pose", POSE_TYPE)
        self.tf_topic = self._topic("tf", TF_TYPE)

    def messages(self, state: RelativeState) -> list[tuple[RosTopic, bytes]]:
        """Return the CDR of each topic's message; nothing for a state that is not trusted.

        Raises ValueError for a time that ROS cannot stamp.
        """
        estimate = trusted_estimate(state)
        if estimate is None:
            return []
        if not 0 <= state.t_capture_ns // NS_PER_S < 2**31:
            raise ValueError(f"t_capture_ns {state.t_capture_ns} is outside what a ROS stamp holds, 1970 to 2038")
        return [
            (self.pose_topic, self._cdr(POSE_TYPE, self._pose(state, estimate))),
            (self.tf_topic, self._cdr(TF_TYPE, self._transforms(state, estimate))),
        ]

    def _topic(self, name: str, type_name: str) -> RosTopic:
        return RosTopic(name, type_name, self._store.hash_rihs01(type_name))

    def _cdr(self, type_name: str, message: Any) -> bytes:
        return bytes(self._store.serialize_cdr(message, type_name))

    def _make(self, type_name: str, **fields: Any) -> Any:
        return self._store.types[type_name](**fields)

    def _header(self, state: RelativeState) -> Any:
        sec, nanosec = divmod(state.t_capture_ns, NS_PER_S)
        stamp = self._make("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
        return self._make("std_msgs/msg/Header", stamp=stamp, frame_id=CHASER_FRAME)

    def _quaternion(self, state: RelativeState) -> Any:
        assert state.T_chaser_target is not None
        q = state.T_chaser_target.rotation_wxyz
        return self._make("geometry_msgs/msg/Quaternion", x=q.x, y=q.y, z=q.z, w=q.w)

    def _vector(self, type_name: str, estimate: Estimate) -> Any:
        return self._make(type_name, **dict(zip("xyz", estimate.position_m.tolist(), strict=True)))

    def _pose(self, state: RelativeState, estimate: Estimate) -> Any:
        position = self._vector("geometry_msgs/msg/Point", estimate)
        pose = self._make("geometry_msgs/msg/Pose", position=position, orientation=self._quaternion(state))
        covariance = np.ascontiguousarray(estimate.fixed_axes_covariance()[POSE, POSE]).ravel()
        with_covariance = self._make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=covariance)
        return self._make(POSE_TYPE, header=self._header(state), pose=with_covariance)

    def _transforms(self, state: RelativeState, estimate: Estimate) -> Any:
        translation = self._vector("geometry_msgs/msg/Vector3", estimate)
        transform = self._make("geometry_msgs/msg/Transform", translation=translation, rotation=self._quaternion(state))
        stamped = self._make(
            "geometry_msgs/msg/TransformStamped",
            header=self._header(state),
            child_frame_id=TARGET_FRAME,
            transform=transform,
        )
        return self._make(TF_TYPE, transforms=[stamped])


def _ros_name(vehicle: str) -> str:
    """Return a vehicle's name as a ROS name may be: letters, digits and underscores, no digit first."""
    name = re.sub(r"\W", "_", vehicle)
    return f"v{name}" if name[0].isdigit() else name
