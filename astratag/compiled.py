"""Compiled functions: loops over pixels and points, translated to machine code by Numba.

Signatures are given, so that all is compiled when the package is first imported on a machine, kept beside the source,
and only loaded from then on: nothing is compiled in flight.  Arrays must have the type that a signature says, and be
in C order; another one raises a TypeError.

Numba by itself would not notice a change in what a function calls, or in a constant it uses, in another file.  So what
it keeps is kept under a digest of all sources that compiled functions may draw on.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
from collections.abc import Callable
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any, TypeVar

import numba
from numba import types

F = TypeVar("F", bound=Callable[..., Any])

BOOL, INT, INDEX = types.boolean, types.int64, types.uint32
REAL, SINGLE = types.float64, types.float32

PREFIX = "compiled-"
ANY_ORDER = {"reassoc", "nsz", "contract"}
"""What the compiler may do to sums that may be added up in any order: it keeps several at once, in one register."""


def array(dtype: types.Type, dimensions: int) -> types.Type:
    """Return the type of an array that a function reads only: in C order."""
    return types.Array(dtype, dimensions, "C", readonly=True)


LIGHT, GRAY = array(SINGLE, 2), array(types.uint8, 2)
"""Images (H, W)."""
BRIGHTNESS = (LIGHT, GRAY)
"""Either image."""
VECTOR, MATRIX, CUBE = array(REAL, 1), array(REAL, 2), array(REAL, 3)
FLAGS, FLAG_MATRIX = array(BOOL, 1), array(BOOL, 2)
INDICES, INDEX_MATRIX = array(INT, 1), array(INT, 2)
BITS = array(types.uint8, 2)
TABLE = array(types.int32, 2)
LINES, LINE_NUMBERS, BELLS = array(SINGLE, 4), array(INT, 3), array(REAL, 4)
"""All in C order, and only read."""
INTO_SHAPES, INTO_POINTS = types.Array(types.uint8, 2, "C"), types.Array(types.int32, 2, "C")
"""Shapes (H, W) and pixels (N, 2) that are written to as well."""
INTO_VECTOR, INTO_MATRIX = types.Array(REAL, 1, "C"), types.Array(REAL, 2, "C")
INTO_STARTS, INTO_INDICES = types.Array(INT, 1, "C"), types.Array(INT, 2, "C")
"""Numbers (N,) and (N, M), and indices, likewise."""
INTO_MARKS, WORDS = types.Array(types.uint8, 1, "C"), types.Array(types.uint64, 1, "C")
"""Shapes row by row (H W,), a pixel at once and eight."""
PLACES = (MATRIX, array(SINGLE, 2))
"""Points (N, 2), exact or to what a pixel needs."""
PLACES_OF_MANY = (CUBE, array(SINGLE, 3))
"""The same of Q patterns (Q, N, 2)."""


def compiled(*arguments: types.Type | tuple[types.Type, ...]) -> Callable[[F], F]:
    """Return a decorator that compiles a function of arguments of these types; once for each where there are several.

    As in NumPy, division by zero gives infinities and NaNs, and sums are added up in any order.
    """
    signatures = list(product(*(one if isinstance(one, tuple) else (one,) for one in arguments)))

    def decorate(function: F) -> F:
        config: Any = numba.config
        others = config.CACHE_DIR
        try:
            config.CACHE_DIR = str(_folder())
            machine_code: Any = numba.njit(signatures, cache=True, error_model="numpy", fastmath=ANY_ORDER)(function)
        finally:
            config.CACHE_DIR = others
        return machine_code

    return decorate


@cache
def _folder() -> Path:
    """Return where machine code of these sources is kept: beside them, or else in the user's cache.

    What was kept of other versions is removed.
    """
    package = Path(__file__).parent
    digest = hashlib.sha256("".join(_sources(package)).encode())
    name = f"{PREFIX}{digest.hexdigest()[:16]}"
    caches = package / "__pycache__", Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "astratag"
    for folder in caches:
        try:
            (folder / name).mkdir(parents=True, exist_ok=True)
        except OSError:
            continue
        if os.access(folder / name, os.W_OK):
            for old in folder.glob(f"{PREFIX}*"):
                if old.name != name:
                    shutil.rmtree(old, ignore_errors=True)
            return folder / name
    raise OSError(f"nowhere to keep compiled functions: neither {caches[0]} nor {caches[1]} can be written to")


def _sources(package: Path) -> list[str]:
    """Return the texts of all modules that have compiled functions, and of those that they import."""
    texts = {source.relative_to(package): source.read_text() for source in sorted(package.rglob("*.py"))}
    names = {".".join(path.with_suffix("").parts): path for path in texts}
    wanted = {path for path, text in texts.items() if "from astratag.compiled import" in text}
    while (
        new := {
            names[imported]
            for path in wanted
            for imported in re.findall(r"^from astratag\.([\w.]+) import", texts[path], re.MULTILINE)
            if imported in names
        }
        - wanted
    ):
        wanted |= new
    return [texts[path] for path in sorted(wanted)]
