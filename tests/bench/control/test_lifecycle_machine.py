"""Any order of requests, faults and time, put to the compiled step: the properties hold in every tick.

The properties are derived independently from the two tables of `bench.base.lifecycle` and from the test's
own changes to the readings; the step's verdicts are used only where they are the specification. For more
than the few seconds of every day: the release tests, and `pytest --hypothesis-profile=thorough` with them.
"""

from __future__ import annotations

from math import inf, nan
from typing import Any, NamedTuple

import numba
import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, precondition, rule

from bench.base.lifecycle import (
    ACCEPTED_IN,
    ACTUATOR_FAULT,
    EMERGENCY,
    NEEDS_LEASE,
    READINGS_LOST,
    READINGS_VALID,
    STOP_REACTIONS,
    TRANSITIONS,
    Answer,
    Cause,
    Phase,
    Reaction,
    Refusal,
    Request,
    State,
)
from tests.bench.control.operating import TIMES, reach
from tests.bench.control.puppet import GOOD, Puppet

pytestmark = pytest.mark.skipif(
    bool(numba.config.DISABLE_JIT), reason="hundreds of thousands of ticks need compilation"
)

MOTION = {State.HOMING, State.ARMED, State.SWINGING, State.RECOVERING}
LATCHED = {State.ESTOP, State.FAULT}
PAIRS = {(edge.source, edge.target) for edge in TRANSITIONS}
STOPS = (Request.STOP, Request.EMERGENCY_STOP)
CLEARED = {Request.RESET, Request.HOME, Request.ARM, Request.SWING}
LOST_TIME = 0.0045
RESET_TIME = 0.2
"""s for which a press of the local reset counts here."""
FULL, EMPTY = 6e5, 1.013e5

joints = st.sampled_from([(0,), (1,), (2,), (0, 1, 2)])
garbage = st.sampled_from([nan, inf, -inf, -1e9, 1e300])


class Look(NamedTuple):
    """Observed bench state between two ticks."""

    state: State
    phase: Phase
    reaction: Reaction
    cause: Cause


class Bench(RuleBasedStateMachine):
    """A bench, its readings, and the test's record of them."""

    puppet: Puppet

    @initialize(
        state=st.sampled_from(State), local_reset=st.booleans(), series=st.booleans(), fitted=st.booleans()
    )
    def begin(self, state: State, local_reset: bool, series: bool, fitted: bool) -> None:
        """Begin in any state, so that few steps lead far."""
        fitted = fitted or state is State.ACCESS  # which chambers without sensors do not get to
        self.puppet = reach(
            state,
            fitted=fitted,
            local_reset=local_reset,
            local_reset_time=RESET_TIME,
            hold_between_swings=series,
        )
        self.local_reset, self.series, self.fitted = local_reset, series, fitted
        self.pressure, self.stuck = EMPTY, False
        if state in MOTION - {State.HOMING}:
            self.pressure = FULL
        self.pressed_at, self.button = -inf, False
        self.fresh_at = np.full(3, self.puppet.time)
        self.lost_permission = False
        self.number = 0
        self.dropped: dict[int, str] = {}
        self.garbled = False

    # Time and requests ----------------------------------------------------------------------------------

    @rule(ticks=st.sampled_from([1, 2, 3, 7, 30, 120, 600]))
    def let_time_pass(self, ticks: int) -> None:
        for _ in range(ticks):
            self.tick()

    @rule(step=st.sampled_from([0.002, 0.0045, 0.009, 0.011, 0.05, 0.5, 20.0]))
    def skip_ticks(self, step: float) -> None:
        self.tick(step=step)

    @rule(request=st.sampled_from([*list(Request)[1:], 11, 255]), then=st.integers(0, 30))
    def ask(self, request: int, then: int) -> None:
        if request not in STOPS:
            self.number += 1
        self.tick(request)
        for _ in range(then):
            self.tick()

    @rule()
    def mend_and_reset(self) -> None:
        """Act as an operator does after a stop."""
        self.dropped, self.garbled, self.stuck = {}, False, False
        self.puppet.give(encoder_valid=1, encoder_indexed=1, device_operational=True)
        self.puppet.supply = None
        self.puppet.give(**dict.fromkeys(GOOD, True))
        self.puppet.give(lease_held=True, support_ready=True, supervisor_alive=True)
        self.puppet.offset[:] = 0.0
        for _ in range(60):
            self.tick()
        self.press(True)
        self.press(False)
        self.ask(Request.RESET, 0)
        self.ask(Request.HOME, 25)

    @precondition(lambda self: self.puppet.bench is State.READY)
    @rule(after=st.sampled_from([0, 5, 30, 450]))
    def arm(self, after: int) -> None:
        self.ask(Request.ARM, after)

    @precondition(lambda self: self.puppet.phase is Phase.HOLD)
    @rule(after=st.sampled_from([0, 5, 15, 25, 35, 45, 55, 75, 95, 400]))
    def swing(self, after: int) -> None:
        self.ask(Request.SWING, after)

    # Faults ---------------------------------------------------------------------------------------------

    @rule(which=joints, how=st.sampled_from(["invalid", "stale", "not finite", "intermittent", "jumps"]))
    def drop(self, which: tuple[int, ...], how: str) -> None:
        self.dropped |= dict.fromkeys(which, how)
        self.tick()

    @rule(which=joints)
    def mend(self, which: tuple[int, ...]) -> None:
        for joint in which:
            self.dropped.pop(joint, None)
        self.tick()

    @rule(name=st.sampled_from(GOOD), closed=st.booleans())
    def interlock(self, name: str, closed: bool) -> None:
        self.puppet.give(**{name: closed})
        self.tick()

    @rule(
        name=st.sampled_from(["lease_held", "support_ready", "supervisor_alive", "device_operational"]),
        given=st.booleans(),
    )
    def permit(self, name: str, given: bool) -> None:
        self.puppet.give(**{name: given})
        self.tick()

    @rule(pressed=st.booleans())
    def press(self, pressed: bool) -> None:
        self.puppet.give(local_reset=pressed)
        self.tick()

    @rule(value=garbage | st.sampled_from([None, FULL]))
    def supply(self, value: float | None) -> None:
        """Set the manifold's reading to `value`, or to the pressure that the supply valve gives."""
        self.puppet.supply = value
        self.tick()

    @rule(stuck=st.booleans())
    def vents(self, stuck: bool) -> None:
        """Let the vents be stuck shut."""
        self.stuck = stuck
        self.tick()

    @rule(joint=st.integers(0, 2), indexed=st.booleans())
    def index(self, joint: int, indexed: bool) -> None:
        self.puppet.readings["encoder_indexed"][0, joint] = indexed
        self.tick()

    @rule(joint=st.integers(0, 2), miss=st.sampled_from([0.0, 0.012, 0.03, 0.5, -0.5]))
    def push(self, joint: int, miss: float) -> None:
        """Push a joint off its reference within 30 ms."""
        for value in np.linspace(self.puppet.offset[joint], miss, 30):
            self.puppet.offset[joint] = value
            self.tick()

    # One tick -------------------------------------------------------------------------------------------

    def look(self) -> Look:
        puppet = self.puppet
        return Look(puppet.bench, puppet.phase, puppet.reaction, puppet.cause)

    def tick(self, request: int = 0, step: float = 1e-3) -> None:
        """Move air and joints on, run the step, and insist on all that must hold."""
        puppet, control, readings = self.puppet, self.puppet.control, self.puppet.readings
        before, air = self.look(), bool(puppet.record["supply_enable"][0])
        if not self.stuck:
            self.pressure = FULL if air else EMPTY + (self.pressure - EMPTY) * float(np.exp(-step / 0.01))
        readings["chamber_pressure"] = self.pressure if self.fitted else nan
        puppet.period = step
        offset = puppet.offset.copy()
        odd = round(1000 * (puppet.time + step)) % 2
        readings["encoder_valid"], puppet.stamp[:] = 1, 0.0
        for joint, how in self.dropped.items():
            match how:
                case "invalid":
                    readings["encoder_valid"][0, joint] = 0
                case "intermittent":
                    readings["encoder_valid"][0, joint] = round(1000 * (puppet.time + step)) % 7 == 0
                case "stale":
                    puppet.stamp[joint] = self.fresh_at[joint] - puppet.time - step
                case "not finite":
                    puppet.stamp[joint] = nan
                case "jumps":
                    puppet.offset[joint] += 1.0 if odd else -1.0
        control["request_number"] = self.number
        control["answer"] = Answer.NONE if request and request not in STOPS else control["answer"]
        puppet.step(request)
        puppet.offset[:] = offset
        for joint in range(3):
            how = self.dropped.get(joint, "")
            seen = how == "intermittent" and readings["encoder_valid"][0, joint]
            if not how or seen or (how == "jumps" and puppet.state.encoder["fresh"][0, joint]):
                self.fresh_at[joint] = puppet.time
        self.note_button()
        self.check(before, self.look(), request, step)

    def note_button(self) -> None:
        """Keep the test's own account of edges of the local reset."""
        pressed = bool(self.puppet.readings["local_reset"][0])
        if pressed and not self.button:
            self.pressed_at = self.puppet.time
        self.button = pressed

    def check(self, before: Look, after: Look, request: int, step: float) -> None:
        control, record, cycle = self.puppet.control, self.puppet.record[0], self.puppet.cycle[0]
        accepted = request and (request in STOPS or control["answer"] == Answer.ACCEPTED)
        self.check_outputs(after, record)
        self.check_answer(before, request, control, cycle)
        self.check_way(before, after, request if accepted else 0)
        self.check_reaction(before, after, request, step)
        self.check_latched(before, after, request if accepted else 0)
        self.check_guard(after, record)

    def check_outputs(self, after: Look, record: Any) -> None:
        """Outputs are numbers within -1 … 1, and without energy where nothing may move."""
        valve = record["valve"]
        assert np.isfinite(valve).all()
        assert np.abs(valve).max() <= 1.0
        still = after.state not in MOTION or after.reaction is Reaction.PASSIVE
        if still or after.phase is Phase.STANDING:
            assert not valve.any()
            assert not record["supply_enable"]
            assert not record["exhaust_closed"]
            assert not record["tee"]

    def check_answer(self, before: Look, request: int, control: Any, cycle: Any) -> None:
        """Every request is answered under its number in its tick, refused with a reason; a stop never is."""
        assert cycle["request"] == request
        if not request:
            return
        if request in STOPS:
            assert cycle["request_number"] in {0, self.number}
            return
        assert cycle["request_number"] == self.number
        assert cycle["answer"] in {Answer.ACCEPTED, Answer.REFUSED}
        assert (cycle["answer"] == Answer.REFUSED) == (cycle["refusal"] != Refusal.NONE)
        if cycle["answer"] == Answer.ACCEPTED:
            assert before.state in ACCEPTED_IN[Request(request)]
            assert control["lease_held"] or request not in NEEDS_LEASE
            if request in CLEARED:
                assert self.puppet.readings[list(GOOD)].tolist() == [(True,) * 3]
                assert control["encoder_fault"] == 0
                assert control["supervisor_alive"]
            if request in {Request.ARM, Request.SWING}:
                assert control["support_ready"]

    def check_way(self, before: Look, after: Look, accepted: int) -> None:
        """States change only along transitions, and motion starts only on request."""
        control = self.puppet.control
        if not (control["lease_held"] and control["support_ready"]):
            self.lost_permission = True
        if before.state is after.state:
            return
        assert (before.state, after.state) in PAIRS
        match after.state:
            case State.HOMING:
                assert accepted == Request.HOME
            case State.SWINGING:
                assert accepted == Request.SWING
                self.lost_permission = False
            case State.ARMED if before.state is State.RECOVERING:
                assert self.series
                assert not self.lost_permission
            case State.ARMED:
                assert accepted == Request.ARM
            case State.ACCESS:
                assert accepted == Request.ACCESS

    def check_reaction(self, before: Look, after: Look, request: int, step: float) -> None:
        """Without fresh readings or permission only the reaction of the stopping table runs."""
        control, readings = self.puppet.control, self.puppet.readings[0]
        if after.phase is Phase.STANDING:
            begun = after.state in LATCHED or (after.state is State.ACCESS and after.cause)
            assert after.reaction is (Reaction.VENT if begun else Reaction.NONE)
            assert bool(after.cause) == bool(begun)
            return
        assert after.state in MOTION
        silence = self.puppet.time - self.fresh_at.min()
        emergency = not readings["emergency_stop_clear"] or request == Request.EMERGENCY_STOP
        row = STOP_REACTIONS[after.phase]
        least = Reaction.NONE
        if silence > LOST_TIME + 1e-9:
            least = row[READINGS_LOST]
        elif emergency:
            least = row[EMERGENCY]
        elif not (readings["guard_closed"] and readings["guard_locked"]) or request == Request.STOP:
            least = row[READINGS_VALID]
        elif not control["device_operational"]:
            least = row[ACTUATOR_FAULT]
        elif not control["supervisor_alive"] or step > 0.010:
            least = row[READINGS_VALID]
        assert after.reaction >= least
        permitted = {*row, before.reaction, Reaction.BRAKE if before.reaction <= Reaction.COMPLETE else 0}
        assert after.reaction in permitted
        assert after.reaction >= before.reaction or before.phase is Phase.STANDING
        if after.reaction is not Reaction.NONE and not after.cause:  # let go in order, without a cause
            assert after.reaction is Reaction.BRAKE
            assert after.state in {State.RECOVERING, State.HOMING}
        if after.state is State.ARMED and after.reaction is Reaction.NONE:
            assert control["lease_held"]
            assert control["support_ready"]

    def check_latched(self, before: Look, after: Look, accepted: int) -> None:
        """ESTOP and FAULT are left by an accepted reset with its cause gone, or for ACCESS, and come back."""
        if before.state not in LATCHED or after.state in {before.state, State.ESTOP}:
            return
        assert accepted in {Request.RESET, Request.ACCESS}
        if accepted == Request.ACCESS:
            assert after.state is State.ACCESS
            assert after.cause is before.cause
            return
        assert after.state in {State.SAFE, State.READY}
        assert not before.cause or self.puppet.readings["emergency_stop_clear"][0]
        assert not (before.cause is Cause.NOT_VENTED and self.stuck and self.pressure > TIMES.vented_pressure)
        if self.local_reset:
            assert self.puppet.time - self.pressed_at <= RESET_TIME + 1e-9
            self.pressed_at = -inf  # one press, one reset

    def check_guard(self, after: Look, record: Any) -> None:
        """The guard is unlocked in ACCESS only, with manifold and all chambers seen empty.

        A cause that ends ACCESS leaves it unlocked for who went in.
        """
        if record["guard_lock"]:
            return
        if after.state in LATCHED:
            assert self.puppet.control["guard_was_opened"]
            return
        assert after.state is State.ACCESS
        assert self.puppet.control["vented"]
        assert self.pressure <= TIMES.vented_pressure
        assert not self.puppet.readings["supply_pressure"][0] > TIMES.vented_pressure


thorough = settings.get_current_profile_name() == "thorough"
few = settings(max_examples=30, stateful_step_count=40, derandomize=True, deadline=None, print_blob=True)
many = settings(few, max_examples=3000 if thorough else 300, stateful_step_count=60, derandomize=not thorough)


class LongBench(Bench):
    """The same for longer, before a release."""


Bench.TestCase.settings, LongBench.TestCase.settings = few, many
TestBench = Bench.TestCase
TestLongBench = pytest.mark.release(LongBench.TestCase)
