"""The entrants: how each marker is printed, and how each detector reads a picture.

Prints are square sheets with all they need around them: quiet zone or outer data cells.  On equal area, all sheets are
as wide as AstraTag's; at nominal size, what each maker calls the tag's size is AstraTag's black side (100 mm, as in the
paper).  Reported corners are pixels with (0, 0) at the centre of the top-left pixel, in each detector's own order.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from importlib.util import find_spec
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from astratag import Camera, Detector, Surface, Tracker, load_dictionary
from astratag.geometry import QUIET_MARGIN
from benchmarks.detection.scenes import SHEET_M, SIDE_M
from pipeline.texture import Texture, print_coverage

Array = NDArray[np.float64]
Raster = NDArray[np.uint8]
Seen = tuple[int, Array]
"""What was read: identity, and its four corners (4, 2) in pixels."""
Reader = Callable[[Raster, Camera], list[Seen]]

CELL_TEXELS = 128
IDENTITIES = 20
"""Identities drawn from, of each family that has as many."""
APRILTAG_IDS = 587
"""How many of an AprilTag family are active: all of tag36h11."""
FRACTAL = "FRACTAL_3L_6"
FRACTAL_CELLS = 14
FRACTAL_SQUARES = {0: 1.0, 1: 3 / 7, 2: 1 / 7}
"""Side of each level's square, by its identity, as a fraction of the outermost."""
DICTIONARY = load_dictionary()
ARUCO = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)


@dataclass(frozen=True)
class Marker:
    """One kind of marker: ``draw`` gives sheet rasters (rows, columns), 0 ink to 255 white, of identities 0 to ids-1.

    ``squares`` maps what may be read to the side of the square whose corners come with it, as a fraction of the
    sheet's; None stands for the identity printed.  ``nominal`` is the side the maker calls the tag's size, so too.
    """

    draw: Callable[[int], Raster]
    ids: int
    nominal: float
    squares: Mapping[int | None, float]
    order: tuple[int, int, int, int] = (0, 1, 2, 3)
    """Which of top left, top right, bottom right, bottom left the detector's corners are."""

    def sheet_m(self, size: str) -> float:
        """Return how wide the sheet is at "equal" area or "nominal" size."""
        return SHEET_M if size == "equal" else SIDE_M / self.nominal

    def corners(self, printed: int, size: str) -> dict[int, Array]:
        """Return, for each identity that is right, its corners on the print (4, 2), metres, x right, y up."""
        unit = np.array([(-0.5, 0.5), (0.5, 0.5), (0.5, -0.5), (-0.5, -0.5)])[list(self.order)] * self.sheet_m(size)
        return {printed if seen is None else seen: unit * side for seen, side in self.squares.items()}


@dataclass(frozen=True)
class Entrant:
    """One detector and the marker it reads; ``needs`` is the module it comes in."""

    name: str
    marker: str
    start: Callable[[Surface], Reader]
    needs: str = "astratag"

    @property
    def absent(self) -> bool:
        """Return whether its module is not installed."""
        return find_spec(self.needs) is None


def blown_up(cells: NDArray[np.uint8], margin: int = 0) -> Raster:
    """Return a picture of one texel a cell with a white margin of cells, enlarged exactly."""
    return np.pad(cells, margin, constant_values=255).repeat(CELL_TEXELS, axis=0).repeat(CELL_TEXELS, axis=1)


def draw_apriltag(family: str, tag_id: int) -> Raster:
    """Return an AprilTag as the library itself draws it, with the white or data cells around its border."""
    from pyapriltags.apriltags import _ImageU8

    detector = apriltag_detector(family)
    to_image = detector.libc.apriltag_to_image
    to_image.restype, to_image.argtypes = ctypes.POINTER(_ImageU8), [ctypes.c_void_p, ctypes.c_int]
    image = to_image(ctypes.cast(detector.tag_families[family], ctypes.c_void_p), tag_id).contents
    rows = np.ctypeslib.as_array(image.buf, shape=(image.height, image.stride))
    return blown_up(rows[:, : image.width].copy())


def draw_fractal(_: int) -> Raster:
    """Return the only print of the fractal family, with a quiet zone one outer cell wide."""
    from nanofractal import generate_fractal

    picture = generate_fractal(FRACTAL, FRACTAL_CELLS * CELL_TEXELS)
    return np.pad(picture, CELL_TEXELS, constant_values=255)


MARKERS = {
    "AstraTag": Marker(
        lambda i: print_coverage(DICTIONARY.signature(i), texels_per_unit=2),
        IDENTITIES,
        1 / (1 + 2 * QUIET_MARGIN),
        {None: 1 / (1 + 2 * QUIET_MARGIN)},
    ),
    "tag36h11": Marker(lambda i: draw_apriltag("tag36h11", i), IDENTITIES, 8 / 10, {None: 8 / 10}, (3, 2, 1, 0)),
    "tagCustom48h12": Marker(
        lambda i: draw_apriltag("tagCustom48h12", i), IDENTITIES, 6 / 10, {None: 6 / 10}, (3, 2, 1, 0)
    ),
    "ArUco 4x4": Marker(
        lambda i: blown_up(cv2.aruco.generateImageMarker(ARUCO, i, 6), margin=1), IDENTITIES, 6 / 8, {None: 6 / 8}
    ),
    "Fractal ArUco": Marker(
        draw_fractal,
        1,
        FRACTAL_CELLS / (FRACTAL_CELLS + 2),
        {i: side * FRACTAL_CELLS / (FRACTAL_CELLS + 2) for i, side in FRACTAL_SQUARES.items()},
    ),
}


@lru_cache(maxsize=10 * IDENTITIES)
def texture(marker: str, printed: int, size: str) -> Texture:
    """Return a marker's print as it is laid into a scene."""
    kind = MARKERS[marker]
    return Texture(kind.draw(printed), kind.sheet_m(size))


@lru_cache(maxsize=8)
def astratag(surface: Surface | None) -> Reader:
    """Return AstraTag's detector, told the surface or not."""
    detector = Detector(side_m=SIDE_M, surface=surface)
    return lambda image, camera: [(seen.marker_id, seen.corners_px) for seen in detector.detect(image, camera)]


def astratag_tracked(surface: Surface | None) -> Reader:
    """Return AstraTag's tracker, without any memory yet."""
    tracker = Tracker(Detector(side_m=SIDE_M, surface=surface))
    return lambda image, camera: [(seen.marker_id, seen.corners_px) for seen in tracker.detect(image, camera)]


@lru_cache(maxsize=2)
def apriltag_detector(family: str) -> Any:
    """Return an AprilTag detector of one thread that corrects two bits, as is usual.

    Only the family's first ``APRILTAG_IDS`` are active: with all 42211, the table of 48h12 takes gigabytes.  The
    binding rounds decode_sharpening down to 0; 0.25 is the library's own.
    """
    from pyapriltags import Detector as AprilTagDetector

    detector: Any = AprilTagDetector(families="", nthreads=1)
    detector.tag_families[family] = codes = getattr(detector.libc, f"{family}_create")()
    codes.contents.ncodes = APRILTAG_IDS
    detector.libc.apriltag_detector_add_family_bits(detector.tag_detector_ptr, codes, 2)
    detector.tag_detector_ptr.contents.decode_sharpening = 0.25
    return detector


def apriltag(family: str, decimate: float) -> Reader:
    """Return AprilTag's detector; it counts pixels from their edges, so half a pixel comes off."""
    detector = apriltag_detector(family)

    def read(image: Raster, _: Camera) -> list[Seen]:
        detector.tag_detector_ptr.contents.quad_decimate = decimate
        return [(seen.tag_id, seen.corners - 0.5) for seen in detector.detect(image)]

    return read


@lru_cache(maxsize=1)
def aruco() -> Reader:
    """Return OpenCV's ArUco detector with its sub-pixel corners."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector = cv2.aruco.ArucoDetector(ARUCO, parameters)

    def read(image: Raster, _: Camera) -> list[Seen]:
        corners, ids, _rejected = detector.detectMarkers(image)
        return (
            []
            if ids is None
            else [(int(i), np.reshape(c, (4, 2)).astype(float)) for i, c in zip(ids.ravel(), corners, strict=True)]
        )

    return read


@lru_cache(maxsize=1)
def fractal() -> Reader:
    """Return the Fractal ArUco detector of one thread; every level it sees is a reading."""
    import nanofractal

    nanofractal.set_num_threads(1)
    detector = nanofractal.FractalDetector(FRACTAL)
    return lambda image, _: [(level, corners.astype(float)) for level, corners in detector.detect(image)]


ENTRANTS = (
    Entrant("AstraTag", "AstraTag", astratag),
    Entrant("AstraTag, surface unknown", "AstraTag", lambda _: astratag(None)),
    Entrant("tag36h11, decimate 1", "tag36h11", lambda _: apriltag("tag36h11", 1.0), "pyapriltags"),
    Entrant("tag36h11, decimate 2", "tag36h11", lambda _: apriltag("tag36h11", 2.0), "pyapriltags"),
    Entrant("tagCustom48h12, decimate 1", "tagCustom48h12", lambda _: apriltag("tagCustom48h12", 1.0), "pyapriltags"),
    Entrant("tagCustom48h12, decimate 2", "tagCustom48h12", lambda _: apriltag("tagCustom48h12", 2.0), "pyapriltags"),
    Entrant("ArUco 4x4", "ArUco 4x4", lambda _: aruco(), "cv2"),
    Entrant("Fractal ArUco, 3 levels", "Fractal ArUco", lambda _: fractal(), "nanofractal"),
)
TRACKED = Entrant("AstraTag, tracked", "AstraTag", astratag_tracked)
