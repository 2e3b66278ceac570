"""How well anything could know the relative state: the posterior Cramer-Rao bound along a true trajectory.

Source: P. Tichavsky, C. Muravchik, A. Nehorai, "Posterior Cramer-Rao bounds for discrete-time nonlinear filtering",
1998: for Gaussian noise it is the Riccati recursion with all slopes taken at the truth, and nothing merely considered.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pipeline.convert import NS_PER_S
from pipeline.corner_filter import CornerFilter, Look, Update
from pipeline.corners import Eye, SeenLayer, predicted_corners
from pipeline.dynamics import Motion
from pipeline.mission import FilterSection

Array = NDArray[np.float64]


class Bound(CornerFilter):
    """The recursion: a filter that is told the truth before it looks."""

    considered = slice(0, 0)
    gain: tuple[Array, Array] | None = None
    """How the last look's residuals (8 L,) px move the error state (N, 8 L), and its slopes (8 L, N); None: no look."""

    def look(self, motion: Motion, layers: Sequence[SeenLayer], eye: Eye) -> None:
        """Take in the information that layers hold about a true motion."""
        self.motion, self.gain = motion, None
        predicted = predicted_corners(motion, layers, eye) if layers else None
        if predicted is None:
            return
        corners = predicted[0].reshape(-1, 4, 2)
        self.update([replace(layer, corners_px=px) for layer, px in zip(layers, corners, strict=True)], eye)

    def _accept(self, motion: Motion, error: Array, look: Look, K: Array, innovation: Array, L: Array) -> Update | None:
        self.gain = K, look.H
        return super()._accept(motion, error, look, K, innovation, L)


def posterior_bounds(
    looks: Iterable[tuple[int, Motion, Sequence[SeenLayer]]], eye: Eye, noise: FilterSection
) -> Iterator[Array]:
    """Yield the bound (12, 12), in the messages' convention, after each of (stamp, true motion, layers seen).

    Of the layers only places and sigmas count.
    """
    bound: Bound | None = None
    last_ns = 0
    for t_ns, motion, layers in looks:
        if bound is None:
            T_chaser_target = motion.pose_chaser_target()
            range_m = float(np.linalg.norm((eye.T_cam_chaser @ T_chaser_target)[:3, 3]))
            bound = Bound.start(T_chaser_target, range_m, noise)
        else:
            bound.predict((t_ns - last_ns) / NS_PER_S)
        last_ns = t_ns
        bound.look(motion, layers, eye)
        yield bound.message_covariance()
