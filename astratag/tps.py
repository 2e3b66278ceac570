"""Thin-plate splines: the warp that reads a code on a surface nobody described.

Of all smooth maps through given correspondences the thin-plate spline bends least (Bookstein, 1989).  The
correspondences are the corners of the nested squares and the middles of the outer one's sides: the AstraTag
paper's fallback for curved surfaces.  Where the inner squares lie is searched along bends a cylinder can make.
"""

from __future__ import annotations

from dataclasses import dataclass

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


@dataclass(frozen=True, eq=False)
class ThinPlateWarp:
    """The warp that takes a thin plate's knots to ``places_px`` (K, 2)."""

    plate: ThinPlate
    places_px: Array

    def __call__(self, template: Array) -> Array:
        """Return pixels (..., 2) of template points (..., 2)."""
        template = np.asarray(template)
        return (self.plate.basis(template.reshape(-1, 2)) @ self.places_px).reshape(template.shape)


def _knots() -> Array:
    outer = square(0.0, TEMPLATE_UNITS)
    middles = (outer + np.roll(outer, -1, axis=0)) / 2
    frame = LAYERS[1].frame
    assert frame is not None
    return np.concatenate([outer, middles, square(*frame), square(*LAYERS[2].black)])


KNOTS = _knots()
"""Correspondences (16, 2), in fours: outer corners, outer sides' middles, corners of first frame and last square."""

BENDS = (-0.21, -0.14, -0.07, 0.0, 0.07, 0.14, 0.21)
"""How far the middle of a bent print may lie from where it would if flat, as fractions of its sides."""


def _bends() -> Array:
    """Return, for each bend searched, how far (B, 16, 2) the knots move, in fractions of the print's two sides.

    A cylinder whose axis runs along one side moves the print by d (1 - u^2), u across the axis: none at the
    corners, most along the line through the middle.
    """
    u = KNOTS / (TEMPLATE_UNITS / 2) - 1.0
    shifts = [(a, b) for a in BENDS for b in BENDS if 0 < np.hypot(a, b) < 0.25]
    across = [1 - u[:, axis] ** 2 for axis in (0, 1)]
    return np.array([np.outer(profile, shift) for profile in across for shift in shifts])


BEND_SHIFTS = _bends()


def bent_places(flat_px: Array, corners_px: Array) -> Array:
    """Return where the knots lie (B, 16, 2) for each bend of a print whose corners (4, 2) stay in place.

    ``flat_px`` (16, 2) is where they would lie were it flat.
    """
    right = (corners_px[1] - corners_px[0] + corners_px[2] - corners_px[3]) / 2
    down = (corners_px[3] - corners_px[0] + corners_px[2] - corners_px[1]) / 2
    return flat_px + BEND_SHIFTS @ np.stack([right, down])
