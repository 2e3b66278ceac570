"""The camera: pinhole with Brown-Conrady distortion, and the files its calibration comes in.

Camera frame: x right, y down, z forward.  Pixels: (0, 0) is the centre of the top-left pixel.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from numpy.typing import ArrayLike, NDArray

from astratag.checks import file_path, numbers, whole
from astratag.compiled import MATRIX, REAL, VECTOR, compiled

Array = NDArray[np.float64]
DISTORTION_TERMS = 5
LEAST_FOCAL = 0.02
"""Focal length, as a fraction of the image, below which K is in another unit: a pinhole would see 175 degrees."""
LARGEST_PX = 1e9
"""What is more in K is damaged."""
NEAREST = 1e-9
"""Points nearer than this, or behind the camera, have the derivative of one there."""
SKEW_ALLOWED = 1e-6
"""Skew, as a fraction of the focal length, that is rounding left by a calibration program."""
PRINCIPAL_POINT_SLACK = 0.15
"""How far from the middle, as a fraction of the image, a principal point may lie and still be believed."""


@dataclass(frozen=True, eq=False)
class Camera:
    """A calibrated camera: K (3, 3) in pixels, distortion (k1, k2, p1, p2, k3), image width and height in pixels."""

    K: Array
    distortion: Array = field(default_factory=lambda: np.zeros(DISTORTION_TERMS))
    width: int = 0
    height: int = 0
    lens: Array = field(init=False, repr=False)
    """All of its numbers (9,), for compiled functions: fx, fy, cx, cy, k1, k2, p1, p2, k3."""

    def __init__(self, K: ArrayLike, distortion: ArrayLike = (0.0,) * DISTORTION_TERMS, *, width: int, height: int):
        K, distortion = numbers(K, "K"), numbers(distortion, "distortion").ravel()
        width, height = whole(width, "width", 1), whole(height, "height", 1)
        if K.shape != (3, 3) or not np.allclose(K[2], (0, 0, 1)):
            raise ValueError(f"K must be 3x3 with last row 0 0 1, got {K.tolist()}. Is it transposed?")
        if min(K[0, 0] / width, K[1, 1] / height) < LEAST_FOCAL or np.abs(K).max() > LARGEST_PX:
            raise ValueError(
                f"K must have positive focal lengths in pixels, got fx {K[0, 0]:g}, fy {K[1, 1]:g} about "
                f"({K[0, 2]:g}, {K[1, 2]:g}). Are they in millimetres?"
            )
        if max(abs(K[0, 1]), abs(K[1, 0])) > SKEW_ALLOWED * K[0, 0]:
            raise ValueError(
                f"K must have no skew, got {K[0, 1]} and {K[1, 0]} off the diagonal: the model is OpenCV's"
            )
        K[0, 1] = K[1, 0] = 0.0
        if distortion.size not in (0, 4, DISTORTION_TERMS):
            raise ValueError(
                f"distortion must be 5 terms (k1, k2, p1, p2, k3), got {distortion.size}: "
                "fisheye and rational models are not supported"
            )
        padded = np.zeros(DISTORTION_TERMS)
        padded[: distortion.size] = distortion
        lens = np.concatenate([K[[0, 1, 0, 1], [0, 1, 2, 2]], padded])
        fields = {"K": K, "distortion": padded, "width": width, "height": height, "lens": lens}
        for name, value in fields.items():
            object.__setattr__(self, name, value)

    @classmethod
    def load(
        cls, path: str | Path, *, width: int | None = None, height: int | None = None, scale: bool = False
    ) -> Camera:
        """Read the reference's JSON (``camera_matrix``, ``distortion_coefficients``) or ROS camera_info YAML.

        Given the images' width and height, the camera returned is for that size: a calibration of another
        size is refused, or scaled when ``scale`` says that the picture was only resized.  The reference's
        JSON does not tell its size; the principal point must then lie near the middle of the images, and
        without images to compare the size is twice the principal point.
        Raises ValueError with what is missing or wrong.
        """
        for pixels, name in ((width, "width"), (height, "height")):
            if pixels is not None:
                whole(pixels, name, 1)
        path = file_path(path)
        try:
            text = path.read_text()
            data: Any = json.loads(text) if path.suffix == ".json" else yaml.safe_load(text)
        except (OSError, ValueError, RecursionError, yaml.YAMLError) as error:
            raise ValueError(f"cannot read camera file {path}: {' '.join(str(error).split())}") from error
        try:
            K = _numbers(data["camera_matrix"]).reshape(3, 3)
            distortion = _numbers(data.get("distortion_coefficients", ()))
            model = data.get("distortion_model", "plumb_bob")
            size = (int(data.get("image_width", 0)), int(data.get("image_height", 0)))
        except (KeyError, TypeError, AttributeError, ValueError, OverflowError) as error:
            raise ValueError(f"camera file {path} has no readable camera_matrix and distortion_coefficients") from error
        if model not in ("plumb_bob", ""):
            raise ValueError(f"camera file {path}: distortion model {model!r} is not supported, only plumb_bob")
        if not all(size) and np.isfinite(K).all():
            size = _size_from_principal_point(K, width, height)
        try:
            camera = cls(K, distortion, width=size[0], height=size[1])
        except ValueError as error:
            raise ValueError(f"camera file {path}: {error}") from error
        if width is None or height is None:
            return camera
        if scale:
            return camera.scaled(width, height)
        camera.require_size(width, height)
        return camera

    def scaled(self, width: int, height: int) -> Camera:
        """Return this camera for the same picture resized to width x height pixels."""
        width, height = whole(width, "width", 1), whole(height, "height", 1)
        sx, sy = width / self.width, height / self.height
        K = self.K.copy()
        K[0] *= sx
        K[1] *= sy
        K[0, 2], K[1, 2] = (self.K[0, 2] + 0.5) * sx - 0.5, (self.K[1, 2] + 0.5) * sy - 0.5
        return Camera(K, self.distortion, width=width, height=height)

    def require_size(self, width: int, height: int) -> None:
        """Raise ValueError when images of width x height pixels are not what this calibration is for."""
        if (width, height) != (self.width, self.height):
            raise ValueError(
                f"the calibration is for {self.width}x{self.height}, the images are {width}x{height}: "
                "calibrate at that size, or scale the calibration if the picture was only resized"
            )

    def project(self, points_cam: Array) -> Array:
        """Return pixels (N, 2) of points (N, 3) in the camera frame, which must lie in front of it (z > 0)."""
        return _project(np.ascontiguousarray(points_cam, dtype=float).reshape(-1, 3), self.lens)

    def projection_jacobian(self, points_cam: Array) -> Array:
        """Return d pixel / d point (N, 2, 3), px per metre, at points (N, 3) in the camera frame (z > 0)."""
        return _projection_jacobian(np.ascontiguousarray(points_cam, dtype=float).reshape(-1, 3), self.lens)

    def undistort(self, points_px: Array) -> Array:
        """Return where pixels (N, 2) would be without distortion, in normalised coordinates x/z, y/z (N, 2)."""
        points = np.ascontiguousarray(points_px, dtype=float).reshape(-1, 1, 2)
        if not (self.distortion.any() and len(points)):
            return (points.reshape(-1, 2) - self.K[:2, 2]) / self.K.diagonal()[:2]
        criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 1e-12)
        return cv2.undistortPoints(points, self.K, self.distortion, criteria=criteria).reshape(-1, 2)


@compiled(REAL, REAL, REAL, VECTOR)
def pixel(x: float, y: float, z: float, lens: Array) -> tuple[float, float]:
    """Return where a point of the camera frame is seen, pixels."""
    x, y = x / z, y / z
    k1, k2, p1, p2, k3 = lens[4], lens[5], lens[6], lens[7], lens[8]
    xx, yy, xy2 = x * x, y * y, 2 * x * y
    rr = xx + yy
    radial = 1 + rr * (k1 + rr * (k2 + rr * k3))
    u = x * radial + p1 * xy2 + p2 * (rr + 2 * xx)
    v = y * radial + p1 * (rr + 2 * yy) + p2 * xy2
    return lens[0] * u + lens[2], lens[1] * v + lens[3]


@compiled(REAL, REAL, REAL, VECTOR, REAL, REAL)
def pixel_slope(x: float, y: float, z: float, lens: Array, a: float, b: float) -> tuple[float, float, float]:
    """Return how a point's pixel moves along the image vector (a, b) when the point does, px per metre.

    Brown, "Close-range camera calibration", 1971, differentiated.
    """
    inverse_z = 1 / max(z, NEAREST)
    x, y = x * inverse_z, y * inverse_z
    k1, k2, p1, p2, k3 = lens[4], lens[5], lens[6], lens[7], lens[8]
    a, b = a * lens[0] * inverse_z, b * lens[1] * inverse_z
    rr = x * x + y * y
    radial = 1 + rr * (k1 + rr * (k2 + rr * k3))
    slope = 2 * (k1 + rr * (2 * k2 + rr * (3 * k3)))  # d radial / d r, over r
    mixed = x * y * slope + 2 * (p1 * x + p2 * y)
    by_x = radial + x * x * slope + 2 * p1 * y + 6 * p2 * x
    by_y = radial + y * y * slope + 6 * p1 * y + 2 * p2 * x
    a, b = a * by_x + b * mixed, a * mixed + b * by_y
    return a, b, -(a * x + b * y)


@compiled(MATRIX, VECTOR)
def _project(points_cam: Array, lens: Array) -> Array:
    """Return the pixels (N, 2) of points (N, 3)."""
    at = np.empty((len(points_cam), 2))
    for i in range(len(points_cam)):
        at[i, 0], at[i, 1] = pixel(points_cam[i, 0], points_cam[i, 1], points_cam[i, 2], lens)
    return at


@compiled(MATRIX, VECTOR)
def _projection_jacobian(points_cam: Array, lens: Array) -> Array:
    """Return how the pixels of points (N, 3) move with them (N, 2, 3)."""
    J = np.empty((len(points_cam), 2, 3))
    for i in range(len(points_cam)):
        x, y, z = points_cam[i]
        J[i, 0, 0], J[i, 0, 1], J[i, 0, 2] = pixel_slope(x, y, z, lens, 1.0, 0.0)
        J[i, 1, 0], J[i, 1, 1], J[i, 1, 2] = pixel_slope(x, y, z, lens, 0.0, 1.0)
    return J


def _size_from_principal_point(K: Array, width: int | None, height: int | None) -> tuple[int, int]:
    """Return the image size of a calibration that does not tell it: the images' own if K fits them, else 2 c."""
    guess = (round(2 * K[0, 2]), round(2 * K[1, 2]))
    if width is None or height is None:
        return guess
    near = (
        abs(guess[0] / width - 1) < 2 * PRINCIPAL_POINT_SLACK and abs(guess[1] / height - 1) < 2 * PRINCIPAL_POINT_SLACK
    )
    return (width, height) if near else guess


def _numbers(value: Any) -> Array:
    """Return the numbers of a nested list or of ROS's {rows, cols, data}, flat."""
    if isinstance(value, dict):
        value = value["data"]
    return np.array(value, dtype=float).ravel()
