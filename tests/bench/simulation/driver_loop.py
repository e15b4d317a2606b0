"""The Python cycle around the `sim` driver, on a virtual clock: tests put it in the place of lock-step."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bench.base.clock import FreeClock
from bench.control.step_records import ControlParameters
from bench.loop.loop import Cycles, Loop
from bench.simulation.lockstep import holds_or_stands
from bench.simulation.swing_operator import joined
from sim.driver import SimDriver
from sim.plant import Plant


class DriverLoop(Loop):
    """Made and run as `bench.simulation.lockstep.Lockstep`."""

    def __init__(self, plant: Plant, parameters: ControlParameters, angle: NDArray[np.float64]) -> None:
        driver = SimDriver(plant, angle)
        driver.open()
        clock = FreeClock(plant.parameters.tick)
        super().__init__(driver, parameters, clock, name="sim", note_truth=driver.note_truth)
        self.plant, self.plant_state = plant, driver.plant_state

    def advance(self, ticks: int, request: int = 0, look: int = 0) -> Cycles:
        """Run `ticks` ticks, with `look` to the first multiple at which the robot holds or stands."""
        if not look:
            return super().advance(ticks, request)
        parts = list[Cycles]()
        while len(parts) * look < ticks and not holds_or_stands(self.state.control[0]):
            parts.append(super().advance(look))
        return joined(parts)
