"""Laws of rigid transforms, with magnitudes from 1e-12 to pi; SciPy is the second opinion on rotations."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from astratag.transforms import (
    difference,
    exp_so3,
    inverse,
    log_so3,
    perturb,
    pose,
    rotation_from_wxyz,
    skew,
    transform,
    wxyz_from_rotation,
)

seeds = st.integers(0, 2**32 - 1)
unit_vectors = seeds.map(lambda seed: _unit(np.random.default_rng(seed)))
small_to_pi = st.floats(-12.0, 0.0).map(lambda exponent: np.pi * 10.0**exponent)
near_pi = st.floats(-9.0, -1.0).map(lambda exponent: np.pi - 10.0**exponent)
rotation_vectors = st.tuples(unit_vectors, st.one_of(small_to_pi, near_pi, st.just(0.0))).map(lambda ua: ua[0] * ua[1])
translations = st.tuples(unit_vectors, st.floats(-9.0, 3.0)).map(lambda ue: ue[0] * 10.0 ** ue[1])
poses = st.tuples(rotation_vectors, translations).map(lambda rt: pose(Rotation.from_rotvec(rt[0]).as_matrix(), rt[1]))


def _unit(rng):
    v = rng.normal(size=3)
    return v / np.linalg.norm(v)


@given(rotation_vectors)
def test_exp_is_the_matrix_exponential(theta):
    np.testing.assert_allclose(exp_so3(theta), expm(skew(theta)), atol=1e-14)


@given(rotation_vectors)
def test_exp_is_a_rotation(theta):
    R = exp_so3(theta)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(R) == pytest.approx(1.0)


@given(rotation_vectors)
def test_log_undoes_exp_to_the_last_digits_of_a_small_angle(theta):
    """To 1e-9 of each component or 2e-15 rad.  At pi itself both signs are the same rotation."""
    assume(np.linalg.norm(theta) < np.pi - 1e-10)
    np.testing.assert_allclose(log_so3(exp_so3(theta)), theta, rtol=1e-9, atol=2e-15)


@given(unit_vectors, unit_vectors)
def test_skew_is_the_cross_product(v, w):
    np.testing.assert_allclose(skew(v) @ w, np.cross(v, w), atol=1e-15)


@given(poses, rotation_vectors, translations)
def test_difference_undoes_perturb(T_a_b, theta, rho):
    xi = np.concatenate([rho, theta])
    moved = difference(perturb(T_a_b, xi), T_a_b)
    size = np.linalg.norm(T_a_b[:3, 3]) + np.linalg.norm(rho)
    np.testing.assert_allclose(moved[:3], rho, atol=4e-15 * size)
    np.testing.assert_allclose(exp_so3(moved[3:]), exp_so3(theta), atol=1e-14)
    if np.linalg.norm(theta) < 3.0:
        np.testing.assert_allclose(moved[3:], theta, atol=1e-14)


@given(poses, poses)
def test_perturb_undoes_difference(T_a_b, T_a_b_hat):
    size = 1.0 + np.linalg.norm(T_a_b[:3, 3]) + np.linalg.norm(T_a_b_hat[:3, 3])
    np.testing.assert_allclose(perturb(T_a_b_hat, difference(T_a_b, T_a_b_hat)), T_a_b, atol=1e-13 * size)


@given(poses, poses)
def test_a_perturbation_is_in_the_axes_of_the_child(T_c_a, T_a_b):
    """So the error of a pose does not change when the parent frame does."""
    T_a_b_hat = perturb(T_a_b, [0.01, -0.02, 0.03, 0.1, 0.2, -0.3])
    size = 1.0 + np.linalg.norm(T_c_a[:3, 3]) + np.linalg.norm(T_a_b[:3, 3])
    np.testing.assert_allclose(
        difference(T_c_a @ T_a_b, T_c_a @ T_a_b_hat), difference(T_a_b, T_a_b_hat), atol=1e-13 * size
    )


def test_perturbation_is_metres_then_radians_on_the_right():
    """By hand: b is turned 90 degrees about z, so a step along b's x is a step along a's y."""
    T_a_b = pose([[0, -1, 0], [1, 0, 0], [0, 0, 1]], [5, 0, 0])
    moved = perturb(T_a_b, [0.1, 0, 0, 0, 0, np.pi / 2])
    np.testing.assert_allclose(moved[:3, 3], [5, 0.1, 0], atol=1e-15)
    np.testing.assert_allclose(moved[:3, :3], np.diag([-1.0, -1.0, 1.0]), atol=1e-15)


@given(poses)
def test_inverse(T_a_b):
    size = 1.0 + np.linalg.norm(T_a_b[:3, 3])
    np.testing.assert_allclose(inverse(T_a_b) @ T_a_b, np.eye(4), atol=1e-14 * size)
    np.testing.assert_allclose(inverse(inverse(T_a_b)), T_a_b, atol=1e-14 * size)


@given(poses, poses, seeds)
def test_transform_composes(T_a_b, T_b_c, seed):
    points_c = np.random.default_rng(seed).normal(size=(2, 5, 3))
    size = 10.0 + np.linalg.norm(T_a_b[:3, 3]) + np.linalg.norm(T_b_c[:3, 3])
    np.testing.assert_allclose(
        transform(T_a_b, transform(T_b_c, points_c)), transform(T_a_b @ T_b_c, points_c), atol=1e-14 * size
    )


@given(rotation_vectors)
def test_quaternion_round_trip_is_unit_with_w_not_negative(theta):
    R = exp_so3(theta)
    rotation_wxyz = wxyz_from_rotation(R)
    assert rotation_wxyz[0] >= 0
    assert np.linalg.norm(rotation_wxyz) == pytest.approx(1.0)
    np.testing.assert_allclose(rotation_from_wxyz(rotation_wxyz), R, atol=1e-14)
    np.testing.assert_allclose(rotation_from_wxyz(-rotation_wxyz), R, atol=1e-14)


def test_quaternion_is_w_first():
    np.testing.assert_allclose(wxyz_from_rotation(exp_so3([0.2, 0, 0])), [np.cos(0.1), np.sin(0.1), 0, 0], atol=1e-15)
