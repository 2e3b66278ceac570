"""The artwork: ink where the metric model says, in every format, and the published raster reproduced."""

import re
import zlib
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.path import Path as Outline
from PIL import Image

from astratag.artwork import CROP_MM, artwork_image, ink_outlines, write_artwork
from astratag.dictionary import load_dictionary
from astratag.geometry import LAYERS, QUIET_MARGIN, MarkerGeometry, cell_polygons, layer_points, square
from pipeline.texture import print_coverage

DICTIONARY = load_dictionary()
SIDE_MM = 87.3
UNIT_MM = SIDE_MM / 700
signatures = st.lists(st.integers(0, 1), min_size=48, max_size=48).map(lambda bits: np.array(bits, np.uint8))


def signed_area(outline):
    """Positive when clockwise on the print (y down)."""
    x, y = outline.T
    return 0.5 * np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))


def cell_masks():
    """The pixels (3, 48, 700, 700) well inside each cell of each layer, at least one each."""
    masks = np.zeros((3, 48, 700, 700), bool)
    for layer in LAYERS:
        for cell, polygon in enumerate(layer_points(cell_polygons() + 0.5, layer)):
            canvas = np.zeros((700, 700), np.uint8)
            inner = polygon.mean(axis=0) + 0.6 * (polygon - polygon.mean(axis=0))
            cv2.fillConvexPoly(canvas, np.rint((inner - 0.5) * 16).astype(np.int32), 1, shift=4)
            masks[layer.index, cell] = canvas.astype(bool)
    return masks


CELL_MASKS = cell_masks()


def cells_read(image):
    """The bits (3, 48) of an upright artwork (700, 700): the majority of the pixels of each cell."""
    return np.array([[np.mean(image[mask] > 127) > 0.5 for mask in layer] for layer in CELL_MASKS], np.uint8)


@pytest.mark.parametrize("marker_id", range(20))
def test_raster_against_published(shared, marker_id):
    """Black or white as published but for a few border pixels; greys within the published palette's rounding."""
    published = cv2.imread(str(shared / f"reference/markers/marker_{marker_id}.png"), cv2.IMREAD_GRAYSCALE)
    ours = artwork_image(DICTIONARY.signature(marker_id))
    assert np.mean((ours > 127) != (published > 127)) < 1e-4
    assert np.mean(ours != published) < 3e-3
    assert (cells_read(ours) == cells_read(published)).all()
    for layer in LAYERS[1:]:
        (near, far), (black_near, black_far) = map(int, layer.frame), map(int, layer.black)
        frame = np.zeros(ours.shape, bool)
        frame[near:far, near:far] = True
        frame[black_near:black_far, black_near:black_far] = False
        assert (ours[frame] == published[frame]).all()


@pytest.mark.parametrize("marker_id", range(20))
def test_raster_reads_as_its_signature_in_every_layer(marker_id):
    signature = DICTIONARY.signature(marker_id)
    assert (cells_read(artwork_image(signature)) == signature).all()


@settings(max_examples=60)
@given(signatures)
def test_ink_is_the_square_less_frames_and_white_cells(signature):
    """The signed areas of the outlines add up to the ink of the metric model."""
    x, y = np.moveaxis(cell_polygons()[signature.astype(bool)], -1, 0)
    cells = 0.5 * np.abs((x[:, 1] - x[:, 0]) * (y[:, 2] - y[:, 0]) - (x[:, 2] - x[:, 0]) * (y[:, 1] - y[:, 0])).sum()
    expected = 0.0
    for layer in LAYERS:
        expected += (layer.black[1] - layer.black[0]) ** 2 - cells * layer.scale**2
        if layer.frame is not None:
            expected -= (layer.frame[1] - layer.frame[0]) ** 2 - (4 - np.pi) * layer.frame_corner_radius**2
    assert sum(map(signed_area, ink_outlines(signature))) == pytest.approx(expected, abs=2.0)  # arcs are chords


@settings(max_examples=60)
@given(signatures)
def test_colour_at_each_cell_is_its_bit_by_both_fill_rules(signature):
    outlines = ink_outlines(signature)
    centres = np.concatenate([layer_points(cell_polygons().mean(axis=1) + 0.5, layer) for layer in LAYERS])
    inside = np.array([Outline(outline).contains_points(centres) for outline in outlines])
    winding = np.array([np.sign(signed_area(outline)) for outline in outlines]) @ inside
    white = np.tile(signature, 3).astype(bool)
    assert (inside.sum(axis=0) % 2 == ~white).all()
    assert (winding == ~white).all()


@pytest.mark.parametrize("geometry", [MarkerGeometry(), MarkerGeometry(0.7, 0.02, 4), MarkerGeometry(0.4, 0.1, 2)])
def test_colour_at_each_cell_of_another_geometry_is_its_bit_in_every_layer(geometry):
    template, signature = geometry.derived(), DICTIONARY.signature(19)
    outlines = ink_outlines(signature, template)
    centres = np.concatenate([layer_points(template.cells.mean(axis=1), layer) for layer in template.layers])
    inside = np.array([Outline(outline).contains_points(centres) for outline in outlines])
    assert (inside.sum(axis=0) % 2 == 1 - np.tile(signature, geometry.layers)).all()


def test_another_geometry_is_named_on_its_sheet(tmp_path):
    plain = write_artwork(DICTIONARY, 3, tmp_path / "plain.svg", side_m=0.1)
    same = write_artwork(DICTIONARY, 3, tmp_path / "same.svg", side_m=0.1, geometry=MarkerGeometry(4 / 7, 1 / 35, 3))
    other = write_artwork(DICTIONARY, 3, tmp_path / "other.svg", side_m=0.1, geometry=MarkerGeometry(layers=2))
    assert plain.read_bytes() == same.read_bytes()
    assert "contraction 0.5714, border 0.02857, layers 2" in other.read_text()
    assert len(svg_outlines(other)[1]) < len(svg_outlines(plain)[1])


def test_touching_white_cells_are_one_outline():
    """All white: eight triangles a layer, three squares and two frames, and no seam between cells."""
    outlines = ink_outlines(np.ones(48, np.uint8))
    assert len(outlines) == 3 * 8 + 3 + 2


def svg_outlines(path: Path):
    root = ElementTree.parse(path).getroot()
    d = root.find("{*}path").attrib["d"]
    outlines = [
        np.array([pair.split(",") for pair in re.findall(r"[\d.-]+,[\d.-]+", part)], float) for part in d.split("Z")
    ]
    return root, [outline for outline in outlines if len(outline)]


def pdf_outlines(path: Path):
    """The ink of a sheet in mm, y down, read from the content stream without a PDF library."""
    data = path.read_bytes()
    width, height = map(float, re.search(rb"/MediaBox \[ ?0 0 ([\d.]+) ([\d.]+)", data).groups())
    streams = re.findall(rb"/FlateDecode.*?stream\r?\n(.*?)\r?\nendstream", data, re.DOTALL)
    page = max((zlib.decompress(stream) for stream in streams), key=lambda text: text.count(b" l\n"))
    outlines = []
    for x, y, operator in re.findall(rb"([\d.-]+) ([\d.-]+) ([ml])\n", page):
        if operator == b"m":
            outlines.append([])
        outlines[-1].append((float(x), height - float(y)))
    mm = 25.4 / 72
    return (width * mm, height * mm), [np.array(outline) * mm for outline in outlines]


def assert_print_follows_the_metric_model(outlines, signature):
    """Every outline of the marker within 0.01 mm, and nothing else inside the quiet margin."""
    model = ink_outlines(signature)
    first = next(i for i, o in enumerate(outlines) if np.ptp(o, axis=0) == pytest.approx([SIDE_MM] * 2, abs=0.01))
    corner = outlines[first].min(axis=0)
    for printed, expected in zip(outlines[first:], model, strict=False):
        np.testing.assert_allclose(printed[: len(expected)] - corner, expected * UNIT_MM, atol=0.01)
    quiet_near, quiet_far = corner - QUIET_MARGIN * SIDE_MM, corner + (1 + QUIET_MARGIN) * SIDE_MM
    others = outlines[:first] + outlines[first + len(model) :]
    assert len(others) >= 9  # eight crop marks and the scale bar
    for other in others:
        assert (other.max(axis=0) < quiet_near + 0.1).any() or (other.min(axis=0) > quiet_far - 0.1).any()


def test_layer_squares_stand_where_the_detector_believes(tmp_path):
    """The three black squares in the file, against LAYERS directly."""
    _, outlines = svg_outlines(write_artwork(DICTIONARY, 3, tmp_path / "marker.svg", side_m=SIDE_MM / 1000))
    filled = [o for o in outlines if np.prod(np.ptp(o, axis=0)) == pytest.approx(abs(signed_area(o)), rel=1e-4)]
    squares = [o for o in filled if len(o) == 4 and np.ptp(o, axis=0).min() > 10]
    assert len(squares) == 3
    corner = squares[0][0]
    for layer, printed in zip(LAYERS, squares, strict=True):
        np.testing.assert_allclose(printed - corner, square(*layer.black) * UNIT_MM, atol=0.001)


def test_svg_is_in_millimetres_and_follows_the_metric_model(tmp_path):
    root, outlines = svg_outlines(write_artwork(DICTIONARY, 11, tmp_path / "marker.svg", side_m=SIDE_MM / 1000))
    width, height = root.attrib["width"], root.attrib["height"]
    assert root.attrib["viewBox"] == f"0 0 {width.removesuffix('mm')} {height.removesuffix('mm')}"
    assert_print_follows_the_metric_model(outlines, DICTIONARY.signature(11))
    bar = outlines[-1]
    captions = [text.text for text in root.findall(".//{*}text")]
    assert captions == [f"{np.ptp(bar[:, 0]):g} mm", f"astratag20, id 11, side {SIDE_MM:g} mm"]
    assert (np.concatenate(outlines) >= 0).all()
    assert (np.concatenate(outlines) <= [float(width[:-2]), float(height[:-2])]).all()


def test_pdf_has_the_physical_size_of_the_svg_and_follows_the_metric_model(tmp_path):
    root, _ = svg_outlines(write_artwork(DICTIONARY, 11, tmp_path / "marker.svg", side_m=SIDE_MM / 1000))
    size_mm, outlines = pdf_outlines(write_artwork(DICTIONARY, 11, tmp_path / "marker.pdf", side_m=SIDE_MM / 1000))
    np.testing.assert_allclose(size_mm, [float(root.attrib[k][:-2]) for k in ("width", "height")], atol=0.01)
    assert_print_follows_the_metric_model(outlines[1:], DICTIONARY.signature(11))  # the first is the white paper


def test_png_puts_the_square_on_whole_pixels_and_says_its_size(tmp_path):
    path = write_artwork(DICTIONARY, 19, tmp_path / "new" / "marker.png", side_m=0.1, dpi=300)
    with Image.open(path) as file:
        dots_per_mm = file.info["dpi"][0] / 25.4
        image = np.asarray(file)
    side = round(100 * dots_per_mm)
    assert dots_per_mm * 25.4 >= 300
    assert side % 1400 == 0
    assert abs(side / dots_per_mm - 100) < 0.01
    rows, columns = (np.flatnonzero((image == 0).sum(axis=axis) > 0.9 * side) for axis in (1, 0))
    top, left = rows[0], columns[0]
    assert (rows[-1] - top + 1, columns[-1] - left + 1) == (side, side)
    margin = round(QUIET_MARGIN * side) - 1
    quiet = image[top - margin : top + side + margin, left - margin : left + side + margin].copy()
    quiet[margin:-margin, margin:-margin] = 255
    assert (quiet == 255).all()
    marker = cv2.resize(image[top : top + side, left : left + side], (700, 700), interpolation=cv2.INTER_AREA)
    assert (cells_read(marker) == DICTIONARY.signature(19)).all()
    for layer in LAYERS:
        near, far = (int(edge) for edge in layer.black)
        assert (marker[near, near:far] == 0).all()
        assert (marker[near:far, far - 1] == 0).all()
        if layer.frame is not None:
            assert (marker[near - 1, near:far] == 255).all()
            assert (marker[near:far, far] == 255).all()


@pytest.mark.parametrize("side_m", [0.002, 0.03, 1.0])
def test_small_and_large_sheets_hold_their_label(tmp_path, side_m):
    root, outlines = svg_outlines(write_artwork(DICTIONARY, 0, tmp_path / "marker.svg", side_m=side_m))
    assert float(root.attrib["width"][:-2]) > 40
    assert np.ptp(outlines[-1][:, 0]) < float(root.attrib["width"][:-2])


def test_a_family_name_with_markup_stays_text(tmp_path):
    family = type(DICTIONARY)("a<b>&$x$", DICTIONARY.ids, DICTIONARY.signatures)
    root, _ = svg_outlines(write_artwork(family, 0, tmp_path / "marker.svg", side_m=0.05))
    assert root.find("{*}title").text.startswith("a<b>&$x$, id 0")
    write_artwork(family, 0, tmp_path / "marker.pdf", side_m=0.05)


def test_the_same_marker_is_the_same_file(tmp_path):
    for suffix in ("svg", "pdf", "png"):
        first, second = (write_artwork(DICTIONARY, 5, tmp_path / f"{n}.{suffix}", side_m=0.05) for n in (1, 2))
        assert first.read_bytes() == second.read_bytes()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"side_m": 0.0}, "side_m must be a positive length"),
        ({"side_m": -0.1}, "side_m must be a positive length"),
        ({"side_m": float("nan")}, "side_m must be a positive length"),
        ({"marker_id": 20}, "marker 20 is not in dictionary 'astratag20'"),
        ({"name": "marker.bmp"}, "must be one of svg, pdf, png, got 'bmp'"),
        ({"name": "marker"}, "got 'no suffix'"),
        ({"dpi": 0.0}, "dpi must be a positive number"),
        ({"side_m": 0.0005}, "use svg or pdf"),
        ({"side_m": 50.0}, "use svg or pdf"),
    ],
)
def test_refuses_what_it_cannot_print_and_writes_nothing(tmp_path, change, message):
    arguments = {"marker_id": 0, "name": "marker.png", "side_m": 0.1, "dpi": 300.0} | change
    path = tmp_path / arguments.pop("name")
    with pytest.raises(ValueError, match=message) as error:
        write_artwork(DICTIONARY, path=path, **arguments)
    assert "\n" not in str(error.value)
    assert not path.exists()


def test_refuses_a_signature_of_another_length():
    with pytest.raises(ValueError, match="48 cells"):
        artwork_image(np.zeros(36, np.uint8))


@pytest.mark.parametrize("marker_id", [0, 11])
def test_the_printed_marker_is_the_simulated_one(tmp_path, marker_id):
    """The simulated camera paints its prints by other code: the same ink, but for the dots at the cells' tips."""
    path = write_artwork(DICTIONARY, marker_id, tmp_path / "marker.png", side_m=0.1)
    printed = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE).astype(float)
    simulated = print_coverage(DICTIONARY.signature(marker_id), texels_per_unit=2)
    border = 2 * int(np.ceil(CROP_MM / (100 / 700)))
    size = len(simulated)
    difference = printed[border : border + size, border : border + size] - simulated
    assert np.abs(difference).max() < 0.5 * 255
    assert np.mean(np.abs(difference) > 0.2 * 255) < 1e-4
    assert np.abs(difference).mean() < 0.1
