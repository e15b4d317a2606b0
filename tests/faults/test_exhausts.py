"""A clogged silencer or a kinked hose: no access to an arm held up by air, even with open vents."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from bench.base.lifecycle import Request
from bench.control.settings import holding_pressure
from bench.faults._verdict import CaseOutcome
from bench.faults.catalogue import CATALOGUE
from bench.faults.matrix import Workbench
from sim.faults import Fault, own_records
from tests.compiled_only import needs_speed
from tests.faults.made_matrix import instant
from tests.sampling import release_except

pytestmark = needs_speed

Run = Callable[..., CaseOutcome]
THROTTLED = [b.fault for b in CATALOGUE if b.family == "access" and "exhaust" in b.fault.signal]
SAMPLE = {
    "shoulder exhaust at 10 %",
    "manifold exhaust at 0 %",
    "exhausts at 30 %",
    "exhausts at 1 %",
    "exhausts at 0 %",
}
INSTANTS = ("hold", "follow-through 10 %", "follow-through 80 %")


@pytest.mark.slow
@pytest.mark.parametrize("name", release_except({"follow-through 10 %"}, INSTANTS))
@pytest.mark.parametrize("share", release_except({0.1}, [0.2, 0.1, 0.03]))
def test_throttled_exhausts_guard_unlocks_below_holding_pressure(
    workbench: Workbench, name: str, share: float
) -> None:
    """The person presses the button again and again, and reads no gauge."""
    bench = workbench.base(instant(workbench.profile, name))
    bench.stepper.plant = own_records(bench.stepper.plant)
    bench.stepper.break_with((Fault("throttled", "exhausts", "scale", share),))
    bench.advance(1, Request.STOP)
    plant, holding = bench.plant_state, holding_pressure(workbench.configuration.plant)
    for count in range(4000):
        plant["local_reset"] = count % 2 == 0
        if not bench.advance(100, Request.ACCESS)["guard_lock"][-1]:
            break
    else:
        pytest.fail("the guard stays locked")
    assert plant["pressure"][0].max() <= holding
    before = plant["angle"][0].copy()
    moved = np.abs(bench.advance(60_000)["plant_angle"] - before).max()
    assert moved <= 0.02


@pytest.mark.slow
@pytest.mark.parametrize(
    "fault", release_except(SAMPLE, THROTTLED, lambda fault: fault.name), ids=lambda fault: fault.name
)
def test_exhaust_fault_in_swing_is_safe_and_reports_cause(run: Run, fault: Fault) -> None:
    """A verdict counts pressure and motion behind a released guard; trapped air may leave arms elsewhere."""
    case = run(fault, "follow-through 40 %", "stop")
    assert case.verdict == "safe" or case.reasons == (case.change,)
    named = "SUPPLY_VALVE" if fault.signal == "manifold exhaust" else "_EXHAUST"
    assert named in case.detected_by + case.record


@pytest.mark.parametrize("at", ["backswing 50 %", "backswing 90 %", "top 50 %"])
def test_wrist_chamber_exhaust_clogged_reports_exhaust_cause(run: Run, at: str) -> None:
    """The wrist falls while it vents: its small chamber is above the bound for a quarter of a second."""
    case = run(Fault("clogged", "wrist cylinder A exhaust", "scale", 0.1), at, "stop")
    assert (case.verdict, case.detected_by) == ("safe", "WRIST_A_EXHAUST")
