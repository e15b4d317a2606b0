"""Some of the faults of `python -m tests.benchmarks canopen_reactions`, each in one phase."""

from __future__ import annotations

import pytest

from bench.config import Configuration
from bench.lifecycle import Phase, Reaction
from tests.benchmarks.canopen_reactions import FAULTS, run_case
from tests.sampling import release_except

CASES = {
    "positions doubled": (Phase.COMMITTED, Reaction.NONE),
    "an encoder's positions missing": (Phase.DOWNSWING, Reaction.BLIND_BRAKE),
    "the valve node tells of an error": (Phase.BACKSWING, Reaction.PASSIVE),
    "no room any more (ENOBUFS)": (Phase.TOP, Reaction.PASSIVE),
    "bus-off": (Phase.IMPACT, Reaction.PASSIVE),
    "the bench silent": (Phase.COMMITTED, Reaction.PASSIVE),
}


@pytest.mark.parametrize(
    "fault", release_except({"the bench silent", "an encoder's positions missing"}, CASES)
)
def test_the_valve_node_reacts_in_time_and_nothing_breaks(configuration: Configuration, fault: str) -> None:
    phase, reaction = CASES[fault]
    case = run_case(configuration, fault, phase)
    longest = FAULTS[fault].longest
    assert case.reaction is reaction
    assert not case.unsafe
    assert case.ticks == -1 if longest is None else 0 <= case.ticks <= longest
