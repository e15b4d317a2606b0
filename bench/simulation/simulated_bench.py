"""Swings of the simulated bench, as its operator does them: arm, tee up, swing, watch the ball."""

from __future__ import annotations

import platform
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from datetime import datetime
from importlib.metadata import version
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bench.clock import FreeClock
from bench.control.settings import (
    SIMULATED,
    ControlSettings,
    EnvelopeSettings,
    EstimatorSettings,
    HomingSettings,
    build_controller,
)
from bench.control.step import ACCEPTED, ARM, DISARM, SWING, ControlState
from bench.errors import Refused
from bench.lifecycle import CAUSE_TEXT, Cause, Phase
from bench.loop import Cycle, Cycles, Loop, bring_to_rest
from bench.shot.recorded_shot import FlightConditions
from bench.shot.shot import Shot, ShotStatus
from bench.shot.shot_record import ShotRecord
from bench.simulation.lockstep import Lockstep
from bench.swing.profile import Profile
from bench.telemetry.cycle_record import CYCLE
from bench.telemetry.snapshot import SNAPSHOT, pack_snapshot
from bench.telemetry.swing_metadata import begin_of, profile_entry, since, snapshot_entry
from drivers.base import Launch
from drivers.base.compiled import new_record
from sim.ball import Ball
from sim.driver import SimDriver, hanging_pose
from sim.flight import Flight, fly
from sim.impact import Delivery, impact_parameters
from sim.plant import Plant, PlantParameters, build_plant, initial_state
from sim.truth import Contact, contact_in

Engine = Literal["python", "compiled"]
"""The Python cycle around the `sim` driver, or the compiled loop, three times as fast: bit-equal records."""

_CHUNK = 0.02
"""Time between two looks at the phase and at Ctrl-C, s."""
_LONGEST_ARMING = 15.0
_LONGEST_RETURN = 10.0
_LONGEST_STOP = 6.0
_LONGEST_SETTLING = 3.0
_SETTLING = 1.0
"""Time at the address before the instant at which all swings of an ArmedBench begin, s: until joints and
chambers rest, as before a swing of a running bench."""


@dataclass(frozen=True)
class SwingResult:
    """One swing: its record from hold to hold (or to standstill after a stop), and what came of it."""

    cycles: Cycles = field(repr=False, compare=False)
    """Records of CYCLE, `time` from about zero."""
    status: ShotStatus
    reason: str
    """Why the shot is not valid; empty when it is."""
    cause: Cause
    """What stopped the robot; NONE when nothing did."""
    interrupted: bool
    """Stopped by Ctrl-C before it was over."""
    club: str
    ball: Ball | None
    delivery: Delivery | None
    launch: Launch | None
    flight: Flight | None
    contact_time: float | None
    """s on the record's clock."""
    stop_energy: NDArray[np.float64]
    """Greatest energy taken by each cushion, (3, 2) J: lower and upper end of shoulder, right arm, wrist."""
    peak_pressure: NDArray[np.float64]
    """(6,) Pa absolute in the order of drivers.base.CHAMBERS."""
    lowest_clearance: float
    """Sole over ground, m."""
    peak_head_speed: float
    """m/s"""
    begin: float
    """The loop's time less the record's, s."""
    snapshot: NDArray[Any] = field(repr=False, compare=False)
    """The controller's memory after the record's first tick, one element of SNAPSHOT."""

    def replay_metadata(self) -> dict[str, Any]:
        """Return what a replay of the record needs, for its metadata."""
        return {"begin": self.begin, "snapshot": snapshot_entry(self.snapshot), "replayable": True}

    def shot(self, shot: int, *, block: int = 1, position: int = 1, time_utc: datetime) -> ShotRecord:
        """Return the swing as shot number `shot` of a series, with its record."""
        row = Shot.from_measurements(
            shot=shot,
            block=block,
            position=position,
            club=self.club,
            ball=self.ball.name if self.ball else "",
            time_utc=time_utc,
            delivery=self.delivery,
            launch=self.launch,
            flight=self.flight,
            status=self.status,
            reason=self.reason,
        )
        return ShotRecord(row, self.cycles, self.flight)


@dataclass(frozen=True)
class SimulatedBench:
    """What a simulated bench is made of, and how fast it may think; the defaults are the default plant's."""

    profile: Profile
    plant: PlantParameters = field(default_factory=PlantParameters)
    control: ControlSettings = field(default_factory=ControlSettings)
    envelope: EnvelopeSettings = field(default_factory=EnvelopeSettings)
    estimator: EstimatorSettings = field(default_factory=EstimatorSettings)
    surroundings: FlightConditions = field(default_factory=FlightConditions)
    engine: Engine = "compiled"
    start: tuple[float, float, float] | None = None
    """Joint angles before arming, rad; None is as the vented robot hangs."""
    hold: float = 0.3
    """Time at address before each swing, s."""

    def metadata(self, swing: Mapping[str, Any] | None = None) -> dict[str, Any]:
        """Return what is stored with a record: configuration, versions, seed, profile, and `swing`."""
        settings = ("plant", "control", "envelope", "estimator", "surroundings")
        names = ("golfbench", "numpy", "numba", "scipy")
        return {
            "configuration": {name: asdict(getattr(self, name)) for name in settings}
            | {"lifecycle": asdict(SIMULATED), "homing": asdict(HomingSettings())}
            | {"engine": self.engine, "hold": self.hold},
            "versions": {name: version(name) for name in names} | {"python": platform.python_version()},
            "seed": self.plant.seed,
            "profile": profile_entry(self.profile),
            **(swing or {}),
        }


def never() -> bool:
    """Tell that nobody asked to stop."""
    return False


def simulate_swing(
    bench: SimulatedBench, ball: Ball | None = None, *, stop: Callable[[], bool] = never
) -> SwingResult:
    """Arm a vented `bench`, swing once at `ball` (default: the plant's) and return what came of it.

    Raises:
        Refused: the robot does not reach its address.
        KeyboardInterrupt: `stop` became true before the swing's record began.
    """
    for result in simulate_swings(bench, [ball or bench.plant.ball], stop=stop):
        return result
    raise KeyboardInterrupt


def simulate_swings(
    bench: SimulatedBench, balls: Iterable[Ball | None], *, stop: Callable[[], bool] = never
) -> Iterator[SwingResult]:
    """Arm a vented `bench`, swing once at each of `balls` (None: no ball on the tee), then disarm.

    Yields each result as soon as the robot is back at address. A swing that ends in a stop is the last:
    nothing arms again by itself. When `stop` (the wish of `bench.interrupt.deferred_interrupt`) becomes
    true, the robot is brought to rest by the stopping table, the passive command is sent, and the result
    yielded last says `interrupted`, unless the robot was at address.

    Raises:
        Refused: the robot does not reach its address.
    """
    rig = _Rig(bench, stop)
    try:
        if not rig.arm():
            return
        for ball in balls:
            if stop():
                rig.rest()
                return
            result = rig.swing(ball)
            yield result
            if result.cause is not Cause.NONE or result.interrupted:
                return
        rig.step(1, DISARM)
    finally:
        rig.close()


def begin_swing(bench: SimulatedBench, ball: Ball | None) -> tuple[Lockstep, Cycles]:
    """Return `bench` (lock-step engine) as `simulate_swing` has it once the swing has begun.

    Beside it the record of the swing's first tick, which is done.

    Raises:
        Refused: the robot does not come to rest at its address.
    """
    rig = _Rig(bench, never)
    if not isinstance(rig.stepper, Lockstep):
        raise ValueError(f"engine {bench.engine!r} cannot be taken on tick by tick")
    rig.arm()
    if not rig.begin(ball):
        raise Refused(
            f"a swing with profile {bench.profile.name!r}",
            CAUSE_TEXT[rig.cause] if rig.cause else "the robot does not come to rest",
            "rest at address",
            "Check the profile's address and the gains.",
        )
    return rig.stepper, rig.latest


class ArmedBench:
    """A simulated bench that is armed once; each swing begins at that same instant.

    A swing then depends on its own `plant` and `ball` only, not on those before it: a series that was cut off
    goes on as if it had not been.
    """

    def __init__(self, bench: SimulatedBench, stop: Callable[[], bool] = never) -> None:
        """Arm `bench`, whose engine is the lock-step one.

        Raises:
            Refused: the robot does not reach its address.
            KeyboardInterrupt: `stop` became true before it did.
        """
        self._rig = rig = _Rig(bench, stop)
        if not isinstance(rig.stepper, Lockstep):
            raise ValueError(f"engine {bench.engine!r} cannot be set back")
        self._stepper: Lockstep = rig.stepper
        if not rig.arm():
            raise KeyboardInterrupt
        self._keep_instant()
        # Arming leaves other air in the closed chambers than a swing does: begin where a swing ends.
        if rig.swing(None).cause is Cause.NONE and rig.holding():
            rig.step(round(_SETTLING / rig.period))
            self._keep_instant()

    def _keep_instant(self) -> None:
        self._tick = self._stepper.tick
        self._instant = [array.copy() for array in self._arrays()]

    def _arrays(self) -> list[np.ndarray]:
        stepper = self._stepper
        return [stepper.plant_state, stepper.readings, stepper.command, *stepper.state]

    def swing(self, plant: PlantParameters, ball: Ball | None) -> SwingResult:
        """Swing at `ball` from the instant of arming, with the plant as it is at this shot."""
        rig, stepper = self._rig, self._stepper
        for array, then in zip(self._arrays(), self._instant, strict=True):
            array[...] = then
        stepper.tick = self._tick
        rig.bench = replace(rig.bench, plant=plant)
        rig.plant = stepper.plant = build_plant(plant)
        stepper.plant_state["random"] = initial_state(rig.plant, stepper.plant_state["angle"][0])["random"]
        return rig.swing(ball)


class _Rig:
    """A simulated bench while it is switched on."""

    def __init__(self, bench: SimulatedBench, stop: Callable[[], bool]) -> None:
        self.bench, self.stop = bench, stop
        self.plant: Plant = build_plant(bench.plant)
        self.period = bench.plant.tick
        parameters = build_controller(
            bench.plant, bench.profile, bench.control, bench.envelope, bench.estimator
        )
        start: ArrayLike = hanging_pose(bench.plant) if bench.start is None else bench.start
        self.driver: SimDriver | None = None
        self.cycle: Cycle | None = None
        self.stepper: Loop | Lockstep
        if bench.engine == "python":
            self.driver = SimDriver(self.plant, start)
            self.driver.open()
            self.cycle = Cycle(
                self.driver, parameters, lambda _: None, name="sim", note_truth=self.driver.note_truth
            )
            self.stepper, self.plant_state = Loop(self.cycle, FreeClock(self.period)), self.driver.plant_state
        else:
            lockstep = Lockstep(self.plant, parameters, np.asarray(start, dtype=float))
            self.stepper, self.plant_state = lockstep, lockstep.plant_state
        self.state: ControlState = self.stepper.state
        self._kept: list[Cycles] = []
        self._snapshot = new_record(SNAPSHOT)

    def step(self, ticks: int, request: int = 0) -> None:
        """Run `ticks` ticks and keep their records."""
        self._kept.append(self.stepper.advance(ticks, request))

    def run_until(self, reached: Callable[[], bool], longest: float) -> bool:
        """Run until `reached`, a standstill, Ctrl-C or `longest` (s); return whether it was `reached`."""
        chunk = round(_CHUNK / self.period)
        for _ in range(round(longest / _CHUNK)):
            if reached():
                return True
            if self.stop() or self.phase is Phase.STANDING:
                return False
            self.step(chunk)
        return reached()

    @property
    def phase(self) -> Phase:
        return Phase(int(self.state.control["phase"][0]))

    @property
    def cause(self) -> Cause:
        return Cause(int(self.state.control["cause"][0]))

    def request(self, request: int) -> bool:
        """Put `request` to one tick and return whether it was accepted."""
        self.step(1, request)
        return bool(self.state.control["answer"][0] == ACCEPTED)

    def holding(self) -> bool:
        control = self.state.control
        return self.phase is Phase.HOLD and not control["swinging"][0] and not control["reaction"][0]

    def arm(self) -> bool:
        """Charge the chambers and take the robot to its address; False when Ctrl-C came."""
        self.step(10)  # the estimators settle
        accepted = self.request(ARM)
        if not (accepted and self.run_until(self.holding, _LONGEST_ARMING)):
            if self.stop():
                self.rest()
                return False
            reason = CAUSE_TEXT[self.cause] if self.cause else "not there in time"
            angle = np.array2string(self.plant_state["angle"][0], precision=3)
            self.rest()
            raise Refused(
                f"arming with profile {self.bench.profile.name!r}",
                f"{reason}; joints at {angle} rad" if accepted else "the request refused",
                f"hold at address {np.array2string(self.bench.profile.angle[0], precision=3)} rad within "
                f"{_LONGEST_ARMING:g} s",
                "Check the profile's address against the plant, or start nearer to it.",
            )
        return True

    def rest(self) -> None:
        """Bring the robot to rest as the stopping table says and keep the records."""
        self._kept += bring_to_rest(self.stepper, round(_LONGEST_STOP / self.period))

    def swing(self, ball: Ball | None) -> SwingResult:
        """Tee `ball` up, swing, return to address, and look at what happened."""
        asked = self.begin(ball)
        back = asked and self.run_until(self.holding, self.bench.profile.duration + _LONGEST_RETURN)
        interrupted = self.stop()
        if interrupted or not back:
            self.rest()
        self.state.control["tee"] = False
        return self._result(ball, asked, interrupted and not back)

    def begin(self, ball: Ball | None) -> bool:
        """Tee `ball` up, hold at address and begin the swing; False when it was not to be had."""
        self._kept = []
        self._begin_tally()
        self._tee_up(ball)
        return self._settled()

    @property
    def latest(self) -> Cycles:
        """The records of the latest call of `step`."""
        return self._kept[-1]

    def _tee_up(self, ball: Ball | None) -> None:
        """Let the tee down, and raise it with `ball` if there is one."""
        self.state.control["tee"] = False
        self.step(1)
        self.plant_state["ball_present"] = self.plant_state["struck"] = False
        if ball is not None:
            parameters = self.bench.plant
            self.plant.impact[:] = impact_parameters(parameters.robot.club, ball, parameters.robot.lie)
            self.state.control["tee"] = True
        pack_snapshot(self.state, self._snapshot)

    def _settled(self) -> bool:
        """Hold at address, then begin the swing; False when it was not to be had."""
        ticks = round(self.bench.hold / self.period)
        for _ in range(1 + round(_LONGEST_SETTLING / max(self.bench.hold, _CHUNK))):
            self.step(max(ticks, 1))
            if self.stop() or not self.holding():
                return False
            if self.request(SWING):
                return True
        return False

    def _begin_tally(self) -> None:
        """Begin to count extremes anew; the plant's motion does not depend on them."""
        state = self.plant_state
        state["stop_energy"] = state["stop_depth"] = 0.0
        state["peak_pressure"] = state["pressure"]
        state["peak_head_speed"], state["lowest_clearance"] = 0.0, np.inf

    def _result(self, ball: Ball | None, asked: bool, interrupted: bool) -> SwingResult:
        # As bytes: numpy joins records field by field and leaves their padding to chance.
        cycles = np.concatenate([part.view(np.uint8) for part in self._kept]).view(CYCLE)
        begin = begin_of(cycles)
        cycles = since(cycles, begin)
        club, robot, site = self.bench.plant.robot.club, self.bench.plant.robot, self.bench.plant.site
        contact = contact_in(self.plant_state)
        delivery = launch = flight = None
        reason = _trouble(self.cause, interrupted, asked, ball, contact)
        if self.cycle is not None and (error := self.cycle.read_error or self.cycle.publish_error):
            reason += f" ({error})"
        if contact is not None and ball is not None:
            delivery = contact.delivery(robot, (site.ball_x, site.ball_y))
            launch = contact.launch
            around = self.bench.surroundings
            try:
                flight = fly(launch, around.air, ball, around.wind, around.turf)
            except ValueError as error:
                reason = reason or f"no flight: {error}"
        state = self.plant_state[0]
        return SwingResult(
            cycles=cycles,
            status=ShotStatus.FAILED if reason else ShotStatus.VALID,
            reason=reason,
            cause=self.cause,
            interrupted=interrupted,
            club=club.name,
            ball=ball,
            delivery=delivery,
            launch=launch,
            flight=flight,
            contact_time=None if contact is None else contact.time - begin,
            stop_energy=state["stop_energy"].copy(),
            peak_pressure=state["peak_pressure"].copy(),
            lowest_clearance=float(state["lowest_clearance"]),
            peak_head_speed=float(state["peak_head_speed"]),
            begin=begin,
            snapshot=self._snapshot.copy(),
        )

    def close(self) -> None:
        """Switch the bench off."""
        self.stepper.make_passive()
        if self.driver is not None:
            self.driver.close()


def _trouble(cause: Cause, interrupted: bool, asked: bool, ball: Ball | None, contact: Contact | None) -> str:
    """Return why the swing gave no valid shot, or nothing."""
    if interrupted:
        return "interrupted by Ctrl-C"
    if cause is not Cause.NONE:
        return CAUSE_TEXT[cause]
    if not asked:
        return "the robot did not come to rest at address"
    if ball is None:
        return "no ball on the tee"
    return "" if contact is not None else "the club missed the ball"
