"""Proposals against shapes drawn with known corners, and the bounds on what any one image may cost, in counts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import ModuleType

import cv2
import numpy as np
import pytest

import astratag.confirm
import astratag.detector
from astratag import Camera, Detector, Flat, load_dictionary
from astratag.binarise import sums_of, threshold_blocks, threshold_enlarged, traced
from astratag.candidates import Candidate
from astratag.codes import Reading
from astratag.describe import outer_corners
from astratag.detector import MAX_MATCHED, _seconded
from astratag.effort import BETTER, COST, LEAST_UNITS, MOST_UNITS, UNITS_A_PIXEL, Effort, Tries, first_distinct
from astratag.geometry import LAYERS, TEMPLATE_UNITS, square
from astratag.search import (
    BLOCK_PX,
    BROAD,
    COARSE,
    FAINT,
    FINE_PX,
    MAX_CONTOURS,
    NARROW,
    PLAIN,
    POLYGON_TOLERANCES,
    SLANTED,
    STEEP,
    THIN,
    TINY,
    bent_quads_of,
    find_outlines,
    quads_of,
    scaled,
)
from astratag.simplify import hull, simplified
from astratag.transforms import exp_so3, pose
from astratag.view import MAX_ALIGNED, MAX_BY_EDGES, MAX_CURVED
from astratag.warp import HomographyWarp, PoseWarp
from pipeline.render import render_marker

HEIGHT, WIDTH = 240, 320
MOST_AT_ONCE = max(COST.curved, COST.matched)
"""Units that what is begun last may cost beyond what an image is worth."""
EVERY_BINARISATION = (COARSE, NARROW, PLAIN, FAINT, TINY, BROAD, SLANTED, THIN, STEEP)


def drawn(*outlines: np.ndarray) -> np.ndarray:
    """Return a white picture with filled dark outlines (N, 2), drawn eight times finer and averaged."""
    fine = np.full((8 * HEIGHT, 8 * WIDTH), 220, np.uint8)
    for outline in outlines:
        cv2.fillPoly(fine, [np.round(8 * outline + 3.5).astype(np.int32)], 30)
    return cv2.resize(fine, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)


def turned_square(seed: int) -> np.ndarray:
    """Return a square (4, 2) seen at a slant."""
    rng = np.random.default_rng(seed)
    angle, side, squeeze = rng.uniform(0, 2 * np.pi), rng.uniform(40, 110), rng.uniform(0.4, 1.0)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    corners = square(-0.5, 0.5) * side * (1.0, squeeze)
    return corners @ turn.T + rng.uniform(-10, 10, 2) + (WIDTH / 2, HEIGHT / 2)


def nearest(quads: np.ndarray, corners: np.ndarray) -> tuple[int, int, float]:
    """Return which quad (Q, 4, 2), begun at which corner, comes nearest to corners (4, 2), and how near, in pixels."""
    apart = [[np.linalg.norm(np.roll(quad, -k, axis=0) - corners, axis=1).max() for k in range(4)] for quad in quads]
    quad, start = np.unravel_index(np.argmin(apart), (len(quads), 4))
    return int(quad), int(start), float(np.min(apart))


@pytest.mark.parametrize("how", [COARSE, PLAIN], ids=["coarse", "plain"])
@pytest.mark.parametrize("whole", [True, False], ids=["whole", "all"])
def test_a_dark_square_is_proposed_to_two_pixels_of_the_resolution_worked_at(how, whole):
    for seed in range(12):
        corners = turned_square(seed)
        assert nearest(quads_of(find_outlines(drawn(corners), how), whole=whole), corners)[2] < 2.0 / how.scale


def test_a_square_with_a_notch_is_proposed_by_its_hull():
    corners = turned_square(3)
    notch = corners.mean(axis=0)
    notched = np.insert(
        corners, 1, [0.6 * corners[0] + 0.4 * corners[1], notch, 0.4 * corners[0] + 0.6 * corners[1]], 0
    )
    outlines = find_outlines(drawn(notched))
    assert nearest(quads_of(outlines), corners)[2] < 2.0
    assert len(quads_of(outlines, whole=True)) == 0


@pytest.mark.parametrize(
    "corners", [[(152, 178), (58, 76), (61, 36), (191, 175)], [(119, 63), (140, 26), (202, 205), (164, 193)]]
)
def test_a_skinny_square_keeps_its_corners(corners):
    """Seen at 80 degrees: its short sides are hardly longer than what a square-on outline is simplified by."""
    assert nearest(quads_of(find_outlines(drawn(np.array(corners, float)))), np.array(corners, float))[2] < 4.0


@pytest.mark.parametrize("cut", [(8.0, 120.0), (160.0, 6.0), (311.0, 120.0)], ids=["left", "top", "right"])
def test_a_corner_beyond_the_border_is_where_its_sides_meet(cut):
    outwards = np.sign(np.array(cut) - (WIDTH / 2, HEIGHT / 2))
    corners = np.array(cut) + 14 * outwards + 24 * (np.array([(0, -1), (1, 0), (0, 1), (-1, 0)]) - outwards)
    beyond = (corners < 0).any(axis=1) | (corners > (WIDTH, HEIGHT)).any(axis=1)
    assert beyond.sum() == 1
    assert nearest(quads_of(find_outlines(drawn(corners))), corners)[2] < 3.0


def test_only_the_largest_steps_are_worth_a_fine_look():
    image = np.full((720, 1280), 120, np.uint8)
    image[::32, ::32] = 150
    image[300:314, 700:714] = 10
    enlarged = scaled(image, 2.0)
    assert enlarged.gray is image and enlarged.enlarged == 2
    assert enlarged.worth is not None and enlarged.worth.shape == (45, 80)
    assert enlarged.worth.sum() * BLOCK_PX**2 <= FINE_PX
    assert enlarged.worth[300 // BLOCK_PX : 314 // BLOCK_PX + 1, 700 // BLOCK_PX : 714 // BLOCK_PX + 1].all()


@pytest.mark.parametrize("holes", [True, False])
@pytest.mark.parametrize("how", [TINY, SLANTED, STEEP, THIN], ids=["tiny", "slanted", "steep", "thin"])
def test_blocks_are_told_apart_as_by_opencv(how, holes):
    rng = np.random.default_rng(0)
    gray = cv2.resize(rng.integers(0, 256, (60, 83), dtype=np.uint8), (333, 250), interpolation=cv2.INTER_CUBIC)
    worth = rng.random((8, 11)) < 0.5
    kind, offset = (cv2.THRESH_BINARY, -how.offset) if holes else (cv2.THRESH_BINARY_INV, how.offset)
    whole = cv2.adaptiveThreshold(gray, 255, cv2.ADAPTIVE_THRESH_MEAN_C, kind, how.window_px, offset)
    inside = np.kron(worth, np.ones((32, 32), dtype=bool))[: len(gray), : gray.shape[1]]
    shapes, changes = threshold_blocks(gray, sums_of(gray), worth, 32, how.window_px, how.offset, holes)
    expected = np.where(inside, whole // 255, 0)
    np.testing.assert_array_equal(shapes[1:251, 1:334], expected)
    assert shapes.sum() == expected.sum()
    assert changes == 4 * np.abs(np.diff(expected[3::4].astype(int), axis=1)).sum()


@pytest.mark.parametrize("holes", [True, False])
@pytest.mark.parametrize("window_px", [5, 11, 15])
def test_what_is_told_apart_enlarged_is_what_stands_out_enlarged(window_px, holes):
    """As by OpenCV's resizing of how far every pixel is above the mean around it."""
    rng = np.random.default_rng(0)
    gray = cv2.resize(rng.integers(0, 256, (40, 50), dtype=np.uint8), (133, 90), interpolation=cv2.INTER_CUBIC)
    worth = rng.random((6, 9)) < 0.5
    near = cv2.dilate(worth.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    area, offset = window_px**2, 7
    total = cv2.boxFilter(gray, cv2.CV_64F, (window_px,) * 2, normalize=False, borderType=cv2.BORDER_REPLICATE)
    stands_out = cv2.resize(gray * float(area) - total, None, fx=2, fy=2, interpolation=cv2.INTER_LINEAR)
    inside = np.kron(worth, np.ones((32, 32), dtype=bool))[: len(stands_out), : stands_out.shape[1]]
    expected = inside & (stands_out > offset * area if holes else -stands_out > offset * area)
    shapes, changes = threshold_enlarged(gray, sums_of(gray), worth, near, 16, window_px, offset, holes)
    written = np.kron(near, np.ones((32, 32), dtype=bool))[:180, :266]
    np.testing.assert_array_equal(shapes[1:181, 1:267] * written, expected)
    assert expected.any() and not any(edge.any() for edge in (shapes[0], shapes[181], shapes[:, 0], shapes[:, 267:]))
    assert 0 < changes <= 4 * np.abs(np.diff(expected[2::4].astype(int), axis=1)).sum()


@pytest.mark.parametrize("everywhere", [True, False], ids=["everywhere", "blocks"])
@pytest.mark.parametrize("kind", ["noise", "blobs", "board", "JPEG", "squares"])
def test_borders_are_followed_as_by_opencv(kind, everywhere):
    gray, block_px, share = adversarial(kind), WIDTH if everywhere else 32, 1.0 if everywhere else 0.5
    worth = np.random.default_rng(0).random((-(-HEIGHT // block_px), -(-WIDTH // block_px))) < share
    shapes, _ = threshold_blocks(gray, sums_of(gray), worth, block_px, 7, 7, False)
    borders = cv2.findContours(shapes[1 : HEIGHT + 1, 1 : WIDTH + 1].copy(), cv2.RETR_LIST, cv2.CHAIN_APPROX_SIMPLE)[0]
    long = [one for one in borders if len(one) >= 4 and cv2.arcLength(one, True) > 23.99]
    points, starts, areas, perimeters, _ = traced(shapes, worth, block_px, 24.0)
    assert len(long) == len(areas) > 0
    for one, start, end, area, perimeter in zip(long[::-1], starts, starts[1:], areas, perimeters, strict=False):
        np.testing.assert_array_equal(points[start:end], one[:, 0])
        assert area == -cv2.contourArea(one, oriented=True)
        assert perimeter == pytest.approx(cv2.arcLength(one, True), rel=1e-5)


def test_contours_simplify_as_by_opencv():
    """All but a few, where two points are as far away and one or the other is kept."""
    outlines = find_outlines(adversarial("blobs")).contours
    alike = [
        np.array_equal(
            simplified(contour, t * length, len(contour)),
            cv2.approxPolyDP(contour.astype(np.int32)[:, None], t * length, True)[:, 0],
        )
        for length, contour in zip(outlines.perimeters, map(outlines.contour, range(outlines.count)), strict=True)
        for t in POLYGON_TOLERANCES
    ]
    assert len(alike) > 100 and np.mean(alike) > 0.99


def test_hulls_against_opencv():
    rng = np.random.default_rng(0)
    for _ in range(100):
        points = np.round(rng.normal(0, rng.uniform(1, 20), (rng.integers(3, 60), 2)))
        around = cv2.convexHull(points.astype(np.int32))[:, 0]
        assert sorted(map(tuple, hull(points))) == sorted(map(tuple, around))


def test_bulges_against_the_parabolas_drawn():
    along = np.linspace(0.0, 1.0, 40, endpoint=False)[:, None]
    for seed in range(12):
        corners = turned_square(seed)
        ahead = np.roll(corners, -1, axis=0) - corners
        outward = np.stack([ahead[:, 1], -ahead[:, 0]], axis=1) / np.linalg.norm(ahead, axis=1, keepdims=True)
        height = np.random.default_rng(seed).uniform(-5, 8, 4)
        bulge = height[:, None, None] * (4 * along * (1 - along)) * outward[:, None]
        sides = corners[:, None] + along * ahead[:, None] + bulge
        bent = bent_quads_of(find_outlines(drawn(sides.reshape(-1, 2))))
        quad, start, apart_px = nearest(bent.corners_px, corners)
        assert apart_px < 4.0
        bulges = np.roll(bent.bulges_px[quad], -start, axis=0)
        assert np.abs((bulges * outward).sum(axis=1) - height).max() < 2.5


def test_distinct_squares_against_one_by_one():
    rng = np.random.default_rng(0)
    squares = np.array([turned_square(seed) for seed in range(5)])
    quads = squares[rng.integers(0, 5, 60)] + rng.uniform(-0.3, 0.3, (60, 1, 2))
    for most in (0, 2, 20):
        kept = first_distinct(quads, squares[:1], most)
        assert len(kept) == min(most, 4)
        for i, quad in enumerate(kept):
            assert all(np.abs(quad - other).max() > 1.0 for other in [squares[0], *kept[:i]])


def test_a_square_is_tried_again_only_if_it_reads_better_and_never_more_than_so_many():
    corners = turned_square(0)
    warp = HomographyWarp.from_points(square(0.0, TEMPLATE_UNITS), corners)
    first = Candidate(Reading(3, 0, 0.7, 2), corners, warp)
    tries = Tries(3)
    assert tries.take(first) and not tries.take(first)
    assert not tries.take(replace(first, corners_px=corners + 0.1))
    assert not tries.take(replace(first, reading=Reading(3, 0, 0.7 + 0.9 * BETTER, 2)))
    assert tries.take(replace(first, reading=Reading(3, 0, 0.7 + 1.1 * BETTER, 2)))
    assert tries.take(replace(first, reading=Reading(4, 0, 0.6, 2)))
    assert not tries.take(replace(first, corners_px=corners + 50.0))
    assert len(tries.made) == 3
    tries.succeed()  # a marker does not count
    assert tries.take(replace(first, corners_px=corners + 50.0))


def test_a_bent_square_is_seconded_by_another_layer_that_reads_the_same():
    """About the same place, of another size, and bent; not by itself, nor by what reads otherwise or lies elsewhere."""
    corners = turned_square(0)
    warp = HomographyWarp.from_points(square(0.0, TEMPLATE_UNITS), corners)
    inner = Candidate(Reading(3, 0, 0.5, 9), corners, warp, bent=True)
    outer = replace(inner, corners_px=corners.mean(axis=0) + 2.3 * (corners - corners.mean(axis=0)))
    view = Detector().view(np.zeros((HEIGHT, WIDTH), np.uint8), None)
    view.later.append(inner)
    assert not _seconded(view, inner)
    assert _seconded(view, outer)
    assert not _seconded(view, replace(outer, reading=Reading(4, 0, 0.5, 9)))
    assert not _seconded(view, replace(outer, corners_px=outer.corners_px + 200.0))
    assert not _seconded(view, replace(outer, bent=False))
    view.later.clear()
    view.curved.take(outer)  # and came to nothing
    assert _seconded(view, inner)


def adversarial(kind: str) -> np.ndarray:
    """Return a picture with as much to look at as can be, and no marker."""
    rng = np.random.default_rng(len(kind))
    noise = rng.integers(0, 256, (HEIGHT, WIDTH), dtype=np.uint8)
    if kind == "noise":
        return noise
    if kind == "blobs":
        return ((cv2.GaussianBlur(noise, (0, 0), 2.0) > 127) * 255).astype(np.uint8)
    if kind == "board":
        return ((np.indices(noise.shape) // 8).sum(axis=0) % 2 * 255).astype(np.uint8)
    if kind == "JPEG":
        small = cv2.imdecode(cv2.imencode(".jpg", noise[::4, ::4], [cv2.IMWRITE_JPEG_QUALITY, 10])[1], 0)
        return cv2.resize(small, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
    image = np.full_like(noise, 220)  # squares, with borders like a marker's and nonsense inside
    for y in range(4, HEIGHT - 30, 32):
        for x in range(4, WIDTH - 30, 32):
            image[y : y + 24, x : x + 24] = 20
            image[y + 3 : y + 21, x + 3 : x + 21] = np.kron(rng.random((6, 6)) < 0.4, np.ones((3, 3))) * 200 + 20
    return cv2.GaussianBlur(image, (0, 0), 0.7)


def counting(counts: dict[str, int], name: str, module: ModuleType) -> Callable:
    """Return a function of the detector's modules that counts its calls."""
    function = getattr(module, name)

    def counted(*args, **options):
        counts[name] += 1
        return function(*args, **options)

    return counted


@pytest.mark.parametrize("surface", [None, Flat()], ids=["unknown", "flat"])
@pytest.mark.parametrize("kind", ["noise", "blobs", "board", "JPEG", "squares"])
def test_no_image_is_looked_at_closely_more_often_than_bounded(kind, surface, monkeypatch):
    """Counts, not clocks: the bounds hold over all ways of telling ink from paper together."""
    used_in = {"find_outlines": astratag.detector, "match": astratag.confirm, "grow": astratag.confirm}
    counts = dict.fromkeys(used_in, 0)
    for name, module in used_in.items():
        monkeypatch.setattr(module, name, counting(counts, name, module))
    detector = Detector(surface=surface)
    view = detector.view(
        adversarial(kind), Camera([[300, 0, 160], [0, 300, 120], [0, 0, 1]], width=WIDTH, height=HEIGHT)
    )
    assert detector.find(view) == []
    assert view.effort.spent <= view.effort.most + MOST_AT_ONCE
    assert len(view.by_edges.made) <= MAX_BY_EDGES and len(view.aligned.made) <= MAX_ALIGNED
    assert len(view.curved.made) <= MAX_CURVED
    assert counts["match"] <= MAX_MATCHED and counts["find_outlines"] <= len(EVERY_BINARISATION)
    assert counts["grow"] <= len(LAYERS) * (MAX_BY_EDGES + MAX_ALIGNED)


@pytest.mark.parametrize("kind", ["noise", "blobs", "board", "JPEG", "squares"])
def test_what_is_done_ends_with_the_effort_an_image_is_worth(kind, monkeypatch):
    """Whatever is left to do: costly calls are paid for, so that their number falls with the effort."""
    detector = Detector()
    camera = Camera([[300, 0, 160], [0, 300, 120], [0, 0, 1]], width=WIDTH, height=HEIGHT)
    calls = []
    for most in (0.0, 5_000.0, 20_000.0):
        counts = dict.fromkeys(("find_outlines", "rough_matches", "curved_candidates"), 0)
        with monkeypatch.context() as patch:
            for name in counts:
                patch.setattr(astratag.detector, name, counting(counts, name, astratag.detector))
            view = detector.view(adversarial(kind), camera)
            view.effort.most = most
            assert detector.find(view) == []
        assert view.effort.spent <= most + MOST_AT_ONCE * (most > 0)  # what was begun is ended
        calls.append(counts)
    assert calls[0]["find_outlines"] == calls[0]["curved_candidates"] == 0
    assert calls[0]["find_outlines"] <= calls[1]["find_outlines"] <= calls[2]["find_outlines"]


@pytest.mark.parametrize("size", [(320, 240), (640, 480), (1280, 720)])
@pytest.mark.parametrize("kind", ["noise", "blobs", "board", "JPEG", "squares"])
def test_no_image_of_any_size_is_worth_more_than_so_many_units(kind, size):
    image = np.tile(adversarial(kind), (3, 4))[: size[1], : size[0]]
    detector = Detector()
    view = detector.view(image, None)
    assert detector.find(view) == []
    assert view.effort.spent <= view.effort.most + MOST_AT_ONCE
    assert view.effort.most <= min(LEAST_UNITS + UNITS_A_PIXEL * image.size, MOST_UNITS)


def test_effort_is_never_overspent_but_by_what_was_begun():
    effort = Effort(1000)
    assert effort.spend(effort.most - 1) and not effort.spend(2.0)
    assert effort.begin(2.0) and effort.spent == effort.most + 1 and not effort.begin(2.0)
    assert effort.afford(5.0, 3) == 0
    effort = Effort(1000)
    assert effort.spend(effort.most) and not effort.spend(1.0)
    assert effort.afford(5.0, 3) == 0
    effort = Effort(1000)
    assert effort.afford(effort.most / 2.5, 7) == 2
    assert effort.spent == pytest.approx(effort.most / 1.25)


def test_noise_has_no_outlines_where_every_pixel_counts():
    noise = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH), dtype=np.uint8)
    assert all(find_outlines(noise, how).contours.count == 0 for how in (NARROW, TINY, SLANTED, STEEP))
    assert find_outlines(noise, PLAIN).contours.count <= MAX_CONTOURS


def close_up(range_m: float, roll_rad: float) -> tuple[np.ndarray, Camera, np.ndarray]:
    """Return a marker's picture by a small wide camera, the camera, and the marker's pose."""
    camera = Camera([[290, 0, 159.5], [0, 290, 119.5], [0, 0, 1]], width=WIDTH, height=HEIGHT)
    T = pose(np.diag([1.0, -1.0, -1.0]) @ exp_so3([0.0, 0.0, roll_rad]) @ exp_so3([0.2, 0.1, 0.0]), [0, 0, range_m])
    signature = load_dictionary().signature(7)
    return render_marker(camera, T, signature=signature, side_m=0.1, surface=Flat(), seed=1), camera, T


def test_a_plain_marker_costs_one_look():
    """Its inner squares read as well as its outer one, and are not looked at once that is a marker."""
    image, camera, _ = close_up(0.3, 0.4)
    detector = Detector(surface=Flat())
    view = detector.view(image, camera)
    assert [seen.marker_id for seen in detector.find(view)] == [7]
    assert len(view.by_edges.made) == 1 and not view.aligned.made


def test_the_innermost_square_is_read_with_a_corner_cut():
    """At 3 cm only the innermost square is in view, and at this roll the image's border cuts off a corner."""
    image, camera, T = close_up(0.03, np.pi / 4)
    innermost = PoseWarp(camera, 0.1, Flat(), T)(square(*LAYERS[2].black))
    assert (innermost < 0).any()
    (seen,) = Detector(surface=Flat()).detect(image, camera)
    assert seen.marker_id == 7
    np.testing.assert_allclose(seen.T_cam_marker, T, atol=2e-3)


def test_a_corner_behind_the_camera_is_where_the_lines_of_its_sides_meet():
    _, camera, _ = close_up(0.03, np.pi / 4)
    T = pose(np.diag([1.0, -1.0, -1.0]) @ exp_so3([0.0, 0.0, 0.8]) @ exp_so3([0.8, 0.0, 0.0]), [0.0, 0.0, 0.03])
    corners = T[:3, :3] @ np.array([(-0.05, 0.05, 0), (0.05, 0.05, 0), (0.05, -0.05, 0), (-0.05, -0.05, 0)]).T
    x, y, depth = camera.K @ (corners + T[:3, 3:])
    assert (depth < 0).any() and (depth > 0).any()
    found = outer_corners(PoseWarp(camera, 0.1, Flat(), T))
    np.testing.assert_allclose(found, np.stack([x, y], axis=1) / depth[:, None], rtol=1e-3, atol=0.1)
