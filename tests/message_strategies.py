"""Hypothesis strategies for every message model, derived from its fields and their bounds."""

from __future__ import annotations

import types
import typing
from enum import IntEnum
from typing import Any

from annotated_types import Ge, Gt, Le, MaxLen, MinLen
from hypothesis import strategies as st
from pydantic.fields import FieldInfo

from schemas import Message

INT64 = 2**63


def messages(model: type[Message]) -> st.SearchStrategy[Any]:
    """Return a strategy for valid messages of a model, of numbers over their whole range."""
    fields = {name: _values(info.annotation, info.metadata) for name, info in model.model_fields.items()}
    return st.builds(model, **fields)


def _values(kind: Any, bounds: list[Any]) -> st.SearchStrategy[Any]:
    origin = typing.get_origin(kind)
    if origin is typing.Annotated:
        inner, *extra = typing.get_args(kind)
        return _values(inner, [b for e in extra for b in (e.metadata if isinstance(e, FieldInfo) else [e])])
    if origin is types.UnionType or origin is typing.Union:
        return st.one_of(st.none() if a is type(None) else _values(a, bounds) for a in typing.get_args(kind))
    low = next((b.ge for b in bounds if isinstance(b, Ge)), None)
    above = next((b.gt for b in bounds if isinstance(b, Gt)), None)
    high = next((b.le for b in bounds if isinstance(b, Le)), None)
    if origin is list:
        least = next((b.min_length for b in bounds if isinstance(b, MinLen)), 0)
        most = next((b.max_length for b in bounds if isinstance(b, MaxLen)), least + 2)
        return st.lists(_values(typing.get_args(kind)[0], []), min_size=least, max_size=most)
    if kind is float:
        floor, exclusive = (above, True) if above is not None else (low, False)
        return st.floats(floor, high, allow_nan=False, allow_infinity=False, exclude_min=exclusive)
    if kind is bool or issubclass(kind, IntEnum):
        return st.booleans() if kind is bool else st.sampled_from(kind)
    if kind is int:
        floor = above + 1 if above is not None else low
        return st.integers(-INT64 if floor is None else floor, INT64 - 1 if high is None else high)
    return st.text(max_size=10) if kind is str else messages(kind)
