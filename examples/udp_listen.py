"""Listen to `relnav node relay --to udp://HOST:PORT` or `udp+json://HOST:PORT`, with the standard library alone.

For example: python examples/udp_listen.py 5600
"""

import json
import socket
import struct
import sys
import zlib

PACKET = struct.Struct("<4sHBBqqdd3d4d3d3d78dII")
MODES = ("INIT", "AMBIGUOUS", "TRACK", "COAST", "LOST")
VALID, NUMBERS = 1, 2


def decode(datagram: bytes) -> dict[str, object]:
    """Return a datagram's fields, under the same names whichever form it has.  Raises ValueError for another's."""
    if datagram[:1] == b"{":
        fields: dict[str, object] = json.loads(datagram)
        return fields
    if len(datagram) != PACKET.size or datagram[:6] != b"RNAV\x01\x00":
        raise ValueError(f"{len(datagram)} bytes are no RNAV packet of version 1")
    _, version, mode, flags, sequence, t_ns, age_s, probability, *numbers, crc, _ = PACKET.unpack(datagram)
    if zlib.crc32(datagram[: PACKET.size - 8]) != crc:
        raise ValueError("wrong checksum")
    shared = bool(flags & NUMBERS)
    return {
        "version": version,
        "sequence": sequence,
        "t_capture_ns": t_ns,
        "mode": MODES[mode],
        "valid": bool(flags & VALID),
        "age_s": None if age_s != age_s else age_s,
        "hypothesis_probability": probability,
        "translation_m": numbers[0:3] if shared else None,
        "rotation_wxyz": numbers[3:7] if shared else None,
        "v_chaser_target_m_s": numbers[7:10] if shared else None,
        "omega_chaser_target_in_target_rad_s": numbers[10:13] if shared else None,
        "covariance_upper": numbers[13:] if shared else None,
    }


def main(port: int) -> None:
    """Print states until interrupted, and say so when none came for a second."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listening:
        listening.bind(("127.0.0.1", port))
        listening.settimeout(1.0)
        while True:
            try:
                state = decode(listening.recv(65535))
            except TimeoutError:
                print("nothing for a second: lost")
                continue
            where = state["translation_m"] if state["valid"] else "hold"
            print(state["sequence"], state["mode"], where, flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]))
