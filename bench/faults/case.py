"""Cases of the fault matrix: the bench at an instant, one thing that breaks, and the run to rest."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from math import pi

import numpy as np

from bench.config import Configuration
from bench.control.records import ControlParameters, new_control_state
from bench.control.settings import SIMULATED, build_controller
from bench.errors import Refused
from bench.faults.catalogue import EVENT_AFTER, Breakage
from bench.faults.instants import Instant
from bench.faults.verdict import CaseLimits, CaseOutcome, judge_case
from bench.faults.watch import Watch, WatchedRun
from bench.lifecycle import CAUSE_TEXT, Request, State
from bench.simulation.engine import LockstepEngine
from bench.simulation.lockstep import Lockstep
from bench.simulation.safety import SafetyLimits
from bench.swing.profile import Profile
from sim.driver import hanging_pose
from sim.faults import own_records
from sim.plant import Plant, build_plant

_LONGEST = 40.0
"""Longest watch of a case, s."""
_LONGEST_SEARCH = 10.0
"""Additional time for a case that begins in the search and goes on to a swing, s."""
_ASK_AFTER = 0.2
"""Time in hold or standing from the fault to the request that goes on, s."""


class Workbench:
    """A plant, a profile and settings; each case begins in their undisturbed run."""

    def __init__(
        self, configuration: Configuration, profile: Profile, *, model_check: bool | None = None
    ) -> None:
        """Build plant and controllers; `model_check` overrides the configuration."""
        c = configuration
        self.profile, self.configuration = profile, c
        self.envelope = c.envelope
        if model_check is not None:
            self.envelope = c.envelope.with_model_check("always" if model_check else "off")
        self.plant: Plant = build_plant(c.plant)
        lifecycle = replace(c.lifecycle, warning_time=SIMULATED.warning_time, series=True)
        self.parameters = build_controller(c.plant, profile, c.control, self.envelope, c.estimator, lifecycle)
        self.period = c.plant.tick
        self._bases: dict[Instant, LockstepEngine] = {}
        self._ends: dict[Instant, WatchedRun] = {}
        self._lifecycle = lifecycle

    @cached_property
    def _homing(self) -> tuple[Plant, ControlParameters]:
        """The same machine with encoders that count from switching on, homed by their index."""
        c = self.configuration
        counts = c.plant.encoders.counts_per_revolution
        marks = hanging_pose(c.plant) + np.array([-0.6, -0.4, -0.4])
        a, b, c_ = (float(np.floor(-angle * counts / (2 * pi))) for angle in marks)
        encoders = replace(c.plant.encoders, incremental=True, zero_count=(a, b, c_))
        plant = replace(c.plant, encoders=encoders)
        homing = replace(c.homing, method="index")
        return build_plant(plant), build_controller(
            plant, self.profile, c.control, self.envelope, c.estimator, self._lifecycle, homing
        )

    def base(self, instant: Instant) -> LockstepEngine:
        """Return the undisturbed bench at `instant`.

        Raises:
            Refused: the undisturbed bench does not get there.
        """
        if instant not in self._bases:
            self._bases[instant] = self._brought_to(instant)
        return self._bases[instant].copy()

    def _brought_to(self, instant: Instant) -> LockstepEngine:
        if instant.phase == "homing":
            plant, parameters = self._homing
            stepper = Lockstep(plant, parameters, hanging_pose(plant.parameters))
            stepper.state = new_control_state(State.SAFE)
            bench = LockstepEngine(stepper, name=self.profile.name)
            bench.advance(20)
            bench.request(Request.HOME)
            bench.advance(instant.tick)
        else:
            stepper = Lockstep(self.plant, self.parameters, hanging_pose(self.configuration.plant))
            bench = LockstepEngine(stepper, name=self.profile.name)
            bench.advance(200)
            if instant.phase != "standing":
                bench.arm()
                bench.control["tee"] = True
                bench.advance(400)
                if instant.phase != "hold":
                    bench.advance(instant.tick, Request.SWING)
        if bench.cause:
            raise Refused(
                f"fault matrix of profile {self.profile.name!r}",
                f"the undisturbed bench stopped before {instant.name}: {CAUSE_TEXT[bench.cause]}",
                "an undisturbed swing that runs to its end",
                "Try it with `golfbench swing simulate`.",
            )
        return bench

    def run(self, breakage: Breakage, instant: Instant) -> CaseOutcome:
        """Return how `breakage` at `instant` ends."""
        run = self._watched(instant, breakage)
        healthy = self._healthy(instant, without_ball=breakage.event == "no ball")
        return judge_case(self._limits, breakage, instant, run, healthy)

    def _healthy(self, instant: Instant, *, without_ball: bool) -> WatchedRun:
        key = replace(instant, label=instant.label + (" no ball" if without_ball else ""))
        if key not in self._ends:
            self._ends[key] = self._watched(instant, None, without_ball=without_ball)
        return self._ends[key]

    @cached_property
    def _limits(self) -> CaseLimits:
        """Limits of all cases; the head may be as fast as undisturbed, with or without a ball."""
        hold = Instant("hold", 0)
        runs = [self._healthy(hold, without_ball=without_ball) for without_ball in (False, True)]
        safety = SafetyLimits(
            frame_radius=self.envelope.frame_radius,
            access_pressure=1.05 * self.configuration.lifecycle.vented_pressure,
        )
        return CaseLimits(self.plant, safety, max(run.loads.peak_head_speed for run in runs))

    def _watched(
        self, instant: Instant, breakage: Breakage | None, *, without_ball: bool = False
    ) -> WatchedRun:
        """Run from `instant` until everything rests."""
        bench = self.base(instant)
        bench.stepper.plant = own_records(bench.stepper.plant)
        bench.begin_tally()
        state = bench.plant_state
        no_ball = without_ball or (breakage is not None and breakage.event == "no ball")
        if no_ball:
            state["ball_present"] = False
        if breakage is not None:
            bench.stepper.break_with((breakage.fault,), watchdog=self.configuration.driver.watchdog)
        watch = Watch(bench)
        ask_at = round(_ASK_AFTER / self.period)
        event_at = round(EVENT_AFTER / self.period)
        event = breakage.event if breakage is not None else ""
        watch.advance(event_at, 0)
        if event == "guard opened":
            state["guard_closed"] = False
        elif event == "emergency stop":
            state["emergency_stop_clear"] = False
        watch.advance(ask_at - event_at, Request.STOP if event == "stop" else 0)
        requests = {"standing": Request.ARM, "homing": Request.ARM, "hold": Request.SWING}
        going_on = requests.get(instant.phase, 0)
        longest = _LONGEST + (_LONGEST_SEARCH if instant.phase == "homing" else 0.0)
        watch.until_rest(round(longest / self.period), going_on, instant.phase)
        return watch.run()
