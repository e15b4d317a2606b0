"""The shipped swing, stopped on the plant: at rest, stops and chambers below their ratings, cause reported.

Tried at some instants only; `golfbench profile check` tries all, and shows which valves stuck open end above.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from bench.base.lifecycle import Answer, Cause, Phase, Reaction, Request
from bench.control.settings import EnvelopeSettings, ModelSettings, build_controller
from bench.design.stop_verification import TRIALS, SwingCheck, TrialOutcome
from bench.simulation.lockstep import Lockstep
from bench.simulation.simulated_bench import Bench
from bench.simulation.swing_operator import SETTLING_TIMEOUT, LockstepEngine
from bench.swing.profile import Profile
from sim.plant import PlantParameters, build_plant
from tests.compiled_only import needs_speed
from tests.sampling import release_except

pytestmark = needs_speed

SPACING = 101
"""Ticks between the instants that are tried."""
TRIAL = {trial.name: trial for trial in TRIALS}

StoppedAt = Callable[[str], list[TrialOutcome]]


@pytest.fixture(scope="module")
def stopped(default_profile: Profile) -> StoppedAt:
    """Return how a fault, by its name, ends from each instant."""
    check = SwingCheck(Bench(default_profile))
    return lambda name: check.outcomes((TRIAL[name],), SPACING)


def test_trial_instants_cover_swing_phases(default_profile: Profile) -> None:
    phases = {default_profile.phase_of(tick) for tick in range(0, len(default_profile.angle), SPACING)}
    assert phases >= {
        Phase.HOLD,
        Phase.BACKSWING,
        Phase.TOP,
        Phase.DOWNSWING,
        Phase.COMMITTED,
        Phase.FOLLOW_THROUGH,
    }


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "cause"),
    release_except(
        {"none", "emergency stop", "encoders lost, no ball"},
        [
            ("none", Cause.NONE),
            ("no ball", Cause.NONE),
            ("operator stop", Cause.OPERATOR_STOP),
            ("emergency stop", Cause.EMERGENCY_STOP),
            ("emergency stop, no ball", Cause.EMERGENCY_STOP),
            ("encoders lost", Cause.SHOULDER_ENCODER),
            ("encoders lost, no ball", Cause.SHOULDER_ENCODER),
        ],
    ),
)
def test_swing_check_stop_ends_safe_with_expected_cause(stopped: StoppedAt, name: str, cause: Cause) -> None:
    outcomes = stopped(name)
    assert [outcome.unsafe for outcome in outcomes if outcome.unsafe] == []
    assert {outcome.cause for outcome in outcomes} == {cause}


@pytest.mark.parametrize(
    "name",
    release_except(
        {"wrist valve stuck shut"},
        ["shoulder valve stuck shut", "arm valve stuck shut", "wrist valve stuck shut"],
    ),
)
def test_swing_check_valve_stuck_shut_stays_within_ratings(stopped: StoppedAt, name: str) -> None:
    outcomes = stopped(name)
    assert max(outcome.stop_share for outcome in outcomes) <= 1.0
    assert max(outcome.pressure_share for outcome in outcomes) <= 1.0
    own = Cause[f"{name.partition(' ')[0].upper()}_FOLLOWING"]
    assert [outcome.cause for outcome in outcomes if outcome.phase < Phase.DOWNSWING].count(own) > 5


@pytest.mark.parametrize("height", ["5 mm", "10 mm", "20 mm"])
def test_swing_check_raised_ground_ends_safe(stopped: StoppedAt, height: str) -> None:
    (outcome,) = stopped(f"ground {height} higher")
    assert outcome.unsafe == ""
    assert outcome.time == 0.0


@pytest.mark.parametrize("joint", release_except({"arm"}, ["shoulder", "arm", "wrist"]))
def test_swing_check_model_based_detection_stays_within_ratings(default_profile: Profile, joint: str) -> None:
    watching = EnvelopeSettings(model=ModelSettings(check="always"))
    check = SwingCheck(Bench(default_profile, envelope=watching))
    outcomes = check.outcomes((TRIAL[f"{joint} valve stuck shut"],), SPACING)
    assert max(outcome.stop_share for outcome in outcomes) <= 1.0
    assert max(outcome.pressure_share for outcome in outcomes) <= 1.0
    told = {outcome.cause.name for outcome in outcomes}
    assert told <= {f"{joint.upper()}_{what}" for what in ("AIR", "FLOW", "SENSOR")}


@pytest.fixture(scope="module")
def swinging(default_profile: Profile) -> Lockstep:
    """Return a bench, to be copied, after the first tick of the shipped swing at a ball."""
    parameters = PlantParameters()
    controller = build_controller(parameters, default_profile)
    bench = Lockstep(build_plant(parameters), controller, default_profile.angle[0])
    engine = LockstepEngine(bench)
    assert engine.arm()
    assert engine.await_air()
    bench.state.control["tee"] = True
    bench.advance(1, Request.SWING)
    assert bench.state.control["answer"][0] == Answer.ACCEPTED
    return bench


@pytest.mark.parametrize(
    ("phase", "reaction"),
    [
        (Phase.BACKSWING, Reaction.BRAKE),
        (Phase.DOWNSWING, Reaction.BRAKE),
        (Phase.COMMITTED, Reaction.BRAKE),
        (Phase.FOLLOW_THROUGH, Reaction.COMPLETE),
    ],
)
def test_record_emergency_stop_shows_reaction_and_cause(
    swinging: Lockstep, default_profile: Profile, phase: Phase, reaction: Reaction
) -> None:
    bench = swinging.copy()
    begins = int(np.flatnonzero(default_profile.phases == phase)[0])
    bench.advance(begins + 30)
    bench.plant_state["emergency_stop_clear"] = False
    cycles = bench.advance(4000)
    assert cycles["phase"][0] == phase
    assert (cycles["reaction"][0], cycles["cause"][0]) == (reaction, Cause.EMERGENCY_STOP)
    assert (cycles["cause"] == Cause.EMERGENCY_STOP).all()
    assert not cycles["emergency_stop_clear"].any()
    assert (cycles["phase"][-1], cycles["reaction"][-1]) == (Phase.STANDING, Reaction.VENT)
    standing = cycles["phase"] == Phase.STANDING
    for name in ("applied_valve", "supply_enable", "exhaust_closed", "beacon", "tee"):
        assert not cycles[name][standing].any()
    assert np.diff(standing.astype(int)).min() == 0  # once standing, it stands
    # With air on until nothing moves; the air is let out at standstill.
    last = int(np.flatnonzero(~standing)[-1])
    assert cycles["supply_enable"][: last + 1].all()
    bench.plant_state["emergency_stop_clear"] = True
    assert not bench.advance(500)["supply_enable"].any()
    engine = LockstepEngine(bench)
    assert engine.wait_for(engine.is_still, SETTLING_TIMEOUT)
    bench.advance(1, Request.RESET)
    assert bench.state.control["answer"][0] == Answer.ACCEPTED
    assert not bench.advance(500)["supply_enable"].any()
