"""What crosses a process boundary: messages, topics, frames and units, and their codec.

Frames, units and conventions, said once for every message:

- SI units and radians; each physical field's name ends in its unit.  Pixels have (0, 0) at the centre of
  the top-left pixel; corners come top left, top right, bottom right, bottom left of the upright marker.
- Camera frame: x right, y down, z forward.  Marker frame: origin at the centre of the print, x right, y up,
  z out of the face; on a curved surface, tangent there.  Port frames: z out of the vehicle.
- ``T_a_b`` takes b-coordinates to a and is the pose of b in a; quaternions are (w, x, y, z).
- Covariance of a pose: 6x6 row-major, metres then radians, right perturbation in the child's axes:
  T = T_hat * (Exp(theta), rho).  The 12x12 covariance of a relative state continues with the velocity
  (m/s, chaser axes) and the rate (rad/s, target axes).
- ``t_capture_ns``: UTC nanoseconds at mid-exposure, unchanged from the camera to the last sink.
"""

from schemas.codec import CodecError, decode, encode
from schemas.envelope import Envelope, Stamp
from schemas.messages import (
    ChaserMotion,
    Detection,
    Detections,
    Guidance,
    LayerCorners,
    Message,
    Mode,
    NodeHealth,
    Phase,
    PlanarPose,
    Point2,
    PortToPort,
    Pose,
    Quaternion,
    RelativeState,
    Truth,
    Vector3,
    WarpGrid,
)
from schemas.topics import TOPICS, Topic, topic_of

__all__ = [
    "TOPICS",
    "ChaserMotion",
    "CodecError",
    "Detection",
    "Detections",
    "Envelope",
    "Guidance",
    "LayerCorners",
    "Message",
    "Mode",
    "NodeHealth",
    "Phase",
    "PlanarPose",
    "Point2",
    "PortToPort",
    "Pose",
    "Quaternion",
    "RelativeState",
    "Stamp",
    "Topic",
    "Truth",
    "Vector3",
    "WarpGrid",
    "decode",
    "encode",
    "topic_of",
]
