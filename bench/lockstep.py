"""Control step and plant in one compiled loop: whole swings in milliseconds, bit for bit repeatable.

The order of a tick is that of the real cycle (`bench.loop`): sense, decide, apply. A test shows that both
give bit-equal records.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from bench.control.requests import near_address
from bench.control.step import (
    ARM,
    ControlParameters,
    ControlState,
    new_control_state,
    step,
)
from bench.lifecycle import Phase
from bench.telemetry.cycle_record import CYCLE
from drivers.base import COMMAND, PASSIVE, READINGS, pack_command
from sim.compiled import compiled, new_record
from sim.plant import Plant, advance, initial_state, sense
from sim.truth import note_truth


@compiled
def run(
    robot: Any, plant: Any, impact: Any, plant_state: Any, state: ControlState, parameters: ControlParameters,
    readings: Any, command: Any, requests: Any, first_tick: int, cycles: Any,
) -> None:  # fmt: skip
    """Run len(requests) ticks; `requests` (n,) u1 are put to the step, `cycles` (n,) CYCLE are written."""
    period = plant[0].tick
    for k in range(len(requests)):
        sense(plant, plant_state, readings)
        if requests[k] != 0:
            state.control[0].request = requests[k]
        cycle = cycles[k : k + 1]
        step(state, parameters, readings, (first_tick + k) * period, command, cycle)
        note_truth(plant_state, cycle)
        advance(robot, plant, impact, plant_state, command)


class Lockstep:
    """A simulated bench on a virtual clock, driven by the compiled loop."""

    def __init__(self, plant: Plant, parameters: ControlParameters, angle: np.ndarray) -> None:
        """Stand vented at joint angles `angle` (3,) rad."""
        self.plant, self.parameters = plant, parameters
        self.plant_state = initial_state(plant, angle)
        self.state = new_control_state()
        self.readings, self.command = new_record(READINGS), new_record(COMMAND)
        self.command["guard_lock"] = True
        self.tick = 0

    def advance(self, ticks: int, request: int = 0) -> np.ndarray:
        """Run `ticks` ticks, `request` put at the first; return their CYCLE records."""
        requests = np.zeros(ticks, np.uint8)
        if ticks:
            requests[0] = request
        cycles = new_record(CYCLE, ticks)
        run(
            *self.plant.records, self.plant_state, self.state, self.parameters, self.readings, self.command,
            requests, self.tick, cycles,
        )  # fmt: skip
        self.tick += ticks
        return cycles

    def arm(self, longest_ticks: int = 15000) -> bool:
        """Arm, and run until the robot rests at address; False when it does not within `longest_ticks`."""
        self.advance(1, ARM)
        control = self.state.control[0]
        for _ in range(longest_ticks // 10):
            if control["phase"] == Phase.HOLD and near_address(self.parameters, self.state.estimator):
                return True
            self.advance(10)
        return False

    def make_passive(self) -> None:
        """Hold the passive command until the next tick."""
        pack_command(PASSIVE, self.command)
