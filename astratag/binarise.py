"""Binarising: telling ink from paper by the mean around each pixel, in some blocks of an image only.

Compiled, because an enlarged image has millions of pixels of which few are worth it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from astratag.compiled import BOOL, GRAY, INT, array, compiled

Image = NDArray[np.uint8]


@compiled(GRAY, array(BOOL, 2), INT, INT, INT, BOOL)
def threshold_blocks(
    gray: Image, worth: NDArray[np.bool_], block_px: int, window_px: int, offset: int, holes: bool
) -> Image:
    """Return 255 where an image (H, W) is ``offset`` below the mean around it, or with ``holes`` above; else 0.

    As OpenCV's ``adaptiveThreshold``, in blocks of ``block_px`` that are ``worth`` it (R, C), and 0 elsewhere.
    """
    height, width = gray.shape
    shapes = np.zeros((height, width), dtype=np.uint8)
    reach, area = window_px // 2, window_px * window_px
    sums = np.zeros(width, dtype=np.int32)
    for row in range(worth.shape[0]):
        column = 0
        while column < worth.shape[1]:
            if not worth[row, column]:
                column += 1
                continue
            first = column
            while column < worth.shape[1] and worth[row, column]:
                column += 1
            left, right = first * block_px, min(column * block_px, width)
            top, bottom = row * block_px, min((row + 1) * block_px, height)
            low, high = max(left - reach, 0), min(right + reach, width)
            sums[:] = 0
            for y in range(top - reach, top + reach):
                for x in range(low, high):
                    sums[x] += np.int32(gray[min(max(y, 0), height - 1), x])
            for y in range(top, bottom):
                for x in range(low, high):
                    sums[x] += np.int32(gray[min(y + reach, height - 1), x])
                total = 0
                for x in range(left - reach, left + reach):
                    total += sums[min(max(x, 0), width - 1)]
                for x in range(left, right):
                    total += sums[min(x + reach, width - 1)]
                    mean = (2 * total + area) // (2 * area)
                    level = np.int64(gray[y, x])
                    if (level > mean + offset) if holes else (level <= mean - offset):
                        shapes[y, x] = 255
                    total -= sums[max(x - reach, 0)]
                for x in range(low, high):
                    sums[x] -= np.int32(gray[max(y - reach, 0), x])
    return shapes
