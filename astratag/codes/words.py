"""Cells as regions and as 48-bit words: their order under turns, packing, and GF(2)-linear maps by table."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from astratag.geometry import CELLS, REGIONS, TURN_CLOCKWISE

Words = NDArray[np.uint64]
CELLS_PER_REGION = CELLS // REGIONS


def _region_cells() -> NDArray[np.int64]:
    """Return the cells (8, 6) of each region, cell j of one the image of cell j of the one before under the turn."""
    rows = []
    for first in (0, CELLS // 2):
        row = np.arange(first, first + CELLS_PER_REGION)
        for _ in range(REGIONS // 2):
            rows.append(row)
            row = TURN_CLOCKWISE[row]
    return np.array(rows)


REGION_CELLS = _region_cells()
"""Cells (8, 6) of the regions TL, TR, BR, BL, L, T, R, B in the order in which they carry a symbol's bits."""


def checked_bits(cells: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return cells (..., 48).  Raises ValueError for another number of them, or what are not zeros and ones."""
    bits = np.asarray(cells)
    if bits.shape[-1:] != (CELLS,) or bits.dtype.kind not in "biu" or (bits > 1).any() or (bits < 0).any():
        raise ValueError(f"cells must be {CELLS} zeros and ones, got {bits.dtype} of shape {bits.shape}")
    return bits


def pack(cells: NDArray[np.uint8]) -> Words:
    """Return cells (..., 48), 0 or 1, as words (...): bit c of a word is cell c."""
    octets = np.packbits(cells, axis=-1, bitorder="little")
    padded = np.concatenate([octets, np.zeros((*octets.shape[:-1], 2), np.uint8)], axis=-1)
    return padded.view("<u8")[..., 0].astype(np.uint64)


def unpack(words: ArrayLike) -> NDArray[np.uint8]:
    """Return words (...) as cells (..., 48)."""
    octets = np.asarray(words, dtype="<u8")[..., None].view(np.uint8)
    return np.unpackbits(octets, axis=-1, count=CELLS, bitorder="little")


def span(rows: Sequence[int]) -> Words:
    """Return all sums (2^N,) of N words, place m holding the sum of the rows that are the ones of m."""
    sums = np.zeros(1, dtype=np.uint64)
    for row in rows:
        sums = np.concatenate([sums, sums ^ np.uint64(row)])
    return sums


class LinearMap:
    """The linear map that takes message m to the sum of the rows that are the ones of m, by two small tables."""

    def __init__(self, rows: Sequence[int]) -> None:
        self.half_bits = len(rows) // 2
        self.low, self.high = span(rows[: self.half_bits]), span(rows[self.half_bits :])

    def __call__(self, messages: ArrayLike) -> Words:
        """Return the images of messages, integers of any shape."""
        messages = np.asarray(messages, dtype=np.int64)
        return self.low[messages & (len(self.low) - 1)] ^ self.high[messages >> self.half_bits]

    def least_weight(self, floor: int = 0) -> int:
        """Return the fewest ones in the image of any message but zero, all of them counted.

        Stops early with a lower weight than ``floor`` once one is seen.
        """
        least = int(np.bitwise_count(self.low[1:]).min())
        for word in self.high[1:]:
            if least < floor:
                break
            least = min(least, int(np.bitwise_count(self.low ^ word).min()))
        return least
