"""Recall, wrong identities, corner error and CPU time in one cell: one value of one condition.

A reading is right when its identity is and its corners, in their own order, are within ``PLACED`` of the longest edge
of the truth.  With another identity it is wrong; with the right one elsewhere, or turned, misplaced.
"""

from __future__ import annotations

import time
from collections.abc import Collection
from dataclasses import dataclass, field
from zlib import crc32

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

from benchmarks.detection.peers import ENTRANTS, MARKERS, Entrant, Reader, Seen, texture
from benchmarks.detection.scenes import CONDITIONS, Draw, draw

Array = NDArray[np.float64]
PLACED, PLACED_AT_LEAST_PX = 0.2, 3.0
CONFIDENCE = 0.95
SIZES = ("equal", "nominal")
SAME_SHEET = 0.05
"""Sheets that differ in width by less are measured once: AstraTag, tag36h11 and ArUco are as wide at both sizes."""


@dataclass
class Tally:
    """What one entrant did in one cell."""

    images: int = 0
    found: int = 0
    wrong: int = 0
    misplaced: int = 0
    squared_errors: list[float] = field(default_factory=list)
    cpu_ms: list[float] = field(default_factory=list)

    def add(self, seen: list[Seen], truth: dict[int, Array], cpu_ms: float) -> None:
        """Count one picture: ``truth`` holds each right identity's corners in pixels (4, 2)."""
        errors = [_squared_error(corners, truth[identity]) for identity, corners in seen if identity in truth]
        right = [error for error in errors if error is not None]
        self.images += 1
        self.found += bool(right)
        self.wrong += len(seen) - len(errors)
        self.misplaced += len(errors) - len(right)
        self.squared_errors += right[:1]
        self.cpu_ms.append(cpu_ms)

    def summary(self) -> dict[str, object]:
        """Return the figures of the cell; the recall's bounds are Wilson's."""
        low, high = wilson(self.found, self.images)
        return {
            "images": self.images,
            "found": self.found,
            "recall": self.found / self.images,
            "recall_95": [low, high],
            "wrong": self.wrong,
            "misplaced": self.misplaced,
            "corner_rms_px": float(np.sqrt(np.mean(self.squared_errors))) if self.squared_errors else None,
            "cpu_ms": float(np.median(self.cpu_ms)),
        }


def _squared_error(corners: Array, truth: Array) -> float | None:
    """Return the mean squared distance a coordinate, or None when the corners are elsewhere."""
    longest = np.linalg.norm(np.roll(truth, -1, axis=0) - truth, axis=1).max()
    away = np.linalg.norm(corners - truth, axis=1)
    return float(np.mean(away**2) / 2) if away.max() <= max(PLACED * longest, PLACED_AT_LEAST_PX) else None


def wilson(found: int, images: int, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """Return the bounds of a rate (Wilson, 1927)."""
    z = norm.ppf((1 + confidence) / 2)
    rate, spread = found / images, 1 + z**2 / images
    half = z * np.sqrt(rate * (1 - rate) / images + z**2 / (4 * images**2)) / spread
    middle = (rate + z**2 / (2 * images)) / spread
    return max(0.0, float(middle - half)), min(1.0, float(middle + half))


def timed(read: Reader, image: NDArray[np.uint8], scene: Draw) -> tuple[list[Seen], float]:
    """Return what was read and the CPU milliseconds it took."""
    start = time.process_time()
    seen = read(image, scene.camera)
    return seen, 1e3 * (time.process_time() - start)


def measure(condition: str, value: float, images: int, names: Collection[str]) -> list[dict]:
    """Return one row for each entrant, by name, and size: the same draws for all, each print photographed once."""
    cv2.setNumThreads(1)
    entrants = [entrant for entrant in ENTRANTS if entrant.name in names]
    scene = next(one for one in CONDITIONS if one.name == condition).scene(value)
    first_seed = crc32(f"{condition} {value}".encode()) % 1_000_000
    tallies = {(entrant, size): Tally() for size in SIZES for entrant in entrants if _differs(entrant, size)}
    for seed in range(first_seed, first_seed + images):
        one = draw(scene, seed)
        for size in SIZES:
            for marker in {entrant.marker for entrant in entrants if _differs(entrant, size)}:
                kind = MARKERS[marker]
                printed = int(np.random.default_rng([seed, 2]).integers(kind.ids))
                image = one.photograph(texture(marker, printed, size))
                truth = {seen: one.pixels(corners) for seen, corners in kind.corners(printed, size).items()}
                for entrant in entrants:
                    if entrant.marker == marker:
                        seen, cpu_ms = timed(entrant.start(one.surface), image, one)
                        tallies[entrant, size].add(seen, truth, cpu_ms)
    place = {"condition": condition, "value": value, "first_seed": first_seed}
    return [{**place, "entrant": e.name, "size": size, **tally.summary()} for (e, size), tally in tallies.items()]


def _differs(entrant: Entrant, size: str) -> bool:
    """Return whether an entrant's sheet at this size is another than the one that is measured anyway."""
    kind = MARKERS[entrant.marker]
    return size == SIZES[0] or abs(kind.sheet_m(size) / kind.sheet_m(SIZES[0]) - 1) > SAME_SHEET
