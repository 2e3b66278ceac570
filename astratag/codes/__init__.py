"""Codes: what the 48 cells of a marker may say, how it is read back, and how often chance says it too."""

from astratag.codes.acceptance import (
    acceptance_threshold,
    effective_cells,
    hamming_false_accept_rate,
    hamming_threshold,
)
from astratag.codes.algebraic import Rejected
from astratag.codes.families import FAMILIES
from astratag.codes.family import Codeword, Family
from astratag.codes.search import search_instance
from astratag.codes.selection import select_identities
from astratag.codes.soft import Reading

__all__ = [
    "FAMILIES",
    "Codeword",
    "Family",
    "Reading",
    "Rejected",
    "acceptance_threshold",
    "effective_cells",
    "hamming_false_accept_rate",
    "hamming_threshold",
    "search_instance",
    "select_identities",
]
