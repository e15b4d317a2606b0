"""Swings of a simulated bench one after another, each beginning with the air that the one before left."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from bench.control.settings import (
    ControlSettings,
    EnvelopeSettings,
    EstimatorSettings,
    build_controller,
    with_tables_of,
)
from bench.control.step import ACCEPTED, SWING, ControlParameters
from bench.errors import Refused
from bench.lifecycle import CAUSE_TEXT, Cause, Phase, Request
from bench.simulation.lockstep import Lockstep
from bench.swing.profile import Profile
from bench.telemetry.cycle_record import CYCLE
from sim.impact import Delivery
from sim.plant import Plant, PlantParameters, build_plant
from sim.truth import contact_in

HOLD = 1.0
"""s at the address before a swing: the air in the chambers comes to rest later than the robot."""
_LONGEST_RETURN = 10.0
_LONGEST_STOP = 6.0
_LONGEST_VENT = 15.0
_REQUESTS = 300
"""For a swing, until the robot is still enough at its address."""
_CHUNK = 10
"""Ticks between two looks at the phase."""


class SeriesSwing(NamedTuple):
    """One swing of a series."""

    cycles: np.ndarray[Any, Any]
    """CYCLE records of the profile's duration, from its first tick."""
    delivery: Delivery | None
    """What the plant knows of the contact; None without one."""
    contact_time: float
    """s from the swing's first tick; NaN without contact."""
    cause: Cause
    """What stopped the robot; NONE when nothing did."""
    air_used: float
    """kg taken from the supply from address to the profile's end."""
    settled: bool
    """Whether it began with the air that a swing had left, not with that of arming."""


class Bench(NamedTuple):
    """What the swings are made with, beside the plant that is swung."""

    model: PlantParameters
    """The plant as the bench believes it to be: controller and envelope are built from it."""
    profile: Profile
    control: ControlSettings = ControlSettings()
    envelope: EnvelopeSettings = EnvelopeSettings()
    estimator: EstimatorSettings = EstimatorSettings()

    def controller(self) -> ControlParameters:
        """Return the records that the control step takes.

        Without the model-based check: what is swung differs from the model by intent.
        """
        unwatched = self.envelope.with_model_check("off")
        return build_controller(self.model, self.profile, self.control, unwatched, self.estimator)


class Series:
    """A simulated bench that swings again and again; the profile's tables may differ from swing to swing."""

    def __init__(self, bench: Bench, plant: PlantParameters) -> None:
        """Arm `bench` on `plant`, which may be another one than it believes.

        Raises:
            Refused: the robot does not reach its address.
        """
        self.bench, self._parameters = bench, plant
        self._stepper = Lockstep(build_plant(plant), bench.controller(), bench.profile.angle[0])
        self._arm()

    def _arm(self) -> None:
        self._settled = False
        if not self._stepper.arm():
            raise self._no_address()

    def _no_address(self) -> Refused:
        return Refused(
            f"address of profile {self.bench.profile.name!r}",
            "the robot does not come to rest there",
            "hold at its address",
            "Check the profile's address against the plant.",
        )

    def vary(self, plant: PlantParameters) -> None:
        """Let the plant be `plant` from here on; its state stays."""
        self._stepper.plant = build_plant(plant)

    def rest(self) -> None:
        """Rest at the address for as long as before a swing."""
        self._stepper.advance(round(HOLD / self.bench.profile.period))

    @property
    def plant(self) -> Plant:
        """The plant that is swung."""
        return self._stepper.plant

    def mark(self) -> Mark:
        """Return the present instant, at the address, for `swing_from`."""
        stepper = self._stepper
        return Mark(tuple(array.copy() for array in _memory(stepper)), stepper.tick)

    def swing_from(
        self, mark: Mark, profile: Profile, ticks: int | None = None, *, ball: bool = True,
        parameters: ControlParameters | None = None,
    ) -> SeriesSwing:  # fmt: skip
        """Swing `profile` from the instant `mark`; the robot is left where it is after `ticks`.

        With `parameters` the controller is another one from here on.
        """
        self._stepper.parameters = parameters or self._stepper.parameters
        for array, then in zip(_memory(self._stepper), mark.arrays, strict=True):
            array[...] = then
        self._stepper.tick = mark.tick
        return self._swing(profile, ticks or len(profile.angle), ball=ball)

    def swing(self, profile: Profile, parameters: ControlParameters | None = None) -> SeriesSwing:
        """Rest at the address, tee a ball up, swing `profile`, and come back to the address.

        With `parameters` the swing itself, not what is before and after it, is another controller's. After a
        stop the robot is reset and armed again, as a person would.

        Raises:
            Refused: the robot does not come back to its address.
        """
        self.rest()
        own = self._stepper.parameters
        self._stepper.parameters = parameters or own
        swing = self._swing(profile, len(profile.angle))
        if parameters is not None:
            self._stepper.parameters = own
        if self._returned(profile.period):
            return swing
        cause = self._cause
        self._recover(profile.period)
        return swing._replace(cause=cause)

    def _swing(self, profile: Profile, ticks: int, *, ball: bool = True) -> SeriesSwing:
        stepper, control = self._stepper, self._stepper.state.control
        stepper.parameters = with_tables_of(stepper.parameters, profile, self.bench.control, self.bench.model)
        control["tee"] = False
        stepper.advance(1)
        stepper.plant_state["ball_present"] = stepper.plant_state["struck"] = False
        control["tee"] = ball
        before = float(stepper.plant_state["air_used"][0])
        for _ in range(_REQUESTS):
            first = stepper.advance(1, SWING)
            if control["answer"][0] == ACCEPTED:
                break
            stepper.advance(_CHUNK)
        else:
            raise self._no_address()
        # As bytes: numpy joins records field by field and leaves their padding to chance.
        parts = [part.view(np.uint8) for part in (first, stepper.advance(ticks - 1))]
        cycles = np.concatenate(parts).view(CYCLE)
        contact, site = contact_in(stepper.plant_state), self.bench.model.site
        delivery, time = None, float("nan")
        if contact is not None:
            time = contact.time - float(cycles["time"][0])
            delivery = contact.delivery(self.bench.model.robot, (site.ball_x, site.ball_y))
        used = float(stepper.plant_state["air_used"][0]) - before
        settled, self._settled = self._settled, True
        return SeriesSwing(cycles, delivery, time, self._cause, used, settled)

    @property
    def _cause(self) -> Cause:
        return Cause(int(self._stepper.state.control["cause"][0]))

    def _returned(self, period: float) -> bool:
        """Let the robot return; tell whether it holds the address again."""
        control = self._stepper.state.control
        for _ in range(round(_LONGEST_RETURN / period / _CHUNK)):
            if control["phase"][0] == Phase.HOLD:
                return not control["reaction"][0]
            if control["phase"][0] == Phase.STANDING:
                return False
            self._stepper.advance(_CHUNK)
        return False

    def _recover(self, period: float) -> None:
        """Come to rest, reset and arm again."""
        stepper = self._stepper
        for _ in range(round(_LONGEST_STOP / period / _CHUNK)):
            if stepper.state.control["phase"][0] == Phase.STANDING:
                break
            stepper.advance(_CHUNK)
        for _ in range(round(_LONGEST_VENT / period / _CHUNK)):
            if stepper.state.control["vented"][0]:
                break
            stepper.advance(_CHUNK)
        cause = self._cause
        stepper.advance(1, int(Request.RESET))
        if stepper.state.control["answer"][0] != ACCEPTED:
            raise Refused(
                "going on after a stop", CAUSE_TEXT[cause], "a bench that can be reset", "Look at the plant."
            )
        self._arm()


class Mark(NamedTuple):
    """An instant of a series, to begin swings at again."""

    arrays: tuple[np.ndarray[Any, Any], ...]
    tick: int


def _memory(stepper: Lockstep) -> list[np.ndarray[Any, Any]]:
    return [stepper.plant_state, stepper.readings, stepper.command, *stepper.state]


def settled(bench: Bench, plant: PlantParameters, swings: int = 2) -> tuple[Series, Mark]:
    """Return a series on `plant` and the instant at its address after some swings.

    The first swing after arming begins with other pressures than those that follow.
    """
    series = Series(bench, plant)
    for _ in range(swings):
        series.swing(bench.profile)
    series.rest()
    return series, series.mark()


def quiet(plant: PlantParameters) -> PlantParameters:
    """Return `plant` with encoders that are free of noise: what is compared then differs by intent only."""
    return replace(plant, encoders=replace(plant.encoders, noise=0.0, jitter=0.0))
