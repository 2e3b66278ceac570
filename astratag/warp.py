"""Warps: smooth models of how the flat print lies in the image, with derivatives for fitting.

A warp takes template points (700 units to the side, y down) to pixels, (0, 0) the centre of the top-left
pixel.  Three are fitted to edges: a homography, a homography with a bend, and a pose on a known surface.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from astratag.camera import Camera, pixel, pixel_slope
from astratag.compiled import CUBE, INT, MATRIX, REAL, VECTOR, compiled
from astratag.geometry import TEMPLATE_UNITS, print_from_template
from astratag.surface import Flat, Surface
from astratag.transforms import perturb

Array = NDArray[np.float64]

OUTSIDE_PX = -1e4
"""Where points behind the camera are said to be: far outside every image."""
FREE = np.full(8, np.inf)
FREE.flags.writeable = False
"""Of parameters that one step may take anywhere, not to be changed."""
BEND_STEP_PX = 3.0
LEAST_AREA = 1e-9
LEAST_DEPTH = 1e-6
"""Homogeneous depth below which a point of a plane is at infinity or behind the camera."""
NEAREST_SIDES = 1e-3
"""Points of a print nearer than so many of its sides are behind the camera."""
GRAZING_COSINE = 0.12
"""Print seen flatter than this (83 degrees from its normal) is not used."""


class FittedWarp(Protocol):
    """A warp with parameters: what the edge fit needs to know of it."""

    def __call__(self, template: Array) -> Array:
        """Return pixels (..., 2) of template points (..., 2)."""
        ...

    def jacobian(self, template: Array) -> Array:
        """Return d pixels / d parameters (N, 2, P) at template points (N, 2)."""
        ...

    def slopes(self, template: Array, along: Array) -> Array:
        """Return d pixels / d parameters along image vectors (2, N): (P, N), at template points (N, 2)."""
        ...

    def stepped(self, delta: Array) -> Self:
        """Return the warp with its parameters moved by delta (P,)."""
        ...

    def visible(self, template: Array) -> NDArray[np.bool_]:
        """Return which template points (N, 2) face the viewer."""
        ...

    def step_sigma(self) -> Array:
        """Return how far (P,) one step may take each parameter, as a standard deviation; inf where free."""
        ...


def _listed(template: Array) -> Array:
    """Return template points (..., 2) as a list (N, 2) in C order."""
    return np.ascontiguousarray(template, dtype=float).reshape(-1, 2)


def along_both_axes(warp: FittedWarp, template: Array) -> Array:
    """Return d pixels / d parameters (N, 2, P) at template points (N, 2), from its slopes along rows and columns."""
    axes = np.zeros((2, 2, len(template)))
    axes[0, 0] = axes[1, 1] = 1.0
    return np.stack([warp.slopes(template, along).T for along in axes], axis=1)


@dataclass(frozen=True, eq=False)
class HomographyWarp:
    """A plane seen by a camera without distortion; ``H`` (3, 3) with H[2, 2] = 1 takes -1..1 to pixels."""

    H: Array

    @classmethod
    def from_points(cls, template: Array, points_px: Array) -> HomographyWarp:
        """Return the homography through four points (4, 2), or nearest to more (N, 2)."""
        source = np.asarray(template) / (TEMPLATE_UNITS / 2) - 1.0  # -1..1 keeps the normal equations well conditioned
        if len(source) == 4:
            H = plane_between(source, np.ascontiguousarray(points_px, dtype=float))
        else:
            H = cv2.findHomography(source, points_px)[0]
        return cls(H / H[2, 2])

    def __call__(self, template: Array) -> Array:
        """Return pixels (..., 2)."""
        return _through_plane(_listed(template), self.H).reshape(np.shape(template))

    def jacobian(self, template: Array) -> Array:
        """Return the derivative (N, 2, 8) by the first eight entries of H."""
        return along_both_axes(self, template)

    def slopes(self, template: Array, along: Array) -> Array:
        """Return the derivative (8, N) along image vectors (2, N) by the first eight entries of H."""
        return _plane_slopes(_listed(template), self.H, np.ascontiguousarray(along))

    def stepped(self, delta: Array) -> HomographyWarp:
        """Return H + delta."""
        return HomographyWarp((self.H.ravel() + np.append(delta, 0.0)).reshape(3, 3))

    def visible(self, template: Array) -> NDArray[np.bool_]:
        """Return all true: a plane faces the viewer whole."""
        return np.ones(len(template), dtype=bool)

    def step_sigma(self) -> Array:
        """Return no limits (8,)."""
        return FREE[:8]


@dataclass(frozen=True, eq=False)
class BentWarp:
    """A homography plus ``bend`` (2, 3) pixels times (u^2, uv, v^2): any gently curved print of unknown surface.

    A cylinder of any axis and small sagitta is one of these, to the second order, under weak perspective.
    """

    flat: HomographyWarp
    bend: Array

    def __call__(self, template: Array) -> Array:
        """Return pixels (..., 2)."""
        points = _listed(template)
        return (_through_plane(points, self.flat.H) + _bend_terms(points) @ self.bend.T).reshape(np.shape(template))

    def jacobian(self, template: Array) -> Array:
        """Return the derivative (N, 2, 14): eight of the homography, then the bend by rows."""
        return along_both_axes(self, template)

    def slopes(self, template: Array, along: Array) -> Array:
        """Return the derivative (14, N) along image vectors (2, N)."""
        terms = _bend_terms(_listed(template)).T
        return np.concatenate([self.flat.slopes(template, along), along[0] * terms, along[1] * terms])

    def stepped(self, delta: Array) -> BentWarp:
        """Return both parts moved."""
        return BentWarp(self.flat.stepped(delta[:8]), self.bend + delta[8:].reshape(2, 3))

    def visible(self, template: Array) -> NDArray[np.bool_]:
        """Return all true: a gentle bend hides nothing."""
        return np.ones(len(template), dtype=bool)

    def step_sigma(self) -> Array:
        """Return limits (14,) on the bend only: outer edges alone do not tell how it stretches the inside."""
        return np.concatenate([FREE[:8], np.full(6, BEND_STEP_PX)])

    @classmethod
    def from_points(cls, template: Array, points_px: Array) -> BentWarp:
        """Return the bent warp nearest to seven or more points (N, 2): homography first, then the bend."""
        warp = cls(HomographyWarp.from_points(template, points_px), np.zeros((2, 3)))
        for _ in range(3):
            J = warp.jacobian(template).reshape(-1, 14)
            scale = np.linalg.norm(J, axis=0) + 1e-12
            delta = np.linalg.lstsq(J / scale, (points_px - warp(template)).ravel(), rcond=1e-6)[0]
            warp = warp.stepped(delta / scale)
        return warp


def on_surface(surface: Surface, side_m: float, template: Array) -> tuple[Array, Array]:
    """Return the points and outward normals (3, N) in the marker frame of template points (..., 2); not to be changed.

    They are kept, because the same few sets of points are projected in every frame: those of templates that cannot be
    changed by the array itself, others by their numbers.
    """
    if template.flags.writeable:
        return _on_surface(surface, side_m, np.asarray(template, dtype=float).tobytes())
    key = (surface, side_m, id(template))
    kept = _KEPT.get(key)
    if kept is None:
        if len(_KEPT) >= MOST_KEPT:
            _KEPT.clear()
        kept = _KEPT[key] = (template, *_on_surface(surface, side_m, np.asarray(template, dtype=float).tobytes()))
    return kept[1:]


_KEPT: dict[tuple[Surface, float, int], tuple[Array, Array, Array]] = {}
"""By the identity of a template, which is held here so that no other array can have it."""
MOST_KEPT = 128


@lru_cache(maxsize=64)
def _on_surface(surface: Surface, side_m: float, template: bytes) -> tuple[Array, Array]:
    on_print = print_from_template(np.frombuffer(template).reshape(-1, 2), side_m)
    points, normals = (np.ascontiguousarray(part.T) for part in surface.wrapped(on_print))
    points.flags.writeable = normals.flags.writeable = False
    return points, normals


@dataclass(frozen=True, eq=False)
class PoseWarp:
    """A print of known size on a known surface at ``T_cam_marker``, seen by a calibrated camera."""

    camera: Camera
    side_m: float
    surface: Surface
    T_cam_marker: Array

    def _marker(self, template: Array) -> tuple[Array, Array]:
        """Return points and outward normals (3, N) in the marker frame."""
        return on_surface(self.surface, self.side_m, template)

    def __call__(self, template: Array) -> Array:
        """Return pixels (..., 2)."""
        points_marker, nearest_m = self._marker(template)[0], NEAREST_SIDES * self.side_m
        at = seen_from(points_marker, self.T_cam_marker, self.camera.lens, nearest_m)
        return at.reshape(np.shape(template))

    def jacobian(self, template: Array) -> Array:
        """Return the derivative (N, 2, 6) by a right perturbation of the pose, metres then radians."""
        return pose_jacobian(self._marker(template)[0], self.T_cam_marker, self.camera.lens)

    def slopes(self, template: Array, along: Array) -> Array:
        """Return the derivative (6, N) along image vectors (2, N)."""
        along = np.ascontiguousarray(along)
        return _pose_slopes(self._marker(template)[0], self.T_cam_marker, self.camera.lens, along)

    def stepped(self, delta: Array) -> PoseWarp:
        """Return the pose perturbed."""
        return PoseWarp(self.camera, self.side_m, self.surface, perturb(self.T_cam_marker, delta))

    def visible(self, template: Array) -> NDArray[np.bool_]:
        """Return which points face the camera by more than a grazing angle."""
        if not self.curved:
            t = self.T_cam_marker[:3, 3]
            facing = -float(t @ self.T_cam_marker[:3, 2])  # distance from the plane
            return np.full(len(template), facing > GRAZING_COSINE * math.sqrt(t @ t))
        return _facing(*self._marker(template), self.T_cam_marker)

    def step_sigma(self) -> Array:
        """Return no limits (6,)."""
        return FREE[:6]

    @property
    def curved(self) -> bool:
        """Return whether the surface is anything but a plane."""
        return not isinstance(self.surface, Flat)


@compiled(MATRIX)
def sides_of(corners: Array) -> tuple[float, float]:
    """Return the mean and the largest length of the sides of a quad (4, 2)."""
    total, longest = 0.0, 0.0
    for i in range(4):
        dx, dy = corners[i, 0] - corners[i - 1, 0], corners[i, 1] - corners[i - 1, 1]
        length = np.sqrt(dx * dx + dy * dy)
        total, longest = total + length, max(longest, length)
    return total / 4, longest


@compiled(CUBE, INT, INT)
def quads_inside(quads: Array, height: int, width: int) -> NDArray[np.bool_]:
    """Return which quads (Q, 4, 2) have all their corners inside an image."""
    inside = np.ones(len(quads), np.bool_)
    for q in range(len(quads)):
        for x, y in quads[q]:
            inside[q] &= 0 <= x <= width - 1 and 0 <= y <= height - 1
    return inside


@compiled(MATRIX)
def plane_of(quad: Array) -> Array:
    """Return the homography (3, 3) that takes the unit square, clockwise from the origin, to a quad (4, 2).

    Heckbert, "Fundamentals of texture mapping and image warping", 1989.  Zeros in its last row where three corners are
    on a line.
    """
    (x0, y0), (x1, y1), (x2, y2), (x3, y3) = quad
    ax, ay, bx, by = x1 - x2, y1 - y2, x3 - x2, y3 - y2
    sx, sy = x0 - x1 + x2 - x3, y0 - y1 + y2 - y3
    area, g, h = ax * by - ay * bx, 0.0, 0.0
    if abs(area) > LEAST_AREA:
        g, h = (sx * by - sy * bx) / area, (ax * sy - ay * sx) / area
    H = np.empty((3, 3))
    H[0, 0], H[0, 1], H[0, 2] = x1 - x0 + g * x1, x3 - x0 + h * x3, x0
    H[1, 0], H[1, 1], H[1, 2] = y1 - y0 + g * y1, y3 - y0 + h * y3, y0
    H[2, 0], H[2, 1], H[2, 2] = g, h, 1.0
    return H


@compiled(MATRIX, MATRIX)
def plane_between(quad: Array, other: Array) -> Array:
    """Return the homography (3, 3), up to its scale, that takes one quad (4, 2) to another (4, 2)."""
    A, H = plane_of(quad), plane_of(other)
    adjugate, product = np.empty((3, 3)), np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            k, m, n, o = (i + 1) % 3, (i + 2) % 3, (j + 1) % 3, (j + 2) % 3
            adjugate[j, i] = A[k, n] * A[m, o] - A[k, o] * A[m, n]
    for i in range(3):
        for j in range(3):
            for k in range(3):
                product[i, j] += H[i, k] * adjugate[k, j]
    return product


@compiled(MATRIX, MATRIX)
def _through_plane(template: Array, H: Array) -> Array:
    """Return the pixels (N, 2) of template points (N, 2) under a homography of the print spanning -1..1."""
    at = np.empty(template.shape)
    for i in range(len(template)):
        u, v = template[i, 0] / (TEMPLATE_UNITS / 2) - 1.0, template[i, 1] / (TEMPLATE_UNITS / 2) - 1.0
        depth = H[2, 0] * u + H[2, 1] * v + H[2, 2]
        if depth > LEAST_DEPTH:
            at[i, 0] = (H[0, 0] * u + H[0, 1] * v + H[0, 2]) / depth
            at[i, 1] = (H[1, 0] * u + H[1, 1] * v + H[1, 2]) / depth
        else:
            at[i] = OUTSIDE_PX
    return at


@compiled(MATRIX, MATRIX, MATRIX)
def _plane_slopes(template: Array, H: Array, along: Array) -> Array:
    """Return the derivative (8, N) of ``_through_plane`` along image vectors (2, N) by the first eight entries of H."""
    slopes = np.empty((8, len(template)))
    for i in range(len(template)):
        u, v = template[i, 0] / (TEMPLATE_UNITS / 2) - 1.0, template[i, 1] / (TEMPLATE_UNITS / 2) - 1.0
        depth = max(H[2, 0] * u + H[2, 1] * v + H[2, 2], LEAST_DEPTH)
        x, y = (H[0, 0] * u + H[0, 1] * v + H[0, 2]) / depth, (H[1, 0] * u + H[1, 1] * v + H[1, 2]) / depth
        right, down = along[0, i] / depth, along[1, i] / depth
        nearer = -(x * right + y * down)
        slopes[0, i], slopes[1, i], slopes[2, i] = right * u, right * v, right
        slopes[3, i], slopes[4, i], slopes[5, i] = down * u, down * v, down
        slopes[6, i], slopes[7, i] = nearer * u, nearer * v
    return slopes


@compiled(MATRIX)
def _bend_terms(template: Array) -> Array:
    """Return u^2, uv and v^2 (N, 3) of template points (N, 2), the print spanning -1..1."""
    terms = np.empty((len(template), 3))
    for i in range(len(template)):
        u, v = template[i, 0] / (TEMPLATE_UNITS / 2) - 1.0, template[i, 1] / (TEMPLATE_UNITS / 2) - 1.0
        terms[i, 0], terms[i, 1], terms[i, 2] = u * u, u * v, v * v
    return terms


@compiled(MATRIX, REAL, REAL, REAL)
def in_camera(T: Array, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Return a point of the marker frame in the camera's."""
    right = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
    down = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
    return right, down, T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]


@compiled(MATRIX, MATRIX, VECTOR, REAL)
def seen_from(points_marker: Array, T_cam_marker: Array, lens: Array, nearest_m: float) -> Array:
    """Return the pixels (N, 2) of points (3, N), those not before the camera outside every image."""
    at = np.empty((points_marker.shape[1], 2))
    for i in range(len(at)):
        x, y, z = in_camera(T_cam_marker, points_marker[0, i], points_marker[1, i], points_marker[2, i])
        before = z > nearest_m
        u, v = pixel(x, y, z if before else 1.0, lens)
        at[i, 0], at[i, 1] = u if before else OUTSIDE_PX, v if before else OUTSIDE_PX
    return at


@compiled(MATRIX, VECTOR, REAL, REAL, REAL, REAL, REAL)
def _pose_slope(
    T: Array, lens: Array, x: float, y: float, z: float, right: float, down: float
) -> tuple[float, float, float, float, float, float]:
    """Return how a point's pixel moves along the image vector (right, down) as the pose is perturbed."""
    x_cam, y_cam, z_cam = in_camera(T, x, y, z)
    a, b, c = pixel_slope(x_cam, y_cam, z_cam, lens, right, down)
    gx = T[0, 0] * a + T[1, 0] * b + T[2, 0] * c
    gy = T[0, 1] * a + T[1, 1] * b + T[2, 1] * c
    gz = T[0, 2] * a + T[1, 2] * b + T[2, 2] * c
    return gx, gy, gz, y * gz - z * gy, z * gx - x * gz, x * gy - y * gx  # g . (theta x X)


@compiled(MATRIX, MATRIX, VECTOR, MATRIX)
def _pose_slopes(points_marker: Array, T_cam_marker: Array, lens: Array, along: Array) -> Array:
    """Return how the pixels of points (3, N) move along image vectors (2, N) as the pose is perturbed: (6, N)."""
    slopes = np.empty((6, points_marker.shape[1]))
    for i in range(points_marker.shape[1]):
        x, y, z = points_marker[0, i], points_marker[1, i], points_marker[2, i]
        by = _pose_slope(T_cam_marker, lens, x, y, z, along[0, i], along[1, i])
        slopes[0, i], slopes[1, i], slopes[2, i], slopes[3, i], slopes[4, i], slopes[5, i] = by
    return slopes


@compiled(MATRIX, MATRIX, VECTOR)
def pose_jacobian(points_marker: Array, T_cam_marker: Array, lens: Array) -> Array:
    """Return the derivative (N, 2, 6) of the pixels of points (3, N) by a right perturbation of the pose."""
    J = np.empty((points_marker.shape[1], 2, 6))
    for i in range(len(J)):
        x, y, z = points_marker[0, i], points_marker[1, i], points_marker[2, i]
        by = _pose_slope(T_cam_marker, lens, x, y, z, 1.0, 0.0)
        J[i, 0, 0], J[i, 0, 1], J[i, 0, 2], J[i, 0, 3], J[i, 0, 4], J[i, 0, 5] = by
        by = _pose_slope(T_cam_marker, lens, x, y, z, 0.0, 1.0)
        J[i, 1, 0], J[i, 1, 1], J[i, 1, 2], J[i, 1, 3], J[i, 1, 4], J[i, 1, 5] = by
    return J


@compiled(MATRIX, MATRIX, MATRIX)
def _facing(points_marker: Array, normals_marker: Array, T_cam_marker: Array) -> NDArray[np.bool_]:
    """Return which points (3, N) with outward normals (3, N) face the camera by more than a grazing angle."""
    R, facing = T_cam_marker, np.empty(points_marker.shape[1], np.bool_)
    for i in range(len(facing)):
        x, y, z = in_camera(T_cam_marker, points_marker[0, i], points_marker[1, i], points_marker[2, i])
        p, q, r = normals_marker[0, i], normals_marker[1, i], normals_marker[2, i]
        towards = 0.0
        for axis, across in enumerate((x, y, z)):
            towards -= across * (R[axis, 0] * p + R[axis, 1] * q + R[axis, 2] * r)
        length = np.sqrt(x * x + y * y + z * z)
        facing[i] = towards > GRAZING_COSINE * length and z > 0
    return facing
