"""What corners are off for long: layers that join later, or stay while others are measured, are no other for that."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.corner_filter import CornerFilter
from pipeline.corners import SeenLayer
from pipeline.dynamics import STATES, Motion
from pipeline.lasting import OUTWARD, PER_LAYER, covariance_px2
from pipeline.mission import FilterSection

SHARES = st.floats(0.0, 0.9)


def layer(number: int) -> SeenLayer:
    return SeenLayer(1, number, np.zeros((4, 2)), 0.1, np.zeros((4, 3)))


def ignorant(noise: FilterSection, *layers: int) -> CornerFilter:
    filter_ = CornerFilter(Motion.at_rest(np.eye(4)), np.eye(STATES), noise)
    filter_.know([layer(k) for k in layers])
    return filter_


@given(SHARES, st.floats(0.01, 5.0))
def test_stationary(share, dt_s):
    """Time alone changes nothing of what is known of layers' lasting errors."""
    noise = FilterSection(edge_bias_shared=share)
    filter_ = ignorant(noise, 0, 1, 2)
    assert filter_.covariance[STATES:, STATES:] == pytest.approx(covariance_px2(3, noise))
    filter_.predict(dt_s)
    assert filter_.covariance[STATES:, STATES:] == pytest.approx(covariance_px2(3, noise))


@given(SHARES, st.integers(0, 2**32 - 1))
def test_layers_that_join_later(share, seed):
    """Whether two layers join before or after others are measured, and time passes, makes no difference."""
    noise, rng = FilterSection(edge_bias_shared=share), np.random.default_rng(seed)
    early, late = ignorant(noise, 0, 1, 2, 3), ignorant(noise, 0, 1)
    for _ in range(2):
        seen, measured = rng.standard_normal((3, STATES + 2 * PER_LAYER)), rng.standard_normal(3)
        for filter_ in (early, late):
            H = np.zeros((3, len(filter_.covariance)))
            H[:, : seen.shape[1]] = seen
            P = filter_.covariance
            K = P @ H.T @ np.linalg.inv(H @ P @ H.T + np.eye(3))
            moved = filter_.moved(K @ measured, P - K @ H @ P)
            filter_.motion, filter_.lasting, filter_._P = filter_.motion, moved.lasting, moved.covariance
            filter_.predict(0.3)
    late.know([layer(2), layer(3)])
    assert late.covariance == pytest.approx(early.covariance, abs=1e-12)
    assert late.lasting.px[:, OUTWARD] == pytest.approx(early.lasting.px[:, OUTWARD], abs=1e-12)
