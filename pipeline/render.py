"""The simulated camera: rays cast through a calibrated lens at printed markers, in linear light.

Everything is anti-aliased by area before it is encoded, so an edge in the linear picture stands where
``Camera.project`` puts it (tested to 0.03 px at worst, 0.005 px on average).  Pixels: (0, 0) is the
centre of the top-left pixel.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from astratag.camera import Camera
from astratag.geometry import CELLS
from astratag.surface import Cylinder, Flat, Surface
from astratag.transforms import inverse, transform
from pipeline.texture import Image, Texture, print_texture

Array = NDArray[np.float64]
Encoding = Literal["srgb", "linear"]

BLACK_ALBEDO = 0.04
WHITE_ALBEDO = 0.85
FINER = 2
"""Light is drawn at so many times the picture's resolution where a lens is to blur it before pixels average."""
NEAR_PLANE_M = 1e-4
"""Points nearer than this before the camera have no place in its picture."""


@lru_cache(maxsize=4)
def pixel_rays(camera: Camera) -> tuple[Array, Array, Array]:
    """Return x/z and y/z of the ray through each pixel's centre (H, W, 2), and their change a pixel right and down."""
    columns, rows = np.meshgrid(np.arange(camera.width, dtype=float), np.arange(camera.height, dtype=float))
    rays = camera.undistort(np.stack([columns, rows], axis=-1).reshape(-1, 2)).reshape(camera.height, camera.width, 2)
    right, down = (np.asarray(np.gradient(rays, axis=axis)) for axis in (1, 0))
    return rays, right, down


def ray_lattice(samples: int) -> Array:
    """Return where the rays of a pixel go (samples, 2), pixels from its centre.

    A rank-1 lattice near the golden ratio: every row and every column of the pixel is sampled at ``samples`` different
    places, so that an edge along the pixel grid is as exact as a slanted one; the mean is zero.
    """
    golden = (np.sqrt(5.0) - 1.0) / 2.0
    step = min((k for k in range(1, samples + 1) if math.gcd(k, samples) == 1), key=lambda k: abs(k - golden * samples))
    index = np.arange(samples)
    return (np.stack([index, index * step % samples], axis=-1) + 0.5) / samples - 0.5


def srgb_from_linear(light: Image) -> Image:
    """Return the sRGB code value (0 to 1) of linear light, which is cut off at 0 and 1."""
    light = np.clip(light, 0.0, 1.0)
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.power(light, 1 / 2.4) - 0.055).astype(np.float32)


def linear_from_srgb(code: Image) -> Image:
    """Return the linear light (0 to 1) of sRGB code values (0 to 1)."""
    return np.where(code <= 0.04045, code / 12.92, np.power((code + 0.055) / 1.055, 2.4)).astype(np.float32)


def render_marker(
    camera: Camera,
    T_cam_marker: Array,
    *,
    signature: NDArray[np.uint8],
    side_m: float,
    surface: Surface | None = None,
    blur_px: float = 0.8,
    noise_sigma: float = 2.0,
    background: float | NDArray[np.uint8] = 40.0,
    seed: int = 0,
    encoding: Encoding = "srgb",
    samples: int = 8,
) -> NDArray[np.uint8]:
    """Return a gray picture (height, width) of one evenly lit marker print, for tests and benchmarks.

    The print shows the 48 bits of ``signature`` in all its layers, black 0.04 and white 0.85 of full light, with its
    quiet margin, on ``surface`` (Flat by default).  ``blur_px`` is the sigma of the point spread, ``noise_sigma`` that
    of Gaussian noise in grey levels, ``background`` a grey level or picture (height, width) behind the print,
    ``samples`` the rays a pixel.  The same arguments give the same picture.

    Raises ValueError when a size or a shape is impossible.
    """
    fine = finer_camera(camera)
    light = cv2.resize(light_behind(camera, background, encoding), (fine.width, fine.height))
    few, surface = max(samples // FINER**2, 1), surface or Flat()
    light = lay_print(light, fine, T_cam_marker, signature=signature, side_m=side_m, surface=surface, samples=few)
    return develop(light, blur_px=blur_px, noise_sigma=noise_sigma, seed=seed, encoding=encoding, finer=FINER)


@lru_cache(maxsize=4)
def finer_camera(camera: Camera) -> Camera:
    """Return a camera for the same picture at ``FINER`` times its resolution."""
    return camera.scaled(FINER * camera.width, FINER * camera.height)


def light_behind(camera: Camera, background: float | NDArray[np.uint8], encoding: Encoding = "srgb") -> Image:
    """Return the linear light (height, width) of a grey level or picture (height, width)."""
    levels = np.broadcast_to(np.asarray(background, dtype=np.float32), (camera.height, camera.width)) / np.float32(255)
    return linear_from_srgb(levels) if encoding == "srgb" else levels


def develop(
    light: Image,
    *,
    blur_px: float = 0.8,
    noise_sigma: float = 2.0,
    seed: int = 0,
    encoding: Encoding = "srgb",
    finer: int = 1,
) -> NDArray[np.uint8]:
    """Return the gray picture a camera makes of linear light (height, width): blur, encoding, noise, rounding.

    A lens blurs what pixels then average.  Light that is so many times ``finer`` than the picture comes near to that;
    on the picture's own grid, edges along it are off by 0.04 px.
    """
    code = encoded(light, blur_px=blur_px, encoding=encoding, finer=finer)
    if noise_sigma > 0:
        code += np.float32(noise_sigma) * np.random.default_rng(seed).standard_normal(code.shape, dtype=np.float32)
    return np.clip(np.round(code), 0, 255).astype(np.uint8)


def encoded(light: Image, *, blur_px: float = 0.8, encoding: Encoding = "srgb", finer: int = 1) -> Image:
    """Return the same before noise and rounding, in grey levels."""
    if blur_px > 0:
        light = cv2.GaussianBlur(light, (0, 0), finer * blur_px, borderType=cv2.BORDER_REPLICATE)
    if finer > 1:
        light = cv2.resize(light, None, fx=1 / finer, fy=1 / finer, interpolation=cv2.INTER_AREA)
    return (srgb_from_linear(light) if encoding == "srgb" else np.clip(light, 0, 1)) * np.float32(255)


def lay_print(
    light: Image,
    camera: Camera,
    T_cam_marker: Array,
    *,
    signature: NDArray[np.uint8],
    side_m: float,
    surface: Surface,
    samples: int = 8,
) -> Image:
    """Return the linear picture ``light`` (height, width) with an evenly lit marker print over it, edges exact.

    Arguments as for ``render_marker``.  Raises ValueError when a size or a shape is impossible.
    """
    if np.shape(signature) != (CELLS,):
        raise ValueError(f"signature must be the {CELLS} bits of one marker, got shape {np.shape(signature)}")
    if not side_m > 0:
        raise ValueError(f"side_m must be a positive side in metres, got {side_m}")
    return lay_texture(light, camera, T_cam_marker, print_texture(signature, side_m), surface, samples)


def lay_texture(
    light: Image, camera: Camera, T_cam_print: Array, texture: Texture, surface: Surface, samples: int = 8
) -> Image:
    """Return the linear picture ``light`` (height, width) with any square print over it, evenly lit, edges exact.

    ``texture`` is 0 where there is ink and 1 where the print is white; ``samples`` the rays a pixel.
    """
    light = np.array(light, np.float32)
    half_m = texture.width_m / 2
    grid = np.linspace(-half_m, half_m, 33)
    enclosing = surface.points(np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2))
    window = window_of(camera, transform(T_cam_print, enclosing))
    if window is None:
        return light
    rays, right, down = (part[window] for part in pixel_rays(camera))
    behind = light[window].copy()
    total = np.zeros_like(behind)
    T_print_cam = inverse(T_cam_print)
    for dx, dy in ray_lattice(samples):
        x, y, stretch, seen = hit_print(surface, T_print_cam, rays + dx * right + dy * down)
        if not seen.any():
            total += behind
            continue
        footprint = float(np.median(stretch[seen])) / np.sqrt(camera.K[0, 0] * camera.K[1, 1] * samples)
        alpha = np.clip((half_m - np.abs(x)) / footprint + 0.5, 0, 1)
        alpha *= np.clip((half_m - np.abs(y)) / footprint + 0.5, 0, 1) * seen
        albedo = BLACK_ALBEDO + (WHITE_ALBEDO - BLACK_ALBEDO) * texture.read(x, y, footprint)
        total += (behind + alpha * (albedo - behind)).astype(np.float32)
    light[window] = total / np.float32(samples)
    return light


def hit_print(surface: Surface, T_marker_cam: Array, rays: Array) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
    """Return where rays (H, W, 2) meet a surface on its outside.

    Gives print coordinates x and y, the square root of the surface area a unit of solid ray area covers, and whether
    the ray meets the surface at all.
    """
    R, o = T_marker_cam[:3, :3], T_marker_cam[:3, 3]
    dx, dy, dz = (R[k, 0] * rays[..., 0] + R[k, 1] * rays[..., 1] + R[k, 2] for k in range(3))
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        if isinstance(surface, Flat):
            depth = -o[2] / dz
            x, y, facing = o[0] + depth * dx, o[1] + depth * dy, -dz
        else:
            depth, x, y, facing = _hit_cylinder(surface, o, dx, dy, dz)
        seen = (depth > 0) & (facing > 0) & np.isfinite(depth)
        stretch = np.where(seen, depth / np.sqrt(facing), 0.0)
    return np.where(seen, x, 0.0), np.where(seen, y, 0.0), stretch, seen


def _hit_cylinder(surface: Cylinder, o: Array, dx: Array, dy: Array, dz: Array) -> tuple[Array, Array, Array, Array]:
    """Return depth, print coordinates and the ray's fall against the normal; NaN where a ray passes by."""
    radius = surface.radius_m
    c, s = np.cos(surface.axis_rad), np.sin(surface.axis_rad)
    along_o, across_o, up_o = c * o[0] + s * o[1], c * o[1] - s * o[0], o[2] + radius
    along_d, across_d = c * dx + s * dy, c * dy - s * dx
    a = across_d**2 + dz**2
    b = across_o * across_d + up_o * dz
    depth = (-b - np.sqrt(b**2 - a * (across_o**2 + up_o**2 - radius**2))) / a
    across, up = across_o + depth * across_d, up_o + depth * dz
    along, around = along_o + depth * along_d, radius * np.arctan2(across, up)
    facing = -(across * across_d + up * dz) / radius
    return depth, c * along - s * around, s * along + c * around, facing


def window_of(camera: Camera, points_cam: Array) -> tuple[slice, slice] | None:
    """Return the rows and columns of pixels that enclose points (N, 3) in the camera frame.

    All of the picture when some of the points are beside or behind the camera; None when they are out of sight.
    """
    in_front = points_cam[:, 2] > NEAR_PLANE_M
    if not in_front.any():
        return None
    rows, columns = slice(0, camera.height), slice(0, camera.width)
    if in_front.all():
        spread = points_cam[:, :2] / points_cam[:, 2:]
        # Bounds of rays, not of projected points: far outside the picture the distortion polynomial folds back.
        low_x, high_x, low_y, high_y = _ray_bounds(camera)
        columns = _between(low_x, high_x, *np.sort(spread[:, 0])[[0, -1]])
        rows = _between(low_y, high_y, *np.sort(spread[:, 1])[[0, -1]])
    return (rows, columns) if rows.stop > rows.start and columns.stop > columns.start else None


@lru_cache(maxsize=4)
def _ray_bounds(camera: Camera) -> tuple[Array, Array, Array, Array]:
    """Return the least and the greatest x/z of each column, and y/z of each row."""
    x, y = np.moveaxis(pixel_rays(camera)[0], -1, 0)
    return x.min(axis=0), x.max(axis=0), y.min(axis=1), y.max(axis=1)


def _between(low: Array, high: Array, first: float, last: float) -> slice:
    """Return the lines of pixels between two values, with two lines to spare."""
    met = np.flatnonzero((high >= first) & (low <= last))
    return slice(max(met[0] - 2, 0), met[-1] + 3) if met.size else slice(0, 0)
