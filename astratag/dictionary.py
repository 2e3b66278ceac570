"""Dictionaries: the codes a detector looks for, each in its four orientations."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from astratag.geometry import CELLS, turn_clockwise

ORIENTATIONS = ("0", "90", "180", "270")
"""Names of the four readings: "90" is what the print reads when turned clockwise by 90 degrees."""

PUBLISHED_MESSAGES = (
    (0x3AD948, 0x6A7C47, 0x928B3A, 0x5ED181, 0x21A31B, 0xBDEC98, 0x671123, 0x89BCCD, 0x91C6B9, 0x58238B)
    + (0xA41FE9, 0x2AFB01, 0x89B9D0, 0xBE5ABC, 0x84CA19, 0xF2DB2D, 0x77BB25, 0xF6E292, 0xDAF4E8, 0x96D66E)
)  # fmt: skip
"""The 24-bit messages behind the twenty markers published with the AstraTag paper (2026)."""


def published_signature(message: int) -> NDArray[np.uint8]:
    """Return the 48 cells printed for a 24-bit message, in cell order, 1 for white.

    Systematic code with generator (x + 1)^24 = x^24 + x^16 + x^8 + 1.  The published artworks print the
    parity without its leading zeros and pad the whole with zeros on the right; so do we, to read them.
    """
    m0, m1, m2 = message >> 16, (message >> 8) & 0xFF, message & 0xFF
    parity = (m2 << 16) | ((m0 ^ m2) << 8) | (m1 ^ m2)
    text = (f"{message:024b}" + (f"{parity:b}" if parity else "")).ljust(CELLS, "0")
    return np.array([int(bit) for bit in text], dtype=np.uint8)


@dataclass(frozen=True, eq=False)
class Dictionary:
    """A set of marker codes.

    ``signatures`` is (N, 48), uint8, 1 for a white cell, upright; ``ids`` gives each row's marker id.
    """

    family: str
    ids: tuple[int, ...]
    signatures: NDArray[np.uint8] = field(repr=False)

    def __post_init__(self) -> None:
        if not self.ids:
            raise ValueError(f"dictionary {self.family!r} holds no markers")
        if not np.isin(self.signatures, (0, 1)).all():
            raise ValueError(f"dictionary {self.family!r} has cells that are neither 0 nor 1")
        if self.signatures.shape != (len(self.ids), CELLS):
            raise ValueError(
                f"signatures must be ({len(self.ids)}, {CELLS}), got {self.signatures.shape}: one row of cells an id"
            )
        signatures = np.array(self.signatures, dtype=np.uint8)
        signatures.flags.writeable = False
        object.__setattr__(self, "signatures", signatures)
        if len(set(self.ids)) != len(self.ids):
            raise ValueError(f"dictionary {self.family!r} lists an id twice")
        rows = self.oriented.reshape(-1, CELLS)
        if len(np.unique(rows, axis=0)) != len(rows):
            raise ValueError(
                f"dictionary {self.family!r} has colliding signatures: two ids, or two turns of one, read the same"
            )

    def __len__(self) -> int:
        return len(self.ids)

    @cached_property
    def oriented(self) -> NDArray[np.uint8]:
        """All readings, (N, 4, 48): row [i, k] is id i turned clockwise by k quarter turns."""
        return np.stack([turn_clockwise(self.signatures, k) for k in range(4)], axis=1)

    @cached_property
    def minimum_distance(self) -> int:
        """Smallest Hamming distance between any two readings, of one marker or of two."""
        rows = self.oriented.reshape(-1, CELLS).astype(np.int64)
        distance = (rows[:, None, :] != rows[None, :, :]).sum(axis=2)
        return int(distance[~np.eye(len(rows), dtype=bool)].min())

    def signature(self, marker_id: int) -> NDArray[np.uint8]:
        """Return the upright code (48,) of an id.  Raises ValueError for an id that is not in the dictionary."""
        if marker_id not in self.ids:
            raise ValueError(
                f"marker {marker_id} is not in dictionary {self.family!r} (ids {min(self.ids)}-{max(self.ids)})"
            )
        return self.signatures[self.ids.index(marker_id)]


def _published() -> Dictionary:
    signatures = np.array([published_signature(m) for m in PUBLISHED_MESSAGES])
    return Dictionary("astratag20", tuple(range(len(PUBLISHED_MESSAGES))), signatures)


def _from_json(path: Path) -> Dictionary:
    """Read the reference implementation's JSON: {id: {"0" | "90" | ...: {"signature": 48 characters}}}."""
    try:
        entries = json.loads(path.read_text())
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise ValueError(f"cannot read dictionary {path}: {error}") from error
    try:
        ids = tuple(sorted(int(key) for key in entries))
        rows = [[int(bit) for bit in entries[str(i)]["0"]["signature"]] for i in ids]
        signatures = np.array(rows, dtype=np.uint8)
        dictionary = Dictionary(path.stem, ids, signatures)
        turned = {
            (i, name): [int(bit) for bit in reading["signature"]]
            for i in ids
            for name, reading in entries[str(i)].items()
        }
    except (KeyError, TypeError, AttributeError, OverflowError, ValueError) as error:
        raise ValueError(f"dictionary {path} is not {{id: {{'0': {{'signature': 48 bits}}}}}}: {error}") from error
    for row, i in enumerate(ids):
        for k, name in enumerate(ORIENTATIONS):
            if (i, name) in turned and not np.array_equal(dictionary.oriented[row, k], turned[i, name]):
                raise ValueError(
                    f"dictionary {path}: the {name} degree signature of id {i} is not its 0 degree one turned"
                )
    return dictionary


def load_dictionary(name: str | Path = "astratag20") -> Dictionary:
    """Return a dictionary by name ("astratag20") or from a file in the reference's JSON format.

    Raises ValueError for an unknown name, an unreadable file or colliding signatures.
    """
    if name == "astratag20":
        return _published()
    path = Path(name)
    if path.is_file():
        return _from_json(path)
    raise ValueError(f"unknown dictionary {str(name)!r}: neither a family (astratag20) nor a JSON file that exists")
