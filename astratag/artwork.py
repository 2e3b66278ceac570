"""Artwork: a marker as closed outlines of ink, as a sheet to print at exact physical size, and as the published raster.

The print follows a ``Template`` of ``geometry``: black squares and frames at the edges of its layers, cells at its
polygons.  A sheet adds crop marks around the quiet margin and, below it, a scale
bar and a label.  Sheet coordinates: millimetres from the sheet's top-left corner, x right, y down.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING
from xml.sax.saxutils import escape

import cv2
import numpy as np
from numpy.typing import NDArray

from astratag.checks import file_path, instance, numbers, positive
from astratag.dictionary import Dictionary
from astratag.geometry import (
    CELLS,
    LAYERS,
    PUBLISHED,
    PUBLISHED_GEOMETRY,
    QUIET_MARGIN,
    TEMPLATE_UNITS,
    Layer,
    MarkerGeometry,
    Template,
    cell_polygons,
    layer_points,
    square,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = NDArray[np.float64]
Point = tuple[float, float]

FORMATS = ("svg", "pdf", "png")
MM_PER_INCH = 25.4
POINTS_PER_INCH = 72.0
MAX_PIXELS = 150_000_000

FONT_MM = 2.5
CROP_MM = 4.0
"""Length of the crop marks, and the clear border outside the quiet margin that holds them."""
LABEL_MM = 12.0
"""Height of the strip below the quiet margin that holds the scale bar and the label."""
ARC_STEPS = 16
"""Chords in a rounded corner: they leave the arc by 0.012 template units, 2 micrometres on a 100 mm marker."""


def artwork_image(signature: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return a code (48,) as the published raster artwork, (700, 700) uint8, 0 for ink.

    Drawn as the published ones were: filled polygons that include their outline, every cell over those before
    it, each inner layer a smaller copy of the layer around it, frames stroked with round joins.
    """
    signature = _checked(signature)
    size = int(TEMPLATE_UNITS)
    pattern = np.zeros((size, size), np.uint8)
    for polygon, bit in zip(cell_polygons().astype(np.int32), signature, strict=True):
        cv2.fillPoly(pattern, [polygon], 255 * int(bit))
    image = pattern.copy()
    for layer in LAYERS[1:]:
        assert layer.frame is not None
        start, width = int(layer.origin), round(layer.scale * size)
        pattern = cv2.resize(pattern, (width, width), interpolation=cv2.INTER_LINEAR)
        image[start : start + width, start : start + width] = pattern
        radius = int(layer.frame_corner_radius)
        near, far = int(layer.frame[0]) + radius, int(layer.frame[1]) - 1 - radius
        cv2.rectangle(image, (near, near), (far, far), 255, 2 * radius)
    return image


def ink_outlines(signature: NDArray[np.uint8], template: Template = PUBLISHED) -> list[Array]:
    """Return the closed outlines (N, 2) between ink and white of a code (48,), template units.

    To be filled as one path: each crossing changes colour (even-odd), and outlines around ink run clockwise on
    the print and those around white the other way (non-zero works too).  White cells that touch are one outline,
    so no seam can show between them.
    """
    cells = _union(template.cells[_checked(signature).astype(bool)])
    outlines = []
    for layer in template.layers:
        if layer.frame is not None:
            outlines.append(_frame_outline(layer)[::-1])
        outlines.append(square(*layer.black))
        outlines += [layer_points(outline, layer) for outline in cells]
    return outlines


def write_artwork(
    dictionary: Dictionary,
    marker_id: int,
    path: str | Path,
    *,
    side_m: float,
    dpi: float = 300.0,
    geometry: MarkerGeometry = PUBLISHED_GEOMETRY,
) -> Path:
    """Write the sheet of a marker whose black square has sides of ``side_m`` metres, and return its path.

    The suffix of ``path`` says the format: .svg and .pdf are exact; .png has at least ``dpi`` dots an inch, raised
    so that a template unit is an even number of pixels (its physical size is in its pHYs chunk).  ``geometry`` other
    than the published one is named on the sheet: the detector reads the published one.
    Raises ValueError for an unknown id or format, or a side or resolution that is not possible.
    """
    instance(dictionary, Dictionary, "dictionary", "load_dictionary(name) makes one")
    path = file_path(path)
    format_ = path.suffix.lower().removeprefix(".")
    if format_ not in FORMATS:
        raise ValueError(f"artwork format must be one of {', '.join(FORMATS)}, got {format_ or 'no suffix'!r} ({path})")
    positive(side_m, "side_m", "length in metres, the black square's side")
    positive(dpi, "dpi", "number of dots an inch")
    instance(geometry, MarkerGeometry, "geometry", "MarkerGeometry(contraction, border, layers) makes one")
    sheet = _sheet(dictionary, marker_id, 1000.0 * side_m, geometry)
    path.parent.mkdir(parents=True, exist_ok=True)
    if format_ == "svg":
        path.write_text(_svg(sheet), encoding="utf-8")
    elif format_ == "pdf":
        metadata = {"Title": sheet.label, "CreationDate": None}
        _figure(sheet, POINTS_PER_INCH).savefig(path, format="pdf", metadata=metadata)
    else:
        _write_png(sheet, path, dpi)
    return path


@dataclass(frozen=True)
class _Sheet:
    """A marker laid out to print: millimetres, y down; the marker starts a whole number of units from the edges."""

    unit_mm: float
    units: tuple[int, int]
    """Width and height in template units."""
    ink: list[Array]
    label: str
    texts: list[tuple[Point, str]]
    """Baseline start and text."""

    @property
    def size_mm(self) -> tuple[float, float]:
        return self.units[0] * self.unit_mm, self.units[1] * self.unit_mm


def _sheet(dictionary: Dictionary, marker_id: int, side_mm: float, geometry: MarkerGeometry) -> _Sheet:
    signature = dictionary.signature(marker_id)
    label = f"{dictionary.family}, id {marker_id}, side {side_mm:.6g} mm"
    if geometry != PUBLISHED_GEOMETRY:
        label += f", contraction {geometry.contraction:.4g}, border {geometry.border:.4g}, layers {geometry.layers}"
    unit = side_mm / TEMPLATE_UNITS
    margin = round(QUIET_MARGIN * TEMPLATE_UNITS)
    border, strip = int(np.ceil(CROP_MM / unit)), int(np.ceil(LABEL_MM / unit))
    cut = int(TEMPLATE_UNITS) + 2 * margin
    extra = max(0, int(np.ceil((0.65 * FONT_MM * len(label) / unit - cut) / 2)))  # 0.65 em: a generous character
    left, top = border + extra, border
    ink = [(outline + (left + margin, top + margin)) * unit for outline in ink_outlines(signature, geometry.template())]
    ink += _crop_marks(left * unit, top * unit, cut * unit)

    bar = _scale_bar_mm(cut * unit)
    x, y = border * unit, (top + cut) * unit + CROP_MM + 1.0
    ink.append(_rectangle(x, y, bar, 1.0))
    texts = [((x + bar + 1.0, y + 1.4), f"{bar:g} mm"), ((x, y + 1.0 + 1.6 * FONT_MM), label)]
    return _Sheet(unit, (cut + 2 * left, cut + border + strip), ink, label, texts)


def _scale_bar_mm(room_mm: float) -> float:
    """Return the largest 1, 2 or 5 times a power of ten that leaves a third of the room to its caption."""
    decade = 10.0 ** np.floor(np.log10(room_mm))
    return float(max(k * decade for k in (0.1, 0.2, 0.5, 1.0, 2.0, 5.0) if k * decade <= 0.67 * room_mm))


def _crop_marks(left: float, top: float, cut: float) -> list[Array]:
    """Return eight hairlines that point at the corners of the quiet margin from outside, with a gap."""
    length, gap, width = 0.6 * CROP_MM, 0.3 * CROP_MM, 0.1
    marks = []
    for edge in (0.0, cut):
        for start in (-gap - length, cut + gap):
            marks.append(_rectangle(left + start, top + edge - width / 2, length, width))
            marks.append(_rectangle(left + edge - width / 2, top + start, width, length))
    return marks


def _rectangle(x: float, y: float, width: float, height: float) -> Array:
    return np.array([(x, y), (x + width, y), (x + width, y + height), (x, y + height)])


def _frame_outline(layer: Layer) -> Array:
    """Return the frame's outer edge with its rounded corners, clockwise on the print, template units."""
    assert layer.frame is not None
    radius = layer.frame_corner_radius
    centres = square(layer.frame[0] + radius, layer.frame[1] - radius)
    angles = np.linspace(0.0, np.pi / 2, ARC_STEPS + 1)
    arcs = []
    for corner, centre in enumerate(centres):
        turn = angles + np.pi + corner * np.pi / 2
        arcs.append(centre + radius * np.stack([np.cos(turn), np.sin(turn)], axis=-1))
    return np.concatenate(arcs)


def _union(triangles: Array) -> list[Array]:
    """Return the outlines of triangles (N, 3, 2) that touch along whole edges only, counter-clockwise on the print."""
    edges: set[tuple[Point, Point]] = set()
    for a, b, c in triangles:
        clockwise = np.cross(np.append(b - a, 0.0), np.append(c - a, 0.0))[2] > 0  # y is down
        corners = [(float(x), float(y)) for x, y in ((a, c, b, a) if clockwise else (a, b, c, a))]
        for start, end in pairwise(corners):
            if (end, start) in edges:
                edges.remove((end, start))
            else:
                edges.add((start, end))
    leaving: dict[Point, list[Point]] = {}
    for start, end in sorted(edges):
        leaving.setdefault(start, []).append(end)
    outlines = []
    while leaving:
        outline = [next(iter(leaving))]
        while outline[-1] in leaving:
            ends = leaving[outline[-1]]
            if len(ends) == 1:
                del leaving[outline[-1]]
            outline.append(ends.pop())
        outlines.append(np.array(outline[:-1]))
    return outlines


def _svg(sheet: _Sheet) -> str:
    width, height = sheet.size_mm
    path = " ".join("M" + " L".join(f"{x:.5f},{y:.5f}" for x, y in outline) + " Z" for outline in sheet.ink)
    texts = "\n".join(f'<text x="{x:.3f}" y="{y:.3f}">{escape(text)}</text>' for (x, y), text in sheet.texts)
    return f"""<svg xmlns="http://www.w3.org/2000/svg" width="{width:.5f}mm" height="{height:.5f}mm" \
viewBox="0 0 {width:.5f} {height:.5f}">
<title>{escape(sheet.label)}</title>
<rect width="100%" height="100%" fill="white"/>
<path fill="black" fill-rule="evenodd" d="{path}"/>
<g font-family="DejaVu Sans, Verdana, sans-serif" font-size="{FONT_MM}">
{texts}
</g>
</svg>
"""


def _figure(sheet: _Sheet, dpi: float) -> Figure:
    """Return the sheet as a figure of its physical size, drawn in dots of ``dpi`` an inch."""
    from matplotlib.figure import Figure  # half a second to import, and only printing needs it
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path as Outline
    from matplotlib.transforms import Affine2D

    width, height = sheet.size_mm
    figure = Figure(figsize=(width / MM_PER_INCH, height / MM_PER_INCH), dpi=dpi, facecolor="white")
    dots = dpi / MM_PER_INCH
    to_dots = Affine2D().scale(dots, -dots).translate(0.0, height * dots)
    ink = Outline.make_compound_path(*(Outline([*outline, outline[0]], closed=True) for outline in sheet.ink))
    figure.add_artist(PathPatch(ink, facecolor="black", linewidth=0.0, snap=False, transform=to_dots))
    font_points = FONT_MM / MM_PER_INCH * POINTS_PER_INCH
    for (x, y), text in sheet.texts:
        figure.text(x, y, text, transform=to_dots, fontsize=font_points, parse_math=False)
    return figure


def _write_png(sheet: _Sheet, path: Path, dpi: float) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from PIL import Image

    pixels_per_unit = 2 * int(np.ceil(dpi * sheet.unit_mm / MM_PER_INCH / 2))  # even: cells stand on half units
    width, height = (units * pixels_per_unit for units in sheet.units)
    if width * height > MAX_PIXELS:
        raise ValueError(
            f"a PNG of {sheet.label} would have {width}x{height} pixels, more than {MAX_PIXELS:,}: use svg or pdf"
        )
    dpi = pixels_per_unit / sheet.unit_mm * MM_PER_INCH
    canvas = FigureCanvasAgg(_figure(sheet, dpi))
    canvas.draw()
    image = Image.fromarray(np.asarray(canvas.buffer_rgba())[..., 0])
    image.save(path, dpi=(dpi, dpi))


def _checked(signature: NDArray[np.uint8]) -> NDArray[np.uint8]:
    cells = numbers(signature, "signature")
    if cells.shape != (CELLS,) or not np.isin(cells, (0, 1)).all():
        raise ValueError(f"signature must hold {CELLS} cells, each 0 or 1, got shape {cells.shape}")
    return cells.astype(np.uint8)
