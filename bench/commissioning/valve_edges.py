"""Step 2: centres and dead bands of the valves, from slow ramps at the stops.

A ramp towards the stop at which the joint stands presses it, so that nothing moves; the chamber fills against
its open vent, and the opening from which it does is the edge.
"""

from __future__ import annotations

from bench.commissioning.air_fit import NAMES, fit_air
from bench.commissioning.known_robot import ACTUATOR_KEYS, FoundValue, KnownRobot
from bench.commissioning.machine import CommissionedMachine, MotionTrace, Segment
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
from bench.commissioning.steps import StepResult, Traces
from bench.commissioning.wiring import MAX_BAND, MAX_CENTRE
from bench.commissioning.wrong_machine import WrongMachine
from drivers.base import JOINTS, Triple

_BELOW, _ABOVE = 0.02, 0.08
"""Openings on this side of the rough edge and beyond it."""
_RAMP, _REST = 1.6, 0.8
"""s"""


class ValveEdges:
    """Step 2."""

    name = "valves"
    title = "Centres and dead bands of the valves"
    bounds_text = "openings up to 0.15 at 3 bar absolute with open vents, joints at their stops"

    def measure(self, machine: CommissionedMachine, known: KnownRobot) -> Traces:
        """Ramp each valve towards either stop, the joint standing there."""
        return at_both_stops(machine, known, _ramp)

    def estimate(self, traces: Traces, known: KnownRobot) -> StepResult:
        """Return centre and dead band of each valve."""
        values: list[FoundValue] = []
        for i, key in enumerate(ACTUATOR_KEYS):
            fit = fit_air((traces[f"{JOINTS[i]} lower"], traces[f"{JOINTS[i]} upper"]), known, i)
            for name, most in (("valve.centre", MAX_CENTRE), ("valve.dead_band", MAX_BAND)):
                k = NAMES.index(name)
                value, error = float(fit.values[k]), float(fit.error[k])
                if abs(value) > most:
                    raise WrongMachine(
                        f"{JOINTS[i]} valve",
                        f"{name.partition('.')[2].replace('_', ' ')} {value:+.3f}",
                        f"at most {most}",
                        "Adjust the valve's centre by its maker's manual, or replace the valve.",
                    )
                values.append(FoundValue(f"{key}.{name}", value, error, "", self.name))
        return StepResult(tuple(values))


def _ramp(machine: CommissionedMachine, known: KnownRobot, joint: int, side: Side) -> MotionTrace:
    """Return the ramp of `joint`'s valve towards `side`, at whose stop it stands."""

    def at(opening: float) -> Triple:
        valve = beyond(known, joint, side, opening)
        return openings(known, FOLD_ORDER, **{JOINTS[joint]: valve})

    rest = openings(known, FOLD_ORDER, **{JOINTS[joint]: centres(known)[joint]})
    machine.set_supply(MOVING)
    trace = machine.run(
        (
            Segment(_REST, at(-_BELOW)),
            Segment(_RAMP, at(-_BELOW), at(_ABOVE)),
            Segment(_RAMP, at(_ABOVE), at(-_BELOW)),
            Segment(_REST, rest),
        ),
        slow_bounds(known.plant, 1.2 * PRESSING),
    )
    require_within(trace, f"{JOINTS[joint]} valve ramped at its {side} stop")
    return trace
