"""A commissioned machine that stops reports whether the device or the computer is the reason."""

from __future__ import annotations

import math
import pickle
import re
from typing import Any

import numpy as np
import pytest

from bench.base.errors import Refused
from bench.commissioning.machine.driver_machine import DriverMachine, LongStall, Stalled
from bench.commissioning.machine.machine import MotionBounds, MotionTrace, Segment
from drivers.base import INVALID, Command
from sim.driver import SimDriver
from sim.plant import PlantParameters, build_plant

PLANT = PlantParameters()
BOUNDS = MotionBounds((10.0, 10.0, 20.0), (3.0, 3.0, 5.0), 9e5)


class FaultyDriver(SimDriver):
    """Goes passive with a `fault`."""

    fault = ""

    @property
    def operational(self) -> bool:
        return not self.fault


class JumpingClock:
    """Ticks one after the other; the hundredth comes `stall` s late, and `driver` is passive then."""

    def __init__(self, driver: FaultyDriver, stall: float) -> None:
        self._driver, self._stall = driver, stall
        self._ticks, self._now = 0, 0.0

    def wait(self) -> float:
        self._ticks += 1
        self._now += PLANT.tick
        if self._ticks == 100:
            self._now += self._stall
            self._driver.fault = "node 10 reports error 8250h"
        return self._now


@pytest.mark.parametrize(
    ("stall", "error", "found", "action"),
    [
        (0.0, Refused, r"went passive: node 10 reports error 8250h$", "link"),
        (
            0.06,
            Stalled,
            r"went passive: node 10 .*, after this program stood still for 61 ms",
            "golfbench doctor",
        ),
    ],
)
def test_driver_machine_passive_driver_reports_earlier_stall(
    stall: float, error: type[Refused], found: str, action: str
) -> None:
    driver = FaultyDriver(build_plant(PLANT))
    clock = JumpingClock(driver, stall)
    with DriverMachine(driver, PLANT, clock) as machine:  # type: ignore[arg-type]  # a clock that jumps
        with pytest.raises(Refused) as refused:
            machine.run((Segment(0.3, (0.0, 0.0, 0.0)),), BOUNDS)
        assert type(refused.value) is error
        assert re.search(found, refused.value.found)
        assert action in refused.value.action


class ReopenedDriver(FaultyDriver):
    """Goes passive again whenever it is opened, but for the last of `opened` times."""

    opened = 0

    def open(self) -> None:
        super().open()
        self.fault = self.fault if self.opened else ""
        self.opened -= 1


@pytest.mark.parametrize("inputs", ["read", "low"])
def test_driver_machine_late_while_reopened_reports_stall(inputs: str) -> None:
    """Three seconds pass between the stall and the refusal; inputs of a passive device may read low."""
    driver = ReopenedDriver(build_plant(PLANT))
    with DriverMachine(driver, PLANT, JumpingClock(driver, 0.06)) as machine:  # type: ignore[arg-type]
        driver.opened = 1
        with pytest.raises(Stalled):
            machine.run((Segment(0.3, (0.0, 0.0, 0.0)),), BOUNDS)
        driver.plant_state["guard_closed"] = inputs == "read"
        with pytest.raises(Stalled, match="passive: node 10"):
            machine.vent()
        driver.plant_state["guard_closed"] = True
        machine.vent()


class UnsampledDriver(FaultyDriver):
    """Its encoders are not sampled in the first 3 ms after it is opened."""

    opened_at = math.nan

    def open(self) -> None:
        super().open()
        self.fault, self.opened_at = "", math.nan

    def read_record(self, time: float, record: np.ndarray[Any, Any]) -> None:
        super().read_record(time, record)
        self.opened_at = time if math.isnan(self.opened_at) else self.opened_at
        if time < self.opened_at + 0.003:
            record["encoder_valid"], record["encoder_time"] = 0, math.nan


@pytest.mark.parametrize("doing", ["watch", "run"])
def test_driver_machine_reopened_awaits_samples_of_encoders(doing: str) -> None:
    driver = UnsampledDriver(build_plant(PLANT))
    with DriverMachine(driver, PLANT) as machine:
        driver.fault = "node 10 reports error 8250h"
        if doing == "watch":
            machine.watch(Command(supply_enable=True, beacon=True), None, math.inf, 0.1, 0.2)
        else:
            assert machine.run((Segment(0.1, (0.0, 0.0, 0.0)),), BOUNDS).tripped is None


@pytest.mark.parametrize(("stall", "error"), [(0.5, Stalled), (5.0, LongStall)])
def test_driver_machine_stall_reports_whether_guard_may_have_been_open(
    stall: float, error: type[Refused]
) -> None:
    driver = FaultyDriver(build_plant(PLANT))
    with DriverMachine(driver, PLANT, JumpingClock(driver, stall)) as machine:  # type: ignore[arg-type]
        with pytest.raises(Stalled) as stalled:
            machine.run((Segment(0.3, (0.0, 0.0, 0.0)),), BOUNDS)
        assert type(pickle.loads(pickle.dumps(stalled.value))) is error  # noqa: S301


@pytest.mark.parametrize(("stall", "permitted"), [(0.5, True), (600.0, False)])
def test_driver_machine_time_without_readings_voids_local_reset(stall: float, permitted: bool) -> None:
    driver = FaultyDriver(build_plant(PLANT))
    clock = JumpingClock(driver, stall)
    with DriverMachine(driver, PLANT, clock, local_reset=True) as machine:  # type: ignore[arg-type]
        for level in (False, True, False):
            driver.plant_state["local_reset"] = level
            for _ in range(10):
                machine.hold()
        assert machine.may_move()
        for _ in range(100):
            machine.hold()
        assert machine.may_move() is permitted


class SilentDriver(SimDriver):
    """Its first `silent` encoders give no readings for 4 ms; pressures come again 40 ms later."""

    silent = 3

    def read_record(self, time: float, record: np.ndarray[Any, Any]) -> None:
        super().read_record(time, record)
        if 0.1 <= time < 0.104:
            record["encoder_valid"][0, : self.silent] = 0
        if 0.104 <= time < 0.144:
            record["supply_pressure"] = INVALID


@pytest.mark.parametrize(("silent", "error"), [(3, Stalled), (2, Refused), (0, Refused)])
def test_driver_machine_pressures_lost_with_all_encoders_raise_stalled(
    silent: int, error: type[Refused]
) -> None:
    driver = SilentDriver(build_plant(PLANT))
    driver.silent = silent
    with DriverMachine(driver, PLANT) as machine:
        with pytest.raises(Refused) as refused:
            machine.run((Segment(0.3, (0.0, 0.0, 0.0)),), BOUNDS)
        assert type(refused.value) is error
        assert "supply" in refused.value.found
        assert ("all encoders were silent at once" in refused.value.found) is (silent == 3)


def test_driver_machine_venting_after_stall_waits_for_pressures() -> None:
    with DriverMachine(SilentDriver(build_plant(PLANT)), PLANT) as machine:
        with pytest.raises(Stalled):
            machine.run((Segment(0.3, (0.0, 0.0, 0.0)),), BOUNDS)
        machine.vent()
        machine.run((Segment(0.3, (0.0, 0.0, 0.0)),), BOUNDS)


class LateClock:
    """Ticks one after the other; number `late` comes 15 ms late."""

    def __init__(self, late: int = -1) -> None:
        self._late, self._ticks, self._now = late, 0, 0.0

    def wait(self) -> float:
        self._ticks += 1
        self._now += PLANT.tick + (0.015 if self._ticks == self._late else 0.0)
        return self._now


def test_driver_machine_speed_after_late_tick_is_no_faster() -> None:
    moved = (Segment(0.4, (0.12, 0.0, 0.0)),)
    traces: list[MotionTrace] = []
    for late, bound in ((-1, 20.0), (400, 1.3)):
        fastest = np.abs(np.diff(traces[0].count[:, 0])).max() if traces else 0.0
        speed = bound * max(fastest * 2 * np.pi / PLANT.encoders.counts_per_revolution / PLANT.tick, 1.0)
        clock = LateClock(late)
        with DriverMachine(SimDriver(build_plant(PLANT)), PLANT, clock) as machine:  # type: ignore[arg-type]
            traces.append(machine.run(moved, MotionBounds((speed, 50.0, 50.0), (3.0, 3.0, 5.0), 9e5)))
    assert len(traces[1].time) == len(traces[0].time) + 15
    assert [trace.tripped for trace in traces] == [None, None]
