"""Operates a bench as a person does: arms it, waits for pressure, swings, brings it to rest.

The bench is the control loop of a robot, or a simulation whose plant, loads and tee are accessible. On the
simulation (`LockstepEngine`) run `simulate`, the series of learning and tuning, `profile check`, the fault
matrix and the simulated iterations of the designer; `bench.simulation.safety` assesses the end of a run.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from bench.base.errors import Refused
from bench.base.lifecycle import CAUSE_TEXT, REFUSAL_TEXT, Answer, Cause, Phase, Refusal, Request
from bench.control.monitor.pressure_monitor import chambers_show_pressure
from bench.control.states import near_address
from bench.loop.loop import Cycles, Stepper, bring_to_rest
from bench.records.telemetry.cycle_record import CYCLE
from bench.simulation.lockstep import Lockstep
from bench.simulation.safety import Loads, loads_of, reset_peaks

ARMING_TIMEOUT = 30.0
"""Timeout of arming (s); the bench's own time-outs are shorter."""
SETTLING_TIMEOUT = 10.0
"""Until the standing robot rests, s."""
RETURN_TIMEOUT = 10.0
"""Max time from the end of a profile back to its address (s)."""
STANDSTILL_TIMEOUT = 6.0
"""Max time from a stop to standstill (s)."""
_LOOKS = 10
"""Looks at the phase in compiled code between two looks at `stop`."""


AnyStepper = TypeVar("AnyStepper", bound=Stepper)


def never() -> bool:
    """Return False: no stop is requested."""
    return False


class SwingOperator(Generic[AnyStepper]):
    """A bench that is switched on, and its simulated operator."""

    def __init__(
        self, stepper: AnyStepper, *, look: int = 10, stop: Callable[[], bool] = never, name: str = ""
    ) -> None:
        """Run `stepper`, looking at its phase and at `stop` every `look` ticks; `name` is the profile's."""
        self.stepper, self.stop, self.name, self._look = stepper, stop, name, look
        self._kept: list[Cycles] = []

    @property
    def control(self) -> NDArray[Any]:
        """Memory of the swing's state machine, one record."""
        return np.asarray(self.stepper.state.control)

    @property
    def period(self) -> float:
        """Tick, s."""
        return self.stepper.period

    @property
    def phase(self) -> Phase:
        """Phase after the last tick."""
        return Phase(int(self.control["phase"][0]))

    @property
    def cause(self) -> Cause:
        """Cause of the last stop; NONE if nothing stopped the robot."""
        return Cause(int(self.control["cause"][0]))

    # Ticks ---------------------------------------------------------------------------------------------

    def advance(self, ticks: int, request: int = 0) -> Cycles:
        """Run `ticks` ticks with `request` in the first; keep and return their records."""
        self._kept.append(self.stepper.advance(ticks, request))
        return self._kept[-1]

    def request(self, request: int) -> bool:
        """Run one tick with `request`; return whether it was accepted."""
        self.advance(1, request)
        return bool(self.control["answer"][0] == Answer.ACCEPTED)

    def wait_for(self, reached: Callable[[], bool], longest: float) -> bool:
        """Run until `reached`, a request to stop or `longest` (s); return whether it was `reached`."""
        for _ in range(round(longest / self.period / self._look)):
            if reached():
                return True
            if self.stop():
                return False
            self.advance(self._look)
        return reached()

    def run_until(self, reached: Callable[[], bool], longest: float) -> bool:
        """Run as `wait_for` does, but no longer than to a standstill."""
        return self.wait_for(lambda: reached() or self.phase is Phase.STANDING, longest) and reached()

    def run_to_hold(self, longest: float) -> bool:
        """Run until the robot holds its address, as `run_until` does."""
        return self.run_until(self.holding, longest)

    # Records -------------------------------------------------------------------------------------------

    def begin_record(self, keep: float = 0.0) -> None:
        """Drop the records kept so far, up to those of the last `keep` s or somewhat more; copies none."""
        left, first = round(keep / self.period), len(self._kept)
        while first and left > 0:
            first -= 1
            left -= len(self._kept[first])
        self._kept = self._kept[first:]

    @property
    def latest(self) -> Cycles:
        """Records of the latest ticks run at once."""
        return self._kept[-1]

    def record(self) -> Cycles:
        """Return the records kept since `begin_record`."""
        return joined(self._kept)

    # A swing -------------------------------------------------------------------------------------------

    def holding(self) -> bool:
        """Return whether the robot holds its address: no swing and no reaction is active."""
        control = self.control
        return self.phase is Phase.HOLD and not control["swinging"][0] and not control["reaction"][0]

    def resting(self) -> bool:
        """Return whether the robot holds its address with every joint at rest there."""
        parameters, estimator = self.stepper.parameters, self.stepper.state.estimator
        return self.phase is Phase.HOLD and bool(near_address(parameters, estimator))

    def is_still(self) -> bool:
        """Return whether no joint has moved for as long as counts as rest; else the bench refuses to arm."""
        control = self.control
        since = control["time"][0] - control["moved_at"][0]
        return bool(since >= self.stepper.parameters.control["rest_time"][0])

    def is_vented(self) -> bool:
        """Return whether it is still, and no sensor shows pressure in a chamber; else nothing is armed."""
        return self.is_still() and self.shows_no_pressure()

    def shows_no_pressure(self) -> bool:
        """Return whether no living sensor shows pressure in its chamber."""
        return not chambers_show_pressure(self.control["sensors"][0], self.stepper.parameters.control[0])

    def arm(self, *, at_rest: bool = True) -> bool:
        """Charge the chambers of the robot once it is vented, and take it to its address.

        With `at_rest` until it rests there.

        False if asked to stop: the robot is then brought to rest.

        Raises:
            Refused: the request is refused, or the robot does not reach its address.
        """
        self.wait_for(self.is_vented, SETTLING_TIMEOUT)
        if self.request(Request.ARM):
            return self.reach_address(at_rest=at_rest)
        refused = Refusal(int(self.control["refusal"][0]))
        self.rest()
        if self.stop():
            return False
        raise self.refusal(f"the request refused: {REFUSAL_TEXT[refused]}")

    def reach_address(self, *, at_rest: bool = True) -> bool:
        """Wait until the armed robot holds its address, as `arm` does."""
        if self.run_until(self.resting, ARMING_TIMEOUT) if at_rest else self.run_to_hold(ARMING_TIMEOUT):
            return True
        if self.stop():
            self.rest()
            return False
        reason = CAUSE_TEXT[self.cause] if self.cause else "not there in time"
        angle = np.array2string(self.stepper.state.estimator["angle"][0], precision=3)
        self.rest()
        raise self.refusal(f"{reason}; joints at {angle} rad")

    def refusal(self, found: str) -> Refused:
        """Return the error of a robot that does not hold its address; `found` describes its state."""
        address = np.array2string(self.stepper.parameters.angle[0], precision=3)
        return Refused(
            f"arming with profile {self.name!r}",
            found,
            f"hold at address {address} rad within {ARMING_TIMEOUT:g} s",
            "Check the profile's address against the plant, or start nearer to it.",
        )

    def await_air(self) -> bool:
        """Hold the address until the chambers are as planned; return whether they are.

        Returns at once if no pressures are planned. A bench that cannot reach them stops automatically.
        """
        parameters = self.stepper.parameters
        if not parameters.profile["air_planned"][0]:
            return True
        longest = float(parameters.control["pressure_timeout"][0]) + 1.0
        return self.run_until(lambda: bool(self.control["address_air"]["ready"][0]), longest)

    def start_swing(self, attempts: int, wait: int) -> bool:
        """Request the swing up to `attempts` times, `wait` ticks apart; return whether it began.

        A swing is refused until the robot is at rest. Attempts that wait for chamber pressure do not
        count: the bench limits that wait. False also if the robot leaves its hold, or on a stop.
        """
        while attempts > 0:
            if self.stop() or not self.holding():
                return False
            if self.request(Request.SWING):
                return True
            if self.control["refusal"][0] == Refusal.AIR:
                self.await_air()
                continue
            attempts -= 1
            if attempts > 0:
                self.advance(wait)
        return False

    def rest(self) -> None:
        """Bring the robot to rest as the stopping table says."""
        self._kept += bring_to_rest(self.stepper, round(STANDSTILL_TIMEOUT / self.period))


def joined(parts: list[Cycles]) -> Cycles:
    """Return the records of `parts`, one after another."""
    # As bytes: numpy joins records field by field and leaves their padding to chance.
    return np.concatenate([np.zeros(0, np.uint8), *(part.view(np.uint8) for part in parts)]).view(CYCLE)


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

    def run_to_hold(self, longest: float) -> bool:
        """Run until the robot holds its address, as `run_until` does, most looks in compiled code."""
        left = round(longest / self.period / self._look) * self._look
        while left > 0 and not self.stop():
            ticks = min(left, _LOOKS * self._look)
            self._kept.append(self.stepper.advance(ticks, look=self._look))
            if len(self._kept[-1]) < ticks:
                break
            left -= ticks
        return self.holding()

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
