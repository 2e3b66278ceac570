"""From the relative state to what a docking controller watches: port-to-port quantities and the approach corridor.

Port frames have z out of their vehicle.  Docked and unrolled, the ports face each other with their x axes parallel.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from astratag.transforms import inverse, skew, transform
from pipeline.mission import CorridorSection, DockingBoxSection, Mission
from schemas import PortToPort

Array = NDArray[np.float64]

CONTACT_M = 1e-6
"""Closer than this the line of sight has no direction, and the port axis stands for it."""


def port_to_port(
    mission: Mission,
    T_chaser_target: Array,
    v_chaser_target_m_s: Array,
    omega_chaser_target_in_target_rad_s: Array,
) -> PortToPort:
    """Return the chaser's port as seen from the target's, with its motion and where it is in the corridor.

    ``T_chaser_target`` (4, 4), ``v_chaser_target_m_s`` (3,) in chaser axes, the rate (3,) in target axes.  Speeds are
    as an observer on the target's port sees them.  ``roll_rad`` is the turn of the chaser port's x axis about the
    target port's z, from the target port's x.
    """
    T_target_port, T_chaser_port = mission.T_target_port.matrix(), mission.T_chaser_port.matrix()
    T_target_chaser = inverse(T_chaser_target)
    T_port_target = inverse(T_target_port)
    T_targetport_chaserport = T_port_target @ T_target_chaser @ T_chaser_port

    p = T_targetport_chaserport[:3, 3]
    p_target = transform(T_target_chaser, T_chaser_port[:3, 3])
    v_target = -T_target_chaser[:3, :3] @ v_chaser_target_m_s + skew(p_target) @ omega_chaser_target_in_target_rad_s
    v = T_port_target[:3, :3] @ v_target

    range_m, lateral_m = float(np.linalg.norm(p)), float(np.hypot(p[0], p[1]))
    sight = p / range_m if range_m > CONTACT_M else np.array([0.0, 0.0, 1.0])
    chaser_x, chaser_z = T_targetport_chaserport[:3, 0], T_targetport_chaserport[:3, 2]
    port = PortToPort(
        range_m=range_m,
        axial_m=float(p[2]),
        lateral_m=lateral_m,
        closing_speed_m_s=-float(sight @ v),
        lateral_speed_m_s=float(np.hypot(v[0], v[1])),
        misalignment_rad=float(np.arctan2(np.hypot(chaser_z[0], chaser_z[1]), -chaser_z[2])),
        roll_rad=float(np.arctan2(chaser_x[1], chaser_x[0])),
        corridor_angle_rad=float(np.arctan2(lateral_m, p[2])),
        in_corridor=in_corridor(mission.corridor, axial_m=float(p[2]), lateral_m=lateral_m),
        in_keep_out_sphere=bool(np.linalg.norm(p_target) < mission.corridor.keep_out_radius_m),
        axial_closing_speed_m_s=-float(v[2]),
        hold_point_m=next_hold_point_m(mission.corridor, float(p[2])),
    )
    rate_rad_s = float(np.linalg.norm(omega_chaser_target_in_target_rad_s))
    return port.model_copy(
        update={"in_docking_box": not box_violations(mission.corridor.docking_box, port, rate_rad_s)}
    )


def in_corridor(corridor: CorridorSection, *, axial_m: float, lateral_m: float) -> bool:
    """Tell whether a place is inside the corridor: before the port, and inside the cone, which goes on for ever."""
    return axial_m >= 0 and lateral_m <= corridor.port_radius_m + axial_m * float(np.tan(corridor.half_angle_rad))


def next_hold_point_m(corridor: CorridorSection, axial_m: float) -> float | None:
    """Return the axial distance of the next hold point ahead, None when there is none."""
    return next((hold_m for hold_m in corridor.hold_points_m if hold_m <= axial_m), None)


def box_violations(box: DockingBoxSection, port: PortToPort, rate_rad_s: float) -> list[str]:
    """Return, a line each, what a contact with this motion would break; ``rate_rad_s`` is that between the two."""
    slowest, fastest = box.closing_speed_m_s
    checks = (
        ("closing speed", port.axial_closing_speed_m_s, slowest, fastest, "m/s"),
        ("lateral", port.lateral_m, 0.0, box.lateral_m, "m"),
        ("lateral speed", port.lateral_speed_m_s, 0.0, box.lateral_speed_m_s, "m/s"),
        ("misalignment", port.misalignment_rad, 0.0, box.angle_rad, "rad"),
        ("roll", abs(port.roll_rad), 0.0, box.angle_rad, "rad"),
        ("angular rate", rate_rad_s, 0.0, box.angular_rate_rad_s, "rad/s"),
    )
    return [
        f"{name} {value:.4f} {unit} is not in {low:.4g} to {high:.4g}"
        for name, value, low, high, unit in checks
        if not low <= value <= high
    ]
