"""Series of swings of a simulated bench, each beginning with the air that the one before left."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from bench.base.errors import Refused
from bench.base.lifecycle import CAUSE_TEXT, Cause, Phase, Request
from bench.config import Configuration
from bench.control.settings import (
    ControlSettings,
    EnvelopeSettings,
    EstimatorSettings,
    build_controller,
    for_learning,
    with_tables_of,
)
from bench.control.step_records import ControlParameters
from bench.simulation.lockstep import Lockstep
from bench.simulation.safety import Loads
from bench.simulation.swing_operator import RETURN_TIMEOUT, STANDSTILL_TIMEOUT, LockstepEngine, joined
from bench.swing.profile import Profile
from sim.faults import Fault
from sim.impact import Delivery
from sim.plant import Plant, PlantParameters, build_plant
from sim.sensors import contact_in

HOLD = 1.0
"""Time at the address before a swing, s: the air in the chambers comes to rest later than the robot."""
ADDRESS_TRIES = 3
"""Times that a robot may take its address for one swing."""
_MAX_VENT_TIME = 15.0
"""Max time of venting (s)."""
_REQUESTS = 300
"""Max requests for a swing, until the robot is still enough at its address."""
_CHUNK = 10
"""Ticks between two requests."""


class SeriesSwing(NamedTuple):
    """One swing of a series."""

    cycles: np.ndarray[Any, Any]
    """CYCLE records of the profile's duration, from its first tick."""
    delivery: Delivery | None
    """Delivery at the plant's contact; None without one."""
    contact_time: float
    """Time from the swing's first tick (s); NaN without contact."""
    cause: Cause
    """Cause of a stop; NONE without one."""
    air_used: float
    """Air taken from the supply from address to the profile's end, kg."""
    settled: bool
    """Whether it began with planned air, or with that a swing had left, not with that of arming."""


class ReturnFailed(Refused):
    """The robot swung, and does not come back to its address."""

    swing: SeriesSwing
    """The swing."""


class ArmingFailed(Refused):
    """The robot was stopped before it was armed."""

    cycles: np.ndarray[Any, Any]
    """CYCLE records of the last seconds."""


def return_failed(refused: Refused, swing: SeriesSwing) -> ReturnFailed:
    """Return `refused` after `swing`."""
    error = ReturnFailed(*refused.args)
    error.swing = swing
    return error


class Bench(NamedTuple):
    """Model, profile and settings of a series, without its plant."""

    model: PlantParameters
    """The plant as the bench believes it to be: controller and envelope are built from it."""
    profile: Profile
    control: ControlSettings = ControlSettings()
    envelope: EnvelopeSettings = EnvelopeSettings()
    estimator: EstimatorSettings = EstimatorSettings()
    as_known: bool = False
    """Whether the robot is the model within its tolerances, swung as planned: limits of known robots hold."""

    @classmethod
    def of(cls, c: Configuration, profile: Profile) -> Bench:
        """Return the bench of configuration `c` for `profile`."""
        return cls(c.plant, profile, c.control, c.envelope, c.estimator)

    def controller(self) -> ControlParameters:
        """Return the records that the control step takes."""
        made = build_controller(self.model, self.profile, self.control, self.envelope, self.estimator)
        return self.with_its_limits(made)

    def with_its_limits(self, made: ControlParameters) -> ControlParameters:
        """Return the controller `made` with the limits of learning, unless the robot is as known."""
        return made if self.as_known else for_learning(made, self.envelope.model)


class Series:
    """A simulated bench that swings repeatedly; the profile's tables may differ from swing to swing."""

    def __init__(self, bench: Bench, plant: PlantParameters, faults: tuple[Fault, ...] = ()) -> None:
        """Arm `bench` on `plant`, which may differ from the bench's model, with `faults`.

        Raises:
            Refused: the robot does not reach its address.
        """
        self.bench, self._parameters = bench, plant
        stepper = Lockstep(build_plant(plant), bench.controller(), bench.profile.angle[0], faults)
        self._engine = LockstepEngine(stepper, name=bench.profile.name)
        self._arm()

    def _arm(self) -> None:
        self._settled = bool(self.bench.profile.air)
        self._engine.arm()

    def rest(self) -> None:
        """Rest at the address for `HOLD`, the time before each swing."""
        self._engine.advance(round(HOLD / self.bench.profile.period))

    def loads(self) -> Loads:
        """Return the loads since it was armed first."""
        return self._engine.loads()

    @property
    def plant(self) -> Plant:
        """Plant that the series swings."""
        return self._engine.stepper.plant

    def settle(self, swings: int = 2) -> None:
        """Swing some times and rest: at this instant `swing_again` begins.

        Without planned chamber pressures the first swing after arming begins with other pressures than the
        following ones.
        """
        for _ in range(swings):
            self.swing(self.bench.profile)
        self.rest()
        self._mark = self._engine.mark()

    def swing_again(self, profile: Profile, ticks: int, *, ball: bool = True) -> SeriesSwing:
        """Swing `profile` from the instant of `settle`; the robot is left where it is after `ticks`."""
        self._engine.go_back(self._mark)
        return self._swing(profile, ticks, ball=ball)

    def swing(
        self, profile: Profile, parameters: ControlParameters | None = None, *, ball: bool = True
    ) -> SeriesSwing:
        """Rest at the address, tee a ball up, swing `profile`, and come back to the address.

        With `parameters` another controller makes the swing itself, but not what precedes and follows it.
        After a stop the robot is reset and armed again, as a person would; so it is after a stop at the
        address, where friction may let a joint slip, and the swing is then tried again.

        Raises:
            ReturnFailed: the robot does not come back to its address.
            Refused: it does not come to rest there before.
        """
        stepper = self._engine.stepper
        own = stepper.parameters
        swing = self._rest_and_swing(profile, ball=ball, other=parameters)
        if parameters is not None:
            stepper.parameters = own
        if self._returned():
            return swing
        swing = swing._replace(cause=self._engine.cause)
        try:
            self._recover()
        except Refused as refused:
            raise return_failed(refused, swing) from None
        return swing

    def _rest_and_swing(
        self, profile: Profile, *, ball: bool, other: ControlParameters | None
    ) -> SeriesSwing:
        """Rest at the address and swing; take the address again after a stop there."""
        for _ in range(ADDRESS_TRIES - 1):
            self.rest()
            try:
                return self._swing(profile, len(profile.angle), ball=ball, other=other)
            except Refused:
                if not self._engine.cause:
                    raise
                self._recover()
        self.rest()
        return self._swing(profile, len(profile.angle), ball=ball, other=other)

    def _swing(
        self, profile: Profile, ticks: int, *, ball: bool = True, other: ControlParameters | None = None
    ) -> SeriesSwing:
        """Swing for `ticks`, from the accepted request on by the controller `other` if there is one."""
        engine, stepper, bench = self._engine, self._engine.stepper, self.bench
        stepper.parameters = with_tables_of(stepper.parameters, profile, bench.control, bench.model)
        engine.begin_record()
        engine.await_air()  # a joint that breaks away may take the club to the ball
        engine.tee_up(ball=ball)
        before = float(engine.plant_state["air_used"][0])
        if not engine.start_swing(_REQUESTS, _CHUNK):
            raise engine.refusal("the robot does not come to rest there")
        if other is not None:  # not before: the address is held, and its air awaited, by the bench's own
            stepper.parameters = with_tables_of(other, profile, bench.control, bench.model)
        cycles = joined([engine.latest, engine.advance(ticks - 1)])
        contact, site = contact_in(engine.plant_state), self.bench.model.site
        delivery, time = None, float("nan")
        if contact is not None:
            time = contact.time - float(cycles["time"][0])
            delivery = contact.delivery(self.bench.model.robot, (site.ball_x, site.ball_y))
        used = float(engine.plant_state["air_used"][0]) - before
        settled, self._settled = self._settled, True
        return SeriesSwing(cycles, delivery, time, engine.cause, used, settled)

    def _returned(self) -> bool:
        """Let the robot return; return whether it holds the address again, without a reaction."""
        engine = self._engine
        reached = engine.run_until(lambda: engine.phase is Phase.HOLD, RETURN_TIMEOUT)
        return reached and not engine.control["reaction"][0]

    def _recover(self) -> None:
        """Come to rest, reset and arm again."""
        engine = self._engine
        engine.wait_for(lambda: engine.phase is Phase.STANDING, STANDSTILL_TIMEOUT)
        engine.wait_for(lambda: bool(engine.control["venting"]["emptied"][0]), _MAX_VENT_TIME)
        cause = engine.cause
        if not engine.request(Request.RESET):
            raise Refused(
                "reset after a stop",
                CAUSE_TEXT[cause],
                "a bench that can be reset",
                "Check [plant] with golfbench check.",
            )
        self._arm()


def quiet(plant: PlantParameters) -> PlantParameters:
    """Return `plant` with encoders without noise, so that compared swings differ by intent only."""
    return replace(plant, encoders=replace(plant.encoders, noise=0.0, jitter=0.0))
