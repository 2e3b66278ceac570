"""Pictures on surfaces, read area by area: any picture, and the print of a marker with exact edges."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from astratag.geometry import (
    DRAWN_OFFSET,
    LAYERS,
    QUIET_MARGIN,
    TEMPLATE_UNITS,
    Layer,
    cell_polygons,
    layer_points,
)

Array = NDArray[np.float64]
Image = NDArray[np.float32]

PRINT_UNITS = TEMPLATE_UNITS * (1 + 2 * QUIET_MARGIN)
TEXELS_PER_UNIT = 4
"""Texels of the print to a template unit: at most a pixel each while a unit spans less than 4 px."""


class Texture:
    """A picture in linear light on a surface, with halved copies of itself so that it can be read area by area.

    ``picture`` (rows, columns) or (rows, columns, 3), 0 to 1, covers ``width_m`` by its share in height, centred on
    (0, 0) of the surface, first row at the top (largest y).
    """

    def __init__(self, picture: NDArray[np.float32] | NDArray[np.uint8], width_m: float):
        self.width_m = width_m
        self._texels_per_m = picture.shape[1] / width_m
        self._levels = [picture]
        while min(self._levels[-1].shape[:2]) >= 8:
            rows, columns = self._levels[-1].shape[:2]
            self._levels.append(cv2.resize(self._levels[-1], (columns // 2, rows // 2), interpolation=cv2.INTER_AREA))

    def read(self, x_m: Array, y_m: Array, footprint_m: float) -> Image:
        """Return the picture at surface points (2-D arrays), averaged over about ``footprint_m`` each way.

        Averages are symmetric, so edges keep their place.  Outside the picture its border goes on.
        """
        level = int(min(np.ceil(np.log2(max(footprint_m * self._texels_per_m, 1.0))), len(self._levels) - 1))
        picture = self._levels[level]
        rows, columns = picture.shape[:2]
        full_rows, full_columns = self._levels[0].shape[:2]
        at_x = x_m * (self._texels_per_m * columns / full_columns) + (columns - 1) / 2
        at_y = (rows - 1) / 2 - y_m * (self._texels_per_m * rows / full_rows)
        at_x, at_y = at_x.astype(np.float32), at_y.astype(np.float32)
        read = cv2.remap(picture, at_x, at_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return read / np.float32(255) if picture.dtype == np.uint8 else read


def print_coverage(signature: NDArray[np.uint8], texels_per_unit: int = TEXELS_PER_UNIT) -> NDArray[np.uint8]:
    """Return how much of each texel of a print with its quiet margin is white, 0 to 255, upright.

    The print carries the 48 bits of ``signature`` in all three layers.  Texels are squares of 1 / ``texels_per_unit``
    template units; straight edges are exact to 1/255 of a texel.
    """
    margin = TEMPLATE_UNITS * QUIET_MARGIN
    size = round(PRINT_UNITS * texels_per_unit)
    centres = (np.arange(size) + 0.5) / texels_per_unit - margin
    white = np.ones((size, size), np.float32)
    for layer in LAYERS:
        _paint_square(white, centres, layer, texels_per_unit)
        cells = layer_points(cell_polygons() + DRAWN_OFFSET, layer)
        for corners, bit in zip(cells, signature, strict=True):
            if bit:
                _add_triangle(white, centres, corners, texels_per_unit)
    return np.round(white * 255).astype(np.uint8)


def _paint_square(white: Image, centres: Array, layer: Layer, texels_per_unit: int) -> None:
    """Lay a layer's white frame, its outer corners rounded, and the black square inside it."""
    near, far = layer.black if layer.frame is None else layer.frame
    part = slice(*np.searchsorted(centres, (near - 1, far + 1)))
    white, at = white[part, part], centres[part].astype(np.float32)
    if layer.frame is not None:
        radius = layer.frame_corner_radius
        beyond = np.abs(at - (near + far) / 2) - ((far - near) / 2 - radius)
        outside = np.hypot(np.maximum(beyond[:, None], 0), np.maximum(beyond[None, :], 0))
        inside = radius - outside - np.minimum(np.maximum(beyond[:, None], beyond[None, :]), 0)
        np.maximum(white, np.clip(inside * texels_per_unit + 0.5, 0, 1), out=white)
    near, far = layer.black
    along = np.clip(np.minimum(at - near, far - at) * texels_per_unit + 0.5, 0, 1)
    white *= 1 - along[:, None] * along[None, :]


def _add_triangle(white: Image, centres: Array, corners: Array, texels_per_unit: int) -> None:
    """Add a white triangle (3, 2): neighbours share an edge, so what they cover adds up to one."""
    low, high = np.searchsorted(centres, corners.min(axis=0) - 1), np.searchsorted(centres, corners.max(axis=0) + 1)
    x, y = centres[low[0] : high[0]], centres[low[1] : high[1]]
    edges = np.roll(corners, -1, axis=0) - corners
    turn = np.sign(edges[0, 0] * edges[1, 1] - edges[0, 1] * edges[1, 0])
    covered = np.ones((len(y), len(x)), np.float32)
    for (ax, ay), (ex, ey) in zip(corners, edges, strict=True):
        normal = turn * np.array([-ey, ex]) / np.hypot(ex, ey)
        inside = ((x - ax) * normal[0])[None, :] + ((y - ay) * normal[1])[:, None]
        widest = np.abs(normal).sum()
        covered *= np.clip(inside * texels_per_unit / widest + 0.5, 0, 1).astype(np.float32)
    patch = white[low[1] : high[1], low[0] : high[0]]
    np.minimum(patch + covered, 1.0, out=patch)


def print_texture(signature: NDArray[np.uint8], side_m: float) -> Texture:
    """Return ``print_coverage`` of a marker with black squares of ``side_m``, 0 for ink and 1 for white."""
    return _print_texture(np.ascontiguousarray(signature, np.uint8).tobytes(), side_m)


@lru_cache(maxsize=8)
def _print_texture(signature: bytes, side_m: float) -> Texture:
    coverage = print_coverage(np.frombuffer(signature, np.uint8))
    return Texture(coverage, side_m * PRINT_UNITS / TEMPLATE_UNITS)
