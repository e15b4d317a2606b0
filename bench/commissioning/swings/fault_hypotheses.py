"""Causes by which a robot may swing otherwise than the one that was measured: one parameter each.

A cause changes the model or the recorded values: valve commands that a spool does not follow, angles from an
encoder that slips, pressures from a sensor with an offset.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from bench.commissioning.machine.machine import Array
from bench.commissioning.swings.short_predictions import RecordedSwing
from bench.control.measured_plant import value_at, with_values
from drivers.base import CHAMBERS, JOINTS
from drivers.base.compiled import compiled
from sim.plant import ACTUATOR_KEYS, PlantParameters

Changed = Callable[[RecordedSwing, PlantParameters, float], Array]
"""Returns the errors of the windows with the cause at a value."""


_TIMES = "{:.2f} times"


class SwingCause(NamedTuple):
    """A cause with one parameter."""

    location: str
    what: str
    """The fault there: causes alike in place and fault are one."""
    errors: Changed
    values: tuple[float, ...]
    """Values to begin the search with, in rising order; between the first and the last it stays."""
    form: str
    """Format of the value times `scale`."""
    action: str
    scale: float = 1.0


def swing_causes(recorded: RecordedSwing) -> list[SwingCause]:
    """Return the causes that are looked at in a swing `recorded`."""
    causes = [
        _factor(
            "supply",
            "the regulator gives less than measured",
            ("supply.pressure",),
            (0.4, 0.6, 0.8, 0.9, 1.1),
            "Read the gauge in service; set the regulator, and look at the compressor.",
        ),
        _factor(
            "supply",
            "it sags under flow",
            ("supply.feed_conductance",),
            (0.03, 0.1, 0.25, 0.5, 1.5),
            "Look for a clogged filter, a kinked hose or a fitting too small before the manifold.",
        ),
        _factor(
            "club",
            "its head is not as heavy as entered",
            ("robot.club.head_mass",),
            (0.5, 0.75, 1.25, 1.6, 2.2),
            "Weigh the head, and enter its mass.",
        ),
        _factor(
            "vents",
            "they empty the chambers at another rate than assumed",
            ("supply.vent_conductance",),
            (0.05, 0.3, 0.7, 1.5, 3.0),
            "Look at the vents and their throttles.",
        ),
    ]
    for joint in range(3):
        causes += [*_of_air(joint), *_of_valve(joint, recorded), *_of_sensors(joint)]
    return causes


def _of_air(joint: int) -> list[SwingCause]:
    """Return friction and leaks of `joint`."""
    name, key = JOINTS[joint], ACTUATOR_KEYS[joint]
    air, leaks = f"air of the {name}", "it leaks under pressure"
    tight = f"Look for a hose or fitting of the {name} that opens under pressure, then for its seals."
    return [
        _factor(
            f"friction of the {name}",
            "it is another than measured",
            tuple(f"{key}.friction.{kind}" for kind in ("coulomb", "static", "viscous")),
            (0.2, 0.6, 1.5, 2.5, 4.0, 8.0),
            f"Look for a rubbing part, bearing, belt or seal of the {name}.",
        ),
        _added(air, leaks, f"{key}.valve.leakage", (0.0, 0.003, 0.01, 0.04, 0.15), tight),
        _added(air, leaks, f"{key}.cross_leakage", (0.0, 2e-10, 1e-9, 5e-9), tight),
    ]


def _of_valve(joint: int, recorded: RecordedSwing) -> list[SwingCause]:
    """Return what its valve may do otherwise."""
    name, key = JOINTS[joint], ACTUATOR_KEYS[joint]
    valve = f"{name} valve"
    weak, sticks = "it lets through less than measured", "its spool sticks or lags"
    clear_way = f"Look for a kinked hose, a clogged silencer or a spool of the {name} that opens less."
    spool = f"Clean or replace the valve of the {name}; look at its plug and the air's filter."
    instants = tuple(np.linspace(0.0, len(recorded) * recorded.tick, 25).tolist())
    return [
        _factor(valve, weak, (f"{key}.valve.conductance",), (0.15, 0.4, 0.7, 0.85, 1.3), clear_way),
        SwingCause(valve, weak, _commanded(joint, _farther), (0.2, 0.5, 0.8, 1.2), _TIMES, clear_way),
        SwingCause(
            valve,
            sticks,
            _commanded(joint, _lagging),
            (0.0, 0.003, 0.01, 0.03),
            "later by {:.0f} ms",
            spool,
            1e3,
        ),
        SwingCause(valve, sticks, _commanded(joint, _stuck), instants, "stuck from {:.0f} ms", spool, 1e3),
        _added(
            valve,
            "its centre moved",
            f"{key}.valve.centre",
            (-0.1, -0.03, 0.0, 0.03, 0.1),
            f"Look at the valve of the {name}: plug, amplifier, spool.",
        ),
    ]


def _of_sensors(joint: int) -> list[SwingCause]:
    """Return what its encoder and the sensors of its chambers may do otherwise."""
    name = JOINTS[joint]
    encoder, slips = f"{name} encoder", "it slips on its shaft"
    fasten = f"Fasten the encoder of the {name} on its shaft, then commission again: its zero is another."
    steps = (-0.4, -0.1, -0.03, 0.03, 0.1, 0.4)
    return [
        SwingCause(encoder, slips, _slipping(joint, at_once=False), (0.6, 0.85, 1.15, 1.4), _TIMES, fasten),
        SwingCause(encoder, slips, _slipping(joint, at_once=True), steps, "{:+.3f} rad", fasten),
        *(
            SwingCause(
                f"{CHAMBERS[k]} sensor",
                "it reads another pressure",
                _misread(k),
                (-1e5, -2e4, 2e4, 1e5),
                "{:+.2f} bar",
                f"Check the sensor of {CHAMBERS[k]} and its cable against a gauge.",
                1e-5,
            )
            for k in (2 * joint, 2 * joint + 1)
        ),
    ]


def _factor(
    location: str, what: str, keys: tuple[str, ...], values: tuple[float, ...], action: str
) -> SwingCause:
    def errors(recorded: RecordedSwing, plant: PlantParameters, value: float) -> Array:
        return recorded.errors(with_values(plant, {key: value * float(value_at(plant, key)) for key in keys}))

    return SwingCause(location, what, errors, values, _TIMES, action)


def _added(location: str, what: str, key: str, values: tuple[float, ...], action: str) -> SwingCause:
    def errors(recorded: RecordedSwing, plant: PlantParameters, value: float) -> Array:
        return recorded.errors(with_values(plant, {key: value + float(value_at(plant, key))}))

    return SwingCause(location, what, errors, values, "{:+.2g}", action)


def _commanded(joint: int, change: Callable[[Array, float, float], Array]) -> Changed:
    """Return the errors if the spool of `joint` is where `change` of commands (n,), value and tick says."""

    def errors(recorded: RecordedSwing, plant: PlantParameters, value: float) -> Array:
        valve = recorded.valve.copy()
        valve[:, joint] = change(valve[:, joint], value, recorded.tick)
        return recorded.errors(plant, valve=valve)

    return errors


def _farther(command: Array, value: float, _: float) -> Array:
    """The valve opens `value` times as far."""
    return np.asarray(command * value)


def _lagging(command: Array, value: float, tick: float) -> Array:
    """The spool follows with a time constant of `value` s."""
    return np.asarray(_followed(command, tick / (value + tick)))


@compiled
def _followed(command: Array, share: float) -> Array:
    """Return `command` (n,) through a filter of first order that goes `share` of the way in each row."""
    out = command.copy()
    for k in range(1, len(out)):
        out[k] = out[k - 1] + share * (command[k] - out[k - 1])
    return out


def _stuck(command: Array, value: float, tick: float) -> Array:
    """The spool stays where it is from `value` s on."""
    row = min(max(round(value / tick), 0), len(command) - 1)
    command[row:] = command[row]
    return command


def _slipping(joint: int, *, at_once: bool) -> Changed:
    """The encoder turns `value` times as far as its joint; or slips `at_once`, by `value` rad (`jump`)."""

    def errors(recorded: RecordedSwing, plant: PlantParameters, value: float) -> Array:
        angle = recorded.raw_angle.copy()
        if at_once:
            angle[recorded.jump(joint) :, joint] -= value
        else:
            angle[:, joint] = angle[0, joint] + (angle[:, joint] - angle[0, joint]) / value
        return recorded.errors(plant, angle)

    return errors


def _misread(chamber: int) -> Changed:
    """The sensor reads `value` Pa too much."""
    return lambda recorded, plant, value: recorded.with_pressure(chamber, -value).errors(plant)
