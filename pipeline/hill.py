"""Relative orbital motion, and what a chaser knows of it between pictures.

Hill frame: x radial outward, y along-track, z along the orbit normal, about the target.  States are position (m) and
velocity (m/s, as seen in the turning frame) of the chaser, (6,).
"""

from __future__ import annotations

from collections import deque
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm
from scipy.stats import chi2

from astratag.transforms import exp_so3, log_so3
from pipeline.convert import NS_PER_S

Array = NDArray[np.float64]

POSITION, VELOCITY = slice(0, 3), slice(3, 6)


@lru_cache(maxsize=64)
def clohessy_wiltshire(rate_rad_s: float, dt_s: float) -> tuple[Array, Array]:
    """Return how a state (6,) becomes one ``dt_s`` later, Phi (6, 6), and what a constant acceleration adds, (6, 3).

    Source: W. H. Clohessy, R. S. Wiltshire, "Terminal guidance system for satellite rendezvous", 1960.
    """
    n = rate_rad_s
    A = np.zeros((9, 9))
    A[POSITION, VELOCITY] = np.eye(3)
    A[3, 0], A[3, 4], A[4, 3], A[5, 2] = 3 * n**2, 2 * n, -2 * n, -(n**2)
    A[VELOCITY, 6:] = np.eye(3)
    step = expm(A * dt_s)
    return step[:6, :6], step[:6, 6:]


class RelativeOrbit:
    """Dead reckoning between measured positions: a Kalman filter that knows the orbit and its own thrust.

    The measurements are themselves a filter's output, whose errors last: each counts for little, ``inflation`` times
    its covariance.
    """

    GATE = float(chi2.ppf(1 - 1e-5, df=3))

    def __init__(
        self,
        x: Array,
        P: Array,
        t_ns: int,
        *,
        rate_rad_s: float,
        inflation: float,
        disturbance_m_s2: float,
        thrust_error_share: float,
    ):
        self._x, self._P, self._t_ns = x, P, t_ns
        self._rate_rad_s, self._inflation = rate_rad_s, inflation
        self._disturbance_m_s2, self._thrust_error_share = disturbance_m_s2, thrust_error_share
        self._thrusts: deque[tuple[int, Array]] = deque([(t_ns, np.zeros(3))])

    def thrust(self, t_ns: int, acceleration_hill_m_s2: Array) -> None:
        """Note the acceleration that is commanded from ``t_ns`` on."""
        self._thrusts.append((t_ns, acceleration_hill_m_s2))

    def measure(self, t_ns: int, r_hill_m: Array, cov: Array) -> bool:
        """Take in a position measured at ``t_ns``; False, and nothing changed, when it contradicts what is known."""
        if t_ns < self._t_ns:
            return False
        self._x, self._P = self.at(t_ns)
        self._t_ns = t_ns
        while len(self._thrusts) > 1 and self._thrusts[1][0] <= t_ns:
            self._thrusts.popleft()
        R = self._inflation * cov
        innovation, S = r_hill_m - self._x[POSITION], self._P[POSITION, POSITION] + R
        if float(innovation @ np.linalg.solve(S, innovation)) > self.GATE:
            return False
        K = np.linalg.solve(S, self._P[POSITION]).T
        IKH = np.eye(6)
        IKH[:, POSITION] -= K
        self._x = self._x + K @ innovation
        self._P = IKH @ self._P @ IKH.T + K @ R @ K.T
        return True

    def at(self, t_ns: int) -> tuple[Array, Array]:
        """Return the state (6,) and its covariance (6, 6) at ``t_ns``, not before the last measurement."""
        x, P, now_ns = self._x, self._P, self._t_ns
        ends = [start_ns for start_ns, _ in self._thrusts][1:] + [t_ns]
        for (_, acceleration), end_ns in zip(self._thrusts, ends, strict=True):
            dt_s = (min(end_ns, t_ns) - now_ns) / NS_PER_S
            if dt_s <= 0:
                continue
            Phi, Gamma = clohessy_wiltshire(self._rate_rad_s, dt_s)
            sigma_m_s2 = self._disturbance_m_s2 + self._thrust_error_share * np.abs(acceleration)
            x = Phi @ x + Gamma @ acceleration
            P = Phi @ P @ Phi.T + Gamma @ np.diag(sigma_m_s2**2) @ Gamma.T
            now_ns = min(end_ns, t_ns)
        return x, P


class TargetAttitude:
    """The target's attitude in the Hill frame, which hardly changes: a mean of what was measured, and of a prior.

    The errors of a measured attitude last long: each counts for little, ``inflation`` times its covariance.
    """

    GATE = float(chi2.ppf(1 - 1e-5, df=3))

    def __init__(self, R_hill_target: Array, sigma_rad: float, t_ns: int, *, inflation: float, drift_rad_sqrt_s: float):
        self.R_hill_target = R_hill_target
        self._P, self._t_ns = sigma_rad**2 * np.eye(3), t_ns
        self._inflation, self._drift_rad_sqrt_s = inflation, drift_rad_sqrt_s

    @property
    def sigma_rad(self) -> float:
        """Return the standard deviation about the least certain axis."""
        return float(np.sqrt(np.linalg.eigvalsh(self._P)[-1]))

    def measure(self, t_ns: int, R_hill_target: Array, cov: Array) -> bool:
        """Take in an attitude measured at ``t_ns`` with its covariance in target axes; False when it contradicts."""
        dt_s = max(t_ns - self._t_ns, 0) / NS_PER_S
        P = self._P + self._drift_rad_sqrt_s**2 * dt_s * np.eye(3)
        innovation = log_so3(self.R_hill_target.T @ R_hill_target)
        if float(innovation @ np.linalg.solve(P + cov, innovation)) > self.GATE:
            return False
        K = np.linalg.solve(P + self._inflation * cov, P).T
        self.R_hill_target = self.R_hill_target @ exp_so3(K @ innovation)
        self._P, self._t_ns = (np.eye(3) - K) @ P, t_ns
        return True
