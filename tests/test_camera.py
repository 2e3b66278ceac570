"""The camera: against OpenCV's projection, its own inverse, and the files calibrations come in."""

import json

import cv2
import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from astratag.camera import Camera

K = np.array([[1100.0, 0.0, 630.5], [0.0, 1080.0, 365.25], [0.0, 0.0, 1.0]])
DISTORTION = (-0.21, 0.09, 0.0012, -0.0008, -0.02)
WIDTH, HEIGHT = 1280, 720

terms = st.tuples(
    *(st.floats(-bound, bound) for bound in (0.25, 0.1, 0.002, 0.002, 0.02)),
)
focals = st.floats(1200.0, 5000.0)  # shorter ones with these terms fold the picture before its corners
cameras = st.builds(
    lambda focal, ratio, c, distortion: Camera(
        [[focal, 0, c[0]], [0, focal * ratio, c[1]], [0, 0, 1]], distortion, width=WIDTH, height=HEIGHT
    ),
    focals,
    st.floats(0.95, 1.05),
    st.tuples(st.floats(560.0, 720.0), st.floats(300.0, 420.0)),
    st.one_of(terms, st.just((0.0,) * 5)),
)


def grid_px():
    u, v = np.meshgrid(np.linspace(-0.5, WIDTH - 0.5, 9), np.linspace(-0.5, HEIGHT - 0.5, 7))
    return np.stack([u, v], axis=-1).reshape(-1, 2)


@given(cameras, st.floats(-2.0, 2.0))
def test_project_undoes_undistort_over_the_whole_image(camera, depth_exponent):
    """To a millionth of a pixel, at any depth."""
    z = 10.0**depth_exponent
    rays = camera.undistort(grid_px())
    np.testing.assert_allclose(camera.project(z * np.c_[rays, np.ones(len(rays))]), grid_px(), atol=1e-6)


@given(cameras, st.integers(0, 2**32 - 1))
def test_project_against_opencv(camera, seed):
    rng = np.random.default_rng(seed)
    points = rng.uniform((-0.4, -0.25, 1.0), (0.4, 0.25, 1.0), (20, 3)) * rng.uniform(0.05, 20.0, (20, 1))
    zero = np.zeros(3)
    expected = cv2.projectPoints(points, zero, zero, camera.K, camera.distortion)[0].reshape(-1, 2)
    np.testing.assert_allclose(camera.project(points), expected, atol=1e-9)


@given(cameras, st.integers(0, 2**32 - 1))
def test_projection_jacobian_against_differences(camera, seed):
    rng = np.random.default_rng(seed)
    points = rng.uniform((-0.4, -0.25, 1.0), (0.4, 0.25, 1.0), (6, 3)) * rng.uniform(0.05, 5.0, (6, 1))
    jacobian = camera.projection_jacobian(points)
    for axis, step in enumerate(1e-6 * np.eye(3)):
        slope = (camera.project(points + step) - camera.project(points - step)) / 2e-6
        np.testing.assert_allclose(jacobian[..., axis], slope, rtol=1e-5, atol=1e-3)


def test_the_optical_axis_meets_the_principal_point_x_right_y_down():
    camera = Camera(K, DISTORTION, width=WIDTH, height=HEIGHT)
    axis, right, down = camera.project(np.array([(0.0, 0.0, 2.0), (0.1, 0.0, 2.0), (0.0, 0.1, 2.0)]))
    np.testing.assert_allclose(axis, K[:2, 2])
    assert right[0] > axis[0]
    assert down[1] > axis[1]


def test_the_reference_camera_inverts_over_its_images(shared):
    """A strong lens, k3 = 15: OpenCV's iteration still gets there, to a hundred-thousandth of a pixel."""
    camera = Camera.load(shared / "reference/camera_example.json", width=WIDTH, height=HEIGHT)
    rays = camera.undistort(grid_px().clip(0, (WIDTH - 1, HEIGHT - 1)))
    there_and_back = camera.project(np.c_[rays, np.ones(len(rays))])
    np.testing.assert_allclose(there_and_back, grid_px().clip(0, (WIDTH - 1, HEIGHT - 1)), atol=1e-5)


@pytest.mark.parametrize("distortion", [(0.0,) * 5, DISTORTION])
def test_no_points_in_no_points_out(distortion):
    camera = Camera(K, distortion, width=WIDTH, height=HEIGHT)
    assert camera.undistort(np.zeros((0, 2))).shape == (0, 2)
    assert camera.project(np.zeros((0, 3))).shape == (0, 2)


def test_a_scaled_camera_sees_the_resized_picture():
    """Pixel edges scale, centres do not: pixel u covers [u - 0.5, u + 0.5]."""
    camera = Camera(K, DISTORTION, width=WIDTH, height=HEIGHT)
    half = camera.scaled(640, 360)
    points = np.array([(0.1, -0.2, 1.0), (-0.3, 0.1, 2.0)])
    np.testing.assert_allclose(half.project(points) + 0.5, (camera.project(points) + 0.5) / 2)
    np.testing.assert_allclose(half.scaled(WIDTH, HEIGHT).K, camera.K)
    assert (half.width, half.height) == (640, 360)


def ros_yaml(**changes):
    entries = {
        "image_width": WIDTH,
        "image_height": HEIGHT,
        "camera_name": "mock_up",
        "camera_matrix": {"rows": 3, "cols": 3, "data": K.ravel().tolist()},
        "distortion_model": "plumb_bob",
        "distortion_coefficients": {"rows": 1, "cols": 5, "data": list(DISTORTION)},
        "rectification_matrix": {"rows": 3, "cols": 3, "data": np.eye(3).ravel().tolist()},
    } | changes
    return yaml.safe_dump({key: value for key, value in entries.items() if value is not None})


def reference_json(matrix=K, distortion=DISTORTION):
    return json.dumps({"camera_matrix": np.asarray(matrix).tolist(), "distortion_coefficients": [list(distortion)]})


def written(tmp_path, text, name="camera.yaml"):
    path = tmp_path / name
    path.write_text(text)
    return path


@pytest.mark.parametrize(("name", "text"), [("camera.yaml", ros_yaml()), ("camera.json", reference_json())])
def test_reads_ros_yaml_and_the_reference_json(tmp_path, name, text):
    camera = Camera.load(written(tmp_path, text, name), width=WIDTH, height=HEIGHT)
    np.testing.assert_array_equal(camera.K, K)
    np.testing.assert_array_equal(camera.distortion, DISTORTION)
    assert (camera.width, camera.height) == (WIDTH, HEIGHT)


def test_reads_the_reference_calibration(shared):
    camera = Camera.load(shared / "reference/camera_example.json", width=WIDTH, height=HEIGHT)
    assert camera.K[0, 0] == pytest.approx(1482.6846)
    assert camera.distortion[4] == pytest.approx(15.373820746)


def test_a_ros_file_tells_its_size_and_a_bare_json_twice_its_principal_point(tmp_path):
    told = Camera.load(written(tmp_path, ros_yaml()))
    guessed = Camera.load(written(tmp_path, reference_json(), "camera.json"))
    assert (told.width, told.height) == (WIDTH, HEIGHT)
    assert (guessed.width, guessed.height) == (1261, 730)


@pytest.mark.parametrize(("name", "text"), [("camera.yaml", ros_yaml()), ("camera.json", reference_json())])
def test_refuses_images_of_another_size_unless_told_to_scale(tmp_path, name, text):
    path = written(tmp_path, text, name)
    with pytest.raises(ValueError, match="images are 640x360: calibrate at that size, or scale"):
        Camera.load(path, width=640, height=360)
    scaled = Camera.load(path, width=640, height=360, scale=True)
    assert (scaled.width, scaled.height) == (640, 360)
    assert scaled.K[0, 0] == pytest.approx(K[0, 0] / 2, rel=0.02)


def test_four_or_no_distortion_terms_leave_the_rest_zero(tmp_path):
    four = written(tmp_path, ros_yaml(distortion_coefficients={"rows": 1, "cols": 4, "data": list(DISTORTION[:4])}))
    np.testing.assert_array_equal(Camera.load(four).distortion, (*DISTORTION[:4], 0.0))
    none = written(tmp_path, ros_yaml(distortion_coefficients=None, distortion_model=None))
    assert not Camera.load(none).distortion.any()


def matrix(**changes):
    out = K.copy()
    for name, value in changes.items():
        out[int(name[1]), int(name[2])] = value
    return {"rows": 3, "cols": 3, "data": out.ravel().tolist()}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (ros_yaml(camera_matrix=None), "no readable camera_matrix"),
        (ros_yaml(camera_matrix={"rows": 3, "cols": 3}), "no readable camera_matrix"),
        (ros_yaml(camera_matrix=[1, 2, 3]), "no readable camera_matrix"),
        (ros_yaml(camera_matrix="wide"), "no readable camera_matrix"),
        (ros_yaml(image_width=float("inf")), "no readable"),
        (ros_yaml(camera_matrix=matrix(k00=float("nan"))), "K must be finite"),
        (ros_yaml(camera_matrix=matrix(k02=float("inf"))), "K must be finite"),
        (ros_yaml(camera_matrix=matrix(k00=0.0)), "positive focal lengths"),
        (ros_yaml(camera_matrix=matrix(k11=-1080.0)), "positive focal lengths"),
        (ros_yaml(camera_matrix=matrix(k01=1100.0, k10=1080.0)), "no skew"),
        (ros_yaml(camera_matrix=matrix(k20=630.5, k02=0.0)), "Is it transposed"),
        (ros_yaml(image_height=-720), "height must be a whole number, 1 or more"),
        (ros_yaml(distortion_model="equidistant"), "'equidistant' is not supported"),
        (ros_yaml(distortion_coefficients=[0.0] * 8), "must be 5 terms"),
        (ros_yaml(distortion_coefficients=[float("nan")] * 5), "finite numbers"),
        ("", "no readable camera_matrix"),
        ("- 1\n- 2\n", "no readable camera_matrix"),
        ("a: [1,\n b", "cannot read camera file"),
    ],
)
def test_refuses_a_bad_calibration_in_one_line_that_names_the_file(tmp_path, text, message):
    path = written(tmp_path, text)
    with pytest.raises(ValueError, match=message) as error:
        Camera.load(path, width=WIDTH, height=HEIGHT)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


def test_refuses_files_that_are_absent_or_no_text(tmp_path):
    with pytest.raises(ValueError, match="cannot read camera file"):
        Camera.load(tmp_path / "absent.yaml")
    (tmp_path / "camera.json").write_bytes(b"\x89PNG\xff\xfe")
    with pytest.raises(ValueError, match="cannot read camera file"):
        Camera.load(tmp_path / "camera.json")


@pytest.mark.parametrize("shape", [(9,), (2, 2), (3, 4)])
def test_refuses_a_matrix_of_another_shape(shape):
    with pytest.raises(ValueError, match="K must be 3x3"):
        Camera(np.ones(shape), width=WIDTH, height=HEIGHT)


def test_skew_left_by_rounding_is_dropped():
    assert Camera(K + [[0, 1e-9, 0], [0, 0, 0], [0, 0, 0]], width=WIDTH, height=HEIGHT).K[0, 1] == 0.0
