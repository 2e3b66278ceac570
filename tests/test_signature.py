"""Signatures: every code reads back from its artwork, in every orientation, and noise does not."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from astratag.artwork import artwork_image
from astratag.dictionary import load_dictionary
from astratag.signature import ALWAYS_BLACK, BLUR_UNITS, SAMPLES, Artwork, Codebook, cell_values, hamming
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


@pytest.mark.parametrize("rate", [1e-1, 1e-2, 1e-3])
def test_chance_patterns_are_accepted_no_more_often_than_asked_for(rate: float) -> None:
    codebook = Codebook(DICTIONARY, false_accept_rate=rate)
    cells = np.random.default_rng(0).normal(size=(20_000, 48))
    accepted = [reading.correlation >= codebook.least(1) for reading in codebook.read(cells)]
    assert np.mean(accepted) < rate


def test_a_thousand_identities_ask_for_more_than_twenty_and_a_lower_rate_for_more_still() -> None:
    few, many = Codebook(DICTIONARY), Codebook(load_dictionary("astratag48h16"))
    strict = Codebook(DICTIONARY, false_accept_rate=1e-9)
    assert few.least(1) == pytest.approx(0.72, abs=0.005)
    assert many.least(1) > few.least(1) + 0.04 and many.promising() > few.promising() + 0.04
    assert strict.least(1) > few.least(1) and few.least(6) > few.least(1) and few.least(1, 30) > few.least(1)


@pytest.mark.parametrize("tau", [3, 5, 10])
def test_hard_thresholds_of_the_paper_count_wrong_cells(tau: int) -> None:
    codebook = Codebook(DICTIONARY, tau_hamming=tau)
    for wrong in (tau, tau + 1):
        cells = DICTIONARY.signature(4).astype(float)
        cells[:wrong] = 1 - cells[:wrong]
        assert codebook.accepts(codebook.read_as(cells, 4, np.inf), warps=1) == (wrong <= tau)


@pytest.mark.parametrize("box_units", BLUR_UNITS[1:])
def test_a_known_identity_is_read_as_blurred_as_it_is(box_units: float) -> None:
    """A sharp code fits a blurred print badly; the code as blurred as the print fits it well, and counts less."""
    blurred = cv2.blur(sheet(8), (int(box_units),) * 2)
    cells = cell_values(blurred, SAMPLES[None] + MARGIN - 0.5)[0]
    best, sharp = CODEBOOK.read_as(cells, 8), CODEBOOK.read_as(cells, 8, np.inf)
    assert best.correlation > 0.97 > sharp.correlation + 0.05
    assert best.cells < sharp.cells == 48
    assert CODEBOOK.accepts(best, warps=6)


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
