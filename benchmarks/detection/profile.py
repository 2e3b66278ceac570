"""Where a search's time goes: OpenCV's own functions, the detector's compiled ones, and the Python around them."""

from __future__ import annotations

import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import wraps
from types import ModuleType
from typing import Any, Literal
from unittest.mock import patch

import cv2
import numpy as np
from numba.core.registry import CPUDispatcher

from astratag.transforms import perturb
from benchmarks.detection.cost import FIRST_SEED, SCENES, STEP
from benchmarks.detection.peers import ENTRANTS, texture
from benchmarks.detection.recall import timed
from benchmarks.detection.scenes import Draw, draw

Kind = Literal["OpenCV", "compiled"]
SEARCH = ENTRANTS[0]


def native_functions() -> Iterator[tuple[Kind, ModuleType, str]]:
    """Yield where each function that is no Python is looked up: its kind, module and name."""
    for name, value in vars(cv2).items():
        if type(value).__name__ == "builtin_function_or_method":  # constants and classes are none
            yield "OpenCV", cv2, name
    for module in [module for name, module in sys.modules.items() if name.startswith("astratag.")]:
        for name, value in vars(module).items():
            if isinstance(value, CPUDispatcher):
                yield "compiled", module, name


@contextmanager
def native_timed() -> Iterator[dict[tuple[Kind, str], float]]:
    """Give the CPU seconds spent meanwhile in each native function that Python calls."""
    spent: dict[tuple[Kind, str], float] = defaultdict(float)

    def timing(key: tuple[Kind, str], function: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(function)
        def called(*args: Any, **options: Any) -> Any:
            start = time.process_time()
            try:
                return function(*args, **options)
            finally:
                spent[key] += time.process_time() - start

        return called

    with ExitStack() as patches:
        for kind, module, name in list(native_functions()):
            patches.enter_context(patch.object(module, name, timing((kind, name), getattr(module, name))))
        yield spent


def measure_profile(images: int) -> list[dict]:
    """Return a row for each image size: mean CPU milliseconds of a search, and of the native functions in it.

    The search is timed as it is, then once more with these timed, so that their timing is not in the whole.
    """
    cv2.setNumThreads(1)
    rows = []
    for name, scene in SCENES.items():
        first = draw(scene, FIRST_SEED)
        read = SEARCH.start(first.surface)
        total_ms: list[float] = []
        native_ms: dict[Kind, dict[str, float]] = {"OpenCV": defaultdict(float), "compiled": defaultdict(float)}
        for frame in range(images + 1):
            moved: Draw = replace(first, T_cam_print=perturb(first.T_cam_print, STEP * frame))
            picture = moved.photograph(texture(SEARCH.marker, 0, "equal"))
            _, cpu_ms = timed(read, picture, moved)
            with native_timed() as spent:
                read(picture, moved.camera)
            if frame:  # the first warms caches up
                total_ms.append(cpu_ms)
                for (kind, function), seconds in spent.items():
                    native_ms[kind][function] += 1e3 * seconds / images
        cpu_ms = float(np.mean(total_ms))
        row: dict = {"image": name, "frames": images, "cpu_ms": cpu_ms}
        for kind, by_function in native_ms.items():
            row[kind] = dict(sorted(by_function.items(), key=lambda item: -item[1]))
        rows.append(row)
    return rows
