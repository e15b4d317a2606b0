"""A run of the bench from a fault until everything rests, and the observations made on the way.

They are the plant's truth, not the bench's belief; what the bench reported stands beside it in the records.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.lifecycle import REFUSAL_TEXT, Answer, Phase, Refusal, Request, State
from bench.loop import Cycles
from bench.simulation.engine import LockstepEngine
from bench.simulation.loads import Loads
from bench.simulation.safety import RunEnd
from sim.plant import Plant

_LATCHED = (State.FAULT, State.ESTOP)
_CHUNK = 100
"""Ticks between two looks."""
_STILL, _STILL_FOR = 0.02, 1.0
"""Joint speed below which a joint rests, rad/s, and the time for which it must, s."""


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
    vented_tick: int
    """Tick at which the chambers were reported empty after a fault; -1: never."""
    access_pressure: float
    """Max chamber pressure when the guard was released, Pa absolute; NaN if it never was."""
    armed_again: bool
    """Whether the robot armed after a fault without a reset."""
    refusals: tuple[str, ...]
    """Requests that were refused, each with its reason."""
    device_passive: int
    """Tick at which the valve node went passive by itself; -1: never."""
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
            rested=self.rest_tick < len(self.cycles) - 1,
            frame_distance=self.frame_distance,
            head_share=head_share,
            creep=creep,
            access_pressure=None if np.isnan(self.access_pressure) else self.access_pressure,
            armed_again=self.armed_again,
        )


class Watch:
    """Runs a bench from a fault to rest and notes the observations that a verdict needs."""

    def __init__(self, bench: LockstepEngine) -> None:
        """Watch `bench` from here on."""
        self.bench, self.period = bench, bench.period
        self.ticks = self.rest_tick = 0
        self.vented_tick = -1
        self.access_pressure = float("nan")
        self.armed_again = False
        self.refusals: list[str] = []
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
        released = np.flatnonzero((cycles["tick"] > 0) & ~cycles["guard_lock"])
        if len(released) and np.isnan(self.access_pressure):
            self.access_pressure = float(cycles["plant_pressure"][released[0]].max())
        empty = np.flatnonzero(cycles["vented"])
        if len(empty) and self.vented_tick < 0 and self.state in _LATCHED:
            self.vented_tick = self.ticks + int(empty[0])
        if request and cycles["answer"][0] == Answer.REFUSED and cycles["request"][0] == request:
            self.refusals.append(
                f"{Request(request).name.lower()} refused: {REFUSAL_TEXT[Refusal(int(cycles['refusal'][0]))]}"
            )
        faults = self.bench.stepper.faults
        if faults is not None and self.device_passive < 0 and faults.device["passive"][0]:
            self.device_passive = self.ticks + max(0, ticks - 1)
        self.ticks += ticks

    def until_rest(self, longest: int, going_on: int, phase: str) -> None:
        """Run until rest, at most `longest` ticks in all, with requests from `phase` on.

        From standing and hold the request `going_on` is put; after a fault requests that must be refused.
        """
        latched_at, asked, done_at = -1, False, -1
        while self.ticks < longest:
            request: int = 0
            if self.state in _LATCHED:
                request = Request.ARM if latched_at < 0 else Request.ACCESS  # nothing arms before a reset
                latched_at = self.ticks if latched_at < 0 else latched_at
            elif going_on == Request.ARM and not asked and self.state is not State.HOMING:
                asked, request = True, Request.ARM
            elif going_on and self._may_swing(0 if going_on == Request.ARM or phase == "hold" else 1):
                request = Request.SWING
            self.advance(_CHUNK, request)
            if latched_at >= 0 and self.state in (State.ARMED, State.SWINGING, State.HOMING):
                self.armed_again = True
            if not self._done(request):
                done_at = -1
            elif done_at < 0:
                done_at = self.ticks
            elif self.ticks - done_at >= 3 * _CHUNK:
                return

    def _may_swing(self, swings: int) -> bool:
        """Return whether the robot holds its address after `swings` swings."""
        control = self.bench.control[0]
        holds = control["phase"] == Phase.HOLD and control["state"] == State.ARMED
        return bool(holds and control["swings"] == swings)

    def _done(self, request: int) -> bool:
        """Return whether the robot is still and nothing more will come."""
        if self.ticks - self.rest_tick < round(_STILL_FOR / self.period):
            return False
        if self.state in (State.ACCESS, State.READY, State.SAFE):
            return True
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
            vented_tick=self.vented_tick,
            access_pressure=self.access_pressure,
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
