"""One image as the detector works on it, and how much of that it is worth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from astratag.camera import Camera
from astratag.candidates import Candidate
from astratag.checks import picture
from astratag.cylinder import assumed_camera
from astratag.effort import Effort, Tries
from astratag.sampling import Light
from astratag.search import Binarisation, Outlines, Scaled

Array = NDArray[np.float64]

MAX_BY_EDGES, MAX_ALIGNED, MAX_CURVED = 8, 2, 4
"""Candidates in one image that come to nothing: of those whose edges are fitted, that are moved until they look as they
read, and so on cylinders.

Before 4267 markers that were found by their edges up to six others came to nothing, before 225 that were moved one at
most, and before 505 bent ones two.
"""


@dataclass(frozen=True, eq=False)
class View:
    """One image as the detector works on it: gray, in linear light, and with its camera.

    ``effort`` is what all that is done in it is taken from; ``by_edges``, ``aligned`` and ``curved`` hold what was
    looked at closely, and end that when it was enough; ``later`` those that are moved only when nothing else is found;
    ``scaled`` holds it at the resolutions it was searched at, ``outlines`` what was found, one way and another.
    """

    gray: NDArray[np.uint8]
    light: Light
    camera: Camera | None
    effort: Effort
    buffer: NDArray[np.float32]
    """Where the light of all its pixels (H, W) is put when it is asked for."""
    boxes: Sequence[NDArray[np.int64]] | None = None
    """The parts that are looked at, (2, 2) pixels: low and high x, y; None is all."""
    by_edges: Tries = field(default_factory=lambda: Tries(MAX_BY_EDGES))
    aligned: Tries = field(default_factory=lambda: Tries(MAX_ALIGNED))
    curved: Tries = field(default_factory=lambda: Tries(MAX_CURVED))
    later: list[Candidate] = field(default_factory=list)
    scaled: dict[float, Scaled] = field(default_factory=dict)
    outlines: dict[Binarisation, Outlines] = field(default_factory=dict)

    @cached_property
    def lit(self) -> NDArray[np.float32]:
        """Return the light (H, W) of all its pixels in the boxes, 0..255: for what looks at all, not at a few."""
        gray, of_gray = self.light.gray, self.light.of_gray.astype(np.float32)
        whole = np.array([(0, 0), gray.shape[::-1]])
        for (left, top), (right, bottom) in [whole] if self.boxes is None else self.boxes:
            part = slice(int(top), int(bottom)), slice(int(left), int(right))
            cv2.LUT(gray[part], of_gray, dst=self.buffer[part])
        return self.buffer

    @property
    def some_camera(self) -> Camera:
        """Return the camera, or one like most when it is not known: to bend prints with, not for poses."""
        return self.camera or assumed_camera(self.gray.shape[1], self.gray.shape[0])


def as_gray(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return a gray (H, W) or BGR (H, W, 3) image as gray.  Raises ValueError for anything else."""
    image = picture(image)
    return np.ascontiguousarray(image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))
