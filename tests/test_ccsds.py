"""OEM and AEM: read back by a strict parser of the standards, ccsds-ndm-py."""

import ccsds_ndm
import numpy as np
import pytest

from astratag.transforms import rotation_from_wxyz
from pipeline.adapters.ccsds import Names, aem_text, epoch, oem_text
from pipeline.adapters.estimate import POSITION, VELOCITY, trusted_estimate
from schemas import Mode
from tests.some_states import NOT_TRUSTED, T_NS, some_state

PERIOD_NS = 50_000_000
NAMES = Names(chaser="SERVICER", target="CLIENT", originator="TESTER")


def states(modes: str):
    """Return a state for each letter: T in TRACK, any other letter in the mode that begins with it."""
    named = {mode.name[0]: mode for mode in Mode}
    return [some_state(named[m], seed=k, t_ns=T_NS + k * PERIOD_NS) for k, m in enumerate(modes)]


def read(write, made):
    message = ccsds_ndm.from_str(write(made, NAMES, created_ns=T_NS))
    message.validate()
    return message


def test_an_oem_is_read_back_in_km():
    made = states("TTT")
    message = read(oem_text, made)
    assert (message.version, message.header.originator, message.header.creation_date) == ("3.0", "TESTER", epoch(T_NS))
    (segment,) = message.segments
    meta = segment.metadata
    assert (meta.object_name, meta.center_name, meta.ref_frame) == ("CLIENT", "SERVICER", "SC_BODY_1")
    assert (meta.time_system, meta.start_time) == ("UTC", "2027-01-15T08:00:00.123456789")
    assert segment.data.state_vector_epochs == [epoch(state.t_capture_ns) for state in made]
    estimates = [trusted_estimate(state) for state in made]
    expected = [np.r_[e.position_m, e.v_chaser_target_m_s] / 1000 for e in estimates]
    np.testing.assert_allclose(segment.data.state_vector_numpy, expected, rtol=1e-14)


def test_an_oem_s_covariances_are_along_its_frame():
    made = states("TT")
    data = read(oem_text, made).segments[0].data
    assert data.covariance_matrix_epochs == data.state_vector_epochs
    rows = np.r_[POSITION, VELOCITY]
    for state, got in zip(made, data.covariance_matrix_numpy, strict=True):
        estimate = trusted_estimate(state)
        np.testing.assert_allclose(got * 1e6, estimate.fixed_axes_covariance()[np.ix_(rows, rows)], rtol=1e-12)


def test_an_aem_is_read_back():
    """By annex F of 504.0-B-2 the matrix of the quaternion takes coordinates from frame A to frame B."""
    made = states("TT")
    (segment,) = read(aem_text, made).segments
    meta = segment.metadata
    assert (meta.object_name, meta.ref_frame_a, meta.ref_frame_b) == ("CLIENT", "SC_BODY_1", "SC_BODY_2")
    assert (meta.attitude_type, meta.angvel_frame) == ("QUATERNION/ANGVEL", "SC_BODY_2")
    for state, numbers in zip(made, segment.data.attitude_states_numpy, strict=True):
        estimate = trusted_estimate(state)
        q1, q2, q3, qc = numbers[:4]
        M_first_row = [q1**2 - q2**2 - q3**2 + qc**2, 2 * (q1 * q2 + q3 * qc), 2 * (q1 * q3 - q2 * qc)]
        np.testing.assert_allclose(M_first_row, estimate.T_chaser_target[:3, :3].T[0], atol=1e-14)
        np.testing.assert_allclose(rotation_from_wxyz((qc, q1, q2, q3)), estimate.T_chaser_target[:3, :3], atol=1e-14)
        np.testing.assert_allclose(np.deg2rad(numbers[4:]), estimate.omega_chaser_target_in_target_rad_s, rtol=1e-14)


@pytest.mark.parametrize("write", [oem_text, aem_text])
def test_a_segment_ends_where_a_state_is_not_trusted(write):
    """By both standards nobody may interpolate from one segment into the next."""
    made = states("ITTACTTTLIT")
    segments = read(write, made).segments
    times = [(segment.metadata.start_time, segment.metadata.stop_time) for segment in segments]
    assert times == [(epoch(made[a].t_capture_ns), epoch(made[b].t_capture_ns)) for a, b in ((1, 2), (5, 7), (10, 10))]


@pytest.mark.parametrize("write", [oem_text, aem_text])
def test_times_rise(write):
    """A repeated and a late state are left out."""
    made = states("TTT")
    message = read(write, [made[0], made[1], made[1], made[0], made[2]])
    epochs = "state_vector_epochs" if write is oem_text else "attitude_states_epochs"
    assert getattr(message.segments[0].data, epochs) == [epoch(state.t_capture_ns) for state in made]


@pytest.mark.parametrize("write", [oem_text, aem_text])
def test_without_a_trusted_state_there_is_no_file(write):
    with pytest.raises(ValueError, match="no state is in TRACK"):
        write([some_state(mode) for mode in NOT_TRUSTED], NAMES, created_ns=T_NS)
