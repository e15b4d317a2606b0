"""Frozen dataclasses from TOML tables; every key must be known, of its type, finite and in its range.

A key is its field's name; the value is in the field's SI unit. Where people think in other units a suffix
says so: `loft_deg` for a field in rad, `rate_hz` for one in Hz or rad/s. Errors are collected, not
raised, so that one run reports all of them.
"""

from __future__ import annotations

import json
import re
import sys
import tomllib
from codecs import BOM_UTF16_BE, BOM_UTF16_LE, BOM_UTF32_BE, BOM_UTF32_LE
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field, fields, is_dataclass
from functools import cache, partial
from math import pi
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, TypeVar, get_args, get_origin, get_type_hints

from bench.base.errors import BenchError, did_you_mean
from drivers.base.ranges import Above, AtLeast, AtMost, Gap, Range, short

SUFFIXES: Mapping[str, Mapping[str, float]] = {"deg": {"rad": pi / 180}, "hz": {"Hz": 1.0, "rad/s": 2 * pi}}
"""Suffix of a key -> unit of its field -> factor on the value."""

MAX_FINITE = sys.float_info.max
"""Max absolute value of a finite number; comparisons with it are false for NaN."""

_UNIT_OF = {"deg": "deg", "hz": "Hz"}
_SUFFIXED = re.compile(rf"(.+)_({'|'.join(SUFFIXES)})")
_BAD = object()

hints_of: Callable[[Any], dict[str, Any]] = cache(partial(get_type_hints, include_extras=True))
"""Types of the fields of a dataclass, with their ranges."""


class TomlValue(NamedTuple):
    """A value as written in a file."""

    value: Any
    file: Path
    path: str
    """Dotted key as written."""
    suffix: str = ""

    @property
    def key(self) -> str:
        """Last part of the key as written."""
        return self.path.rsplit(".", 1)[-1]


Tree = dict[str, "Tree | TomlValue"]
"""Tables of a file; values under the name of their field, without suffix."""


Mistake = tuple[str, str, str, str]
"""Mistake found by a rule across keys: key, found, expected, action."""


def errors_of(mistakes: Iterable[Mistake], tree: Tree, file: Path) -> list[BenchError]:
    """Return the errors of `mistakes`, each at its key as its author wrote it."""
    return [BenchError(location_of(tree, file, key), *rest) for key, *rest in mistakes]


def read_toml(path: Path, expected: str, action: str) -> dict[str, Any]:
    """Return the parsed file.

    Raises:
        BenchError: the file is missing, unreadable or not TOML; `expected` and `action` go into the message.
    """
    return parse_toml(read_text(path, expected, action), str(path))


def parse_toml(text: str, location: str) -> dict[str, Any]:
    """Return the tables that the TOML `text` contains.

    Raises:
        BenchError: `text` is not TOML.
    """
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise BenchError(
            location, f"invalid TOML: {error}", "TOML", "Correct that line of the file."
        ) from None
    except RecursionError:
        raise BenchError(
            location,
            "values nested too deep",
            "tables and arrays of ordinary depth",
            "Write the file without deep nesting.",
        ) from None


def read_text(path: Path, expected: str, action: str) -> str:
    """Return the text of a file that a person has written, without the byte order mark of some editors.

    Raises:
        BenchError: the file is missing, unreadable or not UTF-8; `expected` and `action` go into the message.
    """
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        raise BenchError(str(path), "no such file", expected, action) from None
    except OSError as error:
        raise BenchError(str(path), error.strerror or str(error), "a file that can be read", action) from None
    if (other := _other_encoding(content)) is not None:
        raise BenchError(str(path), f"text in {other}", "UTF-8 text", "Save it as UTF-8.")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise BenchError(
            str(path), f"a byte that is not UTF-8 at offset {error.start}", "UTF-8 text", "Save it as UTF-8."
        ) from None


def _other_encoding(content: bytes) -> str | None:
    """Return the name of an encoding of two or four bytes a character, by its mark or the zeros in it."""
    if content.startswith((BOM_UTF32_LE, BOM_UTF32_BE)):  # one of them begins as that of UTF-16
        return "UTF-32"
    if content.startswith((BOM_UTF16_LE, BOM_UTF16_BE)):
        return "UTF-16"
    begin = content[:64]
    return "UTF-16, without a byte order mark" if begin and 3 * begin.count(0) >= len(begin) else None


def encoding_of(content: bytes) -> str:
    """Return the codec of an exported text: UTF-16 by its mark or its zero second byte, else UTF-8."""
    if content.startswith((BOM_UTF16_LE, BOM_UTF16_BE)):
        return "utf-16"
    return "utf-16-le" if content[1:2] == b"\0" else "utf-8-sig"


def as_tree(tables: Mapping[str, Any], file: Path, faults: list[BenchError], path: str = "") -> Tree:
    """Return `tables` of `file` without suffixes; a value written twice is a fault."""
    tree: Tree = {}
    for key, value in tables.items():
        if isinstance(value, dict):
            tree[key] = as_tree(value, file, faults, f"{path}{key}.")
            continue
        match = _SUFFIXED.fullmatch(key)
        name, suffix = match.groups() if match else (key, "")
        if isinstance(before := tree.get(name), TomlValue):
            faults.append(
                BenchError(
                    f"{file}: {path}{key}",
                    f"also {before.key}",
                    "one of the two keys",
                    "Delete one of the two keys.",
                )
            )
        tree[name] = TomlValue(value, file, f"{path}{key}", suffix)
    return tree


def laid_over(base: Tree, over: Tree) -> Tree:
    """Return `base` with the values of `over` added or replaced."""
    merged = dict(base)
    for name, node in over.items():
        below = merged.get(name)
        merged[name] = laid_over(below, node) if isinstance(below, dict) and isinstance(node, dict) else node
    return merged


def without(tree: Tree, paths: Collection[str], above: str = "") -> Tree:
    """Return `tree` without the keys at the dotted `paths`."""
    return {
        name: without(node, paths, f"{above}{name}.") if isinstance(node, dict) else node
        for name, node in tree.items()
        if f"{above}{name}" not in paths
    }


def location_of(tree: Tree, file: Path, path: str) -> str:
    """Return file and key of dotted `path` as its author wrote it; `file` if `tree` has no such key."""
    *above, last = path.split(".")
    node: Tree | TomlValue | None = tree
    for name in above:
        node = node.get(name) if isinstance(node, dict) else None
    leaf = node.get(last) if isinstance(node, dict) else None
    if isinstance(leaf, TomlValue):
        return f"{leaf.file}: {leaf.path}"
    files = [below.file for below in _leaves(leaf)] if isinstance(leaf, dict) else []
    return f"{file if file in files or not files else files[0]}: {path}"


def _leaves(tree: Tree) -> Iterator[TomlValue]:
    for node in tree.values():
        if isinstance(node, dict):
            yield from _leaves(node)
        else:
            yield node


def format_value(value: Any) -> str:
    """Return `value` as TOML text, cut when long."""
    if isinstance(value, bool):
        return str(value).lower()
    text = json.dumps(value, ensure_ascii=False) if isinstance(value, str) else repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


@dataclass
class Builder:
    """Builds values from one tree and collects validation errors in `faults`.

    Fields whose dotted path is in `left_out` are not read and keep their defaults; those with `optional` in
    their metadata may be missing.
    """

    tree: Tree
    file: Path
    """Place of errors about missing keys."""
    action: str
    add: str
    """Action of errors about missing keys."""
    left_out: frozenset[str] = frozenset()
    faults: list[BenchError] = field(default_factory=list)
    wrong: set[str] = field(default_factory=set)
    """Dotted paths of the keys with faults."""

    def build(self, kind: type[Any]) -> Any:
        """Return the value of dataclass `kind`, or None if there were faults.

        Raises:
            TypeError: a field's type cannot be written in TOML.
        """
        value = self._value(kind, self.tree, "")
        return None if self.faults else value

    def _value(self, hint: Any, node: Tree | TomlValue, path: str) -> Any:
        if is_dataclass(hint):
            if isinstance(node, dict):
                return self._dataclass(hint, node, path, {})
            return self._fault(path, format_value(node.value), "a table")
        if get_origin(hint) is dict:
            if isinstance(node, dict):
                return self._named(get_args(hint)[1], node, path)
            return self._fault(path, format_value(node.value), "a table")
        if isinstance(node, dict):
            return self._fault(path, "a table", expected(hint))
        if node.suffix and node.suffix not in suffixes(hint):
            name = f"{node.key} ({path.rsplit('.', 1)[-1]})"
            action = f"It cannot be given in {node.suffix}."
            if not suffixes(hint):
                action = f"Write it without _{node.suffix}; the manual states its unit."
            return self._fault(path, name, expected(hint), action)
        return self._leaf(hint, node.value, node.suffix, path)

    def _dataclass(self, kind: Any, node: Tree, path: str, given: dict[str, Any]) -> Any:
        hints = hints_of(kind)
        prefix = f"{path}." if path else ""
        optional = {f.name for f in fields(kind) if f.metadata.get("optional")}
        keys = {
            f.name: hints[f.name]
            for f in fields(kind)
            if f.init and f.name not in given and f"{prefix}{f.name}" not in self.left_out
        }
        faults_before = len(self.faults)
        self._unknown(set(node) - set(keys), node, prefix, keys)
        values = dict(given)
        for name, hint in keys.items():
            if name in node:
                values[name] = self._value(hint, node[name], f"{prefix}{name}")
            elif name not in optional:
                self._fault(f"{prefix}{name}", "nothing", expected(hint), self.add)
        if len(self.faults) > faults_before:
            return _BAD
        try:
            return kind(**values)
        except ValueError as error:
            return self._fault(path, "contradictory values", str(error))

    def _named(self, hint: Any, node: Tree, path: str) -> Any:
        """Return a dictionary; an entry that is a dataclass gets its key as its `name`."""
        built = {}
        for name, entry in node.items():
            below = f"{path}.{name}"
            has_name = is_dataclass(hint) and any(f.name == "name" for f in fields(hint))
            if has_name and isinstance(entry, dict):
                built[name] = self._dataclass(hint, entry, below, {"name": name})
            else:
                built[name] = self._value(hint, entry, below)
        return built

    def _leaf(self, hint: Any, value: Any, suffix: str, path: str) -> Any:
        bare, marks = _parts(hint)
        if get_origin(bare) is tuple:
            parts = get_args(bare)
            if parts[-1] is Ellipsis and isinstance(value, list):
                parts = (parts[0],) * len(value)
            if not isinstance(value, list) or len(value) != len(parts):
                return self._fault(path, format_value(value), expected(hint))
            pairs = enumerate(zip(parts, value, strict=True))
            return tuple(self._leaf(part, item, suffix, f"{path}[{i}]") for i, (part, item) in pairs)
        if get_origin(bare) is Literal:
            ok = value in get_args(bare) and isinstance(value, str)
        elif bare is Path:
            ok = isinstance(value, str) and value != ""
        elif bare is float:
            ok = isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= MAX_FINITE
        elif bare in (int, bool, str):
            ok = type(value) is bare
        else:
            raise TypeError(f"{path}: {hint} cannot be written in TOML")
        if not ok:
            return self._fault(path, format_value(value), expected(hint, suffix))
        if bare is Path:
            return Path(value)
        if bare is float:
            value = float(value)
        factor = _factor(marks, suffix)
        if not all(_holds(mark, value * factor if suffix else value) for mark in marks):
            return self._fault(path, format_value(value), expected(hint, suffix))
        return value * factor if suffix else value

    def _unknown(self, names: set[str], node: Tree, prefix: str, keys: Mapping[str, Any]) -> None:
        writable = [*keys, *(f"{name}_{suffix}" for name, hint in keys.items() for suffix in suffixes(hint))]
        for name in sorted(names):
            entry = node[name]
            key = entry.key if isinstance(entry, TomlValue) else name
            action = did_you_mean(key, writable, "Delete it, or put it under its own table.")
            self._fault(f"{prefix}{name}", "an unknown key", f"one of {', '.join(keys)}", action)

    def _fault(self, path: str, found: str, wanted: str, action: str = "") -> Any:
        path, bracket, index = path.partition("[")
        self.wrong.add(path)
        location = location_of(self.tree, self.file, path) + bracket + index
        self.faults.append(BenchError(location, found, wanted, action or self.action))
        return _BAD


def expected(hint: Any, suffix: str = "") -> str:
    """Return the values that `hint` allows in words, in the unit of `suffix`."""
    bare, marks = _parts(hint)
    if is_dataclass(bare) or get_origin(bare) is dict:
        return "a table"
    if get_origin(bare) is tuple:
        parts = get_args(bare)
        number = "any number of" if parts[-1] is Ellipsis else len(parts)
        return f"{number} values in brackets, each {expected(parts[0], suffix)}"
    if get_origin(bare) is Literal:
        return " or ".join(json.dumps(choice) for choice in get_args(bare))
    names = {float: "a finite number", int: "a whole number", bool: "true or false", str: "a text in quotes"}
    text = names.get(bare, "a path in quotes")
    factor = _factor(marks, suffix)
    for mark in marks:
        match mark:
            case Range(low, high, unit):
                text += f", {Range(low / factor, high / factor, _UNIT_OF.get(suffix, unit))}"
            case Above(bound):
                text += f" above {short(bound)}"
            case AtLeast(bound):
                text += f" of at least {short(bound)}"
            case AtMost(bound):
                text += f" up to {short(bound)}"
            case Gap(low, high):
                text += f", none between {short(low / factor)} and {short(high / factor)}"
    return text


def suffixes(hint: Any) -> Mapping[str, float]:
    """Return the unit suffixes that a value of type `hint` may have, and their factors."""
    unit = _unit(_parts(hint)[1])
    return {suffix: table[unit] for suffix, table in SUFFIXES.items() if unit in table}


def _factor(marks: tuple[Any, ...], suffix: str) -> float:
    return SUFFIXES[suffix].get(_unit(marks), 1.0) if suffix else 1.0


def _unit(marks: tuple[Any, ...]) -> str:
    """Return the unit of a field, the first if it depends on the joint ("rad, rod m")."""
    return next((mark.unit.split(",")[0] for mark in marks if isinstance(mark, Range)), "")


def _parts(hint: Any) -> tuple[Any, tuple[Any, ...]]:
    if get_origin(hint) is Annotated:
        return get_args(hint)[0], hint.__metadata__
    return hint, ()


def _holds(mark: Any, value: Any) -> bool:
    match mark:
        case Range(low, high):
            # A value at the end of a range may be rounded when it is turned into the field's unit.
            slack = 1e-12 if isinstance(value, float) else 0
            return bool(low - slack * abs(low) <= value <= high + slack * abs(high))
        case Above(bound):
            return bool(value > bound)
        case AtLeast(bound):
            return bool(value >= bound)
        case AtMost(bound):
            return bool(value <= bound)
        case Gap(low, high):
            return not low < value < high * (1 - 1e-12)
        case _:
            return True


def recorded_tables(
    configuration: Mapping[str, Any], kinds: Mapping[str, type[Any]], location: str, action: str
) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Return tables of a record's `configuration` as their `kinds`, and the keys that it lacks.

    Today's defaults stand for missing keys. The record is at `location`.

    Raises:
        ExceptionGroup: one BenchError, with `action`, per value that this program rejects.
    """
    file, faults = Path(f"{location}: configuration"), list[BenchError]()
    built, missing = dict[str, Any](), list[str]()
    for name, kind in kinds.items():
        given = configuration.get(name)
        recorded = as_tree({name: given if isinstance(given, dict) else {}}, file, faults)
        today = as_tree({name: json.loads(json.dumps(asdict(kind())))}, file, faults)
        missing += _missing(today, recorded)
        tree: Any = laid_over(today, recorded)[name]
        built[name] = Builder(tree, file, action, action, faults=faults).build(kind)
    if faults:
        raise ExceptionGroup(f"{location} has an invalid configuration", faults)
    return built, tuple(missing)


def _missing(today: Tree, recorded: Tree, prefix: str = "") -> list[str]:
    """Return the dotted keys of `today` that `recorded` does not have."""
    keys = []
    for name, node in today.items():
        other = recorded.get(name)
        if other is None:
            keys.append(f"{prefix}{name}")
        elif isinstance(node, dict) and isinstance(other, dict):
            keys += _missing(node, other, f"{prefix}{name}.")
    return keys


Checked = TypeVar("Checked")


def checked_values(
    kind: type[Checked], content: Mapping[str, Any], location: str, action: str = "Measure again."
) -> Checked:
    """Return the values of dataclass `kind` in `content`, whose keys are its fields.

    Raises:
        ExceptionGroup: one BenchError at `location`, with `action`, per value that is missing, unknown, of
            the wrong type or out of range.
    """
    faults: list[BenchError] = []
    file = Path(location)
    listed = {key: list(value) if isinstance(value, tuple) else value for key, value in content.items()}
    builder = Builder(as_tree(listed, file, faults), file, action, "Give it.", faults=faults)
    values: Any = builder.build(kind)
    if faults:
        for fault in faults:
            fault.location = fault.location.removesuffix(": ")  # of the values as a whole
        raise ExceptionGroup(f"{location} is invalid", faults)
    return values  # type: ignore[no-any-return]
