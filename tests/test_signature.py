"""Signatures: every code reads back from its artwork, in every orientation, and noise does not."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from astratag.artwork import artwork_image
from astratag.dictionary import load_dictionary
from astratag.signature import ACCEPT, ALWAYS_BLACK, SAMPLES, Artwork, Codebook, cell_values, hamming
from astratag.warp import HomographyWarp

DICTIONARY = load_dictionary()
CODEBOOK = Codebook(DICTIONARY)
MARGIN = 98


def sheet(marker_id: int) -> np.ndarray:
    return np.pad(artwork_image(DICTIONARY.signature(marker_id)), MARGIN, constant_values=255)


@pytest.mark.parametrize("quarter_turns", range(4))
@pytest.mark.parametrize("marker_id", DICTIONARY.ids)
def test_every_artwork_reads_as_itself_in_every_orientation(marker_id: int, quarter_turns: int) -> None:
    turned = np.rot90(sheet(marker_id), -quarter_turns).copy()
    cells = cell_values(turned, SAMPLES[None] + MARGIN - 0.5)
    (reading,) = CODEBOOK.read(cells)
    assert (reading.marker_id, reading.quarter_turns, reading.hamming) == (marker_id, quarter_turns, 0)
    assert reading.correlation > 0.98


def test_points_called_always_black_are_black_in_every_artwork() -> None:
    at = np.floor(ALWAYS_BLACK).astype(int) + MARGIN
    for marker_id in DICTIONARY.ids:
        assert sheet(marker_id)[at[:, 1], at[:, 0]].max() == 0


def test_a_gradient_of_light_does_not_change_the_reading() -> None:
    """Black rising from 0 to 150 over the print, white with it: the smooth surface is removed."""
    art = sheet(7)
    ramp = np.linspace(0, 150, art.shape[1])[None, :]
    lit = np.clip(art * 0.4 + ramp, 0, 255).astype(np.uint8)
    (reading,) = CODEBOOK.read(cell_values(lit, SAMPLES[None] + MARGIN - 0.5))
    assert (reading.marker_id, reading.hamming) == (7, 0)


@pytest.mark.parametrize("seed", [0])
def test_chance_patterns_stay_below_acceptance(seed: int) -> None:
    cells = np.random.default_rng(seed).normal(size=(20_000, 48))
    assert max(reading.correlation for reading in CODEBOOK.read(cells)) < ACCEPT


def test_a_pattern_without_contrast_correlates_with_nothing() -> None:
    assert CODEBOOK.read(np.full((1, 48), 3.0))[0].correlation == 0.0


def test_hamming_counts_flipped_cells() -> None:
    code = DICTIONARY.signature(3)
    cells = code.astype(float)
    cells[[4, 9]] = 1 - cells[[4, 9]]
    assert hamming(cells[None], code[None]).tolist() == [2]


@pytest.mark.parametrize("layer", [0, 1, 2])
def test_surroundings_tell_which_layer_a_square_is(layer: int) -> None:
    """A square of any layer reads the same inside; only what is around it tells them apart."""
    from astratag.geometry import LAYERS, square

    big = cv2.resize(sheet(12), None, fx=1.5, fy=1.5, interpolation=cv2.INTER_CUBIC)
    corners = (square(*LAYERS[layer].black) + MARGIN) * 1.5 - 0.5
    scores = Artwork(DICTIONARY).layer_scores(big, HomographyWarp.from_points(square(0.0, 700.0), corners), 12)
    assert scores.argmax() == layer
