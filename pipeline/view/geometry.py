"""Shapes and bounds for the 3D view and the plots: plain arrays, no viewer.

Frames: the *port frame* is the target's docking port, z out of the target towards the chaser.  A relative
state's tangent is (rho, theta, dv, domega) as the package docstring of ``schemas`` says.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from astratag.geometry import QUIET_MARGIN
from astratag.surface import Cylinder, Surface
from astratag.transforms import inverse, skew, transform
from pipeline.mission import CorridorSection

Array = NDArray[np.float64]

PRINT_STEPS = 24
"""Squares to a side of the mesh a print is drawn on."""
SECTORS = 64
"""Facets around a body or a corridor."""
LIFT = 0.004
"""How far a print stands off its body, as a fraction of the print's side: hides no part of it."""


SIGMAS = 3.0
"""Bounds and ellipsoid are drawn at so many standard deviations."""
ELLIPSOID_SCALE = 10.0
"""The ellipsoid is drawn so many times as large: its millimetres would be lost in a scene of metres."""
DASHES = 9
"""Dashes to a side of a predicted square, each ``DASH_SHARE`` of its place."""
DASH_SHARE = 0.55


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles: vertices (V, 3), indices (T, 3), normals (V, 3), texture coordinates (V, 2) or None."""

    vertices: Array
    triangles: NDArray[np.uint32]
    normals: Array
    texture: Array | None = None


def _grid_triangles(rows: int, columns: int) -> NDArray[np.uint32]:
    """Return the triangles (T, 3) of a grid of rows x columns vertices."""
    at = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = at[:-1, :-1].ravel(), at[:-1, 1:].ravel(), at[1:, 1:].ravel(), at[1:, :-1].ravel()
    return np.concatenate([np.stack([a, d, c], axis=1), np.stack([a, c, b], axis=1)]).astype(np.uint32)


def print_mesh(side_m: float, surface: Surface) -> Mesh:
    """Return a print with its quiet margin as it lies on its surface, in the marker frame."""
    half_m = side_m * (0.5 + QUIET_MARGIN)
    along = np.linspace(-1.0, 1.0, PRINT_STEPS + 1)
    x, y = np.meshgrid(along, -along)
    on_print = half_m * np.stack([x, y], axis=-1).reshape(-1, 2)
    normals = surface.normals(on_print)
    return Mesh(
        vertices=surface.points(on_print) + LIFT * side_m * normals,
        triangles=_grid_triangles(PRINT_STEPS + 1, PRINT_STEPS + 1),
        normals=normals,
        texture=np.stack([(x + 1) / 2, (1 - y) / 2], axis=-1).reshape(-1, 2),
    )


def body_mesh(side_m: float, surface: Surface) -> Mesh:
    """Return a piece of the body a marker is stuck to, in the marker frame: a closed cylinder or a plate."""
    if isinstance(surface, Cylinder):
        return _cylinder_mesh(surface, length_m=max(3.0 * surface.radius_m, 3.0 * side_m))
    corners = side_m * np.array([(-1.0, 1.0, 0.0), (1.0, 1.0, 0.0), (-1.0, -1.0, 0.0), (1.0, -1.0, 0.0)])
    return Mesh(corners, _grid_triangles(2, 2), np.tile([0.0, 0.0, 1.0], (4, 1)))


def _cylinder_mesh(surface: Cylinder, length_m: float) -> Mesh:
    c, s = np.cos(surface.axis_rad), np.sin(surface.axis_rad)
    R_marker_axis = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    around = np.linspace(0.0, 2 * np.pi, SECTORS + 1)
    rim = np.stack([np.zeros_like(around), np.sin(around), np.cos(around)], axis=-1)
    ends = length_m / 2 * np.array([-1.0, 1.0])
    axis = np.array([1.0, 0.0, 0.0])
    rows, normals = [], []
    for end, facing in ((ends[0], -axis), (ends[1], axis)):
        cap = end * axis + surface.radius_m * rim
        rows += [np.tile(end * axis, (len(rim), 1)), cap, cap]
        normals += [np.tile(facing, (len(rim), 1))] * 2 + [rim]
    order = [0, 1, 2, 5, 4, 3]
    vertices = np.concatenate([rows[k] for k in order]) @ R_marker_axis.T - (0.0, 0.0, surface.radius_m)
    return Mesh(
        vertices, _grid_triangles(len(order), len(rim)), np.concatenate([normals[k] for k in order]) @ R_marker_axis.T
    )


def corridor_strips(corridor: CorridorSection) -> list[Array]:
    """Return the approach corridor as line strips (N, 3) in the port frame: rings and generators of its cone."""
    angles = np.linspace(0.0, 2 * np.pi, SECTORS + 1)
    slope = np.tan(corridor.half_angle_rad)

    def ring(z_m: float) -> Array:
        radius_m = corridor.port_radius_m + z_m * slope
        return np.stack([radius_m * np.cos(angles), radius_m * np.sin(angles), np.full_like(angles, z_m)], axis=-1)

    near, far = ring(corridor.stop_m), ring(corridor.start_m)
    rings = [ring(z_m) for z_m in np.linspace(corridor.stop_m, corridor.start_m, 4)]
    return rings + [np.stack([near[k], far[k]]) for k in range(0, SECTORS, SECTORS // 8)]


def hold_point_strips(corridor: CorridorSection) -> list[Array]:
    """Return the hold points as squares across the corridor (5, 3) in the port frame, each touching its cone."""
    square = np.array([(1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0), (1.0, 1.0)]) / np.sqrt(2.0)
    slope = np.tan(corridor.half_angle_rad)
    return [
        np.column_stack([(corridor.port_radius_m + z_m * slope) * square, np.full(len(square), z_m)])
        for z_m in corridor.hold_points_m
    ]


def keep_out_strips(corridor: CorridorSection, T_target_port: Array) -> list[Array]:
    """Return three great circles (N, 3) of the keep-out sphere about the target's origin, in the port frame."""
    angles = np.linspace(0.0, 2 * np.pi, SECTORS + 1)
    circle = corridor.keep_out_radius_m * np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], axis=-1)
    centre = inverse(T_target_port)[:3, 3]
    return [centre + np.roll(circle, shift, axis=1) for shift in range(3)]


def corridor_mesh(corridor: CorridorSection) -> Mesh:
    """Return the corridor's cone in the port frame."""
    rings = [strip for strip in corridor_strips(corridor) if len(strip) == SECTORS + 1]
    outward = rings[-1] * (1.0, 1.0, 0.0)
    normals = outward / np.linalg.norm(outward, axis=1, keepdims=True)
    return Mesh(np.concatenate(rings), _grid_triangles(len(rings), SECTORS + 1), np.tile(normals, (len(rings), 1)))


def ellipsoid(covariance_m2: Array, sigmas: float = 3.0) -> tuple[Array, Array]:
    """Return half axes (3,) in metres and the quaternion (x, y, z, w) of a covariance's (3, 3) ellipsoid."""
    variances, axes = np.linalg.eigh(covariance_m2)
    if np.linalg.det(axes) < 0:  # eigenvectors have either sign; a quaternion needs a rotation
        axes = axes * (1.0, 1.0, -1.0)
    return sigmas * np.sqrt(np.maximum(variances, 0.0)), Rotation.from_matrix(axes).as_quat()


@dataclass(frozen=True, eq=False)
class PortMotion:
    """Where the chaser's port is in the target's port frame, how it moves, and how well both are known.

    ``p_port_m`` (3,), ``jacobian`` (3, 12) of p by the state's tangent; range, lateral offset and closing speed
    in metres and m/s, each with its derivative (12,) by the same tangent.
    """

    p_port_m: Array
    jacobian: Array
    range_m: float
    range_by: Array
    lateral_m: float
    lateral_by: Array
    closing_m_s: float
    closing_by: Array

    def plotted(self) -> Iterator[tuple[str, float, float, Array]]:
        """Give each quantity's name with the unit of its plot, the plot's units to an SI unit, value and derivative."""
        yield "range_m", 1.0, self.range_m, self.range_by
        yield "lateral_mm", 1e3, self.lateral_m, self.lateral_by
        yield "closing_mm_s", 1e3, self.closing_m_s, self.closing_by


def port_motion(
    T_chaser_target: Array, v_m_s: Array, omega_rad_s: Array, T_chaser_port: Array, T_target_port: Array
) -> PortMotion:
    """Return the motion of the chaser's port in the target's port frame, to first order in the state's errors.

    With c the chaser's port in chaser axes, T_chaser_target = (R, t) and right perturbation (rho, theta):
    p = R^T (c - t), dp = -rho + p x theta;  p' = -omega x p - w, w = R^T v, dw = w x theta + R^T dv.
    """
    R = T_chaser_target[:3, :3]
    p = transform(inverse(T_chaser_target), T_chaser_port[:3, 3])
    w = R.T @ v_m_s
    rate = -np.cross(omega_rad_s, p) - w
    p_by = np.hstack([-np.eye(3), skew(p), np.zeros((3, 6))])
    rate_by = -skew(omega_rad_s) @ p_by
    rate_by[:, 3:6] -= skew(w)
    rate_by[:, 6:9] -= R.T
    rate_by[:, 9:12] += skew(p)
    R_port_target = T_target_port[:3, :3].T
    p, p_by = R_port_target @ (p - T_target_port[:3, 3]), R_port_target @ p_by
    rate, rate_by = R_port_target @ rate, R_port_target @ rate_by
    range_m, lateral_m = float(np.linalg.norm(p)), float(np.hypot(p[0], p[1]))
    u = p / max(range_m, 1e-9)
    sideways = np.array([p[0], p[1], 0.0]) / max(lateral_m, 1e-9)
    u_by = (np.eye(3) - np.outer(u, u)) @ p_by / max(range_m, 1e-9)
    return PortMotion(
        p_port_m=p,
        jacobian=p_by,
        range_m=range_m,
        range_by=u @ p_by,
        lateral_m=lateral_m,
        lateral_by=sideways @ p_by,
        closing_m_s=float(-u @ rate),
        closing_by=-(u @ rate_by) - rate @ u_by,
    )


def chaser_pose(T_chaser_target: Array, T_target_port: Array) -> Array:
    """Return the chaser in the target's port frame."""
    return inverse(T_target_port) @ inverse(T_chaser_target)


def dashed(corners_px: Array) -> Array:
    """Return a closed polygon (N, 2) as short strips (N * DASHES, 2, 2)."""
    starts = np.arange(DASHES) / DASHES
    along = np.stack([starts, starts + DASH_SHARE / DASHES], axis=1)
    sides = np.roll(corners_px, -1, axis=0) - corners_px
    return (corners_px[:, None, None] + along[None, :, :, None] * sides[:, None, None]).reshape(-1, 2, 2)


def target_bodies(markers: list[tuple[Array, float, Surface]]) -> list[tuple[Array, Mesh]]:
    """Return the bodies under the markers (T_target_marker, side_m, surface), each once, with its T_target_body."""
    bodies: list[tuple[Array, Mesh]] = []
    seen: list[tuple[float, Array, Array]] = []
    for T_target_marker, side_m, surface in markers:
        if isinstance(surface, Cylinder):
            c, s = np.cos(surface.axis_rad), np.sin(surface.axis_rad)
            axis = T_target_marker[:3, :3] @ (c, s, 0.0)
            centre = transform(T_target_marker, np.array([0.0, 0.0, -surface.radius_m]))
            if any(_coincide(surface.radius_m, centre, axis, *other) for other in seen):
                continue
            seen.append((surface.radius_m, centre, axis))
        bodies.append((T_target_marker, body_mesh(side_m, surface)))
    return bodies


def _coincide(
    radius_m: float, centre: Array, axis: Array, other_radius_m: float, other_centre: Array, other_axis: Array
) -> bool:
    """Tell whether two cylinders have one axis and one radius, to a percent of it."""
    slack_m = 0.01 * radius_m
    beside_m = np.linalg.norm(np.cross(centre - other_centre, other_axis))
    return bool(abs(radius_m - other_radius_m) < slack_m and beside_m < slack_m and abs(axis @ other_axis) > 0.9999)
