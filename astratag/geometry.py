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
from math import ldexp

import numpy as np
from numpy.typing import NDArray

from astratag.checks import positive, whole

TEMPLATE_UNITS = 700.0
CELLS = 48
REGIONS = 8
QUIET_MARGIN = 0.14
"""Light margin around the black square, as a fraction of its side, on the published mock-ups."""

DRAWN_OFFSET = 0.5
"""The published cells are polygons through pixel centres: half a unit right of and below the print's own edges."""
LEAST_LAYER = 1.0
"""Side of the smallest black square that makes sense: a unit, 0.14 mm on a 100 mm marker."""
FRAME_ROOM = 2.5
"""Frame thicknesses by which a layer is smaller than the midpoint square it lies in: 1.25 at either side."""


Order = tuple[str, str, str, str, str, str]


def square(near: float, far: float) -> NDArray[np.float64]:
    """Return the corners (4, 2) of an axis-aligned square in the marker's order, template units."""
    return np.array([(near, near), (far, near), (far, far), (near, far)])


@dataclass(frozen=True)
class Region:
    """One encoding triangle: the right angle ``a``, the other vertices ``b`` and ``c`` clockwise, and the centroid.

    Its six cells are the medial triangles at b and c and the four around the centroid; ``order`` lists
    them as published: ``b`` and ``c`` the medial ones, ``ab`` and ``ac`` beside the right angle, ``mb`` and
    ``mc`` beside the middle of the hypotenuse.
    """

    name: str
    a: tuple[float, float]
    b: tuple[float, float]
    c: tuple[float, float]
    centroid: tuple[float, float]
    order: Order

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


_ORDERS: tuple[tuple[str, Order], ...] = (
    ("top left", ("c", "ab", "ac", "mb", "b", "mc")),
    ("top right", ("ab", "c", "mc", "ac", "mb", "b")),
    ("bottom right", ("c", "mb", "b", "mc", "ac", "ab")),
    ("bottom left", ("mc", "c", "ac", "mb", "b", "ab")),
    ("left", ("b", "mc", "c", "ab", "ac", "mb")),
    ("top", ("mb", "b", "mc", "c", "ac", "ab")),
    ("right", ("ac", "c", "mc", "ab", "mb", "b")),
    ("bottom", ("ab", "c", "mc", "ac", "mb", "b")),
)


def midpoint_square(level: int) -> NDArray[np.float64]:
    """Return the corners (4, 2) of the square after so many inscriptions in the midpoints of sides, template units.

    Each has half the area of the one before and is turned by 45 degrees: equations 1 to 3 of the paper.  Level 0 is
    the black square from its top-left corner, clockwise, level 1 starts at the middle of the top.
    """
    corners = square(0.0, TEMPLATE_UNITS)
    for _ in range(level):
        corners = (corners + np.roll(corners, -1, axis=0)) / 2
    return corners


def encoding_triangles() -> NDArray[np.float64]:
    """Return the triangles (8, 3, 2) between the first three midpoint squares, not yet contracted, in published order.

    Each is its right angle and the next and the previous corner of the square inside, clockwise.
    """
    outer, middle, inner = (midpoint_square(level) for level in range(3))
    corners = np.stack([outer, middle, np.roll(middle, 1, axis=0)], axis=1)
    edges = np.stack([middle, inner, np.roll(inner, 1, axis=0)], axis=1)
    return np.concatenate([corners, np.roll(edges, 1, axis=0)])


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
    frame_corner_radius: float = 0.0
    """Rounding of the frame's outer corners: half the frame's width, as a round pen draws them."""


@dataclass(frozen=True, eq=False)
class Template:
    """What a print is made of, template units: the cells (48, 3, 2) of the outermost layer as drawn, and the layers."""

    cells: NDArray[np.float64]
    layers: tuple[Layer, ...]


@dataclass(frozen=True)
class MarkerGeometry:
    """The parameters of the paper's construction, from which every point of a marker follows.

    ``contraction`` is what each structural triangle keeps of its size when it is contracted towards its centroid;
    ``border`` the thickness of the outermost white frame as a fraction of the marker's side; ``layers`` how many
    times the pattern is there.

    A layer lies in the second midpoint square of the one around it, half as large.  The paper leaves open how much
    of that square its white frame takes: as in the published artwork frames are half as thick from layer to layer,
    and a quarter of their thickness stays black around them.
    """

    contraction: float = 4 / 7
    border: float = 20 / TEMPLATE_UNITS
    layers: int = 3

    def __post_init__(self) -> None:
        if positive(self.contraction, "contraction", "fraction below 1") >= 1.0:
            raise ValueError(
                f"contraction must be a positive fraction below 1, got {self.contraction}: cells would touch"
            )
        positive(self.border, "border", "fraction of the side")
        object.__setattr__(self, "layers", whole(self.layers, "layers", 1))
        innermost = self._side(self.layers - 1)
        if innermost < LEAST_LAYER:
            raise ValueError(
                f"{self.layers} layers with a border of {self.border:.3g} sides do not fit: the innermost is "
                f"{innermost / TEMPLATE_UNITS:.3g} sides wide. Take fewer, or a thinner border"
            )

    def _side(self, layer: int) -> float:
        """Return the side of a layer's black square: each halves, less the room for its frame, which halves too."""
        return ldexp(TEMPLATE_UNITS * (1 - 2 * FRAME_ROOM * self.border * layer), -layer)

    def derived(self) -> Template:
        """Return the print that follows from the parameters, exactly as constructed."""
        return Template(np.concatenate([region.cells() for region in self.regions()]), self.nested_layers())

    def template(self) -> Template:
        """Return the print to make: for the published parameters the published one, as it was rounded and drawn."""
        return PUBLISHED if self == PUBLISHED_GEOMETRY else self.derived()

    def regions(self) -> tuple[Region, ...]:
        """Return the eight contracted encoding triangles with their true centroids."""
        triangles = encoding_triangles()
        centroids = triangles.mean(axis=1, keepdims=True)
        vertices = centroids + self.contraction * (triangles - centroids)
        points = np.concatenate([vertices, centroids], axis=1)
        return tuple(_region(name, at, order) for (name, order), at in zip(_ORDERS, points, strict=True))

    def nested_layers(self) -> tuple[Layer, ...]:
        """Return the layers, the outermost first."""
        layers = [Layer(0, black=(0.0, TEMPLATE_UNITS), frame=None, origin=0.0, scale=1.0)]
        for index in range(1, self.layers):
            side, border = self._side(index), TEMPLATE_UNITS * self.border / 2 ** (index - 1)
            near, far = (TEMPLATE_UNITS - side) / 2, (TEMPLATE_UNITS + side) / 2
            frame = near - border, far + border
            layers.append(Layer(index, (near, far), frame, near, side / TEMPLATE_UNITS, border / 2))
        return tuple(layers)


def _region(name: str, points: NDArray[np.float64], order: Order) -> Region:
    """Return a region from its three vertices and its centroid (4, 2)."""
    a, b, c, centroid = ((float(x), float(y)) for x, y in points)
    return Region(name, a, b, c, centroid, order)


def _published_region(exact: Region) -> Region:
    """Return an encoding triangle as published: vertices of whole units, and the paper's approximate centroid.

    Where a centroid is 1, 3 or 5 sixths of the side the published one is so many times 200 / sqrt(3), truncated: 115,
    346 and 577 for 116.7, 350 and 583.3.
    """
    sixths = np.round(6 * np.array(exact.centroid) / TEMPLATE_UNITS)
    points = [*np.round([exact.a, exact.b, exact.c]), np.trunc(sixths * 200 / np.sqrt(3.0))]
    return _region(exact.name, np.array(points), exact.order)


PUBLISHED_GEOMETRY = MarkerGeometry()
"""The parameters of the published artwork."""

SPIDRON = tuple(_published_region(region) for region in PUBLISHED_GEOMETRY.regions())
"""The published encoding triangles."""
LAYERS = (
    Layer(0, black=(0.0, 700.0), frame=None, origin=0.0, scale=1.0),
    Layer(1, (201.0, 500.0), (180.0, 521.0), origin=200.0, scale=300.0 / 700.0, frame_corner_radius=10.0),
    Layer(2, (288.0, 412.0), (277.0, 423.0), origin=287.0, scale=125.0 / 700.0, frame_corner_radius=5.0),
)
"""The published layers, measured on the artwork."""
SQUARES = tuple(square(*layer.black) for layer in LAYERS)
"""The corners (4, 2) of each layer's black square, not to be changed: warps keep where they are on a surface."""
for _corners in SQUARES:
    _corners.flags.writeable = False


TURN_CLOCKWISE = np.array(
    [7, 6, 9, 10, 11, 8, 17, 12, 15, 16, 13, 14, 19, 21, 22, 18, 20, 23, 5, 0, 2, 3, 4, 1]
    + [31, 32, 33, 35, 34, 30, 40, 41, 38, 37, 36, 39, 45, 43, 44, 42, 46, 47, 27, 26, 25, 28, 29, 24]
)
"""Where each cell goes when the print is turned clockwise by 90 degrees."""


def cell_polygons() -> NDArray[np.float64]:
    """Return the 48 cells of the outermost layer in published order, (48, 3, 2) template units."""
    return np.concatenate([region.cells() for region in SPIDRON])


PUBLISHED = Template(cell_polygons() + DRAWN_OFFSET, LAYERS)
"""The published print."""


def turn_clockwise(bits: NDArray[np.uint8], quarter_turns: int = 1) -> NDArray[np.uint8]:
    """Return what a code (..., 48) reads when its print is turned clockwise by quarter turns."""
    bits = bits.copy()
    for _ in range(quarter_turns % 4):
        turned = np.empty_like(bits)
        turned[..., TURN_CLOCKWISE] = bits
        bits = turned
    return bits


def layer_points(points: NDArray[np.float64], layer: Layer) -> NDArray[np.float64]:
    """Return points (..., 2) of the pattern as they stand inside ``layer``, template units."""
    return points * layer.scale + layer.origin


def print_from_template(points: NDArray[np.float64], side_m: float) -> NDArray[np.float64]:
    """Return template points (..., 2) on the flat print: metres from its centre, x right, y up."""
    half = TEMPLATE_UNITS / 2
    return (np.asarray(points) - half) * (np.array([1.0, -1.0]) * (side_m / TEMPLATE_UNITS))


_FROM_EACH = (np.arange(4) + np.arange(4)[:, None]) % 4


def renamed(corners: NDArray[np.float64], quarter_turns: int) -> NDArray[np.float64]:
    """Return corners (4, 2) in the order of a print whose first one is so many further on.

    As ``numpy.roll`` does, which takes ten times as long.
    """
    return corners[_FROM_EACH[quarter_turns % 4]]


def layer_corners_print(layer: int, side_m: float) -> NDArray[np.float64]:
    """Return the black square's corners (4, 2) of a layer on the flat print, metres, x right, y up."""
    return print_from_template(square(*LAYERS[layer].black), side_m)
