"""Sampling: light between pixels is that of the lit image, and ends where the image does."""

from __future__ import annotations

import cv2
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from astratag.edges import inverse_transfer
from astratag.sampling import AS_GRAY, between, bilinear, fading, light_between

GRAY = np.random.default_rng(0).integers(0, 256, (7, 9), dtype=np.uint8)
OF_GRAY = inverse_transfer("srgb")
PLACES = st.floats(-1e3, 1e3) | st.floats(-2.0, 11.0)


@given(PLACES, PLACES)
def test_light_is_that_of_the_lit_image(x: float, y: float) -> None:
    lit = cv2.LUT(GRAY, OF_GRAY)
    assert light_between(GRAY, OF_GRAY.astype(float), x, y) == between(lit, x, y)
    assert light_between(GRAY, AS_GRAY, x, y) == between(GRAY, x, y)


@given(PLACES, PLACES)
def test_an_image_fades_within_a_pixel(x: float, y: float) -> None:
    height, width = GRAY.shape
    beyond_px = max(-x, x - (width - 1), -y, y - (height - 1))
    assert bilinear(GRAY, x, y) == between(GRAY, x, y) * fading(x, y, height, width)
    if beyond_px <= 0:
        assert fading(x, y, height, width) == 1
    if beyond_px >= 1:
        assert bilinear(GRAY, x, y) == 0


def test_no_place_is_the_first_pixel() -> None:
    """A warp gone astray must not read beyond the image."""
    assert light_between(GRAY, AS_GRAY, np.nan, np.inf) == GRAY[-1, 0]
