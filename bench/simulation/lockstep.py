"""Control step and plant in one compiled loop: complete swings in milliseconds, bit-identical when repeated.

The order of a tick is that of the real cycle (`bench.loop.loop`): sense, decide, apply. A test shows that
both give bit-identical records, also with faults (`sim.faults`).
"""

from __future__ import annotations

from typing import Any, Self

import numpy as np

from bench.base.lifecycle import Phase, Reaction
from bench.control.estimate.residual_monitor import BRAKING, note_deviations, row_of
from bench.control.moves.references import charging
from bench.control.step import step
from bench.control.step_records import ControlParameters, ControlState, new_control_state
from bench.loop.compile_ahead import compile_ahead
from bench.records.telemetry.cycle_record import CYCLE
from drivers.base import PASSIVE
from drivers.base.compiled import compiled, new_record
from drivers.base.kept_code import compile_for
from drivers.base.records import COMMAND, READINGS, pack_command
from sim.faults import (
    LEASE,
    RECORDER,
    SUPERVISOR,
    Fault,
    Faults,
    break_parts,
    deliver_command,
    deliver_readings,
    faulty_time,
    is_broken,
    new_faults,
    notice_onsets,
    own_records,
)
from sim.plant import Plant, advance, initial_state
from sim.sensors import note_truth, sense


@compiled
def run(
    robot: Any,
    plant: Any,
    impact: Any,
    plant_state: Any,
    state: ControlState,
    parameters: ControlParameters,
    readings: Any,
    command: Any,
    requests: Any,
    first_tick: int,
    cycles: Any,
    faults: Any,
    largest: Any,
    openings: Any,
    acceleration: Any,
    look: int,
) -> int:
    """Run len(requests) ticks; `requests` (n,) u1 go to the step, `cycles` (n,) CYCLE are written.

    With `look` it ends at a multiple of it at which the robot holds or stands. Returns the number of ticks.
    With `faults` (Faults) between plant and step `robot` and `plant` may also break, and a tick without the
    loop leaves a record of zeros except for the plant's truth. `largest` notes deviations wherever the
    model-based check compares them. `openings` (n, 3) are applied in place of the step's, and `acceleration`
    (n, 3) gets the estimated accelerations, rad/s2. Each may be None.
    """
    period = plant[0].tick
    for k in range(len(requests)):
        if look > 0 and k % look == 0 and holds_or_stands(state.control[0]):
            return k
        time, loop_up = (first_tick + k) * period, True
        s, cycle = state.control[0], cycles[k : k + 1]
        if faults is None:
            sense(plant, plant_state, readings)
        else:
            notice_onsets(faults, plant, plant_state, s.phase)
            deliver_readings(faults, plant, plant_state, readings)
            loop_up = faults.device[0].loop_up
            if loop_up:
                note_processes(state, faults)
                time = faulty_time(faults, time)
        if loop_up:
            if requests[k] != 0:
                s.request = requests[k]
            step(state, parameters, readings, time, command, cycle)
        if largest is not None:
            note_largest(largest, state, time)
        note_truth(plant_state, cycle)
        if openings is not None:
            for i in range(3):
                acceleration[k, i] = state.estimator[0].acceleration[i]
                command[0].valve[i] = openings[k, i]
        if faults is None:
            advance(robot, plant, impact, plant_state, command)
        else:
            deliver_command(faults, plant, command, loop_up)
            break_parts(faults, robot, plant, plant_state)
            advance(robot, plant, impact, plant_state, faults.sent)
    return len(requests)


@compiled
def holds_or_stands(s: Any) -> bool:
    """Return whether the robot stands, or holds its address without swing and reaction."""
    holds: bool = s.phase == Phase.HOLD and not s.swinging and s.reaction == Reaction.NONE
    return holds or s.phase == Phase.STANDING


@compiled
def note_largest(largest: Any, state: ControlState, time: float) -> None:
    """Note the deviations of the tick at `time` (s), if the model-based check compares them."""
    s, e = state.control[0], state.estimator[0]
    if s.phase == Phase.STANDING or charging(s, time) or s.reaction > Reaction.BRAKE:
        return
    if s.reaction == Reaction.BRAKE:
        note_deviations(largest, state.model[0], state.estimator, e.velocity, BRAKING + s.phase)
    else:
        note_deviations(largest, state.model[0], state.estimator, s.reference_velocity, row_of(s))


@compiled
def note_processes(state: ControlState, faults: Faults) -> None:
    """Set which of the bench's processes have ended, and whether the device is operational."""
    s = state.control[0]
    supervisor, recorder = is_broken(faults, SUPERVISOR), is_broken(faults, RECORDER)
    lease = is_broken(faults, LEASE)
    if supervisor >= 0:
        s.supervisor_alive = supervisor == 0
    if recorder >= 0:
        s.support_ready = recorder == 0
    if lease >= 0:
        s.lease_held = lease == 0
    s.device_operational = not faults.device[0].passive


class Lockstep:
    """A simulated bench on a virtual clock, driven by the compiled loop."""

    def __init__(
        self, plant: Plant, parameters: ControlParameters, angle: np.ndarray, faults: tuple[Fault, ...] = ()
    ) -> None:
        """Stand vented at joint angles `angle` (3,) rad, with `faults`."""
        self.plant, self.parameters = plant, parameters
        self.faults: Faults | None = None
        self.largest: np.ndarray | None = None
        """Largest deviations that the model-based check sees; noted where there is such an array."""
        self.plant_state = initial_state(plant, angle)
        self.state = new_control_state()
        self.readings, self.command = new_record(READINGS), new_record(COMMAND)
        self.command["guard_lock"] = True
        self.tick = 0
        if faults:
            self.break_with(faults)
        with compile_ahead() as compiling:
            if compiling:
                compile_for(advance, *plant.records, self.plant_state, self.command)

    @property
    def period(self) -> float:
        """Tick, s."""
        return self.plant.parameters.tick

    def break_with(self, faults: tuple[Fault, ...], *, watchdog: float = 0.02) -> None:
        """Apply `faults` from now on, with time zero now; ValueError as `new_faults`."""
        self.plant = own_records(self.plant)
        self.faults = new_faults(faults, self.plant, watchdog=watchdog)
        if self.tick:  # the device has already received commands
            self.faults.device["commanded"] = True
            self.faults.received[:] = self.command

    def copy(self) -> Self:
        """Return an independent bench in the same state, without faults; both update the same `largest`."""
        other = object.__new__(type(self))
        other.plant, other.parameters, other.tick, other.faults = self.plant, self.parameters, self.tick, None
        other.largest = self.largest
        other.plant_state = self.plant_state.copy()
        other.state = ControlState(*(record.copy() for record in self.state))
        other.readings, other.command = self.readings.copy(), self.command.copy()
        return other

    def advance(self, ticks: int, request: int = 0, look: int = 0) -> np.ndarray:
        """Run `ticks` ticks with `request` in the first; return their CYCLE records.

        With `look`, only to the first multiple of it (ticks) at which the robot holds its address or stands.
        """
        requests = np.zeros(ticks, np.uint8)
        if ticks:
            requests[0] = request
        return self._run(requests, look=look)

    def play(self, openings: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Apply `openings` (n, 3) while the step listens; return records and estimated accelerations."""
        openings = np.ascontiguousarray(openings)
        acceleration = np.zeros_like(openings)
        return self._run(np.zeros(len(openings), np.uint8), openings, acceleration), acceleration

    def _run(
        self,
        requests: np.ndarray,
        openings: np.ndarray | None = None,
        acceleration: np.ndarray | None = None,
        look: int = 0,
    ) -> np.ndarray:
        cycles = new_record(CYCLE, len(requests))
        ticks = run(
            *self.plant.records,
            self.plant_state,
            self.state,
            self.parameters,
            self.readings,
            self.command,
            requests,
            self.tick,
            cycles,
            self.faults,
            self.largest,
            openings,
            acceleration,
            look,
        )
        self.tick += ticks
        return cycles[:ticks]

    def make_passive(self) -> None:
        """Hold the passive command until the next tick."""
        pack_command(PASSIVE, self.command)
