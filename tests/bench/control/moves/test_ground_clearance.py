"""The order of slow moves near the ground, and openings that keep the head off the turf in a stop."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from bench.base.lifecycle import Cause, Phase, Reaction, Request
from bench.config import Configuration, load_configuration
from bench.control.moves.ground_clearance import (
    OPENINGS,
    TIMES,
    disobeying,
    escape,
    joint_progress,
    moves_arm_first,
)
from bench.control.moves.references import begin_move, follow_move
from bench.control.settings import build_controller
from bench.control.step_records import CONTROL_PARAMETERS, CONTROL_STATE, ControlParameters
from bench.design.stop_verification import TRIALS, SwingCheck, TrialOutcome
from bench.simulation.lockstep import Lockstep
from bench.simulation.plant_variation import healthy_plant
from bench.simulation.simulated_bench import Bench
from bench.simulation.swing_operator import LockstepEngine
from bench.swing.library import find_profile
from bench.swing.profile import Profile, load_profile
from drivers.base.compiled import new_record
from sim.driver import hanging_pose
from sim.plant import PlantParameters, build_plant
from tests.bench.control.puppet import STILL, Puppet
from tests.compiled_only import needs_speed

_ARMING = 600
"""Tens of ticks."""


@cache
def swing_of(name: str, configured: str) -> tuple[Configuration, Profile, ControlParameters]:
    file = find_profile(name)
    profile = load_profile(file)
    c = load_configuration(Path(configured)).for_profile(profile, file)
    return c, profile, build_controller(c.plant, profile, c.control, c.envelope, c.estimator)


def test_moves_arm_first_depends_on_head_path() -> None:
    """From each hanging pose: the golfers' robot would clear its minimum by 27 mm, the shipped one by 36."""
    for name, configured, expected in (("default", "shipped", False), ("tour-male-full", "golfers", True)):
        c, profile, parameters = swing_of(name, configured)
        assert moves_arm_first(parameters, hanging_pose(c.plant), profile.angle[0]) is expected, name
        above = profile.angle[0] + [0.5, 0.0, 0.0]
        assert not moves_arm_first(parameters, above, profile.angle[0])


def test_moves_arm_first_pulled_in_arm_returns_false() -> None:
    """An arm pulled in far already: let down first, it would lead the head lower."""
    c, profile, parameters = swing_of("tour-male-full", "golfers")
    pulled_in = hanging_pose(c.plant) + [0.0, -0.35, 0.0]
    assert not moves_arm_first(parameters, pulled_in, profile.angle[0])


@pytest.mark.parametrize("first", [True, False])
def test_follow_move_joints_run_from_start_to_end(*, first: bool) -> None:
    puppet = Puppet(STILL)
    s, parameters = puppet.control, puppet.parameters
    start = parameters.angle[0] - [0.3, 0.1, 0.2]
    begin_move(parameters, puppet.state.control[0], start, 1.0)
    puppet.state.control["move"]["arm_first"] = first
    references = []
    for time in np.linspace(1.0, 1.0 + float(s["move"]["duration"]), 1001):
        follow_move(parameters, puppet.state.control[0], time)
        references.append((s["reference"].copy(), s["reference_velocity"].copy()))
    angle, velocity = (np.array(column) for column in zip(*references, strict=True))
    assert angle[0] == pytest.approx(start)
    assert angle[-1] == pytest.approx(parameters.angle[0])
    step = float(s["move"]["duration"]) / 1000
    assert np.gradient(angle, step, axis=0)[1:-1] == pytest.approx(velocity[1:-1], abs=2e-3)
    if first:
        assert np.all(angle[:500, 0] == start[0])
        assert np.all(angle[501:, 1:] == parameters.angle[0, 1:])


def test_joint_progress_arm_first_moves_joints_in_separate_halves() -> None:
    assert [joint_progress(part, 0, True) for part in (0.0, 0.5, 0.75, 1.0)] == [0.0, 0.0, 0.5, 1.0]
    assert [joint_progress(part, 2, True) for part in (0.0, 0.25, 0.5, 1.0)] == [0.0, 0.5, 1.0, 1.0]
    assert joint_progress(0.3, 0, False) == joint_progress(0.3, 1, False) == 0.3


@needs_speed
@pytest.mark.parametrize("seed", [54, 75])
def test_arming_sticking_arm_keeps_head_above_ground(seed: int) -> None:
    """A right arm held by friction passed 4 mm above the ground on its way, where 5 stop it."""
    c, _, parameters = swing_of("average-male-full", "golfers")
    plant = healthy_plant(c.plant, seed)
    bench = LockstepEngine(Lockstep(build_plant(plant), parameters, hanging_pose(plant)))
    bench.advance(200)
    bench.request(Request.ARM)
    heights = []
    for _ in range(_ARMING):
        bench.advance(10)
        heights.append(bench.control["head"][0, 1] - c.plant.site.sole_depth - c.plant.site.ground)
    assert bench.cause is Cause.NONE
    assert bench.control["phase"][0] == Phase.HOLD
    assert min(heights) > 0.03


# Stops near the ball ----------------------------------------------------------------------------------


def acting(
    cause: Cause, phase: Phase = Phase.COMMITTED, reaction: Reaction = Reaction.PASSIVE, since: float = 0.0
) -> list[float | None]:
    """Return the openings of shoulder, arm and wrist that are set; None where none is."""
    s, p = new_record(CONTROL_STATE), new_record(CONTROL_PARAMETERS)
    p["escape_opening"], p["escape_time"] = OPENINGS, TIMES
    s["latest_cause"], s["phase"], s["reaction"], s["reaction_start"] = cause, phase, reaction, 5.0
    s["desired"], s["turf_override"] = 0.123, 1
    escape(s[0], p[0], 5.0 + since)
    assert np.all((s["desired"][0] == 0.123) | (s["turf_override"][0] != 0))
    return [float(s["desired"][0, i]) if s["turf_override"][0, i] else None for i in range(3)]


@pytest.mark.parametrize(
    ("cause", "joint"),
    [
        (Cause.SHOULDER_AIR, 0),
        (Cause.ARM_FLOW, 1),
        (Cause.WRIST_AIR, 2),
        (Cause.WRIST_SENSOR, 2),
        (Cause.SHOULDER_SENSOR, 0),
        (Cause.ARM_VELOCITY, 1),
        (Cause.ARM_JUMP, -1),
        (Cause.SHOULDER_EFFORT, -1),
        (Cause.SUPPLY_SENSOR, -1),
        (Cause.WRIST_FOLLOWING, -1),
        (Cause.NONE, -1),
    ],
)
def test_disobeying_returns_joint_of_cause(cause: Cause, joint: int) -> None:
    assert disobeying(int(cause)) == joint


@pytest.mark.parametrize(
    ("cause", "expected"),
    [
        (Cause.SHOULDER_AIR, [None, 0.0, -0.4]),
        (Cause.ARM_AIR, [0.4, None, 0.0]),
        (Cause.WRIST_AIR, [0.0, -1.0, None]),
    ],
)
def test_escape_other_joints_act_until_escape_time(cause: Cause, expected: list[float | None]) -> None:
    last = TIMES[disobeying(int(cause))]
    assert acting(cause) == expected
    assert acting(cause, since=0.9 * last) == expected
    assert acting(cause, since=1.1 * last) == [None] * 3


def test_escape_acts_only_in_stop_from_downswing_to_follow_through() -> None:
    for phase, reaction in product(Phase, Reaction):
        stops = reaction in (Reaction.BRAKE, Reaction.PASSIVE)
        wanted = Phase.DOWNSWING <= phase <= Phase.FOLLOW_THROUGH and stops
        found = acting(Cause.ARM_AIR, phase, reaction)
        assert (found == [0.4, None, 0.0]) is wanted, (phase, reaction)
        assert acting(Cause.EMERGENCY_STOP, phase, reaction) == [None] * 3, (phase, reaction)


def test_escape_time_without_turf_equals_zero() -> None:
    plant = PlantParameters()
    turf = replace(plant, site=replace(plant.site, surface="turf", divot=0.01))
    assert build_controller(plant, STILL).control["escape_time"].tolist() == [[0.0, 0.0, 0.0]]
    assert build_controller(turf, STILL).control["escape_time"].tolist() == [list(TIMES)]


# On the plant -----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def iron() -> SwingCheck:
    file = find_profile("iron7-78mph")
    profile = load_profile(file)
    c = load_configuration(Path("bag")).with_club(profile.club).for_profile(profile, file)
    return SwingCheck(Bench.of(c, profile))


def ended(check: SwingCheck, fault: str, tick: int) -> TrialOutcome:
    (trial,) = (trial for trial in TRIALS if trial.name == fault)
    (outcome,) = check.outcomes((trial,), ticks=[tick])
    return outcome


@needs_speed
@pytest.mark.parametrize(
    ("fault", "tick"),
    [
        ("shoulder valve stuck open in reverse", 1280),
        ("wrist valve stuck open", 1253),
        ("wrist valve stuck open", 1280),
        ("arm valve stuck open", 1360),
        ("arm valve stuck open in reverse", 1360),
    ],
)
def test_escape_stuck_valve_keeps_iron_out_of_ground(iron: SwingCheck, fault: str, tick: int) -> None:
    assert not ended(iron, fault, tick).unsafe
    times = iron.parameters.control["escape_time"].copy()
    iron.parameters.control["escape_time"] = 0.0
    try:
        assert "into the ground" in ended(iron, fault, tick).unsafe
    finally:
        iron.parameters.control["escape_time"] = times
