"""Bounds of the values that a person's safety hangs on, tighter with a real robot than in simulation."""

from __future__ import annotations

from collections.abc import Iterator
from math import inf
from operator import attrgetter
from typing import Any, NamedTuple

from bench.base.from_toml import Mistake, format_value
from bench.config.settings import Configuration
from drivers.base.ranges import Range, short


class Bound(NamedTuple):
    """Bounds of a value of the configuration, or of each number of a list."""

    key: str
    """Dotted name in the configuration."""
    simulated: tuple[float, float]
    real: tuple[float, float]
    unit: str
    reason: str

    def allowed(self, *, is_machine: bool) -> Range:
        """Return the range for a real or a simulated robot."""
        return Range(*(self.real if is_machine else self.simulated), self.unit)


BOUNDS = (
    Bound("lifecycle.warning_time", (0.0, inf), (1.0, 60.0), "s",
          "people at the robot must have time to see the beacon and step back"),
    Bound("lifecycle.armed_timeout", (0.0, inf), (1.0, 600.0), "s",
          "a pressurised robot without use for ten minutes is forgotten"),
    Bound("lifecycle.vented_pressure", (0.5e5, 3e5), (1.05e5, 1.5e5), "Pa",
          "half a bar above the atmosphere lifts an arm; below the atmosphere nothing ever counts as empty"),
    Bound("lifecycle.vent_timeout", (0.0, inf), (1.0, 120.0), "s",
          "without chamber sensors it is the proof itself, and throttled vents take seconds"),
    Bound("lifecycle.rest_time_vented", (0.0, inf), (0.5, 60.0), "s",
          "a raised arm hangs on what little air is left, and sinks late"),
    Bound("lifecycle.rest_time_without_encoders", (0.0, inf), (5.0, 120.0), "s",
          "without encoder readings only time shows that a raised arm has sunk"),
    Bound("lifecycle.access_delay", (0.0, inf), (5.0, 120.0), "s",
          "an encoder that is stuck shows rest while a raised arm sinks"),
    Bound("lifecycle.local_reset_time", (0.0, inf), (0.5, 30.0), "s",
          "an older press does not account for a person at the robot now"),
    Bound("lifecycle.supervisor_timeout", (0.0, inf), (0.05, 2.0), "s",
          "if a stop over the network cannot arrive, the robot must stop automatically"),
    Bound("control.rest_speed", (0.0, 1.0), (0.0, 0.2), "rad/s",
          "a faster joint does not rest: its club's head moves by more than 0.3 m/s"),
    Bound("control.rest_time", (0.0, inf), (0.02, 1.0), "s",
          "a joint that reverses also rests for an instant"),
    Bound("control.brake_timeout", (0.05, inf), (0.5, 10.0), "s",
          "a brake that ends sooner vents a robot that still moves, which then nothing brakes"),
    Bound("control.open_loop_settling_time", (0.0, inf), (0.1, 10.0), "s",
          "after an open-loop brake closed chambers stop the remaining motion"),
    Bound("control.address_tolerance", (0.0, 0.2), (0.0, 0.05), "rad",
          "a swing that begins elsewhere than designed passes elsewhere over the ground"),
    Bound("envelope.max_tick_interval", (0.0, 0.5), (0.0, 0.02), "s",
          "during a gap the head moves without feedback, 0.8 m at 40 m/s in 0.02 s"),
    Bound("envelope.encoder_timeout", (0.0, 0.5), (0.0, 0.012), "s",
          "for an encoder that is lost for longer, braking starts too late"),
    Bound("driver.watchdog", (0.0, inf), (0.0, 0.02), "s",
          "until a silent bench is noticed its last openings stay in force"),
    Bound("homing.tolerance", (0.0, 6.3), (0.0, 0.35), "rad",
          "an encoder that may be further off proves no zero"),
    Bound("homing.head_tolerance", (0.0, 1.0), (0.0, 0.03), "m",
          "with zeros 0.1 rad off, 0.15 m at the head, the club passes 2 mm over the ground"),
)  # fmt: skip
"""Bounds of each value in simulation and with a real robot, and their reasons."""


def check_safety(c: Configuration, tree: Any) -> Iterator[Mistake]:
    """Yield the values that are unsafe for a person at the robot; `tree` is not used."""
    for bound in BOUNDS:
        value = attrgetter(bound.key)(c)
        allowed = bound.allowed(is_machine=c.is_machine)
        values = value if isinstance(value, tuple) else (value,)
        for wrong in [number for number in values if not allowed.low <= number <= allowed.high][:1]:
            wanted = f"{'with a real robot ' * c.is_machine}{allowed}: {bound.reason}"
            yield bound.key, f"{short(wrong)} {bound.unit}", wanted, f"Set {bound.key} within these bounds."
    if not c.is_machine:
        return
    if not c.lifecycle.local_reset:
        wanted = "true with a real robot: a remote operator cannot see people near it"
        yield "lifecycle.local_reset", "false", wanted, "Wire the button and set the key to true."
    if c.loop.realtime != "require":
        found, action = format_value(c.loop.realtime), "Set it, and try it with `golfbench doctor`."
        wanted = '"require" with a real robot: a loop that other work delays stops swings, or brakes late'
        yield "loop.realtime", found, wanted, action
    if not c.homing.stops:
        wanted = "true with a real robot: neither pose nor index shows a coupling that slipped a little"
        yield "homing.stops", "false", wanted, "Set it to true."
    if c.driver.name in ("daq", "canopen"):
        yield from _shut_off_proof(c)
        yield from _vent_proof(c)


def _shut_off_proof(c: Configuration) -> Iterator[Mistake]:
    """Yield a missing position switch of a real robot's shut-off valve.

    Only this valve keeps the manifold empty during access if the supply valve stays open. Nothing else shows
    beforehand that it is stuck.
    """
    if c.driver.name == "daq":
        key, fitted = "daq.shut_off_feedback", bool(c.daq.shut_off_feedback)
    else:
        bit = c.canopen.valve_node.inputs.shut_off_open
        key, fitted = "canopen.valve_node.inputs.shut_off_open", bit >= 0
    if not fitted:
        wanted = "the shut-off valve's position switch: nothing else shows that it is stuck open"
        yield key, "not fitted", wanted, "Fit the switch and name its input."


def _vent_proof(c: Configuration) -> Iterator[Mistake]:
    """Yield the missing pressure sensors of a real robot whose venting only time would verify.

    Time proves no vent, and a vent's position no flow: behind a clogged silencer chambers stay full. Only a
    pressure shows that they are empty. It needs a sensor in each chamber and in the manifold, or pressure
    switches outside the bench on the manifold and on each actuator's exhaust.
    """
    node = c.canopen.valve_node
    settings = c.daq if c.driver.name == "daq" else node
    if settings.vent_proof:
        return
    section = "daq" if c.driver.name == "daq" else "canopen.valve_node"
    action = f"Fit sensors, or name in {section}.vent_proof the switches on the manifold and on each exhaust."
    if not settings.supply_pressure:
        wanted = f"a sensor, or {section}.vent_proof: nothing else shows the pressure in the manifold"
        yield f"{section}.supply_pressure", "no sensor", wanted, action
    if not all(settings.chamber_pressures):
        found = "no sensor" if not any(settings.chamber_pressures) else "a chamber without sensor"
        wanted = (
            f"a sensor in each chamber, or {section}.vent_proof: neither time nor a vent's position proves "
            "that air flows out"
        )
        yield f"{section}.chamber_pressures", found, wanted, action
