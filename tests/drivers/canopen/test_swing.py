"""A whole swing over CANopen, in step: the delivery is the one of the `sim` driver."""

from __future__ import annotations

import random
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from bench.base.lifecycle import Cause, Phase, Reaction
from bench.config import Configuration
from sim.sensors import Contact, contact_in
from tests.benchmarks.canopen_reactions import FAULTS, run_case
from tests.drivers.canopen.in_step import WITH_SPOOLS
from tests.drivers.canopen.swing_in_step import SwingBench, on_canopen, on_plant
from tests.sampling import release_except

CASES = {
    "positions doubled": (Phase.COMMITTED, Reaction.NONE),
    "an encoder's positions missing": (Phase.DOWNSWING, Reaction.BLIND_BRAKE),
    "the valve node reports an error": (Phase.BACKSWING, Reaction.PASSIVE),
    "no room any more (ENOBUFS)": (Phase.TOP, Reaction.PASSIVE),
    "bus-off": (Phase.IMPACT, Reaction.PASSIVE),
    "the bench silent": (Phase.COMMITTED, Reaction.PASSIVE),
}


@pytest.mark.slow
@pytest.mark.parametrize(
    "fault", release_except({"the bench silent", "an encoder's positions missing"}, CASES)
)
def test_canopen_fault_reaction_in_time_is_safe(configuration: Configuration, fault: str) -> None:
    phase, reaction = CASES[fault]
    case = run_case(configuration, fault, phase)
    longest = FAULTS[fault].longest
    assert case.reaction is reaction
    assert not case.unsafe
    assert case.ticks == -1 if longest is None else 0 <= case.ticks <= longest


@pytest.fixture(scope="module")
def by_sim(configuration: Configuration) -> Contact:
    return swung(on_plant(configuration))


def swung(bench: SwingBench) -> Contact:
    """Swing; return how the ball was struck."""
    record = bench.swing()
    cause = Cause(int(bench.cycle.state.control["cause"][0]))
    assert (cause, bench.cycle.phase) == (Cause.NONE, Phase.HOLD)
    # The shoulder is what a bad estimate of its acceleration holds back.
    fast = record[np.isin(record["phase"], (Phase.COMMITTED, Phase.IMPACT))]
    assert np.abs(fast["reference_angle"] - fast["angle"])[:, 0].max() < 0.06
    contact = contact_in(bench.state)
    assert contact is not None
    return contact


def assert_alike(found: Contact, expected: Contact, speed: float) -> None:
    """Compare speed (relative), strike (m, along and across the plane) and the face's angle (rad)."""
    assert np.hypot(*found.head_velocity[:2]) == pytest.approx(
        np.hypot(*expected.head_velocity[:2]), rel=speed
    )
    assert found.head == pytest.approx(expected.head, abs=0.01)


@pytest.mark.slow
def test_canopen_swing_delivery_matches_sim_driver(configuration: Configuration, by_sim: Contact) -> None:
    bench, driver, _ = on_canopen(configuration)
    assert_alike(swung(bench), by_sim, speed=0.03)
    counters = driver.counters
    assert (counters.missing, counters.late, counters.duplicates, driver.fault) == (0, 0, 0, "")


@pytest.mark.slow
def test_swing_over_bus_with_spool_feedback_not_stopped(
    configuration: Configuration, by_sim: Contact
) -> None:
    fitted = replace(configuration, plant=replace(configuration.plant, spool_feedback=True))
    bench, driver, _ = on_canopen(fitted, WITH_SPOOLS)
    assert_alike(swung(bench), by_sim, speed=0.03)
    assert driver.fault == ""
    assert np.isfinite(bench.kept.cycles["spool_position"]).all()


@pytest.mark.release
def test_canopen_swing_lost_positions_keep_delivery(configuration: Configuration, by_sim: Contact) -> None:
    bench, driver, wire = on_canopen(configuration)
    chance = random.Random(5)
    wire.meddle = lambda identifier, data: (
        [] if identifier in (0x281, 0x282, 0x283) and chance.random() < 1e-3 else [(identifier, data)]
    )
    assert_alike(swung(bench), by_sim, speed=0.1)
    assert driver.counters.missing > 10


@pytest.mark.release
def test_canopen_swing_stamp_errors_keep_delivery(configuration: Configuration, by_sim: Contact) -> None:
    bench, _, wire = on_canopen(configuration)
    wire.stamp_error = partial(random.Random(5).gauss, 0.0, 2e-6)
    assert_alike(swung(bench), by_sim, speed=0.06)
