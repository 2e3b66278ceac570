"""Arithmetic in GF(64), the field of the region symbols: one element is the six cells of one region.

Elements are the integers 0..63, polynomials over GF(2) modulo x^6 + x + 1 with bit j the coefficient of x^j;
addition is exclusive or.  All functions take integers or integer arrays.  A polynomial over the field is a
one-dimensional array of coefficients, lowest degree first, without trailing zeros; zero is the empty array.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

ORDER = 64
SYMBOL_BITS = 6
MODULUS = 0b1000011
"""x^6 + x + 1, primitive: the powers of x run through all 63 elements but zero."""

Elements = NDArray[np.int64]


def _tables() -> tuple[Elements, Elements]:
    """Return the powers of x, twice over so that sums of two logarithms need no modulo, and their logarithms."""
    powers, element = [], 1
    for _ in range(ORDER - 1):
        powers.append(element)
        element <<= 1
        if element & ORDER:
            element ^= MODULUS
    logarithms = np.zeros(ORDER, dtype=np.int64)
    logarithms[powers] = np.arange(ORDER - 1)
    return np.array(powers * 2, dtype=np.int64), logarithms


_POWERS, _LOGARITHMS = _tables()


def multiply(a: ArrayLike, b: ArrayLike) -> Elements:
    """Return the products of elements, broadcast."""
    a, b = np.asarray(a), np.asarray(b)
    return np.where((a == 0) | (b == 0), 0, _POWERS[_LOGARITHMS[a] + _LOGARITHMS[b]])


def inverse(a: ArrayLike) -> Elements:
    """Return the multiplicative inverses of elements.  Raises ZeroDivisionError for zero."""
    a = np.asarray(a)
    if (a == 0).any():
        raise ZeroDivisionError("zero has no inverse in GF(64)")
    return _POWERS[ORDER - 1 - _LOGARITHMS[a]]


def power(a: ArrayLike, exponent: int) -> Elements:
    """Return elements raised to a positive integer power."""
    a = np.asarray(a)
    return np.where(a == 0, 0, _POWERS[_LOGARITHMS[a] * exponent % (ORDER - 1)])


def trim(p: ArrayLike) -> Elements:
    """Return a polynomial without its leading zeros."""
    p = np.asarray(p, dtype=np.int64)
    return p[: np.flatnonzero(p).max(initial=-1) + 1]


def add_poly(p: Elements, q: Elements) -> Elements:
    """Return the sum, which is also the difference, of two polynomials."""
    total = np.zeros(max(len(p), len(q)), dtype=np.int64)
    total[: len(p)] ^= p
    total[: len(q)] ^= q
    return trim(total)


def multiply_poly(p: Elements, q: Elements) -> Elements:
    """Return the product of two polynomials."""
    product = np.zeros(max(len(p) + len(q) - 1, 0), dtype=np.int64)
    for degree, coefficient in enumerate(p):
        product[degree : degree + len(q)] ^= multiply(coefficient, q)
    return trim(product)


def divide_poly(p: Elements, q: Elements) -> tuple[Elements, Elements]:
    """Return quotient and remainder of p by q, q not zero."""
    remainder = np.array(p, dtype=np.int64)
    quotient = np.zeros(max(len(p) - len(q) + 1, 0), dtype=np.int64)
    scale = inverse(q[-1])
    for degree in range(len(quotient) - 1, -1, -1):
        quotient[degree] = multiply(remainder[degree + len(q) - 1], scale)
        remainder[degree : degree + len(q)] ^= multiply(quotient[degree], q)
    return trim(quotient), trim(remainder)


def evaluate(p: Elements, points: ArrayLike) -> Elements:
    """Return a polynomial's values at points, by Horner's rule."""
    points = np.asarray(points)
    value = np.zeros(points.shape, dtype=np.int64)
    for coefficient in p[::-1]:
        value = multiply(value, points) ^ coefficient
    return value


def vanishing(points: ArrayLike) -> Elements:
    """Return the monic polynomial whose roots are the distinct points (N,)."""
    product = np.array([1], dtype=np.int64)
    for root in np.asarray(points):
        product = multiply_poly(product, np.array([root, 1]))
    return product


def interpolate(points: ArrayLike, values: ArrayLike) -> Elements:
    """Return the polynomial of degree below N through N distinct points (N,) and values (N,), by Lagrange."""
    points, values = np.asarray(points), np.asarray(values)
    total = np.zeros(0, dtype=np.int64)
    for i, value in enumerate(values):
        basis = vanishing(np.delete(points, i))
        total = add_poly(total, multiply(basis, multiply(value, inverse(evaluate(basis, points[i])))))
    return total
