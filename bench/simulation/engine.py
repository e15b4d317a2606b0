"""The one engine of simulated swings: a bench whose plant, loads and tee are at hand.

`simulate`, the series that learning and tuning swing, `profile check`, the fault matrix and the designer's
rehearsals run on it; `bench.simulation.safety` judges the end of a run.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from numpy.typing import NDArray

from bench.simulation.loads import Loads, loads_of, reset_peaks
from bench.simulation.lockstep import Lockstep
from bench.simulation.swing_operator import SwingOperator


class Mark(NamedTuple):
    """An instant of a lock-step bench, to go back to."""

    arrays: tuple[NDArray[Any], ...]
    tick: int


class LockstepEngine(SwingOperator[Lockstep]):
    """A simulated bench that is switched on: it can be copied, and taken back to an earlier instant."""

    @property
    def plant_state(self) -> NDArray[Any]:
        """State of the plant, one PLANT_STATE record."""
        return self.stepper.plant_state

    def reset_peaks(self) -> None:
        """Reset the loads."""
        reset_peaks(self.plant_state)

    def loads(self) -> Loads:
        """Return the loads since `reset_peaks`."""
        return loads_of(self.plant_state, self.stepper.plant.parameters)

    def tee_up(self, *, ball: bool) -> None:
        """Lower the tee for a tick, then raise it with a `ball` or leave it down."""
        self.control["tee"] = False
        self.advance(1)
        self.plant_state["ball_present"] = self.plant_state["struck"] = False
        self.control["tee"] = ball

    def copy(self) -> LockstepEngine:
        """Return an independent bench that continues from here, without faults and records."""
        return LockstepEngine(self.stepper.copy(), look=self._look, stop=self.stop, name=self.name)

    def mark(self) -> Mark:
        """Return the present instant."""
        return Mark(tuple(array.copy() for array in self._memory()), self.stepper.tick)

    def go_back(self, mark: Mark) -> None:
        """Go back to the instant `mark`."""
        for array, then in zip(self._memory(), mark.arrays, strict=True):
            array[...] = then
        self.stepper.tick = mark.tick

    def _memory(self) -> list[NDArray[Any]]:
        stepper = self.stepper
        return [stepper.plant_state, stepper.readings, stepper.command, *stepper.state]
