"""Compiled loops over pixels, against OpenCV's interpolation and NumPy's linear algebra."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from astratag.geometry import TEMPLATE_UNITS
from astratag.looks import AROUND, LOOKS, MEAN
from astratag.normal import factored, gram, inverse, left_over, solved
from astratag.sampling import sample
from astratag.steps import INTERPOLATED, LEAST_NOISE, contrast, least_squares

GREY_OF_OPENCV = 1e-3
"""What single precision makes of places, in grey values of an image that varies by hundreds a pixel."""


def some_image(shape: tuple[int, int] = (24, 32), seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, shape).astype(np.uint8)


@pytest.mark.parametrize("of_points", [np.float64, np.float32])
@pytest.mark.parametrize("of_image", [np.uint8, np.float32])
def test_samples_are_those_of_opencv_in_and_around_an_image(of_image: type, of_points: type) -> None:
    """Beyond the image there is 0, and within a pixel of it a mixture with that."""
    image = some_image().astype(of_image)
    points_px = np.random.default_rng(1).uniform((-3, -3), (35, 27), (40, 25, 2)).astype(of_points)
    theirs = cv2.remap(image.astype(np.float32), points_px.astype(np.float32), None, cv2.INTER_LINEAR)
    assert sample(image, points_px) == pytest.approx(theirs, abs=GREY_OF_OPENCV)


def test_pixels_are_sampled_as_they_are_and_places_that_are_none_as_nothing() -> None:
    image = some_image((5, 7))
    places = np.stack(np.meshgrid(np.arange(7.0), np.arange(5.0)), axis=-1)
    assert (sample(image, places) == image).all()
    nowhere = np.array([[np.nan, 2.0], [2.0, np.inf], [-np.inf, np.nan], [1e300, 1.0], [-1.0, 2.0], [2.0, 5.0]])
    assert (sample(image, nowhere) == 0).all()
    assert sample(image[:1, :1], np.array([[0.0, 0.0], [0.5, 0.5]])) == pytest.approx(image[0, 0] * np.array([1, 0.25]))


def test_views_of_images_are_sampled_like_copies() -> None:
    image, points_px = some_image(), np.random.default_rng(2).uniform(0, 12, (50, 2))
    part = image[4:20:1, 8:24]
    assert (sample(part, points_px) == sample(part.copy(), points_px)).all()


def test_what_is_left_over_is_what_least_squares_leaves() -> None:
    rng = np.random.default_rng(3)
    columns = rng.normal(size=(7, 200))
    columns[2] = columns[0] - 3 * columns[1]  # explains nothing new
    explained, others = columns[:4].T, columns[4:].T
    residual = others - explained @ np.linalg.lstsq(explained, others)[0]
    assert gram(columns) == pytest.approx(columns @ columns.T)
    assert left_over(gram(columns), 4) == pytest.approx(residual.T @ residual)


def test_factors_solve_and_invert_like_numpy() -> None:
    columns, right = np.random.default_rng(4).normal(size=(12, 40)), np.arange(12.0)
    normal = columns @ columns.T
    factor = factored(normal)
    assert factor == pytest.approx(np.linalg.cholesky(normal))
    assert solved(factor, right) == pytest.approx(np.linalg.solve(normal, right))
    assert inverse(factor) == pytest.approx(np.linalg.inv(normal))


def test_least_squares_are_those_of_numpy_where_nothing_is_held() -> None:
    rng = np.random.default_rng(5)
    columns = rng.normal(size=(6, 300)) * np.logspace(-3, 3, 6)[:, None]
    value = rng.normal(size=6) @ columns + rng.normal(size=300)
    x, covariance = least_squares(columns, value, np.full(2, np.inf), 200.0)
    theirs, energy = np.linalg.lstsq(columns.T, value)[:2]
    variance = INTERPOLATED * energy[0] / (200 - 6) + LEAST_NOISE**2
    assert x == pytest.approx(theirs, rel=1e-6)
    assert covariance / np.outer(*[np.sqrt(np.diag(covariance))] * 2) == pytest.approx(
        variance * np.linalg.inv(columns @ columns.T) / np.outer(*[np.sqrt(np.diag(covariance))] * 2), abs=1e-6
    )


def test_a_step_sigma_holds_an_unknown() -> None:
    rng = np.random.default_rng(6)
    columns = rng.normal(size=(3, 100))
    value = np.array([5.0, 2.0, 1.0]) @ columns
    held, free = (least_squares(columns, value, np.array([sigma]), 100.0)[0] for sigma in (1e-4, np.inf))
    assert free == pytest.approx([5.0, 2.0, 1.0]) and abs(held[0]) < 1e-2


def test_contrast_is_the_slope_that_numpy_finds_beside_a_plane_of_light() -> None:
    rng = np.random.default_rng(7)
    template, weight = rng.uniform(0, TEMPLATE_UNITS, (500, 2)), rng.uniform(0.2, 1.0, 500)
    looks = rng.uniform(0, 1, (LOOKS, 500))
    light = 40 + template @ (0.1, -0.05) + 90 * looks[MEAN] + 30 * looks[AROUND] + rng.normal(0, 3, 500)
    apart, correlation = contrast(template, weight, light, looks)
    A = np.column_stack([np.ones(500), template, looks[AROUND], looks[MEAN]]) * np.sqrt(weight)[:, None]
    slope = np.linalg.lstsq(A, light * np.sqrt(weight))[0][-1]
    assert apart == pytest.approx(slope) and 0.95 < correlation < 1.0
