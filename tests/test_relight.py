"""Relit cells: codes read the same in shadow, in glare and under coverings, and what is hidden says so."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from astratag.artwork import artwork_image
from astratag.codes.words import REGION_CELLS
from astratag.dictionary import load_dictionary
from astratag.geometry import CELLS
from astratag.relight import RELIT_SAMPLES, relit_cells
from astratag.signature import CELL_SAMPLES, LEAST_SEEN, Codebook

DICTIONARY = load_dictionary()
CODEBOOK = Codebook(DICTIONARY)
MARGIN = 98
INK, PAPER = 10.0, 230.0
"""Linear light of 255."""
SAMPLES_PX = RELIT_SAMPLES[None] + MARGIN - 0.5
CENTRES = CELL_SAMPLES.mean(axis=1)


def sheet(marker_id: int) -> np.ndarray:
    """Return a print's light, evenly lit: a unit to the pixel."""
    art = np.pad(artwork_image(DICTIONARY.signature(marker_id)), MARGIN, constant_values=255)
    return (INK + (PAPER - INK) * art / 255.0).astype(np.float32)


def read(light: np.ndarray):
    cells, seen = relit_cells(light, SAMPLES_PX)
    return CODEBOOK.read_seen(cells, seen)[0], seen[0]


@pytest.mark.parametrize("marker_id", DICTIONARY.ids)
def test_every_artwork_reads_without_a_wrong_cell(marker_id: int) -> None:
    reading, seen = read(sheet(marker_id))
    assert (reading.marker_id, reading.quarter_turns, reading.hamming, reading.cells) == (marker_id, 0, 0, CELLS)
    assert reading.correlation > 0.99 and seen.all()


@settings(max_examples=20)
@given(st.floats(0.02, 1.1))
def test_cells_do_not_change_with_exposure(exposure: float) -> None:
    """Light times a constant is the same picture: but for ink near the noise, which tells less."""
    dim, bright = (relit_cells(sheet(5) * np.float32(e), SAMPLES_PX)[0] for e in (exposure, 1.0))
    np.testing.assert_allclose(dim, bright, atol=0.1)


@pytest.mark.parametrize("angle_rad", np.linspace(0.1, 6.2, 7))
@pytest.mark.parametrize("share", [0.33, 0.5, 0.7])
def test_a_hard_shadow_makes_no_cell_wrong(angle_rad: float, share: float) -> None:
    """A straight edge across the print beyond which a tenth of the light is left."""
    light = sheet(7)
    rows, columns = np.indices(light.shape)
    along = columns * np.cos(angle_rad) + rows * np.sin(angle_rad)
    shadowed = np.where(along < np.quantile(along, share), 0.1, 1.0).astype(np.float32) * light
    reading, _ = read(shadowed)
    assert reading.marker_id == 7 and reading.hamming <= 2
    assert CODEBOOK.accepts(reading, warps=6)


@pytest.mark.parametrize("at", [(250, 300), (450, 600), (700, 450)])
def test_saturated_cells_count_as_hidden_and_the_others_read_right(at: tuple[int, int]) -> None:
    """Glare over a quarter of the print: 1.5 times full light at its middle, falling off like a bell."""
    light = sheet(12)
    rows, columns = np.indices(light.shape)
    squared = (columns - at[0]) ** 2 + (rows - at[1]) ** 2
    glared = np.clip(light + 1.5 * 255 * np.exp(-squared / 200.0**2), 0, 255).astype(np.float32)
    reading, seen = read(glared)
    dark = light[CENTRES[:, 1].astype(int) + MARGIN, CENTRES[:, 0].astype(int) + MARGIN] < 100
    drowned = np.hypot(*(CENTRES + MARGIN - at).T) < 100
    assert drowned.any() and not seen[drowned & dark].any()
    assert LEAST_SEEN < reading.cells < CELLS and reading.marker_id == 12 and reading.hamming <= 1
    assert CODEBOOK.accepts(reading, warps=6)


def test_what_a_strip_covers_is_hidden_and_the_others_read_right() -> None:
    """A grey strip over the left: the top left, left and bottom left regions are gone."""
    light = sheet(3)
    light[:, : MARGIN + 160] = 40.0
    reading, seen = read(light)
    left = REGION_CELLS[[0, 3, 4]].ravel()
    assert not seen[[c for c in left if CENTRES[c, 0] < 140]].any()
    assert (reading.marker_id, reading.quarter_turns, reading.hamming) == (3, 0, 0)
    assert CODEBOOK.accepts(reading, warps=6)


def test_an_even_patch_shows_no_cell() -> None:
    assert not relit_cells(np.full((896, 896), 90.0, np.float32), SAMPLES_PX)[1].any()
