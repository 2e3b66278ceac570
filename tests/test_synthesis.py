"""Synthesis and matching: derivatives against differences, sums against brute force, and markers of a dozen pixels."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from astratag import Camera, Cylinder, Detector, Flat, Surface, Tracker, load_dictionary
from astratag.edges import inverse_transfer
from astratag.geometry import QUIET_MARGIN, TEMPLATE_UNITS, square
from astratag.grid import look
from astratag.matching import HOPELESS, Match, acceptance_of_pixels, match, rough_matches
from astratag.synthesis import Expected, Synthesis, _nodes, _picture, _weighted, expected
from astratag.transforms import difference, exp_so3, perturb, pose
from astratag.warp import FittedWarp, HomographyWarp, PoseWarp
from pipeline.render import render_marker
from pipeline.texture import print_coverage

DICTIONARY = load_dictionary()
SYNTHESIS = Synthesis(DICTIONARY)
CAMERA = Camera([[500, 0, 159.5], [0, 500, 119.5], [0, 0, 1]], width=320, height=240)
FLAT = Flat()
FACING = np.diag([1.0, -1.0, -1.0])
SIDE_M = 0.1
ACCEPT = acceptance_of_pixels(4 * len(DICTIONARY))
BLUR_PX = 0.94
"""What a render of 0.8 px looks like when sampled between pixels."""


def tumbled(side_px: float, seed: int, tilt_deg: float = 40.0) -> np.ndarray:
    """Return a pose at which the black side looks ``side_px`` long square-on."""
    rng = np.random.default_rng(seed)
    azimuth, roll = rng.uniform(0, 2 * np.pi, 2)
    tilt = np.radians(tilt_deg) * np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    range_m = 500 * SIDE_M / side_px
    return pose(FACING @ exp_so3([0.0, 0.0, roll]) @ exp_so3(tilt), [*(rng.uniform(-0.1, 0.1, 2) * range_m), range_m])


def photograph(T_cam_marker: np.ndarray, surface: Surface = FLAT, marker_id: int = 7, **kwargs: float) -> np.ndarray:
    background = np.full((240, 320), 70, np.uint8)
    return render_marker(
        CAMERA,
        T_cam_marker,
        signature=DICTIONARY.signature(marker_id),
        side_m=SIDE_M,
        surface=surface,
        background=background,
        **{"blur_px": 0.8, "noise_sigma": 2.0, "seed": 1} | kwargs,
    )


def light_of(image: np.ndarray) -> np.ndarray:
    return cv2.LUT(image, inverse_transfer("srgb"))


def corners(T_cam_marker: np.ndarray, surface: Surface = FLAT) -> np.ndarray:
    return PoseWarp(CAMERA, SIDE_M, surface, T_cam_marker)(square(0.0, 700.0))


def matched(synthesis: Synthesis, image: np.ndarray, quad: np.ndarray) -> Match | None:
    """Return what a quad of an image is matched with, if anything."""
    light = light_of(image)
    rough = rough_matches(synthesis, light, quad[None], BLUR_PX)
    return match(synthesis, light, rough[0], BLUR_PX, ACCEPT) if rough else None


def looks(warp: FittedWarp, blur_px: float, softness: float | None = None) -> Expected:
    seen = look(warp, (240, 320))
    assert seen is not None
    soft = seen.softness(blur_px) if softness is None else softness
    return expected(seen, _picture(DICTIONARY.signature(7).tobytes(), soft), blur_px)


@pytest.mark.parametrize(("side_px", "tilt_deg"), [(14, 0.0), (20, 60.0), (60, 30.0), (120, 78.0)])
def test_what_is_expected_is_the_mean_of_the_artwork_under_the_blur(
    side_px: float, tilt_deg: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Few nodes on a soft picture give what thousands give on a sharp one, to some hundredths of the contrast."""
    warp = PoseWarp(CAMERA, SIDE_M, Flat(), tumbled(side_px, 3, tilt_deg))
    few = looks(warp, BLUR_PX)
    thousands = _weighted(_nodes(3000), np.full(3000, 1 / 3000))
    monkeypatch.setattr("astratag.synthesis._nodes_for", lambda *_: thousands)
    many = looks(warp, BLUR_PX, softness=0.0)
    assert np.sqrt(np.mean((few.mean - many.mean) ** 2)) < 0.005
    assert np.abs(few.beyond - many.beyond).max() < 0.01


@pytest.mark.parametrize("marker_id", [0, 3, 7])
def test_the_artwork_is_what_is_printed(marker_id: int) -> None:
    """As white in all, and nowhere shifted: texels on edges between cells are neither lost nor all the one side's."""
    code = load_dictionary().signature(marker_id)
    printed = print_coverage(code, texels_per_unit=2) / 255.0
    inside = slice(round(2 * QUIET_MARGIN * TEMPLATE_UNITS), round(2 * (1 + QUIET_MARGIN) * TEMPLATE_UNITS))
    printed = printed[inside, inside].reshape(round(TEMPLATE_UNITS), 2, round(TEMPLATE_UNITS), 2).mean(axis=(1, 3))
    whole = _picture(code.tobytes(), 0.0).brightness
    border = (len(whole) - len(printed)) // 2
    seen = whole[border:-border, border:-border]
    assert seen.mean() == pytest.approx(printed.mean(), abs=5e-4)
    along = np.arange(len(seen)) + 0.5
    for axis in (0, 1):
        centres = [along @ picture.mean(axis=axis) / picture.mean() / len(seen) for picture in (seen, printed)]
        assert centres[0] == pytest.approx(centres[1], abs=0.15)
    assert np.abs(cv2.blur(seen - printed, (15, 15))).max() < 0.06


def test_derivatives_are_differences() -> None:
    """By blur: of the mean.  By place: of the mean when the same points are seen from a print moved by a little."""
    warp = PoseWarp(CAMERA, SIDE_M, Flat(), tumbled(24, 5))
    seen = look(warp, (240, 320))
    assert seen is not None
    picture = _picture(DICTIONARY.signature(7).tobytes(), seen.softness(BLUR_PX))
    here = expected(seen, picture, BLUR_PX)
    wider, narrower = (expected(seen, picture, BLUR_PX * np.exp(h)).mean for h in (0.02, -0.02))
    assert np.corrcoef(here.by_blur, (wider - narrower) / 0.04)[0, 1] > 0.9
    for axis in range(2):
        step = np.zeros(2)
        step[axis] = 0.1
        ahead, behind = (
            expected(replace(seen, template=seen.template + sign * seen.to_template @ step), picture, BLUR_PX).mean
            for sign in (1, -1)
        )
        difference_px = (ahead - behind) / 0.2
        assert np.corrcoef(here.by_place[:, axis], difference_px)[0, 1] > 0.96
        assert np.linalg.norm(here.by_place[:, axis]) == pytest.approx(np.linalg.norm(difference_px), rel=0.1)


@pytest.mark.parametrize(("side_px", "error_px"), [(14, 0.2), (20, 0.08), (32, 0.05), (60, 0.04)])
def test_alignment_finds_corners_far_below_a_pixel_with_honest_covariance(side_px: float, error_px: float) -> None:
    """From half a pixel off or more, corners come to within a few hundredths, by as much as the covariance says."""
    squares, rng = [], np.random.default_rng(11)
    for seed in range(8):
        truth = corners(tumbled(side_px, seed))
        start = HomographyWarp.from_points(square(0.0, 700.0), truth + rng.normal(0, 0.025 * side_px, (4, 2)))
        aligned = SYNTHESIS.align(light_of(photograph(tumbled(side_px, seed), seed=seed)), start, 7, BLUR_PX)
        assert aligned is not None
        error = aligned.warp(square(0.0, 700.0)) - truth
        assert np.sqrt(np.mean(error**2)) < error_px
        squares.append(np.mean(error**2) / aligned.sigma_px(square(0.0, 700.0)) ** 2)
    assert 0.2 < np.mean(squares) < 2.5


@pytest.mark.parametrize("side_px", [20, 48])
def test_what_is_no_print_is_given_up_after_a_step(side_px: float) -> None:
    start = HomographyWarp.from_points(square(0.0, 700.0), corners(tumbled(side_px, 3)) + 0.5)
    noise = cv2.GaussianBlur(np.random.default_rng(3).uniform(0, 255, (240, 320)), (0, 0), 2.0).astype(np.uint8)
    for image, given_up in ((photograph(tumbled(side_px, 3)), False), (noise, True)):
        found = SYNTHESIS.align(light_of(image), start, 7, BLUR_PX, hopeless=HOPELESS)
        assert (found is None) == given_up


def test_alignment_works_on_any_warp_and_tells_the_blur() -> None:
    surface, T_cam_marker = Cylinder(0.1, 0.5), tumbled(60, 2, 30.0)
    image = photograph(T_cam_marker, surface, blur_px=2.0)
    start = PoseWarp(CAMERA, SIDE_M, surface, perturb(T_cam_marker, np.array([1e-3, -1e-3, 4e-3, 0.02, -0.02, 0.02])))
    aligned = SYNTHESIS.align(light_of(image), start, 7, 1.0, steps=12)
    assert aligned is not None
    assert aligned.blur_px == pytest.approx(np.hypot(2.0, 0.5), rel=0.1)
    assert np.abs(aligned.warp(square(0.0, 700.0)) - corners(T_cam_marker, surface)).max() < 0.2
    assert np.linalg.norm(difference(T_cam_marker, aligned.warp.T_cam_marker)[3:]) < 0.02


@pytest.mark.parametrize("marker_id", [0, 7, 19])
def test_sixteen_pixels_are_enough_to_tell_identity_and_orientation(marker_id: int) -> None:
    image = photograph(tumbled(16, 4), marker_id=marker_id)
    found = matched(SYNTHESIS, image, np.roll(corners(tumbled(16, 4)), 3, axis=0) + 0.3)
    assert found is not None
    assert (found.marker_id, found.layer) == (marker_id, 0)
    assert np.abs(found.alignment.warp(square(0.0, 700.0)) - corners(tumbled(16, 4))).max() < 0.4


def test_nothing_else_is_matched() -> None:
    """Squares of noise, a plain dark square, and a marker's code that is not in the dictionary are refused."""
    rng, quad = np.random.default_rng(3), square(100.0, 130.0)
    for cells in (8, 12, 16):
        for _ in range(15):
            image = np.full((240, 320), 200, np.uint8)
            noise = rng.integers(0, 2, (cells, cells)).astype(np.uint8) * 180 + 20
            image[100:130, 100:130] = cv2.resize(noise, (30, 30), interpolation=cv2.INTER_NEAREST)
            assert matched(SYNTHESIS, cv2.GaussianBlur(image, (0, 0), 0.8), quad - 0.5) is None
    others = Synthesis(DICTIONARY.restricted([0, 1, 2, 3]))
    assert matched(others, photograph(tumbled(24, 1)), corners(tumbled(24, 1))) is None


@pytest.mark.parametrize("side_px", [14, 20, 28])
def test_a_small_marker_is_found_and_followed(side_px: float) -> None:
    """The detector finds it without a hint; the tracker follows it as it moves, with the right pose."""
    surface, T_cam_marker = Flat(), tumbled(side_px, 6, 35.0)
    tracker = Tracker(Detector(side_m=SIDE_M, surface=surface))
    for frame in range(4):
        (seen,) = tracker.detect(photograph(T_cam_marker, seed=frame), CAMERA)
        assert seen.marker_id == 7
        assert seen.method == ("tracked" if frame else "planar")
        assert seen.T_cam_marker is not None and seen.covariance is not None
        error = difference(T_cam_marker, seen.T_cam_marker)
        assert error @ np.linalg.solve(seen.covariance, error) / 6 < 6
        T_cam_marker = perturb(T_cam_marker, np.array([1e-3, -1e-3, 5e-3, 5e-3, 5e-3, 1e-2]))
