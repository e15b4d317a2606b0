"""A run of the bench from a fault until everything rests, and the observations made on the way.

They are the plant's true state, not the bench's estimate; the records also contain the bench's reports. An
unnoticed fault may be detected by the next swing, before another ball is struck.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.base.lifecycle import LATCHED, REFUSAL_TEXT, Answer, Cause, Phase, Refusal, Request, State
from bench.loop.loop import Cycles
from bench.simulation.safety import Loads, RunEnd
from bench.simulation.swing_operator import LockstepEngine
from sim.plant import Plant

_CHUNK = 100
"""Ticks between two looks."""
_INSIDE = 5.0
"""Time for which people stay inside the guard, s."""
_LEAVING = 3.0
"""Time in which the guard locks behind the last person, s."""
_MAX_VENT_TIME = 20.0
"""Time at rest after which access and arming are given up, s."""
_STILL, _STILL_FOR = 0.02, 1.0
"""Max joint speed at rest (rad/s), and the time it must not be exceeded (s)."""
_EMPTY, _MAX_CREEP_TIME = 0.05e5, 600.0
"""Pressure over the atmosphere's at which a chamber carries less than friction holds, Pa, and the time after
which a stopped robot is not waited for, s: on trapped air that leaks away a joint slips every few seconds."""


_NEXT_SWING_TIMEOUT = 90.0
"""Time after which a next swing that never comes is given up, s."""
_REPEATED = (Request.HOME, Request.ACCESS, Request.SWING)
"""Requests that are put until they are accepted: what they need comes with time."""


@dataclass(frozen=True, eq=False)
class WatchedRun:
    """A run from a fault to rest, before it is judged; ticks count from the fault."""

    cycles: Cycles
    angle: NDArray[np.float64]
    """Joint angles at the end, rad."""
    loads: Loads
    control: NDArray[Any]
    """Memory of the state machine at the end, one record."""
    rest_tick: int
    """Tick after which no joint moved."""
    rested: bool
    """Whether all joints rest at the end: a joint that slips is also at rest for some ticks."""
    vented_tick: int
    """Tick at which the chambers were reported empty after a fault; -1: never."""
    access_pressure: float
    """Max pressure in a chamber or in the manifold from a release of the guard for as long as people may be
    inside, Pa absolute; NaN if it never was released. The manifold is looked at every 0.1 s."""
    access_motion: float
    """Max movement of a joint while people may be inside, rad."""
    armed_again: bool
    """Whether the robot armed after a fault without a reset."""
    refusals: tuple[tuple[Request, Refusal], ...]
    """Requests that were refused, each with its reason."""
    device_passive: int
    """Tick at which the valve node went passive by its watchdog; -1: never."""
    frame_distance: float
    """Smallest distance of the club from the shoulder axis, m."""
    contact: NDArray[np.float64] | None
    """x, y, theta (m, m, rad) and their speeds at the ball; None without contact."""

    def end(self, head_share: float) -> RunEnd:
        """Return the end for the judge; `head_share` is the fastest head over the profile's."""
        creep = None
        if self.vented_tick >= 0:
            after = self.cycles["plant_angle"][self.vented_tick :]
            creep = float(np.abs(after - after[0]).max()) if len(after) else 0.0
        return RunEnd(
            loads=self.loads,
            rested=self.rested,
            frame_distance=self.frame_distance,
            head_share=head_share,
            creep=creep,
            access_pressure=None if np.isnan(self.access_pressure) else self.access_pressure,
            access_motion=self.access_motion,
            armed_again=self.armed_again,
        )


class Watch:
    """Runs a bench from a fault to rest and notes the observations that a verdict needs."""

    def __init__(self, bench: LockstepEngine) -> None:
        """Watch `bench` from here on."""
        self.bench, self.period = bench, bench.period
        self.ticks = self.rest_tick = 0
        self.vented_tick = -1
        self.access_pressure, self.access_motion = float("nan"), 0.0
        self.armed_again = False
        self._inside: NDArray[np.float64] | None = None
        self._released_at = self._left_at = 0
        self.refusals: list[tuple[Request, Refusal]] = []
        self.device_passive = -1

    @property
    def state(self) -> State:
        """State of the lifecycle."""
        return State(int(self.bench.control["state"][0]))

    def advance(self, ticks: int, request: int = 0) -> None:
        """Run `ticks` ticks with `request` in the first."""
        cycles = self.bench.advance(ticks, request)
        moving = np.flatnonzero((np.abs(cycles["plant_velocity"]) > _STILL).any(axis=1))
        if len(moving):
            self.rest_tick = self.ticks + int(moving[-1]) + 1
        self._monitor_access(cycles)
        empty = np.flatnonzero(cycles["vented"])
        if len(empty) and self.vented_tick < 0 and self.state in LATCHED:
            self.vented_tick = self.ticks + int(empty[0])
        if request and cycles["answer"][0] == Answer.REFUSED and cycles["request"][0] == request:
            self.refusals.append((Request(request), Refusal(int(cycles["refusal"][0]))))
        faults = self.bench.stepper.faults
        if faults is not None and self.device_passive < 0 and faults.device["passive"][0]:
            self.device_passive = self.ticks + max(0, ticks - 1)
        self.ticks += ticks

    def _monitor_access(self, cycles: Cycles) -> None:
        """Note pressure and motion from a release of the guard until a person has secured it."""
        ran = cycles["tick"] > 0
        released = np.flatnonzero(ran & ~cycles["guard_lock"])
        if self._inside is None and len(released):
            first = released[0]
            self._inside, self._released_at = cycles["plant_angle"][first].copy(), self.ticks
            inside = cycles[first:]
        else:
            inside = cycles
        if self._inside is not None and len(inside):
            manifold = float(self.bench.plant_state["supply_pressure"][0])
            most = max(float(inside["plant_pressure"].max()), manifold)
            self.access_pressure = float(np.fmax(self.access_pressure, most))
            moved = float(np.abs(inside["plant_angle"] - self._inside).max())
            self.access_motion = max(self.access_motion, moved)

    def until_rest(self, longest: int, requests: tuple[Request, ...]) -> None:
        """Run until rest, at most `longest` ticks in all unless it creeps, and put `requests` when due.

        After a fault requests that must be refused are put instead.
        """
        latched_at, done_at = -1, -1
        left = deque(requests)
        swings = int(self.bench.control["swings"][0]) + 1
        while self.ticks < longest or self._creeps():
            request: int = 0
            if self.state in LATCHED:
                request = Request.ARM if latched_at < 0 else Request.ACCESS  # nothing arms before a reset
                latched_at = self.ticks if latched_at < 0 else latched_at
                left.clear()
            elif left and self._is_due(left[0]):
                request = left[0]
                if request == Request.SECURE:
                    self._leave()
                if request not in _REPEATED:
                    left.popleft()
            # For access a person presses the local reset repeatedly, whatever a gauge shows.
            press = request == Request.ACCESS and self.ticks // _CHUNK % 2 == 0
            self.bench.plant_state["local_reset"] = press
            self.advance(_CHUNK, request)
            if left and left[0] in _REPEATED and self._is_followed(left[0], swings):
                left.popleft()
            if latched_at >= 0 and self.state in (State.ARMED, State.SWINGING, State.HOMING):
                self.armed_again = True
            if not self._done(request, left):
                done_at = -1
            elif done_at < 0:
                done_at = self.ticks
            elif self.ticks - done_at >= 3 * _CHUNK:
                return

    def _creeps(self) -> bool:
        """Return whether a stopped robot moves, or may do so, as it stands on air."""
        if self.state not in LATCHED or self.ticks >= round(_MAX_CREEP_TIME / self.period):
            return False
        air = self.bench.plant_state["pressure"].max() - self.bench.stepper.plant.plant["atmosphere"][0]
        return bool(air > _EMPTY or self.ticks - self.rest_tick < round(_STILL_FOR / self.period))

    def _is_followed(self, request: Request, swings: int) -> bool:
        """Return whether `request` was accepted; after ACCESS, open the guard as a person does."""
        if request == Request.ACCESS:
            if self.state is State.ACCESS:
                self.bench.plant_state["guard_closed"] = False
            return self.state is State.ACCESS
        if request == Request.HOME:
            return self.state is not State.SAFE
        return bool(self.bench.control["swings"][0] >= swings)

    def _is_due(self, request: Request) -> bool:
        """Return whether `request` is to be put now."""
        state, control = self.state, self.bench.control[0]
        if request == Request.SWING:
            return bool(control["phase"] == Phase.HOLD and state is State.ARMED)
        if request == Request.SECURE:
            return state is State.ACCESS and self.ticks - self._released_at >= round(_INSIDE / self.period)
        if request == Request.ARM and not (self.bench.is_vented() or self._seems_ready()):
            return False
        return state in (State.SAFE, State.READY) or request == Request.DISARM

    def _seems_ready(self) -> bool:
        """Return whether the operator has seen no motion for a while, whatever the encoders say.

        With pressure shown in a chamber for as long as it may take to vent, whatever the sensors say.
        """
        seen = 0.5 * _STILL_FOR if self.bench.shows_no_pressure() else _MAX_VENT_TIME
        return self.ticks - self.rest_tick >= round(seen / self.period)

    def _leave(self) -> None:
        """Leave: close the guard and press the local reset."""
        state = self.bench.plant_state
        state["guard_closed"] = True
        self.advance(_CHUNK)
        state["local_reset"] = True
        self.advance(_CHUNK)
        state["local_reset"] = False
        self._inside, self._left_at = None, self.ticks

    def _done(self, request: int, left: Collection[Request]) -> bool:
        """Return whether the robot rests and no event is pending; `left` are the requests not yet sent."""
        if self.ticks - self.rest_tick < round(_STILL_FOR / self.period):
            return False
        if self.state in (State.READY, State.SAFE):
            waits = bool({Request.ACCESS, Request.HOME, Request.ARM}.intersection(left))
            return not (waits and self.ticks - self.rest_tick < round(_MAX_VENT_TIME / self.period))
        if self.state is State.ACCESS:
            begin, longest = (
                (self._released_at, _INSIDE) if Request.SECURE in left else (self._left_at, _LEAVING)
            )
            return not left or self.ticks - begin >= round((longest + 1.0) / self.period)
        if self.state is State.ARMED and self.bench.phase is Phase.HOLD and not request:
            return True
        faults = self.bench.stepper.faults
        return faults is not None and self.device_passive >= 0 and not faults.device["loop_up"][0]

    def run(self) -> WatchedRun:
        """Return the run so far."""
        cycles, state = self.bench.record(), self.bench.plant_state
        return WatchedRun(
            cycles=cycles,
            angle=state["angle"][0].copy(),
            loads=self.bench.loads(),
            control=self.bench.control.copy(),
            rest_tick=self.rest_tick,
            rested=self.ticks - self.rest_tick >= round(_STILL_FOR / self.period),
            vented_tick=self.vented_tick,
            access_pressure=self.access_pressure,
            access_motion=self.access_motion,
            armed_again=self.armed_again,
            refusals=tuple(dict.fromkeys(self.refusals)),
            device_passive=self.device_passive,
            frame_distance=_frame_distance(self.bench.stepper.plant, cycles),
            contact=state["impact_head"][0].copy() if state["struck"][0] else None,
        )


def _frame_distance(plant: Plant, cycles: Cycles) -> float:
    """Return the club's smallest distance to the shoulder axis (m)."""
    r, angle = plant.robot[0], cycles["plant_angle"]
    a1, a12 = angle[:, 0], angle[:, 0] + angle[:, 1]
    theta = a12 + angle[:, 2]
    x, y = r["l12"] * np.cos(a1) + r["l23"] * np.cos(a12), r["l12"] * np.sin(a1) + r["l23"] * np.sin(a12)
    along = np.clip(-(x * np.cos(theta) + y * np.sin(theta)), 0.0, r["l3t"])
    return float(np.hypot(x + along * np.cos(theta), y + along * np.sin(theta)).min())


def next_swing(bench: LockstepEngine) -> str:
    """Make `bench` ready for another ball as an operator does, and swing.

    Return the name of the cause that stops it before the ball, or of a request that is refused for good, with
    the reason. "" if the ball is struck.
    """
    plant, latched, refused = bench.plant_state, bench.cause, ""
    plant["emergency_stop_clear"] = plant["guard_closed"] = True
    teed = False
    for _ in range(round(_NEXT_SWING_TIMEOUT / (bench.period * _CHUNK))):
        if not teed and bench.resting():
            bench.tee_up(ball=True)
            teed = True
        request = _due(bench)
        if request in (Request.RESET, Request.SECURE):
            plant["local_reset"] = True  # a person presses the local reset
            bench.advance(_CHUNK)
            plant["local_reset"] = False
        cycles = bench.advance(_CHUNK, request)
        if request and cycles["answer"][0] == Answer.REFUSED:
            why = REFUSAL_TEXT[Refusal(int(cycles["refusal"][0]))]
            refused = f"{Request(request).name.lower()} refused: {why}"
        if bench.cause not in (Cause.NONE, latched):
            return bench.cause.name
        latched = bench.cause
        if teed and bool(plant["struck"][0]):
            return ""
    return refused or "it never swings"


def _due(bench: LockstepEngine) -> int:
    """Return the request that an operator puts next; 0: wait."""
    state = State(int(bench.control["state"][0]))
    if state in (State.FAULT, State.ESTOP):
        return Request.RESET
    if state is State.ACCESS:
        return Request.SECURE
    if state is State.SAFE:
        return Request.HOME
    if state is State.READY and bench.is_vented():
        return Request.ARM
    if state is State.ARMED and bench.resting() and bench.control["tee"][0]:
        return Request.SWING
    return 0
