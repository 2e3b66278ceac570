"""How far the corners of each layer are off for long: what a detector makes of blur, neighbours and JPEG stays for a
while, and is no smaller after many looks.

Of each black square: how far all its edges lie outside their place, of which all squares have a share in common, as
blur and exposure are of the whole picture; and beside that how far each edge lies outside by itself, and how far it is
turned.  Each is a first-order Gauss-Markov process (A. E. Bryson, Y.-C. Ho, "Applied optimal control", 1975), whose
stationary spread and correlation time the mission has; it joins the filter's error state, behind the motion's, when the
layer is first seen, and leaves it once the layer was away for so long that little of it is left.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from pipeline.mission import FilterSection

Array = NDArray[np.float64]
Key = tuple[int, int]
"""Marker and layer."""

OUTWARD, EDGES, TURNS = 0, slice(1, 5), slice(5, 9)
PER_LAYER = 9


@dataclass(frozen=True, eq=False)
class LastingErrors:
    """The estimate of every layer's lasting errors, px.

    Outward; each edge by itself, from the one at the top clockwise; how far the end of each is outside and its
    beginning inside.

    Nothing is changed in place.
    """

    keys: tuple[Key, ...] = ()
    px: Array = field(default_factory=lambda: np.zeros((0, PER_LAYER)))
    """(L, 9)"""
    unseen_s: tuple[float, ...] = ()
    """For how long each layer was not measured."""

    def moved(self, error_px: Array) -> LastingErrors:
        """Return these with an error (9 L,) put in."""
        return replace(self, px=self.px + error_px.reshape(-1, PER_LAYER))

    def slots(self, keys: Iterable[Key]) -> list[int]:
        """Return which of these layers' errors are."""
        place = {key: k for k, key in enumerate(self.keys)}
        return [place[key] for key in keys]

    def with_new(self, keys: Sequence[Key], noise: FilterSection) -> LastingErrors:
        """Return these and, behind them, those of layers that were not known, as those that are let one expect."""
        new = tuple(dict.fromkeys(key for key in keys if key not in self.keys))
        if not new:
            return self
        px = np.zeros((len(new), PER_LAYER))
        px[:, OUTWARD] = expected_share(len(self.keys), noise) * self.px[:, OUTWARD].sum()
        return LastingErrors(self.keys + new, np.vstack([self.px, px]), self.unseen_s + (0.0,) * len(new))

    def seen(self, keys: Iterable[Key]) -> LastingErrors:
        """Return the same after layers were measured."""
        now = set(keys)
        unseen_s = (0.0 if key in now else s for key, s in zip(self.keys, self.unseen_s, strict=True))
        return replace(self, unseen_s=tuple(unseen_s))

    def after(self, dt_s: float, noise: FilterSection) -> LastingErrors:
        """Return what is left of them ``dt_s`` seconds later."""
        return LastingErrors(self.keys, decay(dt_s, noise) * self.px, tuple(s + dt_s for s in self.unseen_s))

    def kept(self, noise: FilterSection) -> list[int]:
        """Return which of them were seen so lately that more is known of them than of new ones."""
        longest_s = max(noise.edge_bias_correlation_s, noise.one_edge_bias_correlation_s)
        return [k for k, s in enumerate(self.unseen_s) if s <= longest_s]

    def only(self, chosen: Sequence[int]) -> LastingErrors:
        """Return some of them."""
        return LastingErrors(
            tuple(self.keys[k] for k in chosen), self.px[list(chosen)], tuple(self.unseen_s[k] for k in chosen)
        )


def is_modelled(noise: FilterSection) -> bool:
    """Tell whether a mission knows of any lasting errors."""
    return max(noise.edge_bias_px, noise.one_edge_bias_px, noise.edge_turn_px) > 0


def variances_px2(noise: FilterSection) -> Array:
    """Return the stationary variances (9,) px^2 of a layer's lasting errors."""
    variances = np.empty(PER_LAYER)
    variances[OUTWARD] = noise.edge_bias_px**2
    variances[EDGES], variances[TURNS] = noise.one_edge_bias_px**2, noise.edge_turn_px**2
    return variances


def shared_px2(noise: FilterSection) -> float:
    """Return what of the variance (px^2) of the outward errors all layers have in common."""
    return noise.edge_bias_shared * noise.edge_bias_px**2


def covariance_px2(layers: int, noise: FilterSection) -> Array:
    """Return the stationary covariance (9 L, 9 L) px^2 of the lasting errors of so many layers."""
    variances = variances_px2(noise)
    variances[OUTWARD] -= shared_px2(noise)
    P = np.diag(np.tile(variances, layers))
    P[OUTWARD::PER_LAYER, OUTWARD::PER_LAYER] += shared_px2(noise)
    return P


def expected_share(known: int, noise: FilterSection) -> float:
    """Return how much of the sum of ``known`` layers' outward errors one expects of another layer's.

    The regression on equally correlated variables, which holds whatever is known of them: the processes have the same
    correlation time.
    """
    return noise.edge_bias_shared / (1 + (known - 1) * noise.edge_bias_shared)


def with_new_covariance(P: Array, known: int, new: int, noise: FilterSection) -> Array:
    """Return the covariance (N + 9 ``new``,) squared of an error state (N,) whose last ``known`` layers are joined.

    New layers' outward errors are what known ones let expect, and what these leave open.
    """
    before, size = len(P), len(P) + PER_LAYER * new
    old = np.arange(before - PER_LAYER * known + OUTWARD, before, PER_LAYER)
    fresh = np.arange(before + OUTWARD, size, PER_LAYER)
    share = expected_share(known, noise)
    expected, whole = share * P[old].sum(axis=0), np.zeros((size, size))
    whole[:before, :before], whole[before:, before:] = P, covariance_px2(new, noise)
    whole[fresh, :before], whole[:before, fresh] = expected, expected[:, None]
    explained_px2 = known * share * shared_px2(noise)
    whole[np.ix_(fresh, fresh)] += share * expected[old].sum() - explained_px2
    return whole


def decay(dt_s: float, noise: FilterSection) -> Array:
    """Return the shares (9,) of a layer's lasting errors that are left after ``dt_s`` seconds."""
    shares = np.full(PER_LAYER, np.exp(-dt_s / noise.one_edge_bias_correlation_s))
    shares[OUTWARD] = np.exp(-dt_s / noise.edge_bias_correlation_s)
    return shares
