"""Detection of an unnoticed fault by the next swing."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from bench.faults._case_run import next_swing
from bench.faults._verdict import CaseOutcome
from bench.faults.catalogue import Instant
from bench.faults.matrix import Workbench
from bench.faults.summary import next_swing_text
from sim.faults import Fault
from tests.compiled_only import needs_speed

HOLD = Instant("hold", 0)


@needs_speed
@pytest.mark.parametrize(
    ("name", "at", "cause"),
    [
        ("shoulder encoder × 0.9", "follow-through 10 %", "SHOULDER_FLOW"),
        ("arm valve stuck open, during an operator's stop", "top 50 % +200 ms", "ARM_FOLLOWING"),
        ("wrist encoder stuck, during an emergency stop", "backswing 10 % +60 ms", "WRIST_EFFORT"),
    ],
)
def test_next_swing_reports_undetected_fault(
    run: Callable[[str, str], CaseOutcome], name: str, at: str, cause: str
) -> None:
    outcome = run(name, at)
    assert (outcome.verdict, outcome.next_swing) == ("undetected", cause)


@needs_speed
def test_next_swing_detected_fault_is_skipped(run: Callable[[str, str], CaseOutcome]) -> None:
    outcome = run("arm encoder off", "downswing 20 %")
    assert (outcome.verdict, outcome.next_swing) == ("safe", "")


@needs_speed
def test_next_swing_fault_free_robot_strikes_ball(workbench: Workbench) -> None:
    bench = workbench.base(HOLD)
    assert next_swing(bench) == ""
    assert bench.plant_state["struck"][0]


@needs_speed
def test_next_swing_after_emergency_stop_strikes_ball(workbench: Workbench) -> None:
    bench = workbench.base(HOLD)
    bench.plant_state["emergency_stop_clear"] = False
    bench.advance(20_000)
    assert next_swing(bench) == ""
    assert bench.plant_state["struck"][0]


@pytest.mark.slow
@needs_speed
def test_next_swing_permanent_fault_reports_cause_or_refusal(workbench: Workbench) -> None:
    bench = workbench.base(HOLD)
    bench.stepper.break_with((Fault("guard", "guard closed", "stuck", 0.0),), watchdog=0.1)
    assert next_swing(bench) == "GUARD"
    assert next_swing(bench).startswith("reset refused: ")


def test_next_swing_text_counts_reported_faults() -> None:
    assert next_swing_text({"next_swing": {}}) == ""
    text = next_swing_text({"next_swing": {"SHOULDER_FLOW": 3, "": 1, "ARM_FLOW": 2}})
    assert text == "Of 6 undetected 5 are named before another ball is struck."
