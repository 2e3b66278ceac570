"""Every filtered state of a recording as a row: CSV, or Parquet with the same columns.

Columns are named after the fields of ``schemas.RelativeState``, units last; ``valid`` is true where the state may be
flown on.  Standard deviations are in the axes of what they belong to: position along, and rotation about, the
chaser's axes; velocity along the chaser's; rate along the target's.  What a state does not have is an empty cell.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.adapters.estimate import POSITION, RATE, ROTATION, VELOCITY, estimate_of, trusted_estimate
from schemas import PortToPort, RelativeState

Row = dict[str, Any]

_SIGMAS = (
    (POSITION, "sigma_position_{}_m"),
    (ROTATION, "sigma_rotation_{}_rad"),
    (VELOCITY, "sigma_v_{}_m_s"),
    (RATE, "sigma_omega_{}_rad_s"),
)


@dataclass(frozen=True)
class Recorded:
    """A state with the stamps it was recorded with."""

    state: RelativeState
    sequence: int
    t_receipt_ns: int


def _named(pattern: str, values: Iterable[float] | None, axes: str = "xyz") -> Row:
    """Return a cell for each component, None throughout when there are no values."""
    cells = [None] * len(axes) if values is None else [float(value) for value in values]
    return {pattern.format(axis): cell for axis, cell in zip(axes, cells, strict=True)}


def row(recorded: Recorded) -> Row:
    """Return a state's cells by column; all rows have the same columns in the same order."""
    state = recorded.state
    pose, estimate = state.T_chaser_target, estimate_of(state)
    v, omega = state.v_chaser_target_m_s, state.omega_chaser_target_in_target_rad_s
    sigma = None if estimate is None else np.sqrt(np.diag(estimate.fixed_axes_covariance()).clip(min=0.0))
    t = None if pose is None else pose.translation_m
    q = None if pose is None else pose.rotation_wxyz
    cells: Row = {
        "t_capture_ns": state.t_capture_ns,
        "sequence": recorded.sequence,
        "t_receipt_ns": recorded.t_receipt_ns,
        "mode": state.mode.name,
        "valid": trusted_estimate(state) is not None,
        "age_s": state.age_s,
        "hypothesis_probability": state.hypothesis_probability,
    }
    cells |= _named("translation_{}_m", None if t is None else (t.x, t.y, t.z))
    cells |= _named("rotation_{}", None if q is None else (q.w, q.x, q.y, q.z), axes="wxyz")
    cells |= _named("v_chaser_target_{}_m_s", None if v is None else (v.x, v.y, v.z))
    cells |= _named("omega_chaser_target_in_target_{}_rad_s", None if omega is None else (omega.x, omega.y, omega.z))
    for part, pattern in _SIGMAS:
        cells |= _named(pattern, None if sigma is None else sigma[part])
    cells |= {
        "nis": state.nis,
        "nis_dof": state.nis_dof,
        "marker_ids": " ".join(str(i) for i in state.marker_ids),
        "layers": " ".join(str(layer) for layer in state.layers),
        "rejections": "; ".join(state.rejections),
    }
    port = {} if state.port is None else state.port.model_dump()
    return cells | {f"port_{name}": port.get(name) for name in PortToPort.model_fields}


def write_csv(rows: Sequence[Row], path: Path) -> None:
    """Write rows as CSV, numbers to full precision, truth values as 1 and 0."""
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, fieldnames=list(rows[0]))
        writer.writeheader()
        for cells in rows:
            writer.writerow({name: int(cell) if isinstance(cell, bool) else cell for name, cell in cells.items()})


def write_parquet(rows: Sequence[Row], path: Path) -> None:
    """Write rows as Parquet."""
    import pyarrow as pa
    from pyarrow import parquet

    table = pa.Table.from_pylist(rows)
    # A column that is empty throughout has no type of its own: they are numbers.
    types = [pa.field(f.name, pa.float64() if pa.types.is_null(f.type) else f.type) for f in table.schema]
    parquet.write_table(table.cast(pa.schema(types)), path)
