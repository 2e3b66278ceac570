"""Normal equations: sums of products of columns, and what is solved or left out with them; and ranks of residuals.

Compiled, and small.  NumPy's own would do, but take Numba seconds to compile.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from astratag.compiled import INT, MATRIX, VECTOR, compiled

Array = NDArray[np.float64]

EXPLAINED = 1e-12
"""What of a column's energy is left of it when all before it explain it."""


@compiled(VECTOR, VECTOR)
def dot(a: Array, b: Array) -> float:
    """Return the sum of the products of two columns (N,)."""
    total = 0.0
    for n in range(len(a)):
        total += a[n] * b[n]
    return total


@compiled(MATRIX)
def gram(columns: Array) -> Array:
    """Return the products (P, P) of columns (P, N) with each other.

    Two by two, so that each number that is loaded is used twice.
    """
    size = len(columns)
    products = np.empty((size, size))
    for i in range(0, size, 2):
        k = min(i + 1, size - 1)
        for j in range(0, i + 1, 2):
            m = min(j + 1, size - 1)
            a, b, c, d = columns[i], columns[k], columns[j], columns[m]
            ac, ad, bc, bd = 0.0, 0.0, 0.0, 0.0
            for n in range(columns.shape[1]):
                ac += a[n] * c[n]
                ad += a[n] * d[n]
                bc += b[n] * c[n]
                bd += b[n] * d[n]
            products[i, j], products[i, m], products[k, j], products[k, m] = ac, ad, bc, bd
            products[j, i], products[m, i], products[j, k], products[m, k] = ac, ad, bc, bd
    return products


@compiled(MATRIX, INT)
def left_over(products: Array, count: int) -> Array:
    """Return the products (P - C, P - C) of columns when what the first ``count`` C of them explain is taken out.

    ``products`` (P, P) are those of all columns with each other.
    """
    size = len(products)
    left = products.copy()
    for k in range(count):
        if left[k, k] > EXPLAINED * products[k, k]:
            for i in range(k + 1, size):
                share = left[i, k] / left[k, k]
                for j in range(k + 1, size):
                    left[i, j] -= share * left[k, j]
    return left[count:, count:].copy()


@compiled(MATRIX)
def factored(normal: Array) -> Array:
    """Return the lower Cholesky factor (P, P) of a positive matrix, NaNs of what is none."""
    size = len(normal)
    L = np.zeros((size, size))
    for i in range(size):
        for j in range(i + 1):
            rest = normal[i, j]
            for k in range(j):
                rest -= L[i, k] * L[j, k]
            L[i, j] = math.sqrt(rest) if i == j else rest / L[j, j]
    return L


@compiled(MATRIX, VECTOR)
def solved(factor: Array, right: Array) -> Array:
    """Return x (P,) of L L.T x = right (P,), for a lower factor (P, P)."""
    size = len(right)
    x = right.copy()
    for i in range(size):
        for k in range(i):
            x[i] -= factor[i, k] * x[k]
        x[i] /= factor[i, i]
    for i in range(size - 1, -1, -1):
        for k in range(i + 1, size):
            x[i] -= factor[k, i] * x[k]
        x[i] /= factor[i, i]
    return x


@compiled(MATRIX)
def inverse(factor: Array) -> Array:
    """Return the inverse (P, P) of L L.T, for a lower factor (P, P)."""
    size = len(factor)
    columns = np.empty((size, size))
    for i in range(size):
        unit = np.zeros(size)
        unit[i] = 1.0
        columns[i] = solved(factor, unit)
    return columns


@compiled(VECTOR, INT)
def ranked(values: Array, rank: int) -> float:
    """Return the value (N,) that ``rank`` others do not exceed: Hoare's selection."""
    left = values.copy()
    low, high = 0, len(left) - 1
    while low < high:
        pivot, i, j = left[(low + high) // 2], low, high
        while i <= j:
            while left[i] < pivot:
                i += 1
            while left[j] > pivot:
                j -= 1
            if i <= j:
                left[i], left[j] = left[j], left[i]
                i, j = i + 1, j - 1
        if rank <= j:
            high = j
        elif rank >= i:
            low = i
        else:
            break
    return left[rank]
