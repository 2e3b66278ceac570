# ruff: noqa: E402
"""CPU time a frame and recall of the detector and the tracker, on renders with known truth.

Run as ``python -m benchmarks.detection``.  Times are CPU milliseconds of one process with one thread: BLAS is
held to one before NumPy is loaded.
"""

from __future__ import annotations

import os

for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")

import argparse
import time
from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from astratag import Camera, Cylinder, Detector, Flat, Surface, Tracker, load_dictionary
from astratag.transforms import difference, exp_so3, pose
from pipeline.render import render_marker

DICTIONARY = load_dictionary()
SIDE_M = 0.1
FOCAL_BY_WIDTH = 0.78
FACING = np.diag([1.0, -1.0, -1.0])
SURFACES: dict[str, Surface] = {"flat": Flat(), "cylinder": Cylinder(0.15)}
JPEG_QUALITY = 90


def camera_of(width: int, height: int) -> Camera:
    focal_px = FOCAL_BY_WIDTH * width
    return Camera(
        [[focal_px, 0, (width - 1) / 2], [0, focal_px, (height - 1) / 2], [0, 0, 1]], width=width, height=height
    )


def textured(camera: Camera, seed: int) -> NDArray[np.uint8]:
    """Return a dark background with smooth shapes and sharp ones: something to search through."""
    rng = np.random.default_rng(seed)
    picture = cv2.GaussianBlur(rng.integers(0, 256, (camera.height, camera.width), dtype=np.uint8), (0, 0), 4.0)
    picture = cv2.normalize(picture, None, 10, 90, cv2.NORM_MINMAX)
    for _ in range(60):
        centre, size = rng.uniform(0, (camera.width, camera.height)), rng.uniform(5, 60, 2)
        box = cv2.boxPoints((centre.tolist(), size.tolist(), float(rng.uniform(0, 180))))
        cv2.fillPoly(picture, [box.astype(np.int32)], int(rng.integers(0, 200)))
    return picture


def photograph(camera: Camera, T_cam_marker: NDArray[np.float64], surface: Surface, marker_id: int, seed: int):
    image = render_marker(
        camera,
        T_cam_marker,
        signature=DICTIONARY.signature(marker_id),
        side_m=SIDE_M,
        surface=surface,
        background=textured(camera, seed),
        seed=seed,
    )
    return cv2.imdecode(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1], cv2.IMREAD_GRAYSCALE)


def cpu_ms(call: Callable[[], object], repeats: int) -> float:
    """Return the median CPU milliseconds of a call."""
    call()
    spent = []
    for _ in range(repeats):
        start = time.process_time()
        call()
        spent.append(1e3 * (time.process_time() - start))
    return float(np.median(spent))


def times(repeats: int) -> None:
    print(f"{'image':>10} {'side, px':>8} {'search, ms':>11} {'track, ms':>10} {'no marker, ms':>14}")
    for width, height in ((1280, 720), (640, 480)):
        camera, surface = camera_of(width, height), SURFACES["cylinder"]
        empty = textured(camera, 1)
        detector = Detector(side_m=SIDE_M, surface=surface)
        nothing_ms = cpu_ms(
            lambda detector=detector, empty=empty, camera=camera: detector.detect(empty, camera), repeats
        )
        for side_px in (70, 150, 400):
            T = pose(FACING @ exp_so3([0.1, 0.15, 0.2]), [0, 0, camera.K[0, 0] * SIDE_M / side_px])
            image = photograph(camera, T, surface, 19, 1)
            tracker = Tracker(detector)
            search_ms = cpu_ms(lambda d=detector, i=image, c=camera: d.detect(i, c), repeats)
            track_ms = cpu_ms(lambda t=tracker, i=image, c=camera: t.detect(i, c), repeats)
            print(f"{f'{width}x{height}':>10} {side_px:8d} {search_ms:11.2f} {track_ms:10.2f} {nothing_ms:14.2f}")


def recall(draws: int) -> None:
    camera = camera_of(1280, 720)
    for name, surface in SURFACES.items():
        detector = Detector(side_m=SIDE_M, surface=surface)
        print(f"\n{name}: per cent found, median NEES / 6, wrong identities")
        for label, cells in (
            ("side at 10 degrees", [(px, 10) for px in (24, 32, 40, 60, 100)]),
            ("tilt at 120 px", [(120, deg) for deg in (0, 30, 50, 60, 70, 80)]),
        ):
            for side_px, tilt_deg in cells:
                found, wrong, nees = 0, 0, []
                for draw in range(draws):
                    rng = np.random.default_rng([side_px, tilt_deg, draw])
                    roll, azimuth, marker_id = *rng.uniform(0, 2 * np.pi, 2), int(rng.integers(len(DICTIONARY)))
                    tilt = np.radians(tilt_deg) * np.array([np.cos(azimuth), np.sin(azimuth), 0])
                    T = pose(FACING @ exp_so3([0, 0, roll]) @ exp_so3(tilt), [0, 0, camera.K[0, 0] * SIDE_M / side_px])
                    seen = detector.detect(photograph(camera, T, surface, marker_id, draw), camera)
                    wrong += sum(one.marker_id != marker_id for one in seen)
                    right = [one for one in seen if one.marker_id == marker_id]
                    found += bool(right)
                    if right and right[0].covariance is not None:
                        error = difference(T, right[0].T_cam_marker)
                        nees.append(error @ np.linalg.solve(right[0].covariance, error) / 6)
                typical = f"{np.median(nees):6.2f}" if nees else "     -"
                print(f"  {label:20} {side_px:4d} px {tilt_deg:3d} deg {100 * found / draws:6.0f} {typical} {wrong:3d}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=20, help="timed calls a cell")
    parser.add_argument("--draws", type=int, default=8, help="images a recall cell; 0 for times only")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    times(options.repeats)
    if options.draws:
        recall(options.draws)


if __name__ == "__main__":
    main()
