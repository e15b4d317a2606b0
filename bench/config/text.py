"""A configuration as a complete file with comments: meaning, unit and bounds of every key."""

from __future__ import annotations

import inspect
import json
import textwrap
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any, get_args, get_origin, get_type_hints

import sim
from bench.base.from_toml import expected, suffixes
from bench.base.json_schema import field_docs
from bench.base.to_toml import toml_value
from bench.config.files import keys_of, plain
from bench.config.settings import Configuration
from drivers.base.ranges import short

_COLUMN = 34
_WIDTH = 110
_HEAD = """\
# The complete configuration of golfbench as shipped: every key with its meaning, unit and bounds.
# In a file that begins with `base = "shipped"` give only the keys you change.
"""
_SOURCES = Path(sim.__file__).with_name("parameter_sources.toml")
"""Sources of the plant's values by dotted key."""
_KINDS = ("a finite number", "a whole number", "a text in quotes", "a path in quotes")


@dataclass(frozen=True)
class _Table:
    """A table of the file: dotted key, type, value and comment."""

    path: str
    kind: Any
    value: Any
    comment: str


def configuration_text(configuration: Configuration) -> str:
    """Return `configuration` as the text of a file without base, with comments.

    The text loads as the same configuration, bit for bit.
    """
    lines = [_HEAD.rstrip()]
    for table in _tables(_Table("", Configuration, configuration, "")):
        keys = [*_keys(table)]
        if keys or not is_dataclass(table.kind):
            lines += ["", *_commented(f"[{table.path}]", table.comment), *keys]
    return "\n".join(lines) + "\n"


def changed_values(before: Configuration, after: Configuration) -> Iterator[tuple[str, str, str]]:
    """Yield each key whose value differs with both values, in degrees or Hz where those are exact."""
    whole = (_tables(_Table("", Configuration, one, "")) for one in (before, after))
    for old, new in zip(*whole, strict=True):
        if not is_dataclass(old.kind) or old.value == new.value:
            continue
        hints = get_type_hints(old.kind, include_extras=True)
        for name in keys_of(old.kind, f"{old.path}."):  # type: ignore[arg-type]
            values = [plain(getattr(table.value, name), "") for table in (old, new)]
            if values[0] == values[1] or isinstance(values[0], dict):
                continue
            shown = [_in_people_units(name, hints[name], value) for value in values]
            if shown[0][0] != shown[1][0]:
                shown = [(name, value) for value in values]
            yield f"{old.path}.{shown[0][0]}", _written(shown[0][1]), _written(shown[1][1])


def _tables(table: _Table) -> Iterator[_Table]:
    """Yield `table` and the tables in it, in the order of the fields."""
    if table.path:
        yield table
    prefix = f"{table.path}." if table.path else ""
    if not is_dataclass(table.kind):
        kind = get_args(table.kind)[1]
        for name, entry in table.value.items() if is_dataclass(kind) else ():
            yield from _tables(_Table(f"{prefix}{name}", kind, entry, ""))
        return
    hints = get_type_hints(table.kind, include_extras=True)
    for name in keys_of(table.kind, prefix):  # type: ignore[arg-type]
        hint, path = hints[name], f"{prefix}{name}"
        if is_dataclass(hint) or get_origin(hint) is dict:
            docs = field_docs(table.kind).get(name) or (_first_line(hint) if is_dataclass(hint) else "")
            comment = _with_origin(docs, path)
            yield from _tables(_Table(path, hint, getattr(table.value, name), comment))


def _keys(table: _Table) -> Iterator[str]:
    """Yield the lines of the keys of `table` that are no tables."""
    if not is_dataclass(table.kind):
        if not is_dataclass(get_args(table.kind)[1]):
            for name, value in table.value.items():
                key = name if name.isidentifier() else json.dumps(name)
                yield f"{key} = {_written(value)}"
        return
    hints, docs = get_type_hints(table.kind, include_extras=True), field_docs(table.kind)
    named = table.path.startswith(("clubs.", "balls.", "faults."))
    for name in keys_of(table.kind, f"{table.path}."):  # type: ignore[arg-type]
        hint = hints[name]
        if is_dataclass(hint) or get_origin(hint) is dict or (named and name == "name"):
            continue
        key, value = _in_people_units(name, hint, plain(getattr(table.value, name), ""))
        comment = _with_origin(docs.get(name, ""), f"{table.path}.{name}")
        bounds = _bounds(hint, key.removeprefix(name).removeprefix("_"))
        comment = "; ".join(part for part in (comment, bounds) if part)
        yield from _commented(f"{key} = {_written(value)}", comment)


def _in_people_units(name: str, hint: Any, value: Any) -> tuple[str, Any]:
    """Return key and value in degrees or Hz where that is exact, else as they are."""
    for suffix, factor in suffixes(hint).items():
        if factor != 1.0 and isinstance(value, float) and not get_args(hint)[1].unit.count(","):
            rounded = round(value / factor, 9)
            if rounded * factor == value:
                return f"{name}_{suffix}", rounded
    return name, value


def _bounds(hint: Any, suffix: str) -> str:
    """Return the permitted values of the key in words; empty for any value of its kind."""
    text = expected(hint, suffix)
    if text.endswith("true or false") or " in brackets" in text:
        return ""
    for kind in _KINDS:
        text = text.removeprefix(kind)
    return text.removeprefix(",").strip().removeprefix("of ")


@cache
def _origins() -> dict[str, str]:
    return tomllib.loads(_SOURCES.read_text(encoding="utf-8"))


def _with_origin(docs: str, path: str) -> str:
    table, _, key = path.partition(".")
    origins = _origins()
    of_actuator = origins.get(key.partition(".")[2], "")
    origin = origins.get(key, of_actuator) if table == "plant" else ""
    return "; ".join(part for part in (" ".join(docs.split()).removesuffix("."), origin) if part)


def _commented(line: str, comment: str) -> list[str]:
    """Return `line` with `comment` behind it, or above it when that is too long."""
    if not comment:
        return [line]
    whole = f"{line:<{_COLUMN - 1}} # {comment}"
    if len(whole) <= _WIDTH:
        return [whole]
    return [*textwrap.wrap(comment, _WIDTH, initial_indent="# ", subsequent_indent="# "), line]


def _written(value: Any) -> str:
    """Return a value as TOML has it."""
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_written, value))}]"
    if isinstance(value, float):
        brief = short(value)
        return brief if "e" in brief and float(brief) == value else toml_value(value)
    return toml_value(str(value) if isinstance(value, Path) else value)


def _first_line(kind: Any) -> str:
    return (inspect.getdoc(kind) or "").split("\n", 1)[0]
