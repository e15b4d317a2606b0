"""Every check of the envelope: just inside, at and just outside each limit, not a number, in every phase."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import wraps
from inspect import signature
from itertools import product
from math import asin, inf, nan, pi
from typing import Any

import numba
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench.base.lifecycle import Cause, Phase
from bench.control.envelope import (
    ENVELOPE_PARAMETERS,
    interlock_cause,
    joint_coordinates,
    limit,
    motion_cause,
    readings_cause,
    relay_closed,
)
from bench.control.estimate.estimator import ESTIMATOR_STATE
from bench.control.settings import ControlSettings, EnvelopeSettings, build_controller
from bench.swing.profile import Profile
from drivers.base.compiled import new_record
from drivers.base.records import READINGS
from sim.kinematics import forward_kinematics, right_arm_length
from sim.plant import PlantParameters
from sim.robot import thesis_robot

Record = np.ndarray[Any, Any]

ROBOT = thesis_robot()
CLUB_REACH = float(ROBOT.record["l3t"][0])
"""Wrist to face centre, m."""
POSE = (0.5, 4.25, 5.75)
"""Exact in binary, so that sums and differences meet their limits exactly; the head is over the ground."""
STOPPABLE = {*range(Phase.COMMITTED), Phase.RETURN}
"""Phases in which stopping sooner than planned is still a choice."""
TINY = 1e-9

compiled_only = pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="there is nothing compiled")
each_joint = pytest.mark.parametrize("joint", range(3))


def each_phase(test: Callable[..., None]) -> Callable[..., None]:
    """Let `test` run in all phases, as one test: its microseconds are less than a test costs."""

    @wraps(test)
    def in_each(**given_values: Any) -> None:
        for phase in Phase:
            try:
                test(phase=phase, **given_values)
            except Exception as error:
                error.add_note(f"in phase {phase.name}")
                raise

    own = signature(test)
    others = [one for name, one in own.parameters.items() if name != "phase"]
    in_each.__signature__ = own.replace(parameters=others)  # type: ignore[attr-defined]
    return in_each


def above(value: float) -> float:
    return float(np.nextafter(value, inf))


def below(value: float) -> float:
    return float(np.nextafter(value, -inf))


def generous() -> Record:
    """Return limits that nothing breaks."""
    p = new_record(ENVELOPE_PARAMETERS)
    p["lower"], p["upper"] = -100.0, 100.0
    p["max_following_error"] = p["min_deceleration"] = p["end_stop_max_speed"] = p["max_speed"] = 1e3
    p["max_opening"], p["max_slew"] = 0.75, 50.0
    p["encoder_timeout"], p["max_tick_interval"], p["min_supply_pressure"] = 0.0045, 0.010, 6.5e5
    p["max_supply_pressure"] = 8.8e5
    p["ground"] = -100.0
    return p


def moving(angle: tuple[float, float, float] = POSE) -> Record:
    """Return an estimate of all joints at `angle`, slow."""
    e = new_record(ESTIMATOR_STATE)
    e["angle"], e["velocity"], e["started"] = angle, (0.5, -0.5, 1.0), 1
    return e


def readings() -> Record:
    r = new_record(READINGS)
    r["supply_pressure"] = 8e5
    r["emergency_stop_clear"] = r["guard_closed"] = r["guard_locked"] = True
    return r


@dataclass
class Motion:
    """All that `motion_cause` looks at; nothing is broken until a test breaks it."""

    parameters: Record = field(default_factory=generous)
    estimator: Record = field(default_factory=moving)
    readings: Record = field(default_factory=readings)
    reference: Record = field(default_factory=lambda: np.array(POSE))
    phase: Phase = Phase.DOWNSWING
    step: float = 1e-3
    charging: bool = False
    low: tuple[float, ...] = ()

    def cause(self) -> Cause:
        return Cause(
            motion_cause(
                self.parameters,
                ROBOT.record,
                self.estimator,
                self.readings,
                self.reference,
                int(self.phase),
                self.step,
                self.charging,
                *self.low,
            )
        )

    def coordinates(self, joint: int) -> tuple[float, float]:
        e = self.estimator[0]
        return joint_coordinates(ROBOT.record, e["angle"], e["velocity"], joint)


def nth(first: Cause, joint: int) -> Cause:
    return Cause(first + joint)


STRETCHED = (0.0, 0.0, 0.0)
"""All links along x: derived values are exact."""


def test_envelope_parameters_hold_one_limit_per_joint() -> None:
    shapes = {name: ENVELOPE_PARAMETERS[name].shape for name in ENVELOPE_PARAMETERS.names or ()}
    several = {name: shape for name, shape in shapes.items() if shape}
    assert several == {"max_following_error": (len(Phase), 3)} | dict.fromkeys(
        ("lower", "upper", "max_speed", "min_deceleration", "end_stop_max_speed"), (3,)
    )


# Interlocks and readings ------------------------------------------------------------------------------


@pytest.mark.parametrize(("clear", "closed", "locked"), list(product((True, False), repeat=3)))
def test_interlock_cause_reports_emergency_stop_before_guard(clear: bool, closed: bool, locked: bool) -> None:
    r = readings()
    r["emergency_stop_clear"], r["guard_closed"], r["guard_locked"] = clear, closed, locked
    guard = Cause.NONE if closed and locked else Cause.GUARD
    assert interlock_cause(r) == (guard if clear else Cause.EMERGENCY_STOP)
    assert relay_closed(r) is (clear and closed)


def test_readings_cause_good_readings_returns_none() -> None:
    assert readings_cause(generous(), moving()) == Cause.NONE


@each_joint
@pytest.mark.parametrize(
    ("silence", "lost"),
    [(0.0, 0), (below(0.0045), 0), (0.0045, 1), (above(0.0045), 1), (inf, 1), (nan, 1)],
)
def test_readings_cause_silent_encoder_reports_after_timeout(joint: int, silence: float, lost: bool) -> None:
    e = moving()
    e["without_sample"][0, joint] = silence
    assert readings_cause(generous(), e) == (nth(Cause.SHOULDER_ENCODER, joint) if lost else 0)


@each_joint
def test_readings_cause_unstarted_encoder_reports_encoder(joint: int) -> None:
    e = moving()
    e["started"][0, joint] = 0
    assert readings_cause(generous(), e) == nth(Cause.SHOULDER_ENCODER, joint)


@each_joint
@pytest.mark.parametrize("name", ["angle", "velocity", "acceleration"])
@pytest.mark.parametrize("value", [nan, inf, -inf])
def test_readings_cause_non_finite_estimate_reports_not_finite(joint: int, name: str, value: float) -> None:
    e = moving()
    e[name][0, joint] = value
    assert readings_cause(generous(), e) == Cause.NOT_FINITE


# Motion -----------------------------------------------------------------------------------------------


@each_phase
@pytest.mark.parametrize("charging", [False, True])
def test_motion_cause_within_limits_returns_none(phase: Phase, charging: bool) -> None:
    assert Motion(phase=phase, charging=charging).cause() is Cause.NONE


@each_phase
@pytest.mark.parametrize(
    ("step", "broken"),
    [
        (0.0, False),
        (-0.0, False),
        (below(0.010), False),
        (0.010, False),
        (above(0.010), True),
        (1.0, True),
        (-5e-324, True),
        (-1.0, True),
        (inf, True),
        (-inf, True),
        (nan, True),
    ],
)
def test_motion_cause_long_or_backward_tick_reports_tick_gap(phase: Phase, step: float, broken: bool) -> None:
    assert Motion(phase=phase, step=step).cause() is (Cause.TICK_GAP if broken else Cause.NONE)


@each_phase
@pytest.mark.parametrize(
    ("pressure", "low"),
    [(above(6.5e5), False), (6.5e5, False), (below(6.5e5), True), (0.0, True), (-inf, True)],
)
@pytest.mark.parametrize("charging", [False, True])
def test_motion_cause_low_supply_reports_in_stoppable_phases(
    phase: Phase, pressure: float, low: bool, charging: bool
) -> None:
    motion = Motion(phase=phase, charging=charging)
    motion.readings["supply_pressure"] = pressure
    expected = low and phase in STOPPABLE and not charging
    assert motion.cause() is (Cause.SUPPLY_PRESSURE if expected else Cause.NONE)


@each_phase
@pytest.mark.parametrize(("pressure", "high"), [(8.8e5, False), (above(8.8e5), True), (inf, True)])
@pytest.mark.parametrize("charging", [False, True])
def test_motion_cause_high_supply_reports_even_while_charging(
    phase: Phase, pressure: float, high: bool, charging: bool
) -> None:
    motion = Motion(phase=phase, charging=charging)
    motion.readings["supply_pressure"] = pressure
    assert motion.cause() is (Cause.SUPPLY_PRESSURE if high and phase in STOPPABLE else Cause.NONE)


@each_phase
def test_motion_cause_unfitted_supply_sensor_returns_none(phase: Phase) -> None:
    motion = Motion(phase=phase)
    motion.readings["supply_pressure"] = nan
    assert motion.cause() is Cause.NONE


@each_phase
@each_joint
@pytest.mark.parametrize("charging", [False, True])
def test_motion_cause_joint_beyond_working_range_reports_range(
    phase: Phase, joint: int, charging: bool
) -> None:
    motion = Motion(phase=phase, charging=charging)
    broken = nth(Cause.SHOULDER_RANGE, joint)
    position, _ = motion.coordinates(joint)
    for bound, beyond, within in (("lower", above, below), ("upper", below, above)):
        limits = motion.parameters[bound][0]
        open_bound = limits[joint]
        for value, expected in (
            (within(position), Cause.NONE),
            (position, Cause.NONE),
            (beyond(position), broken),
            (nan, broken),
            (open_bound, Cause.NONE),
        ):
            limits[joint] = value
            assert motion.cause() is expected
    motion.estimator["angle"][0, joint] = nan
    assert motion.cause() is broken


@each_phase
@each_joint
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_motion_cause_joint_above_max_speed_reports_speed(phase: Phase, joint: int, sign: float) -> None:
    motion = Motion(phase=phase)
    broken = nth(Cause.SHOULDER_SPEED, joint)
    motion.estimator["velocity"] *= sign
    speed = abs(motion.coordinates(joint)[1])
    for value, expected in (
        (above(speed), Cause.NONE),
        (speed, Cause.NONE),
        (below(speed), broken),
        (nan, broken),
        (inf, Cause.NONE),
    ):
        motion.parameters["max_speed"][0, joint] = value
        assert motion.cause() is expected
    for value in (nan, inf, -inf):
        motion.estimator["velocity"][0, joint] = value
        motion.parameters["max_speed"] = 1e3
        assert motion.cause() is broken


@each_phase
@pytest.mark.parametrize("joint", [0, 2])
@pytest.mark.parametrize("up", [True, False])
def test_motion_cause_short_stop_distance_reports_in_stoppable_phases(
    phase: Phase, joint: int, up: bool
) -> None:
    # 2.5² = 1.5² + 2·2·1: everything is exact in binary.
    motion = Motion(phase=phase)
    p, e = motion.parameters[0], motion.estimator[0]
    e["velocity"][joint] = 2.5 if up else -2.5
    p["end_stop_max_speed"][joint], p["min_deceleration"][joint] = 1.5, 2.0
    bound, sign = (p["upper"], 1.0) if up else (p["lower"], -1.0)
    at = POSE[joint] + sign
    broken = nth(Cause.SHOULDER_STOP_DISTANCE, joint) if phase in STOPPABLE else Cause.NONE
    bound[joint] = at
    assert motion.cause() is Cause.NONE
    bound[joint] = at - sign * 1e-12
    assert motion.cause() is broken
    bound[joint] = at
    p["min_deceleration"][joint] = nan
    assert motion.cause() is broken


@each_phase
@pytest.mark.parametrize("joint", [0, 2])
@pytest.mark.parametrize("speed", [0.25, -0.25])
def test_motion_cause_stop_distance_counts_ahead_only(phase: Phase, joint: int, speed: float) -> None:
    motion = Motion(phase=phase)
    p, e = motion.parameters[0], motion.estimator[0]
    e["velocity"][joint] = speed
    p["end_stop_max_speed"][joint], p["min_deceleration"][joint] = 0.0, 1.0
    ahead, behind = ("upper", "lower") if speed > 0.0 else ("lower", "upper")
    p[behind][joint] = POSE[joint]
    assert motion.cause() is Cause.NONE
    p[ahead][joint] = POSE[joint]
    broken = nth(Cause.SHOULDER_STOP_DISTANCE, joint) if phase in STOPPABLE else Cause.NONE
    assert motion.cause() is broken


@each_phase
@pytest.mark.parametrize("velocity", [3.0, -3.0])
def test_motion_cause_rod_stop_distance_reports_arm(phase: Phase, velocity: float) -> None:
    motion = Motion(phase=phase)
    motion.estimator["velocity"][0, 1] = velocity
    position, speed = motion.coordinates(1)
    bound, sign = ("upper", 1.0) if speed > 0 else ("lower", -1.0)
    p = motion.parameters
    p[bound][0, 1] = position + 0.05 * sign
    p["end_stop_max_speed"][0, 1] = 0.0
    needed = speed**2 / 0.1
    for deceleration, enough in ((needed * (1 + TINY), True), (needed * (1 - TINY), False)):
        p["min_deceleration"][0, 1] = deceleration
        broken = not enough and phase in STOPPABLE
        assert motion.cause() is (Cause.ARM_STOP_DISTANCE if broken else Cause.NONE)


@each_phase
@each_joint
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_motion_cause_following_error_beyond_limit_reports_following(
    phase: Phase, joint: int, side: float
) -> None:
    motion = Motion(phase=phase)
    motion.parameters["max_following_error"][0, phase, joint] = 0.25
    at = POSE[joint] + 0.25 * side
    broken = nth(Cause.SHOULDER_FOLLOWING, joint) if phase is not Phase.IMPACT else Cause.NONE
    for reference, expected in (
        (at - side * 1e-12, Cause.NONE),
        (at, Cause.NONE),
        (at + side * 1e-12, broken),
        (nan, broken),
        (inf, broken),
        (-inf, broken),
    ):
        motion.reference[joint] = reference
        assert motion.cause() is expected


@each_phase
def test_motion_cause_following_error_uses_limit_of_phase(phase: Phase) -> None:
    motion = Motion(phase=phase)
    motion.parameters["max_following_error"] = 0.0
    motion.parameters["max_following_error"][0, phase] = 1.0
    motion.reference += 0.5
    assert motion.cause() is Cause.NONE


@pytest.mark.parametrize(
    ("changes", "cause"),
    [
        ({"ground": -0.5, "sole_depth": 0.25, "clearance": 0.25}, Cause.NONE),
        ({"ground": -0.5, "sole_depth": 0.25, "clearance": above(0.25)}, Cause.GROUND),
        ({"ground": -0.5, "clearance": 1.0, "ball_window": 1.0}, Cause.NONE),
        ({"ground": -0.5, "clearance": 1.0, "ball_window": below(1.0)}, Cause.GROUND),
        ({"min_frame_distance": 1.0}, Cause.NONE),
        ({"min_frame_distance": above(1.0)}, Cause.FRAME),
        ({"min_lever": 1.0}, Cause.NONE),
        ({"min_lever": above(1.0)}, Cause.WRIST_LEVER),
    ],
)
def test_motion_cause_clearance_reports_only_beyond_limit(changes: dict[str, float], cause: Cause) -> None:
    robot = ROBOT.record[0]
    wrist = float(robot["l12"]) + float(robot["l23"])
    motion = Motion(estimator=moving(STRETCHED), reference=np.array(STRETCHED))
    lengths = {"ball_window": wrist + CLUB_REACH, "min_frame_distance": wrist}
    for name, value in changes.items():
        motion.parameters[name] = value * lengths.get(name, 1.0)
    assert motion.cause() is cause


@each_phase
@pytest.mark.parametrize("window", ["inside", "outside"])
def test_motion_cause_head_below_clearance_reports_ground(phase: Phase, window: str) -> None:
    motion = Motion(phase=phase)
    p = motion.parameters[0]
    x, y, _ = forward_kinematics(ROBOT, np.array(POSE))
    p["clearance"], p["ball_clearance"], p["sole_depth"] = 0.015, 0.005, 0.02
    p["ball_window"], needed = 0.6, 0.005 if window == "inside" else 0.015
    inward = -TINY if window == "inside" else TINY
    for side in (1.0, -1.0):
        p["ball_x"] = x + side * (0.6 + inward)
        for height, expected in (
            (needed + TINY, Cause.NONE),
            (needed - TINY, Cause.GROUND),
            (-1.0, Cause.GROUND),
            (nan, Cause.GROUND),
        ):
            for low in ((), (0.004,)):
                motion.low, p["ground"] = low, y - 0.02 - height + sum(low)
                assert motion.cause() is expected


def test_clearance_by_ball_with_divot_turns_negative(slow_swing: Profile) -> None:
    settings, site = EnvelopeSettings(), replace(PlantParameters().site, surface="turf", divot=0.012)
    assert settings.clearance_by_ball(PlantParameters().site) == settings.ball_clearance
    by_hand = ControlSettings(gains="hand")  # the machine's take half a minute of plain Python
    record = build_controller(replace(PlantParameters(), site=site), slow_swing, by_hand).envelope
    assert record["ball_clearance"][0] == settings.clearance_by_ball(site) == -0.012
    assert record["clearance"][0] == settings.clearance


@given(st.floats(-2.0, 2.0), st.floats(pi, 1.5 * pi), st.floats(4.8, 6.2), st.floats(0.0, 1.2))
def test_motion_cause_shaft_near_frame_reports_frame(a: float, b: float, c: float, radius: float) -> None:
    motion = Motion(estimator=moving((a, b, c)), reference=np.array((a, b, c)))
    motion.parameters["min_frame_distance"] = radius
    x, y, theta = forward_kinematics(ROBOT, np.array((a, b, c)))
    along = np.linspace(0.0, CLUB_REACH, 20001)
    distance = np.hypot(x - along * np.cos(theta), y - along * np.sin(theta)).min()
    if abs(distance - radius) > 1e-4:
        assert motion.cause() is (Cause.FRAME if distance < radius else Cause.NONE)


@each_phase
@pytest.mark.parametrize("angle", [POSE, (0.5, 3.3, 4.9), (0.5, 4.25, 5.0)])
def test_motion_cause_frame_distance_below_limit_reports_frame(
    phase: Phase, angle: tuple[float, float, float]
) -> None:
    motion = Motion(phase=phase, estimator=moving(angle), reference=np.array(angle))
    x, y, theta = forward_kinematics(ROBOT, np.array(angle))
    along = min(max(x * np.cos(theta) + y * np.sin(theta), 0.0), CLUB_REACH)
    distance = np.hypot(x - along * np.cos(theta), y - along * np.sin(theta))
    for radius, expected in (
        (distance - TINY, Cause.NONE),
        (distance + TINY, Cause.FRAME),
        (nan, Cause.FRAME),
    ):
        motion.parameters["min_frame_distance"] = radius
        assert motion.cause() is expected


@each_phase
@pytest.mark.parametrize("mounted", [0.0, 0.5])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_motion_cause_small_wrist_lever_reports_wrist_lever(
    phase: Phase, side: float, mounted: float
) -> None:
    for beta, expected in (
        (asin(0.15) + TINY, Cause.NONE),
        (asin(0.15) - TINY, Cause.WRIST_LEVER),
        (0.0, Cause.WRIST_LEVER),
        (pi - asin(0.15) - TINY, Cause.NONE),
        (pi - asin(0.15) + TINY, Cause.WRIST_LEVER),
    ):
        angle = (0.5, 4.25, 1.5 * pi + side * beta - mounted)
        motion = Motion(phase=phase, estimator=moving(angle), reference=np.array(angle))
        motion.parameters["min_lever"], motion.parameters["lever_angle"] = 0.15, mounted
        assert motion.cause() is expected
        motion.parameters["min_lever"] = nan
        assert motion.cause() is Cause.WRIST_LEVER


def test_motion_cause_several_broken_limits_reports_first() -> None:
    motion = Motion(step=1.0)
    p = motion.parameters
    motion.readings["supply_pressure"] = 0.0
    p["lower"][0, 2] = 50.0
    p["max_following_error"], p["ground"], p["max_speed"][0, 1] = -1.0, 100.0, 0.0
    mends: tuple[Callable[[], None], ...] = (
        lambda: setattr(motion, "step", 0.001),
        lambda: motion.readings.__setitem__("supply_pressure", 8e5),
        lambda: p.__setitem__("max_following_error", 1e3),
        lambda: p.__setitem__("max_speed", 1e3),
        lambda: p.__setitem__("lower", -100.0),
        lambda: p.__setitem__("ground", -100.0),
    )
    order = []
    for mend in mends:
        order.append(motion.cause())
        mend()
    assert order == [
        Cause.TICK_GAP,
        Cause.SUPPLY_PRESSURE,
        Cause.SHOULDER_FOLLOWING,
        Cause.ARM_SPEED,
        Cause.WRIST_RANGE,
        Cause.GROUND,
    ]
    assert motion.cause() is Cause.NONE


# Joint coordinates ------------------------------------------------------------------------------------


@given(st.floats(pi, 1.5 * pi), st.floats(-20.0, 20.0))
def test_joint_coordinates_arm_uses_rod(theta2: float, velocity: float) -> None:
    angle, speed = np.array([0.1, theta2, 5.5]), np.array([1.0, velocity, 2.0])
    position, rod_speed = joint_coordinates(ROBOT.record, angle, speed, 1)
    assert position == pytest.approx(float(right_arm_length(ROBOT, theta2)) - ROBOT.l56, abs=1e-12)
    h = 1e-6
    slope = (right_arm_length(ROBOT, theta2 + h) - right_arm_length(ROBOT, theta2 - h)) / (2 * h)
    assert rod_speed == pytest.approx(float(slope) * velocity, abs=1e-7)
    assert joint_coordinates(ROBOT.record, angle, speed, 0) == (0.1, 1.0)
    assert joint_coordinates(ROBOT.record, angle, speed, 2) == (5.5, 2.0)


# Limit ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("wanted", [nan, inf, -inf])
@pytest.mark.parametrize("before", [0.75, 0.0, -0.75])
def test_limit_non_finite_opening_returns_centre(wanted: float, before: float) -> None:
    assert limit(generous(), wanted, before, 1e-3) == 0.0


@pytest.mark.parametrize("step", [0.0, -0.0, -1e-3, -inf, nan])
@pytest.mark.parametrize("before", [0.75, 0.1, -0.75])
@pytest.mark.parametrize("wanted", [1.0, 0.0, -1.0])
def test_limit_invalid_step_keeps_opening(step: float, before: float, wanted: float) -> None:
    assert limit(generous(), wanted, before, step) == before


@pytest.mark.parametrize(
    ("wanted", "before", "step", "expected"),
    [
        (below(0.75), 0.75, 1.0, below(0.75)),
        (0.75, 0.7, 1.0, 0.75),
        (above(0.75), 0.7, 1.0, 0.75),
        (-0.75, 0.7, 1.0, -0.75),
        (below(-0.75), 0.7, 1.0, -0.75),
        (1e300, 0.0, 1.0, 0.75),
        # slew 50/s: a 64th of a second is exactly 0.78125, half of that 0.390625
        (0.75, 0.0, 1 / 128, 0.390625),
        (0.390625, 0.0, 1 / 128, 0.390625),
        (below(0.390625), 0.0, 1 / 128, below(0.390625)),
        (-0.75, 0.0, 1 / 128, -0.390625),
        (0.0, 0.75, 1 / 128, 0.359375),
        (0.75, -0.75, inf, 0.75),
    ],
)
def test_limit_bounds_opening_and_slew(wanted: float, before: float, step: float, expected: float) -> None:
    assert limit(generous(), wanted, before, step) == expected


steps = st.floats(-1e300, 1e300) | st.sampled_from([inf, -inf, nan])


@given(st.floats(), st.floats(-0.75, 0.75), steps)
def test_limit_any_input_keeps_opening_and_slew_bounded(wanted: float, before: float, step: float) -> None:
    opening = limit(generous(), wanted, before, step)
    assert abs(opening) <= 0.75
    if np.isfinite(wanted) and step >= 0:
        assert abs(opening - before) <= 50.0 * step + 1e-15
        if wanted == before:
            assert opening == before


# Compiled and plain code ------------------------------------------------------------------------------

Plain = Callable[[Callable[..., Any]], Callable[..., Any]]

near = st.floats(-1e3, 1e3) | st.just(nan)
three = st.tuples(near, near, near)
poses = st.tuples(st.floats(-2.0, 2.0), st.floats(3.0, 5.0), st.floats(4.5, 6.5)) | three


def recarray(record: Record) -> Record:
    return record.view(np.recarray)


@compiled_only
@given(
    angle=poses,
    velocity=three,
    miss=st.tuples(*[st.floats(-0.5, 0.5)] * 3),
    pressure=st.floats(),
    step=st.floats(0.0, 0.011) | st.floats(),
    phase=st.sampled_from(Phase),
    charging=st.booleans(),
    ground=st.floats(-2.0, 0.0),
    radius=st.floats(0.0, 0.5),
    silence=st.tuples(*[st.floats(0.0, 0.005)] * 3),
)
def test_compiled_causes_match_plain_code(
    plain: Plain,
    angle: tuple[float, float, float],
    velocity: tuple[float, float, float],
    miss: tuple[float, float, float],
    pressure: float,
    step: float,
    phase: Phase,
    charging: bool,
    ground: float,
    radius: float,
    silence: tuple[float, float, float],
) -> None:
    p, e, r = generous(), moving(angle), readings()
    p["lower"], p["upper"] = (-1.5, 0.0, 4.8), (1.5, 0.4, 6.2)
    p["max_following_error"], p["min_deceleration"], p["end_stop_max_speed"] = (
        0.4,
        (60.0, 15.0, 150.0),
        (9.0, 5.0, 34.0),
    )
    p["max_speed"], p["ground"] = (26.0, 6.0, 48.0), ground
    p["min_frame_distance"], p["min_lever"] = radius, 0.15
    e["velocity"], e["without_sample"], r["supply_pressure"] = velocity, silence, pressure
    reference = np.array(angle) + np.array(miss)
    robot = ROBOT.record
    ours = motion_cause(p, robot, e, r, reference, int(phase), step, charging)
    theirs = plain(motion_cause)(
        recarray(p), recarray(robot), recarray(e), recarray(r), reference, int(phase), step, charging
    )
    assert ours == theirs
    assert readings_cause(p, e) == plain(readings_cause)(recarray(p), recarray(e))


@compiled_only
@given(st.floats(), st.floats(-0.75, 0.75), steps)
def test_limit_compiled_matches_plain_code(plain: Plain, wanted: float, before: float, step: float) -> None:
    p = generous()
    assert limit(p, wanted, before, step) == plain(limit)(recarray(p), wanted, before, step)
