"""The whole configuration: built from its files and checked, and written as one file with comments.

How files are found and merged: `bench.base.configuration_files`. Keys and units:
`bench.base.from_toml`. Club and ball of the plant are those that `[swing]` names; an entry of `[clubs]` or
`[balls]` that says `like = "driver"` gives only what differs from that one.
Defaults are those of the settings' fields, their only source.
"""

from __future__ import annotations

import inspect
import json
import textwrap
import tomllib
from collections.abc import Iterator
from dataclasses import MISSING, dataclass, fields, is_dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, get_args, get_origin

import sim
from bench.base.configuration_files import PRINT, SHIPPED, find_configuration, read_layers, shown_path
from bench.base.errors import BenchError
from bench.base.from_toml import (
    Builder,
    TomlValue,
    Tree,
    errors_of,
    expected,
    format_value,
    hints_of,
    laid_over,
    location_of,
    suffixes,
)
from bench.base.json_schema import field_docs
from bench.base.to_toml import toml_value
from bench.config._rules import RULES
from bench.config._settings import ClubSite, Configuration
from drivers.base.ranges import short

DERIVED = frozenset({"plant.tick", "plant.ball", "plant.robot.club", "files"})
"""Fields that are derived from other keys, and are no keys themselves."""


def load_configuration(path: Path | None = None) -> Configuration:
    """Return the checked configuration at `path` (as `find_configuration` takes it).

    Raises:
        BenchError: a file or most of its tables are missing, it cannot be read, or is not TOML.
        ExceptionGroup: the files have mistakes; it has one BenchError for each.
    """
    faults: list[BenchError] = []
    file = find_configuration(path)
    tree, files = read_layers(file, default_tables, faults)
    missing = [name for name in keys_of(Configuration, "") if name not in tree]
    if len(files) == 1 and len(missing) > 1:
        raise BenchError(
            str(shown_path(file)),
            f"{len(missing)} tables missing, such as {', '.join(missing[:3])}",
            f"every table, or a base that has them; {PRINT} prints all",
            f'Begin the file with base = "{SHIPPED}".',
        )
    for section in ("clubs", "balls"):
        _complete_likes(tree, section, file, faults)
    add = f"Add it; {PRINT} prints every key. "
    add += (
        'In a new club or ball write like = "NAME" for the keys it shares with another.'
        if len(files) > 1
        else f'Or begin {shown_path(file)} with base = "{SHIPPED}".'
    )
    action = f"Correct the value; {PRINT} prints its meaning, unit and default."
    builder = Builder(tree, file, action, add, DERIVED, faults)
    configuration = builder.build(Configuration)
    if configuration is not None:
        configuration = _with_derived(configuration, files)
        for rule in RULES:
            faults += errors_of(rule(configuration, tree), tree, file)
    if faults:
        # Entries that are like another one repeat its mistakes.
        once = {str(fault): fault for fault in faults}
        raise ExceptionGroup(f"{file} is not a valid configuration", list(once.values()))
    return configuration  # type: ignore[no-any-return]


def _complete_likes(tree: Tree, section: str, file: Path, faults: list[BenchError]) -> None:
    """Complete entries of `section` that say `like` with the values of the entry it names."""
    entries = tree.get(section)
    if not isinstance(entries, dict):
        return
    whole = {
        name: entry for name, entry in entries.items() if isinstance(entry, dict) and "like" not in entry
    }
    for name, entry in entries.items():
        if isinstance(entry, dict) and isinstance(like := entry.get("like"), TomlValue):
            rest = {key: node for key, node in entry.items() if key != "like"}
            model = whole.get(like.value) if isinstance(like.value, str) else None
            if model is None:
                known = f"one of {', '.join(whole)}, which say no like themselves"
                location = location_of(tree, file, f"{section}.{name}.like")
                faults.append(BenchError(location, format_value(like.value), known, "Name one of them."))
                model = next(iter(whole.values()), {})  # any: only the entry's own keys are then checked
            entries[name] = laid_over(model, rest)


def _with_derived(c: Configuration, files: tuple[Path, ...]) -> Configuration:
    """Return `c` with derived values: tick, club, site and ball of the plant.

    With `sites`, a club without its own site uses plant.site, so that a change of clubs and back restores it.
    """
    if c.sites:
        c = replace(c, sites={name: ClubSite.of(c.plant) for name in c.clubs} | c.sites)
    club, ball = c.clubs.get(c.swing.club), c.balls.get(c.swing.ball)
    plant = c.plant if club is None else c.plant_of(c.swing.club, club)
    plant = replace(plant, tick=1.0 / c.loop.rate, ball=ball or c.plant.ball)
    return replace(c, plant=plant, files=files).with_driver(c.driver)


def default_tables() -> dict[str, Any]:
    """Return the values of all keys that have a default in the form of a file, in SI units and rad."""
    return _defaults_of(Configuration, "")


def tables_of(value: Any, path: str = "") -> dict[str, Any]:
    """Return the values of a dataclass as in a file; `path` is its dotted key with a trailing dot."""
    return {f: plain(getattr(value, f), f"{path}{f}") for f in keys_of(type(value), path)}


def keys_of(kind: type[Any], path: str) -> Iterator[str]:
    """Return the names of the fields of dataclass `kind` that are keys at `path`."""
    return (f.name for f in fields(kind) if f.init and f"{path}{f.name}" not in DERIVED)


def plain(value: Any, path: str) -> Any:
    """Return a field's value as TOML has it."""
    if is_dataclass(value):
        return tables_of(value, f"{path}.")
    if isinstance(value, dict):
        # The name of an entry is its key.
        return {key: _without_name(plain(item, f"{path}.{key}")) for key, item in value.items()}
    if isinstance(value, tuple):
        return [plain(item, path) for item in value]
    return str(value) if isinstance(value, Path) else value


def _without_name(item: Any) -> Any:
    return {key: value for key, value in item.items() if key != "name"} if isinstance(item, dict) else item


def _defaults_of(kind: type[Any], path: str) -> dict[str, Any]:
    tables, hints = {}, hints_of(kind)
    by_name = {f.name: f for f in fields(kind)}
    for name in keys_of(kind, path):
        field, hint = by_name[name], hints[name]
        if field.default is not MISSING:
            tables[name] = plain(field.default, f"{path}{name}")
        elif field.default_factory is not MISSING:
            tables[name] = plain(field.default_factory(), f"{path}{name}")
        elif is_dataclass(hint):
            tables[name] = _defaults_of(hint, f"{path}{name}.")  # type: ignore[arg-type]
    return tables


# Written with comments: meaning, unit and bounds of every key -----------------------------------------

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
        hints = hints_of(old.kind)
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
    hints = hints_of(table.kind)
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
    hints, docs = hints_of(table.kind), field_docs(table.kind)
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
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_written, value))}]"
    if isinstance(value, float):
        brief = short(value)
        return brief if "e" in brief and float(brief) == value else toml_value(value)
    return toml_value(str(value) if isinstance(value, Path) else value)


def _first_line(kind: Any) -> str:
    return (inspect.getdoc(kind) or "").split("\n", 1)[0]
