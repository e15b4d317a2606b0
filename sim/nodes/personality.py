"""Device families that the simulated nodes play, read from `personalities.toml`.

A personality lists a family's differences from the plain device of the EDS file: objects that it has or
lacks, their size and value as delivered, and how its firmware behaves.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from canopen.objectdictionary import ObjectDictionary, ODArray, ODVariable
from canopen.objectdictionary.datatypes import INTEGER32, UNSIGNED8, UNSIGNED16, UNSIGNED32

FILE = Path(__file__).with_name("personalities.toml")
ENCODER, IO = "encoder", "io"
_TYPES = {"u8": UNSIGNED8, "u16": UNSIGNED16, "u32": UNSIGNED32, "i32": INTEGER32}


@dataclass(frozen=True)
class ObjectChange:
    """One object that differs from the EDS file."""

    index: int
    subindex: int
    value: int | None
    """Value as delivered; None to keep the EDS file's."""
    kind: int | None
    """Data type; None to keep the EDS file's."""
    access: str | None
    """Access "ro" or "rw"; None to keep the EDS file's."""


@dataclass(frozen=True)
class Personality:
    """One device family."""

    name: str
    role: str
    """ENCODER or IO."""
    maker: str
    family: str
    source: str
    """Source document of the values, and the assumed ones."""
    counts: int = 0
    """Counts per revolution of an encoder's disc; 0 for those of the plant."""
    revolutions: int = 1
    objects: tuple[ObjectChange, ...] = ()
    absent: frozenset[tuple[int, int | None]] = field(default_factory=frozenset)
    """Objects (index, sub-index) that the family lacks; sub-index None for the whole object."""
    store_time: float = 0.0
    """Time until storing the settings is answered, s."""
    always_scaled: bool = False
    """6001h counts whatever 6000h says."""
    range_is_last: bool = False
    """6002h holds the last position, not their number."""
    fixed_mapping: int = 0
    """Abort code with which every write to a mapping is refused; 0 if mappings can be written."""

    def apply(self, dictionary: ObjectDictionary) -> None:
        """Change an object dictionary that was read from the role's EDS file."""
        for index, subindex in self.absent:
            if index not in dictionary:
                continue
            entry = dictionary[index]
            if subindex is None or isinstance(entry, ODVariable):
                del dictionary[index]
            else:
                entry.subindices.pop(subindex, None)
        # The highest sub-index first: it makes the array, and the number of its entries.
        for change in sorted(self.objects, key=lambda one: one.subindex, reverse=True):
            found = _object(dictionary, change.index, change.subindex, change.kind)
            found.data_type = found.data_type if change.kind is None else change.kind
            found.default = found.default if change.value is None else change.value
            found.access_type = found.access_type if change.access is None else change.access
            if change.kind is not None:  # the limits were those of another type
                found.min = found.max = None


@cache
def personalities() -> Mapping[str, Personality]:
    """Return all families by name."""
    entries = tomllib.loads(FILE.read_text(encoding="utf-8-sig"))
    return {name: _read(name, entry) for name, entry in entries.items()}


def find_personality(name: str, role: str) -> Personality:
    """Return a family of one role.

    Raises:
        ValueError: the name is unknown.
    """
    known = {one.name: one for one in personalities().values() if one.role == role}
    if name not in known:
        raise ValueError(f"{role} {name!r}: not known; choose one of {', '.join(sorted(known))}")
    return known[name]


def _read(name: str, entry: Mapping[str, Any]) -> Personality:
    changes = []
    for location, change in entry.get("objects", {}).items():
        index, subindex = _place(location)
        kind = change.get("type")
        changes.append(
            ObjectChange(
                index,
                subindex or 0,
                change.get("value"),
                None if kind is None else _TYPES[kind],
                change.get("access"),
            )
        )
    plain = {key: value for key, value in entry.items() if key not in {"objects", "absent"}}
    absent = frozenset(_place(location) for location in entry.get("absent", ()))
    return Personality(name=name, objects=tuple(changes), absent=absent, **plain)


def _place(text: str) -> tuple[int, int | None]:
    """Return index and sub-index of "6444" or "6444:1"."""
    index, _, subindex = text.partition(":")
    return int(index, 16), int(subindex) if subindex else None


def _object(dictionary: ObjectDictionary, index: int, subindex: int, kind: int | None) -> ODVariable:
    """Return a variable of the dictionary; make it if it is not there."""
    if index not in dictionary:
        if subindex == 0:
            dictionary.add_object(ODVariable(f"{index:04X}h", index, 0))
        else:
            array = ODArray(f"{index:04X}h", index)
            first = ODVariable("Number of entries", index, 0)
            first.data_type, first.access_type, first.default = UNSIGNED8, "ro", subindex
            array.add_member(first)
            dictionary.add_object(array)
    entry = dictionary[index]
    if isinstance(entry, ODVariable):
        return entry
    if subindex not in entry.subindices:
        made = ODVariable(f"{index:04X}h:{subindex}", index, subindex)
        made.data_type, made.access_type, made.default = kind or UNSIGNED32, "rw", 0
        entry.add_member(made)
    found = entry.subindices[subindex]
    if not isinstance(found, ODVariable):
        raise TypeError(f"{index:04X}h:{subindex}: not a variable")
    return found
