"""Values of a plant by their dotted keys below [plant], and robots that could have been measured as it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any

import numpy as np

from sim.plant import PlantParameters

_FARTHEST = 3.0
"""Standard errors by which a drawn value is off at most."""


def measured_as(plant: PlantParameters, errors: Mapping[str, float], seed: int) -> PlantParameters:
    """Return a robot, drawn with `seed`, that could have been measured as `plant` with standard `errors`.

    The two areas of an actuator are off alike, as one scale gives both. A value keeps its sign.
    """
    random, off, values = np.random.default_rng([seed, 5]), dict[str, float](), dict[str, float]()
    for key, error in errors.items():
        by = float(np.clip(random.standard_normal(), -_FARTHEST, _FARTHEST))
        value = float(value_at(plant, key))
        drawn = value + error * off.setdefault(key.replace("area_b", "area_a"), by)
        values[key] = drawn if value * drawn >= 0.0 else value
    return with_values(plant, values)


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
