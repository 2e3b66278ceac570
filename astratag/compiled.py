"""Compiled functions: loops over pixels and points, translated to machine code by Numba.

Signatures are given, so that all is compiled when the package is first imported on a machine, kept beside the source,
and only loaded from then on: nothing is compiled in flight.  Arrays must have the type that a signature says, and be
in C order; another one raises a TypeError.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numba
from numba import types

F = TypeVar("F", bound=Callable[..., Any])

BOOL, INT, REAL = types.boolean, types.int64, types.float64

SUMS_IN_ANY_ORDER = {"reassoc", "contract"}


def array(dtype: types.Type, dimensions: int) -> types.Type:
    """Return the type of an array that a function reads only: in C order."""
    return types.Array(dtype, dimensions, "C", readonly=True)


LIGHT, GRAY = array(types.float32, 2), array(types.uint8, 2)
"""Images (H, W)."""
VECTOR, MATRIX, CUBE = array(REAL, 1), array(REAL, 2), array(REAL, 3)
FLAGS, FLAG_MATRIX = array(BOOL, 1), array(BOOL, 2)
INDICES = array(INT, 1)
"""All in C order, and only read."""


def compiled(*arguments: types.Type) -> Callable[[F], F]:
    """Return a decorator that compiles a function of arguments of these types.

    As in NumPy, division by zero gives infinities and NaNs, and sums are taken in any order.
    """

    def decorate(function: F) -> F:
        machine_code: Any = numba.njit(arguments, cache=True, error_model="numpy", fastmath=SUMS_IN_ANY_ORDER)(function)
        return machine_code

    return decorate
