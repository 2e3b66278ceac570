"""Compiled functions: loops over pixels and points, translated to machine code by Numba.

Signatures are given, so that all is compiled when the package is first imported on a machine, kept beside the source,
and only loaded from then on: nothing is compiled in flight.  Arrays must have the type that a signature says, and be
in C order; another one raises a TypeError.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import Any, TypeVar

import numba
from numba import types

F = TypeVar("F", bound=Callable[..., Any])

BOOL, INT, INDEX = types.boolean, types.int64, types.uint32
REAL, SINGLE = types.float64, types.float32


def array(dtype: types.Type, dimensions: int) -> types.Type:
    """Return the type of an array that a function reads only: in C order."""
    return types.Array(dtype, dimensions, "C", readonly=True)


LIGHT, GRAY = array(SINGLE, 2), array(types.uint8, 2)
"""Images (H, W)."""
BRIGHTNESS = (LIGHT, GRAY)
"""Either image."""
CHANNELS = array(SINGLE, 3)
"""Images of several channels (H, W, C)."""
VECTOR, MATRIX, CUBE = array(REAL, 1), array(REAL, 2), array(REAL, 3)
FLAGS, FLAG_MATRIX = array(BOOL, 1), array(BOOL, 2)
INDICES = array(INT, 1)
BITS = array(types.uint8, 2)
PLACES = (MATRIX, array(SINGLE, 2))
"""Points (N, 2), exact or to what a pixel needs."""
PLACES_OF_MANY = (CUBE, array(SINGLE, 3))
"""The same of Q patterns (Q, N, 2)."""


ANY_ORDER = {"reassoc", "nsz", "contract"}
"""What the compiler may do to sums that may be added up in any order: it keeps several at once, in one register."""


def compiled(*arguments: types.Type | tuple[types.Type, ...], any_order: bool = False) -> Callable[[F], F]:
    """Return a decorator that compiles a function of arguments of these types; once for each where there are several.

    As NumPy does, division by zero gives infinities and NaNs.  Where sums may be added up in ``any_order`` long ones
    take a fraction of the time.
    """
    signatures = list(product(*(one if isinstance(one, tuple) else (one,) for one in arguments)))

    def decorate(function: F) -> F:
        fastmath = ANY_ORDER if any_order else False
        machine_code: Any = numba.njit(signatures, cache=True, error_model="numpy", fastmath=fastmath)(function)
        return machine_code

    return decorate
