"""What the adapters share: which states are trusted, and covariances about fixed axes."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipeline.adapters.estimate import POSE, RATE, VELOCITY, estimate_of, trusted_estimate
from schemas import Mode
from tests.some_states import NOT_TRUSTED, some_state


@pytest.mark.parametrize("mode", NOT_TRUSTED, ids=lambda mode: mode.name)
def test_only_track_is_trusted(mode):
    assert trusted_estimate(some_state(mode)) is None
    assert estimate_of(some_state(mode)) is not None


@pytest.mark.parametrize(
    "absent", ["T_chaser_target", "v_chaser_target_m_s", "omega_chaser_target_in_target_rad_s", "covariance"]
)
def test_a_state_without_all_its_numbers_is_not_trusted(absent):
    """A pose whose covariance is unknown is not a navigation solution, whatever the mode says."""
    assert trusted_estimate(some_state().model_copy(update={absent: None})) is None


def test_the_covariance_about_fixed_axes_is_that_of_samples():
    """Poses drawn from the message's convention, their errors measured along and about the chaser's axes."""
    estimate = trusted_estimate(some_state(Mode.TRACK, seed=5))
    assert estimate is not None
    R_hat = Rotation.from_matrix(estimate.T_chaser_target[:3, :3])
    rng = np.random.default_rng(0)
    xi = rng.multivariate_normal(np.zeros(6), estimate.covariance[POSE, POSE], size=100_000)
    turned = R_hat * Rotation.from_rotvec(xi[:, 3:])
    errors = np.hstack([R_hat.apply(xi[:, :3]), (turned * R_hat.inv()).as_rotvec()])
    sampled = np.cov(errors.T)
    claimed = estimate.fixed_axes_covariance()[POSE, POSE]
    sigma = np.sqrt(np.diag(claimed))
    np.testing.assert_allclose(sampled / np.outer(sigma, sigma), claimed / np.outer(sigma, sigma), atol=0.02)
    unturned = estimate.covariance[POSE, POSE]
    assert np.abs((unturned - claimed) / np.outer(sigma, sigma)).max() > 0.3, "the test would not see a missing turn"


def test_velocity_and_rate_keep_their_axes():
    estimate = trusted_estimate(some_state())
    assert estimate is not None
    turned = estimate.fixed_axes_covariance()
    for part in (VELOCITY, RATE):
        np.testing.assert_array_equal(turned[part, part], estimate.covariance[part, part])
    np.testing.assert_allclose(turned, turned.T, rtol=1e-12)
    np.testing.assert_allclose(np.linalg.eigvalsh(turned), np.linalg.eigvalsh(estimate.covariance), rtol=1e-6)
