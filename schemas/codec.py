"""From messages to bytes and back: protobuf, derived from the pydantic models or foxglove's own classes."""

from __future__ import annotations

import types
import typing
from collections.abc import Callable
from enum import IntEnum
from functools import cache
from typing import Any, TypeVar

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.descriptor import Descriptor, FileDescriptor
from google.protobuf.message import DecodeError
from google.protobuf.message import Message as ProtoMessage
from pydantic import ValidationError

from schemas import messages
from schemas.messages import PROTO_PACKAGE, Message

AnyMessage = Message | ProtoMessage
"""One of our own models, or one of foxglove's protobuf classes."""

M = TypeVar("M", bound=AnyMessage)

_FIELD = descriptor_pb2.FieldDescriptorProto
SCALARS: dict[type, tuple[Any, str]] = {
    float: (_FIELD.TYPE_DOUBLE, "double"),
    int: (_FIELD.TYPE_INT64, "int64"),
    bool: (_FIELD.TYPE_BOOL, "bool"),
    str: (_FIELD.TYPE_STRING, "string"),
}


class CodecError(ValueError):
    """Bytes that are not the message they claim to be."""


class FieldPlan(typing.NamedTuple):
    """How one model field travels."""

    name: str
    number: int
    type: Any
    """A scalar, an IntEnum or a Message class."""
    repeated: bool
    optional: bool


def all_models() -> list[type[Message]]:
    """Return every message model, in the order of their definition."""
    return [m for m in vars(messages).values() if isinstance(m, type) and issubclass(m, Message) and m is not Message]


@cache
def field_plans(model: type[Message]) -> tuple[FieldPlan, ...]:
    """Return a model's fields in the order of their numbers."""
    plans = []
    for name, info in model.model_fields.items():
        kind, optional, repeated = info.annotation, False, False
        if isinstance(kind, types.UnionType) or typing.get_origin(kind) is typing.Union:
            (kind,) = (a for a in typing.get_args(kind) if a is not type(None))
            optional = True
        if typing.get_origin(kind) is typing.Annotated:
            kind = typing.get_args(kind)[0]
        if typing.get_origin(kind) is list:
            (kind,), repeated = typing.get_args(kind), True
        extra = info.json_schema_extra
        assert isinstance(extra, dict), f"{model.__name__}.{name} has no field number"
        plans.append(FieldPlan(name, typing.cast(int, extra["number"]), kind, repeated, optional))
    return tuple(sorted(plans, key=lambda plan: plan.number))


@cache
def file_descriptor() -> FileDescriptor:
    """Return the protobuf file derived from the models."""
    file = descriptor_pb2.FileDescriptorProto(name="relnav.proto", package=PROTO_PACKAGE, syntax="proto3")
    enums: dict[str, type[IntEnum]] = {}
    for model in all_models():
        message = file.message_type.add(name=model.__name__)
        for plan in field_plans(model):
            out = message.field.add(name=plan.name, number=plan.number, json_name=plan.name)
            out.label = _FIELD.LABEL_REPEATED if plan.repeated else _FIELD.LABEL_OPTIONAL
            if plan.type in SCALARS:
                out.type = SCALARS[plan.type][0]
                if plan.optional and not plan.repeated:
                    out.proto3_optional = True
                    out.oneof_index = len(message.oneof_decl)
                    message.oneof_decl.add(name=f"_{plan.name}")
            elif issubclass(plan.type, IntEnum):
                enums[plan.type.__name__] = plan.type
                out.type, out.type_name = _FIELD.TYPE_ENUM, f".{PROTO_PACKAGE}.{plan.type.__name__}"
            else:
                out.type, out.type_name = _FIELD.TYPE_MESSAGE, f".{PROTO_PACKAGE}.{plan.type.__name__}"
    for name, enum in enums.items():
        added = file.enum_type.add(name=name)
        for member in enum:
            added.value.add(name=member.name, number=member.value)
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return pool.FindFileByName(file.name)


@cache
def proto_class(model: type[Message]) -> Callable[[], ProtoMessage]:
    """Return the protobuf class that carries a model."""
    return message_factory.GetMessageClass(file_descriptor().message_types_by_name[model.__name__])


def descriptor_of(schema: Any) -> Descriptor:
    """Return the protobuf descriptor of a message class, ours or foxglove's."""
    if issubclass(schema, Message):
        return file_descriptor().message_types_by_name[schema.__name__]
    return typing.cast(Descriptor, schema.DESCRIPTOR)


def schema_name(schema: Any) -> str:
    """Return a schema's full name, such as "relnav.RelativeState" or "foxglove.Log"."""
    return descriptor_of(schema).full_name


def file_descriptor_set(descriptor: Descriptor) -> bytes:
    """Return a message's protobuf file and all it imports, imports first, as readers of recordings want them."""
    files = descriptor_pb2.FileDescriptorSet()
    added: set[str] = set()

    def add(file: FileDescriptor) -> None:
        if file.name in added:
            return
        added.add(file.name)
        for dependency in file.dependencies:
            add(dependency)
        file.CopyToProto(files.file.add())

    add(descriptor.file)
    return files.SerializeToString(deterministic=True)


def encode(message: AnyMessage) -> bytes:
    """Return the protobuf bytes of a message; equal messages give equal bytes."""
    if isinstance(message, Message):
        proto = proto_class(type(message))()
        _fill(proto, message)
    else:
        proto = message
    return proto.SerializeToString(deterministic=True)


def decode(schema: type[M], payload: bytes) -> M:
    """Return the message of class ``schema`` in ``payload``.  Raises CodecError when it is not one."""
    try:
        if not issubclass(schema, Message):
            return typing.cast(M, schema.FromString(payload))
        proto = proto_class(schema)()
        proto.ParseFromString(payload)
        return typing.cast(M, schema.model_validate(_plain(proto, schema)))
    except (DecodeError, ValidationError) as error:
        reason = error.errors()[0]["msg"] if isinstance(error, ValidationError) else "damaged protobuf"
        raise CodecError(f"not a {schema_name(schema)} of {len(payload)} bytes: {reason}") from error


def _fill(proto: ProtoMessage, message: Message) -> None:
    for plan in field_plans(type(message)):
        value = getattr(message, plan.name)
        if value is None:
            continue
        nested = isinstance(plan.type, type) and issubclass(plan.type, Message)
        if plan.repeated and nested:
            repeated = getattr(proto, plan.name)
            for item in value:
                _fill(repeated.add(), item)
        elif plan.repeated:
            getattr(proto, plan.name).extend(value)
        elif nested:
            child = getattr(proto, plan.name)
            child.SetInParent()
            _fill(child, value)
        else:
            setattr(proto, plan.name, value)


def _plain(proto: ProtoMessage, model: type[Message]) -> dict[str, Any]:
    plain: dict[str, Any] = {}
    for plan in field_plans(model):
        nested = isinstance(plan.type, type) and issubclass(plan.type, Message)
        if plan.repeated:
            values = getattr(proto, plan.name)
            if len(values) or not plan.optional:
                plain[plan.name] = [_plain(v, plan.type) for v in values] if nested else list(values)
        elif nested:
            if proto.HasField(plan.name):
                plain[plan.name] = _plain(getattr(proto, plan.name), plan.type)
        elif not plan.optional or proto.HasField(plan.name):
            plain[plan.name] = getattr(proto, plan.name)
    return plain
