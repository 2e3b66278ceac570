"""What a scene is made of: plates, tubes and boxes where rays meet them, and what their surfaces are like.

A body's own frame: a plate or disc lies in x, y and faces z; a tube's axis runs along x, and the origin lies on its
outside where z is the outward normal, as for a marker on a cylinder.  Albedos are linear, RGB.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.render import BLACK_ALBEDO, WHITE_ALBEDO
from pipeline.texture import Image, Texture

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Component = NDArray[Any]
"""One number a ray, float32."""
Line = tuple[Any, Any, Any]
"""Three components of the rays' origins, directions or normals; a float where all rays share it."""


@dataclass(frozen=True, eq=False)
class Hit:
    """Where rays meet a body: depth in ray lengths, surface coordinates (m), normal, and whether they meet it."""

    depth: Component
    u_m: Component
    v_m: Component
    normal: Line
    seen: Mask


@dataclass(frozen=True)
class Plate:
    """A rectangle, seen from its front; with ``round``, the ellipse in it, with a ``hole`` of that share."""

    half_x_m: float
    half_y_m: float
    round: bool = False
    hole: float = 0.0

    def points(self) -> Array:
        """Return corners (N, 3) of something that encloses the plate."""
        return np.array([(x, y, 0.0) for x in (-self.half_x_m, self.half_x_m) for y in (-self.half_y_m, self.half_y_m)])

    def hit(self, origin: Line, direction: Line) -> Hit:
        """Return where rays meet the plate's plane, from either side."""
        depth = np.asarray(-origin[2] / direction[2])
        u, v = origin[0] + depth * direction[0], origin[1] + depth * direction[1]
        if self.round:
            share = (u / self.half_x_m) ** 2 + (v / self.half_y_m) ** 2
            seen = (share <= 1) & (share >= self.hole**2)
        else:
            seen = (np.abs(u) <= self.half_x_m) & (np.abs(v) <= self.half_y_m)
        return Hit(depth, u, v, (0.0, 0.0, 1.0), seen & (depth > 0))


@dataclass(frozen=True)
class Tube:
    """The outside of a tube, ``radius_m`` in the middle and growing by ``taper`` along x."""

    radius_m: float
    half_length_m: float
    taper: float = 0.0

    def points(self) -> Array:
        """Return corners (N, 3) of something that encloses the tube."""
        reach = self.radius_m + abs(self.taper) * self.half_length_m
        ends = itertools.product((-self.half_length_m, self.half_length_m), (-reach, reach), (-reach, reach))
        return np.array([(x, y, z - self.radius_m) for x, y, z in ends])

    def hit(self, origin: Line, direction: Line) -> Hit:
        """Return where rays enter the tube."""
        (ox, oy, oz), (dx, dy, dz), k = origin, direction, self.taper
        oz = oz + self.radius_m
        o_radius, d_radius = self.radius_m + k * ox, k * dx
        a = dy * dy + dz * dz - d_radius * d_radius
        b = oy * dy + oz * dz - o_radius * d_radius
        depth = np.asarray((-b - np.sqrt(b * b - a * (oy * oy + oz * oz - o_radius * o_radius))) / a)
        x, y, z = ox + depth * dx, oy + depth * dy, oz + depth * dz
        radius = o_radius + depth * d_radius
        seen = (np.abs(x) <= self.half_length_m) & (depth > 0) & (radius > 0)
        steep = float(np.hypot(1.0, k))
        normal = (-k / steep, y / (radius * steep), z / (radius * steep))
        return Hit(depth, x, (radius * np.arctan2(y, z)), normal, seen)


@dataclass(frozen=True)
class Box:
    """A cuboid about its origin; its sides have no coordinates, so it is of one colour."""

    half_x_m: float
    half_y_m: float
    half_z_m: float

    def points(self) -> Array:
        """Return the corners (8, 3)."""
        return np.array(
            list(itertools.product(*((-half, half) for half in (self.half_x_m, self.half_y_m, self.half_z_m))))
        )

    def hit(self, origin: Line, direction: Line) -> Hit:
        """Return where rays enter the box."""
        halves = (self.half_x_m, self.half_y_m, self.half_z_m)
        middle = [np.asarray(-o / d) for o, d in zip(origin, direction, strict=True)]
        reach = [np.abs(half / d) for half, d in zip(halves, direction, strict=True)]
        enter = np.maximum(np.maximum(middle[0] - reach[0], middle[1] - reach[1]), middle[2] - reach[2])
        leave = np.minimum(np.minimum(middle[0] + reach[0], middle[1] + reach[1]), middle[2] + reach[2])
        x, y, z = (-np.sign(d) * (enter == m - r) for d, m, r in zip(direction, middle, reach, strict=True))
        flat = np.zeros_like(enter)
        return Hit(enter, flat, flat, (x, y, z), (enter < leave) & (enter > 0))


@dataclass(frozen=True, eq=False)
class Print:
    """A marker print laid flush on a body, its centre at the body's origin: x right, y up."""

    coverage: Texture
    half_m: float


@dataclass(frozen=True, eq=False)
class Material:
    """How a surface reflects: diffuse ``albedo``, and a glossy lobe of peak ``gloss`` and exponent ``sharpness``.

    ``bump`` holds the surface's slopes along u and v; ``marker`` is laid over the albedo.
    """

    albedo: Texture | tuple[float, float, float]
    gloss: float = 0.05
    sharpness: float = 40.0
    bump: Texture | None = None
    marker: Print | None = None

    def normal(self, hit: Hit, footprint_m: float) -> Line:
        """Return the surface's normal where rays meet it, bumps included."""
        if self.bump is None:
            return hit.normal
        slopes = self.bump.read(hit.u_m, hit.v_m, footprint_m)
        steep = 1 / np.sqrt(1 + slopes[..., 0] ** 2 + slopes[..., 1] ** 2)
        return -slopes[..., 0] * steep, -slopes[..., 1] * steep, steep

    def read_albedo(self, u_m: Component, v_m: Component, footprint_m: float) -> Image:
        """Return the albedo (..., 3) at surface points."""
        if isinstance(self.albedo, Texture):
            albedo = self.albedo.read(u_m, v_m, footprint_m)
        else:
            albedo = np.broadcast_to(np.array(self.albedo, np.float32), (*u_m.shape, 3))
        if self.marker is None:
            return albedo
        albedo, half = np.array(albedo), self.marker.half_m
        near = (np.abs(u_m) < half + footprint_m) & (np.abs(v_m) < half + footprint_m)
        rows, columns = np.flatnonzero(near.any(axis=1)), np.flatnonzero(near.any(axis=0))
        if rows.size:
            part = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
            u, v = u_m[part], v_m[part]
            alpha = np.clip((half - np.abs(u)) / footprint_m + 0.5, 0, 1)
            alpha *= np.clip((half - np.abs(v)) / footprint_m + 0.5, 0, 1)
            ink = BLACK_ALBEDO + (WHITE_ALBEDO - BLACK_ALBEDO) * self.marker.coverage.read(u, v, footprint_m)
            albedo[part] += alpha[..., None] * (ink[..., None] - albedo[part])
        return albedo


@dataclass(frozen=True, eq=False)
class Body:
    """A shape of one material, fixed in the scene."""

    shape: Plate | Tube | Box
    material: Material
    T_scene_body: Array
    casts_shadow: bool = False
