"""The detector on renders with known truth, on the real frames, and on images that are not what they should be."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from astratag import Camera, Cylinder, Detection, Detector, Flat, MarkerSpec, Surface, annotate, load_dictionary
from astratag.geometry import LAYERS, square
from astratag.transforms import difference, exp_so3, pose
from astratag.warp import PoseWarp
from benchmarks.detection.peers import texture
from benchmarks.detection.scenes import CONDITIONS, SIDE_M, LightChange, Scene, covered, draw, glare, shadow
from pipeline.render import render_marker

DICTIONARY = load_dictionary()
CAMERA = Camera([[1000, 0, 639.5], [0, 1000, 359.5], [0, 0, 1]], width=1280, height=720)
CYLINDER = Cylinder(0.15)
FACING = np.diag([1.0, -1.0, -1.0])
TEXTURE = texture("AstraTag", 19, "equal")
TURNED = next(one for one in CONDITIONS if one.name == "turn").scene(75)


def photograph(
    T_cam_marker: np.ndarray, surface: Surface, marker_id: int = 19, seed: int = 0, **kwargs: object
) -> np.ndarray:
    """Return a render through JPEG of quality 90."""
    image = render_marker(
        CAMERA,
        T_cam_marker,
        signature=DICTIONARY.signature(marker_id),
        side_m=0.1,
        surface=surface,
        seed=seed,
        **kwargs,
    )
    return cv2.imdecode(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 90])[1], cv2.IMREAD_GRAYSCALE)


def tumbled(range_m: float, seed: int, tilt_rad: float = 0.25) -> np.ndarray:
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3) * (1, 1, 2)
    R = FACING @ exp_so3(axis / np.linalg.norm(axis) * rng.uniform(0.05, tilt_rad))
    return pose(R, [*(rng.uniform(-0.06, 0.06, 2) * range_m), range_m])


def one(detections: list[Detection]) -> Detection:
    assert [seen.marker_id for seen in detections] == [19]
    return detections[0]


def corner_errors(seen: Detection, T_cam_marker: np.ndarray, surface: Surface) -> list[np.ndarray]:
    """Return the corners' errors (4, 2) of each layer in units of its sigma."""
    warp = PoseWarp(CAMERA, 0.1, surface, T_cam_marker)
    return [(s.corners_px - warp(square(*LAYERS[s.layer].black))) / s.sigma_px for s in seen.layers]


@pytest.mark.parametrize("surface", [Flat(), CYLINDER], ids=["flat", "cylinder"])
def test_pose_and_corners_are_right_and_honest_from_far_to_near(surface: Surface) -> None:
    """From 1.5 m to 6 cm: identity, one detection, position to 0.3 % of range, NEES and corner chi-square near one."""
    detector, nees, squares = Detector(surface=surface), [], []
    ranges = (1.5, 1.2, 0.9, 0.7, 0.5, 0.35, 0.25, 0.08)
    for seed, range_m in enumerate(ranges):
        T = tumbled(range_m, seed)
        seen = one(detector.detect(photograph(T, surface, seed=seed), CAMERA))
        assert seen.method == ("planar" if surface == Flat() else "cylinder")
        error = difference(T, seen.T_cam_marker)
        assert np.linalg.norm(error[:3]) < 0.003 * range_m
        assert np.linalg.norm(error[3:]) < np.radians(2.0 if range_m > 0.5 else 0.5)
        nees.append(error @ np.linalg.solve(seen.covariance, error) / 6)
        squares += [np.mean(e**2) for e in corner_errors(seen, T, surface)]
    assert 0.2 < np.mean(nees) < 3.0
    assert 0.1 < np.mean(squares) < 2.0


def test_the_outer_square_may_be_out_of_view() -> None:
    """At 6 cm only inner layers fit the image: the outer square is predicted and the depth still right."""
    T = pose(FACING @ exp_so3([0.05, -0.1, 0.3]), [0.004, -0.002, 0.06])
    seen = one(Detector(surface=CYLINDER).detect(photograph(T, CYLINDER), CAMERA))
    assert 0 not in {layer.layer for layer in seen.layers} and 2 in {layer.layer for layer in seen.layers}
    assert np.linalg.norm(difference(T, seen.T_cam_marker)[:3]) < 1e-4
    truth = PoseWarp(CAMERA, 0.1, CYLINDER, T)(square(0, 700))
    assert np.abs(seen.corners_px - truth).max() < 2.0
    assert truth.min() < 0


@pytest.mark.parametrize("turn_deg", [0, 45, 90, 137, 180, 270])
def test_corners_come_in_the_markers_own_order_at_any_roll(turn_deg: int) -> None:
    T = pose(FACING @ exp_so3([0.0, 0.0, np.radians(turn_deg)]) @ exp_so3([0.5, 0.0, 0.0]), [0.0, 0.0, 0.6])
    seen = one(Detector().detect(photograph(T, Flat())))
    np.testing.assert_allclose(seen.corners_px, PoseWarp(CAMERA, 0.1, Flat(), T)(square(0, 700)), atol=0.3)
    assert seen.T_cam_marker is None and seen.covariance is None and seen.planar_poses == ()


def test_a_print_on_an_undescribed_cylinder_is_read_and_its_grid_follows_it() -> None:
    """Radius 1.5 sides seen at 45 degrees, surface unknown."""
    T = pose(FACING @ exp_so3([0.8, 0.0, 0.0]), [0.0, 0.0, 0.6])
    seen = one(Detector().detect(photograph(T, CYLINDER)))
    assert seen.method == "cylinder" and seen.surface is None
    span = np.linspace(0, 700, 9)
    truth = PoseWarp(CAMERA, 0.1, CYLINDER, T)(np.stack(np.meshgrid(span, span), axis=-1))
    assert seen.warp_grid_px.shape == (9, 9, 2)
    assert np.sqrt(((seen.warp_grid_px - truth) ** 2).sum(axis=-1).mean()) < 2.0


@pytest.mark.parametrize("azimuth_rad", [0.3, 2.0, 5.0])
def test_a_described_cylinder_is_read_at_50_degrees(azimuth_rad: float) -> None:
    """Too bent to read as flat: a spline and an alignment read it, the declared surface then gives the pose."""
    tilt = np.radians(50.0) * np.array([np.cos(azimuth_rad), np.sin(azimuth_rad), 0.0])
    T = pose(FACING @ exp_so3([0.0, 0.0, 1.0]) @ exp_so3(tilt), [0.0, 0.0, 0.8])
    seen = one(Detector(surface=CYLINDER).detect(photograph(T, CYLINDER), CAMERA))
    error = difference(T, seen.T_cam_marker)
    assert np.linalg.norm(error[:3]) < 2e-3 and np.linalg.norm(error[3:]) < np.radians(0.5)


def hard(px: float, tilt_deg: float, azimuth_rad: float, roll_rad: float = 0.5) -> np.ndarray:
    """Return the pose of a marker ``px`` large on the axis if frontal, tilted about an axis in its plane."""
    tilt = np.radians(tilt_deg) * np.array([np.cos(azimuth_rad), np.sin(azimuth_rad), 0.0])
    return pose(FACING @ exp_so3([0.0, 0.0, roll_rad]) @ exp_so3(tilt), [0.01, -0.005, 100.0 / px])


def assert_seen_right(image: np.ndarray, T_cam_marker: np.ndarray, surface: Surface, known: bool = False) -> None:
    """Assert one marker 19, every corner measured of it within 3 pixels of the truth."""
    seen = one(Detector(surface=surface if known else None).detect(image, CAMERA))
    assert seen.layers
    warp = PoseWarp(CAMERA, 0.1, surface, T_cam_marker)
    for layer in seen.layers:
        assert np.abs(layer.corners_px - warp(square(*LAYERS[layer.layer].black))).max() < 3.0
    if surface == Flat():
        assert np.abs(seen.corners_px - warp(square(0, 700))).max() < 3.0


@pytest.mark.parametrize(
    ("px", "tilt_deg"), [(32, 20.0), (32, 45.0), (160, 75.0), (160, 78.0)], ids=["small", "small leaned", "75", "78"]
)
def test_small_and_slanted_markers_are_read(px: float, tilt_deg: float) -> None:
    for seed, azimuth in enumerate((0.4, 2.2, 4.1)):
        T = hard(px, tilt_deg, azimuth)
        assert_seen_right(photograph(T, Flat(), seed=seed), T, Flat())


@pytest.mark.parametrize("known", [False, True], ids=["unknown", "known"])
@pytest.mark.parametrize("tilt_deg", [50.0, 60.0])
def test_a_cylinder_of_radius_1_5_sides_leaned_is_read(tilt_deg: float, known: bool) -> None:
    for seed, azimuth in enumerate((0.0, np.pi)):
        T = hard(160, tilt_deg, azimuth + np.pi / 2 + CYLINDER.axis_rad, roll_rad=1.1)
        assert_seen_right(photograph(T, CYLINDER, seed=seed), T, CYLINDER, known)


@pytest.mark.parametrize(
    ("condition", "turn_deg", "seed"), [("turn", 60, 6000021), ("turn", 60, 6000076), ("tight", 50, 6000004)]
)
def test_an_inner_layer_that_looks_flat_does_not_make_the_whole_print_flat(
    condition: str, turn_deg: float, seed: int
) -> None:
    """On a cylinder that nobody told of: corners of the outer square were ten pixels off."""
    scene = next(one for one in CONDITIONS if one.name == condition).scene(turn_deg)
    drawn = draw(scene, seed)
    seen = one(Detector(side_m=SIDE_M).detect(drawn.photograph(TEXTURE), drawn.camera))
    warp = PoseWarp(drawn.camera, SIDE_M, drawn.surface, drawn.T_cam_print)
    assert np.abs(seen.corners_px - warp(square(0.0, 700.0))).max() < 3.0


def test_a_contrast_of_15_grey_levels_is_enough() -> None:
    for seed in range(3):
        T = hard(100, 20.0, 1.3 * seed)
        image = render_marker(CAMERA, T, signature=DICTIONARY.signature(19), side_m=0.1, surface=Flat(), seed=seed)
        faint = 100 + (image.astype(float) - 128) * (15 / 181)
        faint += np.random.default_rng(seed).normal(size=faint.shape)
        assert_seen_right(np.clip(np.round(faint), 0, 255).astype(np.uint8), T, Flat())


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("change", [glare(0.2), shadow(0.33), shadow(0.5)], ids=["glare", "shadow", "half in shadow"])
def test_uneven_light_is_read_through_and_no_corner_is_further_off_than_it_says(change: LightChange, seed: int) -> None:
    drawn = draw(Scene(side_px=120, change=change), 100 + 2 * seed)
    image = drawn.photograph(TEXTURE)
    seen = one(Detector(side_m=SIDE_M, surface=Flat()).detect(image, drawn.camera))
    warp = PoseWarp(drawn.camera, SIDE_M, Flat(), drawn.T_cam_print)
    assert np.abs(seen.corners_px - warp(square(0.0, 700.0))).max() < 1.0
    for layer in seen.layers:
        assert np.abs(layer.corners_px - warp(square(*LAYERS[layer.layer].black))).max() < 4 * layer.sigma_px


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("surface", [Flat(), None], ids=["flat", "unknown"])
def test_the_edge_of_a_covering_is_not_taken_for_the_markers(surface: Surface | None, seed: int) -> None:
    """A strip ends two pixels from an inner square's side: only what is in view is measured, the rest predicted."""
    drawn = draw(Scene(side_px=160, change=covered(0.3)), 200 + seed)
    seen = one(Detector(side_m=SIDE_M, surface=surface).detect(drawn.photograph(TEXTURE), drawn.camera))
    warp = PoseWarp(drawn.camera, SIDE_M, Flat(), drawn.T_cam_print)
    assert [layer.layer for layer in seen.layers] == [2]
    assert np.abs(seen.corners_px - warp(square(0.0, 700.0))).max() < 0.5
    assert np.abs(seen.layers[0].corners_px - warp(square(*LAYERS[2].black))).max() < 4 * seen.layers[0].sigma_px


@pytest.mark.parametrize("seed", [9236068, 9236075, 9236120])
def test_a_print_turned_far_round_a_cylinder_is_found_by_its_near_side(seed: int) -> None:
    """By 75 degrees: its far side is hidden, and the nearest of coarse turns is not near enough to read it."""
    drawn = draw(TURNED, seed)
    seen = one(Detector(side_m=SIDE_M).detect(drawn.photograph(TEXTURE), drawn.camera))
    assert seen.marker_id == 19


@pytest.mark.parametrize("blur_px", [3.5, 4.5])
def test_strong_blur_is_read_as_blurred(blur_px: float) -> None:
    seen = [Detector(side_m=SIDE_M).detect(draw(Scene(blur_px=blur_px), seed).photograph(TEXTURE)) for seed in range(4)]
    assert sum([s.marker_id for s in found] == [19] for found in seen) >= 3


def test_with_one_side_covered_nothing_is_reported_wrong() -> None:
    """A fifth to a third of the print hidden: an inner square is then read, and taken for what it is."""
    for seed, edge in enumerate((150.0, 210.0, 230.0)):
        T = hard(140, 15.0, 2.0 * seed)
        image = photograph(T, Flat(), seed=seed)
        cover = np.array([(-100.0, -100.0), (edge, -100.0), (edge, 800.0), (-100.0, 800.0)])
        cover_px = PoseWarp(CAMERA, 0.1, Flat(), T)(cover)
        cv2.fillConvexPoly(image, np.round(cover_px).astype(np.int32), 60 + 60 * seed)
        seen = one(Detector(surface=Flat()).detect(image, CAMERA))
        warp = PoseWarp(CAMERA, 0.1, Flat(), T)
        for layer in seen.layers:
            assert np.abs(layer.corners_px - warp(square(*LAYERS[layer.layer].black))).max() < 3.0
        assert abs(difference(T, seen.T_cam_marker)[2]) < 0.06 * T[2, 3]


def test_two_prints_of_one_identity_are_two_detections() -> None:
    left, right = (photograph(pose(FACING, [x, 0.0, 0.8]), Flat()) for x in (-0.15, 0.15))
    both = np.hstack([left[:, :640], right[:, 640:]])
    found = Detector(surface=Flat()).detect(both, CAMERA)
    assert [seen.marker_id for seen in found] == [19, 19]
    x = sorted(seen.T_cam_marker[0, 3] for seen in found)
    np.testing.assert_allclose(x, [-0.15, 0.15], atol=1e-3)


def test_each_marker_has_the_side_and_surface_it_was_listed_with() -> None:
    T = tumbled(0.6, seed=3)
    detector = Detector(side_m=0.5, markers={19: MarkerSpec(side_m=0.1, surface=CYLINDER)})
    seen = one(detector.detect(photograph(T, CYLINDER), CAMERA))
    assert seen.method == "cylinder"
    assert np.linalg.norm(difference(T, seen.T_cam_marker)[:3]) < 1e-3


def test_linear_light_needs_to_be_told() -> None:
    T = tumbled(0.8, seed=5)
    image = photograph(T, Flat(), encoding="linear")
    told, untold = (
        one(Detector(surface=Flat(), transfer=transfer).detect(image, CAMERA)) for transfer in ("linear", "srgb")
    )
    errors = [np.abs(difference(T, seen.T_cam_marker)[2]) for seen in (told, untold)]
    assert errors[0] < 5e-4 < errors[1]


def test_the_same_image_gives_the_same_detection() -> None:
    image = photograph(tumbled(0.5, seed=2), CYLINDER)
    detector = Detector(surface=CYLINDER)
    first, second = one(detector.detect(image, CAMERA)), one(Detector(surface=CYLINDER).detect(image, CAMERA))
    np.testing.assert_array_equal(first.T_cam_marker, second.T_cam_marker)
    np.testing.assert_array_equal(first.corners_px, second.corners_px)


@pytest.mark.parametrize("seed", [0, 1])
def test_images_without_a_marker_give_none_and_do_not_raise(seed: int) -> None:
    rng = np.random.default_rng(seed)
    noise = rng.integers(0, 256, (240, 320), dtype=np.uint8)
    blobs = ((cv2.GaussianBlur(noise, (0, 0), 3.0) > 127) * 255).astype(np.uint8)
    board = ((np.indices((240, 320)) // 20).sum(axis=0) % 2 * 255).astype(np.uint8)
    camera = Camera([[300, 0, 160], [0, 300, 120], [0, 0, 1]], width=320, height=240)
    for image in (noise, blobs, board, np.zeros((240, 320), np.uint8), np.full((9, 9), 255, np.uint8)):
        for detector in (Detector(), Detector(surface=CYLINDER)):
            assert detector.detect(image, camera if image.shape == (240, 320) else None) == []


@pytest.mark.parametrize(
    ("image", "camera", "message"),
    [
        (np.zeros((720, 1280)), None, "uint8"),
        (np.zeros((720, 1280, 4), np.uint8), None, "shape"),
        (np.zeros((0, 0), np.uint8), None, "shape"),
        (None, None, "NoneType"),
        (np.zeros((480, 640), np.uint8), CAMERA, "1280x720"),
    ],
)
def test_what_is_not_an_image_is_refused_with_a_reason(image: np.ndarray, camera: Camera | None, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Detector().detect(image, camera)


def test_impossible_detectors_are_refused() -> None:
    with pytest.raises(ValueError, match="side_m"):
        Detector(side_m=0.0)
    with pytest.raises(ValueError, match="marker 77"):
        Detector(markers={77: MarkerSpec(0.1)})
    with pytest.raises(ValueError, match="transfer"):
        Detector(transfer="gamma")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="false_accept_rate"):
        Detector(false_accept_rate=0.0)
    with pytest.raises(ValueError, match="tau_hamming"):
        Detector(tau_hamming=48)


def test_the_papers_hard_thresholds_decide_instead_of_correlation() -> None:
    """Under noise that makes a few cells wrong, none may be with a threshold of 0."""
    drawn = draw(Scene(side_px=80, blur_px=1.5), 7)
    image = drawn.photograph(TEXTURE)
    wrong = one(Detector().detect(image)).hamming
    assert wrong > 0
    assert one(Detector(tau_hamming=wrong).detect(image)).hamming <= wrong
    assert Detector(tau_hamming=0).detect(image) == []


REAL_LAYERS = {"0000": 0, "0043": 0, "0056": 1, "0083": 0, "0086": 0}
"""The outermost layer that is whole in each real frame; 0056 cuts the outer square."""


@pytest.mark.parametrize("name", REAL_LAYERS)
def test_real_frames_read_as_marker_19_with_the_right_layers(shared: Path, name: str) -> None:
    image = cv2.imread(str(shared / "reference" / "frames" / f"frame_{name}.png"))
    seen = one(Detector().detect(image))
    assert min(layer.layer for layer in seen.layers) == REAL_LAYERS[name]
    picture = annotate(image, [seen])
    assert picture.shape == image.shape and (picture != image).any()


def test_the_frame_of_a_marker_too_faint_gives_nothing_false(shared: Path) -> None:
    image = cv2.imread(str(shared / "reference" / "frames" / "frame_0098.png"))
    assert all(seen.marker_id == 19 for seen in Detector().detect(image))
