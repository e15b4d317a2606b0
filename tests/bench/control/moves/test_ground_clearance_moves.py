"""The order of a slow move: arm and wrist first where the head would pass near the ground."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from bench.base.lifecycle import Cause, Phase, Request
from bench.config import Configuration, load_configuration
from bench.control.moves.ground_clearance import joint_progress, moves_arm_first
from bench.control.moves.references import begin_move, follow_move
from bench.control.settings import build_controller
from bench.control.step_records import ControlParameters
from bench.simulation.lockstep import Lockstep
from bench.simulation.plant_variation import healthy_plant
from bench.simulation.swing_operator import LockstepEngine
from bench.swing.library import find_profile
from bench.swing.profile import Profile, load_profile
from sim.driver import hanging_pose
from sim.plant import build_plant
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
        assert moves_arm_first(parameters, hanging_pose(c.plant)) is expected, name
        assert not moves_arm_first(parameters, profile.angle[0] + [0.5, 0.0, 0.0]), "from above"


def test_moves_arm_first_pulled_in_arm_returns_false() -> None:
    """An arm pulled in far already: let down first, it would lead the head lower."""
    c, _, parameters = swing_of("tour-male-full", "golfers")
    assert not moves_arm_first(parameters, hanging_pose(c.plant) + [0.0, -0.35, 0.0])


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
