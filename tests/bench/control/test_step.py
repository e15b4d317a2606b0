"""The deciding step against made-up readings: joints that are where the test puts them, and garbage."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from math import inf, nan, pi
from typing import Any

import numba
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numba.core.runtime import _nrt_python, rtsys

from bench.base.lifecycle import (
    ACTUATOR_FAULT,
    CHAMBER_SUSPECT,
    EMERGENCY,
    READINGS_LOST,
    READINGS_VALID,
    STOP_REACTIONS,
    WRIST_FAULT,
    Answer,
    Cause,
    Phase,
    Reaction,
    Request,
    State,
)
from bench.control.step import step
from bench.control.step_records import ControlState
from bench.records.telemetry.cycle_record import CYCLE
from bench.swing.profile import Profile
from drivers.base import PASSIVE
from drivers.base.compiled import new_record
from drivers.base.records import COMMAND, unpack_command
from tests.bench.control.operating import reach
from tests.bench.control.puppet import (
    ADDRESS,
    BEGINS,
    COUNTS,
    GOOD,
    QUICK,
    SAMPLES,
    SPACING,
    STILL,
    Array,
    Puppet,
    entered,
)
from tests.sampling import release_except

compiled_only = pytest.mark.skipif(
    bool(numba.config.DISABLE_JIT), reason="plain integers do not wrap around as compiled ones do"
)


each_phase = pytest.mark.parametrize("phase", list(Phase), ids=lambda phase: phase.name)
moving_phase = pytest.mark.parametrize("phase", list(Phase)[1:], ids=lambda phase: phase.name)


# Power-up, arming, requests ---------------------------------------------------------------------------


def test_power_up_stands_without_energy() -> None:
    puppet = Puppet()
    for _ in range(20):
        puppet.tick()
        assert (puppet.phase, puppet.reaction, puppet.cause) == (Phase.STANDING, 0, 0)
        assert puppet.is_without_energy()


@pytest.mark.parametrize("name", GOOD)
def test_arm_open_interlock_refused(name: str) -> None:
    puppet = Puppet()
    puppet.run(10)
    puppet.readings[name] = False
    assert puppet.tick(Request.ARM) == Answer.REFUSED
    assert puppet.is_without_energy()
    puppet.readings[name] = True
    puppet.run(5)
    assert puppet.phase is Phase.STANDING  # a refused request is forgotten
    assert puppet.tick(Request.ARM) == Answer.REFUSED  # and the interlock has latched
    assert (puppet.tick(Request.RESET), puppet.tick(Request.ARM)) == (Answer.ACCEPTED, Answer.ACCEPTED)


@pytest.mark.parametrize("joint", range(3))
def test_arm_invalid_encoder_refused(joint: int) -> None:
    puppet = Puppet()
    puppet.readings["encoder_valid"][0, joint] = 0
    puppet.run(10)
    assert puppet.tick(Request.ARM) == Answer.REFUSED
    puppet.readings["encoder_valid"] = 1
    puppet.run(2)
    assert puppet.tick(Request.ARM) == Answer.ACCEPTED


def test_guard_opened_by_force_at_standstill_resets_answers() -> None:
    puppet = Puppet()
    puppet.run(10)
    assert puppet.control["first_motion"]["answered"].all()
    puppet.readings["guard_closed"] = False
    puppet.tick()
    assert not puppet.control["first_motion"]["answered"].any()


def test_access_through_guard_with_bridged_switch_resets_answers() -> None:
    puppet = reach(State.ACCESS)
    assert puppet.readings["guard_closed"].all()
    puppet.tick()
    assert not puppet.control["first_motion"]["answered"].any()


def test_guard_opened_by_force_in_brake_resets_answers_at_standstill() -> None:
    puppet = Puppet()
    puppet.tick(Request.ARM)
    puppet.run(500)
    puppet.give(guard_closed=False).run(3)
    puppet.give(guard_closed=True).run(3_000)
    assert (puppet.bench, puppet.cause) == (State.FAULT, Cause.GUARD)
    assert not puppet.control["first_motion"]["answered"].any()


def test_arm_starts_reference_at_current_pose() -> None:
    puppet = Puppet()
    puppet.angle = ADDRESS + [-0.2, 0.1, -0.3]
    puppet.run(50)
    found = puppet.state.estimator["angle"][0].copy()
    puppet.tick(Request.ARM)
    assert puppet.control["reference"] == pytest.approx(found, abs=1e-4)
    assert puppet.control["reference_velocity"] == pytest.approx(0.0)
    assert np.abs(puppet.state.pid["output"][0]).max() < 0.01
    assert np.abs(puppet.record["valve"]).max() <= QUICK.precharge_opening + 0.01
    assert puppet.record["supply_enable"][0]


def test_arm_again_starts_with_small_openings() -> None:
    puppet = entered(Phase.HOLD)
    puppet.shift(0, -0.012)
    puppet.run(500)
    assert np.abs(puppet.state.pid["integral"][0]).max() > 0.001
    puppet.tick(Request.DISARM)
    puppet.offset[:] = 0.0
    puppet.angle = ADDRESS + [-0.2, 0.1, -0.3]  # it sank while it was vented
    puppet.run(50)
    puppet.parameters.control["precharge_opening"] = 0.0
    puppet.tick(Request.ARM)
    openings = [puppet.record["valve"][0].copy()]
    for _ in range(15):  # charging: nothing moves yet
        puppet.tick()
        openings.append(puppet.record["valve"][0].copy())
    assert np.abs(openings).max() < 0.01


def test_precharge_swings_spools_around_centre() -> None:
    puppet = Puppet(control=replace(QUICK, precharge_time=0.4))
    puppet.run(10)
    openings = puppet.run(400, Request.ARM)
    assert np.abs(openings.mean(axis=0)).max() < 0.01
    assert np.abs(openings[1:]).min() > 0.5 * QUICK.precharge_opening  # the slew limit's
    assert np.ptp(openings) < 2 * QUICK.precharge_opening + 0.02


def test_precharge_monitors_all_but_supply_pressure() -> None:
    puppet = Puppet(control=replace(QUICK, precharge_time=0.4))
    puppet.give(supply_pressure=1e5)
    puppet.run(10)
    puppet.run(200, Request.ARM)
    assert puppet.reaction is Reaction.NONE
    puppet.run(250)
    assert (puppet.reaction, puppet.cause) == (Reaction.BRAKE, Cause.SUPPLY_PRESSURE)

    puppet = Puppet(control=replace(QUICK, precharge_time=0.6))
    puppet.run(10)
    puppet.tick(Request.ARM)
    for _ in range(250):  # a valve stuck open drives the shoulder away
        puppet.offset[0] -= 0.002
        puppet.tick()
    assert (puppet.reaction, puppet.cause) == (Reaction.PASSIVE, Cause.SHOULDER_FOLLOWING)


def test_move_to_address_stays_smooth_within_move_speed() -> None:
    puppet = Puppet()
    puppet.angle = ADDRESS + [-0.3, 0.1, -0.4]
    puppet.run(10)
    puppet.tick(Request.ARM)
    references = []
    for _ in range(900):
        puppet.tick()
        references.append(puppet.control["reference"].copy())
    assert puppet.phase is Phase.HOLD
    speed = np.abs(np.diff(references, axis=0)) / 1e-3
    assert (speed.max(axis=0) <= np.array(QUICK.move_speed) * (1 + 1e-6)).all()
    assert np.abs(np.diff(speed, axis=0)).max() < 0.05


def test_move_to_address_missed_address_reports_timeout() -> None:
    puppet = Puppet()
    puppet.run(10)
    puppet.tick(Request.ARM)
    puppet.shift(0, 0.06)
    puppet.run(300)
    assert (puppet.phase, puppet.reaction) == (Phase.RETURN, Reaction.NONE)
    puppet.run(60)
    assert puppet.cause is Cause.ADDRESS_TIMEOUT
    puppet.run(200)
    assert (puppet.phase, puppet.reaction) == (Phase.STANDING, Reaction.VENT)


def test_swing_start_keeps_openings_continuous() -> None:
    profile = replace(STILL, valve=np.full((SAMPLES, 3), 0.2))
    puppet = Puppet(profile).hold()
    for joint, miss in enumerate((0.01, -0.01, 0.02)):
        puppet.shift(joint, miss)
    before = puppet.run(300)[-1]
    assert np.abs(before).min() > 0.001
    puppet.tick(Request.SWING)
    assert puppet.record["valve"][0] == pytest.approx(before, abs=2e-3)


@each_phase
def test_disarm_vents_hold_and_brakes_slow_move(phase: Phase) -> None:
    puppet = entered(phase)
    quiet, slow = phase is Phase.HOLD, phase in {Phase.RETURN, Phase.HOMING}
    assert puppet.tick(Request.DISARM) == (Answer.ACCEPTED if quiet or slow else Answer.REFUSED)
    if quiet:
        assert (puppet.phase, puppet.is_without_energy()) == (Phase.STANDING, True)
    if slow:
        assert (puppet.reaction, puppet.cause) == (Reaction.BRAKE, Cause.NONE)
        puppet.run(1600)
        rests = State.SAFE if phase is Phase.HOMING else State.READY
        assert (puppet.bench, puppet.is_without_energy()) == (rests, True)


def test_disarm_during_brake_refused() -> None:
    puppet = entered(Phase.HOLD)
    puppet.readings["guard_closed"] = False
    puppet.tick()
    assert puppet.reaction is Reaction.BRAKE
    assert puppet.tick(Request.DISARM) == Answer.REFUSED
    assert puppet.reaction is Reaction.BRAKE


@each_phase
def test_stop_accepted_in_each_phase(phase: Phase) -> None:
    puppet = entered(phase)
    assert puppet.tick(Request.STOP) == Answer.ACCEPTED
    assert puppet.tick(Request.STOP) == Answer.ACCEPTED
    assert puppet.cause is Cause.OPERATOR_STOP
    puppet.readings["encoder_valid"] = 0
    puppet.run(20)
    assert puppet.tick(Request.STOP) == Answer.ACCEPTED


@each_phase
def test_step_answers_each_request_once(phase: Phase) -> None:
    for request in (*range(1, len(Request)), 11, 255):
        puppet = entered(phase)
        answer = puppet.tick(request)
        allowed = {Answer.ACCEPTED, Answer.REFUSED} if request < len(Request) else {Answer.REFUSED}
        assert answer in allowed, request
        assert puppet.tick() == 0, request


# The profile ------------------------------------------------------------------------------------------


def curved(period: float = 1e-3) -> Profile:
    """Return a slow swing whose tables are no straight lines."""
    part = np.linspace(0.0, 1.0, SAMPLES)[:, None]
    swell = np.sin(pi * part) ** 2 * [-0.2, -0.05, -0.1]
    velocity = np.gradient(swell, period, axis=0)
    return replace(STILL, period=period, angle=ADDRESS + swell, velocity=velocity, valve=0.1 * velocity)


@pytest.mark.parametrize("tick", [1e-3, 5e-4, 1 / 3000, 1 / 700], ids=["1 kHz", "2 kHz", "3 kHz", "700 Hz"])
def test_profile_interpolates_between_samples(tick: float) -> None:
    profile = curved()
    puppet = Puppet(profile, replace(QUICK, gains="hand", damping=(0.0, 0.0, 0.0)), tick)
    puppet.run(10)
    puppet.tick(Request.ARM)
    puppet.run(round(0.5 / tick))
    puppet.tick(Request.SWING)
    start = puppet.time
    table = np.arange(SAMPLES)
    while True:
        at = (puppet.time - start) / profile.period
        if at >= SAMPLES - 1 - 1e-6:
            break
        assert puppet.control["swing"]["sample"] == int(at + 1e-6)
        assert puppet.phase is profile.phase_of(int(at + 1e-6))
        for name, values in (
            ("reference", profile.angle),
            ("reference_velocity", profile.velocity),
            *((("feed_forward", profile.valve),) if puppet.phase is not Phase.FOLLOW_THROUGH else ()),
        ):
            expected = [np.interp(at, table, values[:, i]) for i in range(3)]
            assert puppet.control[name] == pytest.approx(np.array(expected), abs=1e-6)
        puppet.tick()
        assert puppet.reaction is Reaction.NONE
    assert puppet.phase is Phase.RETURN


def test_dither_acts_until_top_only() -> None:
    puppet = Puppet(control=replace(QUICK, dither=(0.1, 0.2, 0.0), dither_period=0.02, damping=(0.0,) * 3))
    puppet.parameters.control["dither_delay"] = 0.15
    puppet.swing(0)
    openings = puppet.run(BEGINS[5])
    before, moving, down = openings[:145], openings[152 : BEGINS[3] - 2], openings[BEGINS[3] :]
    assert np.abs(before).max() < 0.01
    assert np.abs(moving) == pytest.approx(np.tile([0.1, 0.2, 0.0], (len(moving), 1)), abs=0.01)
    assert (np.diff(moving[:, 0]) > 0.1).sum() == pytest.approx(len(moving) / 20, abs=1)
    assert np.abs(down).max() < 0.01


def test_downswing_damping_scales_damping_in_downswing_only() -> None:
    added = {}
    for share in (0.0, 1.0):
        puppet = Puppet(curved(), replace(QUICK, downswing_damping=share)).swing(50)
        profile = curved()
        for phase, last in (("backswing", BEGINS[2]), ("downswing", BEGINS[3] + 100)):
            while puppet.control["swing"]["sample"] < last - 10:
                puppet.tick()
            planned = profile.valve[int(puppet.control["swing"]["sample"])]
            added[share, phase] = np.abs(puppet.control["feed_forward"] - planned).max()
    assert added[0.0, "downswing"] < 1e-6
    assert added[1.0, "downswing"] > 1e-4
    assert added[0.0, "backswing"] == added[1.0, "backswing"] > 1e-4


def test_swing_end_returns_and_holds() -> None:
    puppet = Puppet().swing(SAMPLES - 2)
    puppet.tick()
    assert (puppet.phase, bool(puppet.control["swinging"])) == (Phase.RETURN, False)
    puppet.run(400)
    assert (puppet.phase, puppet.cause) == (Phase.HOLD, Cause.NONE)
    assert puppet.tick(Request.SWING) == Answer.ACCEPTED
    assert puppet.control["swings"] == 2


@pytest.mark.parametrize("back", [0.001, 0.1, 10.0, 1e6])
def test_swing_backward_clock_stops_within_tables(back: float) -> None:
    puppet = Puppet().swing(250)
    puppet.time -= back + puppet.period
    puppet.tick()
    assert 0 <= puppet.control["swing"]["sample"] <= 250
    assert puppet.reaction is not Reaction.NONE
    assert np.isfinite(puppet.control["reference"]).all()


# The stopping table -----------------------------------------------------------------------------------


def _guard(puppet: Puppet) -> None:
    puppet.give(guard_closed=False, guard_locked=False)


def _lost(puppet: Puppet) -> None:
    puppet.readings["encoder_valid"][0, 1] = 0


def _emergency(puppet: Puppet) -> None:
    puppet.readings["emergency_stop_clear"] = False


def _disobeyed(puppet: Puppet) -> None:
    puppet.parameters.envelope["max_following_error"][0, :, 0] = -1.0


def _wrist_disobeyed(puppet: Puppet) -> None:
    puppet.parameters.envelope["max_following_error"][0, :, 2] = -1.0


def model_checked(puppet: Puppet, **limits: float) -> Puppet:
    """Let the model-based check fail at `limits` only, as soon as it likes."""
    model = puppet.parameters.model
    model["check"] = True
    for kind in ("air", "flow", "velocity", "jump", "effort"):
        model[kind] = limits.get(kind, np.inf)
    puppet.state.model["started"], puppet.state.model["settled"] = True, 1.0
    return puppet


def _doubted(puppet: Puppet) -> None:
    puppet.give(encoder_indexed=1)  # without its zero a joint has no chambers to compare
    model_checked(puppet)
    puppet.state.model["started"] = False  # it takes over what it sees first
    for k in range(3):
        puppet.readings["chamber_pressure"] = 4e5 + k
        puppet.tick()
    puppet.readings["chamber_pressure"] = 4e5
    puppet.readings["chamber_pressure"][0, 0] = 5e5
    model_checked(puppet, air=5e4)


PROVOKED: dict[int, tuple[Callable[[Puppet], None], Cause]] = {
    READINGS_VALID: (_guard, Cause.GUARD),
    READINGS_LOST: (_lost, Cause.ARM_ENCODER),
    EMERGENCY: (_emergency, Cause.EMERGENCY_STOP),
    ACTUATOR_FAULT: (_disobeyed, Cause.SHOULDER_FOLLOWING),
    WRIST_FAULT: (_wrist_disobeyed, Cause.WRIST_FOLLOWING),
    CHAMBER_SUSPECT: (_doubted, Cause.SHOULDER_SENSOR),
}


@moving_phase
@pytest.mark.parametrize(
    "column", PROVOKED, ids=["trusted", "lost", "emergency", "disobeyed", "wrist", "alone"]
)
def test_stopping_table_each_entry_triggers_reaction(phase: Phase, column: int) -> None:
    puppet = entered(phase)
    provoke, cause = PROVOKED[column]
    if phase is Phase.HOMING and column in (ACTUATOR_FAULT, WRIST_FAULT):
        cause = Cause.HOMING_FAILED
    provoke(puppet)
    puppet.run(5 if column == READINGS_LOST else 1)
    if phase is Phase.IMPACT and column in (ACTUATOR_FAULT, WRIST_FAULT):
        assert puppet.reaction is Reaction.NONE  # the blow's jump is in nobody's reference
        return
    assert puppet.reaction is STOP_REACTIONS[phase][column]
    assert puppet.cause is cause
    assert puppet.control["latest_cause"] == cause
    assert (puppet.cycle["cause"][0], puppet.cycle["reaction"][0]) == (cause, puppet.reaction)
    for _ in range(3000):
        puppet.tick()
        if puppet.phase is Phase.STANDING:
            break
    else:
        pytest.fail("the stop has no end")
    assert puppet.reaction is Reaction.VENT
    assert puppet.is_without_energy()
    assert puppet.cause is cause


@pytest.mark.parametrize("phase", [Phase.TOP, Phase.DOWNSWING, Phase.HOMING], ids=lambda phase: phase.name)
@pytest.mark.parametrize("joint", range(3))
def test_model_check_excess_flow_reacts_as_actuator_fault(phase: Phase, joint: int) -> None:
    puppet = model_checked(entered(phase))
    puppet.parameters.model["flow"][0, :, joint] = -1.0
    puppet.tick()
    assert puppet.cause == Cause.SHOULDER_FLOW + joint
    assert puppet.reaction is STOP_REACTIONS[phase][WRIST_FAULT if joint == 2 else ACTUATOR_FAULT]
    assert puppet.control["encoders_suspect"]


@pytest.mark.parametrize("kind", ["jump", "effort"])
def test_model_check_jump_or_effort_reacts_as_readings_lost(kind: str) -> None:
    puppet = model_checked(entered(Phase.TOP), **{kind: -1.0})
    puppet.tick()
    assert puppet.cause is Cause[f"SHOULDER_{kind.upper()}"]
    assert puppet.reaction is STOP_REACTIONS[Phase.TOP][READINGS_LOST]


def test_model_check_encoder_slip_at_rest_clears_homed() -> None:
    puppet = model_checked(Puppet())
    puppet.parameters.model["jump"][0, Phase.STANDING] = 0.01
    puppet.run(60)
    puppet.offset[1] = 0.003
    puppet.run(60)
    assert (puppet.bench, bool(puppet.control["homed"])) == (State.READY, True)
    puppet.offset[1] = 0.03
    puppet.tick()
    assert (puppet.bench, puppet.cause) == (State.FAULT, Cause.ARM_JUMP)
    assert not puppet.control["homed"]


@pytest.mark.parametrize(
    "phase", release_except({Phase.HOMING, Phase.DOWNSWING, Phase.FOLLOW_THROUGH}, list(Phase)[1:])
)
@pytest.mark.parametrize("column", [READINGS_VALID, READINGS_LOST, EMERGENCY])
def test_stop_requires_reset_and_arm_before_motion(phase: Phase, column: int) -> None:
    puppet = entered(phase)
    PROVOKED[column][0](puppet)
    puppet.run(1500)
    assert puppet.phase is Phase.STANDING
    assert puppet.tick(Request.RESET) == Answer.REFUSED  # its cause still stands
    for name in (*GOOD, "encoder_valid"):
        puppet.readings[name] = 1
    puppet.control["tee"] = True
    for _ in range(100):
        puppet.tick()
        assert puppet.is_without_energy()
    for request in (Request.ARM, Request.SWING, Request.DISARM):
        assert puppet.tick(request) == Answer.REFUSED
    assert puppet.tick(Request.RESET) == Answer.ACCEPTED
    assert (puppet.cause, puppet.reaction) == (Cause.NONE, Reaction.NONE)
    for _ in range(100):
        puppet.tick()
        assert puppet.is_without_energy()
    if phase is Phase.HOMING or column == READINGS_LOST:
        assert (puppet.tick(Request.ARM), puppet.bench) == (Answer.REFUSED, State.SAFE)
        return
    assert puppet.tick(Request.ARM) == Answer.ACCEPTED
    assert not puppet.record["tee"][0]
    puppet.run(2400)  # an opened guard requires a test motion
    assert puppet.control["phase"] == Phase.HOLD


def test_reaction_escalates_and_keeps_first_cause() -> None:
    puppet = entered(Phase.COMMITTED)
    _guard(puppet)
    puppet.tick()
    assert (puppet.reaction, puppet.cause) == (Reaction.COMPLETE, Cause.GUARD)
    _emergency(puppet)
    puppet.tick()
    assert (puppet.reaction, puppet.cause) == (Reaction.BRAKE, Cause.GUARD)
    assert puppet.control["latest_cause"] == Cause.EMERGENCY_STOP
    puppet.readings["emergency_stop_clear"] = True
    _lost(puppet)
    puppet.run(5)
    assert (puppet.reaction, puppet.cause) == (Reaction.BLIND_BRAKE, Cause.GUARD)
    puppet.readings["encoder_valid"] = 1
    puppet.run(10)
    assert puppet.reaction is Reaction.BLIND_BRAKE


def test_complete_reaction_brakes_without_return() -> None:
    puppet = entered(Phase.FOLLOW_THROUGH)
    puppet.tick(Request.STOP)
    assert puppet.reaction is Reaction.COMPLETE
    puppet.run(47)
    assert puppet.control["swinging"]
    puppet.run(5)
    assert (puppet.reaction, bool(puppet.control["swinging"])) == (Reaction.BRAKE, False)
    puppet.run(60)
    assert (puppet.phase, puppet.reaction) == (Phase.STANDING, Reaction.VENT)
    assert puppet.cause is Cause.OPERATOR_STOP


def test_reaction_table_vent_entry_vents_immediately() -> None:
    puppet = entered(Phase.BACKSWING)
    puppet.parameters.control["reactions"][0, Phase.BACKSWING, EMERGENCY] = Reaction.VENT
    _emergency(puppet)
    puppet.tick()
    assert (puppet.phase, puppet.reaction) == (Phase.STANDING, Reaction.VENT)
    assert puppet.is_without_energy()


# The reactions ----------------------------------------------------------------------------------------


def test_brake_opposes_motion_until_rest() -> None:
    puppet = Puppet().swing(250)
    puppet.follows = False
    velocity = np.array([-1.0, 0.4, -1.5])
    for _ in range(40):
        puppet.angle = puppet.angle + velocity * 1e-3
        puppet.tick(Request.STOP if puppet.reaction is Reaction.NONE else 0)
    assert puppet.reaction is Reaction.BRAKE
    assert (puppet.record["valve"][0] * velocity < 0).all()
    assert puppet.record["supply_enable"][0]
    assert puppet.record["exhaust_closed"][0]
    puppet.run(200)
    assert puppet.phase is Phase.STANDING


def test_brake_without_rest_ends_at_timeout() -> None:
    puppet = Puppet(control=replace(QUICK, brake_timeout=0.3)).swing(250)
    puppet.follows = False
    puppet.tick(Request.STOP)
    for k in range(305):
        assert (puppet.phase is Phase.STANDING) == (k >= 300)
        puppet.offset[2] = 0.02 * np.sin(0.2 * k)
        puppet.tick()
    assert puppet.is_without_energy()


@pytest.mark.parametrize("circuit", ["emergency_stop_clear", "guard_closed"])
def test_brake_open_safety_circuit_ends_after_vent_delay(circuit: str) -> None:
    """Also where the model-based check is off, as with hardware."""
    puppet = Puppet(control=replace(QUICK, brake_timeout=3.0)).swing(250)
    assert not puppet.parameters.model["check"][0]
    puppet.follows = False
    puppet.give(**{circuit: False})
    delay = round(float(puppet.parameters.control["vent_delay"][0]) / puppet.period)
    for k in range(delay + 3):
        assert puppet.phase is not Phase.STANDING or k >= delay
        puppet.offset[2] = 0.02 * np.sin(0.2 * k)
        puppet.tick()
    assert puppet.phase is Phase.STANDING


def test_brake_continues_while_vents_report_shut() -> None:
    """A machine without the relay is braked until it rests."""
    puppet = Puppet(control=replace(QUICK, brake_timeout=1.0)).swing(250)
    puppet.follows = False
    puppet.give(emergency_stop_clear=False, vent_open=0.0)
    for k in range(1000):
        assert puppet.reaction is Reaction.BRAKE or k == 0
        puppet.offset[2] = 0.02 * np.sin(0.2 * k)
        puppet.tick()


def braked_blindly(sample: int, seed: int) -> tuple[int, Array, Array]:
    """Lose all readings after `sample` amid garbage; return pattern's row, desired and applied openings."""
    puppet = Puppet()
    if sample:
        puppet.swing(sample)
    else:
        puppet.hold().tick(Request.SWING)
    chance = np.random.default_rng(seed)
    puppet.state.estimator["without_sample"] = inf
    puppet.readings["encoder_valid"] = 0
    desired, applied = np.zeros((250, 3)), np.zeros((250, 3))
    for k in range(250):
        puppet.angle = chance.uniform(-3, 3, 3)
        for name in GOOD:
            puppet.readings[name] = chance.random() < 0.5
        puppet.supply = chance.choice([nan, inf, 0.0, -1e9])
        puppet.tick()
        desired[k], applied[k] = puppet.control["desired"], puppet.record["valve"][0]
        if k == 0:
            assert puppet.reaction is Reaction.BLIND_BRAKE
            assert puppet.control["blind_row"] == puppet.control["swing"]["sample"] // SPACING
    assert puppet.phase is Phase.STANDING
    return int(puppet.control["blind_row"]), desired, applied


@pytest.mark.parametrize("sample", [0, 19, 20, 333, 610, SAMPLES - 3])
def test_blind_brake_follows_pattern_regardless_of_readings(sample: int) -> None:
    row, desired, applied = braked_blindly(sample, seed=0)
    _, _, again = braked_blindly(sample, seed=1)
    assert np.array_equal(applied, again)
    opening, duration = np.hsplit(STILL.blind_brake[row], 2)
    since = np.arange(250)[:, None] * 1e-3
    expected = np.where(since < duration, opening, 0.0)
    edge = np.abs(since - duration) < 1.5e-3
    assert np.where(edge, 0.0, desired - expected) == pytest.approx(0.0)
    ended = duration.max() + QUICK.open_loop_settling_time
    assert not applied[round(ended * 1000) + 2 :].any()


def test_blind_brake_outside_swing_centres_spools() -> None:
    puppet = entered(Phase.HOLD)
    puppet.readings["encoder_valid"] = 0
    openings = puppet.run(300)
    assert puppet.cause is Cause.SHOULDER_ENCODER
    assert puppet.phase is Phase.STANDING
    assert not openings[10:].any()


def test_passive_reaction_stays_without_energy() -> None:
    puppet = entered(Phase.TOP)
    puppet.follows = False
    _disobeyed(puppet)
    for k in range(300):
        puppet.offset[0] = 0.02 * np.sin(0.2 * k)
        puppet.tick()
        assert puppet.is_without_energy()
        assert puppet.reaction is Reaction.PASSIVE
    puppet.run(150)
    assert (puppet.phase, puppet.reaction) == (Phase.STANDING, Reaction.VENT)
    assert puppet.is_without_energy()


# Anything at all --------------------------------------------------------------------------------------

whole = st.integers(-(2**63), 2**63 - 1) | st.integers(0, COUNTS)
number = st.floats() | st.floats(-10.0, 10.0)
flag = st.booleans()
anything = st.fixed_dictionaries(
    {
        "encoder_count": st.tuples(whole, whole, whole),
        "encoder_valid": st.tuples(*[st.integers(0, 255)] * 3),
        "encoder_age": st.tuples(number, number, number),
        "supply_pressure": number,
        "local_reset": flag,
        "ball_present": flag,
        "chamber_pressure": st.tuples(*[number] * 6),
        **dict.fromkeys(GOOD, flag | st.just(True)),
    }
)
lag = st.sampled_from([0.0, 0.0005, -0.001, 0.004, nan, inf]) | number
dt = (
    st.sampled_from([1e-3, 1e-3, 5e-4, 0.0, -1e-3, -0.5, 0.02, 3.0, -1e6, 1e300, nan, inf, -inf])
    | st.floats()
)


def copied(state: ControlState) -> ControlState:
    return ControlState(*(record.copy() for record in state))


@pytest.fixture(scope="module")
def puppets() -> dict[Phase, Puppet]:
    return {phase: entered(phase) for phase in Phase}


@compiled_only
@given(
    phase=st.sampled_from(Phase),
    ticks=st.lists(
        st.tuples(dt, anything | st.none(), st.tuples(lag, lag, lag), st.integers(0, 6)),
        min_size=1,
        max_size=25,
    ),
)
def test_step_arbitrary_readings_give_bounded_command(
    puppets: dict[Phase, Puppet],
    phase: Phase,
    ticks: list[tuple[float, dict[str, Any] | None, tuple[float, float, float], int]],
) -> None:
    puppet = puppets[phase]
    state, good, time = copied(puppet.state), puppet.readings.copy(), puppet.time
    greatest = float(puppet.parameters.envelope["max_opening"][0])
    command, cycle = new_record(COMMAND), new_record(CYCLE)
    for interval, changes, lags, request in ticks:
        time += interval
        readings = good.copy()
        readings["time"], readings["encoder_time"] = time, time
        if changes is not None:
            readings["encoder_time"] = [time - late for late in lags]
            for name, value in changes.items():
                readings[name] = value
        state.control["request"] = request
        step(state, puppet.parameters, readings, time, command, cycle)
        s, c = state.control[0], command[0]
        assert np.isfinite(c["valve"]).all()
        assert np.abs(c["valve"]).max() <= greatest
        assert np.array_equal(c["valve"], s["applied"])
        assert s["phase"] in set(Phase)
        assert s["reaction"] in set(Reaction)
        assert s["cause"] in set(Cause)
        assert 0 <= s["swing"]["sample"] < SAMPLES
        assert -1 <= s["blind_row"] < len(STILL.blind_brake)
        if s["phase"] == Phase.STANDING or s["reaction"] >= Reaction.PASSIVE:
            assert unpack_command(command) == PASSIVE
        assert c["guard_lock"]


@compiled_only
def test_step_leaks_no_memory() -> None:
    puppet = Puppet().swing(250)
    given_ = (puppet.state, puppet.parameters, puppet.readings, puppet.time, puppet.record, puppet.cycle)
    step(*given_)
    _nrt_python.memsys_enable_stats()
    tracemalloc.start()
    try:
        before, held = rtsys.get_allocation_stats(), tracemalloc.get_traced_memory()[0]
        for request in (0, Request.STOP, Request.SWING, Request.ARM, Request.RESET) * 100:
            puppet.state.control["request"] = request
            step(*given_)
        after, holding = rtsys.get_allocation_stats(), tracemalloc.get_traced_memory()[0]
    finally:
        tracemalloc.stop()
        _nrt_python.memsys_disable_stats()
    assert after.alloc - before.alloc == after.free - before.free
    assert after.mi_alloc - before.mi_alloc == after.mi_free - before.mi_free
    assert holding - held < 4096
