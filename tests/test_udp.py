"""UDP: read back by the examples, which share no code with what writes it, and by a C compiler's idea of the struct."""

import json
import shutil
import subprocess

import numpy as np
import pytest

from pipeline.adapters.udp import PACKET_BYTES, json_line, packet
from schemas import Mode
from tests.some_states import EXAMPLES, NOT_TRUSTED, T_NS, load_example, some_state

NUMBERS = (
    "translation_m",
    "rotation_wxyz",
    "v_chaser_target_m_s",
    "omega_chaser_target_in_target_rad_s",
    "covariance_upper",
)


@pytest.fixture(scope="module")
def decode():
    return load_example("udp_listen").decode


@pytest.mark.parametrize("write", [packet, json_line])
def test_a_trusted_state_is_read_back_exactly(decode, write):
    state = some_state()
    read = decode(write(state, 4711))
    assert (read["sequence"], read["t_capture_ns"], read["mode"], read["valid"]) == (4711, T_NS, "TRACK", True)
    assert (read["age_s"], read["hypothesis_probability"]) == (0.25, 0.999)
    t, q = state.T_chaser_target.translation_m, state.T_chaser_target.rotation_wxyz
    v, omega = state.v_chaser_target_m_s, state.omega_chaser_target_in_target_rad_s
    upper = np.array(state.covariance).reshape(12, 12)[np.triu_indices(12)]
    expected = ([t.x, t.y, t.z], [q.w, q.x, q.y, q.z], [v.x, v.y, v.z], [omega.x, omega.y, omega.z], upper.tolist())
    assert tuple(read[name] for name in NUMBERS) == expected


@pytest.mark.parametrize("write", [packet, json_line])
@pytest.mark.parametrize("mode", NOT_TRUSTED, ids=lambda mode: mode.name)
def test_no_other_mode_is_valid(decode, write, mode):
    """Numbers are shared in COAST, for a reader that judges by age, and in no other."""
    read = decode(write(some_state(mode), 1))
    assert (read["mode"], read["valid"]) == (mode.name, False)
    for name in NUMBERS:
        assert (read[name] is not None) == (mode == Mode.COAST)


def test_a_reader_who_forgets_the_flags_meets_nan():
    body = np.frombuffer(packet(some_state(Mode.AMBIGUOUS), 1)[40:768], "<f8")
    assert np.isnan(body).all()


@pytest.mark.parametrize("write", [packet, json_line])
def test_a_state_without_numbers_has_no_age(decode, write):
    read = decode(write(some_state(Mode.INIT, numbers=False), 0))
    assert read["age_s"] is None
    assert read["translation_m"] is None


def test_a_damaged_datagram_is_refused(decode):
    whole = packet(some_state(), 1)
    damaged = bytearray(whole)
    damaged[50] ^= 1
    for datagram in (bytes(damaged), whole[:-1], b"RNAV\x02\x00" + whole[6:], b""):
        with pytest.raises(ValueError, match=r"checksum|no RNAV packet"):
            decode(datagram)


def test_a_packet_fits_into_one_ethernet_frame():
    assert len(packet(some_state(), 2**63 - 1)) == PACKET_BYTES == 776 < 1472


def test_json_is_one_line_with_the_port():
    state = some_state()
    line = json_line(state, 1)
    assert line.count(b"\n") == 1 and line.endswith(b"\n")
    assert json.loads(line)["port"] == state.port.model_dump()


def test_c_reads_the_same_numbers(tmp_path):
    """The header of ``examples/``, compiled: offsets, checksum and flags as a C program sees them."""
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler (cc)")
    program = tmp_path / "udp_listen"
    source = EXAMPLES / "udp_listen.c"
    subprocess.run([compiler, "-std=c11", "-Wall", "-Wextra", "-Werror", "-o", program, source], check=True)

    def run(datagram: bytes) -> subprocess.CompletedProcess[bytes]:
        return subprocess.run([program], input=datagram, capture_output=True)

    state = some_state()
    t = state.T_chaser_target.translation_m
    words = run(packet(state, 12)).stdout.decode().split()
    assert words[:3] == ["12", "mode", "2:"]
    assert [float(word) for word in words[3:6]] == [t.x, t.y, t.z]
    assert float(words[10]) == state.covariance[0]
    assert run(packet(some_state(Mode.COAST), 13)).stdout == b"13 mode 3: hold\n"
    assert run(packet(state, 12)[:-9] + bytes(9)).returncode == 1
