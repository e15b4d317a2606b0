"""Sensors that read as fine: feedback that does not follow, and a manifold that does not empty as it must."""

from __future__ import annotations

from math import nan

import numba
import pytest

from bench.faults.catalogue import Breakage, Event, Instant
from bench.faults.matrix import Workbench
from sim.faults import Fault, Kind

pytestmark = pytest.mark.skipif(
    bool(numba.config.DISABLE_JIT), reason="whole swings take minutes without compilation"
)

HOLD, BEFORE, INSIDE = Instant("hold", 0), Instant("access", 0, "before"), Instant("access", 0, "inside")


def run(
    workbench: Workbench, signal: str, kind: Kind, value: float, instant: Instant, event: Event = ""
) -> tuple[str, str, int]:
    """Return verdict, detection and its ticks of one fault."""
    family = "access" if instant.phase == "access" else "one fault"
    breakage = Breakage(Fault(f"{signal} {kind}", signal, kind, value), event, family)  # type: ignore[arg-type]
    case = workbench.run(breakage, instant)
    return case.verdict, case.detected_by, case.detection_ticks


@pytest.mark.slow
@pytest.mark.parametrize("instant", [BEFORE, INSIDE], ids=lambda instant: instant.label)
def test_guard_locked_stuck_in_access_reports_guard_lock(workbench: Workbench, instant: Instant) -> None:
    verdict, found, _ = run(workbench, "guard locked", "stuck", 1.0, instant)
    assert (verdict, found) == ("safe", "GUARD_LOCK")


def test_supply_stuck_open_before_access_reports_supply_valve(workbench: Workbench) -> None:
    verdict, found, _ = run(workbench, "supply", "stuck", 1.0, BEFORE)
    assert (verdict, found) == ("safe", "SUPPLY_VALVE")


def test_supply_stuck_open_in_access_reports_manifold(
    workbench: Workbench,
) -> None:
    verdict, found, _ = run(workbench, "supply", "stuck", 1.0, INSIDE)
    assert (verdict, found) == ("safe", "MANIFOLD")  # once the guard is locked again


@pytest.mark.parametrize("signal", ["shut-off", "shut-off feedback"])
@pytest.mark.parametrize("instant", [BEFORE, INSIDE], ids=lambda instant: instant.label)
def test_shut_off_valve_stuck_open_reports_shut_off(
    workbench: Workbench, signal: str, instant: Instant
) -> None:
    verdict, found, _ = run(workbench, signal, "stuck", 1.0, instant)
    assert (verdict, found) == ("safe", "SHUT_OFF")


@pytest.mark.parametrize(
    ("kind", "value", "named"),
    [
        ("stuck", nan, {"SUPPLY_VALVE"}),
        ("stuck", 1e5, {"SUPPLY_DECAY", "SUPPLY_PRESSURE"}),
        ("slow", 0.5, {"SUPPLY_VALVE"}),
        ("scale", 0.7, {"SUPPLY_PRESSURE", "SUPPLY_SENSOR"}),
    ],
)
def test_supply_sensor_fault_before_access_reports_cause(
    workbench: Workbench, kind: Kind, value: float, named: set[str]
) -> None:
    verdict, found, _ = run(workbench, "supply sensor", kind, value, BEFORE)
    assert verdict == "safe"
    assert found in named


@pytest.mark.parametrize("time", [0.0, 0.1, 0.2, 0.3, 3.0])
def test_supply_sensor_jump_with_supply_stuck_open_is_safe(workbench: Workbench, time: float) -> None:
    first = Fault("supply sensor at 1 bar", "supply sensor", "stuck", 1.0e5, time=time)
    then = Fault("supply valve stuck open", "supply", "stuck", 1.0)
    case = workbench.run(Breakage(then, "stop", "latent pair", first), HOLD)
    assert case.verdict == "safe", case.reasons
