"""The simulated camera puts ink where the camera model says, encodes light as sRGB, and repeats itself exactly."""

from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import pytest

from astratag.camera import Camera
from astratag.dictionary import load_dictionary
from astratag.geometry import DRAWN_OFFSET, LAYERS, cell_polygons, layer_points, print_from_template
from astratag.surface import Cylinder, Flat, Surface
from astratag.transforms import exp_so3, pose, transform
from pipeline.render import (
    BLACK_ALBEDO,
    WHITE_ALBEDO,
    lay_print,
    linear_from_srgb,
    render_marker,
    srgb_from_linear,
)
from pipeline.texture import print_coverage

REFERENCE = Path(__file__).parents[2] / "shared" / "reference"
SIGNATURE = load_dictionary("astratag20").signature(7)
SIDE_M = 0.1
FACING = np.diag([1.0, -1.0, -1.0])
"""R_cam_marker of a marker seen square-on and upright."""

PINHOLE = Camera([[800, 0, 319.5], [0, 800, 239.5], [0, 0, 1]], width=640, height=480)
LENS = Camera([[800, 0, 310.0], [0, 805, 250.0], [0, 0, 1]], (-0.12, 0.06, 0.001, -0.0008, 0.01), width=640, height=480)


def steepness(T_cam_marker: np.ndarray, surface: Surface, on_print: np.ndarray) -> np.ndarray:
    """Return the cosine between the line of sight and the surface's normal: 1 square-on, negative out of sight."""
    seen_from = transform(T_cam_marker, surface.points(on_print))
    normals = surface.normals(on_print) @ T_cam_marker[:3, :3].T
    return -(seen_from * normals).sum(axis=-1) / np.linalg.norm(seen_from, axis=-1)


def edge_offsets_px(camera: Camera, T_cam_marker: np.ndarray, surface: Surface, layer: int) -> np.ndarray:
    """Return how far the edges of a layer's black square stand outside where projected surface points say they do.

    The picture is linear and noise-free; along the normal of the projected edge the light is integrated, so that
    an edge between known levels is found without assuming a blur.
    """
    grey = np.full((camera.height, camera.width), 0.4, np.float32)
    picture = lay_print(grey, camera, T_cam_marker, signature=SIGNATURE, side_m=SIDE_M, surface=surface)
    picture = cv2.GaussianBlur(picture, (0, 0), 1.0)
    near, far = LAYERS[layer].black
    along = np.linspace(near, far, 15)[2:-2]
    sides = [(along, np.full(11, near), (0, -1)), (np.full(11, far), along, (1, 0))]
    sides += [(along, np.full(11, far), (0, 1)), (np.full(11, near), along, (-1, 0))]
    reach = np.arange(-4, 4.01, 0.05)
    offsets = []
    for x, y, outward in sides:
        points = np.stack([x, y], axis=-1)
        points = points[steepness(T_cam_marker, surface, print_from_template(points, SIDE_M)) > 0.6]
        edge, beside, onward = (
            camera.project(transform(T_cam_marker, surface.points(print_from_template(points + step, SIDE_M))))
            for step in (np.zeros(2), np.array(outward) * 0.01, np.array(outward)[::-1] * 0.01)
        )
        tangent = onward - edge
        normal = np.stack([tangent[:, 1], -tangent[:, 0]], axis=-1)
        normal *= np.sign((normal * (beside - edge)).sum(axis=1, keepdims=True)) / np.linalg.norm(
            normal, axis=1, keepdims=True
        )
        at = (edge[:, None] + reach[None, :, None] * normal[:, None]).astype(np.float32)
        light = cv2.remap(picture, at[..., 0], at[..., 1], cv2.INTER_LINEAR)
        dark, bright = light[:, :20].mean(axis=1), light[:, -20:].mean(axis=1)
        share = (bright[:, None] - light) / (bright - dark)[:, None]
        offsets.append(share.sum(axis=1) * 0.05 - 4.025)
    return np.concatenate(offsets)


@pytest.mark.parametrize("camera", [PINHOLE, LENS], ids=["pinhole", "lens"])
@pytest.mark.parametrize(
    "surface", [Flat(), Cylinder(0.15), Cylinder(0.08, 0.7)], ids=["flat", "cylinder", "skew cylinder"]
)
@pytest.mark.parametrize(("range_m", "layer"), [(0.3, 0), (0.12, 1), (0.06, 2)])
@pytest.mark.parametrize("tilt", [(0, 0, 0), (0.3, -0.2, 0.4), (0.0, 0.7, 0.1)], ids=str)
def test_edges_stand_where_the_camera_projects_them(
    camera: Camera, surface: Surface, range_m: float, layer: int, tilt: tuple[float, float, float]
) -> None:
    T_cam_marker = pose(exp_so3(tilt) @ FACING, [0.0031, -0.0017, range_m])
    offsets = edge_offsets_px(camera, T_cam_marker, surface, layer)
    assert len(offsets) > 15
    assert np.abs(offsets).max() < 0.03
    assert abs(offsets.mean()) < 0.005


def test_reads_as_the_published_artwork() -> None:
    if not REFERENCE.exists():
        pytest.skip("the published artworks are not part of this project")
    published = cv2.imread(str(REFERENCE / "markers" / "marker_7.png"), cv2.IMREAD_GRAYSCALE)
    coverage = print_coverage(SIGNATURE)
    margin = (coverage.shape[0] - 4 * 700) // 2
    drawn = cv2.resize(coverage[margin:-margin, margin:-margin], (700, 700), interpolation=cv2.INTER_AREA)
    wrong = np.abs(drawn.astype(float) - published) > 128
    assert wrong.mean() < 1e-3, "only pixels on the edges of cells may differ"
    assert not cv2.erode(wrong.astype(np.uint8), np.ones((3, 3))).any()


def test_cells_of_a_frontal_picture_read_the_signature() -> None:
    camera = Camera([[2000, 0, 895.5], [0, 2000, 895.5], [0, 0, 1]], width=1792, height=1792)
    picture = render_marker(
        camera, pose(FACING, [0, 0, 1000 * SIDE_M / 700]), signature=SIGNATURE, side_m=SIDE_M, noise_sigma=0
    )
    for layer in LAYERS:
        centres = layer_points(cell_polygons() + DRAWN_OFFSET, layer).mean(axis=1)
        pixels = np.round((centres + 98) * 2 - 0.5).astype(int)
        assert np.array_equal(picture[pixels[:, 1], pixels[:, 0]] > 128, SIGNATURE == 1), layer


def test_light_is_conserved() -> None:
    """The print's mean is what its share of black and white says, whatever its size in the picture."""
    coverage = print_coverage(SIGNATURE) / 255
    expected = BLACK_ALBEDO + (WHITE_ALBEDO - BLACK_ALBEDO) * coverage.mean()
    dark = np.zeros((480, 640), np.float32)
    for range_m in (0.3, 1.0, 4.0):
        T_cam_marker = pose(FACING, [0.0013, 0.0007, range_m])
        picture = lay_print(dark, PINHOLE, T_cam_marker, signature=SIGNATURE, side_m=SIDE_M, surface=Flat())
        area = (800 * 1.28 * SIDE_M / range_m) ** 2
        assert picture.sum() / area == pytest.approx(expected, rel=2e-3)


@pytest.mark.parametrize(("encoding", "black", "white"), [("srgb", 56, 237), ("linear", 10, 217)])
def test_encodes_light(encoding: Literal["srgb", "linear"], black: int, white: int) -> None:
    """Levels of the sRGB standard: 0.04 is 56.2 of 255 and 0.85 is 237.1."""
    T_cam_marker = pose(FACING, [0, 0, 0.2])
    picture = render_marker(
        PINHOLE, T_cam_marker, signature=SIGNATURE, side_m=SIDE_M, noise_sigma=0, encoding=encoding, background=77
    )
    assert picture[0, 0] == 77
    assert picture[239, 319] == black
    margin = PINHOLE.project(np.array([[0.056, 0.0, 0.2]]))[0]
    assert picture[round(margin[1]), round(margin[0])] == white


def test_encoding_is_undone() -> None:
    light = np.linspace(0, 1, 1001, dtype=np.float32)
    assert np.allclose(linear_from_srgb(srgb_from_linear(light)), light, atol=2e-6)


def test_same_seed_same_picture() -> None:
    T_cam_marker = pose(FACING, [0, 0, 0.5])
    first, again, other = (
        render_marker(PINHOLE, T_cam_marker, signature=SIGNATURE, side_m=SIDE_M, seed=seed) for seed in (3, 3, 4)
    )
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


def test_a_marker_out_of_sight_leaves_the_background() -> None:
    for T_cam_marker in (pose(FACING, [0, 0, -1.0]), pose(FACING, [9.0, 0, 1.0]), pose(np.eye(3), [0, 0, 1.0])):
        picture = render_marker(PINHOLE, T_cam_marker, signature=SIGNATURE, side_m=SIDE_M, noise_sigma=0)
        assert (picture == 40).all()


def test_refuses_what_is_no_marker() -> None:
    T_cam_marker = pose(FACING, [0, 0, 1.0])
    with pytest.raises(ValueError, match="48 bits"):
        render_marker(PINHOLE, T_cam_marker, signature=SIGNATURE[:24], side_m=SIDE_M)
    with pytest.raises(ValueError, match="positive side"):
        render_marker(PINHOLE, T_cam_marker, signature=SIGNATURE, side_m=0.0)
