"""The poses that explain what is seen: one, or two while a planar marker leaves it open which way it is tilted.

Each pose is a filter of its own; measurements move their probabilities until one is so much likelier that the other
is dropped, or until the two have come to the same.  Two that are near, for their uncertainty or at all, are published
as one that covers both.  Which way a print is tilted is left to the evidence of the last looks, never to where it
began: a pose counts as the only one while its mirror image fits them so much worse, and is ambiguous otherwise.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dpotrf, dtrtrs

from astratag.transforms import inverse, skew
from pipeline.corner_filter import CornerFilter, Update
from pipeline.corners import CORNER_DOF, Eye, SeenLayer, corner_noise, predicted_corners
from pipeline.dynamics import (
    ACCELERATION,
    ANGULAR_ACCELERATION,
    ATTITUDE,
    POSITION,
    RATE,
    VELOCITY,
    Motion,
    OwnMotion,
)
from pipeline.mission import FilterSection

Array = NDArray[np.float64]

POSE_DOF = 6
LOOKS = np.array([100.0, 1.0])
"""How many of the last looks at the corners tell a pose from its mirror image: many, where each says little, or one,
where each says much and the tilt changes from one to the next."""
FEWEST_LOOKS = 8.0
SETTLED = 4.0
"""Evidence so many times what is asked for is looked at again only now and then."""
RECHECK = 5
START_MISFIT = 25.0
"""A first pose whose squared residuals are this many times what their noise explains is not believed."""
FIRST_LOOK = 4.0
"""How many times less certain a pose is begun with than its corners promise: a search is cruder than tracking."""
LEAST_TILT = 0.1
"""Sine of the least tilt at which looks are asked which way a print is tilted."""
SAME_POSE = 0.02
"""Squared distance, as below, from which on two filters have come to the same and one is enough."""
ONE_MODE = 2.0
"""Squared distance, in units of the summed covariances, below which two equal Gaussians have a single mode: each is
then within two of its own standard deviations of the other."""


class HypothesisBank:
    """One or two filters with their logarithmic weights, the likeliest first."""

    def __init__(
        self,
        filters: list[CornerFilter],
        log_weights: list[float],
        noise: FilterSection,
        T_target_marker: Array,
        eye: Eye,
    ):
        """``T_target_marker`` is where the print lies that could be tilted the other way."""
        self.filters, self._log_weights, self._noise = filters, log_weights, noise
        self._T_target_marker, self._eye = T_target_marker, eye
        self._is_one_mode = False
        self._leaning, self._looks = np.zeros((2, 3)), np.zeros(2)
        """Half of what the last looks say for a tilt rather than its reverse, for each unit of tilt, camera axes; and
        how many they are."""
        self._evidence = 0.0
        """What they say for the likeliest pose rather than its mirror image, as a logarithmic likelihood ratio."""
        self._enough = float(np.log(noise.ambiguity_ratio))
        self._unchecked = 0
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
            bank = cls([best], [0.0], noise, T_target_marker, eye)
        else:
            weights = [-best_misfit / scale / 2, -rival[0] / scale / 2]
            bank = cls([best, rival[1]], weights, noise, T_target_marker, eye)
        bank._weigh_mirrored(bank._look_leans(layers, eye) / scale, layers, eye)
        for candidate in bank.filters:
            candidate.distrust_pose(FIRST_LOOK)
        return bank

    @property
    def best(self) -> CornerFilter:
        """Return the likeliest filter."""
        return self.filters[0]

    @property
    def estimate(self) -> CornerFilter:
        """Return what to publish: the likeliest pose, or the mean of two that are near, covering both."""
        if self.is_ambiguous or self._is_sure:
            return self.best
        rival = self.filters[1] if len(self.filters) > 1 else mirrored(self.best, self._T_target_marker, self._eye)
        return self.best.merged(rival, 1.0 - self.probability)

    @property
    def is_ambiguous(self) -> bool:
        """Tell whether two poses are still possible that are not one, for their uncertainty or at all.

        After a few looks at a distant print both may still be far from where they are going.
        """
        return not (self._is_sure or (self._is_one_mode and self._looks[0] > FEWEST_LOOKS))

    @property
    def _is_sure(self) -> bool:
        return len(self.filters) == 1 and self._evidence >= self._enough

    @property
    def probability(self) -> float:
        """Return that of the likeliest pose."""
        if len(self.filters) == 1:
            return float(1.0 / (1.0 + np.exp(-max(self._evidence, 0.0))))
        weights = np.exp(np.array(self._log_weights) - self._log_weights[0])
        return float(1.0 / weights.sum())

    def copy(self) -> HypothesisBank:
        """Return a bank of its own in the same state."""
        bank = copy(self)
        bank.filters, bank._log_weights = [f.copy() for f in self.filters], list(self._log_weights)
        return bank

    def predict(self, dt_s: float, own: OwnMotion | None = None) -> None:
        """Let ``dt_s`` seconds pass."""
        for hypothesis in self.filters:
            hypothesis.predict(dt_s, own)

    def observe_from(self, before: OwnMotion, now: OwnMotion) -> None:
        """Have the chaser's own rate change, which is known."""
        for hypothesis in self.filters:
            hypothesis.motion = hypothesis.motion.observed_from(before, now)

    def gate(self, layers: Sequence[SeenLayer], eye: Eye) -> Array:
        """Return the normalised innovation squared of each layer under the pose that it fits best."""
        return np.min([hypothesis.gate(layers, eye) for hypothesis in self.filters], axis=0)

    def update(self, layers: Sequence[SeenLayer], eye: Eye) -> Update | None:
        """Take the same measurements into every filter; return what the likeliest made of them, None if nothing.

        Where even the better pose fits worse than the corner noise explains, likelihoods count in units of its own
        misfit, so that an underestimated noise cannot decide between the poses.
        """
        is_due = self._evidence < SETTLED * self._enough or self._unchecked >= RECHECK
        self._unchecked = 0 if is_due else self._unchecked + 1
        leaning = self._look_leans(layers, eye) if is_due else None
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
        if leaning is not None:
            self._weigh_mirrored(leaning / scale, layers, eye)
        return likeliest

    def _look_leans(self, layers: Sequence[SeenLayer], eye: Eye) -> Array:
        """Return half of what a look says for a tilt rather than its reverse, for each unit of tilt, camera axes (3,).

        To it, tilts count along the likeliest pose's and across, so that it holds whatever that pose becomes.
        """
        T = eye.T_cam_chaser @ self.best.motion.pose_chaser_target() @ self._T_target_marker
        T_marker_target = inverse(self._T_target_marker)
        sight = T[:3, 3] / np.linalg.norm(T[:3, 3])
        tilt = tilt_of(T)
        size = max(float(np.linalg.norm(tilt)), LEAST_TILT)
        along = tilt if np.linalg.norm(tilt) > 1e-6 else np.cross(sight, [0.0, 1.0, 0.0])
        along = along / np.linalg.norm(along)
        leaning = np.zeros(3)
        root, _ = dpotrf(corner_noise(layers, self._noise), lower=1)
        for way in (along, np.cross(sight, along)):
            poses = [tilted_pose(T, sign * size * way) @ T_marker_target for sign in (1, -1)]
            one, other = (aligned_misfit(pose, layers, eye, root) for pose in poses)
            if np.isfinite(one) and np.isfinite(other):
                leaning += (other - one) / (4 * size) * way
        return leaning

    def _weigh_mirrored(self, leaning: Array, layers: Sequence[SeenLayer], eye: Eye) -> None:
        """Take in what a look says for the tilts, and follow the mirror image too where that fits better.

        What lasts of the corners' errors repeats itself: many looks then count like few.
        """
        fade = 1 - 1 / LOOKS
        self._leaning, self._looks = fade[:, None] * self._leaning + leaning, fade * self._looks + 1
        sigma_px = min(layer.sigma_px for layer in layers)
        tilt = tilt_of(eye.T_cam_chaser @ self.best.motion.pose_chaser_target() @ self._T_target_marker)
        repeated = 1 + self._looks * (self._noise.lasting_sigma_px / sigma_px) ** 2
        self._evidence = float(np.max(2 * self._leaning @ tilt / repeated))
        image = mirrored(self.best, self._T_target_marker, eye)
        self._is_one_mode = is_one_mode(self.best, image, self._noise)
        if len(self.filters) > 1 or self._evidence > 0 or self._is_one_mode:
            return
        image.distrust_pose(FIRST_LOOK)
        if image.update(layers, eye) is not None:
            self.filters.append(image)
            self._log_weights.append(0.0)
            self._sort_and_prune()

    def _sort_and_prune(self) -> None:
        order = np.argsort([-weight for weight in self._log_weights], kind="stable")
        self.filters = [self.filters[k] for k in order]
        self._log_weights = [self._log_weights[k] - self._log_weights[order[0]] for k in order]
        if len(self.filters) == 1:
            return
        apart = distance(*self.filters)
        if apart < SAME_POSE:
            self.filters[0] = self.filters[0].merged(self.filters[1], 1.0 - self.probability)
        image = mirrored(self.best, self._T_target_marker, self._eye)
        is_same_side = turned_rad(self.filters[1], self.best) < turned_rad(self.filters[1], image)
        if apart < SAME_POSE or is_same_side or self._log_weights[-1] < -np.log(self._noise.ambiguity_ratio):
            del self.filters[1:], self._log_weights[1:]


def distance(a: CornerFilter, b: CornerFilter) -> float:
    """Return the squared distance between two filters' attitudes, in units of their summed covariances."""
    apart = a.motion.error_of(b.motion)[ATTITUDE]
    spread = a.covariance[ATTITUDE, ATTITUDE] + b.covariance[ATTITUDE, ATTITUDE]
    return float(apart @ np.linalg.solve(spread, apart))


def turned_rad(a: CornerFilter, b: CornerFilter) -> float:
    """Return how far two filters' attitudes are turned against each other."""
    return float(np.linalg.norm(a.motion.error_of(b.motion)[ATTITUDE]))


def is_one_mode(a: CornerFilter, b: CornerFilter, noise: FilterSection) -> bool:
    """Tell whether two filters' attitudes are so near that a covariance about their mean may stand for both."""
    return turned_rad(a, b) < noise.one_tilt_rad or distance(a, b) < ONE_MODE


MIRROR = np.diag([1.0, 1.0, -1.0])


def mirrored_pose(T_cam_marker: Array) -> Array:
    """Return the other pose under which a small flat marker looks the same: its tilt reversed about the line of sight.

    Source: D. Oberkampf, D. DeMenthon, L. Davis, "Iterative pose estimation using coplanar feature points", 1996.
    """
    T = T_cam_marker.copy()
    sight = T[:3, 3] / np.linalg.norm(T[:3, 3])
    T[:3, :3] = (np.eye(3) - 2 * np.outer(sight, sight)) @ T[:3, :3] @ MIRROR
    return T


def tilt_of(T_cam_marker: Array) -> Array:
    """Return how far a marker is turned from the line of sight: the part of its normal across that, camera axes (3,).

    Its length is the sine of the tilt; the mirror image has the opposite one.
    """
    sight, normal = T_cam_marker[:3, 3] / np.linalg.norm(T_cam_marker[:3, 3]), T_cam_marker[:3, 2]
    return np.asarray(normal - (normal @ sight) * sight)


def tilted_pose(T_cam_marker: Array, tilt: Array) -> Array:
    """Return a pose at the same place that is turned, by the shortest way, to another tilt."""
    T = T_cam_marker.copy()
    sight, normal = T[:3, 3] / np.linalg.norm(T[:3, 3]), T[:3, 2]
    facing = np.copysign(np.sqrt(max(1.0 - float(tilt @ tilt), 0.0)), normal @ sight)
    wanted = tilt + facing * sight
    axis = np.cross(normal, wanted)
    W = skew(axis)
    T[:3, :3] = (np.eye(3) + W + W @ W / (1 + normal @ wanted)) @ T[:3, :3]
    return T


def aligned_misfit(T_cam_target: Array, layers: Sequence[SeenLayer], eye: Eye, root: Array) -> float:
    """Return the squared residuals, in units of their noise, of a pose moved and rolled to fit as well as it can.

    Where a print is and how it is rolled was found with one tilt: held fast, it would speak for that.  ``root``
    (8 L, 8 L) is the lower Cholesky factor of the corners' noise.
    """
    motion = Motion.at_rest(inverse(eye.T_cam_chaser) @ T_cam_target)
    seen = predicted_corners(motion, layers, eye)
    if seen is None:
        return np.inf
    observed = np.concatenate([layer.corners_px.ravel() for layer in layers])
    sight = motion.R_chaser_target.T @ eye.T_cam_chaser[:3, :3].T @ T_cam_target[:3, 3]
    H = seen[1]
    whole = np.column_stack([H[:, POSITION], H[:, ATTITUDE] @ sight, observed - seen[0]])
    white = dtrtrs(root, whole, lower=1)[0]
    squares = white.T @ white
    L, fault = dpotrf(squares[:-1, :-1], lower=1)
    if fault:
        return np.inf
    along = dtrtrs(L, squares[:-1, -1], lower=1)[0]
    return max(float(squares[-1, -1] - along @ along), 0.0)


def mirrored(one: CornerFilter, T_target_marker: Array, eye: Eye) -> CornerFilter:
    """Return a filter's mirror image: where the print lies, and how it moves, stay; tilt and tumble are reversed."""
    motion, place_target = one.motion, T_target_marker[:3, 3]
    R_target_marker = T_target_marker[:3, :3]
    T_cam_marker = eye.T_cam_chaser @ motion.pose_chaser_target() @ T_target_marker
    R = eye.T_cam_chaser[:3, :3].T @ mirrored_pose(T_cam_marker)[:3, :3] @ R_target_marker.T
    reversed_ = -R_target_marker @ MIRROR @ R_target_marker.T  # M R Exp(d) D = (M R D) Exp(-D d)
    omega = reversed_ @ motion.omega_chaser_target_in_target_rad_s
    alpha = reversed_ @ motion.alpha_in_target_rad_s2
    arm = skew(place_target)
    by_lever = R @ arm @ reversed_ - motion.R_chaser_target @ arm
    J = np.eye(len(one.covariance))
    for turn, way in ((ATTITUDE, POSITION), (RATE, VELOCITY), (ANGULAR_ACCELERATION, ACCELERATION)):
        J[turn, turn], J[way, turn] = reversed_, by_lever
    p = motion.p_chaser_target_m + (motion.R_chaser_target - R) @ place_target
    v = (
        motion.v_chaser_target_m_s
        - motion.R_chaser_target @ arm @ motion.omega_chaser_target_in_target_rad_s
        + R @ arm @ omega
    )
    a = motion.a_chaser_target_m_s2 - motion.R_chaser_target @ arm @ motion.alpha_in_target_rad_s2 + R @ arm @ alpha
    moved = replace(
        motion,
        p_chaser_target_m=p,
        R_chaser_target=R,
        v_chaser_target_m_s=v,
        omega_chaser_target_in_target_rad_s=omega,
        a_chaser_target_m_s2=a,
        alpha_in_target_rad_s2=alpha,
    )
    return CornerFilter(moved, J @ one.covariance @ J.T, one.noise, one.lasting)


def guesses_in_chaser(poses_cam_marker: Sequence[Array], eye: Eye, T_marker_target: Array) -> list[Array]:
    """Return T_chaser_target of poses T_cam_marker (4, 4) to start from, and of the mirror image of the first."""
    T_chaser_cam = inverse(eye.T_cam_chaser)
    return [T_chaser_cam @ T @ T_marker_target for T in (*poses_cam_marker, mirrored_pose(poses_cam_marker[0]))]
