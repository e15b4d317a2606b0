"""The whole configuration: built from its files and checked.

How files are found and merged: `bench.base.configuration_files`. Keys and units:
`bench.base.from_toml`. Club and ball of the plant are those that `[swing]` names; an entry of `[clubs]` or
`[balls]` that says `like = "driver"` gives only what differs from that one.
Defaults are those of the settings' fields, their only source.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import MISSING, fields, is_dataclass, replace
from pathlib import Path
from typing import Any, get_type_hints

from bench.base.configuration_files import PRINT, SHIPPED, find_configuration, read_layers, shown_path
from bench.base.errors import BenchError
from bench.base.from_toml import Builder, TomlValue, Tree, errors_of, format_value, laid_over, location_of
from bench.config.rules import RULES
from bench.config.settings import ClubSite, Configuration

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
