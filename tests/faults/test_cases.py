"""Single cases: pneumatic faults, sensors that read as fine, and valves stuck in the search."""

from __future__ import annotations

from collections.abc import Callable
from math import nan

import pytest

from bench.base.lifecycle import Cause
from bench.faults._verdict import CaseOutcome
from bench.faults.catalogue import Breakage, Instant
from bench.faults.matrix import Workbench
from drivers.base import CHAMBERS
from sim.faults import Fault, Kind
from tests.compiled_only import needs_speed
from tests.sampling import release_except

pytestmark = needs_speed

Run = Callable[..., CaseOutcome]
RELEASE = pytest.mark.release
BEFORE, INSIDE = Instant("access", 0, "before"), Instant("access", 0, "inside")
SENSORS = {"supply sensor": Cause.SUPPLY_SENSOR} | {
    f"{chamber} sensor": Cause(Cause.SHOULDER_A_SENSOR + k) for k, chamber in enumerate(CHAMBERS)
}


def fault(signal: str, kind: Kind, value: float = nan) -> Fault:
    return Fault(f"{signal} {kind}", signal, kind, value)


@pytest.mark.parametrize(
    "signal", release_except({"supply sensor", "shoulder vane A sensor", "wrist cylinder B sensor"}, SENSORS)
)
def test_pressure_sensor_off_at_address_reports_cause(run: Run, signal: str) -> None:
    case = run(fault(signal, "off"), "hold")
    assert (case.verdict, case.detected_by) == ("safe", SENSORS[signal].name), case.reasons
    assert case.detection_ticks <= 150


@pytest.mark.parametrize("signal", ["vent 1", "vent 2", "vent 1 feedback", "vent 2 feedback"])
def test_vent_stuck_shut_or_open_reports_cause(run: Run, signal: str) -> None:
    """Stuck shut at a stop, and stuck open: the command of a vent, the position of a switch."""
    valve, expected = "feedback" not in signal, ("safe", "VENT_1" if "1" in signal else "VENT_2")
    shut = run(fault(signal, "stuck", 1.0 if valve else nan), "hold", "stop")
    assert (shut.verdict, shut.detected_by) == expected, shut.reasons
    opened = run(fault(signal, "stuck", 0.0 if valve else 1.0), "standing")
    assert (opened.verdict, opened.detected_by) == expected, opened.reasons
    assert opened.head_share < 0.1, "arming is blocked"


@pytest.mark.slow
def test_vents_stuck_shut_record_not_vented_until_rest(run: Run) -> None:
    """Both vents are held shut: the arm creeps as the air leaks, long after the chambers seem empty."""
    case = run(fault("vents", "stuck", 1.0), Instant("backswing 50 %", 425), "stop")
    assert case.verdict == "safe", case.reasons
    assert "NOT_VENTED" in case.record
    assert case.rest_ticks > 10_000
    assert "moved" not in " ".join(case.reasons)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("signal", "kind", "value", "at", "causes"),
    [
        pytest.param("guard locked", "stuck", 1.0, BEFORE, "GUARD_LOCK", marks=pytest.mark.slow),
        pytest.param("guard locked", "stuck", 1.0, INSIDE, "GUARD_LOCK", marks=pytest.mark.slow),
        pytest.param("supply", "stuck", 1.0, BEFORE, "SUPPLY_VALVE", marks=RELEASE),
        ("supply", "stuck", 1.0, INSIDE, "MANIFOLD"),  # once the guard is locked again
        ("shut-off", "stuck", 1.0, BEFORE, "SHUT_OFF"),
        pytest.param("shut-off", "stuck", 1.0, INSIDE, "SHUT_OFF", marks=RELEASE),
        pytest.param("shut-off feedback", "stuck", 1.0, BEFORE, "SHUT_OFF", marks=RELEASE),
        ("shut-off feedback", "stuck", 1.0, INSIDE, "SHUT_OFF"),
        pytest.param("supply sensor", "stuck", nan, BEFORE, "SUPPLY_VALVE", marks=RELEASE),
        ("supply sensor", "stuck", 1e5, BEFORE, "SUPPLY_DECAY SUPPLY_PRESSURE"),
        pytest.param("supply sensor", "slow", 0.5, BEFORE, "SUPPLY_VALVE", marks=RELEASE),
        pytest.param(
            "supply sensor", "scale", 0.7, BEFORE, "SUPPLY_PRESSURE SUPPLY_SENSOR", marks=pytest.mark.release
        ),
    ],
)
def test_fault_around_access_reports_cause(
    run: Run, signal: str, kind: Kind, value: float, at: Instant, causes: str
) -> None:
    case = run(fault(signal, kind, value), at)
    assert case.verdict == "safe"
    assert case.detected_by in causes.split()


@pytest.mark.parametrize("time", release_except({0.1, 3.0}, [0.0, 0.1, 0.2, 0.3, 3.0]))
def test_supply_sensor_jump_with_supply_stuck_open_is_safe(workbench: Workbench, time: float) -> None:
    first = Fault("supply sensor at 1 bar", "supply sensor", "stuck", 1.0e5, time=time)
    breakage = Breakage(fault("supply", "stuck", 1.0), "stop", "latent pair", first)
    case = workbench.run(breakage, Instant("hold", 0))
    assert case.verdict == "safe", case.reasons


@pytest.mark.parametrize("value", release_except({-1.0}, [1.0, -1.0]), ids=["open", "open in reverse"])
@pytest.mark.parametrize(("joint", "tick"), [("shoulder", 500), ("shoulder", 2500), ("arm", 500)])
def test_homing_valve_stuck_open_reacts_passive(run: Run, joint: str, tick: int, value: float) -> None:
    """In the search zeros are unknown and no model can detect it: the valve loses its air."""
    case = run(fault(f"{joint} valve", "stuck", value), Instant("homing", tick, f"{tick} ms"))
    assert (case.verdict, case.reaction) == ("safe", "PASSIVE")
    assert case.reaction_ticks < 60  # chambers are filled gently, so little air drives the joint
