"""Server in the machine's process: sequences and swings; between them the machine holds or is passive.

The cycle of a running bench arms the robot, tees up and swings; the server keeps the records. The program
makes the operator's requests, under the lifecycle of a bench with people next to it: warning, verified
venting, homing against the stops, a local reset where one is configured.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np

from bench.base.clock import Clock
from bench.base.errors import Refused
from bench.base.lifecycle import CAUSE_WORDS, LATCHED, REFUSAL_TEXT, Cause, Phase, Refusal, Request, State
from bench.commissioning.machine.driver_machine import (
    DriverMachine,
    Stalled,
    StoppedByPerson,
    stopped_by_person,
)
from bench.config import Configuration
from bench.control.settings import with_tables_of
from bench.control.states import near_address
from bench.learning.live import swung_cycles
from bench.loop.loop import Cycles, Loop
from bench.simulation.simulated_bench import (
    ADDRESS_TRIES,
    HOLD,
    ArmingFailed,
    Bench,
    SeriesSwing,
    return_failed,
)
from bench.simulation.swing_operator import (
    RETURN_TIMEOUT,
    SETTLING_TIMEOUT,
    STANDSTILL_TIMEOUT,
    SwingOperator,
    joined,
)
from bench.supervisor.status import cause_text, refusal_words, stall_note
from bench.swing.profile import Profile
from drivers.base import Driver, DriverError

_TIMEOUT = 30.0
"""Time for which a request is repeated that the bench refuses for a passing reason (s)."""
_ACCESS = 60.0
"""Timeout of the proof that the chambers are empty for people (s)."""
_PERSON = 600.0
"""Timeout of a person at the local reset or the guard (s)."""
_AGAIN = 0.2
"""Time between two requests (s)."""
_WARM_UP = 0.2
"""Time for the estimators to settle and the code to compile, before the first request, s."""
_HOMED = 90.0
"""Max duration of homing, s."""
_FEED = 3.0
"""Time for a ball to reach the tee (s)."""
_REPEATED = 10
"""Max tries of an arming or a swing that stalls of this machine end, or that leave gaps in the record."""
_LAST = 5.0
"""Duration of the records that are kept of a failed arming (s)."""
_SWINGS, _CHUNK = 300, 10
"""Max requests for a swing, and ticks between two."""

_BY_PERSON = (Cause.EMERGENCY_STOP, Cause.GUARD)
"""Causes after which a reset alone does not start the robot again."""

Say = Callable[[str], None]


class LiveSeries:
    """A robot that swings repeatedly behind a driver that is open."""

    def __init__(
        self,
        driver: Driver,
        configuration: Configuration,
        bench: Bench,
        clock: Clock,
        *,
        stop: Callable[[], bool],
        say: Say,
    ) -> None:
        """Reset, home and arm `bench` on `driver`; `say` calls a person, `stop` ends a motion.

        Raises:
            ArmingFailed: the robot does not reach its address, or the bench refuses.
            Stalled: stalls of the computer ended each try.
            Refused: it was stopped.
        """
        self.bench, self._driver, self._say = bench, driver, say
        lifecycle = replace(configuration.lifecycle, hold_between_swings=True)
        loop = Loop(
            driver,
            bench.series_controller(lifecycle, configuration.homing),
            clock,
            name=configuration.driver.name,
            note_truth=getattr(driver, "note_truth", None),
            state=State.STARTING,
        )
        control = loop.state.control
        for permission in ("supervisor_alive", "lease_held", "support_ready"):
            control[permission] = True  # no other client; the caller stores the records
        self._operator = SwingOperator(loop, stop=stop, name=bench.profile.name)
        self._operator.shows_no_pressure()  # compiled, or read from the cache, before a tick waits for it
        near_address(loop.parameters, loop.state.estimator)
        self._operator.advance(round(_WARM_UP / clock.period))
        control["is_warmed_up"] = True
        self._operator.advance(1)
        self._arm()

    def swing(self, profile: Profile, ball: bool) -> SeriesSwing:
        """Rest at the address, swing `profile`, and come back; after a stop the robot is armed again.

        A swing whose record has gaps before the ball, or that a stall stopped, as the machine was busy, is
        repeated.

        Raises:
            ReturnFailed: the robot does not come back to its address.
            Stalled: stalls of the computer ended each try to arm it again.
            Refused: no ball comes, it was stopped, or the machine stays busy.
        """
        found = ""
        for _ in range(_REPEATED):
            cycles, whole = self._swing(profile, ball=ball)
            settled = bool(self.bench.profile.air)
            made = SeriesSwing(cycles, None, Cause.NONE, float("nan"), settled)
            try:
                cause, stall = self._come_back()
            except (Stalled, StoppedByPerson):
                raise
            except Refused as refused:
                raise return_failed(refused, made._replace(cause=self._operator.cause)) from None
            if not stall and (whole or cause):
                return made._replace(cause=cause)
            found = f"stopped: {cause_text(cause, stall)}" if stall else "the record has gaps before the ball"
            self._say(f"{found}: the swing is repeated")
        action = "Look at the timing: golfbench doctor."
        raise Refused(f"swinging {profile.name!r}, {_REPEATED} times", found, "a whole swing", action)

    def _swing(self, profile: Profile, *, ball: bool) -> tuple[Cycles, bool]:
        """Return the records of a swing, one a tick, and whether none is missing up to the ball."""
        operator, loop = self._operator, self._operator.stepper
        slips, stalls = ADDRESS_TRIES, _REPEATED
        while True:
            operator.begin_record()
            if not operator.holding():
                self._arm()
            operator.advance(round(HOLD / operator.period))
            loop.parameters = with_tables_of(loop.parameters, profile, self.bench.control, self.bench.plant)
            operator.await_air()  # a joint that breaks away may take the club to the ball
            try:
                self._tee_up(ball=ball)
            except Refused:
                if not (stalls > 1 and self._stall()):
                    raise
            else:
                if operator.start_swing(_SWINGS, _CHUNK):
                    break
            self._require_no_stop()
            if not operator.cause:
                raise operator.refusal("the robot does not come to rest there")
            stall = self._stall()
            slips, stalls = (slips, stalls - 1) if stall else (slips - 1, stalls)
            found = f"stopped at the address: {cause_text(operator.cause, stall)}"
            if not (slips and stalls):
                raise operator.refusal(found)
            self._say(f"{found}; it is armed again")
        made, end = [operator.latest], len(profile.angle)
        while (done := int(made[-1]["tick"][-1]) - int(made[0]["tick"][0]) + 1) < end:
            made.append(operator.advance(min(_CHUNK, end - done), Request.STOP if operator.stop() else 0))
        cycles, missing = swung_cycles(joined(made), end)
        return cycles, not missing[: profile.begins[6]].any()

    def _come_back(self) -> tuple[Cause, str]:
        """Let the robot return to its address, after a stop arm it again.

        Return the stop's cause, and the stall of this machine that explains it better.
        """
        operator = self._operator
        back = operator.run_until(lambda: operator.phase is Phase.HOLD, RETURN_TIMEOUT)
        cause, stall = operator.cause, self._stall()
        if not back or operator.control["reaction"][0]:
            self._require_no_stop()
            self._arm()
        operator.begin_record()
        return cause, stall

    def _stall(self) -> str:
        """Return the stall of this machine behind the stop in the records kept; empty without one."""
        cycles = self._operator.record()
        stops = cycles["cause"] != 0
        if not stops.any():
            return ""
        # The last stop: the cause of an earlier one is latched until the robot is armed again.
        begins = np.flatnonzero(stops & ~np.append(False, stops[:-1]))
        first, lost = int(begins[-1]), self.bench.envelope.encoder_timeout
        cause, fault = Cause(int(cycles["cause"][first])), getattr(self._driver, "fault", "")
        if cause is Cause.TICK_GAP:
            return CAUSE_WORDS[cause][1]
        return stall_note(cycles[: first + 1], cause, lost, self._operator.period, fault)

    def release_guard(self) -> None:
        """Bring the robot to rest and release the guard, for a person to come to the club.

        Raises:
            Refused: the bench does not release it, and why.
        """
        operator = self._operator
        if operator.phase is not Phase.STANDING:
            self._ask(Request.DISARM)
        operator.wait_for(lambda: operator.phase is Phase.STANDING, STANDSTILL_TIMEOUT)
        self._ask(Request.ACCESS, _ACCESS)

    def lock_guard(self) -> None:
        """Lock the guard again, once it is closed; a swing then arms the robot.

        Raises:
            Refused: it stays open.
        """
        self._ask(Request.SECURE, _PERSON)
        self._operator.wait_for(lambda: self._state is not State.ACCESS, _TIMEOUT)

    def hold(self) -> None:
        """Continue for one tick; call a person at the club once when access is lost."""
        was_released = self._state is State.ACCESS
        self._operator.begin_record()
        self._operator.advance(1)
        if was_released and self._state in LATCHED:
            cause = Cause(int(self._operator.control["cause"][0]))
            self._say(f"Leave the robot, leave the guard open ({CAUSE_WORDS[cause][0]}).")

    def end(self) -> None:
        """Bring the robot to rest; the outputs end passive, also after an error."""
        try:
            with suppress(DriverError):
                if self._operator.phase is not Phase.STANDING:
                    self._operator.rest()
        finally:
            self._driver.make_passive()

    # Operator's requests -------------------------------------------------------------------------------

    def _arm(self) -> None:
        """Reset, home and arm, as far as it is needed; again after a stall of this machine."""
        for left in reversed(range(_REPEATED)):
            self._operator.begin_record()
            try:
                return self._arm_once()
            except Refused as refused:
                self._require_no_stop()
                if not (stall := self._stall()):
                    error = ArmingFailed(*refused.args)
                    error.cycles = self._operator.record()[-round(_LAST / self._operator.period) :]
                    raise error from None
                why = cause_text(self._operator.cause, stall)
                if not left:
                    action = "Look at the timing: golfbench doctor, then --resume."
                    raise Stalled(f"arming, {_REPEATED} times", why, "an armed robot", action) from None
                self._say(f"stopped while arming: {why}; it is armed again")

    def _arm_once(self) -> None:
        operator = self._operator
        operator.wait_for(lambda: operator.phase is Phase.STANDING, STANDSTILL_TIMEOUT)
        self._require_no_stop()
        if self._state in LATCHED:
            self._revive()
            self._ask(Request.RESET)
        if self._state is State.SAFE:
            self._ask(Request.HOME)
            operator.wait_for(lambda: self._state is not State.HOMING, _HOMED)
        if self._state is not State.READY:
            cause = operator.cause
            found = cause_text(cause, self._stall()) if cause else f"state {self._state.name}"
            action = "Follow the text, then --resume."
            raise Refused("homing", found, "a homed robot in state READY", action)
        operator.wait_for(lambda: bool(operator.control["venting"]["emptied"][0]), _TIMEOUT)
        operator.wait_for(operator.is_vented, SETTLING_TIMEOUT)
        self._ask(Request.ARM)
        if not operator.reach_address():
            raise stopped_by_person()

    def _ask(self, request: Request, timeout: float = _TIMEOUT) -> None:
        """Request until it is accepted; Refused with its reason if it refuses after `timeout` (s)."""
        operator, waited, called = self._operator, 0.0, False
        while not operator.request(request):
            refusal = Refusal(int(operator.control["refusal"][0]))
            person = refusal in (Refusal.LOCAL_RESET, Refusal.GAUGE)
            if person and not called:
                self._say(f"{request.name.lower()}: {REFUSAL_TEXT[refusal]}")
                called = True
            latched = self._state in LATCHED and request is not Request.RESET  # no waiting changes that
            if latched or waited > (_PERSON if person else timeout):
                air = operator.stepper.record["air_fault"][0]
                fact, action = refusal_words(refusal, getattr(self._driver, "fault", ""), air)
                if not action:  # the state's cause says more
                    fact, action = f"{fact}, {self._state.name}", "follow the text, then --resume"
                    fact += f": {cause_text(operator.cause, self._stall())}" if operator.cause else ""
                raise Refused(
                    f"{request.name.lower()} of the robot", fact, "an accepted request", f"{action}."
                )
            self._require_no_stop()
            operator.advance(round(_AGAIN / operator.period))
            operator.begin_record(keep=_LAST)
            waited += _AGAIN

    def _tee_up(self, *, ball: bool) -> None:
        """Raise the next ball, or swing at none."""
        operator = self._operator
        operator.control["tee"] = False
        operator.advance(1)
        if not ball:
            return
        self._ask(Request.TEE)
        if not operator.run_until(self._sees_ball, _FEED):
            raise Refused("tee", f"no ball in {_FEED:g} s", "a ball", "Fill the feeder, then --resume.")

    def _sees_ball(self) -> bool:
        return bool(self._operator.stepper.record["ball_present"][0])

    def _revive(self) -> None:
        """Open the device again if it has become passive."""
        if not self._driver.operational:
            self._driver.close()
            self._driver.open()

    @property
    def _state(self) -> State:
        return State(int(self._operator.control["state"][0]))

    def _require_no_stop(self) -> None:
        """Raise StoppedByPerson after a stop or an opened guard: a reset alone starts no robot again."""
        if self._operator.stop():
            raise stopped_by_person()
        for name in ("latest_cause", "cause"):
            cause = Cause(int(self._operator.control[name][0]))
            if cause in _BY_PERSON:
                raise stopped_by_person(found=cause_text(cause, ""))


class MachineServer:
    """A machine that obeys orders, one after the other; `hold` is its tick in between."""

    def __init__(
        self,
        driver: Driver,
        configuration: Configuration,
        clock: Clock,
        *,
        stop: Callable[[], bool],
        say: Say,
        inputs_only: bool = False,
    ) -> None:
        """Open `driver` of `configuration`; `stop` ends a motion, `say` calls a person.

        `inputs_only`: its inputs are watched, and nothing else is done.

        Raises:
            Refused: it gives no readings, or an interlock is open.
            DriverError: the device is unsuitable.
        """
        self._driver, self._clock, self._stop, self._say = driver, clock, stop, say
        self._configuration = configuration
        self._series: LiveSeries | None = None
        lifecycle = configuration.lifecycle
        self._machine = DriverMachine(
            driver,
            configuration.plant,
            clock,
            warning=lifecycle.warning_time,
            stop=stop,
            inputs_only=inputs_only,
            local_reset=lifecycle.local_reset,
        )

    def obey(self, order: str, *given: Any) -> Any:
        """Return the answer of `order`: "arm", or a method of the armed series or of the machine.

        A bench that is armed is brought to rest before an order to the machine.

        Raises:
            MachineFault, Refused: as the machine and the series.
            DriverError: the device failed; it is passive.
        """
        if order in ("swing", "release_guard", "lock_guard"):
            if self._series is None:
                raise ValueError("a swing of a robot that is not armed")
            return getattr(self._series, order)(*given)
        self._end_series()
        if order != "arm":
            return getattr(self._machine, order)(*given)
        self._machine.make_passive()
        (bench,) = given
        self._series = LiveSeries(
            self._driver, self._configuration, bench, self._clock, stop=self._stop, say=self._say
        )
        return None

    def hold(self) -> None:
        """Continue for one tick as the last order left the machine."""
        if self._series is None:
            self._machine.hold()
        else:
            self._series.hold()

    def close(self) -> None:
        """Bring the robot to rest, be passive, and close the device."""
        try:
            self._end_series()
        finally:
            for _ in range(3):  # a frame on a bus may be lost
                self._machine.make_passive()
            self._driver.close()

    def _end_series(self) -> None:
        series, self._series = self._series, None
        if series is not None:
            series.end()
