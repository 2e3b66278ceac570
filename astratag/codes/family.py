"""Families: all markers of one generalised Reed-Solomon code, exact under quarter turns of the print.

A region's six cells are one symbol of GF(64), and the eight symbols of a marker are the values of a polynomial
of degree below k at eight points.  The points are two orbits of the map x -> x^8 + a, one for the corner
regions and one for the edge regions, in the order in which a clockwise turn of the print visits them; cell j of
a region lands on cell j of the next, and the field element it stands for is the eighth power of the one before.
Turning the print therefore turns the polynomial f(x) into f(x + a) with all coefficients raised to the eighth
power, which is again one of degree below k: every turned codeword is a codeword.

So a marker and its turns are four codewords, one orbit, and an *identity* is an orbit of four different ones.
A *message* is what the cells of the first k regions say, 6 k bits; the rest follows.  The marker is upright
when its message is the smallest of the four, and its id is the rank of that message among all upright ones.

Source: I. S. Reed and G. Solomon, "Polynomial codes over certain finite fields", 1960; the facts on generalised
codes in S. B. Wicker and V. K. Bhargava (eds.), "Reed-Solomon Codes and Their Applications", 1994.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from astratag.codes import gf64
from astratag.codes.algebraic import Rejected, decode_symbols
from astratag.codes.soft import (
    Reading,
    Search,
    checked_cells,
    decide,
    erased_regions,
    kept_cells,
    likely_words,
    split_level,
)
from astratag.codes.words import CELLS_PER_REGION, REGION_CELLS, LinearMap, Words, checked_bits, pack, unpack
from astratag.geometry import CELLS, REGIONS, TURN_CLOCKWISE

CHUNK = 1 << 20


@dataclass(frozen=True)
class Codeword:
    """A codeword read: whose it is, and how the print was turned clockwise when it read so."""

    marker_id: int
    quarter_turns: int
    wrong_regions: tuple[int, ...]
    """Regions that did not read as the marker's, erased ones left out."""


@dataclass(frozen=True)
class Family:
    """One generalised Reed-Solomon code.

    ``step`` is the a of x -> x^8 + a; ``corner_point`` and ``edge_point`` are the evaluation points of the top-left
    and the left region; ``corner_basis`` and ``edge_basis`` are what each white cell adds to their symbols.
    ``distance`` is the fewest cells in which two readings differ, of one marker or of two; ``seed`` is what
    ``search_instance`` was given to find the rest.
    """

    name: str
    k: int
    distance: int
    step: int
    corner_point: int
    edge_point: int
    corner_basis: tuple[int, ...]
    edge_basis: tuple[int, ...]
    seed: int

    def __len__(self) -> int:
        """Return the number of identities: messages that differ from their half turn, in fours."""
        return len(self._upright)

    @property
    def message_bits(self) -> int:
        """Return the number of bits in a message."""
        return self.k * gf64.SYMBOL_BITS

    @cached_property
    def points(self) -> gf64.Elements:
        """Return the evaluation point (8,) of each region."""
        points = []
        for point in (self.corner_point, self.edge_point):
            for _ in range(REGIONS // 2):
                points.append(point)
                point = int(gf64.power(point, 8)) ^ self.step
        return np.array(points)

    @cached_property
    def basis(self) -> gf64.Elements:
        """Return what each white cell adds to its region's symbol, (8, 6)."""
        first = np.array([self.corner_basis, self.edge_basis])
        turned = gf64.power(first, 8)
        return np.stack([first, turned, first, turned], axis=1).reshape(REGIONS, CELLS_PER_REGION)

    def symbols(self, cells: NDArray[np.uint8]) -> gf64.Elements:
        """Return the symbols (..., 8) of cells (..., 48)."""
        return np.bitwise_xor.reduce(checked_bits(cells)[..., REGION_CELLS] * self.basis, axis=-1)

    def cells(self, symbols: gf64.Elements) -> NDArray[np.uint8]:
        """Return the cells (..., 48) of symbols (..., 8)."""
        cells = np.empty((*symbols.shape[:-1], CELLS), np.uint8)
        cells[..., REGION_CELLS] = self._bits_of_symbol[np.arange(REGIONS), symbols]
        return cells

    @cached_property
    def _bits_of_symbol(self) -> NDArray[np.uint8]:
        """Return the six cells of each region for each symbol, (8, 64, 6)."""
        patterns: NDArray[np.uint8] = np.unpackbits(
            np.arange(gf64.ORDER, dtype=np.uint8)[:, None], axis=1, count=CELLS_PER_REGION, bitorder="little"
        )
        symbols = np.bitwise_xor.reduce(patterns[None] * self.basis[:, None], axis=-1)
        return patterns[np.argsort(symbols, axis=1)]

    @cached_property
    def generator(self) -> tuple[int, ...]:
        """Return the words of the messages 1, 2, 4, ..., 2^(6 k - 1)."""
        return tuple(self._words_from(range(self.k)).tolist())

    def _words_from(self, regions: Sequence[int]) -> Words:
        """Return the words (6 k,) that have a single white cell in any k regions, for each of their cells in turn."""
        known = np.zeros((self.k, CELLS_PER_REGION, self.k), dtype=np.int64)
        known[np.arange(self.k), :, np.arange(self.k)] = self.basis[list(regions)]
        points = self.points[list(regions)]
        through = [gf64.interpolate(points, unit) for unit in np.eye(self.k, dtype=np.int64)]
        values = np.array([gf64.evaluate(p, self.points) for p in through])
        symbols = np.bitwise_xor.reduce(gf64.multiply(known[..., None], values), axis=2)
        return pack(self.cells(symbols.reshape(self.message_bits, REGIONS)))

    @cached_property
    def _any_k_regions(self) -> tuple[NDArray[np.int64], Words]:
        """Return every choice of k regions, (C, k), and the words (C, 6 k) that each cell of them stands for."""
        choices = list(combinations(range(REGIONS), self.k))
        return np.array(choices), np.stack([self._words_from(choice) for choice in choices])

    @cached_property
    def encoder(self) -> LinearMap:
        """Return the map from messages to words."""
        return LinearMap(self.generator)

    @cached_property
    def _turn(self) -> LinearMap:
        """Return the map from a message to the message that the print turned clockwise reads."""
        turned = np.empty((self.message_bits, CELLS), np.uint8)
        turned[:, TURN_CLOCKWISE] = unpack(np.array(self.generator, dtype=np.uint64))
        return LinearMap(self.messages(turned).tolist())

    @cached_property
    def _upright(self) -> NDArray[np.uint32]:
        """Return the upright messages in rising order; place i holds that of id i."""
        found = []
        for first in range(0, 1 << self.message_bits, CHUNK):
            messages = np.arange(first, min(first + CHUNK, 1 << self.message_bits))
            turns = self._turns(messages)
            found.append(messages[(turns[0] < turns[1:]).all(axis=0)].astype(np.uint32))
        return np.concatenate(found)

    def _turns(self, messages: ArrayLike) -> Words:
        """Return messages (...) as they are and turned once, twice and three times clockwise, (4, ...)."""
        turns = [np.asarray(messages, dtype=np.uint64)]
        for _ in range(3):
            turns.append(self._turn(turns[-1]))
        return np.stack(turns)

    @property
    def _message_cells(self) -> NDArray[np.int64]:
        """Return the cells (6 k,) whose bits are the message."""
        return REGION_CELLS[: self.k].reshape(-1)

    def messages(self, cells: NDArray[np.uint8]) -> NDArray[np.int64]:
        """Return the messages (...) that cells (..., 48) say."""
        return checked_bits(cells)[..., self._message_cells] @ (1 << np.arange(self.message_bits))

    def signatures(self, ids: ArrayLike) -> NDArray[np.uint8]:
        """Return the upright cells (..., 48) of ids (...).  Raises ValueError for an id outside the family."""
        ids = np.asarray(ids) if np.size(ids) else np.zeros(np.shape(ids), dtype=np.int64)
        if ids.dtype.kind not in "iu":
            raise ValueError(f"{self.name} has ids 0-{len(self) - 1}, got what is no array of integers")
        if ids.size and not (ids.min() >= 0 and ids.max() < len(self)):
            outside = ids.min() if ids.min() < 0 else ids.max()
            raise ValueError(f"{self.name} has ids 0-{len(self) - 1}, got {outside}")
        return unpack(self.encoder(self._upright[ids]))

    def identify(self, cells: NDArray[np.uint8]) -> tuple[int, int] | None:
        """Return the id and clockwise quarter turns of a codeword's cells (48,).

        None for the few codewords that look the same after half a turn: they are nobody's.
        """
        turns = self._turns(self.messages(cells))
        if turns[0] == turns[2]:
            return None
        to_upright = int(turns.argmin())
        return int(np.searchsorted(self._upright, turns[to_upright].astype(np.uint32))), -to_upright % 4

    def correct(self, cells: NDArray[np.uint8], erased: NDArray[np.bool_] | None = None) -> Codeword | Rejected:
        """Return whose cells (48,) these are when t regions are wrong and e of them ``erased`` (8,), 2 t + e <= 8 - k.

        Beyond that it refuses, or finds another marker that differs in as few regions: a detector that must not
        accept noise asks for more than this (see ``Family.decode``).
        """
        kept = np.flatnonzero(~erased_regions(erased))
        received = self.symbols(cells)
        polynomial = decode_symbols(received[kept], self.points[kept], self.k)
        if isinstance(polynomial, Rejected):
            return polynomial
        symbols = gf64.evaluate(polynomial, self.points)
        identity = self.identify(self.cells(symbols))
        if identity is None:
            return Rejected("the nearest codeword looks the same after half a turn and is nobody's")
        wrong = kept[symbols[kept] != received[kept]]
        return Codeword(*identity, tuple(wrong.tolist()))

    def decode(
        self,
        cells: NDArray[np.float64],
        erased: ArrayLike | None = None,
        *,
        threshold: float | None = None,
        most_missing: int = 0,
    ) -> Reading | Rejected:
        """Return the marker whose code correlates best with brightnesses (48,), searched among all identities.

        Arguments and errors are those of ``Dictionary.decode``; at least k regions must be left.  Candidates are
        the codewords through every choice of k regions, which hold the right one whenever k regions read well,
        and those near the surest cells (``likely_words``).
        """
        cells, kept = checked_cells(cells), kept_cells(erased)
        choices, words = self._any_k_regions
        whole = np.all(kept[REGION_CELLS], axis=1)
        if whole.sum() < self.k:
            return Rejected(f"{whole.sum()} regions are left and {self.k} are needed")
        level = split_level(cells[kept])
        in_view = np.all(whole[choices], axis=1)
        white = cells[REGION_CELLS[choices[in_view]]] > level
        through = np.bitwise_xor.reduce(np.where(white.reshape(-1, self.message_bits), words[in_view], 0), axis=1)
        found = np.unique(np.concatenate([through, likely_words(cells, kept, level, self.generator)]))
        codes = unpack(found)
        search = Search(4 * len(self), threshold, most_missing)
        search = replace(search, most_missing=min(search.most_missing, REGIONS - self.k))
        return decide(cells, kept, codes.astype(float), lambda n: self.identify(codes[n]), search)
