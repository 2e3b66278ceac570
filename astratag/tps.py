"""Thin-plate splines: the warp that reads a code on a surface nobody described.

Of all smooth maps through given correspondences the thin-plate spline bends least (Bookstein, 1989).  The
correspondences are the corners of the nested squares and the middles of the outer one's sides: the AstraTag
paper's fallback for curved surfaces, and ours where no cylinder explains what is seen.  Where the knots lie is
searched by ``candidates``: sides bulge as the contour does, and what is between them shifts along.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from astratag.geometry import LAYERS, TEMPLATE_UNITS, square

Array = NDArray[np.float64]


def _kernel(squared_distance: Array) -> Array:
    """Return U(r) = r^2 log r^2, 0 at r = 0."""
    return squared_distance * np.log(np.where(squared_distance > 0, squared_distance, 1.0))


class ThinPlate:
    """A thin-plate spline with fixed knots (K, 2) in the template: what it warps is linear in where they lie."""

    def __init__(self, knots: Array) -> None:
        self.knots = np.asarray(knots, dtype=float)
        at = self.knots / TEMPLATE_UNITS
        n = len(at)
        if n < 3 or np.linalg.matrix_rank(at - at.mean(axis=0), tol=1e-6) < 2:
            raise ValueError(f"a thin-plate spline needs at least 3 knots that are not on one line, got {n}")
        P = np.column_stack([np.ones(n), at])
        system = np.block([[_kernel(((at[:, None] - at) ** 2).sum(axis=2)), P], [P.T, np.zeros((3, 3))]])
        self._coefficients = np.linalg.inv(system)[:, :n]

    def basis(self, template: Array) -> Array:
        """Return the matrix (N, K) that takes the knots' places to those of template points (N, 2)."""
        points = np.asarray(template) / TEMPLATE_UNITS
        U = _kernel(((points[:, None] - self.knots / TEMPLATE_UNITS) ** 2).sum(axis=2))
        return np.column_stack([U, np.ones(len(points)), points]) @ self._coefficients


def _knots() -> Array:
    outer = square(0.0, TEMPLATE_UNITS)
    middles = (outer + np.roll(outer, -1, axis=0)) / 2
    frame = LAYERS[1].frame
    assert frame is not None
    return np.concatenate([outer, middles, square(*frame), square(*LAYERS[2].black)])


KNOTS = _knots()
"""Correspondences (16, 2), in fours: outer corners, outer sides' middles, corners of first frame and last square."""
