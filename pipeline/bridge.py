"""From the relative states of the pose filter to what a controller may fly on: validity, age, covariance.

The bridge never hands out zeros and never a stale state as if it were fresh: between measurements, and without them,
it reckons with the orbit and its own thrust, says for how long it has done so, and how uncertain that is.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from astratag.transforms import skew, transform
from pipeline.convert import NS_PER_S, pose_matrix
from pipeline.hill import POSITION, RelativeOrbit, TargetAttitude
from schemas import Mode, RelativeState

Array = NDArray[np.float64]

FLOWN_MODES = (Mode.TRACK,)
"""Modes in which a state counts as a measurement.  COAST is no measurement: the bridge reckons better by itself, as it
knows the thrust.  AMBIGUOUS, INIT and LOST are none at all."""
ATTITUDES_KEPT = 64
OWN_ATTITUDE_SIGMA_RAD = 3e-4
"""How well the chaser knows its own attitude: what a far target's place in the Hill frame is uncertain by."""
TILT_SIGMA_RAD_M = 0.004
"""What a marker's tilt may be off by for each metre of range, whatever the pose filter says: a distant print looks much
the same tilted the other way."""


@dataclass(frozen=True, eq=False)
class OwnAttitude:
    """What the chaser's star tracker and gyroscope say."""

    t_ns: int
    R_hill_chaser: Array
    omega_hill_chaser_in_chaser_rad_s: Array


@dataclass(frozen=True, eq=False)
class Navigation:
    """What is known at an instant, and what it is worth."""

    t_ns: int
    r_hill_m: Array
    v_hill_m_s: Array
    position_sigma_m: float
    """Of the least certain direction."""
    R_hill_target: Array
    own: OwnAttitude
    mode: Mode
    """Of the newest state."""
    age_s: float | None
    """Since the last measurement that was believed; None before the first."""
    fresh_s: float
    """For how long measurements have come without a gap."""
    refused: str
    """Why the newest state was not believed; empty when it was."""


class NavigationBridge:
    """Relative states and the chaser's own attitude in, navigation out.  No clock."""

    def __init__(
        self, orbit: RelativeOrbit, target: TargetAttitude, *, gap_s: float, p_target_marker_m: Array | None = None
    ):
        """``p_target_marker_m`` is the middle of the markers, target axes: what is seen is there, whatever its tilt."""
        self._orbit, self._target, self._gap_s = orbit, target, gap_s
        self._p_target_marker_m = np.zeros(3) if p_target_marker_m is None else p_target_marker_m
        self._own: OrderedDict[int, OwnAttitude] = OrderedDict()
        self._mode, self._refused = Mode.INIT, "no state yet"
        self._t_measured_ns: int | None = None
        self._t_fresh_since_ns: int | None = None

    def take_attitude(self, own: OwnAttitude) -> None:
        """Note the chaser's own attitude at an instant, before the states of that instant come."""
        self._own[own.t_ns] = own
        while len(self._own) > ATTITUDES_KEPT:
            self._own.popitem(last=False)

    def take_state(self, state: RelativeState) -> None:
        """Take in a state of the pose filter; one that is not to be flown on only says so."""
        self._mode = state.mode
        self._refused = self._measure(state)
        if self._refused:
            return
        t_ns = state.t_capture_ns
        if self._t_measured_ns is None or (t_ns - self._t_measured_ns) / NS_PER_S > self._gap_s:
            self._t_fresh_since_ns = t_ns
        self._t_measured_ns = t_ns

    def take_thrust(self, t_ns: int, acceleration_hill_m_s2: Array) -> None:
        """Note what the controller commands from ``t_ns`` on."""
        self._orbit.thrust(t_ns, acceleration_hill_m_s2)

    def navigation(self, t_ns: int) -> Navigation:
        """Return what is known at ``t_ns``, for which an own attitude was taken."""
        x, P = self._orbit.at(t_ns)
        measured_ns, since_ns = self._t_measured_ns, self._t_fresh_since_ns
        age_s = None if measured_ns is None else (t_ns - measured_ns) / NS_PER_S
        is_fresh = age_s is not None and age_s <= self._gap_s and since_ns is not None
        return Navigation(
            t_ns=t_ns,
            r_hill_m=x[POSITION],
            v_hill_m_s=x[3:],
            position_sigma_m=float(np.sqrt(np.linalg.eigvalsh(P[POSITION, POSITION])[-1])),
            R_hill_target=self._target.R_hill_target,
            own=self._own[t_ns],
            mode=self._mode,
            age_s=age_s,
            fresh_s=(t_ns - since_ns) / NS_PER_S if is_fresh and since_ns is not None else 0.0,
            refused=self._refused,
        )

    def _measure(self, state: RelativeState) -> str:
        """Take a state in as a measurement; return why not, or nothing."""
        if state.mode not in FLOWN_MODES:
            return f"{state.mode.name} is not flown on"
        if state.T_chaser_target is None or state.covariance is None:
            return "the state has no pose or no covariance"
        own = self._own.get(state.t_capture_ns)
        if own is None:
            return "the chaser's attitude at that time is not known"
        T_chaser_target, cov = pose_matrix(state.T_chaser_target), np.array(state.covariance).reshape(12, 12)[:6, :6]
        R_hill_target = own.R_hill_chaser @ T_chaser_target[:3, :3]
        sight_hill_m = own.R_hill_chaser @ transform(T_chaser_target, self._p_target_marker_m)
        range_m = float(np.linalg.norm(sight_hill_m))
        floor = (OWN_ATTITUDE_SIGMA_RAD**2 + (TILT_SIGMA_RAD_M * range_m) ** 2) * np.eye(3)
        if not self._target.measure(state.t_capture_ns, R_hill_target, cov[3:, 3:] + floor):
            return "the attitude contradicts what it was so far"
        by_pose = R_hill_target @ np.hstack([np.eye(3), -skew(self._p_target_marker_m)])
        swing = OWN_ATTITUDE_SIGMA_RAD**2 * (range_m**2 * np.eye(3) - np.outer(sight_hill_m, sight_hill_m))
        r_hill_m = self._target.R_hill_target @ self._p_target_marker_m - sight_hill_m
        if not self._orbit.measure(state.t_capture_ns, r_hill_m, by_pose @ cov @ by_pose.T + swing):
            return "the position contradicts the orbit and the thrust so far"
        return ""
