"""Simple bodies in sunlight before a dark sky, seen by the simulated camera: plates, discs and (tapered) tubes.

A body's own frame: a plate or disc lies in x, y and faces z; a tube's axis runs along x, and the origin lies on its
outside where z is the outward normal, as for a marker on a cylinder.  Light is linear, RGB, 1 where the sensor
saturates.  The sun is a direction, with one diffuse and one glossy reflection and hard shadows.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from astratag.camera import Camera
from astratag.transforms import inverse, transform
from pipeline.render import BLACK_ALBEDO, WHITE_ALBEDO, Image, Texture, pixel_rays, ray_lattice, window_of

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Component = NDArray[Any]
"""One number a ray, float32."""
Line = tuple[Any, Any, Any]
"""Three components of the rays' origins, directions or normals; a float where all rays share it."""

SHADOW_GAP_M = 1e-4
"""Nearer than this to the lit point nothing casts a shadow: a surface does not shade itself by rounding."""

PENUMBRA_PX = 0.7

EXHAUSTIVE_SAMPLES = 7
"""So many orders can all be tried."""


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
class Sight:
    """What the rays of a window of pixels see of one body: ``won`` where it is the nearest."""

    window: tuple[slice, slice]
    hit: Hit
    direction: Line
    won: Mask


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


@dataclass(frozen=True, eq=False)
class Sun:
    """Where light comes from: a unit vector towards it in camera axes, its irradiance, and the even light from around.

    A white surface square to the sun looks ``irradiance`` bright.
    """

    direction_cam: Array
    irradiance: float = 1.0
    ambient: tuple[float, float, float] = (0.02, 0.022, 0.026)


@dataclass(frozen=True, eq=False)
class Scene:
    """Bodies fixed to each other, the sun, and the sky behind (height, width, 3), both fixed to the camera."""

    bodies: Sequence[Body]
    sun: Sun
    sky: Image = field(repr=False)

    def light(self, camera: Camera, poses_cam_scene: Sequence[Array]) -> Image:
        """Return the light (height, width, 3) that falls on the sensor during an exposure.

        ``poses_cam_scene`` are the scene's poses in the camera at as many instants, evenly spaced about mid-exposure:
        each pixel sends one ray at each.  Shadows are those of mid-exposure, to a pixel.
        """
        samples = len(poses_cam_scene)
        sunlit = self._sunlit(camera, poses_cam_scene[samples // 2])
        pixel = 1.0 / np.sqrt(camera.K[0, 0] * camera.K[1, 1] * samples)
        total = np.zeros_like(self.sky)
        for offset_px, instant in zip(ray_lattice(samples), exposure_order(samples), strict=True):
            T_cam_scene, picture = poses_cam_scene[instant], self.sky.copy()
            for index, sight in self._trace(camera, T_cam_scene, offset_px):
                shade = self._shade(self.bodies[index], T_cam_scene, sight, sunlit[sight.window], pixel)
                np.copyto(picture[sight.window], shade, where=sight.won[..., None])
            total += picture
        return total / np.float32(samples)

    def _trace(self, camera: Camera, T_cam_scene: Array, offset_px: Array) -> Iterator[tuple[int, Sight]]:
        """Yield each body with the pixels in which it is the nearest so far, one ray a pixel."""
        rays, right, down = pixel_rays(camera)
        nearest = np.full((camera.height, camera.width), np.inf, np.float32)
        for index, body in enumerate(self.bodies):
            T_body_cam = inverse(T_cam_scene @ body.T_scene_body)
            window = window_of(camera, transform(inverse(T_body_cam), body.shape.points()))
            if window is None:
                continue
            ray = (rays[window] + offset_px[0] * right[window] + offset_px[1] * down[window]).astype(np.float32)
            direction = _turn(T_body_cam[:3, :3], (ray[..., 0], ray[..., 1], 1.0))
            with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
                hit = body.shape.hit(_floats(T_body_cam[:3, 3]), direction)
                won = hit.seen & (hit.depth < nearest[window]) & (_dot(hit.normal, direction) < 0)
            if won.any():
                hit = _only(hit, won)
                np.copyto(nearest[window], hit.depth, where=won)
                yield index, Sight(window, hit, direction, won)

    def _shade(self, body: Body, T_cam_scene: Array, sight: Sight, sunlit: Component, pixel: float) -> Image:
        """Return the light that a body sends back along the rays that meet it."""
        material, hit, direction = body.material, sight.hit, sight.direction
        facing = np.maximum(-_dot(hit.normal, direction), 1e-6)
        footprint_m = float(np.median((hit.depth / np.sqrt(facing))[sight.won])) * pixel
        to_sun = _floats((T_cam_scene[:3, :3] @ body.T_scene_body[:3, :3]).T @ self.sun.direction_cam)
        normal = material.normal(hit, footprint_m)
        towards_sun = _dot(normal, to_sun)
        sunlit = sunlit * np.float32(self.sun.irradiance) * (towards_sun > 0)
        # Blinn's halfway vector between the sun and the eye, without forming it.
        length = np.sqrt(_dot(direction, direction))
        towards_eye, between = -_dot(normal, direction) / length, -_dot(to_sun, direction) / length
        halfway = np.clip((towards_sun + towards_eye) / np.sqrt(np.maximum(2 + 2 * between, 1e-6)), 0, 1)
        gloss = material.gloss * halfway**material.sharpness * sunlit
        albedo = material.read_albedo(hit.u_m, hit.v_m, footprint_m)
        diffuse = (towards_sun * sunlit)[..., None] + np.array(self.sun.ambient, np.float32)
        return (albedo * diffuse + gloss[..., None]).astype(np.float32)

    def _sunlit(self, camera: Camera, T_cam_scene: Array) -> Component:
        """Return the picture (height, width) of what the sun reaches, 1, and of hard shadows, 0."""
        winner = np.full((camera.height, camera.width), -1, np.int16)
        depth = np.zeros((camera.height, camera.width), np.float32)
        for index, sight in self._trace(camera, T_cam_scene, np.zeros(2)):
            np.copyto(winner[sight.window], index, where=sight.won)
            np.copyto(depth[sight.window], sight.hit.depth, where=sight.won)
        sun_scene = T_cam_scene[:3, :3].T @ self.sun.direction_cam
        light, rays = np.ones_like(depth), pixel_rays(camera)[0]
        for index in np.unique(winner[winner >= 0]).tolist():
            body = self.bodies[index]
            casters = [c for c in self.bodies if c.casts_shadow and c is not body and _may_shade(c, body, sun_scene)]
            where = np.nonzero(winner == index)
            far = depth[where]
            point = (rays[(*where, 0)].astype(np.float32) * far, rays[(*where, 1)].astype(np.float32) * far, far)
            free = np.ones(far.shape, bool)
            for caster in casters:
                T_caster_cam = inverse(T_cam_scene @ caster.T_scene_body)
                turned = _turn(T_caster_cam[:3, :3], point)
                start = tuple(p + float(t) for p, t in zip(turned, T_caster_cam[:3, 3], strict=True))
                with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
                    met = caster.shape.hit(start, _floats(T_caster_cam[:3, :3] @ self.sun.direction_cam))
                free &= ~(met.seen & (met.depth > SHADOW_GAP_M))
            light[where] = free
        # A body that covers only part of a pixel borrows the light of its neighbour; inside it, shadows end softly.
        around = np.ones((3, 3), np.uint8)
        np.copyto(light, cv2.erode(light, around), where=winner < 0)
        alone = cv2.erode(winner, around) == cv2.dilate(winner, around)
        np.copyto(light, cv2.GaussianBlur(light, (0, 0), PENUMBRA_PX), where=alone)
        return light


def exposure_order(samples: int) -> tuple[int, ...]:
    """Return which instant of the exposure each ray of a pixel's lattice sees.

    Chosen so that time goes with neither x nor y: motion then blurs an edge without moving it.
    """
    if samples > EXHAUSTIVE_SAMPLES:
        raise ValueError(f"at most {EXHAUSTIVE_SAMPLES} samples a pixel can share an exposure, got {samples}")
    offsets = ray_lattice(samples)
    time = np.arange(samples) - (samples - 1) / 2
    return min(
        itertools.permutations(range(samples)), key=lambda order: float(np.abs(time[list(order)] @ offsets).sum())
    )


def _may_shade(caster: Body, body: Body, sun_scene: Array) -> bool:
    """Tell whether the shadow of a body's enclosing sphere can meet that of another."""
    (centre, reach), (other, other_reach) = _sphere(caster), _sphere(body)
    ahead = centre - other
    behind = float(ahead @ sun_scene)
    aside = float(np.linalg.norm(ahead - behind * sun_scene))
    return aside < reach + other_reach and behind > -(reach + other_reach)


def _sphere(body: Body) -> tuple[Array, float]:
    corners = transform(body.T_scene_body, body.shape.points())
    centre = corners.mean(axis=0)
    return centre, float(np.linalg.norm(corners - centre, axis=1).max())


def _only(hit: Hit, won: Mask) -> Hit:
    """Return a hit with harmless numbers where rays miss."""
    depth, u, v = (np.where(won, part, np.float32(0)) for part in (hit.depth, hit.u_m, hit.v_m))
    x, y, z = (np.where(won, part, np.float32(other)) for part, other in zip(hit.normal, (0, 0, 1), strict=True))
    return Hit(depth, u, v, (x, y, z), won)


def _turn(R_a_b: Array, v: Line) -> Line:
    """Return components in a of a vector field in b, in the precision of the field."""
    x, y, z = (float(r[0]) * v[0] + float(r[1]) * v[1] + float(r[2]) * v[2] for r in R_a_b)
    return x, y, z


def _dot(a: Line, b: Line) -> Component:
    return np.asarray(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


def _floats(v: Array) -> tuple[float, float, float]:
    return float(v[0]), float(v[1]), float(v[2])
