"""A recording's states as CCSDS files: OEM (502.0-B-3) for position and velocity, AEM (504.0-B-2) for attitude.

What they hold is relative, and their frames are not inertial:

- the object is the *target*, the centre is the *chaser*;
- ``SC_BODY_1`` are the chaser's body axes, in which position and velocity are given: velocity is what an observer on
  the chaser sees, the derivative of the coordinates, in km/s;
- ``SC_BODY_2`` are the target's body axes; the AEM's quaternion leads from SC_BODY_1 to SC_BODY_2 (scalar last:
  the components of the target's attitude in the chaser), its rate is that of SC_BODY_2 against SC_BODY_1, in
  SC_BODY_2, deg/s.

Both files say so in comments.  The OEM's covariances are along SC_BODY_1, km and km/s.

Only trusted states are written.  Where others lie between them the segment ends, which by both standards forbids to
interpolate across.  Times rise throughout: a state that is not later than the one before it is left out.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np

from pipeline.adapters.estimate import POSITION, VELOCITY, Estimate, trusted_estimate
from pipeline.convert import NS_PER_S
from schemas import RelativeState

KM_PER_M = 1e-3
CHASER_BODY, TARGET_BODY = "SC_BODY_1", "SC_BODY_2"


@dataclass(frozen=True)
class Names:
    """Who is who in a CCSDS file."""

    chaser: str = "CHASER"
    target: str = "TARGET"
    originator: str = "RELNAV"


Segment = list[tuple[RelativeState, Estimate]]


def trusted_segments(states: Iterable[RelativeState]) -> list[Segment]:
    """Return the runs of trusted states.  Raises ValueError when there is none."""
    segments: list[Segment] = []
    broken, last_ns = True, None
    for state in states:
        estimate = trusted_estimate(state)
        if estimate is None:
            broken = True
            continue
        if last_ns is not None and state.t_capture_ns <= last_ns:
            continue
        if broken:
            segments.append([])
        segments[-1].append((state, estimate))
        broken, last_ns = False, state.t_capture_ns
    if not segments:
        raise ValueError("no state is in TRACK: there is nothing that a CCSDS file may hold")
    return segments


def oem_text(states: Iterable[RelativeState], names: Names, *, created_ns: int) -> str:
    """Return the OEM of the target about the chaser.  ``created_ns``: creation date, UTC.

    Raises ValueError when no state may be written.
    """
    comments = (
        f"Relative state: {names.target} as seen from {names.chaser}, not an orbit.",
        f"{CHASER_BODY} are the body axes of {names.chaser}, which turn with it.",
        f"Velocity is the rate of change of the coordinates in {CHASER_BODY}.",
        "Only states in TRACK; a segment ends where there is another.",
    )
    lines = _header("OEM", "3.0", names, created_ns, comments)
    for segment in trusted_segments(states):
        where = [f"CENTER_NAME = {names.chaser}", f"REF_FRAME = {CHASER_BODY}"]
        lines += ["", *_metadata(segment, names, where, []), ""]
        lines += [_ephemeris_line(state, estimate) for state, estimate in segment]
        lines += ["", "COVARIANCE_START"]
        for state, estimate in segment:
            lines += [f"EPOCH = {epoch(state.t_capture_ns)}", *_covariance_lines(estimate)]
        lines.append("COVARIANCE_STOP")
    return "\n".join(lines) + "\n"


def aem_text(states: Iterable[RelativeState], names: Names, *, created_ns: int) -> str:
    """Return the AEM of the target against the chaser.  ``created_ns``: creation date, UTC.

    Raises ValueError when no state may be written.
    """
    comments = (
        f"Relative attitude of {names.target} against {names.chaser}.",
        f"{CHASER_BODY} are the body axes of {names.chaser}, {TARGET_BODY} those of {names.target}.",
        f"Data: epoch, Q1 Q2 Q3 QC from {CHASER_BODY} to {TARGET_BODY}, rate in deg/s along {TARGET_BODY}.",
        "Only states in TRACK; a segment ends where there is another.",
    )
    lines = _header("AEM", "2.0", names, created_ns, comments)
    for segment in trusted_segments(states):
        frames = [f"REF_FRAME_A = {CHASER_BODY}", f"REF_FRAME_B = {TARGET_BODY}"]
        kind = ["ATTITUDE_TYPE = QUATERNION/ANGVEL", f"ANGVEL_FRAME = {TARGET_BODY}"]
        lines += ["", *_metadata(segment, names, frames, kind), "", "DATA_START"]
        lines += [_attitude_line(state, estimate) for state, estimate in segment]
        lines.append("DATA_STOP")
    return "\n".join(lines) + "\n"


def epoch(t_ns: int) -> str:
    """Return UTC nanoseconds as CCSDS writes time, exact to the nanosecond."""
    seconds, fraction_ns = divmod(t_ns, NS_PER_S)
    return f"{datetime.fromtimestamp(seconds, UTC):%Y-%m-%dT%H:%M:%S}.{fraction_ns:09d}"


def _header(kind: str, version: str, names: Names, created_ns: int, comments: Iterable[str]) -> list[str]:
    return [
        f"CCSDS_{kind}_VERS = {version}",
        *(f"COMMENT {comment}" for comment in comments),
        f"CREATION_DATE = {epoch(created_ns)}",
        f"ORIGINATOR = {names.originator}",
    ]


def _metadata(segment: Segment, names: Names, frames: list[str], kind: list[str]) -> Iterator[str]:
    yield "META_START"
    yield f"OBJECT_NAME = {names.target}"
    yield "OBJECT_ID = UNKNOWN"
    yield from frames
    yield "TIME_SYSTEM = UTC"
    yield f"START_TIME = {epoch(segment[0][0].t_capture_ns)}"
    yield f"STOP_TIME = {epoch(segment[-1][0].t_capture_ns)}"
    yield from kind
    yield "META_STOP"


def _ephemeris_line(state: RelativeState, estimate: Estimate) -> str:
    numbers = np.concatenate([estimate.position_m, estimate.v_chaser_target_m_s]) * KM_PER_M
    return _line(state, numbers)


def _attitude_line(state: RelativeState, estimate: Estimate) -> str:
    assert state.T_chaser_target is not None
    q = state.T_chaser_target.rotation_wxyz
    rate_deg_s = np.rad2deg(estimate.omega_chaser_target_in_target_rad_s)
    return _line(state, (q.x, q.y, q.z, q.w, *rate_deg_s))


def _line(state: RelativeState, numbers: Iterable[float]) -> str:
    return f"{epoch(state.t_capture_ns)} {_row(numbers)}"


def _row(numbers: Iterable[float]) -> str:
    return " ".join(f"{number:.15e}" for number in numbers)


def _covariance_lines(estimate: Estimate) -> Iterator[str]:
    """Yield the lower triangle of the covariance (6, 6) of position and velocity, row by row."""
    covariance = estimate.fixed_axes_covariance()
    rows = np.r_[POSITION, VELOCITY]
    lower = covariance[np.ix_(rows, rows)] * KM_PER_M**2
    for k in range(6):
        yield _row(lower[k, : k + 1])
