"""Checks at the public door: each returns an argument as it should be, or raises ValueError that says what came."""

from __future__ import annotations

from math import isfinite
from numbers import Real
from os import PathLike
from pathlib import Path
from reprlib import Repr
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

T = TypeVar("T")
MOST_SHOWN = 16
_SHORT = Repr()
_SHORT.maxstring = _SHORT.maxother = 80


def finite(value: Any, name: str) -> float:
    """Return a number."""
    number = _number(value)
    if number is None or not isfinite(number):
        raise ValueError(f"{name} must be a finite number, got {_shown(value)}")
    return number


def positive(value: Any, name: str, what: str = "length in metres") -> float:
    """Return a finite number above zero."""
    number = _number(value)
    if number is None or not (isfinite(number) and number > 0):
        raise ValueError(f"{name} must be a positive {what}, got {_shown(value)}")
    return number


def whole(value: Any, name: str, least: int = 0) -> int:
    """Return a whole number of at least ``least``."""
    number = _number(value)
    if number is None or not isfinite(number) or number != int(number) or number < least:
        raise ValueError(f"{name} must be a whole number, {least} or more, got {_shown(value)}")
    return int(value)


def numbers(value: Any, name: str) -> NDArray[np.float64]:
    """Return an array of finite numbers, a copy."""
    try:
        array = np.array(value)
        array = array.astype(float) if array.dtype.kind in "biuf" else np.full(1, np.nan)
    except ValueError:  # a ragged list
        array = np.full(1, np.nan)
    if not np.isfinite(array).all():
        raise ValueError(f"{name} must be finite numbers, got {_shown(value)}")
    return array


def file_path(value: Any) -> Path:
    """Return a path."""
    if not isinstance(value, str | PathLike):
        raise ValueError(f"path must be a string or a Path, got {_shown(value)}")
    return Path(value)


def instance(value: Any, kind: type[T], name: str, how: str) -> T:
    """Return an instance of a class; ``how`` says how one is made."""
    if not isinstance(value, kind):
        raise ValueError(f"{name} must be a {kind.__name__}, got {_shown(value)}: {how}")
    return value


def picture(value: Any) -> NDArray[np.uint8]:
    """Return a gray (H, W) or BGR (H, W, 3) image with any pixels at all."""
    if not isinstance(value, np.ndarray) or value.dtype != np.uint8:
        kind = value.dtype if isinstance(value, np.ndarray) else type(value).__name__
        raise ValueError(f"image must be a uint8 array, got {kind}: did it load? Scale other depths to 0..255 first")
    if not (value.ndim == 2 or (value.ndim == 3 and value.shape[2] == 3)) or value.size == 0:
        raise ValueError(
            f"image must be gray (H, W) or BGR (H, W, 3) and not empty, got shape {value.shape}: did it load?"
        )
    return value


def _number(value: Any) -> float | None:
    """Return a real number that is not a truth value; None for anything else, or one too large."""
    if not isinstance(value, Real) or isinstance(value, bool):
        return None
    try:
        return float(value)
    except OverflowError:
        return None


def _shown(value: Any) -> str:
    """Return what a value looks like, short, on one line."""
    if isinstance(value, np.ndarray) and value.size > MOST_SHOWN:
        return f"an array of {value.dtype} {value.shape}"
    return " ".join(_SHORT.repr(value.tolist() if isinstance(value, np.ndarray | np.generic) else value).split())
