"""Prints bent about cylinders nobody measured: a warp with free radius and axis, and squares to begin fitting it with.

A square wrapped about an axis parallel to one of its sides has its four corners in a plane: a rectangle, narrower the
larger the half-angle it spans.  So a quad in the image, a half-angle and an axis fix two poses.  Where only one side is
seen whole, that side and the angle the print is turned by fix one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from itertools import product

import numpy as np
from numpy.typing import NDArray

from astratag.camera import Camera, pixel, pixel_slope
from astratag.compiled import CUBE, INT, MATRIX, REAL, VECTOR, array, compiled
from astratag.frame import FRAME, bent_darker_inside
from astratag.geometry import TEMPLATE_UNITS, print_from_template, square
from astratag.surface import Cylinder
from astratag.transforms import pose
from astratag.warp import GRAZING_COSINE, NEAREST_SIDES, OUTSIDE_PX, PoseWarp, along_both_axes, in_camera

Array = NDArray[np.float64]

FOCAL_WIDTHS = 1.2
"""Focal length, in image widths, that a camera is taken to have when nobody knows it."""
LEAST_CURVATURE, MOST_CURVATURE = 0.02, 2.4
"""Sides per radius: a bend that nothing would show, and a print that spans 138 degrees."""
CURVATURE_STEP, AXIS_STEP_RAD = 0.3, 0.3
"""How far one step may take them, as standard deviations: edges seen square-on say little of either."""
NEAREST = 1e-3
"""How near the camera, in sides, a point is taken to be that is nearer, or behind it."""
HALF_ANGLES_RAD = (0.12, 0.3, 0.6)
"""How far a square may bend to either side of its middle: layers of radii 0.8 to 2 sides are near one of these."""
TURNS_RAD = (1.13, 1.175, 1.22, 1.265, 1.31, 1.355, 1.4)
LEANS_RAD = (-0.2, -0.1, 0.0, 0.1, 0.2)
"""How far a print of which only the near side is whole may be turned about it (65 to 80 degrees), and along it.

Every other one will do to tell which sides are a print's.
"""


@dataclass(frozen=True, eq=False)
class CylinderWarp:
    """A print of known size on a cylinder of unknown radius and axis: a pose on the cylinder it is believed to be."""

    pose: PoseWarp

    @classmethod
    def of(cls, camera: Camera, side_m: float, curvature: float, axis_rad: float, T_cam_marker: Array) -> CylinderWarp:
        """Return a print at ``T_cam_marker`` with ``curvature`` sides per radius, kept within what is believable."""
        curvature = min(max(float(curvature), LEAST_CURVATURE), MOST_CURVATURE)
        return cls(PoseWarp(camera, side_m, Cylinder(side_m / curvature, float(axis_rad)), T_cam_marker))

    @property
    def surface(self) -> Cylinder:
        """Return the cylinder."""
        assert isinstance(self.pose.surface, Cylinder)
        return self.pose.surface

    @property
    def curvature(self) -> float:
        """Return how many sides the radius goes into."""
        return self.pose.side_m / self.surface.radius_m

    def __call__(self, template: Array) -> Array:
        """Return pixels (..., 2)."""
        return self._seen(template)[0].reshape(np.shape(template))

    def jacobian(self, template: Array) -> Array:
        """Return the derivative (N, 2, 8): the pose's six, then curvature and axis."""
        return along_both_axes(self, template)

    def slopes(self, template: Array, along: Array) -> Array:
        """Return the derivative (8, N) along image vectors (2, N)."""
        surface, pose = self.surface, self.pose
        on_print, along = print_from_template(np.ascontiguousarray(template), pose.side_m), np.ascontiguousarray(along)
        return _slopes(
            on_print, pose.T_cam_marker, pose.camera.lens, surface.radius_m, surface.axis_rad, pose.side_m, along
        )

    def stepped(self, delta: Array) -> CylinderWarp:
        """Return pose, curvature and axis moved."""
        moved = self.pose.stepped(delta[:6])
        curvature, axis_rad = self.curvature + delta[6], self.surface.axis_rad + delta[7]
        return CylinderWarp.of(moved.camera, moved.side_m, curvature, axis_rad, moved.T_cam_marker)

    def visible(self, template: Array) -> NDArray[np.bool_]:
        """Return which points face the camera by more than a grazing angle."""
        return self._seen(template)[1]

    def facing(self, template: Array) -> Array:
        """Return pixels (N, 2) of template points (N, 2), those that do not face the viewer outside every image."""
        at, visible = self._seen(template)
        at[~visible] = OUTSIDE_PX
        return at

    def _seen(self, template: Array) -> tuple[Array, NDArray[np.bool_]]:
        surface, pose = self.surface, self.pose
        on_print = print_from_template(np.reshape(template, (-1, 2)), pose.side_m)
        lens, nearest_m = pose.camera.lens, NEAREST_SIDES * pose.side_m
        return _seen_on_cylinder(on_print, pose.T_cam_marker, lens, surface.radius_m, surface.axis_rad, nearest_m)

    def step_sigma(self) -> Array:
        """Return limits (8,) on curvature and axis only."""
        return _STEP_SIGMA

    def of_whole(self, side_m: float, scale: float) -> CylinderWarp:
        """Return the warp of a print ``side_m`` wide, given that of the square in its middle, ``scale`` of its size."""
        T = self.pose.T_cam_marker.copy()
        T[:3, 3] *= side_m * scale / self.pose.side_m
        return CylinderWarp.of(self.pose.camera, side_m, self.curvature / scale, self.surface.axis_rad, T)

    def turned(self, quarter_turns: int) -> CylinderWarp:
        """Return the same print with its top at the side ``quarter_turns`` clockwise of this one's."""
        c, s = ((1, 0), (0, -1), (-1, 0), (0, 1))[quarter_turns % 4]
        T, surface = self.pose.T_cam_marker.copy(), self.surface
        x, y = T[:3, 0].copy(), T[:3, 1].copy()
        T[:3, 0], T[:3, 1] = c * x + s * y, c * y - s * x
        surface = Cylinder(surface.radius_m, surface.axis_rad + quarter_turns * np.pi / 2)
        return CylinderWarp(PoseWarp(self.pose.camera, self.pose.side_m, surface, T))


_STEP_SIGMA = np.append(np.full(6, np.inf), (CURVATURE_STEP, AXIS_STEP_RAD))
_STEP_SIGMA.flags.writeable = False


@compiled(MATRIX, MATRIX, VECTOR, REAL, REAL, REAL)
def _seen_on_cylinder(
    on_print: Array, T_cam_marker: Array, lens: Array, radius_m: float, axis_rad: float, nearest_m: float
) -> tuple[Array, NDArray[np.bool_]]:
    """Return the pixels (N, 2) of print points (N, 2) on a cylinder, and which (N,) face the viewer.

    As ``PoseWarp`` does, which keeps where they are on a surface; an unknown cylinder is another with every step.
    """
    R, c, s = T_cam_marker, math.cos(axis_rad), math.sin(axis_rad)
    at, facing = np.empty((len(on_print), 2)), np.empty(len(on_print), dtype=np.bool_)
    for i in range(len(on_print)):
        x, y = on_print[i, 0], on_print[i, 1]
        angle = (c * y - s * x) / radius_m
        sine, cosine = math.sin(angle), math.cos(angle)
        along, across = c * x + s * y, radius_m * sine
        X, Y, Z = in_camera(R, c * along - s * across, s * along + c * across, radius_m * (cosine - 1))
        p, q = -s * sine, c * sine
        towards = -(
            X * (R[0, 0] * p + R[0, 1] * q + R[0, 2] * cosine)
            + Y * (R[1, 0] * p + R[1, 1] * q + R[1, 2] * cosine)
            + Z * (R[2, 0] * p + R[2, 1] * q + R[2, 2] * cosine)
        )
        facing[i] = towards > GRAZING_COSINE * math.sqrt(X * X + Y * Y + Z * Z) and Z > 0
        before = nearest_m < Z
        u, v = pixel(X, Y, Z if before else 1.0, lens)
        at[i, 0], at[i, 1] = u if before else OUTSIDE_PX, v if before else OUTSIDE_PX
    return at, facing


@compiled(MATRIX, MATRIX, VECTOR, REAL, REAL, REAL, MATRIX)
def _slopes(
    on_print: Array, T_cam_marker: Array, lens: Array, radius_m: float, axis_rad: float, side_m: float, along: Array
) -> Array:
    """Return how the pixels of print points (N, 2) move along image vectors (2, N): (8, N).

    With the pose, perturbed from the right as by ``pose_jacobian``, and with the cylinder's curvature and axis.
    """
    T, c, s = T_cam_marker, math.cos(axis_rad), math.sin(axis_rad)
    radius_step = -(radius_m**2) / side_m  # d radius / d curvature
    slopes = np.empty((8, len(on_print)))
    for i in range(len(on_print)):
        x, y = on_print[i, 0], on_print[i, 1]
        a, b = c * x + s * y, c * y - s * x  # along the axis, and across it
        angle = b / radius_m
        sine, cosine = math.sin(angle), math.cos(angle)
        across, inward = radius_m * sine, radius_m * (cosine - 1)
        px, py = c * a - s * across, s * a + c * across
        X = T[0, 0] * px + T[0, 1] * py + T[0, 2] * inward + T[0, 3]
        Y = T[1, 0] * px + T[1, 1] * py + T[1, 2] * inward + T[1, 3]
        Z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * inward + T[2, 3]
        bowed, slid, turned = radius_step * (sine - angle * cosine), b - across, a * (1 - cosine)
        ux, uy, uz = -s * bowed, c * bowed, radius_step * (cosine - 1 + angle * sine)  # by curvature
        vx, vy, vz = c * slid - s * turned, s * slid + c * turned, a * sine  # by the axis
        gx, gy, gz = pixel_slope(X, Y, Z, lens, along[0, i], along[1, i])
        wx = T[0, 0] * gx + T[1, 0] * gy + T[2, 0] * gz
        wy = T[0, 1] * gx + T[1, 1] * gy + T[2, 1] * gz
        wz = T[0, 2] * gx + T[1, 2] * gy + T[2, 2] * gz
        slopes[0, i], slopes[1, i], slopes[2, i] = wx, wy, wz
        slopes[3, i], slopes[4, i], slopes[5, i] = py * wz - inward * wy, inward * wx - px * wz, px * wy - py * wx
        slopes[6, i], slopes[7, i] = ux * wx + uy * wy + uz * wz, vx * wx + vy * wy + vz * wz
    return slopes


def assumed_camera(width_px: int, height_px: int) -> Camera:
    """Return a camera to bend prints with when the real one is unknown."""
    K = np.eye(3)
    K[:2] *= FOCAL_WIDTHS * max(width_px, height_px)
    K[:2, 2] = (width_px - 1) / 2, (height_px - 1) / 2
    return Camera(K, width=width_px, height=height_px)


@dataclass(frozen=True, eq=False)
class Bent:
    """Squares of side 1 on cylinders, M about each of Q places: curvature and axis (M,), and poses."""

    camera: Camera
    curvature: Array
    axis_rad: Array
    rotation: Array
    """(Q, M, 3, 3), R_cam_marker."""
    translation: Array
    """(Q, M, 3), t_cam_marker, sides."""

    @property
    def count(self) -> int:
        """Return how many there are."""
        return self.translation.shape[0] * self.translation.shape[1]

    @property
    def all(self) -> NDArray[np.int64]:
        """Return the place and model (Q M, 2) of each."""
        return np.argwhere(np.ones(self.translation.shape[:2], dtype=bool))

    def warp(self, place: int, model: int) -> CylinderWarp:
        """Return one of them as a warp of a print one metre wide."""
        T = pose(self.rotation[place, model], self.translation[place, model])
        return CylinderWarp.of(self.camera, 1.0, self.curvature[model], self.axis_rad[model], T)

    def framed(self, gray: NDArray[np.uint8], least: int) -> NDArray[np.int64]:
        """Return the place and model (N, 2) of those that are darker inside than outside, on at least so many sides."""
        frame, _ = _on_cylinders(print_from_template(FRAME, 1.0), self.curvature, self.axis_rad)
        rotation, translation = np.ascontiguousarray(self.rotation), np.ascontiguousarray(self.translation)
        return np.argwhere(bent_darker_inside(gray, frame, rotation, translation, self.camera.lens, NEAREST, least))

    def project(self, template: Array, which: NDArray[np.int64] | None = None) -> Array:
        """Return where template points (S, 2) lie in the image (N, S, 2) for those ``which`` (N, 2), or for ``all``."""
        return self.seen(template, which)[0]

    def seen(self, template: Array, which: NDArray[np.int64] | None = None) -> tuple[Array, NDArray[np.bool_]]:
        """Return the same, and which of the points (N, S) face the viewer by more than a grazing angle."""
        return _project_bent(
            print_from_template(template, 1.0),
            self.curvature,
            self.axis_rad,
            np.ascontiguousarray(self.rotation),
            np.ascontiguousarray(self.translation),
            np.ascontiguousarray(self.all if which is None else which),
            self.camera.lens,
        )


@compiled(MATRIX, VECTOR, VECTOR)
def _on_cylinders(on_print: Array, curvature: Array, axis_rad: Array) -> tuple[Array, Array]:
    """Return where print points (S, 2) lie on each of M cylinders, and their outward normals, (M, S, 3)."""
    count = len(on_print)
    points, normals = np.empty((len(curvature), count, 3)), np.empty((len(curvature), count, 3))
    for m in range(len(curvature)):
        c, s, radius = math.cos(axis_rad[m]), math.sin(axis_rad[m]), 1 / curvature[m]
        for i in range(count):
            x, y = on_print[i]
            along, angle = c * x + s * y, (c * y - s * x) / radius
            sine, cosine = math.sin(angle), math.cos(angle)
            points[m, i, 0] = c * along - s * radius * sine
            points[m, i, 1] = s * along + c * radius * sine
            points[m, i, 2] = radius * (cosine - 1)
            normals[m, i, 0], normals[m, i, 1], normals[m, i, 2] = -s * sine, c * sine, cosine
    return points, normals


@compiled(MATRIX, VECTOR, VECTOR, array(REAL, 4), CUBE, array(INT, 2), VECTOR)
def _project_bent(
    on_print: Array,
    curvature: Array,
    axis_rad: Array,
    rotation: Array,
    translation: Array,
    which: NDArray[np.int64],
    lens: Array,
) -> tuple[Array, NDArray[np.bool_]]:
    """Return where print points (S, 2) are seen (N, S, 2), and which face the viewer (N, S).

    Of the squares ``which`` (N, 2), place and model, of those that ``Bent`` describes.
    """
    points, normals = _on_cylinders(on_print, curvature, axis_rad)
    count = len(on_print)
    at, facing = np.empty((len(which), count, 2)), np.empty((len(which), count), dtype=np.bool_)
    for n in range(len(which)):
        q, m = which[n]
        R, t = rotation[q, m], translation[q, m]
        for i in range(count):
            X, N = points[m, i], normals[m, i]
            x = R[0, 0] * X[0] + R[0, 1] * X[1] + R[0, 2] * X[2] + t[0]
            y = R[1, 0] * X[0] + R[1, 1] * X[1] + R[1, 2] * X[2] + t[1]
            z = R[2, 0] * X[0] + R[2, 1] * X[1] + R[2, 2] * X[2] + t[2]
            towards = -(
                x * (R[0, 0] * N[0] + R[0, 1] * N[1] + R[0, 2] * N[2])
                + y * (R[1, 0] * N[0] + R[1, 1] * N[1] + R[1, 2] * N[2])
                + z * (R[2, 0] * N[0] + R[2, 1] * N[1] + R[2, 2] * N[2])
            )
            facing[n, i] = towards > GRAZING_COSINE * math.sqrt(x * x + y * y + z * z)
            at[n, i, 0], at[n, i, 1] = pixel(x, y, max(z, NEAREST), lens)
    return at, facing


def bent_through(camera: Camera, quads: Array, half_angles_rad: tuple[float, ...] = HALF_ANGLES_RAD) -> Bent:
    """Return the bent squares whose corners are seen at quads (Q, 4, 2), clockwise from the top left.

    Both poses of each rectangle from the derivative of its homography at the centre: Collins and Bartoli,
    "Infinitesimal plane-based pose estimation", IJCV 2014, equations 14 to 20.
    """
    half_angles = np.array(half_angles_rad)
    seen = np.ascontiguousarray(camera.undistort(quads.reshape(-1, 2)).reshape(-1, 4, 2))
    curvature, axis_rad = np.repeat(2 * half_angles, 4), np.tile((0.0, 0.0, np.pi / 2, np.pi / 2), len(half_angles))
    return Bent(camera, curvature, axis_rad, *_through(seen, half_angles))


def bent_beside(camera: Camera, sides: Array, *, coarse: bool = False) -> Bent:
    """Return bent squares whose tops, straight and whole, are seen at sides (Q, 2, 2), and whose bottoms turn away.

    The pose whose rotation is given takes two points to where they are seen: linear in its translation.
    """
    half_angle, rotations, ends = _beside_models(2 if coarse else 1)
    rays = camera.undistort(sides.reshape(-1, 2)).reshape(-1, 2, 2)
    (x, y), zero = (rays[:, 1] - rays[:, 0]).T, np.zeros(len(rays))
    c, s = x / np.hypot(x, y), y / np.hypot(x, y)
    frames = _aim(rays.mean(axis=1)) @ _matrices([[c, -s, zero], [s, c, zero], [zero, zero, zero + 1]])
    rotation, translation = _beside(frames, np.ascontiguousarray(rays), rotations, ends)
    return Bent(camera, 2 * half_angle, 0.0 * half_angle, rotation, translation)


@cache
def _beside_models(step: int) -> tuple[Array, Array, Array]:
    """Return half-angles (M,), rotations (M, 3, 3) by turns and leans, and where the ends of the top are (M, 2, 3)."""
    half_angle, turn, lean = np.array(list(product(HALF_ANGLES_RAD, TURNS_RAD[::step], LEANS_RAD[::step]))).T
    c, s, zero = np.cos(lean), np.sin(lean), np.zeros(len(lean))
    leant = _matrices([[c, zero, s], [zero, zero + 1, zero], [-s, zero, c]])
    c, s = np.cos(turn), np.sin(turn)
    turned = _matrices([[zero + 1, zero, zero], [zero, -c, s], [zero, -s, -c]])  # y up and z out of the face
    top = print_from_template(square(0.0, TEMPLATE_UNITS)[:2], 1.0)
    return half_angle, leant @ turned, np.stack([Cylinder(0.5 / h).points(top) for h in half_angle])


@compiled(CUBE, CUBE, CUBE, CUBE)
def _beside(frames: Array, rays: Array, rotations: Array, ends: Array) -> tuple[Array, Array]:
    """Return poses (Q, M, 3, 3) and (Q, M, 3): each of frames (Q, 3, 3) turned each way (M, 3, 3).

    Translations are those that take ``ends`` (M, 2, 3) to ``rays`` (Q, 2, 2) with the least squared error.
    """
    count, models = len(frames), len(rotations)
    rotation, translation = np.zeros((count, models, 3, 3)), np.empty((count, models, 3))
    for q in range(count):
        (u, v), (other_u, other_v) = rays[q]
        sum_u, sum_v, squares = u + other_u, v + other_v, u * u + v * v + other_u * other_u + other_v * other_v
        for m in range(models):
            R = rotation[q, m]
            for i in range(3):
                for j in range(3):
                    for k in range(3):
                        R[i, j] += frames[q, i, k] * rotations[m, k, j]
            x, y, across = 0.0, 0.0, 0.0
            for end in range(2):
                at, (u, v) = ends[m, end], rays[q, end]
                depth = R[2, 0] * at[0] + R[2, 1] * at[1] + R[2, 2] * at[2]
                dx = u * depth - (R[0, 0] * at[0] + R[0, 1] * at[1] + R[0, 2] * at[2])
                dy = v * depth - (R[1, 0] * at[0] + R[1, 1] * at[1] + R[1, 2] * at[2])
                x, y, across = x + dx, y + dy, across + u * dx + v * dy
            z = ((sum_u * x + sum_v * y) / 2 - across) / (squares - (sum_u * sum_u + sum_v * sum_v) / 2)
            translation[q, m, 0], translation[q, m, 1] = (x + sum_u * z) / 2, (y + sum_v * z) / 2
            translation[q, m, 2] = z
    return rotation, translation


def _matrices(rows: list[list[Array]]) -> Array:
    """Return matrices (N, 3, 3) from rows of columns of entries (N,)."""
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _aim(p: Array) -> Array:
    """Return the shortest rotations (..., 3, 3) that take the optical axis to rays (..., 2) at unit depth."""
    x, y = p[..., 0], p[..., 1]
    r2 = x * x + y * y
    t = np.sqrt(r2 + 1)
    k = -1 / (t * (t + 1))
    return _matrices([[1 + k * x * x, k * x * y, x / t], [k * x * y, 1 + k * y * y, y / t], [-x / t, -y / t, 1 / t]])


@compiled(MATRIX)
def _at_centre(quad: Array) -> tuple[float, float, Array]:
    """Return where a homography takes the centre of a -1..1 square, y up, x and y, and its derivative (2, 2) there."""
    d1, d2, total = quad[1] - quad[2], quad[3] - quad[2], quad[0] - quad[1] + quad[2] - quad[3]
    area = d1[0] * d2[1] - d1[1] * d2[0]
    area = area if abs(area) > 1e-12 else np.inf
    g, h = (total[0] * d2[1] - total[1] * d2[0]) / area, (d1[0] * total[1] - d1[1] * total[0]) / area
    across, down = quad[1] - quad[0] + g * quad[1], quad[3] - quad[0] + h * quad[3]
    depth = 1 + (g + h) / 2
    depth = depth if abs(depth) > 1e-6 else 1e-6
    x, y = (quad[0] + (across + down) / 2) / depth
    J = np.empty((2, 2))
    for i, at in enumerate((x, y)):
        J[i, 0], J[i, 1] = (across[i] - g * at) / depth / 2, -(down[i] - h * at) / depth / 2
    return x, y, J


@compiled(CUBE, VECTOR)
def _through(quads: Array, half_angles: Array) -> tuple[Array, Array]:
    """Return poses (Q, 4 H, 3, 3) and (Q, 4 H, 3) of ``bent_through``, of rays at unit depth (Q, 4, 2).

    For each half-angle (H,) both axes, and for each of these both poses.
    """
    models = 4 * len(half_angles)
    rotation, translation = np.empty((len(quads), models, 3, 3)), np.empty((len(quads), models, 3))
    for q in range(len(quads)):
        x, y, J = _at_centre(quads[q])
        k = math.sqrt(x * x + y * y + 1)  # how far a ray reaches at unit depth
        to = -1 / (k * (k + 1))
        turn = ((1 + to * x * x, to * x * y, x / k), (to * x * y, 1 + to * y * y, y / k), (-x / k, -y / k, 1 / k))
        b00, b01 = turn[0][0] - x * turn[2][0], turn[0][1] - x * turn[2][1]
        b10, b11 = turn[1][0] - y * turn[2][0], turn[1][1] - y * turn[2][1]
        area = b00 * b11 - b01 * b10
        for m in range(models):
            half = half_angles[m // 4]
            narrow = 0.5 * math.sin(half) / half  # half the chord across the axis
            right, up = (0.5, narrow) if m % 4 < 2 else (narrow, 0.5)
            (jxr, jxu), (jyr, jyu) = (J[0, 0] / right, J[0, 1] / up), (J[1, 0] / right, J[1, 1] / up)
            xr, xu = (b11 * jxr - b01 * jyr) / area, (b11 * jxu - b01 * jyu) / area
            yr, yu = (b00 * jyr - b10 * jxr) / area, (b00 * jyu - b10 * jxu) / area
            sxx, syy, sxy = xr * xr + xu * xu, yr * yr + yu * yu, xr * yr + xu * yu
            gamma = max(math.sqrt((sxx + syy) / 2 + math.hypot((sxx - syy) / 2, sxy)), 1e-12)
            xr, xu, yr, yu = xr / gamma, xu / gamma, yr / gamma, yu / gamma
            sign = 1.0 if m % 2 == 0 else -1.0
            zr = sign * math.sqrt(max(1 - xr * xr - yr * yr, 0.0))
            zu = sign * math.sqrt(max(1 - xu * xu - yu * yu, 0.0))
            if xr * xu + yr * yu > 0:
                zu = -zu
            columns = ((xr, yr, zr), (xu, yu, zu), (yr * zu - zr * yu, zr * xu - xr * zu, xr * yu - yr * xu))
            sagitta = 0.5 * (1 - math.cos(half)) / half
            for i in range(3):
                for j in range(3):
                    a, b, c = columns[j]
                    rotation[q, m, i, j] = turn[i][0] * a + turn[i][1] * b + turn[i][2] * c
            for i in range(3):
                translation[q, m, i] = (x, y, 1.0)[i] / gamma + rotation[q, m, i, 2] * sagitta
    return rotation, translation
