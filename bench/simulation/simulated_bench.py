"""Swings of the simulated bench as its operator does them: arm, tee up, swing, watch the ball.

`PoweredBench` gives a swing as a shot with its record. `Series` swings repeatedly, each swing beginning with
the air that the one before left, on a plant that may differ from the bench's model.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from copy import copy
from dataclasses import asdict, dataclass, field, replace
from datetime import datetime
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from bench.base.errors import Refused
from bench.base.lifecycle import CAUSE_TEXT, Cause, Phase, Request
from bench.config import Configuration
from bench.control.settings import (
    SIMULATED,
    ControlSettings,
    EnvelopeSettings,
    EstimatorSettings,
    HomingSettings,
    LifecycleSettings,
    build_controller,
    for_learning,
    with_tables_of,
)
from bench.control.step_records import ControlParameters
from bench.loop.loop import Cycles
from bench.loop.snapshot import SNAPSHOT, pack_snapshot
from bench.records.shot.recorded_shot import FlightConditions
from bench.records.shot.shot import (
    Shot,
    ShotRecord,
    ShotStatus,
    delivery_columns,
    flight_columns,
    launch_columns,
)
from bench.records.telemetry.swing_metadata import (
    begin_of,
    profile_entry,
    snapshot_entry,
    subtract_begin,
    versions,
)
from bench.simulation.lockstep import Lockstep
from bench.simulation.safety import Loads, RunEnd, SafetyLimits, unsafe_reasons
from bench.simulation.swing_operator import RETURN_TIMEOUT, STANDSTILL_TIMEOUT, LockstepEngine, joined, never
from bench.swing.profile import Profile
from drivers.base import Launch
from drivers.base.compiled import new_record
from sim.ball import Ball
from sim.driver import hanging_pose
from sim.faults import Fault
from sim.flight import Flight, fly
from sim.impact import Delivery, impact_parameters
from sim.plant import PlantParameters, build_plant, initial_state
from sim.sensors import Contact, contact_in

_LOOK = 0.02
"""Time between two looks at the phase and at Ctrl-C, s."""
_POWER_UP = 10
"""Ticks before arming: the estimators settle."""
_SETTLING_TIMEOUT = 3.0
"""Time for which a refused swing is requested again, s."""
_SETTLING = 1.0
"""Time at the address before the instant at which all swings of an ArmedBench begin, s: joints and
chambers come to rest, as they do on a running bench."""


@dataclass(frozen=True)
class SwingResult:
    """One swing: its record from hold to hold (or to standstill after a stop), and its outcome."""

    cycles: Cycles = field(repr=False, compare=False)
    """Records of CYCLE, `time` from about zero."""
    status: ShotStatus
    reason: str
    """Why the shot is invalid; empty if it is valid."""
    cause: Cause
    """Cause of a stop; NONE without one."""
    interrupted: bool
    """Whether Ctrl-C stopped the swing."""
    club: str
    ball: Ball | None
    delivery: Delivery | None
    launch: Launch | None
    flight: Flight | None
    contact_time: float | None
    """Time on the record's clock (s); None without contact."""
    loads: Loads
    """Since the swing's record began."""
    begin: float
    """Loop time at the record's time zero, s."""
    snapshot: NDArray[Any] = field(repr=False, compare=False)
    """Controller's memory after the record's first tick, one element of SNAPSHOT."""

    @property
    def unsafe(self) -> list[str]:
        """Reasons why the loads of the swing are unsafe; empty if they are safe."""
        return unsafe_reasons(RunEnd(self.loads), SafetyLimits())

    def replay_metadata(self) -> dict[str, Any]:
        """Return the metadata that a replay of the record needs."""
        return {"begin": self.begin, "snapshot": snapshot_entry(self.snapshot), "replayable": True}

    def shot(self, shot: int, *, block: int = 1, position: int = 1, time_utc: datetime) -> ShotRecord:
        """Return the swing as shot number `shot` of a series, with its record."""
        ball, place = self.ball.name if self.ball else "", (shot, block, position)
        columns = launch_columns(self.launch, "simulated") | flight_columns(self.flight, "simulated")
        columns |= delivery_columns(self.delivery) | {"time_utc": time_utc}
        row = Shot(*place, self.club, ball, self.status, self.reason, **columns)
        return ShotRecord(row, self.cycles, self.flight)


@dataclass(frozen=True)
class Bench:
    """A bench without its robot: profile, plant as believed, and settings; the defaults belong together."""

    profile: Profile
    plant: PlantParameters = field(default_factory=PlantParameters)
    """Controller and envelope are built from it; a robot that swings may differ."""
    control: ControlSettings = field(default_factory=ControlSettings)
    envelope: EnvelopeSettings = field(default_factory=EnvelopeSettings)
    estimator: EstimatorSettings = field(default_factory=EstimatorSettings)
    surroundings: FlightConditions = field(default_factory=FlightConditions)
    hold: float = 0.3
    """Time at address before each swing of `PoweredBench`, s."""
    as_known: bool = False
    """Whether the robot is the plant within its tolerances, swung as planned: limits of known robots hold."""

    @classmethod
    def of(cls, c: Configuration, profile: Profile) -> Self:
        """Return the bench of configuration `c` for `profile`."""
        around = FlightConditions(c.air, c.wind, c.turf)
        return cls(profile, c.plant, c.control, c.envelope, c.estimator, around)

    def controller(
        self, lifecycle: LifecycleSettings = SIMULATED, homing: HomingSettings | None = None
    ) -> ControlParameters:
        """Return the parameter records of the control step."""
        settings = self.control, self.envelope, self.estimator, lifecycle, homing
        return build_controller(self.plant, self.profile, *settings)

    def series_controller(
        self, lifecycle: LifecycleSettings = SIMULATED, homing: HomingSettings | None = None
    ) -> ControlParameters:
        """Return the same for a series, with the limits of learning unless the robot is as known."""
        made = self.controller(lifecycle, homing)
        return made if self.as_known else for_learning(made, self.envelope.model)

    def metadata(self, swing: Mapping[str, Any] | None = None) -> dict[str, Any]:
        """Return the metadata of a record: configuration, versions, seed, profile, and `swing`."""
        settings = ("plant", "control", "envelope", "estimator", "surroundings")
        return {
            "configuration": {name: asdict(getattr(self, name)) for name in settings}
            | {"lifecycle": asdict(SIMULATED), "homing": asdict(HomingSettings())}
            | {"hold": self.hold},
            "versions": versions(),
            "seed": self.plant.seed,
            "profile": profile_entry(self.profile),
            **(swing or {}),
        }


def simulate_swing(bench: Bench, *, stop: Callable[[], bool] = never) -> SwingResult:
    """Arm a vented `bench`, swing once at the plant's ball and return the result.

    When `stop` (see `bench.base.interrupt.deferred_interrupt`) becomes true, the stopping table brings the
    robot to rest, and the passive command is sent; the result is then `interrupted`.

    Raises:
        Refused: the robot does not reach its address.
        KeyboardInterrupt: `stop` became true before the swing's record began.
    """
    powered = PoweredBench(bench, stop)
    engine = powered.engine
    try:
        if not powered.arm():
            raise KeyboardInterrupt
        engine.await_air()
        if stop():
            engine.rest()
            raise KeyboardInterrupt
        return powered.swing(bench.plant.ball)
    finally:
        engine.stepper.make_passive()


class PoweredBench:
    """A simulated bench while it is switched on."""

    def __init__(self, bench: Bench, stop: Callable[[], bool] = never) -> None:
        """Stand vented in the hanging pose."""
        self.bench = bench
        self.engine = LockstepEngine(
            Lockstep(build_plant(bench.plant), bench.controller(), hanging_pose(bench.plant)),
            look=round(_LOOK / bench.plant.tick),
            stop=stop,
            name=bench.profile.name,
        )
        self._snapshot = new_record(SNAPSHOT)

    def arm(self) -> bool:
        """Charge the chambers and take the robot to its address; False if Ctrl-C came."""
        self.engine.advance(_POWER_UP)
        return self.engine.arm(at_rest=False)

    def swing(self, ball: Ball | None) -> SwingResult:
        """Tee `ball` up, swing, return to address, and collect the result."""
        engine = self.engine
        begun = self.begin(ball)
        back = begun and engine.run_to_hold(self.bench.profile.duration + RETURN_TIMEOUT)
        interrupted = engine.stop()
        if interrupted or not back:
            engine.rest()
        engine.control["tee"] = False
        return self._result(ball, begun, interrupted and not back)

    def begin(self, ball: Ball | None) -> bool:
        """Tee `ball` up, hold at address and begin the swing; False if it does not begin."""
        engine, plant = self.engine, self.bench.plant
        engine.await_air()  # before the record, which is to be as long as without planned air
        engine.begin_record()
        engine.reset_peaks()
        engine.tee_up(ball=ball is not None)
        if ball is not None:
            impact = engine.stepper.plant.impact
            impact[:] = impact_parameters(plant.robot.club, ball, plant.robot.lie)
        pack_snapshot(engine.stepper.state, self._snapshot)
        hold = max(round(self.bench.hold / engine.period), 1)
        engine.advance(hold)
        return engine.start_swing(1 + round(_SETTLING_TIMEOUT / max(self.bench.hold, _LOOK)), hold)

    def _result(self, ball: Ball | None, begun: bool, interrupted: bool) -> SwingResult:
        engine = self.engine
        cycles = engine.record()
        begin = begin_of(cycles)
        subtract_begin(cycles, begin)
        club, robot, site = self.bench.plant.robot.club, self.bench.plant.robot, self.bench.plant.site
        contact = contact_in(engine.plant_state)
        delivery = launch = flight = None
        reason = _failure_of(engine.cause, interrupted, begun, ball, contact)
        if contact is not None and ball is not None:
            delivery = contact.delivery(robot, (site.ball_x, site.ball_y))
            launch = contact.launch
            around = self.bench.surroundings
            try:
                flight = fly(launch, around.air, ball, around.wind, around.turf)
            except ValueError as error:
                reason = reason or f"no flight: {error}"
        return SwingResult(
            cycles=cycles,
            status=ShotStatus.FAILED if reason else ShotStatus.VALID,
            reason=reason,
            cause=engine.cause,
            interrupted=interrupted,
            club=club.name,
            ball=ball,
            delivery=delivery,
            launch=launch,
            flight=flight,
            contact_time=None if contact is None else contact.time - begin,
            loads=engine.loads(),
            begin=begin,
            snapshot=self._snapshot.copy(),
        )


class ArmedBench(PoweredBench):
    """A simulated bench that is armed once; each swing begins at that same instant.

    A swing then depends on its `plant` and `ball` only, not on earlier swings: an interrupted series
    continues with the same results.
    """

    def __init__(self, bench: Bench, stop: Callable[[], bool] = never) -> None:
        """Arm `bench`.

        Raises:
            Refused: the robot does not reach its address.
            KeyboardInterrupt: `stop` became true before it did.
        """
        super().__init__(bench, stop)
        engine = self.engine
        if not self.arm():
            raise KeyboardInterrupt
        self._mark = engine.mark()
        if bench.profile.air:
            engine.await_air()
        # Arming leaves other air in the closed chambers than a swing does: begin where a swing ends.
        elif self.swing(None).cause is Cause.NONE and engine.holding():
            engine.advance(round(_SETTLING / engine.period))
        else:
            return
        self._mark = engine.mark()

    def copy(self) -> ArmedBench:
        """Return an independent bench whose swings begin at the same instant."""
        other = copy(self)
        vars(other).update(engine=self.engine.copy(), _snapshot=self._snapshot.copy())
        return other

    def swing_on(self, plant: PlantParameters, ball: Ball | None) -> SwingResult:
        """Swing at `ball` from the instant of arming, with the plant as it is at this shot."""
        engine = self.engine
        engine.go_back(self._mark)
        self.bench = replace(self.bench, plant=plant)
        engine.stepper.plant = built = build_plant(plant)
        state = engine.plant_state
        state["random"] = initial_state(built, state["angle"][0])["random"]
        return self.swing(ball)


def _failure_of(
    cause: Cause, interrupted: bool, begun: bool, ball: Ball | None, contact: Contact | None
) -> str:
    """Return why the shot is invalid; empty if it is valid."""
    if interrupted:
        return "interrupted by Ctrl-C"
    if cause is not Cause.NONE:
        return CAUSE_TEXT[cause]
    if not begun:
        return "the robot did not come to rest at address"
    if ball is None:
        return "no ball on the tee"
    return "" if contact is not None else "the club missed the ball"


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
    cause: Cause
    """Cause of a stop; NONE without one."""
    air_used: float
    """Air taken from the supply from address to the profile's end, kg."""
    settled: bool
    """Whether it began with planned air, or with that a swing had left, not with that of arming."""


class ReturnFailed(Refused):
    """The robot swung, and does not come back to its address."""

    swing: SeriesSwing


class ArmingFailed(Refused):
    """The robot was stopped before it was armed."""

    cycles: np.ndarray[Any, Any]
    """CYCLE records of the last seconds."""


def return_failed(refused: Refused, swing: SeriesSwing) -> ReturnFailed:
    """Return the error that the robot did not return after `swing`, with the text of `refused`."""
    error = ReturnFailed(*refused.args)
    error.swing = swing
    return error


class Series:
    """A simulated bench that swings repeatedly; the profile's tables may differ from swing to swing."""

    def __init__(self, bench: Bench, plant: PlantParameters, faults: tuple[Fault, ...] = ()) -> None:
        """Arm `bench` on `plant`, which may differ from the bench's own, with `faults`.

        Raises:
            Refused: the robot does not reach its address.
        """
        self.bench = bench
        stepper = Lockstep(build_plant(plant), bench.series_controller(), bench.profile.angle[0], faults)
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

    def swing(self, profile: Profile, *, ball: bool = True) -> SeriesSwing:
        """Rest at the address, tee a ball up, swing `profile`, and come back to the address.

        After a stop the robot is reset and armed again, as an operator does. After a stop at the address,
        where a joint may slip, the swing is also repeated.

        Raises:
            ReturnFailed: the robot does not come back to its address.
            Refused: it does not come to rest there before.
        """
        swing = self._rest_and_swing(profile, ball=ball)
        if self._returned():
            return swing
        swing = swing._replace(cause=self._engine.cause)
        try:
            self._recover()
        except Refused as refused:
            raise return_failed(refused, swing) from None
        return swing

    def _rest_and_swing(self, profile: Profile, *, ball: bool) -> SeriesSwing:
        """Rest at the address and swing; take the address again after a stop there."""
        for _ in range(ADDRESS_TRIES - 1):
            self.rest()
            try:
                return self._swing(profile, len(profile.angle), ball=ball)
            except Refused:
                if not self._engine.cause:
                    raise
                self._recover()
        self.rest()
        return self._swing(profile, len(profile.angle), ball=ball)

    def _swing(self, profile: Profile, ticks: int, *, ball: bool) -> SeriesSwing:
        """Swing for `ticks` from the accepted request on."""
        engine, stepper, bench = self._engine, self._engine.stepper, self.bench
        stepper.parameters = with_tables_of(stepper.parameters, profile, bench.control, bench.plant)
        engine.begin_record()
        engine.await_air()  # a joint that breaks away may take the club to the ball
        engine.tee_up(ball=ball)
        before = float(engine.plant_state["air_used"][0])
        if not engine.start_swing(_REQUESTS, _CHUNK):
            raise engine.refusal("the robot does not come to rest there")
        cycles = joined([engine.latest, engine.advance(ticks - 1)])
        contact, site = contact_in(engine.plant_state), bench.plant.site
        delivery = contact and contact.delivery(bench.plant.robot, (site.ball_x, site.ball_y))
        used = float(engine.plant_state["air_used"][0]) - before
        settled, self._settled = self._settled, True
        return SeriesSwing(cycles, delivery, engine.cause, used, settled)

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
