"""A chamber with a throttled exhaust is reported by location, and a fault-free one never."""

from __future__ import annotations

from math import nan
from typing import Any

import numpy as np
import pytest

from bench.base.lifecycle import Cause, Phase, Refusal, Request, State
from bench.control.estimate.air import actuator_motion
from bench.control.estimate.estimator import ESTIMATOR_STATE
from bench.control.monitor.pressure_monitor import SWITCHING, air_fault
from bench.control.monitor.venting_monitor import LATE, MIN_EXHAUST_SHARE, exhaust_cause, monitor_exhausts
from bench.control.settings import holding_pressure
from bench.control.step_records import CONTROL_PARAMETERS, CONTROL_STATE
from drivers.base import CHAMBERS
from drivers.base.compiled import new_record
from drivers.base.records import READINGS
from sim.dynamics import chambers
from sim.plant import PlantParameters, build_plant
from tests.bench.control.operating import asked, press, reach
from tests.bench.control.puppet import ADDRESS, ATMOSPHERE, put
from tests.sampling import release_except

PARAMETERS = PlantParameters()
BUILT = build_plant(PARAMETERS)
HOLDING = holding_pressure(PARAMETERS)
TICK = 5e-3
BARELY_PASSED = 1.2 * MIN_EXHAUST_SHARE


class Exhausts:
    """The watch over chambers that empty through exhausts of which each passes a share of its area."""

    def __init__(self, shares: float | list[float], begin: float = 6e5, angle: Any = ADDRESS) -> None:
        """Begin with all chambers at `begin` (Pa), the joints resting at `angle` (rad)."""
        self.control, self.readings = new_record(CONTROL_STATE), new_record(READINGS)
        self.limits, self.estimator = new_record(CONTROL_PARAMETERS), new_record(ESTIMATOR_STATE)
        self.limits["lowest_pressure"], self.limits["highest_pressure"] = 1e4, 2e6
        self.limits["holding_pressure"] = HOLDING
        self.estimator["angle"] = angle
        self.plant = BUILT.plant.copy()
        self.plant["exhaust"][0, :6] = shares
        self.control["phase"], self.control["sensors"]["seen"] = Phase.STANDING, 1
        self.readings["supply_pressure"], self.readings["vent_open"] = ATMOSPHERE, 1.0
        self.pressure, self.rate = np.full(13, begin), np.zeros(13)
        self.pressure[12] = ATMOSPHERE
        self.shown = np.zeros(6)

    def run(self, seconds: float) -> Exhausts:
        """Vent for `seconds`."""
        plant, e = self.plant[0], self.estimator[0]
        for _ in range(round(seconds / TICK)):
            self.control["venting"]["timer"] += TICK
            vent = (
                plant["vent_conductance"]
                if self.control["venting"]["timer"][0] > plant["vent_delay"]
                else 0.0
            )
            for i in range(3):
                position, speed = actuator_motion(BUILT.robot, plant, e["angle"], e["velocity"], i)
                chambers(plant, i, self.pressure, self.rate, 0.0, position, speed, vent)
            self.pressure[6:12] += TICK * self.rate[6:12]
            self.control["sensors"]["shown"][0, 1:] = self.pressure[6:12] + self.shown
            monitor_exhausts(
                self.control[0], self.limits[0], BUILT.robot, BUILT.plant[0], e, self.readings, TICK
            )
        return self

    @property
    def found(self) -> list[int]:
        """Numbers of the chambers whose exhausts are too slow."""
        return np.flatnonzero(self.control["exhausts"]["slow"][0]).tolist()


POSES = {
    "address": ADDRESS,
    "top": ADDRESS + [-1.2, 0.0, -0.8],
    "follow-through": ADDRESS + [1.5, -0.3, 0.1],
}


@pytest.mark.parametrize("pose", POSES)
@pytest.mark.parametrize("share", release_except({BARELY_PASSED}, [1.0, 0.6, BARELY_PASSED]))
@pytest.mark.parametrize("begin", [2e5, 8e5])
def test_exhaust_monitor_share_above_slowest_reports_none(pose: str, share: float, begin: float) -> None:
    assert Exhausts(share, begin, POSES[pose]).run(10.0).found == []


@pytest.mark.parametrize("pose", release_except({"address"}, POSES))
@pytest.mark.parametrize("share", release_except({0.1}, [0.1, 0.01, 0.0]))
@pytest.mark.parametrize("chamber", range(6), ids=CHAMBERS)
def test_exhaust_monitor_throttled_exhaust_reports_chamber(pose: str, share: float, chamber: int) -> None:
    shares = [1.0] * 6
    shares[chamber] = share
    exhausts = Exhausts(shares, angle=POSES[pose]).run(6.0)
    assert exhausts.found == [chamber]
    assert exhaust_cause(exhausts.control["exhausts"][0]) == Cause.SHOULDER_A_EXHAUST + chamber
    assert air_fault(exhausts.control[0]) == 1 << (13 + chamber)


def test_exhaust_monitor_low_start_pressure_finds_throttled_vane_exhausts() -> None:
    """Exhausts of the large vane chambers; a chamber that leaks empty through its valve holds nothing up."""
    assert {0, 1} <= set(Exhausts(0.01, begin=1.12e5).run(5.0).found)


def test_exhaust_cause_fault_free_robot_reports_none() -> None:
    assert exhaust_cause(Exhausts(1.0).run(0.1).control["exhausts"][0]) == 0


@pytest.mark.parametrize(("zero", "found"), [(3e3, []), (8e3, [4])])
def test_exhaust_monitor_sensor_zero_error_reports_chamber(zero: float, found: list[int]) -> None:
    exhausts = Exhausts(1.0)
    exhausts.shown[4] = zero
    assert exhausts.run(10.0).found == found


@pytest.mark.parametrize(
    ("record", "values"),
    [
        ("control", {"phase": Phase.HOLD}),
        ("control", {"encoder_fault": Cause.ARM_ENCODER}),
        ("control", {"encoders_suspect": True}),
        ("control", {"sensors.seen": 0}),
        ("control", {"sensors.dead": 1}),
        ("estimator", {"angle": nan}),
        ("limits", {"home_by_index": True}),
        ("readings", {"vent_open": 0.0}),
    ],
    ids=str,
)
def test_exhaust_monitor_not_venting_or_unknown_reports_none(record: str, values: dict[str, Any]) -> None:
    exhausts = Exhausts(0.0)
    for name, value in values.items():
        put(getattr(exhausts, record), name, value)
    assert exhausts.run(8.0).found == []


def test_exhaust_monitor_starts_after_vent_delay() -> None:
    delay = PARAMETERS.supply.vent_delay + SWITCHING
    exhausts = Exhausts(0.0).run(delay - 2.0 * TICK)
    assert not exhausts.control["exhausts"]["late"].any()
    assert np.all(
        exhausts.control["exhausts"]["bound"][0, 6:12] == exhausts.control["sensors"]["shown"][0, 1:]
    )
    exhausts.run(LATE + 0.5)
    assert exhausts.found == [0, 1, 2, 3, 4, 5]


def test_exhaust_monitor_without_supply_sensor_reports_none() -> None:
    exhausts = Exhausts(1.0)
    exhausts.readings["supply_pressure"] = nan
    assert exhausts.run(10.0).found == []


def test_slow_exhaust_latches_fault_and_access_requires_press() -> None:
    puppet = reach(State.READY, vent_timeout=5.0, local_reset=True)
    puppet.control["exhausts"]["slow"][3] = 1
    puppet.tick()
    assert (puppet.bench, puppet.cause) == (State.FAULT, Cause.ARM_B_EXHAUST)
    assert puppet.cycle["air_fault"][0] == 1 << 16
    press(puppet)
    assert asked(puppet, Request.RESET) is Refusal.NONE
    assert puppet.cycle["air_fault"][0] == 0
    puppet.run(10)
    assert (puppet.bench, puppet.cause) == (State.READY, Cause.NONE)
    assert asked(puppet, Request.ACCESS) is Refusal.GAUGE
    press(puppet)
    assert asked(puppet, Request.ACCESS) is Refusal.NONE


@pytest.mark.parametrize("source", [State.ESTOP, State.FAULT], ids=lambda state: state.name)
def test_slow_exhaust_in_latched_state_replaces_cause(source: State) -> None:
    puppet = reach(source)
    puppet.control["exhausts"]["slow"][0] = 1
    puppet.tick()
    assert (puppet.bench, puppet.cause) == (source, Cause.SHOULDER_A_EXHAUST)
    puppet.give(chamber_pressure=(5e5,) * 6).run(300)  # after the time for venting
    assert puppet.cause is Cause.SHOULDER_A_EXHAUST
