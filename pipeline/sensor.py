"""The camera behind the lens: from the light of a scene to an 8-bit picture, with blur, glow, vignetting and noise."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from astratag.camera import Camera
from pipeline.render import srgb_from_linear
from pipeline.texture import Image

ADC_BITS = 12
GLOW_SIGMA_PX = 14.0


@dataclass(frozen=True)
class Sensor:
    """A small colour sensor and its lens.  Light 1 fills the wells.

    ``blur_px`` is the sigma of the point spread in focus; a lens opening of ``aperture_m`` focused at ``focus_m`` adds
    to it elsewhere.  ``glow`` is the share of light that the lens scatters widely, ``vignetting`` what is lost in
    the corners.  Noise is shot noise of ``full_well_e`` electrons and ``read_noise_e`` a pixel and colour.
    """

    blur_px: float = 0.7
    aperture_m: float = 1.2e-4
    focus_m: float = 0.35
    glow: float = 0.015
    vignetting: float = 0.18
    full_well_e: float = 12000.0
    read_noise_e: float = 4.0

    def blur_at_px(self, range_m: float, focal_px: float) -> float:
        """Return the sigma of the point spread at a range: in focus, and half the radius of the defocused disc."""
        radius_px = focal_px * self.aperture_m * abs(1 / range_m - 1 / self.focus_m) / 2
        return float(np.hypot(self.blur_px, radius_px / 2))

    def expose(self, light: Image, camera: Camera, *, range_m: float, rng: np.random.Generator) -> NDArray[np.uint8]:
        """Return the picture (height, width, 3), sRGB, of linear light with all at one range.

        A lens blurs what pixels then average: light (finer height, finer width, 3) has ``finer`` times the picture's
        resolution, a whole number.  At 1, edges along the pixel grid are up to 0.04 px off (see ``render.develop``).

        Raises ValueError when the light is not of such a size.
        """
        finer, size = light.shape[1] // camera.width, (camera.width, camera.height)
        if finer < 1 or light.shape != (finer * camera.height, finer * camera.width, 3):
            raise ValueError(f"light must be a whole number of times the picture's size {size}, got {light.shape}")
        sharp = cv2.GaussianBlur(light, (0, 0), finer * self.blur_at_px(range_m, camera.K[0, 0]))
        sharp = cv2.resize(sharp, size, interpolation=cv2.INTER_AREA)
        quarter = (camera.width // 4, camera.height // 4)
        small = cv2.resize(light, quarter, interpolation=cv2.INTER_AREA)
        small = cv2.GaussianBlur(np.minimum(small, 4.0), (0, 0), GLOW_SIGMA_PX / 4)
        glow = cv2.resize(small, size, interpolation=cv2.INTER_LINEAR)
        light = (sharp * (1 - self.glow) + glow * self.glow) * _vignette(camera, self.vignetting)
        electrons = np.clip(light, 0, 1) * np.float32(self.full_well_e)
        noise = rng.standard_normal(electrons.shape, dtype=np.float32)
        electrons += noise * np.sqrt(electrons + np.float32(self.read_noise_e**2))
        counts = np.clip(electrons * ((2**ADC_BITS - 1) / self.full_well_e) + 0.5, 0, 2**ADC_BITS - 1)
        return _encoding()[counts.astype(np.uint16)]


@lru_cache(maxsize=1)
def _encoding() -> NDArray[np.uint8]:
    """Return the sRGB code of every count of the converter."""
    counts = np.arange(2**ADC_BITS, dtype=np.float32) / (2**ADC_BITS - 1)
    return np.round(srgb_from_linear(counts) * 255).astype(np.uint8)


@lru_cache(maxsize=4)
def _vignette(camera: Camera, loss: float) -> Image:
    """Return the share of light (height, width, 1) that the lens lets through."""
    x = np.arange(camera.width) - (camera.width - 1) / 2
    y = np.arange(camera.height) - (camera.height - 1) / 2
    squared = (x[None, :] ** 2 + y[:, None] ** 2) / (x[0] ** 2 + y[0] ** 2)
    return (1 - loss * squared).astype(np.float32)[..., None]
