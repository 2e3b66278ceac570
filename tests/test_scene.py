"""Bodies stand where geometry puts them: against the marker renderer, against closed forms, and in the sun's shadow."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from astratag.camera import Camera
from astratag.dictionary import load_dictionary
from astratag.surface import Cylinder
from astratag.transforms import exp_so3, pose
from pipeline.bodies import Body, Box, Material, Plate, Print, Tube
from pipeline.render import lay_print, ray_lattice
from pipeline.scenario import FACING
from pipeline.scene import Scene, Sun, exposure_order
from pipeline.texture import print_texture

CAMERA = Camera([[400.0, 0.0, 158.0], [0.0, 402.0, 121.0], [0.0, 0.0, 1.0]], (-0.1, 0.05, 0, 0), width=320, height=240)
BLACK_SKY = np.zeros((240, 320, 3), np.float32)
SIGNATURE = load_dictionary("astratag20").signature(7)
EVENLY = Sun(np.array([0.0, 0.0, -1.0]), irradiance=0.0, ambient=(1.0, 1.0, 1.0))
MATT = Material((0.5, 0.5, 0.5), gloss=0.0)


@pytest.mark.parametrize("range_m", [0.4, 0.15, 0.06])
def test_a_print_on_a_tube_agrees_with_the_marker_renderer(range_m: float) -> None:
    T_cam_marker = pose(exp_so3([0.2, -0.3, 0.1]) @ FACING, [0.004, -0.003, range_m])
    texture = print_texture(SIGNATURE, 0.1)
    skin = Material((0.3, 0.3, 0.3), marker=Print(texture, texture.width_m / 2))
    scene = Scene([Body(Tube(0.15, 5.0), skin, np.eye(4))], EVENLY, BLACK_SKY)
    seen = scene.light(CAMERA, [T_cam_marker] * 5)[..., 1]
    behind = np.full(seen.shape, 0.3, np.float32)
    expected = lay_print(behind, CAMERA, T_cam_marker, signature=SIGNATURE, side_m=0.1, surface=Cylinder(0.15))
    on_tube = cv2.erode((seen > 0.01).astype(np.uint8), np.ones((9, 9))) > 0
    difference = cv2.GaussianBlur(seen - expected, (0, 0), 1.0)[on_tube]
    assert on_tube.mean() > 0.5
    assert np.abs(difference).max() < 0.03
    assert abs(difference.mean()) < 1e-3


lengths = st.floats(0.02, 0.5)
angles = st.tuples(*[st.floats(-1.0, 1.0)] * 3)


@given(radius_m=lengths, half_length_m=lengths, taper=st.floats(-0.4, 0.4), turn=angles)
def test_rays_meet_tubes_on_their_outside(radius_m: float, half_length_m: float, taper: float, turn: tuple) -> None:
    tube = Tube(radius_m, half_length_m, taper)
    R = exp_so3(turn)
    origin = tuple((R @ [0.1, 0.3, 3.0]).tolist())
    x, y = np.meshgrid(np.linspace(-0.2, 0.2, 25), np.linspace(-0.2, 0.2, 25))
    direction = tuple(R[k, 0] * x + R[k, 1] * y - R[k, 2] for k in range(3))
    with np.errstate(invalid="ignore", divide="ignore"):
        hit = tube.hit(origin, direction)
    px, py, pz = (o + hit.depth[hit.seen] * d[hit.seen] for o, d in zip(origin, direction, strict=True))
    assert np.allclose(np.hypot(py, pz + radius_m), radius_m + taper * px, atol=1e-9)
    assert (np.abs(px) <= half_length_m).all()
    normal = [np.broadcast_to(n, hit.seen.shape)[hit.seen] for n in hit.normal]
    assert np.allclose(sum(n * n for n in normal), 1)


@given(size=st.tuples(lengths, lengths, lengths), turn=angles)
def test_rays_meet_boxes_on_their_sides(size: tuple[float, float, float], turn: tuple) -> None:
    R = exp_so3(turn)
    origin = tuple((R @ [0.1, 0.3, 3.0]).tolist())
    x, y = np.meshgrid(np.linspace(-0.2, 0.2, 25) - 0.1 / 3, np.linspace(-0.2, 0.2, 25) - 0.3 / 3)
    direction = tuple(R[k, 0] * x + R[k, 1] * y - R[k, 2] for k in range(3))
    hit = Box(*size).hit(origin, direction)
    assert hit.seen.any()
    inside = np.stack([o + hit.depth * d for o, d in zip(origin, direction, strict=True)], axis=-1)[hit.seen]
    normal = np.stack(hit.normal, axis=-1)[hit.seen]
    assert np.allclose(np.abs(normal).sum(axis=-1), 1)
    assert (np.abs(inside) <= np.array(size) + 1e-9).all()
    assert np.allclose((inside * normal).sum(axis=-1), (np.array(size) * np.abs(normal)).sum(axis=-1))


def test_a_shadow_falls_away_from_the_sun() -> None:
    """A disc 0.1 m before a wall, the sun at 45 degrees from the right: the shadow lies 0.1 m to the left."""
    to_sun_cam = np.array([1.0, 0.0, -1.0]) / np.sqrt(2)
    wall = Body(Plate(2.0, 2.0), MATT, np.eye(4))
    disc = Body(Plate(0.03, 0.03, round=True), MATT, pose(np.eye(3), [0.0, 0.0, 0.1]), casts_shadow=True)
    scene = Scene([wall, disc], Sun(to_sun_cam, 1.0, (0.0, 0.0, 0.0)), BLACK_SKY)
    light = scene.light(CAMERA, [pose(FACING, [0.0, 0.0, 1.0])] * 3)[..., 0]
    assert light.max() == pytest.approx(0.5 / np.sqrt(2), rel=1e-4)
    rows, columns = np.nonzero(light < 0.1)
    expected = CAMERA.project(np.array([[-0.1, 0.0, 1.0]]))[0]
    assert np.allclose([columns.mean(), rows.mean()], expected, atol=0.3)
    # As long as the disc is round, seen from the sun: its own width on a wall that it is parallel to.
    assert np.ptp(columns) + 1 == pytest.approx(0.06 * 400, abs=1.5)


def test_nearer_bodies_hide_farther_ones_in_any_order() -> None:
    far = Body(Plate(0.5, 0.5), Material((0.2, 0.2, 0.2)), pose(np.eye(3), [0, 0, -0.5]))
    near = Body(Plate(0.1, 0.1), Material((0.9, 0.9, 0.9)), np.eye(4))
    T_cam_scene = pose(FACING, [0, 0, 1.0])
    one, other = (
        Scene(bodies, EVENLY, BLACK_SKY).light(CAMERA, [T_cam_scene]) for bodies in ([far, near], [near, far])
    )
    assert np.array_equal(one, other)
    assert one[121, 158, 0] == pytest.approx(0.9)
    assert one[121, 158 + 60, 0] == pytest.approx(0.2)


def test_motion_blurs_without_moving() -> None:
    """Four pixels of motion during the exposure: the body's centre of light stays at its place of mid-exposure."""
    scene = Scene([Body(Plate(0.05, 0.05, round=True), MATT, np.eye(4))], EVENLY, BLACK_SKY)
    poses = [pose(FACING, [0.01 * s, 0.004 * s, 1.0]) for s in (np.arange(5) + 0.5) / 5 - 0.5]
    still, moving = scene.light(CAMERA, [poses[2]] * 5)[..., 0], scene.light(CAMERA, poses)[..., 0]
    rows, columns = np.mgrid[0:240, 0:320]
    for grid in (rows, columns):
        assert (moving * grid).sum() / moving.sum() == pytest.approx((still * grid).sum() / still.sum(), abs=0.02)
    assert (moving > 0.001).sum() > (still > 0.001).sum()


@pytest.mark.parametrize("samples", [1, 5, 7])
def test_time_goes_with_neither_x_nor_y(samples: int) -> None:
    order = exposure_order(samples)
    assert sorted(order) == list(range(samples))
    time = np.array(order) - (samples - 1) / 2
    drift = np.abs(time @ ray_lattice(samples)) / max(1.0, (time**2).sum())
    assert (drift < 0.11).all()


def test_refuses_more_instants_than_it_can_order() -> None:
    with pytest.raises(ValueError, match="at most 7"):
        exposure_order(20)
