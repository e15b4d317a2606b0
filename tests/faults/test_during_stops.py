"""A stop is also monitored: a fault during it gets its own reaction.

First comes the stop, then, in the middle of it, a valve or an encoder breaks.
"""

from __future__ import annotations

import numpy as np
import pytest

from bench.base.lifecycle import Cause, Reaction
from bench.faults.catalogue import Instant, instants_of
from bench.faults.matrix import Workbench
from bench.swing.profile import Profile
from sim.faults import Fault
from tests.benchmarks.during_stops import AS_THE_TABLE_SAYS, STOPS, stopped, unsafe
from tests.compiled_only import needs_speed
from tests.faults.made_matrix import instant
from tests.sampling import release_except

pytestmark = needs_speed


def broken(joint: str, opening: float, after: float) -> Fault:
    return Fault(f"{joint} valve", f"{joint} valve", "stuck", opening, time=after)


# Unmonitored, these stops ended at 125 to 387 % of a rating.
VALVES = (
    ("backswing 10 %", "operator stop", broken("shoulder", 1.0, 0.1)),
    ("backswing 10 %", "emergency stop", broken("shoulder", 1.0, 0.06)),
    ("downswing 20 %", "guard opened", broken("shoulder", 1.0, 0.03)),
    ("committed 60 %", "guard opened", broken("shoulder", -1.0, 0.01)),
    ("committed 60 %", "emergency stop", broken("shoulder", -1.0, 0.03)),
    ("impact +0 ms", "emergency stop", broken("shoulder", -1.0, 0.03)),
    ("follow-through 10 %", "guard opened", broken("shoulder", -1.0, 0.01)),
)


@pytest.mark.parametrize(
    ("at", "stop", "fault"), VALVES, ids=[f"{at}-{stop}-{fault.value:+.0f}" for at, stop, fault in VALVES]
)
def test_valve_stuck_open_during_stop_reacts_passive(
    workbench: Workbench, profile: Profile, at: str, stop: str, fault: Fault
) -> None:
    bench = stopped(workbench, instant(profile, at), stop, fault)
    cut = np.flatnonzero(bench.record()["reaction"] == Reaction.PASSIVE)
    assert len(cut)
    assert cut[0] - round(fault.time / bench.period) <= 80
    assert not unsafe(bench)


# Braked by the pattern of the instant at which the stop began, these ended at up to 178 % of a rating.
@pytest.mark.parametrize("joint", ["shoulder", "arm", "wrist"])
@pytest.mark.parametrize("after", [0.02, 0.055, 0.09, 0.15])
@pytest.mark.parametrize("ahead", [5, 35, 60])
def test_encoder_lost_during_brake_keeps_brake_of_other_joints(
    workbench: Workbench, profile: Profile, joint: str, after: float, ahead: int
) -> None:
    at = Instant("committed", round(profile.impact_time / profile.period) - ahead, f"-{ahead} ms")
    fault = Fault("encoder", f"{joint} encoder", "off", time=after)
    bench = stopped(workbench, at, "emergency stop", fault)
    assert not unsafe(bench)
    record, index = bench.record(), ["shoulder", "arm", "wrist"].index(joint)
    blind = record["reaction"] == Reaction.BLIND_BRAKE
    if not blind.any():  # 15 ms after the blow the arm's estimate runs away before its encoder counts as lost
        assert (joint, after, ahead) == ("arm", 0.02, 5)
        assert (record["reaction"] == Reaction.PASSIVE).any()
        return
    openings = np.abs(record["desired_valve"][blind])
    assert openings[:, index].max() == 0.0
    others = [i for i in range(3) if i != index]
    moving = np.abs(record["velocity"][blind][:, others]) > 1.0
    assert openings[:, others][moving].min(initial=1.0) > 0.0


@pytest.mark.parametrize("ahead", [12, 16, 20, 24])
def test_ball_struck_during_brake_is_no_fault(workbench: Workbench, profile: Profile, ahead: int) -> None:
    at = Instant("committed", round(profile.impact_time / profile.period) - ahead, f"-{ahead} ms")
    bench = stopped(workbench, at, "emergency stop", None)
    assert bench.plant_state["struck"][0]
    assert set(bench.record()["reaction"].tolist()) <= AS_THE_TABLE_SAYS
    assert bench.cause is Cause.EMERGENCY_STOP


@pytest.mark.parametrize("joint", ["shoulder", "arm", "wrist"])
def test_encoder_lost_during_brake_keeps_stop_share_low(
    workbench: Workbench, profile: Profile, joint: str
) -> None:
    fault = Fault("encoder", f"{joint} encoder", "off", time=0.2)
    bench = stopped(workbench, instant(profile, "downswing 80 %"), "guard opened", fault)
    assert not unsafe(bench)
    assert bench.loads().stop_share < 0.5


@pytest.mark.slow
@pytest.mark.parametrize("stop", release_except({"guard opened"}, STOPS))
def test_fault_free_stop_is_not_escalated(workbench: Workbench, profile: Profile, stop: str) -> None:
    for at in instants_of(profile):
        if at.phase not in ("standing", "homing", "return"):
            bench = stopped(workbench, at, stop, None)
            assert Cause(int(bench.control["latest_cause"][0])) is STOPS[stop], at
            assert set(bench.record()["reaction"].tolist()) <= AS_THE_TABLE_SAYS, at
