"""CPU time of pictures without a marker, and made to be hard, beside that of a plain one with a marker.

Every reader takes turns at the plain one and a hard one; of each the least time counts, so that a busy machine is
unkind to neither.
"""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.detection.cost import FIRST_SEED, SCENES
from benchmarks.detection.peers import ENTRANTS, Entrant, texture
from benchmarks.detection.recall import timed
from benchmarks.detection.scenes import Draw, draw, textured
from pipeline.render import develop, light_behind

Image = NDArray[np.uint8]

SEED = 3
TURNS = 4
INK, PAPER = 30, 220
BOARDS_PX, SQUARES_PX, BLURS_PX = (5, 12, 30), (10, 16, 28), (2.0, 4.0)
NESTED_PX = (60, 48, 36, 24, 14)
"""Squares in squares, as a recursive marker's."""
BOX_AREA_PX = 900
"""Random boxes: one for so many pixels."""


def clutter(one: Draw) -> Iterator[tuple[str, Image]]:
    """Yield pictures without a marker by name: of a scene's size, its camera's and its background among them."""
    width, height = one.camera.width, one.camera.height
    rng = np.random.default_rng(SEED)
    y, x = np.indices((height, width))
    noise = rng.integers(0, 256, (height, width), dtype=np.uint8)
    yield "noise", noise
    for blur in BLURS_PX:
        yield (
            f"noise blurred by {blur:g}",
            cv2.normalize(cv2.GaussianBlur(noise, (0, 0), blur), None, 0, 255, cv2.NORM_MINMAX),
        )
    for cell in BOARDS_PX:
        yield f"chessboard of {cell}", np.where((x // cell + y // cell) % 2, PAPER, INK).astype(np.uint8)
    for cell in SQUARES_PX:
        yield (
            f"squares of {cell}",
            np.where((x % cell < 0.6 * cell) & (y % cell < 0.6 * cell), INK, PAPER).astype(np.uint8),
        )
    boxes, nested = np.full((height, width), PAPER, np.uint8), np.full((height, width), PAPER, np.uint8)
    for _ in range(width * height // BOX_AREA_PX):
        box = (rng.uniform(0, (width, height)).tolist(), rng.uniform(6, 30, 2).tolist(), float(rng.uniform(0, 180)))
        cv2.fillPoly(boxes, [cv2.boxPoints(box).astype(np.int32)], int(rng.integers(0, 256)))
    yield "boxes", boxes
    step = NESTED_PX[0] + 10
    for top in range(0, height - step, step):
        for left in range(0, width - step, step):
            for depth, side in enumerate(NESTED_PX):
                inset = (NESTED_PX[0] - side) // 2
                part = slice(top + inset, top + inset + side), slice(left + inset, left + inset + side)
                nested[part] = PAPER if depth % 2 else INK
    yield "nested squares", nested
    for seed in range(2):
        light = light_behind(one.camera, textured(width, height, seed))
        yield f"background {seed}", develop(light, blur_px=0.8, noise_sigma=2.0, seed=seed)


def measure_clutter(entrants: tuple[Entrant, ...] = ENTRANTS) -> list[dict]:
    """Return a row for each image size and entrant: CPU milliseconds of a plain picture, the median and the worst."""
    cv2.setNumThreads(1)
    rows = []
    for name, scene in SCENES.items():
        one = draw(scene, FIRST_SEED)
        pictures = dict(clutter(one))
        for entrant in entrants:
            read, usual = entrant.start(one.surface), one.photograph(texture(entrant.marker, 0, "equal"))
            spent: dict[str, float] = {}
            times: dict[str, float] = {}
            plain_ms = np.inf
            for kind, picture in pictures.items():
                turns = [(timed(read, usual, one)[1], timed(read, picture, one)[1]) for _ in range(TURNS)]
                least, spent[kind] = (min(ms) for ms in zip(*turns, strict=True))
                plain_ms = min(plain_ms, least)
                times[kind] = spent[kind] / least
            worst = max(times, key=lambda kind: times[kind])
            rows.append(
                {
                    "image": name,
                    "entrant": entrant.name,
                    "plain_ms": float(plain_ms),
                    "median_ms": float(np.median(list(spent.values()))),
                    "median_times": float(np.median(list(times.values()))),
                    "worst_ms": spent[worst],
                    "worst_times": times[worst],
                    "worst": worst,
                }
            )
    return rows
