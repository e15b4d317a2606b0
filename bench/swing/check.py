"""`golfbench swing check`: proves a profile's stops on the plant, from every instant of the swing.

The nominal swing is run once with and once without a ball. From each instant of both, each reaction of
the stopping table is provoked, each valve sticks open either way or shut, and the bench falls silent;
each time the whole control step goes on against the plant until everything rests. What counts is how it
ends: energy in the stops and pressure in the chambers against their ratings, club against ground.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.control.settings import ControlSettings, EnvelopeSettings, EstimatorSettings, build_controller
from bench.control.step import STOP, SWING, ControlParameters, ControlState, step
from bench.lifecycle import CAUSE_TEXT, Cause, Phase
from bench.lockstep import Lockstep
from bench.swing.profile import Profile
from bench.telemetry.cycle_record import CYCLE
from sim.compiled import compiled, new_record
from sim.plant import Plant, PlantParameters, advance, build_plant, sense

_TOUCH = 0.005
"""Depth (m) to which the ground may be pressed: a club that sinks to the ground while the air leaves touches
it at up to about 2 m/s, which the ground's stiffness turns into this depth."""

_LONG_STILL = 1.5  # s
_WATCHED = 14.0
"""How long a stop is watched (s): a raised arm sinks slowly on the air that its throttled vents let go."""
_STANDING = int(Phase.STANDING)

FAULT = np.dtype(
    [
        ("emergency_stop", "?"),
        ("lost_encoders", "?"),
        ("silent", "?"),
        ("stuck", "i8"),
        ("opening", "f8"),
        ("request", "u1"),
    ],
    align=True,
)
"""One fault: e-stop circuit open, encoders without readings, bench silent, valve `stuck` (-1: none) at
`opening` (NaN: where it stands), or a request."""


class Fault(NamedTuple):
    """A fault to provoke, by name."""

    name: str
    emergency_stop: bool = False
    lost_encoders: bool = False
    silent: bool = False
    stuck: int = -1
    opening: float = 0.0
    request: int = 0
    ball: bool = True


_VALVES = ("shoulder", "arm", "wrist")

FAULTS = (
    Fault("none"),
    Fault("no ball", ball=False),
    Fault("operator stop", request=STOP),
    Fault("operator stop, no ball", request=STOP, ball=False),
    Fault("emergency stop", emergency_stop=True),
    Fault("emergency stop, no ball", emergency_stop=True, ball=False),
    Fault("encoders lost", lost_encoders=True),
    Fault("encoders lost, no ball", lost_encoders=True, ball=False),
    Fault("bench silent", silent=True),
    Fault("bench silent, no ball", silent=True, ball=False),
    *(
        Fault(f"{valve} valve stuck {name}", stuck=i, opening=opening)
        for i, valve in enumerate(_VALVES)
        for name, opening in (("open", 1.0), ("open in reverse", -1.0), ("shut", 0.0))
    ),
)


@dataclass(frozen=True)
class Outcome:
    """How one fault at one instant ended; shares are of the ratings, 1 is the limit."""

    fault: str
    time: float
    """s from the start of the swing."""
    phase: Phase
    stop_share: float
    stop: str
    """The stop with that share."""
    pressure_share: float
    clearance: float
    """Lowest clearance of the head over the ground, m."""
    head_speed: float
    """Fastest head, m/s."""
    rest_time: float
    """From the fault until all joints rested, s; inf if they did not."""
    cause: Cause

    @property
    def unsafe(self) -> str:
        """Why this end is unsafe; empty when it is safe."""
        reasons = []
        if not self.stop_share <= 1.0:
            reasons.append(f"{self.stop} took {100 * self.stop_share:.0f} % of its rated energy")
        if not self.pressure_share <= 1.0:
            reasons.append(f"a chamber reached {100 * self.pressure_share:.0f} % of its rating")
        if not self.clearance >= -_TOUCH:
            reasons.append(f"the head went {-1e3 * self.clearance:.0f} mm into the ground")
        if not np.isfinite(self.rest_time):
            reasons.append("it did not come to rest")
        return "; ".join(reasons)


@compiled
def run_fault(
    robot: Any, plant: Any, impact: Any, plant_state: Any, state: ControlState, parameters: ControlParameters,
    readings: Any, command: Any, cycle: Any, fault: Any, first_tick: int, ticks: int, still: float,
) -> float:  # fmt: skip
    """Run `ticks` ticks under `fault`; return the time (s) after which no joint exceeded `still` rad/s."""
    f = fault[0]
    period = plant[0].tick
    rest = 0.0
    stuck_at = 0.0
    if f.stuck >= 0:
        stuck_at = plant_state[0].spool[f.stuck] if np.isnan(f.opening) else f.opening
    for k in range(ticks):
        sense(plant, plant_state, readings)
        if f.emergency_stop:
            readings[0].emergency_stop_clear = False
        if f.lost_encoders:
            for i in range(3):
                readings[0].encoder_valid[i] = 0
        if f.silent:
            c = command[0]
            for i in range(3):
                c.valve[i] = 0.0
            c.supply_enable = c.exhaust_closed = c.beacon = False
        else:
            if k == 0 and f.request != 0:
                state.control[0].request = f.request
            step(state, parameters, readings, (first_tick + k) * period, command, cycle)
        if f.stuck >= 0:
            command[0].valve[f.stuck] = stuck_at
        advance(robot, plant, impact, plant_state, command)
        for i in range(3):
            if not abs(plant_state[0].speed[i]) <= still:
                rest = (k + 1) * period
        # Standing still without energy for long enough: nothing more will come.
        standing = f.silent or state.control[0].phase == _STANDING
        if standing and (k + 1) * period - rest > _LONG_STILL:
            break
    return rest


def _copied(state: ControlState) -> ControlState:
    return ControlState(*(record.copy() for record in state))


class SwingCheck:
    """A plant, a profile and settings, checked fault by fault."""

    def __init__(
        self,
        parameters: PlantParameters,
        profile: Profile,
        control: ControlSettings | None = None,
        envelope: EnvelopeSettings | None = None,
        estimator: EstimatorSettings | None = None,
    ) -> None:
        """Build plant and controller; nothing runs yet."""
        self.plant: Plant = build_plant(parameters)
        self.profile = profile
        self.parameters = build_controller(parameters, profile, control, envelope, estimator)
        self.watched = round(_WATCHED / parameters.tick)

    def _bases(self, spacing: int, *, ball: bool) -> Iterator[tuple[int, Lockstep]]:
        """Yield the bench every `spacing` ticks of a nominal swing: (tick of the swing, bench)."""
        bench = Lockstep(self.plant, self.parameters, self.profile.angle[0])
        if not bench.arm():
            raise RuntimeError("the robot does not come to rest at address")
        bench.state.control["tee"] = ball
        for tick in range(0, len(self.profile.angle), spacing):
            yield tick, bench
            bench.advance(min(spacing, len(self.profile.angle) - tick), SWING if tick == 0 else 0)
            cause = Cause(int(bench.state.control["cause"][0]))
            if cause:
                raise RuntimeError(f"the undisturbed swing stopped at tick {tick}: {CAUSE_TEXT[cause]}")

    def outcomes(
        self,
        faults: tuple[Fault, ...] = FAULTS,
        spacing: int = 10,
        progress: Callable[[float], None] = lambda part: None,
    ) -> list[Outcome]:
        """Return how each of `faults` ends from every `spacing`-th tick of the swing.

        Raises:
            RuntimeError: the undisturbed swing does not run.
        """
        found = []
        for part, ball in enumerate((True, False)):
            wanted = [fault for fault in faults if fault.ball == ball]
            for tick, bench in self._bases(spacing, ball=ball) if wanted else ():
                found += [self._outcome(fault, tick, bench) for fault in wanted]
                progress((part + tick / len(self.profile.angle)) / 2)
        return found

    def _outcome(self, fault: Fault, tick: int, bench: Lockstep) -> Outcome:
        plant_state, state = bench.plant_state.copy(), _copied(bench.state)
        command, readings = bench.command.copy(), bench.readings.copy()
        plant_state["stop_energy"] = plant_state["stop_work"] = 0.0
        plant_state["peak_pressure"] = plant_state["pressure"]
        plant_state["lowest_clearance"], plant_state["peak_head_speed"] = np.inf, 0.0
        record = new_record(FAULT)
        for name in FAULT.names or ():
            record[name] = getattr(fault, name)
        if tick == 0:
            state.control["request"] = SWING if not fault.request else fault.request
        rest = run_fault(
            *self.plant.records, plant_state, state, self.parameters, readings, command,
            new_record(CYCLE), record, bench.tick, self.watched, 0.2,
        )  # fmt: skip
        actuators = self.plant.parameters.actuators
        energies: NDArray[Any] = plant_state["stop_energy"][0] / np.array(
            [[a.stop.energy] for a in actuators]
        )
        pressures = plant_state["peak_pressure"][0].reshape(3, 2) / np.array(
            [[a.pressure_rating] for a in actuators]
        )
        joint, side = np.unravel_index(int(np.argmax(energies)), energies.shape)
        unrest = rest >= (self.watched - 1) * self.plant.parameters.tick
        return Outcome(
            fault=fault.name,
            time=tick * self.profile.period,
            phase=self.profile.phase_of(tick),
            stop_share=float(energies.max()),
            stop=f"{_VALVES[joint]} {('lower', 'upper')[side]} stop",
            pressure_share=float(pressures.max()),
            clearance=float(plant_state["lowest_clearance"][0]),
            head_speed=float(plant_state["peak_head_speed"][0]),
            rest_time=float("inf") if unrest else float(rest),
            cause=Cause(int(state.control["cause"][0])),
        )


@dataclass(frozen=True)
class Summary:
    """All instants of one fault."""

    fault: str
    instants: int
    unsafe: int
    worst_stop: Outcome
    worst_pressure: Outcome
    lowest: Outcome
    slowest: Outcome


def summarise(outcomes: list[Outcome]) -> list[Summary]:
    """Return one summary a fault, in the order of first appearance."""
    names = list(dict.fromkeys(outcome.fault for outcome in outcomes))
    groups = [[outcome for outcome in outcomes if outcome.fault == name] for name in names]
    return [
        Summary(
            name,
            len(group),
            sum(bool(outcome.unsafe) for outcome in group),
            max(group, key=lambda o: o.stop_share),
            max(group, key=lambda o: o.pressure_share),
            min(group, key=lambda o: o.clearance),
            max(group, key=lambda o: o.rest_time),
        )
        for name, group in zip(names, groups, strict=True)
    ]
