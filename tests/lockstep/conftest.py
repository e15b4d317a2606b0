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


class Pair(NamedTuple):
    """The same bench twice."""

    compiled: Lockstep
    python: Loop
    driver: SimDriver

    def set(self, field: str, value: object) -> None:
        """Set a field of both plants' states, between two ticks."""
        ours, theirs, driver = self.compiled.plant_state, self.driver.plant_state, self.driver
        if theirs["time"][0] < ours["time"][0]:  # the driver would move at its next reading
            advance(*driver.plant.records, theirs, driver._command)
            driver._ticks[0] += 1
        ours[field] = theirs[field] = value

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
        return Pair(compiled, loop, driver)

    return make
