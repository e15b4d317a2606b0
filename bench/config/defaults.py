"""The defaults of the code as tables of a configuration file.

The fields of the settings' dataclasses are the only source of these values, with unit and bounds in their
annotations and the meaning in their docstrings. Keys without a default (name and driver of a bench, its loop
and its swing) are in config.toml.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from typing import Any, get_type_hints

from bench.config.settings import Configuration

DERIVED = frozenset({"plant.tick", "plant.ball", "plant.robot.club", "files"})
"""Fields that are derived from other keys, and are no keys themselves."""


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
    tables, hints = {}, get_type_hints(kind)
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
