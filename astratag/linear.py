"""What compiled functions share: small systems of linear equations, as large as a warp has parameters, and ranks.

NumPy's own would do, but take Numba seconds to compile.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from astratag.compiled import INT, MATRIX, VECTOR, compiled

Array = NDArray[np.float64]


@compiled(VECTOR, VECTOR)
def dot(a: Array, b: Array) -> float:
    """Return the sum of products of two vectors (N,)."""
    total = 0.0
    for i in range(len(a)):
        total += a[i] * b[i]
    return total


@compiled(MATRIX)
def inverse_of(S: Array) -> Array:
    """Return the inverse of a symmetric positive definite matrix (P, P), NaN when it is none.

    By its Cholesky factor L: S^-1 = L^-T L^-1.
    """
    size = len(S)
    L, inverse = np.zeros((size, size)), np.empty((size, size))  # of the factor, then of the matrix
    for j in range(size):
        for i in range(j, size):
            left = S[i, j]
            for k in range(j):
                left -= L[i, k] * L[j, k]
            if i == j:
                if not left > 0:
                    return np.full((size, size), np.nan)
                L[j, j] = np.sqrt(left)
            else:
                L[i, j] = left / L[j, j]
    for j in range(size):
        for i in range(j, size):  # the factor's inverse, in place: column by column
            left = 1.0 if i == j else 0.0
            for k in range(j, i):
                left -= L[i, k] * inverse[k, j]
            inverse[i, j] = left / L[i, i]
    for i in range(size):
        for j in range(i, size):
            total = 0.0
            for k in range(j, size):
                total += inverse[k, i] * inverse[k, j]
            L[i, j] = total
    for i in range(size):
        for j in range(i, size):
            inverse[i, j] = inverse[j, i] = L[i, j]
    return inverse


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
