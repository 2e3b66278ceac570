"""42's text: read the way its sources read it, by sscanf's patterns."""

import re
from datetime import UTC, datetime, timedelta

import pytest

from pipeline.adapters.fortytwo import BRACKETS, CURRENT, message
from schemas import Mode
from tests.some_states import NOT_TRUSTED, T_NS, some_state

NUMBER = r"\s*([-+]?\d+\.\d+e[-+]\d+)"
"""What ``%le`` takes, white space before it included."""


def scan(text: str, key: str, count: int, dialect) -> list[float] | None:
    """Read ``key = count numbers`` as 42's sscanf does, None when there is no such line."""
    opening, closing = re.escape(dialect.opening), re.escape(dialect.closing)
    match = re.search(f"^{re.escape(key)} = {opening}{NUMBER * count}{closing}$", text, re.MULTILINE)
    return None if match is None else [float(group) for group in match.groups()]


@pytest.mark.parametrize("dialect", [CURRENT, BRACKETS], ids=lambda dialect: dialect.end)
def test_a_trusted_state_becomes_a_spacecraft(dialect):
    state = some_state()
    text = message(state, spacecraft=3, dialect=dialect).decode()
    t, q = state.T_chaser_target.translation_m, state.T_chaser_target.rotation_wxyz
    v, omega = state.v_chaser_target_m_s, state.omega_chaser_target_in_target_rad_s
    assert scan(text, "SC[3].PosR", 3, dialect) == pytest.approx([t.x, t.y, t.z], rel=1e-12)
    assert scan(text, "SC[3].VelR", 3, dialect) == pytest.approx([v.x, v.y, v.z], rel=1e-12)
    assert scan(text, "SC[3].B[0].qn", 4, dialect) == pytest.approx([q.x, q.y, q.z, q.w], rel=1e-12)
    assert scan(text, "SC[3].B[0].wn", 3, dialect) == pytest.approx([omega.x, omega.y, omega.z], rel=1e-12)
    assert text.endswith(f"\n{dialect.end}\n")


@pytest.mark.parametrize("mode", NOT_TRUSTED, ids=lambda mode: mode.name)
def test_any_other_state_is_the_time_alone(mode):
    assert message(some_state(mode)).decode() == "TIME 2027-015-08:00:00.123456789\n[EOF]\n"


def test_the_time_is_read_back_to_the_nanosecond():
    match = re.match(r"TIME (\d+)-(\d+)-(\d+):(\d+):(\d+\.\d+)\n", message(some_state(Mode.LOST)).decode())
    year, day, hour, minute = (int(group) for group in match.groups()[:4])
    whole, fraction = match[5].split(".")
    start = datetime(year, 1, 1, hour, minute, int(whole), tzinfo=UTC) + timedelta(days=day - 1)
    assert int(start.timestamp()) * 10**9 + int(fraction) == T_NS


def test_a_message_fits_into_what_42_reads_at_once():
    """Lines of at most 511 characters, 16383 in all."""
    text = message(some_state(), spacecraft=999)
    assert len(text) < 16383
    assert max(len(line) for line in text.splitlines()) < 511
