"""Where a search's time goes: OpenCV's own functions, which a native core would keep, and the Python around them."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import wraps
from typing import Any
from unittest.mock import patch

import cv2
import numpy as np

from astratag.transforms import perturb
from benchmarks.detection.cost import FIRST_SEED, SCENES, STEP
from benchmarks.detection.peers import ENTRANTS, texture
from benchmarks.detection.recall import timed
from benchmarks.detection.scenes import Draw, draw

SEARCH = ENTRANTS[0]
OPENCV = tuple(name for name, value in vars(cv2).items() if type(value).__name__ == "builtin_function_or_method")
"""The functions of OpenCV; constants and classes are none."""


@contextmanager
def opencv_timed() -> Iterator[dict[str, list[float]]]:
    """Give, for each function of OpenCV called meanwhile, the CPU seconds of every call."""
    spent: dict[str, list[float]] = defaultdict(list)

    def timing(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(function)
        def called(*args: Any, **options: Any) -> Any:
            start = time.process_time()
            try:
                return function(*args, **options)
            finally:
                spent[name].append(time.process_time() - start)

        return called

    with ExitStack() as patches:
        for name in OPENCV:
            patches.enter_context(patch.object(cv2, name, timing(name, getattr(cv2, name))))
        yield spent


def measure_profile(images: int) -> list[dict]:
    """Return a row for each image size: mean CPU milliseconds of a search, and of OpenCV's functions in it.

    The search is timed as it is, then once more with OpenCV's functions timed, so that the timing of these is in
    neither.
    """
    cv2.setNumThreads(1)
    rows = []
    for name, scene in SCENES.items():
        first = draw(scene, FIRST_SEED)
        read = SEARCH.start(first.surface)
        total_ms: list[float] = []
        opencv_ms: dict[str, list[float]] = defaultdict(list)
        for frame in range(images + 1):
            moved: Draw = replace(first, T_cam_print=perturb(first.T_cam_print, STEP * frame))
            picture = moved.photograph(texture(SEARCH.marker, 0, "equal"))
            _, cpu_ms = timed(read, picture, moved)
            with opencv_timed() as spent:
                read(picture, moved.camera)
            if frame:  # the first warms caches up
                total_ms.append(cpu_ms)
                for function, seconds in spent.items():
                    opencv_ms[function].append(1e3 * sum(seconds))
        by_function = {function: float(np.sum(ms)) / images for function, ms in opencv_ms.items()}
        slowest_first = dict(sorted(by_function.items(), key=lambda item: -item[1]))
        cpu_ms = float(np.mean(total_ms))
        share = sum(by_function.values()) / cpu_ms
        rows.append(
            {"image": name, "frames": images, "cpu_ms": cpu_ms, "opencv_share": share, "opencv_ms": slowest_first}
        )
    return rows
