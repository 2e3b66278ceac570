"""``relnav export``: the filtered states of a recording as a file of another kind."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from pipeline.adapters.ccsds import Names, aem_text, oem_text, trusted_segments
from pipeline.adapters.table import Recorded, row, write_csv, write_parquet
from pipeline.recording import Recording
from schemas import RelativeState
from schemas.topics import STATE

KINDS = ("csv", "parquet", "oem", "aem")


@dataclass(frozen=True)
class Exported:
    """What an export wrote, of how many states there are."""

    written: int
    states: int


def export(recording: Path, out: Path, kind: str, names: Names, *, created_ns: int) -> Exported:
    """Write a recording's states to ``out`` as one of ``KINDS``.

    ``names`` and ``created_ns`` (UTC) are for the CCSDS files.  Raises ValueError when the recording cannot be read or
    holds no state that the file may hold; what was at ``out`` then stays as it is.
    """
    recorded = list(recorded_states(recording))
    if not recorded:
        raise ValueError(f"{recording} holds no relative states: replay it, and export the run.mcap of that")
    states = [one.state for one in recorded]
    out.parent.mkdir(parents=True, exist_ok=True)
    part = out.with_name(out.name + ".part")
    try:
        if kind in _TABLES:
            _TABLES[kind]([row(one) for one in recorded], part)
            written = len(states)
        else:
            part.write_text(_TEXTS[kind](states, names, created_ns=created_ns))
            written = sum(len(segment) for segment in trusted_segments(states))
        part.replace(out)
    finally:
        part.unlink(missing_ok=True)
    return Exported(written, len(states))


def recorded_states(recording: Path) -> Iterator[Recorded]:
    """Yield the relative states of a recording in file order, with their stamps."""
    for envelope, t_receipt_ns in Recording(recording).envelopes((STATE,)):
        state = envelope.message()
        assert isinstance(state, RelativeState)
        yield Recorded(state, envelope.stamp.sequence, t_receipt_ns)


_TABLES = {"csv": write_csv, "parquet": write_parquet}
_TEXTS = {"oem": oem_text, "aem": aem_text}
