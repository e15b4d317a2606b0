"""Two benches of the same make: one thinks in Python around a driver, one is a compiled loop."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pytest

from bench.base.clock import FreeClock
from bench.control.settings import ControlSettings, build_controller
from bench.loop.loop import Loop
from bench.simulation.lockstep import Lockstep
from bench.swing.profile import Profile
from sim.driver import SimDriver, hanging_pose
from sim.plant import PlantParameters, advance, build_plant


class Mark(NamedTuple):
    """An instant of a pair: all that both remember, and their next ticks."""

    arrays: list[np.ndarray]
    compiled: int
    python: int


class Pair(NamedTuple):
    """The same bench twice."""

    compiled: Lockstep
    python: Loop
    driver: SimDriver
    clock: FreeClock

    def set(self, field: str, value: object) -> None:
        """Set a field of both plants' states, between two ticks."""
        ours, theirs, driver = self.compiled.plant_state, self.driver.plant_state, self.driver
        if theirs["time"][0] < ours["time"][0]:  # the driver would move at its next reading
            advance(*driver.plant.records, theirs, driver._command)
            driver._ticks[0] += 1
        ours[field] = theirs[field] = value

    def _memory(self) -> list[np.ndarray]:
        ours, theirs, driver = self.compiled, self.python, self.driver
        apart = [ours.plant_state, ours.readings, ours.command, driver.plant_state, driver._readings]
        apart += [driver._command, driver._progress, theirs._readings, theirs._command, theirs.record]
        return [*apart, *ours.state, *theirs.state]

    def mark(self) -> Mark:
        """Return the present instant."""
        return Mark([array.copy() for array in self._memory()], self.compiled.tick, self.clock.tick)

    def go_back(self, mark: Mark) -> Pair:
        """Go back to the instant `mark`."""
        for array, then in zip(self._memory(), mark.arrays, strict=True):
            array[...] = then
        self.compiled.tick, self.clock.tick = mark.compiled, mark.python
        return self

    def tee(self, raised: bool) -> None:
        for stepper in (self.compiled, self.python):
            stepper.state.control["tee"] = raised

    def advance(self, ticks: int, request: int = 0) -> np.ndarray:
        """Run both and insist that their records and all that the controllers remember are bit-equal."""
        ours, theirs = self.compiled.advance(ticks, request), self.python.advance(ticks, request)
        if ours.tobytes() != theirs.tobytes():
            first = next(k for k in range(ticks) if ours[k].tobytes() != theirs[k].tobytes())
            names = [
                n for n in ours.dtype.names or () if ours[n][first].tobytes() != theirs[n][first].tobytes()
            ]
            pytest.fail(f"tick {first} of {ticks} differs in {names}")
        for one, two in zip(self.compiled.state, self.python.state, strict=True):
            assert one.tobytes() == two.tobytes()
        return ours


@pytest.fixture(scope="session")
def make_pair() -> Callable[..., Pair]:
    """Return a function that makes the pair of vented benches, hanging, drivers open."""

    def make(parameters: PlantParameters, profile: Profile, control: ControlSettings | None = None) -> Pair:
        start = hanging_pose(parameters)
        driver = SimDriver(parameters, start)
        driver.open()
        controllers = [build_controller(parameters, profile, control) for _ in range(2)]
        clock = FreeClock(parameters.tick)
        loop = Loop(driver, controllers[0], clock, name="sim", note_truth=driver.note_truth)
        compiled = Lockstep(build_plant(parameters), controllers[1], start)
        return Pair(compiled, loop, driver, clock)

    return make
