"""The model-based check: the observer follows the plant, and each comparison fails at its limit only."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from bench.base.lifecycle import Cause, Phase, Request, State
from bench.control.envelope import ENVELOPE_PARAMETERS
from bench.control.estimate.estimator import ESTIMATOR_STATE
from bench.control.estimate.residual_monitor import (
    ARMING,
    BRAKING,
    LEARNING,
    MODEL_LIMITS,
    MODEL_STATE,
    SHOCK,
    model_cause,
    note_deviations,
    observe,
    row_of,
)
from bench.control.settings import EnvelopeSettings, ModelSettings, build_controller
from bench.control.step_records import new_control_state
from bench.simulation.lockstep import Lockstep
from bench.simulation.swing_operator import LockstepEngine
from bench.swing.library import find_profile
from bench.swing.profile import load_profile
from drivers.base.compiled import new_record
from drivers.base.records import READINGS
from sim.plant import PlantParameters, build_plant
from sim.robot import RobotParameters
from tests.compiled_only import needs_speed

PLANT = build_plant(PlantParameters()).plant
ROBOT = RobotParameters().record
ENVELOPE = new_record(ENVELOPE_PARAMETERS)
ENVELOPE["ground"], ENVELOPE["sole_depth"], ENVELOPE["ball_x"] = -1.62, 0.03, 0.25
SPEEDS = np.zeros(3)
INDEXED = np.ones(3, dtype=np.uint8)
AWAY = np.array([-1.0, 0.5, 0.0, 40.0, 0.0, 0.0])
"""A fast head far from ball and turf."""


def limits() -> np.ndarray[Any, Any]:
    made = new_record(MODEL_LIMITS)
    made["check"] = True
    for k, name in enumerate(("air", "velocity", "jump", "effort", "flow"), 1):
        made[name] = 10.0 * k
    return made


def settled() -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    model, estimator = new_record(MODEL_STATE), new_record(ESTIMATOR_STATE)
    model["settled"] = 0.05
    return model, estimator


def judged(model: Any, estimator: Any, reference: Any = SPEEDS, phase: Phase = Phase.TOP) -> Cause:
    return Cause(model_cause(limits(), model[0], estimator, np.asarray(reference, float), int(phase)))


@pytest.mark.parametrize(("field", "limit", "valve"), [("residual", 10.0, "AIR"), ("flow", 50.0, "FLOW")])
@pytest.mark.parametrize("joint", range(3))
@pytest.mark.parametrize("side", range(2))
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_model_cause_chamber_over_limit_reports_sensor_or_valve(
    field: str, limit: float, valve: str, joint: int, side: int, sign: float
) -> None:
    model, estimator = settled()
    name = ("SHOULDER", "ARM", "WRIST")[joint]
    model[field][0, 2 * joint + side] = sign * limit
    assert judged(model, estimator) is Cause.NONE
    model[field][0, 2 * joint + side] = sign * limit * 1.00001
    assert judged(model, estimator) is Cause[f"{name}_SENSOR"]
    model[field][0, 2 * joint + 1 - side] = 0.2 * limit
    assert judged(model, estimator) is Cause[f"{name}_SENSOR"]
    model[field][0, 2 * joint + 1 - side] = -0.2001 * limit
    assert judged(model, estimator) is Cause[f"{name}_{valve}"]


@pytest.mark.slow
def test_observe_flow_keeps_lasting_residual_and_damps_single_sample() -> None:
    model, estimator, readings = still()
    watch(model, estimator, readings, 5)
    readings["chamber_pressure"][0, 0] += 2e4  # one sample
    watch(model, estimator, readings, 1)
    once = abs(model["flow"][0, 0])
    assert 0.0 < once < 1e3
    for k in range(200):
        readings["chamber_pressure"][0, 2] += 500.0 + k % 2
        watch(model, estimator, readings, 1)
    assert model["flow"][0, 2] == pytest.approx(model["residual"][0, 2], rel=0.3)
    assert abs(model["flow"][0, 0]) < once
    readings["chamber_pressure"][0, 3] = np.nan
    watch(model, estimator, readings, 1)
    assert (model["flow"][0, 2:4] == 0.0).all()


@pytest.mark.parametrize("joint", range(3))
@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(
    ("record", "field", "limit", "cause"),
    [(1, "velocity", 20.0, "VELOCITY"), (1, "innovation", 30.0, "JUMP"), (0, "effort", 40.0, "EFFORT")],
)
def test_model_cause_velocity_jump_or_effort_over_limit_reports_cause(
    joint: int, sign: float, record: int, field: str, limit: float, cause: str
) -> None:
    state = settled()
    state[record][field][0, joint] = sign * limit
    assert judged(*state) is Cause.NONE
    state[record][field][0, joint] = sign * (limit + 1e-6)
    assert judged(*state) is Cause[f"{('SHOULDER', 'ARM', 'WRIST')[joint]}_{cause}"]


def test_model_cause_velocity_is_relative_to_reference() -> None:
    model, estimator = settled()
    estimator["velocity"][0, 1] = 50.0
    assert judged(model, estimator, (0.0, 45.0, 0.0)) is Cause.NONE
    assert judged(model, estimator, (0.0, 29.0, 0.0)) is Cause.ARM_VELOCITY


def test_model_cause_nan_residual_reports_none() -> None:
    model, estimator = settled()
    model["residual"] = model["effort"] = np.nan
    assert judged(model, estimator) is Cause.NONE


def test_model_cause_unsettled_or_off_reports_none() -> None:
    model, estimator = settled()
    estimator["innovation"] = 1e3
    assert judged(model, estimator) is Cause.SHOULDER_JUMP
    model["settled"] = 0.049
    assert judged(model, estimator) is Cause.NONE
    model["settled"] = 1.0
    off = limits()
    off["check"] = False
    assert model_cause(off, model[0], estimator, SPEEDS, int(Phase.TOP)) == 0


@pytest.mark.parametrize("name", ["residual", "flow"])
@pytest.mark.parametrize(("other", "spool"), [(0.1, False), (0.5, False), (1.1, True)])
def test_model_cause_suspect_joint_reports_spool_only_over_second_limit(
    name: str, other: float, spool: bool
) -> None:
    """A leaking chamber also shifts the other one's residual: the shoulder was cut off in its brake."""
    model, estimator = settled()
    limit = 10.0 if name == "residual" else 50.0
    model[name][0, 2], model[name][0, 3] = 3.0 * limit, other * limit

    def cause(doubted: int) -> Cause:
        return Cause(model_cause(limits(), model[0], estimator, SPEEDS, int(Phase.TOP), doubted))

    valve = Cause.ARM_AIR if name == "residual" else Cause.ARM_FLOW
    assert cause(1) is (valve if spool else Cause.ARM_SENSOR)
    assert cause(0) is cause(-1) is (valve if other > 0.2 else Cause.ARM_SENSOR)


@pytest.mark.parametrize("vent", [0.0, 1e-8])
def test_observe_open_vents_follow_measured_pressure(vent: float) -> None:
    model, estimator, readings = still()
    watch(model, estimator, readings, 600, vent=vent)
    followed = model["air"][0, 6:12] == readings["chamber_pressure"][0]
    assert bool(followed.all()) is (vent > 0.0)  # how much they pass is not known well enough to judge by


def test_model_cause_uses_limits_of_phase() -> None:
    built = limits()
    built["jump"][0, Phase.HOLD] = 0.5
    model, estimator = settled()
    estimator["innovation"] = 1.0
    assert model_cause(built, model[0], estimator, SPEEDS, int(Phase.HOLD)) == Cause.SHOULDER_JUMP
    assert model_cause(built, model[0], estimator, SPEEDS, int(Phase.TOP)) == 0


def still() -> tuple[Any, Any, Any]:
    model, estimator, readings = new_record(MODEL_STATE), new_record(ESTIMATOR_STATE), new_record(READINGS)
    estimator["angle"] = (0.3, 4.4, 6.0)
    readings["chamber_pressure"], readings["supply_pressure"] = 4.5e5, 8e5
    return model, estimator, readings


def watch(
    model: Any,
    estimator: Any,
    readings: Any,
    ticks: int,
    step: float = 1e-3,
    valve: float = 0.0,
    head: Any = AWAY,
    indexed: Any = INDEXED,
    vent: float = 0.0,
    braking: bool = False,
) -> None:
    for _ in range(ticks):
        applied = np.array([valve, 0.0, 0.0])
        observe(
            *(model[0], ROBOT, PLANT, ENVELOPE, estimator, indexed, readings, applied),
            *(SPEEDS, head, vent, braking, step),
        )


def test_observe_settled_time_restarts_after_stall() -> None:
    model, estimator, readings = still()
    watch(model, estimator, readings, 51)
    assert model["settled"][0] == pytest.approx(0.05)
    watch(model, estimator, readings, 1, step=0.005)
    assert model["settled"][0] == 0.0


def run_into_cushion(model: Any, estimator: Any, readings: Any, joint: int, speed: float) -> None:
    """Let `joint` come from its middle to its upper cushion at `speed` rad/s."""
    watch(model, estimator, readings, 60)
    estimator["velocity"][0, joint] = speed
    estimator["angle"][0, joint] = (float(PLANT["upper"][0, 0]) + 0.01, 5.2, 6.5)[joint]
    watch(model, estimator, readings, 1)


@pytest.mark.parametrize("joint", range(3))
def test_observe_cushion_impact_uses_shock_limits_briefly(joint: int) -> None:
    built = limits()
    built["velocity"][0, SHOCK], built["jump"][0, SHOCK] = 200.0, 300.0
    model, estimator, readings = still()
    run_into_cushion(model, estimator, readings, joint, 5.0)
    assert model["effort"].tolist() == [[0.0, 0.0, 0.0]]

    def cause(innovation: float, speed: float) -> Cause:
        estimator["innovation"] = innovation
        reference = estimator["velocity"][0] + speed
        return Cause(model_cause(built, model[0], estimator, reference, int(Phase.COMMITTED)))

    assert cause(299.0, 199.0) is Cause.NONE
    assert cause(301.0, 0.0) is Cause.SHOULDER_JUMP
    assert cause(0.0, 201.0) is Cause.SHOULDER_VELOCITY
    watch(model, estimator, readings, 31)  # it stays there
    assert cause(31.0, 0.0) is Cause.SHOULDER_JUMP
    assert cause(0.0, 21.0) is Cause.SHOULDER_VELOCITY


@pytest.mark.parametrize(
    ("x", "over_turf", "speed", "blow"),
    [
        (0.25 + 0.07, 0.05, 40.0, True),
        (0.25 - 0.09, 0.05, 40.0, False),
        (0.25, 0.13, 40.0, False),
        (0.25, 0.03, 2.0, False),
        (-0.5, 0.005, 40.0, True),
        (-0.5, 0.02, 40.0, False),
    ],
)
def test_observe_fast_head_near_ball_or_turf_sets_blow(
    x: float, over_turf: float, speed: float, blow: bool
) -> None:
    model, estimator, readings = still()
    watch(model, estimator, readings, 60)
    head = np.array([x, -1.62 + 0.03 + over_turf, 0.0, speed, 0.0, 0.0])
    watch(model, estimator, readings, 1, head=head)
    assert (model["blow"][0] > 0.0) == blow


@pytest.mark.parametrize("kind", ["air", "flow", "effort"])
def test_model_cause_blow_uses_wider_shock_limits(kind: str) -> None:
    built = limits()
    built[kind][0, SHOCK] = 1e3
    model, estimator = settled()
    field = {"air": "residual", "flow": "flow", "effort": "effort"}[kind]
    model[field] = 900.0
    row = int(Phase.DOWNSWING)
    assert model_cause(built, model[0], estimator, SPEEDS, row) != 0
    model["blow"] = 0.01
    assert model_cause(built, model[0], estimator, SPEEDS, row) == 0
    built[kind][0, SHOCK] = 1.0
    model[field] = 9.0
    assert model_cause(built, model[0], estimator, SPEEDS, row) == 0  # never tighter than the phase's


def test_model_cause_braking_and_learning_use_separate_limits() -> None:
    built = limits()
    built["jump"][0, BRAKING + Phase.TOP], built["jump"][0, LEARNING + Phase.TOP] = 1.0, 50.0
    model, estimator = settled()
    estimator["innovation"] = 20.0
    top = int(Phase.TOP)
    assert model_cause(built, model[0], estimator, SPEEDS, top) == 0
    assert model_cause(built, model[0], estimator, SPEEDS, BRAKING + top) == Cause.SHOULDER_JUMP
    estimator["innovation"] = 40.0
    assert model_cause(built, model[0], estimator, SPEEDS, top) == Cause.SHOULDER_JUMP
    built["first_row"] = LEARNING
    assert model_cause(built, model[0], estimator, SPEEDS, top) == 0


def test_row_of_armed_return_uses_arming_limits() -> None:
    control = new_control_state().control
    control["phase"] = Phase.RETURN
    rows = {}
    for state in (State.ARMED, State.SWINGING, State.RECOVERING):
        control["state"] = state
        rows[state] = row_of(control[0])
    assert rows == {State.ARMED: ARMING, State.SWINGING: Phase.RETURN, State.RECOVERING: Phase.RETURN}
    control["state"], control["phase"] = State.ARMED, Phase.HOLD
    assert row_of(control[0]) == Phase.HOLD
    built = build_controller(PlantParameters(), load_profile(find_profile("default"))).model
    default = ModelSettings()
    for first in (0, LEARNING):
        assert built["air"][0, first + ARMING].tolist() == list(default.air["arming"])
        assert built["air"][0, first + Phase.RETURN].tolist() == list(default.air["return"])


def test_note_deviations_keeps_largest_per_row() -> None:
    largest = np.zeros((5, LEARNING, 3))
    model, estimator = settled()
    model["residual"], model["flow"] = [[3.0, -4.0, np.nan, 1.0, 0.0, 0.0]], 0.0
    model["effort"], estimator["innovation"] = [[-7.0, np.nan, 1.0]], [[0.1, -0.2, 0.3]]
    estimator["velocity"] = [[5.0, 0.0, 0.0]]
    note_deviations(largest, model[0], estimator, np.array([1.0, 2.0, 3.0]), int(Phase.TOP))
    row = largest[:, Phase.TOP]
    assert row[[0, 2, 3, 4]].tolist() == [[4, 1, 0], [4, 2, 3], [0.1, 0.2, 0.3], [7, 0, 1]]
    model["residual"] = 1.0
    note_deviations(largest, model[0], estimator, SPEEDS, int(Phase.TOP))
    assert largest[0, Phase.TOP].tolist() == [4, 1, 1]
    model["blow"] = 0.01
    note_deviations(largest, model[0], estimator, SPEEDS, int(Phase.TOP))
    assert largest[0, SHOCK].tolist() == [1, 1, 1]
    model["settled"] = 0.0
    note_deviations(largest, model[0], estimator, SPEEDS, int(Phase.HOLD))
    assert not largest[:, Phase.HOLD].any()


def test_observe_slow_cushion_contact_sets_no_blow() -> None:
    model, estimator, readings = still()
    run_into_cushion(model, estimator, readings, 0, 0.4)
    assert model["blow"][0] == 0.0


def test_observe_missing_chamber_pressure_skips_actuator() -> None:
    model, estimator, readings = still()
    readings["chamber_pressure"][0, 2] = np.nan
    watch(model, estimator, readings, 5)
    readings["chamber_pressure"][0] += 1e5
    watch(model, estimator, readings, 1)
    assert np.isnan(model["residual"][0, 2:4]).all()
    assert model["residual"][0, [0, 1, 4, 5]] == pytest.approx(1e5, rel=0.05)


def test_observe_unindexed_joint_has_no_residual_and_no_effort() -> None:
    model, estimator, readings = still()
    watch(model, estimator, readings, 80)
    assert model["effort"].all()
    readings["chamber_pressure"][0] += 1e5
    watch(model, estimator, readings, 1, indexed=np.array([1, 1, 0], dtype=np.uint8))
    assert np.isnan(model["residual"][0, 4:]).all()
    assert model["residual"][0, :4] == pytest.approx(1e5, rel=0.05)
    assert not model["effort"].any()  # the wrist's angle moves every joint's inertia
    readings["chamber_pressure"][0] += 1e5
    watch(model, estimator, readings, 1)
    assert model["residual"][0, 4:] == pytest.approx(1e5, rel=0.05)


def test_observe_missing_supply_pressure_gives_nan_residuals() -> None:
    model, estimator, readings = still()
    readings["supply_pressure"] = np.nan
    watch(model, estimator, readings, 5)
    assert np.isnan(model["residual"]).all()


@pytest.mark.parametrize("joint", range(3))
def test_observe_after_nan_recovers(joint: int) -> None:
    model, estimator, readings = still()

    def run(ticks: int) -> None:
        for _ in range(ticks):
            readings["chamber_pressure"] += 1.0  # only a new value counts
            watch(model, estimator, readings, 1)

    run(60)
    for spoilt, name in ((readings, "chamber_pressure"), (estimator, "angle"), (model, "air")):
        before = spoilt[name].copy()
        location = 6 + 2 * joint if name == "air" else 2 * joint if name == "chamber_pressure" else joint
        spoilt[name][0, location] = np.nan
        run(1)
        spoilt[name] = before
        run(60)
        assert np.isfinite(model["air"]).all(), name
        assert np.isfinite(model["residual"]).all(), name
        readings["chamber_pressure"][0, 2 * joint] += 5e4
        run(1)
        assert abs(model["residual"][0, 2 * joint]) > 2e4, name  # it is seen again
        readings["chamber_pressure"][0, 2 * joint] -= 5e4
        run(60)


@pytest.mark.parametrize(
    ("along", "above", "speed", "braking", "blow"),
    [
        (0.14, 0.14, 1.1, True, 0.03),
        (0.14, 0.14, 1.1, False, 0.0),
        (0.14, 0.14, 0.9, True, 0.0),
        (0.16, 0.14, 1.1, True, 0.0),
        (0.14, 0.16, 1.1, True, 0.0),
    ],
)
def test_observe_braking_lowers_speed_limit_of_blow(
    along: float, above: float, speed: float, braking: bool, blow: float
) -> None:
    model, estimator, readings = still()
    head = np.array([0.25 + along, -1.62 + above, 0.0, speed, 0.0, 0.0])
    watch(model, estimator, readings, 2, head=head, braking=braking)
    assert model["blow"][0] == blow


def test_observe_valve_command_fills_modelled_chamber() -> None:
    model, estimator, readings = still()
    watch(model, estimator, readings, 5)
    watch(model, estimator, readings, 8, valve=1.0)
    readings["chamber_pressure"] += 1.0  # sensors that tell something new
    watch(model, estimator, readings, 1, valve=1.0)
    assert model["residual"][0, 0] < -3e4
    assert abs(model["residual"][0, 4]) < 2e3


def test_observe_follows_measured_pressure() -> None:
    model, estimator, readings = still()
    watch(model, estimator, readings, 5)
    for k in range(60):
        readings["chamber_pressure"][0, 1] = 5e5 + k % 2
        watch(model, estimator, readings, 1)
    assert abs(model["residual"][0, 1]) < 2e3


def armed(check: Any) -> Lockstep:
    """Return a bench at the address of the shipped swing, with its air as planned."""
    profile = load_profile(find_profile("default"))
    envelope = EnvelopeSettings(model=ModelSettings(check=check))
    parameters = build_controller(PlantParameters(), profile, envelope=envelope)
    stepper = Lockstep(build_plant(PlantParameters()), parameters, profile.angle[0])
    engine = LockstepEngine(stepper)
    assert engine.arm()
    assert engine.await_air()
    return stepper


@pytest.mark.slow
@needs_speed
def test_residual_monitor_fault_free_swing_stays_below_limits() -> None:
    stepper = armed("always")
    stepper.state.control["tee"] = True
    worst, request = 0.0, int(Request.SWING)
    for _ in range(len(stepper.parameters.angle) // 5):
        stepper.advance(5, request)
        request = 0
        phase = int(stepper.state.control["phase"][0])
        model, limit = stepper.state.model[0], stepper.parameters.model[0]
        air = np.abs(model["residual"]).reshape(3, 2).max(axis=1) / limit["air"][phase]
        worst = max(
            worst, float(np.nanmax(air)), float(np.nanmax(np.abs(model["effort"]) / limit["effort"][phase]))
        )
    assert stepper.state.control["cause"][0] == 0
    assert worst < 0.8


@needs_speed
def test_model_check_fault_free_swing_keeps_record_identical() -> None:
    off, always = (armed(check).advance(2000, Request.SWING).tobytes() for check in ("off", "always"))
    assert off == always


@needs_speed
def test_observe_compiled_equals_plain(plain: Callable[[Callable[..., Any]], Callable[..., Any]]) -> None:
    random = np.random.default_rng(1)
    one, two = new_record(MODEL_STATE), new_record(MODEL_STATE).view(np.recarray)
    robot, plant = ROBOT.view(np.recarray), PLANT.view(np.recarray)
    slow = plain(observe)
    for _ in range(100):
        estimator, readings = new_record(ESTIMATOR_STATE), new_record(READINGS)
        estimator["angle"] = np.array([0.3, 4.4, 6.0]) + 0.05 * random.normal(size=3)
        estimator["velocity"], estimator["acceleration"] = random.normal(size=(2, 3)) * [[5.0], [50.0]]
        readings["chamber_pressure"] = random.uniform(1e5, 8e5, 6)
        readings["supply_pressure"] = 8e5
        applied = random.uniform(-1.0, 1.0, 3)
        observe(
            *(one[0], ROBOT, PLANT, ENVELOPE, estimator, INDEXED, readings, applied),
            *(SPEEDS, AWAY, 0.0, False, 1e-3),
        )
        seen = (estimator.view(np.recarray), INDEXED, readings.view(np.recarray), applied)
        slow(two[0], robot, plant, ENVELOPE.view(np.recarray), *seen, SPEEDS, AWAY, 0.0, False, 1e-3)
    for name in MODEL_STATE.names or ():
        np.testing.assert_allclose(
            np.asarray(one[name], float), np.asarray(two[name], float), rtol=1e-9, atol=1e-9
        )
