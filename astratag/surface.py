"""The surface a marker is stuck to: from the flat print to points in the marker frame.

Print coordinates are metres from the centre, x right, y up.  The marker frame is tangent to the surface at
that centre; a print is wrapped without stretching.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from astratag.checks import finite, positive
from astratag.compiled import MATRIX, REAL, compiled

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

    def wrapped(self, on_print: Array) -> tuple[Array, Array]:
        """Return both."""
        return self.points(on_print), self.normals(on_print)


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

    def points(self, on_print: Array) -> Array:
        """Return print points (..., 2) in the marker frame (..., 3), metres."""
        return self.wrapped(on_print)[0]

    def normals(self, on_print: Array) -> Array:
        """Return outward unit normals (..., 3) at print points (..., 2)."""
        return self.wrapped(on_print)[1]

    def wrapped(self, on_print: Array) -> tuple[Array, Array]:
        """Return both."""
        shape = (*np.shape(on_print)[:-1], 3)
        flat = np.ascontiguousarray(np.reshape(on_print, (-1, 2)), dtype=float)
        points, normals = _wrapped(flat, self.radius_m, self.axis_rad)
        return points.reshape(shape), normals.reshape(shape)


@compiled(MATRIX, REAL, REAL)
def _wrapped(on_print: Array, radius_m: float, axis_rad: float) -> tuple[Array, Array]:
    """Return the points and outward normals (N, 3) of print points (N, 2) wrapped about a cylinder."""
    points, normals = np.empty((len(on_print), 3)), np.empty((len(on_print), 3))
    c, s = math.cos(axis_rad), math.sin(axis_rad)
    for i in range(len(on_print)):
        x, y = on_print[i, 0], on_print[i, 1]
        along, angle = c * x + s * y, (c * y - s * x) / radius_m
        sine, cosine = math.sin(angle), math.cos(angle)
        across = radius_m * sine
        points[i, 0], points[i, 1], points[i, 2] = (
            c * along - s * across,
            s * along + c * across,
            radius_m * (cosine - 1),
        )
        normals[i, 0], normals[i, 1], normals[i, 2] = -s * sine, c * sine, cosine
    return points, normals


Surface = Flat | Cylinder
