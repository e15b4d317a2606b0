"""What commissioning knows of the robot: values found with standard errors, over the configured ones."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any, NamedTuple

from sim.plant import PlantParameters

ACTUATOR_KEYS = ("shoulder", "right_arm", "wrist")
"""Tables of the three actuators in the configuration, in the order of ACTUATORS."""


class FoundValue(NamedTuple):
    """A value that a step found."""

    key: str
    """Dotted key below [plant]; of a list with its index: encoders.sign.0."""
    value: float
    error: float
    """Standard error."""
    unit: str
    step: str
    """Name of the step that found it."""

    @property
    def joint(self) -> str:
        """Text for a list's index."""
        return self.key.rsplit(".", 1)[-1]


class KnownRobot:
    """The configured robot with the values found so far."""

    def __init__(self, nominal: PlantParameters, found: Iterable[FoundValue] = ()) -> None:
        """Begin with `nominal` and values `found` before."""
        self.nominal = nominal
        self.found: dict[str, FoundValue] = {}
        self.plant = nominal
        """The robot as far as it is known."""
        self.add(found)

    def add(self, values: Iterable[FoundValue]) -> None:
        """Add `values`; one that was found before is replaced."""
        self.found |= {value.key: value for value in values}
        self.plant = with_values(self.nominal, {key: found.value for key, found in self.found.items()})

    def value(self, key: str) -> float:
        """Return the value of `key`, found or configured."""
        return float(value_at(self.plant, key))

    def error(self, key: str, otherwise: float) -> float:
        """Return the standard error of `key`; `otherwise` if it was not found."""
        found = self.found.get(key)
        return otherwise if found is None else found.error


def with_values(plant: PlantParameters, values: Mapping[str, float]) -> PlantParameters:
    """Return `plant` with `values` by their dotted keys; KeyError if a key is not there."""
    for key, value in values.items():
        plant = _with(plant, key.split("."), value)
    return plant


def value_at(plant: PlantParameters, key: str) -> Any:
    """Return the value of `plant` at dotted `key`; KeyError if it is not there."""
    at: Any = plant
    for part in key.split("."):
        at = at[int(part)] if isinstance(at, tuple) else _field(at, part)
    return at


def _field(value: Any, name: str) -> Any:
    if not is_dataclass(value) or name not in {field.name for field in fields(value)}:
        raise KeyError(name)
    return getattr(value, name)


def _with(value: Any, path: list[str], new: float) -> Any:
    if not path:
        return round(new) if isinstance(value, int) else new
    first, rest = path[0], path[1:]
    if isinstance(value, tuple):
        index = int(first)
        return (*value[:index], _with(value[index], rest, new), *value[index + 1 :])
    return replace(value, **{first: _with(_field(value, first), rest, new)})
