"""What commissioning knows of the robot: values found with standard errors, over the configured ones."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

from bench.control.measured_plant import value_at, with_values
from sim.plant import PlantParameters

ACTUATOR_KEYS = ("shoulder", "right_arm", "wrist")
"""Tables of the three actuators in the configuration, in the order of ACTUATORS."""


class ParameterEstimate(NamedTuple):
    """A value that a step found."""

    key: str
    """Dotted key below [plant]; in a list with the index: encoders.sign.0."""
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


class RobotEstimate:
    """The configured robot with the values found so far."""

    def __init__(self, nominal: PlantParameters, found: Iterable[ParameterEstimate] = ()) -> None:
        """Begin with `nominal` and values `found` before."""
        self.nominal = nominal
        self.found: dict[str, ParameterEstimate] = {}
        self.plant = nominal
        """The robot as far as it is known."""
        self.add(found)

    def add(self, values: Iterable[ParameterEstimate]) -> None:
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
