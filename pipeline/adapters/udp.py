"""The state in a UDP datagram: a fixed binary struct, or a line of JSON.

The struct (``examples/relnav_udp.h`` is the same in C) is little-endian, packed, 776 bytes, one datagram on Ethernet:

| offset | type | |
|---|---|---|
| 0 | char[4] | "RNAV" |
| 4 | u16 | version of this layout, 1 |
| 6 | u8 | mode: 0 INIT, 1 AMBIGUOUS, 2 TRACK, 3 COAST, 4 LOST |
| 7 | u8 | flags: 1 VALID, may be flown on; 2 NUMBERS, what follows the age is not NaN |
| 8 | i64 | sequence number of the frame |
| 16 | i64 | time of validity, UTC nanoseconds |
| 24 | f64 | age: seconds since the last accepted measurement, NaN when there was none |
| 32 | f64 | probability of the hypothesis |
| 40 | f64[3] | position of the target in chaser axes, m |
| 64 | f64[4] | rotation chaser to target, w x y z: the target's attitude in the chaser |
| 96 | f64[3] | velocity of the target in chaser axes, m/s |
| 120 | f64[3] | rate of the target against the chaser, target axes, rad/s |
| 144 | f64[78] | covariance 12x12, its upper triangle row by row; order, units and axes as in ``schemas`` |
| 768 | u32 | CRC-32 (IEEE, as in zlib) of bytes 0 to 767 |
| 772 | u32 | 0 |

VALID is set in TRACK only.  Numbers are given in TRACK and in COAST, for a reader that decides itself how long it
trusts a propagation; in all other modes they are NaN, so that a reader who forgets the flags does not fly on them.
"""

from __future__ import annotations

import json
import math
import struct
import zlib
from typing import Any

import numpy as np

from pipeline.adapters.estimate import Estimate, estimate_of, trusted_estimate
from schemas import Mode, RelativeState

MAGIC = b"RNAV"
VERSION = 1
VALID, NUMBERS = 1, 2
UPPER = np.triu_indices(12)
_BODY = struct.Struct("<4sHBBqq93d")
_TAIL = struct.Struct("<II")
PACKET_BYTES = _BODY.size + _TAIL.size
_PARTS = {
    "translation_m": slice(0, 3),
    "rotation_wxyz": slice(3, 7),
    "v_chaser_target_m_s": slice(7, 10),
    "omega_chaser_target_in_target_rad_s": slice(10, 13),
    "covariance_upper": slice(13, 91),
}
"""Where they are in ``_numbers``."""
_NO_NUMBERS = (math.nan,) * 91


def packet(state: RelativeState, sequence: int) -> bytes:
    """Return the binary datagram of a state, the answer to frame ``sequence``."""
    shared = _shared(state)
    flags = (VALID if trusted_estimate(state) else 0) | (NUMBERS if shared else 0)
    age_s = math.nan if state.age_s is None else state.age_s
    body = _BODY.pack(
        MAGIC,
        VERSION,
        state.mode,
        flags,
        sequence,
        state.t_capture_ns,
        age_s,
        state.hypothesis_probability,
        *(_NO_NUMBERS if shared is None else _numbers(state, shared)),
    )
    return body + _TAIL.pack(zlib.crc32(body), 0)


def json_line(state: RelativeState, sequence: int) -> bytes:
    """Return a state as one line of JSON, with ``valid`` true in TRACK only.

    Fields are named and meant as in ``schemas.RelativeState``; ``covariance_upper`` is the upper triangle, row by
    row, of the 12x12.  Numbers are null unless the mode is TRACK or COAST.  Some 2 kB: two fragments on Ethernet.
    """
    shared = _shared(state)
    numbers = None if shared is None else _numbers(state, shared)
    fields: dict[str, Any] = {
        "version": VERSION,
        "sequence": sequence,
        "t_capture_ns": state.t_capture_ns,
        "mode": state.mode.name,
        "valid": trusted_estimate(state) is not None,
        "age_s": state.age_s,
        "hypothesis_probability": state.hypothesis_probability,
        **{name: None if numbers is None else numbers[part] for name, part in _PARTS.items()},
        "port": None if numbers is None or state.port is None else state.port.model_dump(),
    }
    return json.dumps(fields, allow_nan=False, separators=(",", ":")).encode() + b"\n"


def _shared(state: RelativeState) -> Estimate | None:
    """Return the numbers that leave the house: nobody is shown one of two poses, or a lost one."""
    return estimate_of(state) if state.mode in (Mode.TRACK, Mode.COAST) else None


def _numbers(state: RelativeState, estimate: Estimate) -> list[float]:
    """Return position, rotation, velocity, rate and the covariance's upper triangle: 91 numbers."""
    assert state.T_chaser_target is not None
    q = state.T_chaser_target.rotation_wxyz
    return [
        *estimate.position_m.tolist(),
        *(q.w, q.x, q.y, q.z),
        *estimate.v_chaser_target_m_s.tolist(),
        *estimate.omega_chaser_target_in_target_rad_s.tolist(),
        *estimate.covariance[UPPER].tolist(),
    ]
