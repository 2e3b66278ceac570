"""The surface a marker is stuck to: from the flat print to points in the marker frame.

Print coordinates are metres from the centre, x right, y up.  The marker frame is tangent to the surface at
that centre; a print is wrapped without stretching.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from astratag.checks import finite, positive

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Flat:
    """A plane."""

    def points(self, on_print: Array) -> Array:
        """Return print points (..., 2) in the marker frame (..., 3), metres."""
        return np.concatenate([on_print, np.zeros_like(on_print[..., :1])], axis=-1)

    def normals(self, on_print: Array) -> Array:
        """Return outward unit normals (..., 3) at print points (..., 2)."""
        return np.broadcast_to(np.array([0.0, 0.0, 1.0]), (*on_print.shape[:-1], 3)).copy()


@dataclass(frozen=True)
class Cylinder:
    """The outside of a cylinder: its axis lies behind the marker, parallel to the marker's plane.

    ``radius_m`` > 0; ``axis_rad`` is the direction of the axis in the marker's plane, from x towards y:
    0 when the axis runs along the marker's x and the print bends over top and bottom.
    """

    radius_m: float
    axis_rad: float = 0.0

    def __post_init__(self) -> None:
        positive(self.radius_m, "radius_m", "length in metres, and a flat marker is Flat()")
        finite(self.axis_rad, "axis_rad")

    @property
    def _along_across(self) -> tuple[Array, Array]:
        c, s = np.cos(self.axis_rad), np.sin(self.axis_rad)
        return np.array([c, s]), np.array([-s, c])

    def points(self, on_print: Array) -> Array:
        """Return print points (..., 2) in the marker frame (..., 3), metres."""
        along, across = self._along_across
        a, b = on_print @ along, on_print @ across / self.radius_m
        flat = a[..., None] * along + (self.radius_m * np.sin(b))[..., None] * across
        return np.concatenate([flat, (self.radius_m * (np.cos(b) - 1.0))[..., None]], axis=-1)

    def normals(self, on_print: Array) -> Array:
        """Return outward unit normals (..., 3) at print points (..., 2)."""
        _, across = self._along_across
        b = on_print @ across / self.radius_m
        return np.concatenate([np.sin(b)[..., None] * across, np.cos(b)[..., None]], axis=-1)


Surface = Flat | Cylinder
