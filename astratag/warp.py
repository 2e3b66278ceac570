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

from astratag.camera import Camera
from astratag.geometry import TEMPLATE_UNITS, print_from_template
from astratag.surface import Flat, Surface
from astratag.transforms import perturb

Array = NDArray[np.float64]

OUTSIDE_PX = -1e4
"""Where points behind the camera are said to be: far outside every image."""
BEND_STEP_PX = 3.0
_AXES = np.eye(2)[:, :, None]
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
        """Return d pixels / d parameters along unit vectors (2, N): (P, N), at template points (N, 2)."""
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


def _normalised(template: Array) -> Array:
    """Return template points with the print spanning -1..1: keeps the normal equations well conditioned."""
    return np.asarray(template) / (TEMPLATE_UNITS / 2) - 1.0


@dataclass(frozen=True, eq=False)
class HomographyWarp:
    """A plane seen by a camera without distortion; ``H`` (3, 3) with H[2, 2] = 1 takes -1..1 to pixels."""

    H: Array

    @classmethod
    def from_points(cls, template: Array, points_px: Array) -> HomographyWarp:
        """Return the homography through four points (4, 2), or nearest to more (N, 2)."""
        source = _normalised(template)
        if len(source) == 4:
            H = cv2.getPerspectiveTransform(source.astype(np.float32), points_px.astype(np.float32))
        else:
            H = cv2.findHomography(source, points_px)[0]
        return cls(H / H[2, 2])

    def __call__(self, template: Array) -> Array:
        """Return pixels (..., 2)."""
        u = _normalised(template)
        w = u @ self.H[:, :2].T + self.H[:, 2]
        depth = w[..., 2:]
        return np.where(depth > 1e-6, w[..., :2] / np.where(depth > 1e-6, depth, 1.0), OUTSIDE_PX)

    def jacobian(self, template: Array) -> Array:
        """Return the derivative (N, 2, 8) by the first eight entries of H."""
        u = _normalised(template)
        w = u @ self.H[:, :2].T + self.H[:, 2]
        depth = np.maximum(w[:, 2], 1e-6)
        homogeneous = np.concatenate([u, np.ones((len(u), 1))], axis=1) / depth[:, None]
        p = w[:, :2] / depth[:, None]
        J = np.zeros((len(u), 2, 8))
        J[:, 0, 0:3] = homogeneous
        J[:, 1, 3:6] = homogeneous
        J[:, :, 6:8] = -p[:, :, None] * homogeneous[:, None, :2]
        return J

    def slopes(self, template: Array, along: Array) -> Array:
        """Return the derivative (8, N) along unit vectors (2, N) by the first eight entries of H."""
        u = _normalised(template).T
        w = self.H[:, :2] @ u + self.H[:, 2:]
        inverse_depth = 1 / np.maximum(w[2], 1e-6)
        a, b = along * inverse_depth
        by_depth = -(a * w[0] + b * w[1]) * inverse_depth
        S = np.empty((8, u.shape[1]))
        S[0:2], S[2], S[3:5], S[5], S[6:8] = a * u, a, b * u, b, by_depth * u
        return S

    def stepped(self, delta: Array) -> HomographyWarp:
        """Return H + delta."""
        return HomographyWarp((self.H.ravel() + np.append(delta, 0.0)).reshape(3, 3))

    def visible(self, template: Array) -> NDArray[np.bool_]:
        """Return all true: a plane faces the viewer whole."""
        return np.ones(len(template), dtype=bool)

    def step_sigma(self) -> Array:
        """Return no limits (8,)."""
        return np.full(8, np.inf)


@dataclass(frozen=True, eq=False)
class BentWarp:
    """A homography plus ``bend`` (2, 3) pixels times (u^2, uv, v^2): any gently curved print of unknown surface.

    A cylinder of any axis and small sagitta is one of these, to the second order, under weak perspective.
    """

    flat: HomographyWarp
    bend: Array

    def _terms(self, template: Array) -> Array:
        u = _normalised(template)
        return np.stack([u[..., 0] ** 2, u[..., 0] * u[..., 1], u[..., 1] ** 2], axis=-1)

    def __call__(self, template: Array) -> Array:
        """Return pixels (..., 2)."""
        return self.flat(template) + self._terms(template) @ self.bend.T

    def jacobian(self, template: Array) -> Array:
        """Return the derivative (N, 2, 14): eight of the homography, then the bend by rows."""
        terms = self._terms(template)
        J = np.zeros((len(terms), 2, 14))
        J[:, :, :8] = self.flat.jacobian(template)
        J[:, 0, 8:11] = terms
        J[:, 1, 11:14] = terms
        return J

    def slopes(self, template: Array, along: Array) -> Array:
        """Return the derivative (14, N) along unit vectors (2, N)."""
        terms = self._terms(template).T
        return np.concatenate([self.flat.slopes(template, along), along[0] * terms, along[1] * terms])

    def stepped(self, delta: Array) -> BentWarp:
        """Return both parts moved."""
        return BentWarp(self.flat.stepped(delta[:8]), self.bend + delta[8:].reshape(2, 3))

    def visible(self, template: Array) -> NDArray[np.bool_]:
        """Return all true: a gentle bend hides nothing."""
        return np.ones(len(template), dtype=bool)

    def step_sigma(self) -> Array:
        """Return limits (14,) on the bend only: outer edges alone do not tell how it stretches the inside."""
        return np.concatenate([np.full(8, np.inf), np.full(6, BEND_STEP_PX)])

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
    if key not in _KEPT:
        if len(_KEPT) >= MOST_KEPT:
            _KEPT.clear()
        _KEPT[key] = (template, *_on_surface(surface, side_m, np.asarray(template, dtype=float).tobytes()))
    return _KEPT[key][1:]


_KEPT: dict[tuple[Surface, float, int], tuple[Array, Array, Array]] = {}
"""By the identity of a template, which is held here so that no other array can have it."""
MOST_KEPT = 128


@lru_cache(maxsize=64)
def _on_surface(surface: Surface, side_m: float, template: bytes) -> tuple[Array, Array]:
    on_print = print_from_template(np.frombuffer(template).reshape(-1, 2), side_m)
    points, normals = (np.ascontiguousarray(of(on_print).T) for of in (surface.points, surface.normals))
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

    def _cam(self, points_marker: Array) -> Array:
        """Return points (3, N) of the marker frame in the camera's."""
        return self.T_cam_marker[:3, :3] @ points_marker + self.T_cam_marker[:3, 3:]

    def __call__(self, template: Array) -> Array:
        """Return pixels (..., 2)."""
        points_cam = self._cam(self._marker(template)[0])
        behind = points_cam[2] <= 1e-3 * self.side_m
        if not behind.any():
            return self.camera.project(points_cam.T).reshape(np.shape(template))
        points_cam[:, behind] = ((0.0,), (0.0,), (1.0,))
        at = self.camera.project(points_cam.T)
        at[behind] = OUTSIDE_PX
        return at.reshape(np.shape(template))

    def jacobian(self, template: Array) -> Array:
        """Return the derivative (N, 2, 6) by a right perturbation of the pose, metres then radians."""
        return np.stack([self.slopes(template, axis) for axis in _AXES]).transpose(2, 0, 1)

    def slopes(self, template: Array, along: Array) -> Array:
        """Return the derivative (6, N) along unit vectors (2, N)."""
        points_marker = self._marker(template)[0]
        by_point = self.camera.projection_slopes(self._cam(points_marker), along)
        S = np.empty((6, points_marker.shape[1]))
        np.matmul(self.T_cam_marker[:3, :3].T, by_point, out=S[:3])
        x, y, z = points_marker
        gx, gy, gz = S[:3]
        S[3], S[4], S[5] = y * gz - z * gy, z * gx - x * gz, x * gy - y * gx  # g . (theta x X)
        return S

    def stepped(self, delta: Array) -> PoseWarp:
        """Return the pose perturbed."""
        return PoseWarp(self.camera, self.side_m, self.surface, perturb(self.T_cam_marker, delta))

    def visible(self, template: Array) -> NDArray[np.bool_]:
        """Return which points face the camera by more than a grazing angle."""
        if not self.curved:
            t = self.T_cam_marker[:3, 3]
            facing = -float(t @ self.T_cam_marker[:3, 2])  # distance from the plane
            return np.full(len(template), facing > GRAZING_COSINE * math.sqrt(t @ t))
        points_marker, normals_marker = self._marker(template)
        points_cam = self._cam(points_marker)
        towards = -(points_cam * (self.T_cam_marker[:3, :3] @ normals_marker)).sum(axis=0)
        return (towards > GRAZING_COSINE * np.sqrt((points_cam * points_cam).sum(axis=0))) & (points_cam[2] > 0)

    def step_sigma(self) -> Array:
        """Return no limits (6,)."""
        return np.full(6, np.inf)

    @property
    def curved(self) -> bool:
        """Return whether the surface is anything but a plane."""
        return not isinstance(self.surface, Flat)
