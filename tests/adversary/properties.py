"""Properties of a bench in every tick, under any input, evaluated on the plant's truth.

Nothing here asks the bench for its own verdict where the plant or the story knows better. A property that a
fault violates directly is not evaluated while the story has that fault; each property says which.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.base.lifecycle import (
    ACCEPTED_IN,
    EMERGENCIES,
    NEEDS_LEASE,
    TRANSITIONS,
    Answer,
    Cause,
    Phase,
    Reaction,
    Refusal,
    Request,
    State,
)
from bench.control.step_records import ControlParameters
from bench.simulation.safety import Loads, RunEnd, SafetyLimits, unsafe_reasons
from sim.faults import Fault, sort_of
from tests.adversary.story import Setup

MOTION = np.array([State.HOMING, State.ARMED, State.SWINGING, State.RECOVERING])
LATCHED = np.array([State.ESTOP, State.FAULT])
_NUMBERS = (
    "time",
    "measured_step",
    "angle",
    "velocity",
    "angle_variance",
    "reference_angle",
    "reference_velocity",
    "proportional",
    "integral",
    "derivative",
    "feedforward",
    "desired_valve",
    "applied_valve",
    "head_position",
    "head_orientation",
    "head_speed",
    "plant_angle",
    "plant_velocity",
    "plant_pressure",
)
_PAIRS = np.eye(len(State), dtype=bool)
for _edge in TRANSITIONS:
    _PAIRS[_edge.source, _edge.target] = True
_LONGEST_STOP = 15_000
"""Max ticks from the start of a reaction to standstill."""
_PRESS_COUNTS = 10_050
"""Ticks for which a press of the local reset may count."""
_STILL, _CREEP = 0.15, 0.06
"""rad/s and rad by which a joint may move while the guard is released."""
_MARGIN = 1.05
"""On the pressure that counts as vented: what fills a chamber again from its own tube."""
_ASKED_FOR = frozenset(
    {
        Cause.NONE,
        Cause.EMERGENCY_STOP,
        Cause.GUARD,
        Cause.OPERATOR_STOP,
        Cause.NETWORK_STOP,
        Cause.POWER_UP,
        Cause.RESTART,
        Cause.SUPERVISOR,
    }
)
"""Causes that people and network give."""


def sorts(faults: list[Fault]) -> set[str]:
    """Return the sorts of signals that `faults` break."""
    return {sort_of(fault.signal) for fault in faults}


class Judge:
    """Checks every tick of a story, and keeps the violations."""

    def __init__(self, setup: Setup, parameters: ControlParameters) -> None:
        """Judge a bench of `setup` with `parameters`."""
        self.setup = setup
        self.broken: list[str] = []
        p = parameters.control[0]
        self._holding, self._opening = float(p["holding_pressure"]), float(p["home_opening"])
        self._state, self._trip, self._supply = int(State.STARTING), 0, False
        self._latched = self._secured = False
        self._stood_since, self._press = -1, -(10**9)
        self._dark_at, self._reacting_since = -1, -1
        self._released_at: NDArray[Any] | None = None
        self._locked, self._entered = True, False
        self.causes: set[Cause] = set()
        """Causes of the stops so far."""
        self.visited: set[State] = set()

    def pressed(self, tick: int) -> None:
        """Note that the local reset is pressed at `tick`."""
        self._press = tick

    def _say(self, tick: int, text: str) -> None:
        self.broken.append(f"tick {tick}: {text}")

    def look(
        self, all_cycles: Any, first: int, request: int, number: int, plant_state: Any, faults: list[Fault]
    ) -> None:
        """Judge the records of the ticks from `first` on, the first of which was put `request`."""
        up = all_cycles["tick"] > 0
        if not up.any():
            return
        cycles, ticks = all_cycles[up], first + np.flatnonzero(up)
        broken = sorts(faults)
        self._outputs(cycles, ticks)
        self._ways(cycles, ticks)
        self._warning(cycles, ticks, broken)
        self._latch(cycles, ticks, faults)
        if request and up[0]:
            self._answer(cycles[0], int(ticks[0]), request, number)
        self._release(cycles, ticks, plant_state, faults)
        self._stops_end(cycles, ticks)
        self._state, self._trip = int(cycles["state"][-1]), int(cycles["cause"][-1])
        self._supply = bool(cycles["supply_enable"][-1])
        self.causes |= {Cause(int(c)) for c in np.unique(cycles["cause"])}
        self.visited |= {State(int(c)) for c in np.unique(cycles["state"])}

    # In every tick --------------------------------------------------------------------------------------

    def _outputs(self, c: Any, ticks: NDArray[Any]) -> None:
        """Numbers only, valves within their limits, no energy where nothing may move."""
        for name in _NUMBERS:
            bad = ~np.isfinite(c[name].reshape(len(c), -1)).all(axis=1)
            if bad.any():
                self._say(ticks[np.argmax(bad)], f"{name} is not finite")
        valve = np.abs(c["applied_valve"]).max(axis=1)
        homing = (c["phase"] == Phase.HOMING) & (c["reaction"] <= Reaction.COMPLETE)
        for bad, text in (
            (valve > 1.0, "a valve command beyond 1"),
            (homing & (valve > self._opening + 1e-12), "a valve command beyond the search's"),
        ):
            if bad.any():
                self._say(ticks[np.argmax(bad)], text)
        live = (valve > 0.0) | c["supply_enable"] | c["exhaust_closed"] | c["tee"]
        bad = live & (~np.isin(c["state"], MOTION) | (c["phase"] == Phase.STANDING))
        if bad.any():
            k = int(np.argmax(bad))
            self._say(ticks[k], f"energy in {State(int(c['state'][k])).name}")

    def _ways(self, c: Any, ticks: NDArray[Any]) -> None:
        """States change along edges only: one a tick, or that of an accepted request and one after it."""
        states = np.concatenate([[self._state], c["state"]])
        for k in np.flatnonzero(~_PAIRS[states[:-1], states[1:]]):
            before, after = State(int(states[k])), State(int(states[k + 1]))
            asked = Request(int(c["request"][k])).name.lower() if c["answer"][k] == Answer.ACCEPTED else ""
            between = {e.target for e in TRANSITIONS if asked and (e.source, e.event) == (before, asked)}
            if not any(_PAIRS[state, after] for state in between):
                self._say(ticks[k], f"{before.name} -> {after.name}")

    def _warning(self, c: Any, ticks: NDArray[Any], broken: set[str]) -> None:
        """No air without the whole warning, nor while an interlock is seen open."""
        supply = np.concatenate([[self._supply], c["supply_enable"]])
        for k in np.flatnonzero(~supply[:-1] & supply[1:]):
            dark = np.flatnonzero(~c["beacon"][:k])
            since = int(ticks[dark[-1]]) if len(dark) else self._dark_at
            warned = (int(ticks[k]) - since - 1) / 1000
            if warned < self.setup.warning_time - 0.002 and not broken & {"clock", "loop"}:
                self._say(ticks[k], f"air after a warning of {warned:g} s")
            if not (c["emergency_stop_clear"][k] and c["guard_closed"][k] and c["guard_locked"][k]):
                self._say(ticks[k], "air with an open interlock")
        dark = np.flatnonzero(~c["beacon"])
        if len(dark):
            self._dark_at = int(ticks[dark[-1]])

    def _latch(self, c: Any, ticks: NDArray[Any], faults: list[Fault]) -> None:
        """A stop is kept until it is reset, by a person where there is a button; nothing arms before."""
        states = np.concatenate([[self._state], c["state"]])
        trips = np.concatenate([[self._trip], c["cause"]])
        accepted = c["answer"] == Answer.ACCEPTED
        reset = (c["request"] == Request.RESET) & accepted
        secured = (c["request"] == Request.SECURE) & accepted
        changed = (states[1:] != states[:-1]) | (trips[1:] != trips[:-1]) | reset | secured
        for k in np.flatnonzero(changed):
            before, after, tick = int(trips[k]), int(trips[k + 1]), int(ticks[k])
            on_top = after in (Cause.NOT_VENTED, Cause.MANIFOLD)
            on_top |= Cause.SHOULDER_A_EXHAUST <= after <= Cause.WRIST_B_EXHAUST
            on_top |= Cause(after) in EMERGENCIES and Cause(before) not in EMERGENCIES
            if before not in (0, after) and not reset[k] and not on_top:
                self._say(tick, f"cause {Cause(before).name} replaced by {Cause(after).name}")
            if reset[k]:
                self._confirmed(tick, "reset", faults)
                self._latched = False
            if secured[k]:
                self._confirmed(tick, "secure", faults)
                self._secured = True
            state, was = State(int(states[k + 1])), State(int(states[k]))
            if was is State.ACCESS and state is not was and state not in LATCHED and not self._secured:
                self._say(tick, f"ACCESS -> {state.name} without SECURE")
            if state is not was and (state in LATCHED or state is State.ACCESS):
                self._stood_since, self._secured = tick, False
                self._latched = self._latched or state is not State.ACCESS
            if self._latched and state not in (State.ESTOP, State.FAULT, State.ACCESS):
                self._say(tick, f"{state.name} without a reset")
                self._latched = False

    def _confirmed(self, tick: int, what: str, faults: list[Fault]) -> None:
        """Insist on a press of the button since the state was entered, which has confirmed nothing before."""
        press, self._press = self._press, -(10**9)
        if not self.setup.local_reset or any(f.signal in ("local reset", "clock", "loop") for f in faults):
            return
        if not self._stood_since <= press <= tick or tick - press > _PRESS_COUNTS:
            self._say(tick, f"{what} without a press of the local reset")

    def _answer(self, c: Any, tick: int, request: int, number: int) -> None:
        """Every request is answered once, in its tick, under its number, as the tables say."""
        if c["request"] != request:
            self._say(tick, "the request was not taken")
        if request in (Request.STOP, Request.EMERGENCY_STOP):
            return
        if c["request_number"] != number or c["answer"] not in (Answer.ACCEPTED, Answer.REFUSED):
            self._say(tick, "the request was not answered")
        if (c["answer"] == Answer.REFUSED) != (c["refusal"] != Refusal.NONE):
            self._say(tick, "an answer without its reason")
        if c["answer"] == Answer.ACCEPTED:
            if self._state not in ACCEPTED_IN[Request(request)]:
                self._say(tick, f"{Request(request).name} accepted in {State(self._state).name}")
            if Request(request) in NEEDS_LEASE and not c["lease_held"]:
                self._say(tick, f"{Request(request).name} accepted without the lease")

    def _release(self, c: Any, ticks: NDArray[Any], plant_state: Any, faults: list[Fault]) -> None:
        """The guard is released only without pressure, and nothing moves while it is released.

        Pressure that comes back locks the guard in the same tick, unless a person went in: then it latches in
        the same tick, and the guard stays released. Two faults may hide pressure: one that keeps it, and one
        of what would have shown it.
        """
        inside = self._inside(c, ticks)
        open_ = ~c["guard_lock"]
        if not open_.any():
            self._released_at = None
            return
        broken = sorts(faults)
        keeps = broken & {"vents", "vent", "valve", "supply"}
        told = any(f.signal.endswith(" feedback") for f in faults)
        hides = "pressure" in broken or (told and not self.setup.sensors)
        k = int(np.argmax(open_))
        safe = open_ & ~(inside & np.isin(c["state"], LATCHED) & (c["cause"] != Cause.NONE))
        if safe.any() and not (keeps and hides):
            pressure = c["plant_pressure"][safe].max()
            if pressure > _MARGIN * self._holding:
                self._say(ticks[k], f"guard released at {1e-5 * pressure:.2f} bar in a chamber")
            manifold = float(plant_state["supply_pressure"][0])
            if safe[-1] and manifold > _MARGIN * self._holding:
                self._say(ticks[k], f"guard released at {1e-5 * manifold:.2f} bar in the manifold")
        if not keeps and "club head" not in broken:
            if self._released_at is None:
                self._released_at = c["plant_angle"][k].copy()
            speed = np.abs(c["plant_velocity"][open_]).max()
            crept = np.abs(c["plant_angle"][open_] - self._released_at).max()
            if speed > _STILL or crept > _CREEP:
                self._say(ticks[k], f"moves by {crept:.3f} rad at {speed:.2f} rad/s with the guard open")

    def _inside(self, c: Any, ticks: NDArray[Any]) -> NDArray[np.bool_]:
        """Return in which ticks a person may be inside: since the released guard was seen open.

        Only SECURE locks it then; no person is inside once it is seen locked after that.
        """
        inside = np.zeros(len(c), dtype=bool)
        closed = c["emergency_stop_clear"] & c["guard_closed"] & c["guard_locked"]
        secured = (c["request"] == Request.SECURE) & (c["answer"] == Answer.ACCEPTED)
        if not self._entered and self._locked and c["guard_lock"].all():
            return inside
        for k in range(len(c)):
            if c["guard_lock"][k]:
                if self._entered and not self._locked and not secured[k]:
                    self._say(ticks[k], "locked in")
                self._entered = self._entered and not closed[k]
            elif not c["guard_closed"][k]:
                self._entered = True
            self._locked, inside[k] = bool(c["guard_lock"][k]), self._entered
        return inside

    def _stops_end(self, c: Any, ticks: NDArray[Any]) -> None:
        """Every stop comes to its end."""
        under_way = (c["reaction"] != Reaction.NONE) & (c["phase"] != Phase.STANDING)
        for k in np.flatnonzero(np.diff(under_way.astype(np.int8), prepend=int(self._reacting_since >= 0))):
            self._reacting_since = int(ticks[k]) if under_way[k] else -1
        if self._reacting_since >= 0 and ticks[-1] - self._reacting_since > _LONGEST_STOP:
            self._say(ticks[-1], "a stop without an end")
            self._reacting_since = int(ticks[-1])

    # At the end -----------------------------------------------------------------------------------------

    def end(self, loads: Loads, faults: list[Fault]) -> None:
        """Judge a whole story: without a fault nothing is overloaded, and nothing raises an alarm."""
        if faults:
            return
        self.broken += [
            f"without a fault {danger}" for danger in unsafe_reasons(RunEnd(loads), SafetyLimits())
        ]
        alarms = sorted(cause.name for cause in self.causes - _ASKED_FOR)
        if alarms:
            self.broken.append(f"false alarm: {', '.join(alarms)}")
