"""Wrong machines, and the words by which commissioning has to name them."""

from __future__ import annotations

from dataclasses import replace
from math import nan
from typing import NamedTuple

import numpy as np

from bench.commissioning.machine.commissioning_step import ParameterEstimate
from bench.commissioning.swings.swing_diagnosis import Diagnosis
from bench.control.measured_plant import value_at, with_values
from sim.faults import Fault
from sim.plant import ACTUATOR_KEYS, PlantParameters

_ERRORS = {
    "area_a": 0.022,
    "area_b": 0.022,
    "dead_volume": 0.03,
    "cross_leakage": 0.04,
    "valve.conductance": 0.022,
    "valve.critical_ratio": 0.01,
    "valve.leakage": 0.02,
    "valve.natural_frequency": 0.02,
    "friction.coulomb": 0.03,
    "friction.static": 0.05,
    "friction.viscous": 0.1,
}
"""Standard errors of the measuring steps, as shares."""
_OTHERS = {"robot.club.head_mass": 0.03, "robot.club.shaft_mass": 0.07, "supply.pressure": 0.001}
_MASS = 0.07
_CENTRE, _LATENCY, _ZERO = 1e-4, 3e-5, 10.0
"""Standard errors of centres and dead bands, of the latency (s) and of zeros (counts)."""


class WrongCase(NamedTuple):
    """A robot with something wrong."""

    robot: PlantParameters
    faults: tuple[Fault, ...]
    location: str
    """Part of the reported location."""
    words: str
    """Part of the text."""
    step: int
    """Number of the step that finds it, from 1."""


def wrong_machines(robot: PlantParameters) -> dict[str, WrongCase]:
    """Return wrong machines that are otherwise like `robot`, by name."""

    def broken(signal: str, kind: str, value: float, location: str, words: str, step: int = 1) -> WrongCase:
        return WrongCase(robot, (Fault("wrong", signal, kind, value),), location, words, step)  # type: ignore[arg-type]

    encoders, wrist = robot.encoders, robot.wrist
    half = replace(
        robot, encoders=replace(encoders, counts_per_revolution=encoders.counts_per_revolution // 2)
    )
    worn = replace(robot, wrist=replace(wrist, cross_leakage=6e-10))
    low = replace(robot, supply=replace(robot.supply, pressure=5.5e5))
    return {
        "valves swapped": broken("wrist valve", "swapped", 1.0, "wrist valve", "wrist and arm are swapped"),
        "valve reversed": broken("arm valve", "scale", -1.0, "arm valve", "opens the wrong way"),
        "spool stuck": broken("shoulder valve", "stuck", 0.0, "shoulder valve", "spool is stuck"),
        "spool stuck open": broken("arm valve", "stuck", 0.2, "arm valve", "spool is stuck"),
        "supply off": broken("supply", "scale", 0.6, "supply", "too low"),
        "encoders swapped": broken("arm encoder", "swapped", 2.0, "encoder", "are swapped"),
        "encoder stuck": broken("wrist encoder", "stuck", 0.0, "wrist encoder", "encoder is stuck"),
        "encoder of wrong scale": broken("shoulder encoder", "scale", 1.1, "shoulder encoder", "wrong scale"),
        "encoder of half the counts": WrongCase(half, (), "encoder", "wrong scale", 1),
        "valve off its centre": broken("wrist valve", "offset", 0.1, "wrist valve", "centre"),
        "chamber sensor off": broken("right arm B sensor", "offset", -2e4, "right arm B sensor", "zero"),
        "chamber sensor stuck": broken("right arm A sensor", "stuck", 101300.0, "arm valve", "its sensor"),
        "hose leaking": broken("arm valve", "leaking", 0.03, "air of the arm", "leaking hose", 3),
        "vents stay open": broken("vents", "stuck", 0.0, "vents", "A vent stays open", 3),
        "vents stay shut": broken("vents", "stuck", 1.0, "vents", "The vents stay shut", 1),
        "seal worn": WrongCase(worn, (), "air of the wrist", "seals", 3),
        "supply too low in service": WrongCase(low, (), "supply", "in service", 4),
        "encoder late": broken("arm encoder", "delayed", 0.008, "arm encoder", "later than the pressures", 5),
        "spool sticking": broken("wrist valve", "slow", 0.02, "wrist valve", "spool", 5),
    }


class SwungWrongly(NamedTuple):
    """A robot with something wrong that its measuring steps did not see."""

    robot: PlantParameters
    faults: tuple[Fault, ...]
    location: str
    """Reported location; empty: no fault."""
    what: str
    """Part of the reported text."""

    def is_named_by(self, diagnosis: Diagnosis) -> bool:
        """Return whether `diagnosis` identifies the fault."""
        named = diagnosis.named
        return named is not None and named.cause.location == self.location and self.what in named.cause.what


def measured_values(plant: PlantParameters) -> list[ParameterEstimate]:
    """Return the measuring steps' estimates of a robot like `plant`, with standard errors."""
    errors = dict[str, float]()
    for key in ACTUATOR_KEYS:
        errors |= {
            f"{key}.{name}": share * abs(float(value_at(plant, f"{key}.{name}")))
            for name, share in _ERRORS.items()
        }
        errors |= {f"{key}.valve.{name}": _CENTRE for name in ("centre", "dead_band")}
    bodies = ("shoulder_link", "left_arm", "rod", "cylinder")
    masses = {f"robot.{body}.{what}": _MASS for body in bodies for what in ("mass", "inertia")}
    errors |= {key: share * float(value_at(plant, key)) for key, share in (masses | _OTHERS).items()}
    errors |= {f"encoders.zero_count.{i}": _ZERO for i in range(3)} | {"encoders.latency": _LATENCY}
    return [
        ParameterEstimate(key, float(value_at(plant, key)), error, "", "test")
        for key, error in errors.items()
    ]


def true_robot(plant: PlantParameters, seed: int) -> PlantParameters:
    """Return a robot that may have been measured as `plant`; its zeros are as found."""
    random, true = np.random.default_rng(seed), dict[str, float]()
    for value in measured_values(plant):
        drawn = value.value + float(random.normal()) * value.error
        if "zero_count" not in value.key:
            true[value.key] = drawn if value.key.endswith("centre") else max(drawn, 0.0)
    return with_values(plant, true)


def swung_wrongly(robot: PlantParameters) -> dict[str, SwungWrongly]:
    """Return machines that become wrong and are otherwise like `robot`, by name."""

    def broken(
        signal: str, kind: str, value: float, location: str, what: str, phase: str = "backswing"
    ) -> SwungWrongly:
        fault = Fault("wrong", signal, kind, value, phase=phase)  # type: ignore[arg-type]
        return SwungWrongly(robot, (fault,), location, what)

    def other(keys: tuple[str, ...], factor: float, location: str, what: str) -> SwungWrongly:
        values = {key: factor * float(value_at(robot, key)) for key in keys}
        return SwungWrongly(with_values(robot, values), (), location, what)

    def rubbing(key: str, factor: float, joint: str) -> SwungWrongly:
        kinds = tuple(f"{key}.friction.{kind}" for kind in ("coulomb", "static", "viscous"))
        return other(kinds, factor, f"friction of the {joint}", "it is another")

    return {
        "nothing wrong": SwungWrongly(robot, (), "", ""),
        "hose of the arm leaks": broken("arm valve", "leaking", 0.04, "air of the arm", "leaks"),
        "hose of the shoulder leaks": broken(
            "shoulder valve", "leaking", 0.03, "air of the shoulder", "leaks"
        ),
        "regulator too low": broken("supply", "scale", 0.85, "supply", "regulator gives less"),
        "supply sags": other(("supply.feed_conductance",), 0.08, "supply", "sags"),
        "spool sticks": broken("wrist valve", "slow", 0.01, "wrist valve", "sticks", "downswing"),
        "spool stuck": broken("arm valve", "stuck", nan, "arm valve", "sticks", "downswing"),
        "encoder slipped": broken("arm encoder", "offset", 0.05, "arm encoder", "slips", "downswing"),
        "encoder slips": broken("wrist encoder", "scale", 1.1, "wrist encoder", "slips"),
        "head heavier than entered": other(("robot.club.head_mass",), 1.5, "club", "heavy"),
        "arm rubs": rubbing("right_arm", 4.0, "arm"),
        "wrist's bearing dry": rubbing("wrist", 3.0, "wrist"),
        "shoulder's belt tight": rubbing("shoulder", 3.0, "shoulder"),
        "brake of the wrist weak": broken("wrist valve", "scale", 0.5, "wrist valve", "lets through less"),
        "brake of the shoulder weak": broken(
            "shoulder valve", "scale", 0.5, "shoulder valve", "lets through less", "downswing"
        ),
        "sensor drifts": broken(
            "right arm B sensor", "offset", -4e4, "right arm B sensor", "another pressure"
        ),
    }
