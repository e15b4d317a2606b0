"""Healthy swings, stops and arming of a drawn robot: the largest deviations the model-based check sees."""

from __future__ import annotations

from contextlib import suppress
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.control.model import KINDS, LEARNING
from bench.control.records import ControlParameters
from bench.errors import Refused
from bench.lifecycle import Cause, Phase, Reaction, Request
from bench.simulation.engine import LockstepEngine
from bench.simulation.lockstep import Lockstep
from bench.simulation.swing_operator import LONGEST_RETURN
from bench.swing.profile import PHASES, Profile
from sim.driver import hanging_pose
from sim.plant import PlantParameters, build_plant

Array = NDArray[np.float64]

_BEGIN, _HOLD = 200, 400
"""Ticks before arming, and at the address before a swing."""
_LONGEST_STOP, _LOOK = 6_000, 20
"""Ticks of a stop at most, and between two looks at it."""
_LONGEST_VENT = 15.0
"""Time for the chambers to empty after a stop, s."""


class HealthyRun(NamedTuple):
    """Two swings of one robot, and stops of copies of it in all phases of the first."""

    largest: Array
    """(5, LEARNING, 3) largest deviations by comparison, row and joint; 0 where a row was not seen."""
    cause: Cause
    """What stopped a swing; NONE when both came back to the address."""
    stops: int
    """Number of stops."""
    escalated: tuple[str, ...]
    """Stops that became more severe than asked for, by phase and kind, or after which arming was stopped."""


def healthy_run(
    plant: PlantParameters, parameters: ControlParameters, profile: Profile, seed: int
) -> HealthyRun | None:
    """Swing twice on `plant`, once with a ball and once as `seed` has it, and stop copies of the first swing.

    `parameters` decide whether a deviation stops it. None if the robot does not reach its address.
    """
    random = np.random.default_rng([seed, 2])
    stepper = Lockstep(build_plant(plant), parameters, hanging_pose(plant))
    stepper.largest = largest = np.zeros((len(KINDS), LEARNING, 3))
    bench, trial = LockstepEngine(stepper), _StopTrial(random)
    stepper.advance(_BEGIN)
    try:
        bench.arm()
    except Refused:
        return None
    for swing in range(2):
        bench.tee_up(ball=swing == 1 or seed % 4 != 3)
        stepper.advance(_HOLD)
        bench.await_air()
        instants = [] if swing else _instants(profile, random)
        if instants:
            trial.stop(stepper)
        request, at = int(Request.SWING), 0
        for tick in (*instants, len(profile.angle)):
            stepper.advance(tick - at, request)
            request, at = 0, tick
            if tick in instants and not bench.cause:
                trial.stop(stepper)
        bench.run_until(bench.holding, LONGEST_RETURN)
        if bench.cause:
            break
    return HealthyRun(largest, bench.cause, trial.number, tuple(trial.escalated))


def _instants(profile: Profile, random: np.random.Generator) -> list[int]:
    """Return ticks of a swing, one drawn in each of its phases that lasts, and one in the return."""
    ends = (*profile.begins[1:], len(profile.angle))
    spans = [
        (begin, end)
        for phase, begin, end in zip(PHASES, profile.begins, ends, strict=True)
        if phase is not Phase.HOLD and end - begin > 1
    ]
    return sorted({int(random.integers(max(begin, 1), end)) for begin, end in spans})


class _StopTrial:
    """Stops copies of a bench, by request and by the emergency stop in turn as drawn; arms one of them again.

    A stop leaves the robot at an end stop, or where friction holds it: arming from there deviates more than
    from hanging.
    """

    def __init__(self, random: np.random.Generator) -> None:
        self._random, self.number, self.escalated = random, 0, list[str]()
        self._armed_again = int(random.integers(1, len(PHASES) + 1))
        """Number of the stop after which the copy is armed again."""

    def stop(self, bench: Lockstep) -> None:
        """Stop a copy of `bench` and run it until it stands."""
        copy, emergency = bench.copy(), bool(self._random.integers(2))
        control, phase = copy.state.control, Phase(int(bench.state.control["phase"][0]))
        if emergency:
            copy.plant_state["emergency_stop_clear"] = False
        copy.advance(1, 0 if emergency else Request.STOP)
        severe = False
        for _ in range(_LONGEST_STOP // _LOOK):
            severe = severe or control["reaction"][0] in (Reaction.PASSIVE, Reaction.BLIND_BRAKE)
            if control["phase"][0] == Phase.STANDING:
                break
            copy.advance(_LOOK)
        self.number += 1
        if severe or control["distrusted"][0]:
            self.escalated.append(f"{phase.name}, {'emergency stop' if emergency else 'stop'}")
        if self.number == self._armed_again:
            if cause := _arm_again(copy):
                self.escalated.append(f"{phase.name}, armed again: {cause.name}")


def _arm_again(stepper: Lockstep) -> Cause:
    """Reset the stopped bench and arm it from where the robot stands; return what stopped that.

    A bench that trusts not all encoders is left alone.
    """
    bench = LockstepEngine(stepper)
    stepper.plant_state["emergency_stop_clear"] = True
    bench.wait_for(lambda: bool(bench.control["venting"]["emptied"][0]), _LONGEST_VENT)
    if bench.request(Request.RESET):
        with suppress(Refused):  # some robots do not reach their address in time
            bench.arm()
        return bench.cause
    return Cause.NONE
