"""The viewer: its shapes and bounds by law, its file read back, and what it does without a screen."""

import dataclasses
import socket
import sys
import threading
import urllib.request
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rerun.chunk import RrdReader
from scipy.spatial.transform import Rotation

from astratag.geometry import QUIET_MARGIN
from astratag.surface import Cylinder, Flat
from astratag.transforms import perturb, pose
from pipeline.corridor import in_corridor, port_to_port
from pipeline.mission import CorridorSection, Mission, PoseSection
from pipeline.view import Viewer, layout, screenshot, streams
from pipeline.view.geometry import (
    PortMotion,
    body_mesh,
    corridor_strips,
    dashed,
    ellipsoid,
    port_motion,
    print_mesh,
    target_bodies,
)
from pipeline.view.viewer import OUT_OF_SIGHT_M
from schemas import Envelope, Mode
from schemas.topics import DETECTIONS, FRAME, STATE, TRUTH
from tests.fake_run import MISSION, make_run

SURFACES = [Flat(), Cylinder(0.15), Cylinder(0.2, axis_rad=0.7)]
ERROR = np.array([3e-3, 0, 0, 0, 0.02, 0, 0, 0, 0, 0, 0, 0])


def show(run: Iterable[tuple[Envelope, int]], path: Path, mission: Mission = MISSION) -> Path:
    """Write a run's .rrd file."""
    with Viewer(mission, rrd_path=path) as viewer:
        for envelope, t_receipt_ns in run:
            viewer.write(envelope, t_receipt_ns)
    return path


def entities(path: Path) -> set[str]:
    return set(RrdReader(path).store().schema().entity_paths())


def rows(path: Path, entity: str, component: str) -> dict[int, list]:
    """Return what the file holds of an entity's component, by frame."""
    found: dict[int, list] = {}
    for chunk in RrdReader(path).stream():
        batch = chunk.to_record_batch()
        if chunk.entity_path == entity and not chunk.is_static and component in batch.schema.names:
            frames, values = (batch.column(name).to_pylist() for name in ("frame", component))
            found |= {f: v for f, v in zip(frames, values, strict=True) if v is not None}
    return found


def scalars(path: Path, entity: str) -> dict[int, list]:
    return rows(path, entity, "Scalars:scalars")


# Shapes and bounds


@given(st.integers(0, 2**32 - 1))
def test_ellipsoid_axes_rebuild_the_covariance(seed: int):
    """Whatever the signs of the eigenvectors: half of all covariances have a left-handed set of them."""
    rng = np.random.default_rng(seed)
    half = rng.normal(size=(3, 3)) * 10.0 ** rng.uniform(-4, 0)
    covariance = half @ half.T
    half_axes_m, xyzw = ellipsoid(covariance, sigmas=3.0)
    R = Rotation.from_quat(xyzw).as_matrix()
    assert np.linalg.norm(xyzw) == pytest.approx(1.0)
    np.testing.assert_allclose(R @ np.diag((half_axes_m / 3) ** 2) @ R.T, covariance, atol=1e-9 * covariance.max())


def a_motion(seed: int) -> tuple[Mission, np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)

    def section() -> PoseSection:
        return PoseSection(
            translation_m=tuple(rng.normal(scale=0.1, size=3)),
            rotation_wxyz=tuple(Rotation.random(rng=rng).as_quat(scalar_first=True)),
        )

    mission = Mission(T_chaser_port=section(), T_target_port=section())
    T_chaser_target = pose(Rotation.random(rng=rng).as_matrix(), rng.normal(size=3))
    return mission, T_chaser_target, rng.normal(scale=0.1, size=3), rng.normal(scale=0.1, size=3)


def motion_of(mission: Mission, T_chaser_target: np.ndarray, v: np.ndarray, omega: np.ndarray) -> PortMotion:
    return port_motion(T_chaser_target, v, omega, mission.T_chaser_port.matrix(), mission.T_target_port.matrix())


@pytest.mark.parametrize("seed", range(5))
def test_plotted_motion_is_the_filters(seed: int):
    mission, *state = a_motion(seed)
    motion, port = motion_of(mission, *state), port_to_port(mission, *state)
    expected = (port.range_m, port.lateral_m, port.closing_speed_m_s)
    np.testing.assert_allclose([value for _, _, value, _ in motion.plotted()], expected, rtol=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_bounds_follow_the_derivatives(seed: int):
    """Each derivative by the state's tangent agrees with a central difference."""
    mission, T_chaser_target, v, omega = a_motion(seed)

    def moved(xi: np.ndarray) -> PortMotion:
        return motion_of(mission, perturb(T_chaser_target, xi[:6]), v + xi[6:9], omega + xi[9:])

    motion, step = moved(np.zeros(12)), 1e-6
    for k, xi in enumerate(step * np.eye(12)):
        ahead, behind = moved(xi), moved(-xi)
        np.testing.assert_allclose(motion.jacobian[:, k], (ahead.p_port_m - behind.p_port_m) / (2 * step), atol=1e-7)
        for (*_, value, by), (*_, above, _), (*_, below, _) in zip(
            motion.plotted(), ahead.plotted(), behind.plotted(), strict=True
        ):
            assert np.isfinite(value)
            assert by[k] == pytest.approx((above - below) / (2 * step), abs=1e-6)


@pytest.mark.parametrize("surface", SURFACES, ids=str)
def test_a_print_lies_on_its_body_upright(surface: Flat | Cylinder):
    side_m = 0.1
    mesh = print_mesh(side_m, surface)
    assert mesh.texture is not None
    half_m = side_m * (0.5 + QUIET_MARGIN)
    on_print = (mesh.texture * (2, -2) + (-1, 1)) * half_m  # texture runs right and down from the top left
    lift_m = np.linalg.norm(mesh.vertices - surface.points(on_print), axis=1)
    assert (lift_m > 0).all() and (lift_m < 0.001).all()
    a, b, c = (mesh.vertices[mesh.triangles[:, k]] for k in range(3))
    assert (np.cross(b - a, c - a) @ (0, 0, 1) > 0).all()  # the face looks out of the print


@pytest.mark.parametrize("surface", SURFACES[1:], ids=str)
def test_a_body_is_the_cylinder_under_the_print(surface: Cylinder):
    mesh = body_mesh(0.1, surface)
    axis = np.array([np.cos(surface.axis_rad), np.sin(surface.axis_rad), 0.0])
    from_axis = mesh.vertices + (0.0, 0.0, surface.radius_m)
    distance_m = np.linalg.norm(np.cross(from_axis, axis), axis=1)
    assert distance_m.max() == pytest.approx(surface.radius_m)
    a, b, c = (mesh.vertices[mesh.triangles[:, k]] for k in range(3))
    facing = (np.cross(b - a, c - a) * mesh.normals[mesh.triangles[:, 1]]).sum(axis=1)
    assert (facing > -1e-12).all()


def test_markers_on_one_cylinder_share_a_body():
    surface = Cylinder(0.15)
    turn = pose(Rotation.from_euler("x", 40, degrees=True).as_matrix(), (0.0, 0.0, 0.0))
    behind = pose(np.eye(3), (0.0, 0.0, -surface.radius_m))
    around = behind @ turn @ np.linalg.inv(behind)
    assert len(target_bodies([(np.eye(4), 0.1, surface), (around, 0.1, surface)])) == 1
    assert len(target_bodies([(np.eye(4), 0.1, surface), (turn, 0.1, surface)])) == 2


def test_the_corridor_is_drawn_where_it_ends():
    corridor = CorridorSection(half_angle_rad=0.2, port_radius_m=0.05)
    for strip in corridor_strips(corridor):
        for x, y, z_m in strip:
            lateral_m = float(np.hypot(x, y))
            assert in_corridor(corridor, axial_m=z_m, lateral_m=lateral_m * (1 - 1e-9))
            assert not in_corridor(corridor, axial_m=z_m, lateral_m=lateral_m * (1 + 1e-9))


def test_dashes_lie_on_the_sides():
    square = np.array([(0.0, 0.0), (90.0, 0.0), (90.0, 90.0), (0.0, 90.0)])
    points = dashed(square).reshape(-1, 2)
    inset = np.minimum(points, 90 - points).min(axis=1)
    np.testing.assert_allclose(inset, 0.0, atol=1e-9)


# What the file holds


def test_a_run_is_in_the_file(tmp_path: Path):
    path = show(make_run(40, error=lambda k: ERROR), tmp_path / "new" / "run.rrd")
    found = entities(path)
    for name in ("range_m", "lateral_mm", "closing_mm_s"):
        assert {f"/plots/{name}/{line}" for line in ("estimate", "truth")} <= found
    overlay = {f"{layout.OVERLAY}/{name}" for name in ("quads", "predicted", "grid", "axes", "labels")}
    drawn = {
        layout.IMAGE,
        *overlay,
        "scene/estimate/ellipsoid",
        "scene/target/marker_7",
        "scene/corridor",
        *layout.PATHS,
    }
    assert {f"/{name}" for name in drawn} | {"/events", "/legend", "/status/filter_mode"} <= found
    assert len(scalars(path, "/plots/range_m/estimate")) == 40
    assert scalars(path, "/plots/latency_ms") == {}  # nobody said when these frames entered the pipeline


def test_errors_and_bounds_are_the_runs(tmp_path: Path):
    path = show(make_run(10, error=lambda k: ERROR, sigma=lambda k: np.full(12, 1e-3)), tmp_path / "run.rrd")
    np.testing.assert_allclose(list(scalars(path, "/plots/position_error_mm/error").values()), 3.0, rtol=1e-6)
    attitude_deg = list(scalars(path, "/plots/attitude_error_deg/error").values())
    np.testing.assert_allclose(attitude_deg, np.rad2deg(0.02), rtol=1e-6)
    bound_mm = list(scalars(path, "/plots/position_error_mm/bound").values())
    np.testing.assert_allclose(bound_mm, 3 * np.sqrt(3), rtol=1e-6)


def test_bounds_wait_until_the_filter_has_settled(tmp_path: Path):
    """While the speed is known no better than the first guess, estimates are plotted and bounds are not."""

    def sigma(k: int) -> np.ndarray:
        return np.full(12, 0.2 if k == 0 else 1e-3)

    path = show(make_run(3, sigma=sigma), tmp_path / "run.rrd")
    lines = np.array(list(scalars(path, "/plots/closing_mm_s/estimate").values()))
    assert np.isfinite(lines).tolist() == [[True, False, False], [True] * 3, [True] * 3]


def test_truth_may_come_before_or_after_its_state(tmp_path: Path):
    run = list(make_run(12, error=lambda k: ERROR))
    late = [item for item in run if item[0].topic is not TRUTH] + [item for item in run if item[0].topic is TRUTH]
    first, second = show(run, tmp_path / "a.rrd"), show(late, tmp_path / "b.rrd")
    errors = scalars(first, "/plots/position_error_mm/error")
    assert errors == scalars(second, "/plots/position_error_mm/error")
    assert sorted(errors) == list(range(12))


def test_without_state_or_truth_nothing_of_them_is_drawn(tmp_path: Path):
    path = show(make_run(5, mode=lambda k: Mode.INIT, truth=False), tmp_path / "run.rrd")
    assert not scalars(path, "/plots/range_m/estimate") and not scalars(path, "/plots/range_m/truth")
    assert "/scene/truth/chaser" not in entities(path)
    hidden = rows(path, f"/{layout.CHASER}", "Transform3D:translation")
    assert list(hidden) == [0] and hidden[0][0] == pytest.approx(OUT_OF_SIGHT_M)


def test_the_overlay_goes_with_the_marker(tmp_path: Path):
    """Seen, gone for three frames, seen again: cleared once, when it goes."""
    run = [
        (envelope, t_ns)
        for envelope, t_ns in make_run(9)
        if not (envelope.topic is DETECTIONS and 3 <= envelope.stamp.sequence < 6)
    ]
    gone = make_run(9, detect=lambda k, T: [])
    run += [item for item in gone if item[0].topic is DETECTIONS and 3 <= item[0].stamp.sequence < 6]
    run.sort(key=lambda item: item[0].stamp.sequence)
    path = show(run, tmp_path / "run.rrd")
    assert list(rows(path, f"/{layout.OVERLAY}", "Clear:is_recursive")) == [3]
    assert sorted(rows(path, f"/{layout.OVERLAY}/quads", "LineStrips2D:strips")) == [0, 1, 2, 6, 7, 8]


def test_a_mission_without_a_map_shows_the_first_marker(tmp_path: Path):
    path = show(make_run(3), tmp_path / "run.rrd", mission=Mission())
    assert "/scene/target/marker_7" in entities(path)


def test_latency_is_from_origin_to_receipt(tmp_path: Path):
    def entered(envelope: Envelope, t_ns: int) -> Envelope:
        return dataclasses.replace(envelope, stamp=dataclasses.replace(envelope.stamp, t_origin_ns=t_ns - 7_000_000))

    run = [(entered(envelope, t_ns), t_ns) for envelope, t_ns in make_run(3)]
    latency_ms = scalars(show(run, tmp_path / "run.rrd"), "/plots/latency_ms")
    assert latency_ms == {0: [7.0], 1: [7.0], 2: [7.0]}


def test_damaged_bytes_are_refused(tmp_path: Path):
    with Viewer(MISSION, rrd_path=tmp_path / "run.rrd") as viewer:
        envelope = next(envelope for envelope, _ in make_run(1) if envelope.topic is STATE)
        with pytest.raises(ValueError, match=r"relnav\.RelativeState"):
            viewer.write(dataclasses.replace(envelope, payload=b"\xff\xff"), 0)


# Without a screen, and with ports taken


def test_a_file_that_cannot_be_written_is_said_in_one_line(tmp_path: Path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match="cannot write") as raised:
        Viewer(MISSION, rrd_path=tmp_path / "file" / "run.rrd")
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("taken", ["web_port", "grpc_port"])
def test_a_port_in_use_is_said_in_one_line(taken: str):
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        ports = {"web_port": free_port(), "grpc_port": free_port()} | {taken: other.getsockname()[1]}
        with pytest.raises(ValueError, match=f"{taken} {ports[taken]} .*another viewer") as raised:
            Viewer(MISSION, rrd_path=None, mode="web", **ports)
        assert "\n" not in str(raised.value)


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def test_the_web_page_is_served():
    web_port, grpc_port = free_port(), free_port()
    with Viewer(MISSION, rrd_path=None, mode="web", web_port=web_port, grpc_port=grpc_port) as viewer:
        for envelope, t_receipt_ns in make_run(3):
            viewer.write(envelope, t_receipt_ns)
        assert viewer.url is not None and str(grpc_port) in viewer.url
        with urllib.request.urlopen(viewer.url.replace("localhost", "127.0.0.1"), timeout=10) as page:
            assert b"Rerun" in page.read()


@pytest.mark.parametrize(
    ("display", "command", "reason"),
    [
        (False, streams.VIEWER_COMMAND, "no display"),
        (True, (sys.executable, "-c", "raise SystemExit(3)"), "code 3"),
        (True, ("/nowhere/rerun",), "cannot be started"),
    ],
)
def test_a_window_that_does_not_open_costs_one_warning(
    display: bool, command: tuple[str, ...], reason: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """The run is not held up meanwhile, and its file is whole."""
    monkeypatch.setattr(streams, "has_display", lambda: display)
    monkeypatch.setattr(streams, "VIEWER_COMMAND", command)
    warnings: list[str] = []
    path = tmp_path / "run.rrd"
    with Viewer(MISSION, rrd_path=path, mode="native", grpc_port=free_port(), warn=warnings.append) as viewer:
        for envelope, t_receipt_ns in make_run(20):
            viewer.write(envelope, t_receipt_ns)
    assert len(warnings) == 1 and reason in warnings[0]
    assert len(scalars(path, "/plots/range_m/estimate")) == 20


def test_writing_does_not_wait_for_the_window(monkeypatch: pytest.MonkeyPatch):
    """While the viewer is still starting, everything is taken: only close waits for it."""
    started = threading.Event()

    def start_slowly(window: streams.Window) -> str | None:
        started.wait()
        return "it is slow"

    monkeypatch.setattr(streams.Window, "_open", start_slowly)
    warnings: list[str] = []
    viewer = Viewer(MISSION, rrd_path=None, mode="native", grpc_port=free_port(), warn=warnings.append)
    for envelope, t_receipt_ns in make_run(5):
        viewer.write(envelope, t_receipt_ns)
    assert not warnings
    started.set()
    viewer.close()
    assert len(warnings) == 1


@pytest.mark.slow
def test_no_view_reports_a_problem(tmp_path: Path):
    """Rerun itself, without a screen, opens the file: no view has anything to complain of, at any time."""
    picture = cv2.imencode(".jpg", np.full((720, 1280), 60, np.uint8))[1].tobytes()

    def framed(envelope: Envelope) -> Envelope:
        if envelope.topic is not FRAME:
            return envelope
        image = envelope.message()
        image.data = picture
        return dataclasses.replace(envelope, payload=image.SerializeToString())

    modes = [Mode.INIT] * 3 + [Mode.TRACK] * 37
    run = ((framed(envelope), t_ns) for envelope, t_ns in make_run(40, mode=lambda k: modes[k]))
    path = show(run, tmp_path / "run.rrd")
    try:
        with screenshot.headless_viewer(path) as client:
            complaints = {frame: screenshot.show_frame(client, frame) for frame in (0, 2, 3, 20, 39)}
    except RuntimeError as error:
        pytest.skip(str(error))
    assert not any(complaints.values()), complaints
