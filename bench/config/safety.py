"""Bounds of the values that a person's safety hangs on, tighter with a real robot than in simulation."""

from __future__ import annotations

from collections.abc import Iterator
from math import inf
from typing import Any, NamedTuple

from bench.config.settings import Configuration
from bench.from_toml import format_value
from drivers.base.ranges import Range, short

Mistake = tuple[str, str, str, str]
"""Key, found, expected, cure."""


class Bound(NamedTuple):
    """What a value of the configuration may be, each number of a list by itself."""

    section: str
    name: str
    simulated: tuple[float, float]
    real: tuple[float, float]
    unit: str
    reason: str

    @property
    def key(self) -> str:
        """Dotted name in the configuration."""
        return f"{self.section}.{self.name}"

    def allowed(self, *, is_machine: bool) -> Range:
        """Return what holds for a real or a simulated robot."""
        return Range(*(self.real if is_machine else self.simulated), self.unit)


BOUNDS = (
    Bound(
        "lifecycle", "warning_time", (0.0, inf), (1.0, 60.0), "s",
        "who stands beside the robot must have time to see the beacon and step back",
    ),
    Bound(
        "lifecycle", "armed_time", (0.0, inf), (1.0, 600.0), "s",
        "a robot with air that nobody has used for ten minutes is forgotten",
    ),
    Bound(
        "lifecycle", "vented_pressure", (0.5e5, 3e5), (1.05e5, 1.5e5), "Pa",
        "half a bar above the atmosphere lifts an arm; below the atmosphere nothing ever counts as empty",
    ),
    Bound(
        "lifecycle", "vent_time", (0.0, inf), (1.0, 120.0), "s",
        "without chamber sensors it is the proof itself, and throttled vents take seconds",
    ),
    Bound(
        "lifecycle", "vented_still", (0.0, inf), (0.5, 60.0), "s",
        "a raised arm hangs on what little air is left, and sinks late",
    ),
    Bound(
        "lifecycle", "vented_blind", (0.0, inf), (5.0, 120.0), "s",
        "where encoders cannot tell, only time shows that a raised arm has sunk",
    ),
    Bound(
        "lifecycle", "local_reset_time", (0.0, inf), (0.5, 30.0), "s",
        "an older press does not speak for who stands beside the robot now",
    ),
    Bound(
        "lifecycle", "supervisor_time", (0.0, inf), (0.05, 2.0), "s",
        "who asks for a stop over the network must be heard, or the robot stop by itself",
    ),
    Bound(
        "control", "still_speed", (0.0, 1.0), (0.0, 0.2), "rad/s",
        "a faster joint does not rest: its club's head moves by more than 0.3 m/s",
    ),
    Bound(
        "control", "still_time", (0.0, inf), (0.02, 1.0), "s",
        "a joint that turns round rests for an instant, too",
    ),
    Bound(
        "control", "brake_time", (0.05, inf), (0.5, 10.0), "s",
        "a brake that ends sooner vents a robot that still moves, which then nothing brakes",
    ),
    Bound(
        "control", "blind_settle", (0.0, inf), (0.1, 10.0), "s",
        "after a blind brake closed chambers stop what the pattern has left",
    ),
    Bound(
        "control", "address_tolerance", (0.0, 0.2), (0.0, 0.05), "rad",
        "a swing that begins elsewhere than designed passes elsewhere over the ground",
    ),
    Bound(
        "envelope", "max_gap", (0.0, 0.5), (0.0, 0.02), "s",
        "within it the club's head travels blindly, 0.8 m at 40 m/s in 0.02 s",
    ),
    Bound(
        "envelope", "lost_time", (0.0, 0.5), (0.0, 0.012), "s",
        "an encoder that is lost for longer is braked for too late",
    ),
    Bound(
        "homing", "tolerance", (0.0, 6.3), (0.0, 0.35), "rad",
        "an encoder that may be further off proves no zero",
    ),
)  # fmt: skip
"""Every value with what may be given in simulation, with a real robot, and why."""


def check_safety(c: Configuration, tree: Any) -> Iterator[Mistake]:
    """Yield what a person beside the robot could not rely on; `tree` is not looked at."""
    for bound in BOUNDS:
        value = getattr(getattr(c, bound.section), bound.name)
        allowed = bound.allowed(is_machine=c.is_machine)
        values = value if isinstance(value, tuple) else (value,)
        if not all(allowed.low <= number <= allowed.high for number in values):
            wrong = next(number for number in values if not allowed.low <= number <= allowed.high)
            where = "with a real robot " if c.is_machine else ""
            yield (
                bound.key,
                f"{short(wrong)} {bound.unit}",
                f"{where}{allowed}: {bound.reason}",
                "Correct it.",
            )
    if c.is_machine and not c.lifecycle.local_reset:
        wanted = "true with a real robot: who resets over the network does not see who stands beside it"
        yield (
            "lifecycle.local_reset",
            format_value(c.lifecycle.local_reset),
            wanted,
            "Wire the button and set the key to true.",
        )
    if c.driver.name == "daq" and not any(c.daq.chamber_pressures) and not c.daq.vent_proof:
        wanted = "a sensor in each chamber, or daq.vent_proof: time alone does not prove that vents open"
        yield "daq.chamber_pressures", "no sensor", wanted, "Fit sensors, or name the device that proves it."
