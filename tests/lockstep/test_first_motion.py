"""A reversed valve or encoder is found by the first motion, while the joint is still slow."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from bench.base.configuration_files import find_configuration
from bench.base.lifecycle import Cause, Phase, Request, State
from bench.config import load_configuration, shipped_configuration
from bench.control.moves.first_motion import forget_answers
from bench.control.settings import build_controller
from bench.control.step_records import ControlParameters, new_control_state
from bench.simulation.lockstep import Lockstep
from bench.swing.library import find_profile
from bench.swing.profile import load_profile
from drivers.base import JOINTS
from sim.driver import hanging_pose, joint_travel
from sim.faults import Fault, own_records
from sim.plant import PlantParameters, build_plant
from tests.compiled_only import needs_speed
from tests.sampling import release_except

pytestmark = needs_speed
SLOW = {"shoulder": 2.7, "arm": 2.0, "wrist": 3.9}
"""Speed below which the joint is stopped (rad/s). With valves as open as homing may it passes 6, 3 and 9."""
HOMING, ENCODER, VALVE = 4.5, 5.5, 7.5
"""Max speeds of the head until the robot rests again (m/s). Seen: 4.1 while homing; while arming 5.1 with a
reversed encoder, 7.2 with a reversed valve, whose chambers the precharge was filling. A robot without a
fault reaches 5.6 where friction lets a joint go. A brake by the reversed encoder reaches 39."""
TEST = 2.5
"""Max speed of a fault-free head in the test motion (m/s). Seen: 2.2."""

CASES = [
    (robot, pose, request, joint)
    for robot in ("default", "high_speed", "small_plant")
    for pose in ("hanging", "stops", "upper stops", "address")
    for request in (Request.HOME, Request.ARM)
    for joint in JOINTS
]
DAILY = {case for case in CASES if case[0] == "default" and case[1] == "hanging"}
DAILY |= {("default", pose, Request.ARM, joint) for pose in ("stops", "address") for joint in JOINTS}


class Robot(NamedTuple):
    """A robot that rests vented, and the parameters of its bench."""

    plant: PlantParameters
    parameters: ControlParameters
    rest: np.ndarray[Any, Any]

    def with_mirrored_encoder(self, joint: int) -> PlantParameters:
        """Return the plant with an encoder that counts backwards from the present pose on."""
        encoders = self.plant.encoders
        per_radian = encoders.counts_per_revolution / (2.0 * np.pi)
        sign: list[Any] = list(encoders.sign)
        zero = list(encoders.zero_count)
        zero[joint] += round(2.0 * sign[joint] * per_radian * self.rest[joint])
        sign[joint] *= -1
        a, b, c = sign
        d, e, f = zero
        return replace(self.plant, encoders=replace(encoders, sign=(a, b, c), zero_count=(d, e, f)))


@cache
def robot_of(name: str, pose: str) -> Robot:
    """Return the robot of configuration `name` as it rests when vented at `pose`."""
    c = load_configuration(shipped_configuration() if name == "default" else find_configuration(Path(name)))
    profile, plant = load_profile(find_profile(c.swing.profile)), c.plant
    parameters = build_controller(plant, profile, c.control, c.envelope, c.estimator, homing=c.homing)
    lower, upper = joint_travel(plant)
    poses = {"hanging": hanging_pose(plant), "stops": lower + 1e-3, "upper stops": upper - 1e-3}
    bench = Lockstep(build_plant(plant), parameters, poses.get(pose, parameters.angle[0]))
    bench.state = new_control_state(State.SAFE)
    bench.advance(6_000)
    return Robot(plant, parameters, bench.plant_state["angle"][0].copy())


def first_motion(
    robot: Robot, plant: PlantParameters, request: Request, *faults: Fault
) -> tuple[Lockstep, np.ndarray[Any, Any]]:
    """Return a vented bench whose guard was open, and its records since `request`."""
    bench = Lockstep(build_plant(plant), robot.parameters, robot.rest, faults)
    bench.state = new_control_state(State.SAFE if request is Request.HOME else State.READY)
    forget_answers(bench.state.control[0])
    bench.advance(3_000)
    records = [bench.advance(1, request)]
    assert not records[0]["refusal"][0]
    for _ in range(1_200):
        records.append(bench.advance(20))
        state = _state(bench)
        if state not in (State.HOMING, State.ARMED) or (
            state is State.ARMED and not bench.state.control["moving"][0]
        ):
            break
    records.append(bench.advance(1_000))
    return bench, np.concatenate(records)


def _state(bench: Lockstep) -> State:
    return State(int(bench.state.control["state"][0]))


def _cause(bench: Lockstep) -> Cause:
    return Cause(int(bench.state.control["cause"][0]))


@pytest.mark.parametrize("case", release_except(DAILY, ((case,) for case in CASES)))
def test_first_motion_reversed_valve_stops_slow_joint(case: tuple[str, str, Request, str]) -> None:
    name, pose, request, joint = case
    robot, fault = robot_of(name, pose), Fault("reversed", f"{joint} valve", "scale", -1.0)
    bench, records = first_motion(robot, robot.plant, request, fault)
    assert _cause(bench) is not Cause.NONE
    powered = records[records["supply_enable"]]
    assert np.abs(powered["plant_velocity"][:, JOINTS.index(joint)]).max() < SLOW[joint]
    assert records["plant_head_speed"].max() < (HOMING if request is Request.HOME else VALVE)


@pytest.mark.parametrize("case", release_except(DAILY, ((case,) for case in CASES)))
def test_first_motion_reversed_encoder_stops_slow_joint(case: tuple[str, str, Request, str]) -> None:
    name, pose, request, joint = case
    robot, number = robot_of(name, pose), JOINTS.index(joint)
    bench, records = first_motion(robot, robot.with_mirrored_encoder(number), request)
    assert _cause(bench) is not Cause.NONE
    powered = records[records["supply_enable"]]
    assert np.abs(powered["plant_velocity"][:, number]).max() < SLOW[joint]
    assert records["plant_head_speed"].max() < (HOMING if request is Request.HOME else ENCODER)


@pytest.mark.parametrize("pose", ["hanging", "stops", "upper stops", "address"])
@pytest.mark.parametrize("request_", [Request.HOME, Request.ARM])
def test_first_motion_fault_free_robot_continues(request_: Request, pose: str) -> None:
    robot = robot_of("default", pose)
    bench, records = first_motion(robot, robot.plant, request_)
    assert _cause(bench) is Cause.NONE
    assert _state(bench) is (State.READY if request_ is Request.HOME else State.ARMED)
    assert bench.state.control["first_motion"]["answered"].all()
    if pose == "address" and request_ is Request.ARM:
        assert records["plant_head_speed"].max() < TEST


@pytest.mark.parametrize("joint", range(3), ids=JOINTS)
def test_hold_mirrored_encoder_of_unanswered_joint_stops_slow_robot(joint: int) -> None:
    """A joint close to its address comes to hold without an answer; the model-based check is off."""
    robot = robot_of("default", "hanging")
    unwatched = robot.parameters.model.copy()
    unwatched["check"] = False
    parameters = robot.parameters._replace(model=unwatched)
    bench = Lockstep(own_records(build_plant(robot.plant)), parameters, robot.rest)
    bench.state = new_control_state(State.READY)
    bench.advance(1, Request.ARM)
    while bench.state.control["phase"][0] != Phase.HOLD:
        bench.advance(1)
    forget_answers(bench.state.control[0])
    record = bench.plant.plant
    counts = record["encoder_scale"][0, joint] * bench.plant_state["angle"][0, joint]
    record["encoder_zero"][0, joint] += 2.0 * counts
    record["encoder_scale"][0, joint] *= -1.0
    records = bench.advance(5_000)
    assert records["plant_head_speed"].max() < ENCODER
