"""The messages as a .proto file for other languages; ``python -m schemas.proto`` writes it.

The text is derived from the models, like the descriptor, with their docstrings as comments.
"""

from __future__ import annotations

import ast
import inspect
from collections.abc import Iterator
from enum import IntEnum
from pathlib import Path

import schemas
from schemas import messages
from schemas.codec import SCALARS, FieldPlan, all_models, field_plans
from schemas.messages import PROTO_PACKAGE

PATH = Path(__file__).parent / "proto" / "relnav.proto"
HEADER = """\
// The messages of the relative-navigation pipeline, derived from schemas/messages.py: change them there, then
// run `python -m schemas.proto`.  Standard messages are foxglove's: https://github.com/foxglove/foxglove-sdk.
//
"""


def proto_text() -> str:
    """Return the text of the .proto file."""
    docs = _docstrings()
    _, _, conventions = (inspect.getdoc(schemas) or "").split("\n", 2)
    lines = [HEADER + _comment(conventions), "", 'syntax = "proto3";', "", f"package {PROTO_PACKAGE};"]
    enums = {plan.type for model in all_models() for plan in field_plans(model) if _is_enum(plan.type)}
    for enum in sorted(enums, key=lambda enum: str(enum.__name__)):
        lines += ["", *_block("enum", enum.__name__, docs, [(m.name, f"{m.name} = {m.value};") for m in enum])]
    for model in all_models():
        fields = [(plan.name, _field(plan)) for plan in field_plans(model)]
        lines += ["", *_block("message", model.__name__, docs, fields)]
    return "\n".join(lines) + "\n"


def _block(kind: str, name: str, docs: dict[str, str], members: list[tuple[str, str]]) -> Iterator[str]:
    yield _comment(docs[name])
    yield f"{kind} {name} {{"
    for member, text in members:
        doc = docs.get(f"{name}.{member}")
        if doc is not None:
            yield _comment(doc, "  ")
        yield f"  {text}"
    yield "}"


def _field(plan: FieldPlan) -> str:
    scalar = plan.type in SCALARS
    label = "repeated " if plan.repeated else "optional " if plan.optional and scalar else ""
    kind = SCALARS[plan.type][1] if scalar else plan.type.__name__
    return f"{label}{kind} {plan.name} = {plan.number};"


def _comment(text: str, indent: str = "") -> str:
    return "\n".join(f"{indent}// {line}".rstrip() for line in inspect.cleandoc(text).split("\n"))


def _is_enum(kind: object) -> bool:
    return isinstance(kind, type) and issubclass(kind, IntEnum)


def _docstrings() -> dict[str, str]:
    """Return the docstrings of classes, by name, and those below their fields, by "Class.field"."""
    docs: dict[str, str] = {}
    for node in ast.parse(inspect.getsource(messages)).body:
        if not isinstance(node, ast.ClassDef):
            continue
        docs[node.name] = ast.get_docstring(node) or ""
        for field, below in zip(node.body, node.body[1:], strict=False):
            if isinstance(field, ast.AnnAssign | ast.Assign) and isinstance(below, ast.Expr):
                target = field.target if isinstance(field, ast.AnnAssign) else field.targets[0]
                docs[f"{node.name}.{ast.unparse(target)}"] = str(ast.literal_eval(below.value))
    return docs


if __name__ == "__main__":
    PATH.parent.mkdir(exist_ok=True)
    PATH.write_text(proto_text())
    print(PATH)
