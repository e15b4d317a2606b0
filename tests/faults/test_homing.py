"""A valve stuck open in the search, where zeros are unknown and no model can detect it, loses its air."""

from __future__ import annotations

import numba
import pytest

from bench.faults.catalogue import Breakage, Instant
from bench.faults.matrix import Workbench
from sim.faults import Fault


@pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="minutes without compilation")
@pytest.mark.parametrize("value", [1.0, -1.0], ids=["open", "open in reverse"])
@pytest.mark.parametrize(("joint", "tick"), [("shoulder", 500), ("shoulder", 2500), ("arm", 500)])
def test_homing_valve_stuck_open_reacts_passive(
    workbench: Workbench, joint: str, tick: int, value: float
) -> None:
    fault = Fault(f"{joint} valve stuck", f"{joint} valve", "stuck", value)
    outcome = workbench.run(Breakage(fault), Instant("homing", tick, f"{tick} ms"))
    assert (outcome.verdict, outcome.reaction) == ("safe", "PASSIVE")
    assert outcome.reaction_ticks < 60  # chambers are filled gently, so little air drives the joint
