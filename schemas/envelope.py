"""What travels beside a message's bytes: its key, its place in the sequence of frames, and its times."""

from __future__ import annotations

import struct
from dataclasses import dataclass

from schemas.codec import AnyMessage, CodecError, decode, encode
from schemas.topics import Topic, topic_of

_STAMP = struct.Struct("<qqq")


@dataclass(frozen=True)
class Stamp:
    """The frame that a message belongs to.

    ``sequence`` is the frame's number, equal for everything computed from it; ``t_capture_ns`` the
    mid-exposure; ``t_origin_ns`` when the frame entered this pipeline, for latency: in a live run the two
    are close, in a replay they are years apart.
    """

    sequence: int
    t_capture_ns: int
    t_origin_ns: int

    def pack(self) -> bytes:
        """Return the 24 bytes that travel as the message's attachment."""
        return _STAMP.pack(self.sequence, self.t_capture_ns, self.t_origin_ns)

    @classmethod
    def unpack(cls, attachment: bytes) -> Stamp:
        """Read ``pack``'s bytes.  Raises CodecError for anything else."""
        if len(attachment) != _STAMP.size:
            raise CodecError(f"a stamp has {_STAMP.size} bytes, got {len(attachment)}")
        return cls(*_STAMP.unpack(attachment))


@dataclass(frozen=True)
class Envelope:
    """A message on its way: bytes, untouched from its maker to the recording."""

    topic: Topic
    key: str
    payload: bytes
    stamp: Stamp

    @classmethod
    def wrap(cls, message: AnyMessage, stamp: Stamp, *, vehicle: str, camera: str = "", node: str = "") -> Envelope:
        """Encode a message for its topic."""
        topic = topic_of(message)
        return cls(topic, topic.key(vehicle=vehicle, camera=camera, node=node), encode(message), stamp)

    def message(self) -> AnyMessage:
        """Decode.  Raises CodecError when the bytes are damaged."""
        return decode(self.topic.schema, self.payload)
