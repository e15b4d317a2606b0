"""Relief valves and the safety relay: what they action, and what their own faults do."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from bench.base.lifecycle import Request
from bench.config import Configuration, load_configuration
from bench.control.settings import build_controller
from bench.faults._verdict import CaseOutcome
from bench.faults.catalogue import Instant
from bench.faults.matrix import Workbench
from bench.simulation.plant_variation import healthy_plant, healthy_run
from bench.swing.library import find_profile
from bench.swing.profile import load_profile
from tests.compiled_only import needs_speed
from tests.faults.made_matrix import BREAKAGE, instant

pytestmark = needs_speed
Run = Callable[..., CaseOutcome]


@pytest.fixture(scope="module")
def high_speed() -> Workbench:
    file = find_profile("driver-130mph")
    profile = load_profile(file)
    c = load_configuration(Path("high_speed")).with_club(profile.club)
    checked: Configuration = c.for_profile(profile, file)
    return Workbench(checked, profile, model_check=True)


def highest_supply(workbench: Workbench) -> float:
    """Return the manifold's highest pressure in an undisturbed swing and its follow-through, Pa."""
    bench = workbench.base(Instant("hold", 0))
    shown = []
    for tick in range(len(workbench.profile.angle) + 500):
        bench.advance(1, Request.SWING if tick == 0 else Request.NONE)
        shown.append(float(bench.plant_state["supply_pressure"][0]))
    assert bench.cause == 0
    return max(shown)


@pytest.mark.release
@pytest.mark.parametrize("name", ["workbench", "high_speed"])
def test_manifold_pressure_fault_free_swing_stays_below_relief(
    name: str, request: pytest.FixtureRequest
) -> None:
    """Limits that were made without that valve hold with it."""
    workbench: Workbench = request.getfixturevalue(name)
    supply = workbench.plant.parameters.supply
    assert supply.pressure < highest_supply(workbench) + 1e3 < 0.95 * supply.manifold_relief_pressure


@pytest.mark.slow
def test_supply_surge_when_committed_limits_head_speed(high_speed: Workbench) -> None:
    """The manifold's relief valve bounds it: without one the head reached 106 %."""
    at = instant(high_speed.profile, "committed 10 %")
    case = high_speed.run(BREAKAGE["supply surging to 140 %"], at)
    assert (case.verdict, case.detected_by) == ("safe", "SUPPLY_PRESSURE")
    assert 1.0 < case.head_share < 1.05


@pytest.mark.parametrize("at", ["committed 10 %", "impact -10 ms"])
def test_chamber_relief_stuck_open_during_brake_keeps_brake(run: Run, at: str) -> None:
    """The other chamber fits by its own limit: no stuck spool, and no cut of the air that still brakes."""
    case = run("shoulder vane A relief stuck open", at)
    assert (case.verdict, case.detected_by, case.reaction) == ("safe", "SHOULDER_SENSOR", "BRAKE")
    assert case.stop_share < 0.9


def test_arm_valve_stuck_open_in_emergency_stop_is_safe(run: Run) -> None:
    case = run("arm valve stuck open, during an emergency stop", "backswing 90 % +60 ms")
    assert case.verdict == "safe", case.reasons


@pytest.mark.slow
@pytest.mark.parametrize("event", ["emergency stop", "guard opened"])
def test_safety_relay_welded_shut_stop_is_safe(run: Run, event: str) -> None:
    for at in ("hold", "downswing 80 %", "follow-through 10 %"):
        case = run(f"safety relay welded shut, then {event}", at)
        assert case.verdict in ("safe", "harmless"), (at, case.reasons)


def test_vents_stuck_shut_emergency_stop_opens_vents(workbench: Workbench) -> None:
    breakage = BREAKAGE["vents stuck shut, during an emergency stop"]
    bench = workbench.base(instant(workbench.profile, "top 50 % +100 ms"))
    bench.stepper.break_with(breakage.faults, watchdog=workbench.configuration.driver.watchdog)
    bench.plant_state["emergency_stop_clear"] = False
    bench.advance(6000)
    assert np.all(bench.plant_state["vent_open"][0] == 1)
    assert np.all(bench.plant_state["pressure"][0] < 1.5e5)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [90000, 90001, 90002, 90003])
def test_fault_free_emergency_stop_is_not_escalated(configuration: Configuration, seed: int) -> None:
    """Spools that braked on behind the relay let the arm fall, and its blow was taken for a wrong encoder."""
    c, profile = configuration, load_profile(find_profile("default"))
    parameters = build_controller(c.plant, profile, c.control, c.envelope, c.estimator)
    run = healthy_run(healthy_plant(c.plant, seed), parameters, profile, seed)
    assert run is not None
    assert run.escalated == ()
