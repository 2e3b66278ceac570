"""Follow the filtered relative state with nothing but Zenoh and the generated protobuf: the pattern for C++ or MATLAB.

    pip install eclipse-zenoh protobuf grpcio-tools
    python -m grpc_tools.protoc -I schemas/proto --python_out=examples relnav.proto
    relnav live --source /dev/video0 ...            # in another terminal
    python examples/zenoh_state.py

For C++: ``protoc --cpp_out``, zenoh-cpp, and the same key.  Each sample on ``relnav/<vehicle>/state`` is one
``relnav.RelativeState``; beside it travels an attachment of three little-endian int64: the frame's sequence number,
the capture time and when the frame entered the pipeline, both UTC nanoseconds.

A state may be flown on only in TRACK.  In INIT and LOST the pose is absent; an absent message reads as zeros, so ask
``HasField`` first.  A state that is too old is as good as lost: the time of validity is in it.
"""

import struct
import sys

import relnav_pb2
import zenoh

KEY = "relnav/chaser/state"
STAMP = struct.Struct("<qqq")


def line(payload: bytes, attachment: bytes) -> str:
    """Return one line for a sample: what a consumer may take from it."""
    state = relnav_pb2.RelativeState.FromString(payload)
    sequence, _, _ = STAMP.unpack(attachment)
    mode = relnav_pb2.Mode.Name(state.mode)
    if state.mode != relnav_pb2.TRACK or not state.HasField("T_chaser_target"):
        return f"{sequence} {mode}: hold"
    t = state.T_chaser_target.translation_m
    # Right perturbation in the target's axes, metres then radians: see relnav.proto.
    sigma_m = max(state.covariance[k * 12 + k] for k in range(3)) ** 0.5
    return f"{sequence} {mode}: target at {t.x:+.4f} {t.y:+.4f} {t.z:+.4f} m, 1 sigma {sigma_m * 1e3:.2f} mm"


def main(endpoint: str = "tcp/127.0.0.1:7447") -> None:
    """Print states until interrupted."""
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", f'["{endpoint}"]')
    config.insert_json5("connect/timeout_ms", "20000")  # the run may only be starting
    with zenoh.open(config) as session:
        subscriber = session.declare_subscriber(KEY)
        for sample in subscriber:
            print(line(sample.payload.to_bytes(), sample.attachment.to_bytes()), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
