"""A pneumatic fault is reported by location, and elapsed time alone never gives access."""

from __future__ import annotations

import numba
import pytest

from bench.base.lifecycle import Cause
from bench.faults.catalogue import Breakage, Instant
from bench.faults.matrix import Workbench
from drivers.base import CHAMBERS
from sim.faults import Fault

pytestmark = pytest.mark.skipif(
    bool(numba.config.DISABLE_JIT), reason="whole swings take minutes without compilation"
)

HOLD = Instant("hold", 0)
SENSORS = {"supply sensor": Cause.SUPPLY_SENSOR} | {
    f"{chamber} sensor": Cause(Cause.SHOULDER_A_SENSOR + k) for k, chamber in enumerate(CHAMBERS)
}


@pytest.mark.parametrize("signal", SENSORS)
def test_pressure_sensor_off_at_address_reports_cause(workbench: Workbench, signal: str) -> None:
    case = workbench.run(Breakage(Fault(f"{signal} off", signal, "off")), HOLD)
    assert case.verdict == "safe", case.reasons
    assert case.detected_by == SENSORS[signal].name
    assert case.detection_ticks <= 150


@pytest.mark.parametrize("signal", ["vent 1", "vent 2", "vent 1 feedback", "vent 2 feedback"])
def test_vent_stuck_shut_reports_cause_and_is_safe(workbench: Workbench, signal: str) -> None:
    value = 1.0 if signal in ("vent 1", "vent 2") else float("nan")
    case = workbench.run(Breakage(Fault(f"{signal} stuck", signal, "stuck", value), event="stop"), HOLD)
    assert (case.verdict, case.detected_by) == ("safe", "VENT_1" if "1" in signal else "VENT_2"), case.reasons


@pytest.mark.parametrize("signal", ["vent 1", "vent 2", "vent 1 feedback", "vent 2 feedback"])
def test_vent_stuck_open_blocks_arming(workbench: Workbench, signal: str) -> None:
    value = 0.0 if signal in ("vent 1", "vent 2") else 1.0  # of the vent its command, of its switch "open"
    fault = Fault(f"{signal} stuck open", signal, "stuck", value)
    case = workbench.run(Breakage(fault), Instant("standing", 0))
    assert (case.verdict, case.detected_by) == ("safe", "VENT_1" if "1" in signal else "VENT_2"), case.reasons
    assert case.head_share < 0.1


@pytest.mark.slow
def test_vents_stuck_shut_record_not_vented_until_rest(workbench: Workbench) -> None:
    """Both vents are held shut: the arm creeps as the air leaks, long after the chambers seem empty."""
    fault = Fault("vents stuck shut", "vents", "stuck", 1.0)
    case = workbench.run(Breakage(fault, "stop"), Instant("backswing 50 %", 425))
    assert case.verdict == "safe", case.reasons
    assert "NOT_VENTED" in case.record
    assert case.rest_ticks > 10_000
    assert "moved" not in " ".join(case.reasons)
