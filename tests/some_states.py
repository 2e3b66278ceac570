"""States with every number different, for tests of what is made of them."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import numpy as np

from astratag.transforms import exp_so3, pose
from pipeline.convert import pose_message, vector_message
from schemas import Mode, PortToPort, RelativeState

T_NS = 1_800_000_000_123_456_789
"""2027-01-15T08:00:00.123456789Z."""
NOT_TRUSTED = [mode for mode in Mode if mode != Mode.TRACK]
EXAMPLES = Path(__file__).resolve().parents[1] / "examples"


def some_state(mode: Mode = Mode.TRACK, *, seed: int = 1, t_ns: int = T_NS, numbers: bool = True) -> RelativeState:
    """Return a state of ``mode``; without ``numbers`` as the filter answers when it has no pose."""
    if not numbers:
        return RelativeState(t_capture_ns=t_ns, mode=mode, rejections=["pose: none"])
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(12, 12)) * np.repeat([2e-3, 1e-2, 5e-3, 2e-2], 3)[:, None]
    return RelativeState(
        t_capture_ns=t_ns,
        mode=mode,
        T_chaser_target=pose_message(pose(exp_so3(rng.normal(size=3)), rng.normal(size=3) + (0, 0, 5))),
        v_chaser_target_m_s=vector_message(rng.normal(size=3) * 0.1),
        omega_chaser_target_in_target_rad_s=vector_message(rng.normal(size=3) * 0.05),
        covariance=(root @ root.T).ravel().tolist(),
        nis=11.5,
        nis_dof=24,
        age_s=0.25,
        hypothesis_probability=0.999,
        marker_ids=[7, 7],
        layers=[0, 1],
        port=PortToPort(
            range_m=5.0,
            axial_m=4.9,
            lateral_m=0.2,
            closing_speed_m_s=0.05,
            lateral_speed_m_s=0.01,
            misalignment_rad=0.02,
            roll_rad=-0.03,
            corridor_angle_rad=0.04,
            in_corridor=True,
        ),
    )


def load_example(name: str) -> ModuleType:
    """Import a file of ``examples/``, which is no package: it must run by itself."""
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
