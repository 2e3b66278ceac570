"""A fast simulated camera: markers on panels before a dark sky, in grey, through a calibrated lens, by remapping.

Where ``pipeline.scene`` casts rays at bodies, this reads each panel's picture through an image pyramid: ten to thirty
times as fast, for closed loops and cameras at 15 Hz.  Edges stand where ``Camera.project`` puts them: pyramid and
interpolation blur them alike to both sides.  Pixels: (0, 0) is the centre of the top-left pixel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from astratag.camera import Camera
from astratag.dictionary import load_dictionary
from astratag.geometry import TEMPLATE_UNITS
from astratag.surface import Cylinder, Surface
from astratag.transforms import inverse, transform
from pipeline.mission import Mission, Section
from pipeline.render import (
    BLACK_ALBEDO,
    FINER,
    NEAR_PLANE_M,
    WHITE_ALBEDO,
    finer_camera,
    hit_print,
    ray_lattice,
    srgb_from_linear,
    window_of,
)
from pipeline.texture import PRINT_UNITS, Image, print_coverage

Array = NDArray[np.float64]

GRID_PX = 4
"""Rays are cast at every so many fine pixels and interpolated: 0.001 px off for a marker tilted by 20 degrees, 0.01 px
where a cylinder is turned by 60."""
ADC_MAX = 4095
NOISE_MARGIN_PX = 97
"""Noise is a stored field, read at a random place of so many."""
TEXELS_PER_UNIT = 2
PANEL_SHARE = 1.5
"""Side of the panel behind a marker, in prints."""


class LightSection(Section):
    """Sunlight, as an even brightness of the target and its slow change."""

    brightness: float = Field(default=0.9, gt=0, le=4)
    """Light of a white surface; 1 fills the sensor's wells."""
    panel_albedo: float = Field(default=0.3, ge=0, le=1)
    sky: float = Field(default=0.003, ge=0, le=1)


class SensorSection(Section):
    """The lens and the sensor behind it."""

    blur_px: float = Field(default=0.7, ge=0)
    full_well_e: float = Field(default=12000.0, gt=0)
    read_noise_e: float = Field(default=4.0, ge=0)
    vignetting: float = Field(default=0.18, ge=0, lt=1)
    rays: int = Field(default=FINER**2, ge=1, le=64)
    """Samples a pixel: light is drawn finer, with one or more a fine pixel."""
    jpeg_quality: int = Field(default=95, ge=1, le=100)


class SimCameraSection(Section):
    """The simulated camera."""

    width_px: int = Field(default=640, gt=0)
    height_px: int = Field(default=480, gt=0)
    focal_px: float = Field(default=1200.0, gt=0)
    distortion: tuple[float, float, float, float, float] = (-0.08, 0.05, 0.0, 0.0, 0.0)
    rate_hz: float = Field(default=10.0, gt=0)

    def camera(self) -> Camera:
        """Return the calibrated camera, its axis through the middle of the picture."""
        K = [
            [self.focal_px, 0, (self.width_px - 1) / 2],
            [0, self.focal_px, (self.height_px - 1) / 2],
            [0, 0, 1],
        ]
        return Camera(np.array(K, float), self.distortion, width=self.width_px, height=self.height_px)


@dataclass(frozen=True, eq=False)
class Panel:
    """A square picture on a surface with its centre at the origin, halved again and again; first row at largest y."""

    width_m: float
    levels: Sequence[NDArray[np.uint8]]

    @classmethod
    def around(cls, signature: NDArray[np.uint8], side_m: float, panel_albedo: float) -> Panel:
        """Return a marker's print in the middle of a panel; grey levels are albedos, 0 to 255."""
        ink = np.round(255 * BLACK_ALBEDO + (WHITE_ALBEDO - BLACK_ALBEDO) * np.arange(256)).astype(np.uint8)
        print_albedo = ink[print_coverage(signature, TEXELS_PER_UNIT)]
        size = print_albedo.shape[0]
        m = round(size * (PANEL_SHARE - 1) / 2)
        levels = [cv2.copyMakeBorder(print_albedo, m, m, m, m, cv2.BORDER_CONSTANT, value=round(255 * panel_albedo))]
        width_m = side_m * PRINT_UNITS / TEMPLATE_UNITS * levels[0].shape[0] / size
        while levels[-1].shape[0] >= 16:
            half = levels[-1].shape[0] // 2
            levels.append(cv2.resize(levels[-1], (half, half), interpolation=cv2.INTER_AREA))
        return cls(width_m, levels)

    def level(self, footprint_m: float) -> NDArray[np.uint8]:
        """Return the picture whose texels are as large as a pixel's footprint, or the next smaller ones."""
        texels = footprint_m * self.levels[0].shape[0] / self.width_m
        return self.levels[int(np.clip(np.floor(np.log2(max(texels, 1.0)) + 0.5), 0, len(self.levels) - 1))]


class SimCamera:
    """A calibrated camera that sees the markers of a mission, always with the same noise for the same seed."""

    def __init__(self, camera: Camera, mission: Mission, *, light: LightSection, sensor: SensorSection, seed: int):
        self._camera, self._light, self._sensor, self._seed = camera, light, sensor, seed
        self._fine = finer_camera(camera)
        dictionary = load_dictionary(mission.dictionary)
        self._bodies = [
            (
                Panel.around(dictionary.signature(marker.id), marker.side_m, light.panel_albedo),
                marker.surface.surface(),
                marker.T_target_marker.matrix(),
            )
            for marker in mission.markers
        ]
        self._grid_rays = _grid_rays(self._fine)
        self._vignette = _vignette(camera, sensor.vignetting)
        rng = np.random.default_rng(seed)
        shape = (camera.height + NOISE_MARGIN_PX, camera.width + NOISE_MARGIN_PX)
        self._noise = rng.standard_normal(shape, dtype=np.float32)
        counts = (np.arange(ADC_MAX + 1) / ADC_MAX).astype(np.float32)
        self._codes = np.round(srgb_from_linear(counts) * 255).astype(np.uint8)

    def picture(self, T_cam_target: Array, t_ns: int, *, glare: float = 0.0) -> NDArray[np.uint8]:
        """Return the grey picture (height, width), sRGB, taken at ``t_ns`` with the target at a pose.

        ``glare`` is light that falls on the sensor everywhere: at 1 there is nothing else to be seen.
        """
        light = np.full((self._fine.height, self._fine.width), self._light.sky, np.float32)
        nearest_last = sorted(self._bodies, key=lambda body: -float((T_cam_target @ body[2])[2, 3]))
        for panel, surface, T_target_marker in nearest_last:
            self._lay(light, panel, surface, T_cam_target @ T_target_marker)
        return self._expose(light + np.float32(glare), t_ns)

    def jpeg(self, T_cam_target: Array, t_ns: int, *, glare: float = 0.0) -> bytes:
        """Return ``picture`` as JPEG."""
        quality = [cv2.IMWRITE_JPEG_QUALITY, self._sensor.jpeg_quality]
        encoded, data = cv2.imencode(".jpg", self.picture(T_cam_target, t_ns, glare=glare), quality)
        assert encoded
        return data.tobytes()

    def _lay(self, light: Image, panel: Panel, surface: Surface, T_cam_panel: Array) -> None:
        """Put a panel over linear light (finer height, finer width)."""
        half_m, camera = panel.width_m / 2, self._fine
        if isinstance(surface, Cylinder):
            half_m = min(half_m, surface.radius_m)  # what is bent further away is hidden or edge-on
        grid = np.linspace(-half_m, half_m, 9)
        outline = transform(T_cam_panel, surface.points(np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2)))
        window = window_of(camera, outline)
        if window is None or float(T_cam_panel[2, 3]) < NEAR_PLANE_M:
            return
        rows, columns = (
            slice(s.start // GRID_PX, -(-min(s.stop, n) // GRID_PX)) for s, n in zip(window, light.shape, strict=True)
        )
        part = slice(rows.start * GRID_PX, rows.stop * GRID_PX), slice(columns.start * GRID_PX, columns.stop * GRID_PX)
        height, width = (s.stop - s.start for s in (rows, columns))
        behind = light[part]
        total = np.zeros_like(behind)
        rays, right, down = (r[rows.start : rows.stop + 2, columns.start : columns.stop + 2] for r in self._grid_rays)
        samples = ray_lattice(max(self._sensor.rays // FINER**2, 1))
        T_panel_cam = inverse(T_cam_panel)
        for dx, dy in samples:
            x, y, stretch, seen = hit_print(surface, T_panel_cam, rays + dx * right + dy * down)
            if not seen.any():
                total += behind
                continue
            footprint_m = float(np.median(stretch[seen])) / np.sqrt(camera.K[0, 0] * camera.K[1, 1] * len(samples))
            total += self._read(panel, np.where(seen, x, 1e3), y, footprint_m, (height, width), behind)
        light[part] = total / np.float32(len(samples))

    def _read(
        self, panel: Panel, x_m: Array, y_m: Array, footprint_m: float, cells: tuple[int, int], behind: Image
    ) -> Image:
        """Return the panel's light at points given on the grid of rays, and what is behind it beside the panel."""
        picture = panel.level(footprint_m)
        texels = picture.shape[0]
        at_x = (x_m / panel.width_m + 0.5) * texels - 0.5
        at_y = (0.5 - y_m / panel.width_m) * texels - 0.5
        rows, columns = behind.shape
        map_x, map_y = (_upsampled(at.astype(np.float32), cells)[:rows, :columns] for at in (at_x, at_y))
        read = cv2.remap(picture, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        inside = cv2.bitwise_and(*(cv2.inRange(at, -0.5, texels - 0.5) for at in (map_x, map_y)))
        seen = cv2.multiply(read, self._light.brightness / 255, dtype=cv2.CV_32F)
        return cv2.copyTo(seen, inside, dst=behind.copy())

    def _expose(self, light: Image, t_ns: int) -> NDArray[np.uint8]:
        sensor, camera = self._sensor, self._camera
        if sensor.blur_px > 0:
            light = cv2.GaussianBlur(light, (0, 0), FINER * sensor.blur_px, borderType=cv2.BORDER_REPLICATE)
        light = cv2.resize(light, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
        electrons = cv2.multiply(cv2.min(light, 1.0), self._vignette, scale=sensor.full_well_e)
        rng = np.random.default_rng((self._seed, t_ns))
        row, column = rng.integers(NOISE_MARGIN_PX, size=2)
        noise = self._noise[row : row + camera.height, column : column + camera.width]
        electrons += cv2.sqrt(electrons + np.float32(sensor.read_noise_e**2)) * noise
        return self._codes[np.clip(electrons * (ADC_MAX / sensor.full_well_e) + 0.5, 0, ADC_MAX).astype(np.uint16)]


def _grid_rays(camera: Camera) -> tuple[Array, Array, Array]:
    """Return x/z and y/z of rays (R, C, 2) on a grid around the picture, and their change a pixel right and down.

    Cell k stands for pixels 4 (k - 1) to 4 (k - 1) + 3: its ray goes through their middle.
    """
    rows, columns = (
        (np.arange(-(-n // GRID_PX) + 2) - 1.0) * GRID_PX + (GRID_PX - 1) / 2 for n in (camera.height, camera.width)
    )
    x, y = np.meshgrid(columns, rows)
    rays = camera.undistort(np.stack([x, y], axis=-1).reshape(-1, 2)).reshape(*x.shape, 2)
    right, down = (np.asarray(np.gradient(rays, axis=axis)) / GRID_PX for axis in (1, 0))
    return rays, right, down


def _upsampled(grid: Image, cells: tuple[int, int]) -> Image:
    """Return values on a grid with a cell to spare all around at every pixel of the cells (rows, columns)."""
    rows, columns = cells
    size = ((columns + 2) * GRID_PX, (rows + 2) * GRID_PX)
    return cv2.resize(grid, size, interpolation=cv2.INTER_LINEAR)[GRID_PX:-GRID_PX, GRID_PX:-GRID_PX]


def _vignette(camera: Camera, loss: float) -> Image:
    """Return the share of light (height, width) that the lens lets through."""
    x = (np.arange(camera.width) - (camera.width - 1) / 2) / (camera.width / 2)
    y = (np.arange(camera.height) - (camera.height - 1) / 2) / (camera.height / 2)
    return (1 - loss / 2 * (x[None, :] ** 2 + y[:, None] ** 2)).astype(np.float32)
