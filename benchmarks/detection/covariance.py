"""Whether poses are as exact as their covariances say: NEES over range, tilt and bend, beside its chi-square band.

NEES is the squared error of a pose in units of its covariance, over its six degrees of freedom: 1 on average when
covariances are honest, more when they promise too much.  Its band holds the mean of as many honest ones in 95 of 100
runs.  Where a square is so small or so far from the side that two poses explain it, the wrong one may be reported, with
the probability it has; those are counted apart, beside as many as these probabilities make one expect.

Pictures are anti-aliased by more rays than recall needs: with 8 a pixel, edges are off by what some covariances claim.

Errors are also held to the Cramer-Rao bound: no unbiased estimate of a pose has a smaller covariance than the inverse
of what all pixels of a marker tell of it through their noise, were blur and light known exactly.  A marker ends in the
middle of its quiet margin: where its sheet was cut tells nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from zlib import crc32

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from astratag import Detection, Detector
from astratag.transforms import difference, perturb
from benchmarks.detection.peers import MARKERS, texture
from benchmarks.detection.scenes import CONDITIONS, SHEET_M, SIDE_M, Draw, draw
from pipeline.texture import Texture

Array = NDArray[np.float64]

CELLS: dict[str, tuple[float, ...]] = {
    "size": (16, 20, 28, 48, 80, 160),
    "tilt": (0, 30, 45, 60, 70, 75, 80, 83),
    "turn": (0, 20, 40, 60, 70, 75, 80),
    "lean": (0, 40, 60, 75),
    "tight": (0, 30, 50),
}
"""Conditions and the values of each whose covariances are looked at."""
SURFACES = ("told", "unknown")
RAYS = 32
CONFIDENCE, DEGREES_OF_FREEDOM = 0.95, 6
MEDIAN = float(chi2.median(DEGREES_OF_FREEDOM)) / DEGREES_OF_FREEDOM
"""Of NEES a degree of freedom of honest poses: a median is not moved by the one pose among ten that is far off."""
OTHER_RAD = 0.02
"""Planar poses turned by more are two."""
LITTLE = 1e-6
"""A perturbation, metres or radians, that is as good as a derivative."""
BOUNDED, BOUND_RAYS, STEP_PX = 5, 16, 0.25
"""The bound is found of every so many pictures, of so many rays a pixel, by moving the print by so much."""
OUTLINE = 33
"""Points on each side of a marker's outline, which may be bent."""
FIRST_SEED = 5_000_000
"""Added to what recall starts from: pictures that no constant of the detector was chosen on."""


@dataclass
class Consistency:
    """What the poses of one cell came to."""

    nees: list[float] = field(default_factory=list)
    other_pose: int = 0
    """How often the other planar pose was the right one."""
    other_pose_expected: float = 0.0
    bounds: list[float] = field(default_factory=list)
    """Squared errors in units of the Cramer-Rao bound, a degree of freedom."""

    def add(self, seen: Detection, T_cam_print: Array, information: Array | None = None) -> None:
        """Take in one detection, unless it has no pose; the truth is ``T_cam_print``, what pixels tell of it (6, 6)."""
        if seen.T_cam_marker is None or seen.covariance is None:
            return
        reported = seen.T_cam_marker
        error = difference(T_cam_print, reported)
        others = [planar for planar in seen.planar_poses if _turned(planar.T_cam_marker, reported) > OTHER_RAD]
        self.other_pose_expected += sum(planar.probability for planar in others)
        if any(
            2 * _turned(planar.T_cam_marker, T_cam_print) < _turned(seen.T_cam_marker, T_cam_print) for planar in others
        ):
            self.other_pose += 1
        else:
            self.nees.append(float(error @ np.linalg.solve(seen.covariance, error)) / DEGREES_OF_FREEDOM)
            if information is not None:
                self.bounds.append(float(error @ information @ error) / DEGREES_OF_FREEDOM)

    def summary(self) -> dict[str, object]:
        """Return the mean NEES a degree of freedom and its band, and how often the other pose was right."""
        low, high = band(len(self.nees)) if self.nees else (float("nan"), float("nan"))
        return {
            "poses": len(self.nees),
            "nees": float(np.mean(self.nees)) if self.nees else float("nan"),
            "nees_95": [low, high],
            "other_pose": self.other_pose,
            "other_pose_expected": self.other_pose_expected,
            "times_bound": float(np.sqrt(np.median(self.bounds) / MEDIAN)) if self.bounds else float("nan"),
            "bounded": len(self.bounds),
        }


def _turned(T_cam_marker: Array, other: Array) -> float:
    """Return the angle between two poses, radians."""
    return float(np.linalg.norm(difference(T_cam_marker, other)[3:]))


def band(poses: int) -> tuple[float, float]:
    """Return between which bounds the mean NEES of so many honest poses lies."""
    freedom = DEGREES_OF_FREEDOM * poses
    low, high = chi2.ppf([(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2], freedom) / freedom
    return float(low), float(high)


def information_of(one: Draw, print_: Texture) -> Array:
    """Return what the pixels of a picture tell of the print's pose (6, 6): metres and radians, right perturbation."""
    sheet = np.stack(np.meshgrid([-0.5, 0.5], [-0.5, 0.5]), axis=-1) * SHEET_M
    marker, slopes = marker_in(one), []
    for axis in np.eye(DEGREES_OF_FREEDOM):
        tiny = replace(one, T_cam_print=perturb(one.T_cam_print, LITTLE * axis))
        step = STEP_PX * LITTLE / np.abs(tiny.pixels(sheet) - one.pixels(sheet)).max()
        after, before = (
            replace(one, T_cam_print=perturb(one.T_cam_print, by * axis)).expected(print_, BOUND_RAYS)
            for by in (step, -step)
        )
        slopes.append((after - before)[marker].astype(float) / (2 * step))
    return np.array(slopes) @ np.array(slopes).T / one.scene.noise_sigma**2


def marker_in(one: Draw) -> NDArray[np.bool_]:
    """Return which pixels (height, width) show the print up to the middle of its quiet margin."""
    along = np.linspace(-1, 1, OUTLINE)
    sides = [(along, along * 0 + 1), (along * 0 + 1, -along), (-along, along * 0 - 1), (along * 0 - 1, along)]
    outline = one.pixels(np.concatenate([np.stack(side, axis=1) for side in sides]) * (SIDE_M + SHEET_M) / 4)
    picture = np.zeros((one.camera.height, one.camera.width), np.uint8)
    return cv2.fillPoly(picture, [np.round(outline).astype(np.int32)], 1).astype(bool)


def measure_covariance(condition: str, value: float, images: int) -> list[dict]:
    """Return one row for a surface that is told and one for one that is not, over the same pictures."""
    cv2.setNumThreads(1)
    scene = next(one for one in CONDITIONS if one.name == condition).scene(value)
    first_seed = FIRST_SEED + crc32(f"{condition} {value}".encode()) % 1_000_000
    kind, cells = MARKERS["AstraTag"], {surface: Consistency() for surface in SURFACES}
    for seed in range(first_seed, first_seed + images):
        one = draw(scene, seed)
        printed = int(np.random.default_rng([seed, 2]).integers(kind.ids))
        print_ = texture("AstraTag", printed, "equal")
        image = one.photograph(print_, RAYS)
        information = information_of(one, print_) if (seed - first_seed) % BOUNDED == 0 else None
        corners = kind.corners(printed, "equal")[printed]
        side_m = float(np.linalg.norm(corners[0] - corners[1]))
        for surface, cell in cells.items():
            detector = Detector(side_m=side_m, surface=one.surface if surface == "told" else None)
            for seen in detector.detect(image, one.camera):
                if seen.marker_id == printed:
                    cell.add(seen, one.T_cam_print, information)
    place = {"condition": condition, "value": value, "first_seed": first_seed}
    return [{**place, "surface": surface, **cell.summary()} for surface, cell in cells.items()]
