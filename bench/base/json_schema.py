"""JSON Schema of a type, and violations of it by a message: types are the messages' only definition.

A field's docstring becomes its description. `Annotated` refines where JSON has less than Python:
`Annotated[str, State]` is a name of that enumeration, `Annotated[dict[str, Any], Shot]` an object with the
fields of that class, and `Count` gives lengths.
"""

from __future__ import annotations

import ast
import inspect
import json
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import is_dataclass
from datetime import datetime
from enum import Enum, StrEnum
from functools import cache, reduce
from itertools import pairwise
from math import isfinite
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, NotRequired, Union, get_args, get_origin, get_type_hints

from bench.base.errors import BenchError
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

_IS: Mapping[str, Callable[[Any], bool]] = {
    "boolean": lambda value: isinstance(value, bool),
    "integer": lambda value: type(value) is int,
    "number": lambda value: type(value) in (int, float) and abs(value) <= sys.float_info.max,
    "string": lambda value: isinstance(value, str),
    "null": lambda value: value is None,
    "array": lambda value: isinstance(value, list),
    "object": lambda value: isinstance(value, dict),
}
"""Whether a value is of a type of JSON."""


def schema_of(kind: Any) -> Schema:
    """Return the JSON Schema of values of `kind`; additional keys of an object are allowed.

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


def field_docs(kind: Any) -> dict[str, str]:
    """Return the docstrings of the fields of class `kind` of a module, without those that it inherits."""
    found = {}
    for node, below in pairwise(_bodies(kind.__module__).get(kind.__name__, [])):
        match node, below:
            case (ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str() as text))):
                found[name] = text
    return found


@cache
def _bodies(module: str) -> dict[str, list[ast.stmt]]:
    """Return the statements of each class of `module`, whose source is read once."""
    tree = ast.parse(inspect.getsource(sys.modules[module]))
    return {node.name: node.body for node in tree.body if isinstance(node, ast.ClassDef)}


def json_value(value: Any) -> Any:
    """Return a nested `value` as JSON has it: numbers that are not finite as None, paths as texts."""
    match value:
        case dict():
            return {key: json_value(item) for key, item in value.items()}
        case tuple() if hasattr(value, "_asdict"):
            return json_value(value._asdict())
        case list() | tuple():
            return [json_value(item) for item in value]
        case float():
            return value if isfinite(value) else None
        case Path():
            return str(value)
        case _:
            return value


def json_object(payload: bytes | str) -> dict[str, Any] | None:
    """Return the JSON object in `payload`; None for anything else."""
    try:
        read = json.loads(payload)
    except (ValueError, RecursionError):
        return None
    return read if isinstance(read, dict) else None


def require_fit(value: Any, kind: Any, location: str, action: str) -> None:
    """Refuse a `value` that is not of `kind`.

    Raises:
        BenchError: with the place of its first part that is not as the schema of `kind` says.
    """
    for misfit in misfits(value, _schema(kind), location):
        raise BenchError(*misfit, action)


_schema = cache(schema_of)


def misfits(value: Any, schema: Mapping[str, Any], location: str) -> Iterator[tuple[str, str, str]]:
    """Yield place, found and expected of each part of `value` that is not as `schema` says."""
    if "anyOf" in schema:
        found = [list(misfits(value, one, location)) for one in schema["anyOf"]]
        yield from found[0] if all(found) else ()
    elif not _is_of(value, schema):
        kinds = (kind if kind == "null" else f"a{'n' * (kind[0] in 'aio')} {kind}" for kind in _types(schema))
        choices = schema.get("enum", ())
        names = ", ".join(choices) if len(choices) < 10 else f"the {len(choices)} names in `golfbench schema`"
        yield location, shown(value), f"one of {names}" if choices else " or ".join(kinds)
    elif isinstance(value, list):
        parts = schema.get("prefixItems", [schema.get("items", {})] * len(value))
        for index, (item, part) in enumerate(zip(value, parts, strict=True)):
            yield from misfits(item, part, f"{location}[{index}]")
    elif isinstance(value, dict):
        parts, more = schema.get("properties", {}), schema.get("additionalProperties", {})
        for name in schema.get("required", ()):
            if name not in value:
                yield f"{location}.{name}", "nothing", "this key"
        for name, item in value.items():
            yield from misfits(item, parts.get(name, more), f"{location}.{name}")


def _is_of(value: Any, schema: Mapping[str, Any]) -> bool:
    """Return whether `value`, whatever is in it, is what `schema` says."""
    kinds = _types(schema)
    if (kinds and not any(_IS[kind](value) for kind in kinds)) or value not in schema.get("enum", [value]):
        return False
    match value:
        case str():
            length = bool(schema.get("minLength", 0) <= len(value) <= schema.get("maxLength", len(value)))
            return length and bool(re.fullmatch(schema.get("pattern", "(?s:.*)"), value))
        case list():
            return bool(schema.get("minItems", 0) <= len(value) <= schema.get("maxItems", len(value)))
        case int() | float():
            return bool(schema.get("minimum", value) <= value <= schema.get("maximum", value))
    return True


def _types(schema: Mapping[str, Any]) -> Sequence[str]:
    kinds: Sequence[str] = schema.get("type", ())
    return (kinds,) if isinstance(kinds, str) else kinds


def shown(value: Any) -> str:
    """Return `value` as JSON, in ASCII so that it disturbs no terminal, cut if long."""
    try:
        text = json.dumps(value)
    except RecursionError:  # it was just not too deep to be read
        return "values nested too deep"
    return text if len(text) <= 60 else text[:57] + "..."
