"""Bodies in sunlight before a dark sky, seen by the simulated camera.

Light is linear, RGB, 1 where the sensor saturates.  The sun is a direction, with one diffuse and one glossy
reflection and hard shadows.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from astratag.camera import Camera
from astratag.transforms import inverse, transform
from pipeline.bodies import Body, Component, Hit, Line, Mask
from pipeline.render import pixel_rays, ray_lattice, window_of
from pipeline.texture import Image

Array = NDArray[np.float64]
SHADOW_GAP_M = 1e-4
"""Nearer than this to the lit point nothing casts a shadow: a surface does not shade itself by rounding."""

PENUMBRA_PX = 0.7

EXHAUSTIVE_SAMPLES = 7
"""So many orders can all be tried."""


@dataclass(frozen=True, eq=False)
class Sight:
    """What the rays of a window of pixels see of one body: ``won`` where it is the nearest."""

    window: tuple[slice, slice]
    hit: Hit
    direction: Line
    won: Mask


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
        light, rays = np.ones_like(depth), pixel_rays(camera)[0]
        for index in np.unique(winner[winner >= 0]).tolist():
            where = np.nonzero(winner == index)
            far = depth[where]
            point = (rays[(*where, 0)].astype(np.float32) * far, rays[(*where, 1)].astype(np.float32) * far, far)
            light[where] = self._in_the_open(self.bodies[index], T_cam_scene, point)
        # A body that covers only part of a pixel borrows the light of its neighbour; inside it, shadows end softly.
        around = np.ones((3, 3), np.uint8)
        np.copyto(light, cv2.erode(light, around), where=winner < 0)
        alone = cv2.erode(winner, around) == cv2.dilate(winner, around)
        np.copyto(light, cv2.GaussianBlur(light, (0, 0), PENUMBRA_PX), where=alone)
        return light

    def _in_the_open(self, lit: Body, T_cam_scene: Array, point_cam: Line) -> Mask:
        """Tell which points on a body no other body shades."""
        low, high = (np.array([bound(component) for component in point_cam]) for bound in (np.min, np.max))
        around = _Sphere((low + high) / 2, float(np.linalg.norm(high - low)) / 2)
        free = np.ones(point_cam[2].shape, bool)
        for body in self.bodies:
            T_cam_body = T_cam_scene @ body.T_scene_body
            caster = _Sphere.around(transform(T_cam_body, body.shape.points()))
            if body is lit or not body.casts_shadow or not around.may_be_behind(caster, self.sun.direction_cam):
                continue
            T_body_cam = inverse(T_cam_body)
            turned = _turn(T_body_cam[:3, :3], point_cam)
            start = tuple(p + float(t) for p, t in zip(turned, T_body_cam[:3, 3], strict=True))
            with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
                met = body.shape.hit(start, _floats(T_body_cam[:3, :3] @ self.sun.direction_cam))
            free &= ~(met.seen & (met.depth > SHADOW_GAP_M))
        return free


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


@dataclass(frozen=True, eq=False)
class _Sphere:
    """Something that encloses points of the camera frame."""

    centre_cam: Array
    radius_m: float

    @classmethod
    def around(cls, points_cam: Array) -> _Sphere:
        centre = points_cam.mean(axis=0)
        return cls(centre, float(np.linalg.norm(points_cam - centre, axis=1).max()))

    def may_be_behind(self, caster: _Sphere, to_sun_cam: Array) -> bool:
        """Tell whether the shadow of a caster can meet this."""
        between = caster.centre_cam - self.centre_cam
        ahead = float(between @ to_sun_cam)
        aside = float(np.linalg.norm(between - ahead * to_sun_cam))
        reach = self.radius_m + caster.radius_m
        return aside < reach and ahead > -reach


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
