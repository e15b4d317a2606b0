"""Openings that keep the head off the turf: when they act, and that irons stay out of the ground by them."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from bench.base.lifecycle import Cause, Phase, Reaction
from bench.config import load_configuration
from bench.control.moves.ground_clearance import OPENINGS, TIMES, disobeying, escape
from bench.control.settings import build_controller
from bench.control.step_records import CONTROL_PARAMETERS, CONTROL_STATE
from bench.design.stop_verification import TRIALS, SwingCheck, TrialOutcome
from bench.swing.library import find_profile
from bench.swing.profile import load_profile
from drivers.base.compiled import new_record
from sim.plant import PlantParameters
from tests.bench.control.puppet import STILL
from tests.compiled_only import needs_speed


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
    return SwingCheck(c.plant, profile, c.control, c.envelope, c.estimator)


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
