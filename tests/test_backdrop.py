"""What is behind a print is seen past its margin, however thin that looks."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import ndtr

from astratag.backdrop import backdrop
from astratag.edges import POINTS_PER_EDGE

INK, PAPER, BLUR_PX, EDGE_PX = 20.0, 220.0, 1.2, 30.3
LINEAR = np.arange(256.0)


def seen(behind: float, margin_px: float, edge: int = 0) -> np.ndarray:
    """Return what is told of a vertical edge, ink to its left, whose margin ends in a picture of one brightness."""
    x = np.arange(64.0)
    row = (
        INK
        + (PAPER - INK) * ndtr((x - EDGE_PX) / BLUR_PX)
        + (behind - PAPER) * ndtr((x - EDGE_PX - margin_px) / BLUR_PX)
    )
    gray = np.round(np.tile(row, (48, 1))).astype(np.uint8)
    rows = np.linspace(5.0, 43.0, POINTS_PER_EDGE)
    predicted = np.stack([np.full((1, POINTS_PER_EDGE), EDGE_PX), rows[None]])
    normal = np.stack([np.ones((1, POINTS_PER_EDGE)), np.zeros((1, POINTS_PER_EDGE))])
    margins = np.full((1, POINTS_PER_EDGE), margin_px)
    return backdrop(gray, LINEAR, np.array([edge]), predicted, normal, margins, BLUR_PX, np.array([BLUR_PX]))


@pytest.mark.parametrize("margin_px", [1.8, 2.5, 4.0])
@pytest.mark.parametrize("behind", [5.0, 80.0, 220.0, 250.0])
def test_the_backdrop_is_as_bright_as_it_is(behind: float, margin_px: float) -> None:
    np.testing.assert_allclose(seen(behind, margin_px), (behind - PAPER) / (PAPER - INK), atol=0.1)


def test_nothing_shows_through_wide_margins_or_inside() -> None:
    assert not seen(5.0, margin_px=6.5).any()
    assert not seen(5.0, margin_px=2.5, edge=4).any()
