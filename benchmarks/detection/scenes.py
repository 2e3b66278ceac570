"""The scenes: one table of conditions, and how a draw of one becomes a picture of any marker's print.

A draw fixes camera, pose, surface, background, light and noise; only then is a print laid into it, so every marker
is photographed in the same scenes.  Lengths are in AstraTag's black square, ``SIDE_M``; its print is ``SHEET_M`` wide
with the quiet margin.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from astratag import Camera, Cylinder, Flat, Surface
from astratag.geometry import QUIET_MARGIN
from astratag.transforms import exp_so3, pose, transform
from pipeline.render import (
    BLACK_ALBEDO,
    FINER,
    WHITE_ALBEDO,
    develop,
    encoded,
    finer_camera,
    lay_texture,
    light_behind,
    linear_from_srgb,
)
from pipeline.texture import Image, Texture

Array = NDArray[np.float64]
LightChange = Callable[[Image, Array, np.random.Generator], Image]
"""Light of the scene, pixels (n, n, 2) of a regular grid on the sheet, and a generator: what happens to the light."""

SIDE_M = 0.1
SHEET_M = SIDE_M * (1 + 2 * QUIET_MARGIN)
FACING = np.diag([1.0, -1.0, -1.0])
BACKGROUNDS = 16
OFF_CENTRE = 0.05
"""How far the marker's centre is from the image's at most, as a fraction of its width and height."""
GRID = 65
SHADOW_LIGHT = 0.1
COVER_LIGHT = 0.15
DARKEST_CODE = 60
"""Grey level of ink where the contrast is set."""


@dataclass(frozen=True)
class Scene:
    """What a draw of a condition is drawn from."""

    width_px: int = 640
    height_px: int = 480
    focal_px: float = 500.0
    side_px: float = 100.0
    """How long AstraTag's black side would look, square-on."""
    tilt_deg: tuple[float, float] = (0.0, 30.0)
    roll_deg: tuple[float, float] = (0.0, 360.0)
    turn: Literal["any", "about axis", "along axis"] = "any"
    """What the marker is tilted about: any line in its plane, the cylinder's axis, or the line across it."""
    radius_sides: float = np.inf
    blur_px: float = 0.8
    noise_sigma: float = 2.0
    outside: float = 0.0
    """How much of the black square is beyond the image's right border, as a fraction of its width."""
    change: LightChange | None = None

    @property
    def camera(self) -> Camera:
        """Return the camera, its principal point in the middle."""
        return pinhole(self.width_px, self.height_px, self.focal_px)


@dataclass(frozen=True)
class Condition:
    """One quantity that is varied; ``asked`` holds the recall asked of AstraTag, in per cent, at some of its values."""

    name: str
    label: str
    values: tuple[float, ...]
    scene: Callable[[float], Scene]
    asked: Mapping[float, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Draw:
    """One scene drawn: all but the print."""

    scene: Scene
    camera: Camera
    T_cam_print: Array
    surface: Surface
    seed: int

    def photograph(self, texture: Texture, rays: int = 16) -> NDArray[np.uint8]:
        """Return the gray picture with a print in it, of so many rays a pixel."""
        light, blur_px, noise_sigma = self._light(texture, rays), self.scene.blur_px, self.scene.noise_sigma
        return develop(light, blur_px=blur_px, noise_sigma=noise_sigma, seed=self.seed, finer=FINER)

    def expected(self, texture: Texture, rays: int = 16) -> Image:
        """Return that picture before noise and rounding, in grey levels."""
        return encoded(self._light(texture, rays), blur_px=self.scene.blur_px, finer=FINER)

    def _light(self, texture: Texture, rays: int) -> Image:
        """Return the light of the scene at ``FINER`` times the picture's resolution."""
        background = textured(self.scene.width_px, self.scene.height_px, self.seed % BACKGROUNDS)
        fine = finer_camera(self.camera)
        behind = cv2.resize(light_behind(self.camera, background), (fine.width, fine.height))
        light = lay_texture(behind, fine, self.T_cam_print, texture, self.surface, rays // FINER**2)
        if self.scene.change is not None:
            grid = np.stack(np.meshgrid(*[np.linspace(-0.5, 0.5, GRID)] * 2), axis=-1) * SHEET_M
            light = self.scene.change(light, self._seen(fine, grid), np.random.default_rng([self.seed, 1]))
        return light

    def pixels(self, on_print: Array) -> Array:
        """Return where print points (..., 2), metres, x right and y up, are in the picture (..., 2)."""
        return self._seen(self.camera, on_print)

    def _seen(self, camera: Camera, on_print: Array) -> Array:
        """Return where print points (..., 2) are in a camera's picture (..., 2)."""
        in_camera = transform(self.T_cam_print, self.surface.points(on_print).reshape(-1, 3))
        return camera.project(in_camera).reshape(on_print.shape)


def draw(scene: Scene, seed: int) -> Draw:
    """Return one draw of a scene; the same seed gives the same draw."""
    rng = np.random.default_rng(seed)
    tilt_rad, roll_rad = np.radians(rng.uniform(*scene.tilt_deg)), np.radians(rng.uniform(*scene.roll_deg))
    azimuth_rad = rng.uniform(0, 2 * np.pi)
    axis_rad = rng.choice([0.0, np.pi / 2])
    if scene.turn != "any":
        azimuth_rad = axis_rad + rng.choice([0.0, np.pi]) + (np.pi / 2 if scene.turn == "along axis" else 0.0)
    surface = Cylinder(scene.radius_sides * SIDE_M, axis_rad) if np.isfinite(scene.radius_sides) else Flat()
    tilt = tilt_rad * np.array([np.cos(azimuth_rad), np.sin(azimuth_rad), 0.0])
    R_cam_print = FACING @ exp_so3([0.0, 0.0, roll_rad]) @ exp_so3(tilt)
    range_m = scene.focal_px * SIDE_M / scene.side_px
    aside_px = rng.uniform(-OFF_CENTRE, OFF_CENTRE, 2) * (scene.width_px, scene.height_px)
    if scene.outside:
        corners = transform(pose(R_cam_print, [0.0, 0.0, range_m]), surface.points(_square(SIDE_M)))
        across = np.sort((scene.camera.project(corners) - scene.camera.K[:2, 2])[:, 0])
        aside_px[0] = scene.width_px / 2 - across[0] - (1 - scene.outside) * np.ptp(across)
    t_cam_print = [*(aside_px / scene.focal_px * range_m), range_m]
    return Draw(scene, scene.camera, pose(R_cam_print, t_cam_print), surface, seed)


@lru_cache(maxsize=8)
def pinhole(width_px: int, height_px: int, focal_px: float) -> Camera:
    """Return a camera without distortion."""
    K = np.array([[focal_px, 0, (width_px - 1) / 2], [0, focal_px, (height_px - 1) / 2], [0, 0, 1]])
    return Camera(K, width=width_px, height=height_px)


@lru_cache(maxsize=3 * BACKGROUNDS)
def textured(width_px: int, height_px: int, seed: int) -> NDArray[np.uint8]:
    """Return a dark background with smooth shapes and sharp ones: something to search through."""
    rng = np.random.default_rng(seed)
    picture = cv2.GaussianBlur(rng.integers(0, 256, (height_px, width_px), dtype=np.uint8), (0, 0), 4.0)
    picture = cv2.normalize(picture, None, 10, 90, cv2.NORM_MINMAX)
    for _ in range(60):
        centre, size = rng.uniform(0, (width_px, height_px)), rng.uniform(5, 60, 2)
        box = cv2.boxPoints((centre.tolist(), size.tolist(), float(rng.uniform(0, 180))))
        cv2.fillPoly(picture, [box.astype(np.int32)], int(rng.integers(0, 200)))
    return picture


def _square(side: float) -> Array:
    return np.array([(-0.5, 0.5), (0.5, 0.5), (0.5, -0.5), (-0.5, -0.5)]) * side


def glare(share: float) -> LightChange:
    """Return a blob of light that adds more than half of full light over a share of the sheet."""

    def change(light: Image, sheet_px: Array, rng: np.random.Generator) -> Image:
        centre = sheet_px[tuple(rng.integers(GRID // 4, 3 * GRID // 4, 2))]
        outline = np.concatenate([sheet_px[0], sheet_px[:, -1], sheet_px[-1, ::-1], sheet_px[::-1, 0]])
        squared_radius = share * cv2.contourArea(outline.astype(np.float32)) / np.pi
        rows, columns = np.indices(light.shape, dtype=np.float32)
        squared = (columns - centre[0]) ** 2 + (rows - centre[1]) ** 2
        return light + 1.5 * np.exp(-np.log(3.0) * squared / squared_radius).astype(np.float32)

    return change


def shadow(share: float) -> LightChange:
    """Return a shadow with a straight, hard edge that takes nine tenths of the light off a share of the sheet."""

    def change(light: Image, sheet_px: Array, rng: np.random.Generator) -> Image:
        angle = rng.uniform(0, 2 * np.pi)
        along = np.array([np.cos(angle), np.sin(angle)])
        edge = np.quantile(sheet_px @ along, share)
        rows, columns = np.indices(light.shape, dtype=np.float32)
        lit = np.clip(columns * along[0] + rows * along[1] - edge + 0.5, 0, 1)
        return light * (SHADOW_LIGHT + (1 - SHADOW_LIGHT) * lit).astype(np.float32)

    return change


def covered(share: float) -> LightChange:
    """Return a grey strip over one side of the sheet that hides a share of the black square's width."""

    def change(light: Image, sheet_px: Array, rng: np.random.Generator) -> Image:
        lines = 1 + round((GRID - 1) * (QUIET_MARGIN + share) / (1 + 2 * QUIET_MARGIN))
        strip = np.rot90(sheet_px, int(rng.integers(4)))[:lines]
        outline = np.concatenate([strip[0], strip[-1, ::-1]])
        return cv2.fillPoly(light.copy(), [np.round(outline).astype(np.int32)], COVER_LIGHT)

    return change


def contrast(grey_levels: float) -> LightChange:
    """Return a dimming of the whole scene after which ink and white are so many grey levels apart."""

    def change(light: Image, sheet_px: Array, rng: np.random.Generator) -> Image:
        codes = np.array([DARKEST_CODE, DARKEST_CODE + grey_levels], np.float32) / np.float32(255)
        black, white = linear_from_srgb(codes)
        return black + (light - BLACK_ALBEDO) * (white - black) / (WHITE_ALBEDO - BLACK_ALBEDO)

    return change


TILTED = Scene(side_px=160)
GENTLE, TIGHT = replace(TILTED, radius_sides=1.5), replace(TILTED, radius_sides=0.77)
WEBCAM = Scene(width_px=320, height_px=240, focal_px=290.0)
ANGLES = (0, 20, 40, 50, 60, 70, 75, 80)
FAR_CM = (30, 50, 70, 90, 110, 130, 150, 200, 250)


def at_angle(scene: Scene, deg: float, turn: Literal["any", "about axis", "along axis"] = "any") -> Scene:
    """Return a scene at one tilt."""
    return replace(scene, tilt_deg=(deg, deg), turn=turn)


def at_range(scene: Scene, range_cm: float) -> Scene:
    """Return a scene at one range."""
    return replace(scene, side_px=scene.focal_px * SIDE_M / (range_cm / 100))


CONDITIONS = (
    Condition(
        "size",
        "black side, px (flat, tilt 0-60)",
        (12, 14, 16, 20, 24, 28, 32, 48, 80, 160),
        lambda v: Scene(side_px=v, tilt_deg=(0, 60)),
        {16: 50, 20: 90, 28: 99.5, 32: 99.5, 48: 99.5, 80: 99.5, 160: 99.5},
    ),
    Condition(
        "tilt",
        "tilt, degrees (flat, 160 px)",
        (0, 30, 45, 60, 70, 75, 80, 83),
        lambda v: at_angle(TILTED, v),
        {75: 99, 80: 98, 83: 80},
    ),
    Condition(
        "roll",
        "roll, degrees (flat, 100 px, tilt 50)",
        (0, 15, 30, 45, 60, 75),
        lambda v: replace(at_angle(Scene(), 50), roll_deg=(v, v)),
        dict.fromkeys((0, 15, 30, 45, 60, 75), 99.5),
    ),
    Condition(
        "turn",
        "turn about the cylinder's axis, degrees (radius 1.5 sides, 160 px)",
        ANGLES,
        lambda v: at_angle(GENTLE, v, "about axis"),
        {**dict.fromkeys(ANGLES[:6], 99), 75: 97, 80: 50},
    ),
    Condition(
        "lean",
        "tilt along the cylinder's axis, degrees (radius 1.5 sides, 160 px)",
        ANGLES,
        lambda v: at_angle(GENTLE, v, "along axis"),
        {**dict.fromkeys(ANGLES[:6], 99), 75: 97, 80: 50},
    ),
    Condition(
        "tight",
        "tilt, degrees (cylinder of radius 0.77 side, 160 px)",
        (0, 15, 30, 40, 50, 60),
        lambda v: at_angle(TIGHT, v),
        dict.fromkeys((0, 15, 30, 40, 50), 95),
    ),
    Condition(
        "curvature",
        "radius of the cylinder, sides (160 px, tilt 30)",
        (0.6, 0.77, 1.0, 1.25, 1.5, 2.0, 3.0, 5.0),
        lambda v: at_angle(replace(TILTED, radius_sides=v), 30),
    ),
    Condition(
        "blur",
        "blur, sigma in px (100 px)",
        (0.5, 1.5, 2.5, 3.5, 4.5, 6.0),
        lambda v: Scene(blur_px=v),
        {3.5: 98},
    ),
    Condition(
        "noise",
        "noise, sigma in grey levels (100 px)",
        (0, 5, 10, 20, 30, 40),
        lambda v: Scene(noise_sigma=v),
        {20: 98},
    ),
    Condition(
        "contrast",
        "contrast, grey levels (100 px)",
        (8, 10, 15, 25, 50, 100),
        lambda v: Scene(change=contrast(v)),
        {15: 98},
    ),
    Condition(
        "glare",
        "glare, share of the print (100 px)",
        (0.1, 0.2, 0.33, 0.5),
        lambda v: Scene(change=glare(v)),
        {0.33: 95},
    ),
    Condition(
        "shadow",
        "hard shadow, share of the print (100 px)",
        (0.1, 0.2, 0.33, 0.5),
        lambda v: Scene(change=shadow(v)),
        {0.33: 95},
    ),
    Condition(
        "cover",
        "covered from one side, share of the black width (160 px)",
        (0.02, 0.1, 0.2, 0.3, 0.4),
        lambda v: replace(TILTED, change=covered(v)),
        {0.1: 98, 0.2: 98, 0.3: 98},
    ),
    Condition(
        "cut",
        "outside the image, share of the black width (160 px)",
        (0.02, 0.1, 0.2, 0.25),
        lambda v: replace(TILTED, outside=v, roll_deg=(-15, 15)),
        dict.fromkeys((0.02, 0.1, 0.2, 0.25), 98),
    ),
    Condition(
        "lowres",
        "range, cm (flat, 320x240, f = 290 px)",
        (3, 5, 8, 10, 20, 30, 50, 75, 100, 125, 150),
        lambda v: at_range(WEBCAM, v),
        {**dict.fromkeys((3, 5, 8), 98), **dict.fromkeys((10, 20, 30, 50, 75, 100), 99)},
    ),
    Condition(
        "distance",
        "range, cm (cylinder of radius 1.5 sides, 640x480, f = 500 px)",
        FAR_CM,
        lambda v: at_range(replace(GENTLE, tilt_deg=(0, 30)), v),
    ),
)
