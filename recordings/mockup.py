"""The target of the shipped recording: a cylindrical station module with a marker, and what surrounds it.

Scene frame: the marker's, on the module's outside: x right along the module, y up, z out.  Metres; colours are
linear RGB albedos.  Much of it is there to fool a detector: squares that are no marker, grids, foil, hard shadows.
"""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from astratag.camera import Camera
from astratag.transforms import exp_so3, pose
from pipeline.bodies import Body, Box, Material, Plate, Print, Tube
from pipeline.texture import Image, Texture, print_texture

Array = NDArray[np.float64]
Color = tuple[float, float, float]

MODULE_RADIUS_M = 0.15
MODULE_LENGTH_M = 0.56
PAINT = (0.66, 0.65, 0.62)
METAL = Material((0.33, 0.33, 0.34), gloss=0.45, sharpness=60)
WHITE = Material((0.62, 0.61, 0.58), gloss=0.05, sharpness=25)
RAIL = Material((0.55, 0.36, 0.05), gloss=0.15, sharpness=50)
BLACK = Material((0.015, 0.015, 0.017), gloss=0.05, sharpness=20)
TEXEL_MM = 0.2
SEAMS_X_MM, SEAMS_Y_MM = (-205, -88, 88, 205), (-120, -78, 78, 120)


def target(signature: NDArray[np.uint8], side_m: float, rng: np.random.Generator) -> list[Body]:
    """Return the bodies of the target, with a marker at the origin."""
    return [*_module(signature, side_m, rng), *_fittings(), *_node(), *_wings(rng), *_bus(rng)]


def _module(signature: NDArray[np.uint8], side_m: float, rng: np.random.Generator) -> Iterator[Body]:
    texture = print_texture(signature, side_m)
    skin = Material(
        Texture(module_skin(rng), MODULE_LENGTH_M),
        gloss=0.08,
        sharpness=45,
        marker=Print(texture, texture.width_m / 2),
    )
    yield Body(Tube(MODULE_RADIUS_M, MODULE_LENGTH_M / 2), skin, np.eye(4), casts_shadow=True)
    for x, turn in ((-MODULE_LENGTH_M / 2, -np.pi / 2), (MODULE_LENGTH_M / 2, np.pi / 2)):
        yield disc((x, 0, -MODULE_RADIUS_M), exp_so3([0, turn, 0]), MODULE_RADIUS_M, WHITE)


def _fittings() -> Iterator[Body]:
    """Handrails on posts, hooks and feet, all casting shadows."""
    axis = np.array([0.0, 0.0, -MODULE_RADIUS_M])
    for around, start, end in ((1.05, -0.24, 0.10), (-0.95, -0.05, 0.22)):
        out = np.array([0.0, np.sin(around), np.cos(around)])
        rail = axis + (MODULE_RADIUS_M + 0.035) * out
        yield tube(rail + [start, 0, 0], rail + [end, 0, 0], 0.007, RAIL)
        for x in (start + 0.025, (start + end) / 2, end - 0.025):
            yield tube(axis + MODULE_RADIUS_M * out + [x, 0, 0], rail + [x, 0, 0], 0.005, METAL)
    for x, around in ((-0.15, 0.62), (0.12, 0.60), (-0.19, -0.50), (0.02, -0.62), (0.17, -0.45)):
        out = np.array([0.0, np.sin(around), np.cos(around)])
        R = exp_so3([-around, 0, 0])
        yield box(axis + (MODULE_RADIUS_M + 0.003) * out + [x, 0, 0], (0.026, 0.006, 0.008), WHITE, R)
    for x in (-0.2, 0.03, 0.22):
        yield box((x, -0.17, -0.12), (0.03, 0.10, 0.04), WHITE, exp_so3([0.25, 0, 0]))


def _node() -> Iterator[Body]:
    """The module's right end: a cone, a collar with thrusters, and the hatch."""
    right = MODULE_LENGTH_M / 2
    centre = np.array([0.0, 0.0, -MODULE_RADIUS_M])
    slope = (0.10 - MODULE_RADIUS_M) / 0.06
    cone = Tube((MODULE_RADIUS_M + 0.10) / 2, 0.03, slope)
    yield Body(cone, WHITE, pose(np.eye(3), centre + [right + 0.03, 0, cone.radius_m]))
    yield tube(centre + [right + 0.06, 0, 0], centre + [right + 0.15, 0, 0], 0.10, WHITE)
    yield tube(centre + [right + 0.15, 0, 0], centre + [right + 0.17, 0, 0], 0.075, METAL)
    facing = exp_so3([0, np.pi / 2, 0])
    yield disc(centre + [right + 0.15, 0, 0], facing, 0.10, WHITE)
    yield disc(centre + [right + 0.17, 0, 0], facing, 0.075, BLACK)
    for around in (-0.9, 0.1, 1.1):
        out = np.array([0.0, np.sin(around), np.cos(around)])
        foot = centre + 0.10 * out + [right + 0.105, 0, 0]
        yield tube(foot, foot + 0.03 * out, 0.018, WHITE, shadow=True)
        yield disc(foot + 0.03 * out, exp_so3([-around, 0, 0]), 0.018, WHITE)
        yield disc(foot + 0.0301 * out, exp_so3([-around, 0, 0]), 0.012, BLACK)


def _wings(rng: np.random.Generator) -> Iterator[Body]:
    """Solar panels: a grid of light lines on dark squares, and mirror-like at the right angle."""
    cells = Material(Texture(solar_cells(7, 4, rng), 0.34), gloss=0.5, sharpness=400)
    yield Body(Plate(0.17, 0.2975), cells, pose(exp_so3([0.1, -0.25, 0.06]), [0.72, 0.28, -0.22]))
    yield Body(Plate(0.17, 0.2975), cells, pose(exp_so3([-0.1, 0.3, 0.02]), [-0.78, 0.42, -0.40]))
    yield tube((0.40, 0.02, -0.20), (0.58, 0.22, -0.23), 0.008, METAL)
    yield tube((-0.70, -0.03, -0.36), (-0.76, 0.14, -0.40), 0.008, METAL)


def _bus(rng: np.random.Generator) -> Iterator[Body]:
    """A foil-wrapped box below on the left, with a dark dish and a label whose black square carries no code."""
    color, slopes = foil(rng)
    wrap = Material(Texture(color, 0.42), gloss=0.9, sharpness=50, bump=Texture(slopes, 0.42))
    turn = exp_so3([0.05, 0.22, -0.04])
    T_scene_front = pose(turn, [-0.62, -0.22, -0.24])
    yield Body(Plate(0.21, 0.21), wrap, T_scene_front)
    yield Body(Plate(0.15, 0.21), wrap, T_scene_front @ pose(exp_so3([0, np.pi / 2, 0]), [0.21, 0, -0.15]))
    yield Body(Plate(0.21, 0.15), wrap, T_scene_front @ pose(exp_so3([-np.pi / 2, 0, 0]), [0, 0.21, -0.15]))
    label = Material(Texture(empty_square_label(), 0.09), gloss=0.08)
    yield Body(Plate(0.045, 0.045), label, T_scene_front @ pose(exp_so3([0, 0, 0.12]), [0.06, 0.08, 0.002]))
    dish = T_scene_front @ pose(exp_so3([0.5, -0.1, 0]), [-0.09, -0.12, 0.06])
    yield Body(Plate(0.10, 0.10, round=True), BLACK, dish, casts_shadow=True)
    yield Body(Plate(0.104, 0.104, round=True, hole=0.96), METAL, dish)


def tube(start: ArrayLike, end: ArrayLike, radius_m: float, material: Material, *, shadow: bool = True) -> Body:
    """Return a tube between two points on its axis."""
    start, end = np.asarray(start, float), np.asarray(end, float)
    length = float(np.linalg.norm(end - start))
    x = (end - start) / length
    aside = np.array([0.0, 0.0, 1.0]) if abs(x[2]) < 0.9 else np.array([0.0, 1.0, 0.0])
    y = np.cross(aside, x) / np.linalg.norm(np.cross(aside, x))
    R = np.stack([x, y, np.cross(x, y)], axis=1)
    return Body(
        Tube(radius_m, length / 2), material, pose(R, (start + end) / 2 + R[:, 2] * radius_m), casts_shadow=shadow
    )


def disc(centre: ArrayLike, R_scene_disc: Array, radius_m: float, material: Material) -> Body:
    """Return a disc that faces the z of its frame."""
    return Body(Plate(radius_m, radius_m, round=True), material, pose(R_scene_disc, centre))


def box(centre: ArrayLike, size_m: tuple[float, float, float], material: Material, R_scene_box: Array) -> Body:
    """Return a box that casts a shadow."""
    return Body(Box(*(side / 2 for side in size_m)), material, pose(R_scene_box, centre), casts_shadow=True)


def module_skin(rng: np.random.Generator) -> NDArray[np.uint8]:
    """Return the paint of the module unrolled, front half, with seams, rivets, placards and false targets."""
    width, height = round(MODULE_LENGTH_M * 1e3 / TEXEL_MM), round(2.6 * MODULE_RADIUS_M * 1e3 / TEXEL_MM)
    stains = cv2.GaussianBlur(rng.standard_normal((height // 8, width // 8)).astype(np.float32), (0, 0), 9)
    streaks = cv2.GaussianBlur(rng.standard_normal((height // 8, width // 8)).astype(np.float32), (0, 0), 2, sigmaY=30)
    shade = cv2.resize(1 + 0.5 * stains + 0.16 * streaks, (width, height))
    shade *= _panels(rng, width, height)
    skin = np.clip(np.array(PAINT) * 255 * shade[..., None], 0, 255).astype(np.uint8)
    seam, rivet = (70, 70, 68), (105, 104, 100)
    for x in SEAMS_X_MM:
        _line(skin, (x, -195), (x, 195), seam)
        for y in np.arange(-189, 190, 9.0):
            _dot(skin, (x + 4, y), 1.0, rivet)
            _dot(skin, (x - 4, y), 1.0, rivet)
    for y in SEAMS_Y_MM:
        _line(skin, (-280, y), (280, y), seam)
        for x in np.arange(-276, 277, 12.0):
            _dot(skin, (x, y + 4), 1.0, rivet)
    for at, size, picture in (
        ((-140, 40), 44, empty_square_label()),
        ((140, -36), 40, grid_code(rng)),
        ((143, 42), 36, nested_squares()),
        ((-143, -38), 34, quadrant_target()),
    ):
        _stick(skin, at, size, picture)
    for i in range(8):
        corners = [(232 + 4, -190 + 48 * i), (250, -190 + 48 * i), (250, -166 + 48 * i), (236, -166 + 48 * i)]
        cv2.fillPoly(skin, [_texels(skin, corners)], (30, 28, 12) if i % 2 else (190, 130, 10))
    for at, text, size in (((-78, 92), "RELNAV MODULE 7", 9), ((-270, 132), "NO STEP", 8), ((98, -100), "PORT +Z", 8)):
        _write(skin, at, text, size)
    return skin


def empty_square_label() -> NDArray[np.uint8]:
    """Return a black square on white that is no marker."""
    label = np.full((220, 220, 3), 205, np.uint8)
    label[30:190, 30:190] = 10
    cv2.circle(label, (110, 110), 34, (205, 205, 205), -1)
    return label


def nested_squares() -> NDArray[np.uint8]:
    """Return squares in squares, like a marker's frames without its cells."""
    label = np.full((200, 200, 3), 205, np.uint8)
    for near, value in ((24, 10), (58, 205), (64, 10), (84, 205), (88, 10)):
        label[near : 200 - near, near : 200 - near] = value
    return label


def grid_code(rng: np.random.Generator) -> NDArray[np.uint8]:
    """Return a square code of another family: cells on a 6 x 6 grid in a black border."""
    cells = np.full((10, 10), 205, np.uint8)
    cells[1:9, 1:9] = 10
    cells[2:8, 2:8] = np.where(rng.random((6, 6)) < 0.5, 205, 10)
    return cv2.cvtColor(cv2.resize(cells, (200, 200), interpolation=cv2.INTER_NEAREST), cv2.COLOR_GRAY2RGB)


def quadrant_target() -> NDArray[np.uint8]:
    """Return a photogrammetry target."""
    label = np.full((170, 170, 3), 205, np.uint8)
    cv2.circle(label, (85, 85), 75, (10, 10, 10), -1)
    cv2.ellipse(label, (85, 85), (58, 58), 0, 0, 90, (205, 205, 205), -1)
    cv2.ellipse(label, (85, 85), (58, 58), 0, 180, 270, (205, 205, 205), -1)
    return label


def solar_cells(rows: int, columns: int, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Return cells with bus bars between light gaps, 120 texels a cell."""
    panel = np.zeros((rows * 120, columns * 120, 3), np.float32)
    for row in range(rows):
        for column in range(columns):
            cell = panel[row * 120 : row * 120 + 120, column * 120 : column * 120 + 120]
            cell[:] = np.array([4, 7, 19]) * rng.uniform(0.75, 1.25)
            cell[:, 2::10] *= 1.5
            cell[38:42], cell[78:82] = 48, 48
            cell[:4], cell[-4:], cell[:, :4], cell[:, -4:] = 140, 140, 140, 140
    return panel.clip(0, 255).astype(np.uint8)


def foil(rng: np.random.Generator, size: int = 800) -> tuple[NDArray[np.uint8], Image]:
    """Return the colour and the slopes (size, size, 2) of crumpled golden foil: flat facets of three sizes."""
    slopes = np.zeros((size, size, 2), np.float32)
    for facets, steep in ((60, 0.16), (400, 0.16), (2500, 0.12)):
        seeds = np.full((size, size), 255, np.uint8)
        at = rng.integers(0, size, (facets, 2))
        seeds[at[:, 0], at[:, 1]] = 0
        _, label = cv2.distanceTransformWithLabels(seeds, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
        slopes += rng.normal(0, steep, (label.max() + 1, 2)).astype(np.float32)[label]
    slopes = cv2.GaussianBlur(slopes, (0, 0), 1.2)
    return np.broadcast_to(np.array([92, 62, 16], np.uint8), (size, size, 3)).copy(), slopes


def sky(camera: Camera, rng: np.random.Generator) -> Image:
    """Return the sky behind the target: black, faint stars, and the Earth's limb in a lower corner."""
    sky = np.zeros((camera.height, camera.width, 3), np.float32)
    stars = rng.integers(0, (camera.height, camera.width), (140, 2))
    sky[stars[:, 0], stars[:, 1]] = rng.exponential(0.05, (140, 1)).clip(0, 0.6)
    x, y = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    deep = 2600 - np.hypot(x - 2350, y - 2850)
    octaves = ((40, 0.5), (16, 0.3), (6, 0.2), (2, 0.1))
    noise = [
        cv2.GaussianBlur(rng.standard_normal((360, 640)).astype(np.float32), (0, 0), s) * s * w for s, w in octaves
    ]
    clouds = np.clip(cv2.resize(sum(noise), (camera.width, camera.height)) * 2.2 + 0.15, 0, 1)
    ground = np.array([0.03, 0.065, 0.14]) + clouds[..., None] * np.array([0.16, 0.16, 0.15])
    dusk = np.clip(deep / 500, 0, 1)[..., None]
    air = np.exp(-np.abs(deep) / np.where(deep > 0, 60, 9))[..., None] * np.array([0.06, 0.14, 0.30])
    sky += np.where(deep[..., None] > 0, ground * (0.25 + 0.75 * dusk), 0) + air
    return sky.astype(np.float32)


def _panels(rng: np.random.Generator, width: int, height: int) -> Image:
    """Return the shade of each panel between seams: no two were painted on one day."""
    columns = np.digitize((np.arange(width) - width / 2) * TEXEL_MM, SEAMS_X_MM)
    rows = np.digitize((height / 2 - np.arange(height)) * TEXEL_MM, SEAMS_Y_MM)
    return rng.uniform(0.95, 1.03, (5, 5)).astype(np.float32)[rows[:, None], columns[None, :]]


def _texels(skin: NDArray[np.uint8], points_mm: ArrayLike) -> NDArray[np.int32]:
    rows, columns = skin.shape[:2]
    points = np.asarray(points_mm, float) / TEXEL_MM * [1, -1] + [columns / 2, rows / 2]
    return np.round(points).astype(np.int32)


def _line(skin: NDArray[np.uint8], start: ArrayLike, end: ArrayLike, color: Color) -> None:
    cv2.line(skin, _texels(skin, start).tolist(), _texels(skin, end).tolist(), color, 4, cv2.LINE_AA)


def _dot(skin: NDArray[np.uint8], at: ArrayLike, radius_mm: float, color: Color) -> None:
    cv2.circle(skin, _texels(skin, at).tolist(), round(radius_mm / TEXEL_MM), color, -1, cv2.LINE_AA)


def _stick(skin: NDArray[np.uint8], centre: ArrayLike, size_mm: float, picture: NDArray[np.uint8]) -> None:
    size = round(size_mm / TEXEL_MM)
    column, row = _texels(skin, centre) - size // 2
    skin[row : row + size, column : column + size] = cv2.resize(picture, (size, size), interpolation=cv2.INTER_AREA)


def _write(skin: NDArray[np.uint8], at: ArrayLike, text: str, height_mm: float) -> None:
    scale = height_mm / TEXEL_MM / 22
    cv2.putText(
        skin,
        text,
        _texels(skin, at).tolist(),
        cv2.FONT_HERSHEY_DUPLEX,
        scale,
        (35, 35, 38),
        round(2 * scale),
        cv2.LINE_AA,
    )
