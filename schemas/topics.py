"""The topics, one table: what travels under which key, how often, and whether it is latched and recorded."""

from __future__ import annotations

import re
from dataclasses import dataclass

from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from foxglove_schemas_protobuf.Log_pb2 import Log

from schemas.codec import AnyMessage
from schemas.messages import ChaserMotion, Detections, Guidance, NodeHealth, RelativeState, Truth


@dataclass(frozen=True)
class Topic:
    """One row of the table.

    ``latched``: a late subscriber is given the last value.  ``per_frame``: exactly one for every frame, so
    that a gap in the sequence is a loss.  ``newest_wins``: in a live run a slow reader is given the newest
    value only.
    """

    name: str
    pattern: str
    schema: type[AnyMessage]
    rate: str
    latched: bool = False
    recorded: bool = True
    per_frame: bool = False
    newest_wins: bool = False

    def key(self, *, vehicle: str, camera: str = "*", node: str = "*") -> str:
        """Return the key expression for a vehicle, a camera and a node."""
        return self.pattern.format(vehicle=vehicle, camera=camera, node=node)

    def matches(self, key: str) -> bool:
        """Tell whether a concrete key belongs to this topic, whatever the vehicle, camera or node."""
        regex = re.sub(r"\\{\w+\\}", "[^/]+", re.escape(self.pattern))
        return re.fullmatch(regex, key) is not None


FRAME = Topic(
    "frame", "relnav/{vehicle}/camera/{camera}/frame", CompressedImage, "camera", per_frame=True, newest_wins=True
)
CALIBRATION = Topic(
    "calibration", "relnav/{vehicle}/camera/{camera}/calibration", CameraCalibration, "once", latched=True
)
ANNOTATIONS = Topic("annotations", "relnav/{vehicle}/camera/{camera}/annotations", ImageAnnotations, "camera")
DETECTIONS = Topic("detections", "relnav/{vehicle}/detections", Detections, "camera", per_frame=True)
STATE = Topic("state", "relnav/{vehicle}/state", RelativeState, "camera", per_frame=True)
TRANSFORMS = Topic("transforms", "relnav/{vehicle}/transforms", FrameTransforms, "camera")
TRUTH = Topic("truth", "relnav/{vehicle}/truth", Truth, "camera")
GUIDANCE = Topic("guidance", "relnav/{vehicle}/gnc/guidance", Guidance, "camera")
CHASER_MOTION = Topic("chaser motion", "relnav/{vehicle}/gnc/chaser_motion", ChaserMotion, "camera")
EVENTS = Topic("events", "relnav/{vehicle}/events", Log, "on change")
HEALTH = Topic("health", "relnav/{vehicle}/@node/{node}/health", NodeHealth, "1 Hz")

TOPICS = (
    FRAME,
    CALIBRATION,
    ANNOTATIONS,
    DETECTIONS,
    STATE,
    TRANSFORMS,
    TRUTH,
    GUIDANCE,
    CHASER_MOTION,
    EVENTS,
    HEALTH,
)
_BY_SCHEMA = {topic.schema: topic for topic in TOPICS}


def topic_of(message: AnyMessage | type[AnyMessage]) -> Topic:
    """Return the topic of a message or message class: each class has exactly one."""
    return _BY_SCHEMA[message if isinstance(message, type) else type(message)]


def topic_for_key(key: str) -> Topic | None:
    """Return the topic that a concrete key belongs to, or None."""
    return next((topic for topic in TOPICS if topic.matches(key)), None)
