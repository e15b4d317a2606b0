"""A reversed valve or encoder is found by the first motion, while the joint is still slow."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from bench.base.lifecycle import Cause, Request, State
from bench.config import Configuration
from bench.control.moves.first_motion import forget_answers
from bench.control.settings import build_controller
from bench.control.step_records import ControlParameters, new_control_state
from bench.simulation.lockstep import Lockstep
from bench.swing.profile import Profile
from drivers.base import JOINTS
from sim.driver import hanging_pose
from sim.faults import Fault
from sim.plant import PlantParameters, build_plant
from tests.compiled_only import needs_speed

pytestmark = needs_speed
SLOW = {"shoulder": 2.7, "arm": 2.0, "wrist": 3.9}
"""Speed below which the joint is stopped (rad/s). With valves as open as homing may it passes 6, 3 and 9."""


@pytest.fixture(scope="module")
def parameters(configuration: Configuration, default_profile: Profile) -> ControlParameters:
    c = configuration
    return build_controller(c.plant, default_profile, c.control, c.envelope, c.estimator, homing=c.homing)


def _first_motion(
    plant: PlantParameters, parameters: ControlParameters, request: Request, *faults: Fault
) -> tuple[Lockstep, np.ndarray[Any, Any]]:
    """Return a vented bench whose guard was open, and its records since `request`."""
    bench = Lockstep(build_plant(plant), parameters, hanging_pose(plant), faults)
    bench.state = new_control_state(State.SAFE if request is Request.HOME else State.READY)
    forget_answers(bench.state.control[0])
    bench.advance(600)
    records = [bench.advance(1, request)]
    for _ in range(1_200):
        records.append(bench.advance(20))
        state = State(int(bench.state.control["state"][0]))
        if state not in (State.HOMING, State.ARMED) or (
            state is State.ARMED and not bench.state.control["moving"][0]
        ):
            break
    return bench, np.concatenate(records)


def _state(bench: Lockstep) -> State:
    return State(int(bench.state.control["state"][0]))


def _cause(bench: Lockstep) -> Cause:
    return Cause(int(bench.state.control["cause"][0]))


@pytest.mark.parametrize("request_", [Request.HOME, Request.ARM])
@pytest.mark.parametrize("joint", JOINTS)
def test_first_motion_reversed_valve_stops_slow_joint(
    configuration: Configuration, parameters: ControlParameters, joint: str, request_: Request
) -> None:
    fault = Fault("reversed", f"{joint} valve", "scale", -1.0)
    bench, records = _first_motion(configuration.plant, parameters, request_, fault)
    assert _cause(bench) is not Cause.NONE
    powered = records[records["supply_enable"]]
    number = JOINTS.index(joint)
    assert np.abs(powered["plant_velocity"][:, number]).max() < SLOW[joint]
    assert not bench.state.control["first_motion"]["answered"][0, number]


@pytest.mark.parametrize("joint", ["shoulder", "wrist"])
def test_first_motion_reversed_encoder_stops_slow_joint(
    configuration: Configuration, parameters: ControlParameters, joint: str
) -> None:
    number, encoders = JOINTS.index(joint), configuration.plant.encoders
    sign: Any = [-one if i == number else one for i, one in enumerate(encoders.sign)]
    plant = replace(configuration.plant, encoders=replace(encoders, sign=tuple(sign)))
    bench, records = _first_motion(plant, parameters, Request.HOME)
    assert _cause(bench) is not Cause.NONE
    powered = records[records["supply_enable"]]
    assert np.abs(powered["plant_velocity"][:, number]).max() < SLOW[joint]


@pytest.mark.parametrize("request_", [Request.HOME, Request.ARM])
def test_first_motion_fault_free_robot_continues(
    configuration: Configuration, parameters: ControlParameters, request_: Request
) -> None:
    bench, _ = _first_motion(configuration.plant, parameters, request_)
    assert _cause(bench) is Cause.NONE
    assert State(int(bench.state.control["state"][0])) is (
        State.READY if request_ is Request.HOME else State.ARMED
    )
    if request_ is Request.HOME:
        assert bench.state.control["first_motion"]["answered"].all()
