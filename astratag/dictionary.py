"""Dictionaries: the codes a detector looks for, each in its four orientations."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property
from operator import index
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from astratag.checks import file_path, instance, numbers, positive
from astratag.codes.algebraic import Rejected
from astratag.codes.families import FAMILIES
from astratag.codes.family import Family
from astratag.codes.soft import Reading, Search, checked_cells, decide, kept_cells
from astratag.codes.words import pack
from astratag.geometry import CELLS, square, turn_clockwise

ORIENTATIONS = ("0", "90", "180", "270")
"""Names of the four readings: "90" is what the print reads when turned clockwise by 90 degrees."""

PUBLISHED = "astratag20"
LARGEST_ID = (1 << 31) - 1
"""What fits wherever an id is written."""
LARGEST = 1 << 16
"""Most identities a dictionary may hold: each is compared with everything seen."""

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
    """A set of marker codes: the *active set*, what a detector looks for.

    ``signatures`` is (N, 48), uint8, 1 for a white cell, upright; ``ids`` gives each row's marker id.
    """

    family: str
    ids: tuple[int, ...]
    signatures: NDArray[np.uint8] = field(repr=False)

    def __post_init__(self) -> None:
        instance(self.family, str, "family", "it is a name")
        ids = _integers(self.ids)
        if not ids:
            raise ValueError(f"dictionary {self.family!r} holds no markers")
        if not 0 <= min(ids) <= max(ids) <= LARGEST_ID:
            raise ValueError(f"dictionary {self.family!r} has ids {min(ids)}-{max(ids)}, outside of 0-{LARGEST_ID}")
        cells = numbers(self.signatures, "signatures")
        if not np.isin(cells, (0, 1)).all():
            raise ValueError(f"dictionary {self.family!r} has cells that are neither 0 nor 1")
        if cells.shape != (len(ids), CELLS):
            raise ValueError(f"signatures must be ({len(ids)}, {CELLS}), got {cells.shape}: one row of cells an id")
        signatures = cells.astype(np.uint8)
        signatures.flags.writeable = False
        object.__setattr__(self, "ids", ids)
        object.__setattr__(self, "signatures", signatures)
        if len(set(self.ids)) != len(self.ids):
            raise ValueError(f"dictionary {self.family!r} lists an id twice")
        if len(np.unique(self._words)) != self._words.size:
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
    def _words(self) -> NDArray[np.uint64]:
        """All readings (N, 4) packed into words."""
        return pack(self.oriented)

    @cached_property
    def _codes(self) -> NDArray[np.float64]:
        """All readings (4 N, 48), ready to be multiplied with brightnesses."""
        return self.oriented.reshape(-1, CELLS).astype(float)

    @cached_property
    def _row(self) -> dict[int, int]:
        """The row of each id."""
        return {marker_id: row for row, marker_id in enumerate(self.ids)}

    @cached_property
    def minimum_distance(self) -> int:
        """Smallest Hamming distance between any two readings, of one marker or of two."""
        least = CELLS
        for row, upright in enumerate(self._words[:, 0]):  # turning both of a pair changes nothing
            distance = np.bitwise_count(self._words[row:] ^ upright)
            distance[0, 0] = CELLS
            least = min(least, int(distance.min()))
        return least

    def row(self, marker_id: int) -> int:
        """Return the row of an id.  Raises ValueError for an id that is not in the dictionary."""
        try:
            return self._row[index(marker_id)]
        except (KeyError, TypeError):
            raise ValueError(
                f"marker {marker_id!r} is not in dictionary {self.family!r} (ids {min(self.ids)}-{max(self.ids)})"
            ) from None

    def signature(self, marker_id: int) -> NDArray[np.uint8]:
        """Return the upright code (48,) of an id.  Raises ValueError for an id that is not in the dictionary."""
        return self.signatures[self.row(marker_id)]

    def restricted(self, ids: Iterable[int]) -> Dictionary:
        """Return the dictionary of some of the ids.  Raises ValueError for none, an unknown one, or one twice."""
        chosen = _integers(ids)
        return Dictionary(self.family, chosen, self.signatures[[self.row(i) for i in chosen]])

    def decode(
        self,
        cells: NDArray[np.float64],
        erased: ArrayLike | None = None,
        *,
        threshold: float | None = None,
        most_missing: int = 0,
    ) -> Reading | Rejected:
        """Return the reading that correlates best with brightnesses (48,), of all there are: maximum likelihood.

        Regions are those of the image: TL, TR, BR, BL, L, T, R, B.  ``erased`` (8,) booleans name some that do not
        count; up to ``most_missing`` more may be left out where the others then fit far better: three, a covered
        side, are found without mistakes, more with a wrong id now and then.  ``threshold`` is the least correlation
        to accept, by default the one that chance passes once in a million candidates.
        Raises ValueError for cells or flags of another shape, or cells that are not finite.
        """
        search = Search(self._words.size, threshold, most_missing)
        cells, kept = checked_cells(cells), kept_cells(erased)
        return decide(cells, kept, self._codes, lambda n: (self.ids[n // 4], n % 4), search)


def _published() -> Dictionary:
    signatures = np.array([published_signature(m) for m in PUBLISHED_MESSAGES])
    return Dictionary(PUBLISHED, tuple(range(len(PUBLISHED_MESSAGES))), signatures)


def _from_json(path: Path) -> Dictionary:
    """Read the reference implementation's JSON: {id: {"0" | "90" | ...: {"signature": 48 characters}}}."""
    try:
        entries = json.loads(path.read_text(), object_pairs_hook=_each_once)
    except (OSError, ValueError, RecursionError) as error:
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


def _each_once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return the entries of a JSON object.  Raises ValueError for a key listed twice."""
    entries = dict(pairs)
    if len(entries) < len(pairs):
        twice = next(key for n, (key, _) in enumerate(pairs) if key in dict(pairs[:n]))
        raise ValueError(f"{twice!r} is listed twice")
    return entries


def _is_file(path: str) -> bool:
    """Return whether a path names a file: not when it is too long to be one."""
    try:
        return Path(path).is_file()
    except OSError:
        return False


def load_dictionary(name: str | Path = PUBLISHED, ids: Iterable[int] | None = None) -> Dictionary:
    """Return a dictionary by name, or from a file in the reference's JSON format, whole or only some ``ids`` of it.

    Names are the published "astratag20" and the families of ``astratag.codes``; "astratag48h12:0-99,205" is short
    for the same with ids.  Raises ValueError for an unknown name, an unreadable file, colliding signatures, ids
    that are not there, or a whole family too large to look for.
    """
    source, colon, listed = str(name).rpartition(":")
    if not colon or _is_file(str(name)):
        source = str(name)
    elif ids is None:
        ids = _listed_ids(listed, str(name))
    else:
        raise ValueError(f"ids are given twice: in the name {str(name)!r} and as ids")
    if source in FAMILIES:
        return _of_family(FAMILIES[source], ids)
    if source == PUBLISHED:
        whole = _published()
    elif _is_file(source):
        whole = _from_json(Path(source))
    else:
        known = ", ".join((PUBLISHED, *FAMILIES))
        raise ValueError(f"unknown dictionary {source!r}: neither a family ({known}) nor a JSON file that exists")
    return whole if ids is None else whole.restricted(ids)


def _of_family(family: Family, ids: Iterable[int] | None) -> Dictionary:
    """Return the dictionary of a family's ids, all of them when None."""
    if ids is None and len(family) > LARGEST:
        raise ValueError(
            f"{family.name} has {len(family)} identities, too many to look for: name those in use, as in "
            f"'{family.name}:0-99'"
        )
    chosen = tuple(range(len(family))) if ids is None else _integers(ids)
    return Dictionary(family.name, chosen, family.signatures(chosen))


def _integers(ids: Iterable[int]) -> tuple[int, ...]:
    try:
        return tuple(index(i) for i in ids)
    except TypeError as error:
        raise ValueError(f"ids must be a list of integers, got {ids!r}") from error


def _listed_ids(text: str, name: str) -> list[int]:
    """Return the ids of a list such as "0-99,205"."""
    ids: list[int] = []
    for part in text.split(","):
        match = re.fullmatch(r"\s*(\d{1,9})(?:-(\d{1,9}))?\s*", part)
        first, last = (int(match[1]), int(match[2] or match[1])) if match else (1, 0)
        if not first <= last < first + LARGEST:
            raise ValueError(f"dictionary {name!r}: ids are listed like 0-99,205, got {part!r}")
        ids += range(first, last + 1)
    return ids


def write_dictionary(dictionary: Dictionary, path: str | Path, side_m: float = 0.03) -> Path:
    """Write a dictionary in the reference's JSON format and return its path.

    Each id has its four oriented signatures and, for each, the world points of the image's top-left, top-right,
    bottom-right and bottom-left corner: millimetres from the print's top-left corner, x right, y down, z 0.  The
    reference gives 30.0 for a side and no unit.  Raises ValueError for a side that is no length.
    """
    instance(dictionary, Dictionary, "dictionary", "load_dictionary(name) makes one")
    positive(side_m, "side_m")
    corners_mm = np.zeros((4, 3))
    corners_mm[:, :2] = square(0.0, round(1e3 * side_m, 6))
    entries = {
        str(marker_id): {
            name: {
                "signature": "".join(map(str, dictionary.oriented[row, turns])),
                "world_points": np.roll(corners_mm, turns, axis=0).tolist(),
            }
            for turns, name in enumerate(ORIENTATIONS)
        }
        for row, marker_id in enumerate(dictionary.ids)
    }
    path = file_path(path)
    path.write_text(json.dumps(entries, indent=2))
    return path
