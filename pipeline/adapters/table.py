"""Every filtered state of a recording as a row: CSV, or Parquet with the same columns.

Columns are named after the fields of ``schemas.RelativeState``, units last; ``valid`` is true where the state may be
flown on.  Standard deviations are in the axes of what they belong to: position along, and rotation about, the
chaser's axes; velocity along the chaser's; rate along the target's.  What a state does not have is an empty cell.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.adapters.estimate import POSITION, RATE, ROTATION, VELOCITY, estimate_of, trusted_estimate
from schemas import PortToPort, Quaternion, RelativeState, Vector3

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


def _components(pattern: str, vector: Vector3 | Quaternion | None, axes: str = "xyz") -> Row:
    return {pattern.format(axis): None if vector is None else getattr(vector, axis) for axis in axes}


def _sigmas(state: RelativeState) -> Row:
    estimate = estimate_of(state)
    sigma = None if estimate is None else np.sqrt(np.diag(estimate.fixed_axes_covariance()).clip(min=0.0)).tolist()
    return {
        pattern.format(axis): None if sigma is None else sigma[part][k]
        for part, pattern in _SIGMAS
        for k, axis in enumerate("xyz")
    }


def row(recorded: Recorded) -> Row:
    """Return a state's cells by column; all rows have the same columns in the same order."""
    state = recorded.state
    pose = state.T_chaser_target
    cells: Row = {
        "t_capture_ns": state.t_capture_ns,
        "sequence": recorded.sequence,
        "t_receipt_ns": recorded.t_receipt_ns,
        "mode": state.mode.name,
        "valid": trusted_estimate(state) is not None,
        "age_s": state.age_s,
        "hypothesis_probability": state.hypothesis_probability,
    }
    cells |= _components("translation_{}_m", None if pose is None else pose.translation_m)
    cells |= _components("rotation_{}", None if pose is None else pose.rotation_wxyz, axes="wxyz")
    cells |= _components("v_chaser_target_{}_m_s", state.v_chaser_target_m_s)
    cells |= _components("omega_chaser_target_in_target_{}_rad_s", state.omega_chaser_target_in_target_rad_s)
    cells |= _sigmas(state)
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
