"""Active sets: which of a family's identities to fly so that they are hardest to confuse."""

from __future__ import annotations

import numpy as np

from astratag.checks import instance, whole
from astratag.codes.family import Family
from astratag.codes.words import pack
from astratag.geometry import turn_clockwise

LARGEST_POOL = 1 << 16
"""Of larger families this many identities are drawn at random and chosen from."""


def select_identities(family: Family, count: int, seed: int = 0) -> tuple[int, ...]:
    """Return ``count`` ids that are far apart over all rotations, the farthest first.

    Each id chosen is one of those farthest from all chosen before and from its own turns, drawn by ``seed``:
    the first n of them are the choice of n, so that a fleet may grow.  Reaches 20, 16 and 14 cells for 20, 100
    and 1000 ids of astratag48h12, where the family as a whole has 12.

    Source: T. F. Gonzalez, "Clustering to minimize the maximum intercluster distance", 1985.
    """
    instance(family, Family, "family", "astratag.codes.FAMILIES has them by name")
    count = whole(count, "count")
    if not 0 < count <= len(family):
        raise ValueError(f"count must be in 1-{len(family)}, the identities of {family.name}, got {count}")
    rng = np.random.default_rng(whole(seed, "seed"))
    pool = np.arange(len(family))
    if len(pool) > LARGEST_POOL:
        pool = np.sort(rng.choice(pool, max(LARGEST_POOL, count), replace=False))
    cells = family.signatures(pool)
    turns = np.stack([pack(turn_clockwise(cells, k)) for k in range(4)])
    distance = np.bitwise_count(turns[1:] ^ turns[0]).min(axis=0).astype(np.int64)
    chosen: list[int] = []
    for _ in range(count):
        row = int(rng.choice(np.flatnonzero(distance == distance.max())))
        chosen.append(int(pool[row]))
        distance = np.minimum(distance, np.bitwise_count(turns[0] ^ turns[:, row, None]).min(axis=0))
        distance[row] = -1
    return tuple(chosen)
