"""What a detector reports: markers with their layers, corners, codes and poses."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from astratag.geometry import CELLS
from astratag.surface import Surface

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class LayerDetection:
    """One black square of a marker that was measured in the image.

    ``corners_px`` (4, 2) in the marker's order; ``sigma_px`` the standard deviation of each coordinate,
    calibration of the image noise and what is left of the edge bias included.
    """

    layer: int
    corners_px: Array
    sigma_px: float


@dataclass(frozen=True, eq=False)
class PlanarPose:
    """One of the two poses that explain a planar marker.

    ``probability`` is how likely it is of the two, given the corners and their standard deviations, when neither was
    likelier beforehand.
    """

    T_cam_marker: Array
    reprojection_rms_px: float
    probability: float = 1.0


@dataclass(frozen=True, eq=False)
class Detection:
    """One marker in one image.

    ``corners_px`` (4, 2) is the outer black square in the marker's order: as the pose fitted to all edges has it when
    the surface is declared, else as its own edges have it, or predicted when only inner layers are seen.
    ``T_cam_marker`` (4, 4) is the refined pose on the marker's declared surface with its ``covariance`` (6, 6) (metres
    then radians, right perturbation in marker axes); both None without a camera.  ``warp_grid_px`` (n, n, 2) is the
    print's regular grid as it lies in the image, on curved surfaces.
    """

    family: str
    marker_id: int
    corners_px: Array
    layers: tuple[LayerDetection, ...]
    correlation: float
    hamming: int
    method: str
    """How the code was read: "planar", "tps", "cylinder" or "tracked"."""
    planar_poses: tuple[PlanarPose, ...] = field(default=())
    T_cam_marker: Array | None = None
    covariance: Array | None = None
    reprojection_rms_px: float | None = None
    warp_grid_px: Array | None = None
    cells: int = CELLS
    """How many cells ``correlation`` is worth: fewer when some are hidden, or the print looks blurred."""
    surface: Surface | None = None
    """The curved surface ``T_cam_marker`` is on: as declared, or estimated from this image where it was not."""
