"""Homing on the plant: by the vented pose, and by the index of incremental encoders."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import pi
from pathlib import Path

import numpy as np
import pytest

from bench.base.configuration_files import find_configuration
from bench.base.lifecycle import Cause, Phase, Reaction, Refusal, Request, State
from bench.config import load_configuration
from bench.control.moves.pressed_stops import pressed_stops, stop_tolerance
from bench.control.settings import EnvelopeSettings, HomingSettings, build_controller
from bench.control.step_records import ControlParameters, new_control_state
from bench.simulation.lockstep import Lockstep
from bench.simulation.plant_variation import unknown_plant
from bench.simulation.swing_operator import SETTLING_TIMEOUT, LockstepEngine
from bench.swing.library import find_profile
from bench.swing.profile import Profile, load_profile
from sim.driver import hanging_pose, joint_travel
from sim.kinematics import forward_kinematics
from sim.plant import Encoders, PlantParameters, build_plant
from tests.benchmarks.healthy_swings import counting
from tests.compiled_only import needs_speed
from tests.sampling import release_except

pytestmark = needs_speed

INDEX = np.array([-0.60, 4.25, 5.90])
"""Where the marks are (rad)."""
COUNTS = Encoders().counts_per_revolution
ZEROS = tuple(float(np.floor(-angle * COUNTS / (2 * pi))) for angle in INDEX)
PLANT = PlantParameters(encoders=Encoders(incremental=True, zero_count=ZEROS))  # type: ignore[arg-type]
HOMING = HomingSettings(method="index")
FASTEST = np.array([2.0, 2.0, 4.5])
"""rad/s that no joint may exceed while it is homed: it breaks loose from dry friction."""

MakeBench = Callable[..., Lockstep]


def in_safe(
    plant: PlantParameters, parameters: ControlParameters, angle: np.ndarray | None = None, ticks: int = 20
) -> Lockstep:
    """Return a bench in SAFE after `ticks`, at joint angles `angle`, by default hanging."""
    bench = Lockstep(build_plant(plant), parameters, hanging_pose(plant) if angle is None else angle)
    bench.state = new_control_state(State.SAFE)
    bench.advance(ticks)
    return bench


def kind(*, incremental: bool) -> tuple[PlantParameters, HomingSettings]:
    return (PLANT, HOMING) if incremental else (PlantParameters(), HomingSettings())


@pytest.fixture(scope="module")
def make_bench(default_profile: Profile) -> MakeBench:
    def make(angle: np.ndarray | None = None, plant: PlantParameters = PLANT) -> Lockstep:
        return in_safe(plant, build_controller(PLANT, default_profile, homing=HOMING), angle)

    return make


def state(bench: Lockstep) -> State:
    return State(int(bench.state.control["state"][0]))


def cause(bench: Lockstep) -> Cause:
    return Cause(int(bench.state.control["cause"][0]))


def home(bench: Lockstep, longest: int = 40_000) -> np.ndarray:
    """Ask for homing and run until it has ended; return its records."""
    records = [bench.advance(1, Request.HOME)]
    assert records[0]["refusal"][0] == 0
    while state(bench) is State.HOMING and sum(map(len, records)) < longest:
        records.append(bench.advance(50))
    return np.concatenate(records)


def rest(bench: Lockstep) -> None:
    """Run until the vented robot has sunk to where it rests."""
    for _ in range(40):
        if np.abs(bench.advance(500)["plant_velocity"]).max() < 1e-3:
            return


OFFSETS = [(0.0, 0.0, 0.0), (0.25, -0.05, -0.2), (-0.2, -0.05, -0.1), (0.4, -0.1, -0.3)]


@pytest.mark.parametrize(
    "offset", release_except({OFFSETS[2], OFFSETS[3]}, ((offset,) for offset in OFFSETS))
)
def test_index_homing_from_several_poses_reaches_ready(
    make_bench: MakeBench, offset: tuple[float, float, float]
) -> None:
    bench = make_bench(hanging_pose(PLANT) + offset)
    assert not bench.readings["encoder_indexed"].any()
    records = home(bench)
    assert (state(bench), cause(bench)) == (State.READY, Cause.NONE)
    assert bench.state.control["homed"][0]
    assert bench.readings["encoder_indexed"].all()
    assert np.abs(records["applied_valve"]).max() <= HOMING.opening
    assert (np.abs(records["plant_velocity"]).max(axis=0) < FASTEST).all()
    rest(bench)
    assert bench.state.estimator["angle"][0] == pytest.approx(bench.plant_state["angle"][0], abs=1e-3)
    assert LockstepEngine(bench).arm()


def test_index_homing_searches_joints_in_order(make_bench: MakeBench) -> None:
    records = home(make_bench())
    sought = records["reference_velocity"] != 0.0
    back = int(np.argmax(sought.sum(axis=1) > 1))  # then all go back together
    assert back
    sought = sought[:back]
    order = [joint for joint in np.argmax(sought, axis=1)[sought.any(axis=1)]]
    names = [("shoulder", "arm", "wrist")[joint] for joint in dict.fromkeys(order)]
    assert names == [name for name in HOMING.order if name in names]
    assert names == list(HOMING.order)
    unknown = records["encoder_indexed"] == 0
    assert (np.abs(records["reference_velocity"] * unknown).max(axis=0) <= HOMING.speed).all()
    assert (np.abs(records["reference_velocity"]).max(axis=0) <= HOMING.stop_contact_speed).all()


def test_lifecycle_before_homing_refuses_arm_swing_and_tee(make_bench: MakeBench) -> None:
    bench = make_bench()
    for request in (Request.ARM, Request.SWING, Request.TEE):
        assert bench.advance(1, request)["answer"][0] == 2
    assert not bench.advance(500)["supply_enable"].any()


def failed(bench: Lockstep) -> None:
    assert (state(bench), cause(bench)) == (State.FAULT, Cause.HOMING_FAILED)
    assert not bench.state.control["homed"][0]
    assert not bench.advance(200)["supply_enable"].any()
    rest(bench)  # without its air the robot sinks, and is not reset while it moves
    assert bench.advance(1, Request.RESET)["answer"][0] == 1
    assert state(bench) is State.SAFE


@pytest.mark.parametrize("joint", range(3))
def test_index_homing_lost_index_ends_in_fault(make_bench: MakeBench, joint: int) -> None:
    bench = make_bench()
    bench.plant_state["index_fitted"][0, joint] = 0
    before = bench.plant_state["angle"][0, joint]
    home(bench)
    assert abs(bench.plant_state["angle"][0, joint] - before) < HOMING.travel[joint] + 0.3
    assert bench.plant_state["stop_energy"].max() < 5.0
    failed(bench)


@pytest.mark.parametrize("joint", release_except({1}, range(3)))
def test_index_homing_stuck_joint_ends_in_fault(make_bench: MakeBench, joint: int) -> None:
    name = ("shoulder", "right_arm", "wrist")[joint]
    actuator = getattr(PLANT, name)
    rust = replace(actuator.friction, coulomb=2000.0, static=2000.0)
    bench = make_bench(plant=replace(PLANT, **{name: replace(actuator, friction=rust)}))
    records = home(bench)
    assert Reaction.PASSIVE in records["reaction"]
    failed(bench)


def test_index_homing_open_guard_brakes_and_latches_fault(make_bench: MakeBench) -> None:
    bench = make_bench()
    bench.advance(1, Request.HOME)
    bench.advance(5500)  # by then the arm is pressed against its stop
    assert bench.state.control["phase"][0] == Phase.HOMING
    bench.plant_state["guard_closed"] = False
    records = bench.advance(800)
    assert (records["reaction"][1], records["state"][1]) == (Reaction.BRAKE, State.HOMING)
    assert (state(bench), cause(bench)) == (State.FAULT, Cause.GUARD)
    assert not bench.state.control["homed"][0]
    bench.plant_state["guard_closed"] = True
    bench.advance(10)
    # The brake has left the joint at rest, not the air in its chambers, which now are let out.
    assert bench.advance(1, Request.RESET)["refusal"][0] == Refusal.MOVING
    engine = LockstepEngine(bench)
    assert engine.wait_for(engine.is_still, SETTLING_TIMEOUT)
    assert bench.advance(1, Request.RESET)["answer"][0] == 1
    assert state(bench) is State.SAFE
    home(bench)
    assert state(bench) is State.READY


def test_index_homing_disarm_ends_in_safe(make_bench: MakeBench) -> None:
    bench = make_bench()
    bench.advance(1, Request.HOME)
    bench.advance(2600)
    assert bench.advance(1, Request.DISARM)["answer"][0] == 1
    bench.advance(2000)
    assert (state(bench), cause(bench)) == (State.SAFE, Cause.NONE)


@pytest.mark.parametrize("part", [0.02, 0.5, 0.98])
def test_home_tolerance_covers_joint_travel_only(default_profile: Profile, part: float) -> None:
    plant = PlantParameters()
    lower, upper = joint_travel(plant)
    control = build_controller(plant, default_profile, homing=HomingSettings()).control
    pose, tolerance = control["home_pose"][0], control["home_tolerance"][0]
    assert np.all(np.abs(lower + part * (upper - lower) - pose) <= tolerance)
    for beyond in (lower - 0.2, upper + 0.2):  # past a stop nobody can be: a zero is wrong
        assert np.all(np.abs(beyond - pose) > tolerance)


def test_homing_settings_pose_reference_takes_hanging_pose(default_profile: Profile) -> None:
    plant = PlantParameters()
    control = build_controller(plant, default_profile, homing=HomingSettings(reference="pose")).control
    assert control["home_pose"][0] == pytest.approx(hanging_pose(plant))
    assert control["home_tolerance"][0] == pytest.approx(HomingSettings().tolerance)


def begin(default_profile: Profile, offset: tuple[float, float, float], *, incremental: bool) -> Lockstep:
    """Return a vented bench whose encoders read `offset` rad too much."""
    plant, homing = kind(incremental=incremental)
    encoders = plant.encoders
    a, b, c = (np.array(encoders.zero_count) + np.round(np.array(offset) * COUNTS / (2 * pi))).tolist()
    turned = replace(plant, encoders=replace(encoders, zero_count=(a, b, c)))
    parameters = build_controller(plant, default_profile, homing=homing)
    return in_safe(turned, parameters, hanging_pose(plant), 3000)


@pytest.mark.parametrize("incremental", [False, True], ids=["absolute", "index"])
@pytest.mark.parametrize("offset", release_except({0.0125, -0.3}, [0.0125, -0.0125, 0.05, 0.15, -0.3]))
@pytest.mark.parametrize("joint", range(3))
def test_homing_wrong_encoder_zero_ends_in_fault(
    default_profile: Profile, joint: int, offset: float, incremental: bool
) -> None:
    a, b, c = (offset * (i == joint) for i in range(3))
    bench = begin(default_profile, (a, b, c), incremental=incremental)
    records = home(bench)
    # A large one lies beside the travel, or has its index in the stop.
    beside = {Cause.HOMING_FAILED} if abs(offset) > 0.1 else set()
    assert state(bench) is State.FAULT
    assert cause(bench) in {Cause(Cause.SHOULDER_ZERO + joint), *beside}
    assert not records["homed"].any()
    assert np.abs(records["plant_velocity"]).max() < FASTEST.max()
    assert bench.plant_state["stop_energy"].max() < 5.0


def test_stop_tolerance_with_press_shifts_head_by_given_distance(default_profile: Profile) -> None:
    plant, directions = PlantParameters(), (-1, -1, -1)
    tolerance = stop_tolerance(plant, default_profile, directions, 0.010)
    lower, _ = joint_travel(plant)
    press = lower - pressed_stops(plant, directions)
    assert (press > 0.0).all()
    sample = default_profile.impact_time / default_profile.period
    at = np.array([np.interp(sample, np.arange(len(column)), column) for column in default_profile.angle.T])
    for joint in range(3):
        wrong = at + (tolerance[joint] + 0.17 / 0.83 * press[joint]) * np.eye(3)[joint]
        shift = (forward_kinematics(plant.robot, wrong) - forward_kinematics(plant.robot, at))[:2]
        assert np.hypot(*shift) == pytest.approx(0.010, rel=0.02)
    homing = build_controller(plant, default_profile, homing=HomingSettings()).control
    assert homing["home_stop_tolerance"][0] == pytest.approx(tolerance)


@pytest.mark.parametrize("incremental", [False, True], ids=["absolute", "index"])
@pytest.mark.parametrize("seed", release_except({4}, [1, 4]))
def test_pressed_stops_unknown_plant_lie_within_half_tolerance(
    default_profile: Profile, seed: int, incremental: bool
) -> None:
    """The bench believes in the nominal plant; false alarms must be far away."""
    believed, homing = kind(incremental=incremental)
    parameters = build_controller(believed, default_profile, homing=homing)
    bench = in_safe(unknown_plant(believed, seed), parameters, ticks=3000)
    bench.advance(1, Request.HOME)
    control, limits = bench.state.control[0], parameters.control[0]
    found: dict[int, float] = {}
    while state(bench) is State.HOMING:
        turn = int(control["homing"]["turn"])
        records = bench.advance(10)
        if turn < int(control["homing"]["turn"]):
            joint = int(limits["home_order"][turn])
            found[joint] = float(records["angle"][-1, joint] - limits["home_stop"][joint])
    assert (state(bench), cause(bench)) == (State.READY, Cause.NONE)
    assert len(found) == 3
    for joint, off in found.items():
        assert abs(off) < 0.5 * limits["home_stop_tolerance"][joint]


@pytest.mark.parametrize("incremental", [False, True], ids=["absolute", "index"])
@pytest.mark.parametrize(
    "signs", release_except({(1, -1, -1)}, [((1, 1, 1),), ((1, -1, -1),), ((-1, 1, -1),)])
)
def test_homing_small_wrong_zero_keeps_ground_clearance(
    default_profile: Profile, signs: tuple[int, int, int], incremental: bool
) -> None:
    a, b, c = (0.003 * sign for sign in signs)
    bench = begin(default_profile, (a, b, c), incremental=incremental)
    home(bench)
    assert (state(bench), cause(bench)) == (State.READY, Cause.NONE)
    rest(bench)
    engine = LockstepEngine(bench)
    engine.reset_peaks()
    assert engine.arm()
    bench.advance(500)
    assert engine.start_swing(5, 300)
    bench.advance(4000)
    assert engine.loads().lowest_clearance > 0.010


def test_index_homing_repeated_searches_again(make_bench: MakeBench) -> None:
    bench = make_bench()
    first = home(bench)
    rest(bench)
    second = home(bench)
    assert (state(bench), cause(bench)) == (State.READY, Cause.NONE)
    assert len(second) > 0.5 * len(first)
    assert (second["encoder_indexed"] == 0).all(axis=1).any()
    assert second["homed"][-1]
    searching = (second["state"] == State.HOMING) & (second["reaction"] == Reaction.NONE)
    assert not second["homed"][searching].any()


def test_index_homing_after_stop_reaches_ready(make_bench: MakeBench) -> None:
    bench = make_bench()
    bench.advance(1, Request.HOME)
    while not bench.readings["encoder_indexed"].any():
        bench.advance(20)
    bench.advance(1, Request.STOP)
    bench.advance(6000)
    assert bench.advance(1, Request.RESET)["answer"][0] == 1
    home(bench)
    assert (state(bench), cause(bench)) == (State.READY, Cause.NONE)


@pytest.mark.parametrize("shoulder", [-0.9, -1.2])
def test_index_homing_joint_beyond_index_reverses(make_bench: MakeBench, shoulder: float) -> None:
    bench = make_bench(np.array([shoulder, *hanging_pose(PLANT)[1:]]))
    records = home(bench)
    assert (state(bench), cause(bench)) == (State.READY, Cause.NONE)
    assert np.abs(records["plant_angle"][:, 0] - shoulder).max() < HOMING.travel[0] + 0.3


RAISED = {
    "stops": joint_travel(PLANT)[0] + 1e-3,
    "folded": (-0.39, 3.75, 4.89),
    "shoulder": (-1.7, 3.98, 5.75),
    "high": (-1.5, 3.83, 5.62),
}
"""Poses in which a homing that was stopped, or friction, may leave the vented robot."""


@pytest.mark.parametrize("incremental", [False, True], ids=["absolute", "index"])
@pytest.mark.parametrize("name", release_except({"stops", "shoulder"}, RAISED))
def test_homing_precharge_from_rest_pose_limits_motion(
    default_profile: Profile, name: str, incremental: bool
) -> None:
    plant, homing = kind(incremental=incremental)
    check = EnvelopeSettings().with_model_check("always")
    parameters = build_controller(plant, default_profile, envelope=check, homing=homing)
    bench = in_safe(plant, parameters, np.array(RAISED[name]), 6000)
    records = home(bench)
    assert (state(bench), cause(bench)) == (State.READY, Cause.NONE)
    charged = int(1000 * (parameters.control["warning_time"][0] + parameters.control["precharge_time"][0]))
    pushed = np.abs(records["plant_angle"][:charged] - records["plant_angle"][0]).max(axis=0)
    assert (pushed < (0.3, 0.25, 0.4)).all()
    assert LockstepEngine(bench).loads().stop_share < 0.2


@pytest.mark.parametrize("name", ["golfers", "high_speed"])
def test_index_homing_variant_from_stops_reaches_ready(name: str) -> None:
    """Where an interrupted homing leaves the robot: as far from the index as can be, pressed by full air."""
    c = load_configuration(find_configuration(Path(name)))
    plant, profile = counting(c.plant), load_profile(find_profile(c.swing.profile))
    parameters = build_controller(plant, profile, c.control, homing=HOMING)
    bench = in_safe(plant, parameters, joint_travel(plant)[0])
    home(bench)
    assert (state(bench), cause(bench)) == (State.READY, Cause.NONE)


def test_index_homing_device_keeping_index_fails_without_motion(make_bench: MakeBench) -> None:
    bench = make_bench()
    home(bench)
    rest(bench)
    bench.plant_state["search_before"] = True  # it has seen no edge
    records = home(bench)
    assert (state(bench), cause(bench)) == (State.FAULT, Cause.HOMING_FAILED)
    assert not (records["reference_velocity"] != 0.0).any()
