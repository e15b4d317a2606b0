"""Step 3: leakage, dead volumes, effective areas and the valves' flow, from filling and decay at the stops.

At a stop the volumes are dead volume plus area times way: both stops together give both. What closed
chambers lose or gain says what leaks, and how they empty through the vents says how large they are.
"""

from __future__ import annotations

import numpy as np

from bench.commissioning.air_fit import NAMES, UNITS, AirFit, AirTrace, fit_air, nominal_values
from bench.commissioning.known_robot import ACTUATOR_KEYS, FoundValue, KnownRobot
from bench.commissioning.machine import CommissionedMachine, MotionTrace, Segment, Until
from bench.commissioning.moves import (
    FOLD_ORDER,
    MOVING,
    PRESSING,
    Side,
    at_both_stops,
    beyond,
    centres,
    openings,
    require_within,
    slow_bounds,
)
from bench.commissioning.steps import StepResult, Traces, WrongMachine
from drivers.base import JOINTS, Triple

_FILL, _COUNTER = 0.10, 0.05
"""Openings beyond the edges: filling the chamber that presses the joint, and the other one."""
_HELD = (2, 4)
"""Segments in which all is shut."""
_FULL, _HALF = 2.7e5, 1.8e5
"""Pressures up to which the two are filled, Pa absolute."""
_HOLD, _SHORT_HOLD, _DECAY = 2.5, 0.6, 1.6
"""s"""
MAX_LEAKAGE = 0.008
"""Max leakage of a valve that is right, as a share of its full opening."""
MAX_CROSS_LEAKAGE = 2e-10
"""Max leakage past the seals of an actuator that is right, m3/(s Pa)."""


class Leakage:
    """Step 3."""

    name = "leakage"
    title = "Leakage, dead volumes, effective areas, flow of the valves"
    bounds_text = "chambers up to 2.7 bar absolute at a supply of 3 bar, joints at their stops"

    def measure(self, machine: CommissionedMachine, known: KnownRobot) -> Traces:
        """Fill, hold and empty the chambers of each joint at either stop."""
        return at_both_stops(machine, known, _fill_and_decay)

    def estimate(self, traces: Traces, known: KnownRobot) -> StepResult:
        """Return the air of all actuators."""
        values: list[FoundValue] = []
        notes: list[str] = []
        if vents_stay_open(traces, known):
            raise WrongMachine(
                "vents",
                "chambers empty through them when they are commanded shut",
                "chambers that hold their air",
                "A vent stays open: check its coil, cable and pilot air, then replace it.",
            )
        for i, key in enumerate(ACTUATOR_KEYS):
            sure = [name for name in ("valve.centre", "valve.dead_band") if f"{key}.{name}" in known.found]
            fit = fit_air((traces[f"{JOINTS[i]} lower"], traces[f"{JOINTS[i]} upper"]), known, i, sure)
            _require_tight(i, fit)
            for name, value, error, unit in zip(NAMES, fit.values, fit.error, UNITS, strict=True):
                values.append(FoundValue(f"{key}.{name}", float(value), float(error), unit, self.name))
            notes.append(f"{JOINTS[i]}: pressures fit within {fit.residual:.0f} Pa")
        return StepResult(tuple(values), tuple(notes))


def vents_stay_open(traces: Traces, known: KnownRobot) -> bool:
    """Return whether the chambers of all joints, when closed, behave as with open vents in `traces`."""
    for i, joint in enumerate(JOINTS):
        errors = []
        for vents in (0.0, known.plant.supply.vent_conductance):
            total = 0.0
            for side in ("lower", "upper"):
                air = AirTrace(traces[f"{joint} {side}"], i, known.plant)
                air.vent = np.full(len(air.vent), vents)
                rows = air.windows()
                held = rows[np.isin(air.segment[rows[:, 0]], _HELD)]
                total += float(np.square(air.errors(nominal_values(known, i), held)).sum())
            errors.append(total)
        if errors[1] >= errors[0]:
            return False
    return True


def _require_tight(joint: int, fit: AirFit) -> None:
    leakage, cross = fit.values[NAMES.index("valve.leakage")], fit.values[NAMES.index("cross_leakage")]
    if leakage > MAX_LEAKAGE:
        raise WrongMachine(
            f"air of the {JOINTS[joint]}",
            f"closed chambers leak {100 * leakage:.1f} % of the valve's full opening",
            f"up to {100 * MAX_LEAKAGE:.1f} %",
            f"Look for a leaking hose, fitting or valve at the {JOINTS[joint]}, or a vent that stays open.",
        )
    if cross > MAX_CROSS_LEAKAGE:
        raise WrongMachine(
            f"air of the {JOINTS[joint]}",
            f"{cross:.1e} m3/(s Pa) pass from chamber to chamber",
            f"up to {MAX_CROSS_LEAKAGE:.1e} m3/(s Pa)",
            f"The piston's or vane's seals of the {JOINTS[joint]} are worn: replace them.",
        )


def _fill_and_decay(machine: CommissionedMachine, known: KnownRobot, joint: int, side: Side) -> MotionTrace:
    """Return the trace of `joint` at its stop at `side`: filled, held, counter-filled, held, emptied."""
    other: Side = "lower" if side == "upper" else "upper"
    pressing, counter = (2 * joint, 2 * joint + 1) if side == "upper" else (2 * joint + 1, 2 * joint)

    def at(command: float) -> Triple:
        return openings(known, FOLD_ORDER, **{JOINTS[joint]: command})

    closed = at(centres(known)[joint])
    machine.set_supply(MOVING)
    trace = machine.run(
        (
            Segment(_DECAY, closed),
            Segment(
                6.0,
                at(beyond(known, joint, side, _FILL)),
                vents_shut=True,
                until=Until("above", pressing, _FULL),
            ),
            Segment(_HOLD, closed, vents_shut=True),
            Segment(
                0.25,
                at(beyond(known, joint, other, _COUNTER)),
                vents_shut=True,
                until=Until("above", counter, _HALF),
            ),
            Segment(_SHORT_HOLD, closed, vents_shut=True),
            Segment(_DECAY + known.plant.supply.vent_delay, closed),
        ),
        slow_bounds(known.plant, 1.2 * PRESSING),
    )
    require_within(trace, f"{JOINTS[joint]} filled at its {side} stop")
    return trace
