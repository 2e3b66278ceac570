"""Algebraic decoding of errors and erasures: which codeword differs least from what was read, symbol by symbol."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from astratag.codes import gf64
from astratag.codes.gf64 import Elements


@dataclass(frozen=True)
class Rejected:
    """A refusal to read something as a marker, and why."""

    reason: str


def decode_symbols(received: Elements, points: Elements, k: int) -> Elements | Rejected:
    """Return the polynomial of degree below ``k`` that agrees best with symbols (N,) read at N distinct points.

    Finds it exactly when at most (N - k) // 2 symbols are wrong, and refuses otherwise unless the wrong ones
    happen to lie as near to another codeword.  Erased symbols are left out of ``received`` and ``points``.

    Source: S. Gao, "A new algorithm for decoding Reed-Solomon codes", 2003, algorithm 1: with g0 vanishing on
    all points and g1 through all readings, the Euclidean algorithm on (g0, g1), stopped as soon as
    deg g < (N + k) / 2, has g = v g1 modulo g0, v the error locator, and the message is g / v.
    """
    n = len(points)
    if n < k:
        return Rejected(f"{n} regions are left and {k} are needed")
    previous, current = gf64.vanishing(points), gf64.interpolate(points, received)
    locator_previous, locator = np.zeros(0, dtype=np.int64), np.ones(1, dtype=np.int64)
    while 2 * (len(current) - 1) >= n + k:
        quotient, remainder = gf64.divide_poly(previous, current)
        previous, current = current, remainder
        product = gf64.multiply_poly(quotient, locator)
        locator_previous, locator = locator, gf64.add_poly(locator_previous, product)
    message, remainder = gf64.divide_poly(current, locator)
    if len(remainder) or len(message) > k:
        return Rejected(f"more than {(n - k) // 2} of the {n} regions in view are wrong")
    return message
