"""A commissioned machine behind a driver in lock-step, and the simulated one.

Time is counted in ticks and given to the driver, as the loop does; the simulated plant advances with it.
"""

from __future__ import annotations

from typing import Any, Self

import numpy as np

from bench.commissioning.machine import (
    Array,
    MotionBounds,
    MotionTrace,
    Segment,
    Until,
    bound_passed,
)
from bench.commissioning.wrong_machine import WrongMachine
from bench.errors import Refused
from bench.simulation.loads import Loads, loads_of
from drivers.base import CHAMBERS, JOINTS, PASSIVE, READINGS, Command, Driver
from drivers.base.compiled import new_record
from drivers.base.contract import RecordReader
from sim.driver import SimDriver
from sim.faults import Fault
from sim.plant import PlantParameters, build_plant

_SPEED_SPAN = 5
"""Ticks over which a speed is taken."""
_REST = 5e-4
"""rad by which a joint at rest moves at most."""
_EMPTY = 0.1e5
"""Pa above the atmosphere at which a chamber counts as empty."""
_LOOK = 0.4
"""s without motion after which a vented robot rests."""


class DriverMachine:
    """Runs sequences on a driver whose time is given, one tick after the other."""

    def __init__(self, driver: Driver, believed: PlantParameters) -> None:
        """Open `driver`, a RecordReader, too; tick, encoders and atmosphere are those of `believed`."""
        if not isinstance(driver, RecordReader):
            raise TypeError("a driver that gives its readings as records is needed")
        self._driver, self._reader, self._tick = driver, driver, believed.tick
        self._counts = believed.encoders.counts_per_revolution
        self._atmosphere = believed.supply.atmosphere
        self._number = 0
        self._readings = new_record(READINGS)
        self._applied = Command()
        driver.open()
        self._read()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._driver.close()

    @property
    def time(self) -> float:
        """Time of the machine since it was opened, s."""
        return self._number * self._tick

    def make_passive(self) -> None:
        """Centre the spools, shut the supply, open the vents."""
        self._driver.make_passive()
        self._applied = Command()

    def vent(self, duration: float = 40.0) -> MotionTrace:
        """Be passive until chambers are empty and joints rest, for at most `duration` (s).

        Raises:
            WrongMachine: the chambers are not empty then.
        """
        self.make_passive()
        most, look = round(duration / self._tick), round(_LOOK / self._tick)
        log = _Log(most, self._counts)
        for k in range(most):
            log.note(self._readings, self._applied, 0)
            self._next()
            self._driver.write(PASSIVE)
            empty = np.max(self._readings["chamber_pressure"][0]) < self._atmosphere + _EMPTY
            if k >= look and k % 50 == 0 and empty and log.rested(look):
                break
        fullest = int(np.argmax(self._pressure()))
        if self._pressure()[fullest] > self._atmosphere + 3.0 * _EMPTY:
            raise WrongMachine(
                "vents",
                f"{1e-5 * self._pressure()[fullest]:.2f} bar in {CHAMBERS[fullest]} after {duration:g} s",
                "empty chambers",
                "The vents stay shut, a throttle is blocked or the sensor is off. Mind the air inside.",
            )
        return log.trace("", (False,))

    def run(self, segments: tuple[Segment, ...], bounds: MotionBounds) -> MotionTrace:
        """Run `segments` with the supply on; afterwards the last openings stay in force."""
        most = round(min(sum(s.duration for s in segments), bounds.duration) / self._tick)
        log = _Log(most + 1, self._counts)
        ended: list[bool] = []
        tripped = ""
        for number, segment in enumerate(segments):
            tripped, met = self._segment(segment, number, bounds, log)
            ended.append(met)
            if tripped:
                break
        return log.trace(tripped, tuple(ended))

    def _segment(self, segment: Segment, number: int, bounds: MotionBounds, log: _Log) -> tuple[str, bool]:
        """Run one segment; return the bound that was passed and whether its condition ended it."""
        ticks = max(round(segment.duration / self._tick), 1)
        begin, end = np.array(segment.valve), np.array(segment.end or segment.valve)
        for k in range(ticks):
            if log.full:
                self.make_passive()
                return f"duration, bound {bounds.duration:g} s", False
            opening = np.clip(begin + (end - begin) * (k / ticks), -bounds.opening, bounds.opening)
            self._write(opening, segment.vents_shut)
            log.note(self._readings, self._applied, number)
            passed = bound_passed(bounds, log.speed(self._tick), log.way(), self._pressure())
            if passed:
                self.make_passive()
                return passed, False
            self._next()
            if segment.until is not None and self._met(segment.until, log, k):
                return "", True
        return "", False

    def _met(self, until: Until, log: _Log, k: int) -> bool:
        if until.kind == "above":
            return bool(self._pressure()[until.number] >= until.level)
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

    def _next(self) -> None:
        """Go on by one tick, in which the command in force is repeated for the device's watchdog."""
        self._number += 1
        self._read()

    def _read(self) -> None:
        self._reader.read_record(self.time, self._readings)
        self._require_usable()

    def _require_usable(self) -> None:
        """Make the machine passive and refuse to go on without interlocks, encoders or pressures."""
        r = self._readings[0]
        problem = cure = ""
        if not r["emergency_stop_clear"]:
            problem, cure = "the emergency stop is pressed", "Clear it, then continue with --resume."
        elif not (r["guard_closed"] and r["guard_locked"]):
            problem, cure = "the guard is open", "Close it, then continue with --resume."
        elif not self._driver.operational:
            problem, cure = "the device went passive by its watchdog", "Check its link, then --resume."
        elif not all(r["encoder_valid"]):
            lost = ", ".join(JOINTS[i] for i in range(3) if not r["encoder_valid"][i])
            problem, cure = f"no valid reading of the encoder of {lost}", "Check its plug and cable."
        elif not np.isfinite(r["supply_pressure"]):
            problem, cure = "no reading of the supply's pressure", "Check the sensor and its cable."
        elif not np.all(np.isfinite(r["chamber_pressure"])):
            lost = ", ".join(CHAMBERS[k] for k in range(6) if not np.isfinite(r["chamber_pressure"][k]))
            problem = f"no pressure of {lost}"
            cure = "Fit chamber sensors, or check their cables: commissioning measures the air by them."
        if problem:
            self.make_passive()
            raise Refused("commission", problem, "a machine that reads and may move", cure)


class _Log:
    """Rows of a sequence as they come."""

    def __init__(self, rows: int, counts: int) -> None:
        self._rows, self._counts, self._n = rows, counts, 0
        self._count = np.zeros((rows, 3), np.int64)
        self._first = np.zeros(3, np.int64)
        self._time, self._supply = np.zeros(rows), np.zeros(rows)
        self._pressure, self._valve = np.zeros((rows, 6)), np.zeros((rows, 3))
        self._shut, self._segment = np.zeros(rows, bool), np.zeros(rows, np.int64)

    @property
    def full(self) -> bool:
        """Whether no row is left."""
        return self._n >= self._rows

    def note(self, readings: np.ndarray[Any, Any], command: Command, segment: int) -> None:
        """Add a row."""
        r, n = readings[0], self._n
        count = np.asarray(r["encoder_count"], np.int64)
        if n == 0:
            self._first = count.copy()
        else:
            before = self._count[n - 1] + self._first
            half = self._counts // 2
            self._count[n] = self._count[n - 1] + (count - before + half) % self._counts - half
        self._time[n], self._supply[n] = r["time"], r["supply_pressure"]
        self._pressure[n], self._valve[n] = r["chamber_pressure"], command.valve
        self._shut[n], self._segment[n] = command.exhaust_closed, segment
        self._n = n + 1

    def way(self) -> Array:
        """Return the way (3,) rad since the first row."""
        return np.asarray(self._count[max(self._n - 1, 0)] * (2 * np.pi / self._counts))

    def speed(self, tick: float) -> Array:
        """Return the speeds (3,) rad/s over the last ticks."""
        if self._n <= _SPEED_SPAN:
            return np.zeros(3)
        change = self._count[self._n - 1] - self._count[self._n - 1 - _SPEED_SPAN]
        return np.asarray(change * (2 * np.pi / self._counts / (_SPEED_SPAN * tick)))

    def rested(self, span: int, joint: int | None = None) -> bool:
        """Return whether `joint`, or each, has rested for `span` rows."""
        if self._n <= span:
            return False
        counts = self._count[self._n - 1 - span : self._n]
        counts = counts if joint is None else counts[:, [joint]]
        return bool(np.max(np.ptp(counts, axis=0)) * (2 * np.pi / self._counts) < _REST)

    def trace(self, tripped: str, ended: tuple[bool, ...]) -> MotionTrace:
        """Return the rows."""
        n = self._n
        return MotionTrace(
            self._time[:n],
            self._first,
            self._count[:n],
            self._pressure[:n],
            self._supply[:n],
            self._valve[:n],
            self._shut[:n],
            self._segment[:n],
            tripped,
            ended,
        )


class SimulatedMachine(DriverMachine):
    """The simulated plant: a robot that is truly swung, with its faults."""

    def __init__(
        self, truth: PlantParameters, believed: PlantParameters, faults: tuple[Fault, ...] = ()
    ) -> None:
        """Stand vented and hanging: `truth` moves, with `faults`; the bench believes in `believed`."""
        self.driver = SimDriver(build_plant(truth), faults=faults, seed=truth.seed)
        super().__init__(self.driver, believed)
        self._truth = truth

    @property
    def loads(self) -> Loads:
        """Loads since it was switched on."""
        return loads_of(self.driver.plant_state, self._truth)

    def set_supply(self, pressure: float) -> None:
        """Turn the simulated regulator to `pressure` (Pa absolute), at most to that of service."""
        regulated = min(pressure, self._truth.supply.pressure)
        self.driver.plant.plant["regulated"] = regulated
        if self.driver.faults is not None:  # a fault of the supply refers to the healthy value
            self.driver.faults.healthy_plant["regulated"] = regulated
