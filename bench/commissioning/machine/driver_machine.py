"""A commissioned machine behind a driver, and the simulated one.

Time comes from a clock, as the loop's does: a free one in lock-step, where the simulated plant advances with
it, the wall's with a robot. Between two sequences `hold` repeats the last command tick by tick.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from math import inf, isfinite
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from bench.base.clock import Clock, FreeClock
from bench.base.errors import Refused
from bench.commissioning.machine.commissioning_step import MachineFault
from bench.commissioning.machine.inputs import SIMULATED_TIMEOUT, Act, OperatorIO, levels, without_press
from bench.commissioning.machine.machine import (
    ADRIFT,
    Array,
    LoggedMotion,
    MotionBounds,
    MotionLog,
    MotionTrace,
    PassedBound,
    Segment,
    Until,
    bound_passed,
)
from bench.loop.loop import record_reading
from bench.simulation.safety import Loads, loads_of
from bench.simulation.swing_operator import never
from drivers.base import ABSENT, CHAMBERS, JOINTS, PASSIVE, Command, Driver, Readings
from drivers.base.compiled import new_record
from drivers.base.records import READINGS, unpack_readings
from sim.driver import SimDriver
from sim.faults import Fault, turn_regulator
from sim.plant import PlantParameters, build_plant

_SPEED_SPAN = 5
"""Ticks over which a speed is taken."""
_EMPTY = 0.1e5
"""Pressure above the atmosphere at which a chamber counts as empty (Pa)."""
_LOOK = 0.4
"""Time without motion after which a vented robot rests (s)."""
_LOST = 5
"""Ticks for which sensors may fail in a row: a bus may lose a frame."""
_STALL, _STALL_FELT = 5.0, 0.5
"""Ticks without one that are a stall, and the time after one for which it explains lost readings (s)."""
_UNWATCHED = 1.0
"""Time without readings in which a guard may have been opened and shut (s)."""
_STIRRED = 0.05
"""Max movement of a measured robot's joint while the spools are centred with air on (rad)."""
_READY = 3.0
"""Timeout of an opened device's first readings and of the guard's lock (s)."""


_RESUME = "continue with --resume."
"""Action of what ended a step of `golfbench commission`."""


class Stalled(Refused):
    """A stall of the computer ended a motion; its step can be repeated."""


class LongStall(Stalled):
    """A stall in which persons may have been at the machine."""


REPEATS = 9
"""Max repetitions of a step or stage that a stall of the computer ended."""


class StoppedByPerson(Refused):
    """A person stopped the robot, or opened its guard; the step is repeated only by a new command."""


def stopped_by_person(
    location: str = "commission", action: str = _RESUME, found: str = "stopped by the operator"
) -> StoppedByPerson:
    """Return the error of a motion that was asked to end."""
    return StoppedByPerson(location, found, "a motion without a stop", action[0].upper() + action[1:])


class _Fault(NamedTuple):
    """Why a machine may not move; without text it may."""

    text: str = ""
    action: str = ""
    lasting: bool = False
    """Whether the machine stops at its first tick, not after `_LOST` ticks."""
    of_device: bool = False
    """Whether a stall of the machine may be its reason."""


class DriverMachine:
    """Runs sequences on a driver whose time is given, one tick after the other."""

    def __init__(
        self,
        driver: Driver,
        believed: PlantParameters,
        clock: Clock | None = None,
        *,
        warning: float = 0.0,
        stop: Callable[[], bool] = never,
        inputs_only: bool = False,
        local_reset: bool = False,
    ) -> None:
        """Open `driver`; tick, encoders and atmosphere are those of `believed`.

        Its ticks come from `clock`, by default as fast as they are computed. The beacon warns for `warning`
        (s) before air comes on, and what runs ends once `stop` says so. `inputs_only`: it only watches its
        inputs, for which no pressure sensors and no closed interlocks are needed. `local_reset`: one is
        fitted, and pressed before motions.

        Raises:
            Refused: the device gives no readings, or an interlock is open.
        """
        self._driver, self._read_record, self._tick = driver, record_reading(driver), believed.tick
        self._clock, self._warning, self._stop = clock or FreeClock(believed.tick), warning, stop
        self._counts = believed.encoders.counts_per_revolution
        self._atmosphere = believed.supply.atmosphere
        self._now = self._began = 0.0
        self._failed, self._fault, self._inputs_only = 0, _Fault(), inputs_only
        self._place = "check of the inputs" if inputs_only else "commission"
        self._again = "begin again." if inputs_only else _RESUME
        self._local_reset, self._reset_was_low, self._permitted = local_reset, False, not local_reset
        self._stall, self._stalled_at, self._long_stall = "", 0.0, False
        """The last stall in words, its end (s), and whether a guard may have been opened and shut in it."""
        self._seen = deque[tuple[NDArray[np.int64], Array]](maxlen=_SPEED_SPAN + 1)
        """Counts (3,) and times of the samples (3,), s, of the last ticks since the device was opened and all
        encoders were sampled."""
        self._readings = new_record(READINGS)
        self._readings["chamber_pressure"] = self._readings["supply_pressure"] = ABSENT
        self._applied = Command()
        self._bounds: MotionBounds | None = None
        self._has_run = False
        """Whether air is on by `run`, not by `watch`, which expects open interlocks."""
        self._dropped: Refused | None = None
        """Error that made the machine passive between two motions since it was last vented."""
        driver.open()
        self._await_tick()
        self._began = self._stalled_at = self._now
        self._read()
        self._await_readings()
        self._stall = ""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._driver.close()

    @property
    def time(self) -> float:
        """Time of the machine since it was opened, s."""
        return self._now - self._began

    def may_move(self) -> bool:
        """Return whether a fitted local reset was pressed since guard or emergency stop last opened."""
        return self._permitted

    def make_passive(self) -> None:
        """Centre the spools, shut the supply, open the vents."""
        self._driver.make_passive()
        self._applied, self._bounds = Command(), None

    def hold(self) -> None:
        """Repeat the last command for a tick; passive from then on if a bound is passed or readings fail."""
        bounds, still, held = self._bounds, np.zeros(3), self._applied.supply_enable and self._has_run
        try:
            self._applied = self._driver.write(self._applied)
            self._next(stoppable=False)  # the next order is no stop
            passed = None if bounds is None else bound_passed(bounds, self._speed(), still, self._pressure())
            if passed:
                self.make_passive()
                action = "Look for a valve that moves without a command, or an encoder that jumps."
                raise MachineFault("robot between two motions", passed.text, "rest", action)
        except Refused as error:
            if held:
                self._dropped = error

    def vent(self, duration: float = 40.0) -> MotionTrace:
        """Return the trace of `vent_logged`, with its errors."""
        return self.vent_logged(duration).trace()

    def vent_logged(self, duration: float) -> LoggedMotion:
        """Be passive until chambers are empty and joints rest, for at most `duration` (s).

        Raises:
            MachineFault: the chambers are not empty then.
        """
        self.make_passive()
        self._dropped = None
        self._revive()
        most, look = round(duration / self._tick), round(_LOOK / self._tick)
        log = MotionLog(most, self._counts)
        for k in range(most):
            log.note(self._readings, self._applied, 0)
            self._next()
            self._driver.write(PASSIVE)
            empty = np.max(self._readings["chamber_pressure"][0]) < self._atmosphere + _EMPTY
            if k >= look and k % 50 == 0 and empty and log.rested(look):
                break
        fullest = int(np.argmax(self._pressure()))
        if not self._pressure()[fullest] <= self._atmosphere + 3.0 * _EMPTY:
            shown = self._pressure()[fullest]
            found = f"{1e-5 * shown:.2f} bar" if np.isfinite(shown) else "no valid pressure"
            found += f" in {CHAMBERS[fullest]} after {duration:g} s"
            action = "The vents stay shut, a throttle is blocked or the sensor is off. Mind the air inside."
            raise MachineFault("vents", found, "empty chambers", action)
        return log.motion(None, (False,), self._tick)

    def watch(
        self, command: Command, before: Readings | None, air: float, settled: float, timeout: float
    ) -> Readings:
        """Hold `command` until the switches differ from `before`, if given, and rested for `settled` (s).

        After `timeout` (s) the last readings are returned whatever they are, and at once with more than
        `air` (Pa absolute) in the manifold; the machine is passive then. An open interlock ends
        nothing: interlocks are watched.

        Raises:
            Refused: the device fails, or it was stopped.
            MachineFault: a joint moves with air on and the guard closed; one of a robot that is to be
                measured, whose spools may be off their centres, faster than `ADRIFT` allows.
        """
        self._has_run = False
        if not self._driver.operational:
            self._revive(interlocks=False)
        begun = changed = self._now
        last, start = None if before is None else levels(before), self._seen[-1][0]
        while True:
            self._applied = self._driver.write(command)
            self._bounds = ADRIFT if command.supply_enable else None
            self._next(interlocks=False)
            readings = unpack_readings(self._readings)
            if command.supply_enable and readings.guard_closed:
                self._require_spools_centred(start)
            if isfinite(readings.supply_pressure) and readings.supply_pressure > air:
                self.make_passive()
                return readings
            if (now := levels(readings)) != last:
                last, changed = now, self._now
            differs = before is None or now != levels(before)
            if (differs and self._now - changed >= settled) or self._now - begun >= timeout:
                return readings

    def _require_spools_centred(self, start: NDArray[np.int64]) -> None:
        """Make the machine passive and raise MachineFault if a joint moves, from counts `start`."""
        way = np.abs(self._turned(start))
        joint = JOINTS[int(np.argmax(way))]
        if self._inputs_only:
            found = f"the joint moves by {way.max():.2f} rad" if way.max() > _STIRRED else ""
        else:
            passed = bound_passed(ADRIFT, self._speed(), way, self._pressure())
            found = passed.text if passed else ""
        if not found:
            return
        self.make_passive()
        action = "Adjust its centre by the maker's manual, or look for a stuck spool."
        raise MachineFault(f"{joint} valve", f"{found} with the spools centred", "rest", action)

    def run(self, segments: tuple[Segment, ...], bounds: MotionBounds, doing: str = "") -> MotionTrace:
        """Return the trace of `run_logged`, with its errors."""
        return self.run_logged(segments, bounds).trace()

    def run_logged(self, segments: tuple[Segment, ...], bounds: MotionBounds) -> LoggedMotion:
        """Run `segments` with the supply on; afterwards the last openings stay in force.

        Raises:
            Refused: the machine may not move, or became passive since the last motion: its joints are no
                longer where a step left them, and persons may have been at it. Begin with venting.
        """
        if self._dropped is not None:
            raise self._dropped
        self._has_run = True
        if not self._applied.supply_enable:
            if not self._permitted:
                raise without_press()
            self._revive()
            self._warn()
        self._bounds = bounds
        most = round(min(sum(s.duration for s in segments), bounds.duration) / self._tick)
        log = MotionLog(most + 1, self._counts)
        ended: list[bool] = []
        tripped = None
        for number, segment in enumerate(segments):
            tripped, met = self._segment(segment, number, bounds, log)
            ended.append(met)
            if tripped:
                break
        return log.motion(tripped, tuple(ended), self._tick)

    def _segment(
        self, segment: Segment, number: int, bounds: MotionBounds, log: MotionLog
    ) -> tuple[PassedBound | None, bool]:
        """Run one segment; return the bound that was passed and whether its condition ended it."""
        ticks = max(round(segment.duration / self._tick), 1)
        begin, end = np.array(segment.valve), np.array(segment.end or segment.valve)
        for k in range(ticks):
            if log.full:
                self.make_passive()
                return PassedBound(f"duration, bound {bounds.duration:g} s"), False
            opening = np.clip(begin + (end - begin) * (k / ticks), -bounds.opening, bounds.opening)
            self._write(opening, segment.vents_shut)
            log.note(self._readings, self._applied, number)
            passed = bound_passed(bounds, self._speed(), log.way(), self._pressure())
            if passed:
                self.make_passive()
                return passed, False
            self._next()
            if segment.until is not None and self._met(segment.until, log, k):
                return None, True
        return None, False

    def _met(self, until: Until, log: MotionLog, k: int) -> bool:
        if until.kind == "above":
            return bool(until.level <= self._pressure()[until.number] < np.inf)
        if until.kind == "moved":
            return bool(abs(log.way()[until.number]) >= until.level)
        span = round(until.level / self._tick)
        return k >= span and k % 20 == 0 and log.rested(span, until.number)

    def _pressure(self) -> Array:
        return np.asarray(self._readings["chamber_pressure"][0])

    def _write(self, opening: Array, vents_shut: bool) -> None:
        a, b, c = opening.tolist()
        command = Command(valve=(a, b, c), supply_enable=True, exhaust_closed=vents_shut, beacon=True)
        self._applied = self._driver.write(command)

    def _warn(self) -> None:
        """Warn with the beacon, everything else passive."""
        for _ in range(round(self._warning / self._tick)):
            self._driver.write(Command(beacon=True))
            self._next()

    def _revive(self, *, interlocks: bool = True) -> None:
        """Open a device again that went passive by its watchdog; wait for readings lost in a stall."""
        if not self._driver.operational:
            self._driver.close()
            self._driver.open()
            self._seen.clear()
            self._read()
        elif not self._fault.text:
            return
        self._await_readings(interlocks=interlocks)

    def _await_readings(self, *, interlocks: bool = True) -> None:
        """Send the passive command until the machine may move, with open `interlocks` until it reads.

        Raises:
            Stalled: a stall of the computer explains why it may not.
            Refused: it may not, and what to do.
        """
        begun = self._now
        for _ in range(round(_READY / self._tick)):
            if self._inputs_only or not interlocks:
                self._fault = self._device_failure()
            if not self._fault.text:
                self._failed = 0
                return
            self._driver.write(PASSIVE)
            self._await_tick()
            self._read()
        self._refuse_to_go_on(begun)

    def _next(self, *, interlocks: bool = True, stoppable: bool = True) -> None:
        """Continue for one tick; open `interlocks` end it, or not.

        Raises:
            Refused: the machine is passive, as an interlock is open, readings fail, or it was stopped.
        """
        self._await_tick()
        self._read()
        if not interlocks:
            self._fault = self._device_failure()
        fault = self._fault
        self._failed = self._failed + 1 if fault.text else 0
        if fault.text and (fault.lasting or self._failed > _LOST):
            self._refuse_to_go_on()
        if stoppable and self._stop():
            self.make_passive()
            raise stopped_by_person(self._place, self._again)

    def _await_tick(self) -> None:
        """Wait for the next tick, and note a stall before it."""
        before, self._now = self._now, self._clock.wait()
        if self._now - before > _STALL * self._tick:
            duration = f"{1e3 * (self._now - before):.0f} ms"
            self._stall = f"this program stood still for {duration}, a stall of the computer"
            self._stalled_at, self._long_stall = self._now, self._now - before > _UNWATCHED
            if self._long_stall:  # the guard may have been opened and shut meanwhile
                self._permitted = not self._local_reset

    def _read(self) -> None:
        """Take the readings, and note presses of the local reset; guard or emergency stop makes them void."""
        self._read_record(self._now, self._readings)
        self._fault = self._problem()
        r, level = self._readings[0], self._readings["local_reset"][0]
        closed = r["guard_closed"] and r["emergency_stop_clear"]
        permitted = closed and (self._permitted or (level and self._reset_was_low))
        self._permitted = bool(permitted or not self._local_reset)
        # Inputs that do not arrive read low: after them a stuck button would give an edge.
        self._reset_was_low = bool(not level and closed and self._driver.operational)
        seen, age = self._readings["encoder_valid"][0] != 0, self._readings["encoder_age"][0]
        if not np.any(seen & (age < _STALL * self._tick)):
            # Not a cable: it takes one. Pressures come more rarely, and are missed for longer.
            self._stall = (
                "all encoders were silent at once, by a fault of their bus or, with simulated nodes, a stall "
                "of the computer"
            )
            self._stalled_at = self._now
        counts, times = self._readings["encoder_count"][0], self._readings["encoder_time"][0]
        if np.isfinite(times).all():
            self._seen.append((np.array(counts, np.int64), np.array(times)))

    def _speed(self) -> Array:
        """Return the joints' speeds (3,) between the samples of the last ticks, rad/s."""
        counts, times = self._seen[0]
        return self._turned(counts) / np.maximum(self._seen[-1][1] - times, self._tick)

    def _turned(self, start: NDArray[np.int64]) -> Array:
        """Return the turn (3,) of the joints since the counts `start`, rad, at most half a turn."""
        half = self._counts // 2
        change = (self._seen[-1][0] - start + half) % self._counts - half
        return np.asarray(change * (2 * np.pi / self._counts))

    def _refuse_to_go_on(self, since: float = inf) -> None:
        """Make the machine passive; a stall after `since` (s), or one just now, explains a failed device.

        Raises:
            Stalled: a stall of the computer explains it.
            Refused: otherwise.
        """
        self.make_passive()
        expected, text, action = "a machine that reads and may move", self._fault.text, self._fault.action
        if self._fault.of_device and self._stall and self._stalled_at >= min(since, self._now) - _STALL_FELT:
            text = f"{text}, after {self._stall}"
            action = f"End other programs, look at the bus, see golfbench doctor, then {self._again}"
            raise (LongStall if self._long_stall else Stalled)(self._place, text, expected, action)
        raise Refused(self._place, text, expected, action)

    def _problem(self) -> _Fault:
        """Return why the machine may not move."""
        r = self._readings[0]
        if not self._driver.operational:  # its inputs may read low
            return self._device_failure()
        if not r["emergency_stop_clear"]:
            return _Fault("the emergency stop is pressed", f"Clear it, then {_RESUME}", True)
        if not (r["guard_closed"] and r["guard_locked"]):
            return _Fault("the guard is open", f"Close it, then {_RESUME}", True)
        return self._device_failure()

    def _device_failure(self) -> _Fault:
        """Return the failure of the device or of its sensors."""
        r = self._readings[0]
        if not self._driver.operational:
            fault = getattr(self._driver, "fault", "") or "its watchdog, or its link"
            action = f"Check its link, then {self._again}"
            return _Fault(f"the device went passive: {fault}", action, lasting=True, of_device=True)
        if not all(r["encoder_valid"]):
            lost = ", ".join(JOINTS[i] for i in range(3) if not r["encoder_valid"][i])
            text = f"no valid reading of the encoder of {lost}"
            return _Fault(text, "Check its plug and cable.", of_device=True)
        if self._inputs_only:
            return _Fault()
        if not np.isfinite(r["supply_pressure"]):
            text = "no reading of the supply's pressure"
            return _Fault(text, "Check the sensor and its cable.", of_device=True)
        if not np.all(np.isfinite(r["chamber_pressure"])):
            lost = ", ".join(CHAMBERS[k] for k in range(6) if not np.isfinite(r["chamber_pressure"][k]))
            action = "Fit chamber sensors, or check their cables: commissioning measures the air by them."
            return _Fault(f"no pressure of {lost}", action, of_device=True)
        return _Fault()


class SimulatedMachine(DriverMachine):
    """The simulated plant: a robot that is truly swung, with its faults."""

    def __init__(
        self,
        truth: PlantParameters,
        believed: PlantParameters,
        faults: tuple[Fault, ...] = (),
        *,
        inputs_only: bool = False,
        local_reset: bool = False,
    ) -> None:
        """Stand vented and hanging: `truth` moves, with `faults`; the bench believes in `believed`."""
        self.driver = SimDriver(build_plant(truth), faults=faults, seed=truth.seed)
        super().__init__(self.driver, believed, inputs_only=inputs_only, local_reset=local_reset)
        self._truth = truth

    @property
    def loads(self) -> Loads:
        """Loads since it was switched on."""
        return loads_of(self.driver.plant_state, self._truth)

    def set_supply(self, pressure: float) -> None:
        """Turn the simulated regulator to `pressure` (Pa absolute), at most to that of service."""
        turn_regulator(self.driver.plant, self.driver.faults, pressure)

    @property
    def hands(self) -> OperatorIO:
        """Hands at the simulated plant; the gauge at the manifold is true."""
        state, atmosphere = self.driver.plant_state, self._truth.supply.atmosphere

        def act(act: Act) -> None:
            state[act.field] = act.value

        def gauge() -> float:
            return float(state["supply_pressure"][0]) - atmosphere

        return OperatorIO(self.set_supply, act=act, gauge=gauge, timeout=SIMULATED_TIMEOUT)
