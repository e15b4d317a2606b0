"""JSON Schema of a type: the messages' types are their only definition.

A field's docstring becomes its description. `Annotated` refines where JSON has less than Python:
`Annotated[str, State]` is a name of that enumeration, `Annotated[dict[str, Any], Shot]` an object with the
fields of that class, and `Count` gives lengths.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Mapping, Sequence
from dataclasses import is_dataclass
from datetime import datetime
from enum import Enum, StrEnum
from functools import reduce
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, NotRequired, Union, get_args, get_origin, get_type_hints

from bench.config.field_docs import field_docs
from drivers.base.ranges import Count

Schema = dict[str, Any]

_PLAIN: Mapping[Any, Schema] = {
    bool: {"type": "boolean"},
    int: {"type": "integer"},
    float: {"type": "number"},
    str: {"type": "string"},
    NoneType: {"type": "null"},
    datetime: {"type": "string", "format": "date-time"},
    Any: {},
}


def schema_of(kind: Any) -> Schema:
    """Return the JSON Schema of values of `kind`; keys beyond those of an object's class are left open.

    Raises:
        TypeError: JSON has no such values.
    """
    origin, arguments = get_origin(kind), get_args(kind)
    if kind in _PLAIN:
        return dict(_PLAIN[kind])
    if origin is Annotated:
        return reduce(_refined, arguments[1:], schema_of(arguments[0]))
    if origin is NotRequired:
        return schema_of(arguments[0])
    if origin in (Union, UnionType):
        return _one_of([schema_of(part) for part in arguments])
    if origin is Literal:
        return {"enum": list(arguments)} if len(arguments) > 1 else {"const": arguments[0]}
    if isinstance(kind, type) and issubclass(kind, Enum):
        return {"type": "string", "enum": names_of(kind)}
    if origin is tuple and arguments[-1] is not Ellipsis:
        count = len(arguments)
        parts = [schema_of(part) for part in arguments]
        return {"type": "array", "prefixItems": parts, "minItems": count, "maxItems": count}
    if origin in (list, tuple, Sequence):
        return {"type": "array", "items": schema_of(arguments[0])}
    if origin in (dict, Mapping):
        values = schema_of(arguments[1])
        return {"type": "object"} | ({"additionalProperties": values} if values else {})
    if is_dataclass(kind) or hasattr(kind, "__required_keys__") or hasattr(kind, "_fields"):
        return _object_of(kind)
    raise TypeError(f"JSON has no {kind!r}")


def names_of(kind: type[Enum]) -> list[str]:
    """Return the texts that messages have for the members of `kind`."""
    return [str(member.value) if issubclass(kind, StrEnum) else member.name for member in kind]


def _object_of(kind: Any) -> Schema:
    """Return the schema of an object with the fields of `kind`, all of them required unless it says so."""
    hints = get_type_hints(kind, include_extras=True)
    docs = field_docs(kind)
    properties = {}
    for name, hint in hints.items():
        about = re.sub(r"\bNone\b", "null", " ".join(docs.get(name, "").split()))
        properties[name] = schema_of(hint) | ({"description": about} if about else {})
    return {
        "type": "object",
        "description": (inspect.getdoc(kind) or "").split("\n\n", 1)[0].replace("\n", " "),
        "properties": properties,
        "required": [name for name, hint in hints.items() if get_origin(hint) is not NotRequired],
    }


def _refined(schema: Schema, annotation: Any) -> Schema:
    match annotation:
        case Count(entries):
            return schema | {"minItems": entries, "maxItems": entries}
        case type() if issubclass(annotation, Enum):
            return schema | {"enum": names_of(annotation)}
        case type() if is_dataclass(annotation) or hasattr(annotation, "__required_keys__"):
            return schema_of(annotation)
    return schema


def _one_of(parts: list[Schema]) -> Schema:
    """Return the schema of a union; with null of a plain type in the short form."""
    others = [part for part in parts if part != {"type": "null"}]
    if len(others) == 1 and len(parts) == 2:
        (other,) = others
        if other.keys() == {"type"}:
            return {"type": [other["type"], "null"]}
    return {"anyOf": parts}
