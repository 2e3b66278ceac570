"""The sensor counts electrons: noise follows the mean, levels are sRGB, light is neither made nor lost."""

import numpy as np
import pytest

from astratag.camera import Camera
from pipeline.render import linear_from_srgb, srgb_from_linear
from pipeline.sensor import Sensor

CAMERA = Camera([[800, 0, 319.5], [0, 800, 239.5], [0, 0, 1]], width=640, height=480)
SEED = 5


def flat_field(level: float) -> np.ndarray:
    return np.full((480, 640, 3), level, np.float32)


@pytest.mark.parametrize("level", [0.1, 0.4, 0.7])
def test_noise_is_shot_and_read_noise(level: float) -> None:
    sensor = Sensor(vignetting=0.0, full_well_e=2000.0, read_noise_e=10.0)
    picture = sensor.expose(flat_field(level), CAMERA, range_m=0.35, rng=np.random.default_rng(SEED))
    light = linear_from_srgb(picture.astype(np.float32) / 255)
    expected = np.sqrt(level * 2000 + 10**2) / 2000
    assert light.mean() == pytest.approx(level, abs=2e-3)
    assert light.std() == pytest.approx(expected, rel=0.03)


def test_levels_are_srgb() -> None:
    sensor = Sensor(vignetting=0.0, full_well_e=1e9, read_noise_e=0.0)
    for level in (0.02, 0.18, 0.5, 1.0):
        picture = sensor.expose(flat_field(level), CAMERA, range_m=0.35, rng=np.random.default_rng(SEED))
        assert np.abs(picture - 255 * srgb_from_linear(np.float32(level))).max() <= 1.0


def test_glow_spreads_light_and_keeps_it() -> None:
    spot = flat_field(0.0)
    spot[220:260, 300:340] = 0.8
    sensor = Sensor(vignetting=0.0, full_well_e=1e9, read_noise_e=0.0, glow=0.1)
    picture = sensor.expose(spot, CAMERA, range_m=0.35, rng=np.random.default_rng(SEED))
    light = linear_from_srgb(picture.astype(np.float32) / 255)
    assert light[210, 320, 0] > 0.002
    assert light.sum() == pytest.approx(spot.sum(), rel=0.01)


def test_defocus_grows_away_from_the_focus() -> None:
    sensor = Sensor(blur_px=0.7, focus_m=0.35, aperture_m=1e-4)
    assert sensor.blur_at_px(0.35, 1000.0) == 0.7
    assert sensor.blur_at_px(0.06, 1000.0) > sensor.blur_at_px(0.2, 1000.0) > 0.7
    assert sensor.blur_at_px(1.5, 1000.0) > 0.7


def test_same_generator_same_picture() -> None:
    first, again, other = (
        Sensor().expose(flat_field(0.3), CAMERA, range_m=1.0, rng=np.random.default_rng(seed)) for seed in (1, 1, 2)
    )
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


def test_corners_are_darker() -> None:
    sensor = Sensor(vignetting=0.2, full_well_e=1e9, read_noise_e=0.0, glow=0.0)
    picture = sensor.expose(flat_field(0.5), CAMERA, range_m=0.35, rng=np.random.default_rng(SEED))
    light = linear_from_srgb(picture.astype(np.float32) / 255)
    assert light[240, 320, 0] == pytest.approx(0.5, abs=0.01)
    assert light[0, 0, 0] == pytest.approx(0.4, abs=0.01)
