"""The search that found the frozen families: random points and bases until the distance is as wanted."""

from __future__ import annotations

import numpy as np

from astratag.checks import whole
from astratag.codes import gf64
from astratag.codes.family import Family
from astratag.codes.words import CELLS_PER_REGION, span

WANTED_DISTANCE = {2: 16, 3: 12, 4: 9}


def _random_basis(rng: np.random.Generator) -> tuple[int, ...]:
    """Return six field elements that are independent over GF(2)."""
    while True:
        basis = rng.integers(1, gf64.ORDER, CELLS_PER_REGION).tolist()
        if len(np.unique(span(basis))) == gf64.ORDER:
            return tuple(basis)


def _orbit(point: int, step: int) -> set[int]:
    """Return the points that x -> x^8 + step visits."""
    orbit = {point}
    while (point := int(gf64.power(point, 8)) ^ step) not in orbit:
        orbit.add(point)
    return orbit


def search_instance(k: int, seed: int) -> Family:
    """Return the first random family of dimension k (2, 3 or 4) with the wanted distance, the same for a seed.

    The code is linear over GF(2) and holds the turns of its codewords, so the distance between any two readings
    is the weight of a codeword: counting the ones of all 2^(6 k) words gives it exactly.
    """
    k, seed = whole(k, "k"), whole(seed, "seed")
    if k not in WANTED_DISTANCE:
        raise ValueError(f"k must be one of {sorted(WANTED_DISTANCE)}, got {k}")
    rng = np.random.default_rng(seed)
    distance = WANTED_DISTANCE[k]
    while True:
        step, corner, edge = rng.integers(0, gf64.ORDER, 3).tolist()
        corner_basis, edge_basis = _random_basis(rng), _random_basis(rng)
        if len(_orbit(corner, step) | _orbit(edge, step)) < 8:
            continue
        name = f"astratag48h{distance}"
        family = Family(name, k, distance, step, corner, edge, corner_basis, edge_basis, seed)
        if family.encoder.least_weight(floor=distance) == distance:
            return family
