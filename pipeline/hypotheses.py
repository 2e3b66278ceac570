"""The poses that explain what is seen: one, or two while a planar marker leaves it open which way it is tilted.

Each pose is a filter of its own; measurements move their probabilities until one is so much likelier that the other
is dropped, or until the two have come to the same.  Two that are merely near for their uncertainty are published as one
that covers both, and both are followed on.  A pose that has been so near its mirror image that the two were one is
open again once they part: which way it is tilted is left to the evidence, not to where it began.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from astratag.transforms import inverse, skew
from pipeline.corner_filter import CORNER_DOF, CornerFilter, Eye, SeenLayer, Update
from pipeline.dynamics import ATTITUDE, POSITION, RATE, STATES, VELOCITY, OwnMotion
from pipeline.mission import FilterSection

Array = NDArray[np.float64]

POSE_DOF = 6
START_MISFIT = 25.0
"""A first pose whose squared residuals are this many times what their noise explains is not believed."""
FIRST_LOOK = 4.0
"""How many times less certain a pose is begun with than its corners promise: a search is cruder than tracking."""
SAME_POSE = 0.02
"""Squared distance, as below, from which on two filters have come to the same and one is enough."""
ONE_MODE = 2.0
"""Squared distance, in units of the summed covariances, below which two equal Gaussians have a single mode: each is
then within two of its own standard deviations of the other."""


class HypothesisBank:
    """One or two filters with their logarithmic weights, the likeliest first."""

    def __init__(
        self, filters: list[CornerFilter], log_weights: list[float], noise: FilterSection, T_target_marker: Array
    ):
        """``T_target_marker`` is where the print lies that could be tilted the other way."""
        self.filters, self._log_weights, self._noise = filters, log_weights, noise
        self._T_target_marker = T_target_marker
        self._is_one_mode = False
        self._is_open = len(filters) == 1
        """There is one pose, but which way it is tilted was never decided."""
        self._sort_and_prune()

    @classmethod
    def start(
        cls,
        guesses: Sequence[Array],
        layers: Sequence[SeenLayer],
        eye: Eye,
        noise: FilterSection,
        T_target_marker: Array | None = None,
    ) -> HypothesisBank | None:
        """Return the poses that guesses T_chaser_target (4, 4) lead to on the corners; None when none fits them."""
        T_target_marker = np.eye(4) if T_target_marker is None else T_target_marker
        found: list[tuple[float, CornerFilter]] = []
        for guess in guesses:
            seen_from = eye.T_cam_chaser @ guess
            candidate = CornerFilter.start(guess, float(np.linalg.norm(seen_from[:3, 3])), noise)
            if candidate.update(layers, eye) is not None:
                found.append((candidate.misfit(layers, eye), candidate))
        found.sort(key=lambda pair: pair[0])
        dof = CORNER_DOF * len(layers) - POSE_DOF
        if not found or not found[0][0] < START_MISFIT * dof:
            return None
        best_misfit, best = found[0]
        scale = max(1.0, best_misfit / dof)
        rival = next((pair for pair in found[1:] if distance(best, pair[1]) > SAME_POSE), None)
        if rival is None:
            bank = cls([best], [0.0], noise, T_target_marker)
        else:
            weights = [-best_misfit / scale / 2, -rival[0] / scale / 2]
            bank = cls([best, rival[1]], weights, noise, T_target_marker)
        for candidate in bank.filters:
            candidate.distrust_pose(FIRST_LOOK)
        return bank

    @property
    def best(self) -> CornerFilter:
        """Return the likeliest filter."""
        return self.filters[0]

    @property
    def estimate(self) -> CornerFilter:
        """Return what to publish: the likeliest pose, or the mean of two that are one mode, covering both."""
        if len(self.filters) == 1 or not self._is_one_mode:
            return self.best
        return self.best.merged(self.filters[1], 1.0 - self.probability)

    @property
    def is_ambiguous(self) -> bool:
        """Tell whether two poses are still possible that are not one for their uncertainty."""
        return len(self.filters) > 1 and not self._is_one_mode

    @property
    def probability(self) -> float:
        """Return that of the likeliest pose."""
        weights = np.exp(np.array(self._log_weights) - self._log_weights[0])
        return float(1.0 / weights.sum())

    def copy(self) -> HypothesisBank:
        """Return a bank of its own in the same state."""
        bank = HypothesisBank.__new__(HypothesisBank)
        bank.filters, bank._log_weights = [f.copy() for f in self.filters], list(self._log_weights)
        bank._noise, bank._T_target_marker = self._noise, self._T_target_marker
        bank._is_one_mode, bank._is_open = self._is_one_mode, self._is_open
        return bank

    def predict(self, dt_s: float, unseen_s: float = 0.0, own: OwnMotion | None = None) -> None:
        """Let ``dt_s`` seconds pass, at the end of which nothing was measured for ``unseen_s`` seconds."""
        for hypothesis in self.filters:
            hypothesis.predict(dt_s, unseen_s, own)

    def gate(self, layers: Sequence[SeenLayer], eye: Eye) -> Array:
        """Return the normalised innovation squared of each layer under the pose that it fits best."""
        return np.min([hypothesis.gate(layers, eye) for hypothesis in self.filters], axis=0)

    def update(self, layers: Sequence[SeenLayer], eye: Eye) -> Update | None:
        """Take the same measurements into every filter; return what the likeliest made of them, None if nothing.

        Where even the better pose fits worse than the corner noise explains, likelihoods count in units of its own
        misfit, so that an underestimated noise cannot decide between the poses.
        """
        kept = [
            (update, hypothesis, weight)
            for hypothesis, weight in zip(self.filters, self._log_weights, strict=True)
            if (update := hypothesis.update(layers, eye)) is not None
        ]
        if not kept:
            return None
        scale = max(1.0, min(update.nis / update.dof for update, _, _ in kept))
        self.filters = [hypothesis for _, hypothesis, _ in kept]
        self._log_weights = [weight + update.log_likelihood / scale for update, _, weight in kept]
        likeliest = kept[int(np.argmax(self._log_weights))][0]
        self._sort_and_prune()
        if len(self.filters) == 1:
            self._look_for_a_rival(layers, eye, scale)
        return likeliest

    def _look_for_a_rival(self, layers: Sequence[SeenLayer], eye: Eye, scale: float) -> None:
        """Follow the mirror image too, where it has parted from a pose with which it was one, and fits as well."""
        if mirror_distance(self.best, self._T_target_marker, eye) < ONE_MODE:
            self._is_open = True
            return
        if not self._is_open:
            return
        self._is_open = False
        rival = mirrored(self.best, self._T_target_marker, eye)
        rival.distrust_pose(FIRST_LOOK)
        if rival.update(layers, eye) is None:
            return
        worse = rival.misfit(layers, eye) - self.best.misfit(layers, eye)
        self.filters.append(rival)
        self._log_weights.append(-worse / scale / 2)
        self._sort_and_prune()

    def _sort_and_prune(self) -> None:
        order = np.argsort([-weight for weight in self._log_weights], kind="stable")
        self.filters = [self.filters[k] for k in order]
        self._log_weights = [self._log_weights[k] - self._log_weights[order[0]] for k in order]
        if len(self.filters) == 1:
            return
        apart = distance(*self.filters)
        self._is_one_mode = apart < ONE_MODE
        if apart < SAME_POSE:
            self._is_open, self.filters[0] = True, self.estimate
        if apart < SAME_POSE or self._log_weights[-1] < -np.log(self._noise.ambiguity_ratio):
            del self.filters[1:], self._log_weights[1:]


def distance(a: CornerFilter, b: CornerFilter) -> float:
    """Return the squared distance between two filters' attitudes, in units of their summed covariances."""
    apart = a.motion.error_of(b.motion)[ATTITUDE]
    spread = a.covariance[ATTITUDE, ATTITUDE] + b.covariance[ATTITUDE, ATTITUDE]
    return float(apart @ np.linalg.solve(spread, apart))


MIRROR = np.diag([1.0, 1.0, -1.0])


def mirrored_pose(T_cam_marker: Array) -> Array:
    """Return the other pose under which a small flat marker looks the same: its tilt reversed about the line of sight.

    Source: D. Oberkampf, D. DeMenthon, L. Davis, "Iterative pose estimation using coplanar feature points", 1996.
    """
    T = T_cam_marker.copy()
    sight = T[:3, 3] / np.linalg.norm(T[:3, 3])
    T[:3, :3] = (np.eye(3) - 2 * np.outer(sight, sight)) @ T[:3, :3] @ MIRROR
    return T


def mirror_distance(one: CornerFilter, T_target_marker: Array, eye: Eye) -> float:
    """Return ``distance`` between a filter and its mirror image."""
    T_cam_marker = eye.T_cam_chaser @ one.motion.pose_chaser_target() @ T_target_marker
    sight = T_cam_marker[:3, :3].T @ T_cam_marker[:3, 3]
    across = np.hypot(sight[0], sight[1])
    turn_rad = 2 * np.arctan2(across, abs(sight[2]))
    axis_marker = np.array([sight[1], -sight[0], 0.0]) / max(across, np.finfo(float).tiny)
    apart = turn_rad * T_target_marker[:3, :3] @ axis_marker
    return float(apart @ np.linalg.solve(2 * one.covariance[ATTITUDE, ATTITUDE], apart))


def mirrored(one: CornerFilter, T_target_marker: Array, eye: Eye) -> CornerFilter:
    """Return a filter's mirror image: where the print lies, and how it moves, stay; tilt and tumble are reversed."""
    motion, place_target = one.motion, T_target_marker[:3, 3]
    R_target_marker = T_target_marker[:3, :3]
    T_cam_marker = eye.T_cam_chaser @ motion.pose_chaser_target() @ T_target_marker
    R = eye.T_cam_chaser[:3, :3].T @ mirrored_pose(T_cam_marker)[:3, :3] @ R_target_marker.T
    reversed_ = -R_target_marker @ MIRROR @ R_target_marker.T  # M R Exp(d) D = (M R D) Exp(-D d)
    omega = reversed_ @ motion.omega_chaser_target_in_target_rad_s
    by_lever = R @ skew(place_target) @ reversed_ - motion.R_chaser_target @ skew(place_target)
    J = np.eye(STATES)
    J[ATTITUDE, ATTITUDE] = J[RATE, RATE] = reversed_
    J[POSITION, ATTITUDE] = J[VELOCITY, RATE] = by_lever
    p = motion.p_chaser_target_m + (motion.R_chaser_target - R) @ place_target
    v = (
        motion.v_chaser_target_m_s
        + motion.R_chaser_target @ np.cross(motion.omega_chaser_target_in_target_rad_s, place_target)
        - R @ np.cross(omega, place_target)
    )
    moved = replace(
        motion,
        p_chaser_target_m=p,
        R_chaser_target=R,
        v_chaser_target_m_s=v,
        omega_chaser_target_in_target_rad_s=omega,
    )
    return CornerFilter(moved, J @ one.covariance @ J.T, one.noise)


def guesses_in_chaser(poses_cam_marker: Sequence[Array], eye: Eye, T_marker_target: Array) -> list[Array]:
    """Return T_chaser_target of poses T_cam_marker (4, 4) to start from, and of the mirror image of the first."""
    T_chaser_cam = inverse(eye.T_cam_chaser)
    return [T_chaser_cam @ T @ T_marker_target for T in (*poses_cam_marker, mirrored_pose(poses_cam_marker[0]))]
