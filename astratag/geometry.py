"""The Spidron template: where the black squares, white frames and 48 cells of a marker are.

Template units: 700 to the side of the printed black square, (0, 0) at its top-left corner, x right,
y down, edges of ink at these coordinates (a pixel i of the 700-pixel artwork covers [i, i + 1]).
The marker frame is metric: origin at the centre of the print, x right, y up, z out of the face.
Corners always come top left, top right, bottom right, bottom left of the upright artwork.

Source: R. K. Thakur et al., "Spacecraft Fiducial Marker for Autonomous Rendezvous, Proximity
Operations, and Docking", and the twenty artworks published with it, measured.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

TEMPLATE_UNITS = 700.0
CELLS = 48
REGIONS = 8
QUIET_MARGIN = 0.14
"""Light margin around the black square, as a fraction of its side, on the published mock-ups."""

DRAWN_OFFSET = 0.5
"""The published cells are polygons through pixel centres: half a unit right of and below the print's own edges."""

_THIRD = 200.0 / np.sqrt(3.0)
_LOW, _MID, _HIGH = (float(int(k * _THIRD)) for k in (1, 3, 5))  # 115, 346, 577: the paper's approximate centroid


@dataclass(frozen=True)
class Region:
    """One encoding triangle: the right angle ``a``, the other vertices ``b`` and ``c``, and the centroid.

    Its six cells are the medial triangles at b and c and the four around the centroid; ``order`` lists
    them as published: ``b`` and ``c`` the medial ones, ``ab`` and ``ac`` beside the right angle, ``mb`` and
    ``mc`` beside the middle of the hypotenuse.
    """

    name: str
    a: tuple[float, float]
    b: tuple[float, float]
    c: tuple[float, float]
    centroid: tuple[float, float]
    order: tuple[str, str, str, str, str, str]

    def cells(self) -> NDArray[np.float64]:
        """Return the six cells, (6, 3, 2) template units, in published order."""
        a, b, c, g = (np.array(p) for p in (self.a, self.b, self.c, self.centroid))
        ab, ac, bc = (a + b) / 2, (a + c) / 2, (b + c) / 2
        by_name = {
            "b": (b, ab, bc),
            "c": (c, ac, bc),
            "ab": (a, ab, g),
            "ac": (a, ac, g),
            "mb": (bc, ab, g),
            "mc": (bc, ac, g),
        }
        return np.array([by_name[name] for name in self.order])


SPIDRON = (
    Region("top left", (50, 50), (250, 50), (50, 250), (_LOW, _LOW), ("c", "ab", "ac", "mb", "b", "mc")),
    Region("top right", (650, 50), (450, 50), (650, 250), (_HIGH, _LOW), ("ac", "b", "mb", "ab", "mc", "c")),
    Region("bottom right", (650, 650), (650, 450), (450, 650), (_HIGH, _HIGH), ("b", "mc", "c", "mb", "ab", "ac")),
    Region("bottom left", (50, 650), (250, 650), (50, 450), (_LOW, _HIGH), ("mb", "b", "ab", "mc", "c", "ac")),
    Region("left", (50, 350), (150, 250), (150, 450), (_LOW, _MID), ("b", "mc", "c", "ab", "ac", "mb")),
    Region("top", (350, 50), (450, 150), (250, 150), (_MID, _LOW), ("mb", "b", "mc", "c", "ac", "ab")),
    Region("right", (650, 350), (550, 250), (550, 450), (_HIGH, _MID), ("ab", "b", "mb", "ac", "mc", "c")),
    Region("bottom", (350, 650), (450, 550), (250, 550), (_MID, _HIGH), ("ac", "b", "mb", "ab", "mc", "c")),
)


@dataclass(frozen=True)
class Layer:
    """One of the nested copies of the pattern, in template units of the whole print."""

    index: int
    black: tuple[float, float]
    """Near and far edge of the black square, the same in x and y."""
    frame: tuple[float, float] | None
    """Near and far outer edge of the white frame around it; None for the outermost, which the margin frames."""
    origin: float
    scale: float

    @property
    def frame_corner_radius(self) -> float:
        """Return the rounding of the frame's outer corners: half the frame's drawn width."""
        return 0.0 if self.frame is None else (self.black[0] - self.frame[0]) // 2


LAYERS = (
    Layer(0, black=(0.0, 700.0), frame=None, origin=0.0, scale=1.0),
    Layer(1, black=(201.0, 500.0), frame=(180.0, 521.0), origin=200.0, scale=300.0 / 700.0),
    Layer(2, black=(288.0, 412.0), frame=(277.0, 423.0), origin=287.0, scale=125.0 / 700.0),
)

TURN_CLOCKWISE = np.array(
    [7, 6, 9, 10, 11, 8, 17, 12, 15, 16, 13, 14, 19, 21, 22, 18, 20, 23, 5, 0, 2, 3, 4, 1]
    + [31, 32, 33, 35, 34, 30, 40, 41, 38, 37, 36, 39, 45, 43, 44, 42, 46, 47, 27, 26, 25, 28, 29, 24]
)
"""Where each cell goes when the print is turned clockwise by 90 degrees."""


def cell_polygons() -> NDArray[np.float64]:
    """Return the 48 cells of the outermost layer in published order, (48, 3, 2) template units."""
    return np.concatenate([region.cells() for region in SPIDRON])


def turn_clockwise(bits: NDArray[np.uint8], quarter_turns: int = 1) -> NDArray[np.uint8]:
    """Return what a code (..., 48) reads when its print is turned clockwise by quarter turns."""
    bits = bits.copy()
    for _ in range(quarter_turns % 4):
        turned = np.empty_like(bits)
        turned[..., TURN_CLOCKWISE] = bits
        bits = turned
    return bits


def square(near: float, far: float) -> NDArray[np.float64]:
    """Return the corners (4, 2) of an axis-aligned square in the marker's order, template units."""
    return np.array([(near, near), (far, near), (far, far), (near, far)])


def layer_points(points: NDArray[np.float64], layer: Layer) -> NDArray[np.float64]:
    """Return points (..., 2) of the pattern as they stand inside ``layer``, template units."""
    return points * layer.scale + layer.origin


def print_from_template(points: NDArray[np.float64], side_m: float) -> NDArray[np.float64]:
    """Return template points (..., 2) on the flat print: metres from its centre, x right, y up."""
    half = TEMPLATE_UNITS / 2
    return (np.asarray(points) - half) * (side_m / TEMPLATE_UNITS) * np.array([1.0, -1.0])


def layer_corners_print(layer: int, side_m: float) -> NDArray[np.float64]:
    """Return the black square's corners (4, 2) of a layer on the flat print, metres, x right, y up."""
    return print_from_template(square(*LAYERS[layer].black), side_m)
