"""One case of the matrix: a bench at an instant, one thing that breaks, and how that ends.

Everything is judged by the plant's truth, not by what the bench believes; what the bench noticed, when, and
what it tells the operator stands beside it.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from functools import cached_property
from math import hypot, pi
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.config import Configuration
from bench.control.records import ControlParameters, new_control_state
from bench.control.settings import SIMULATED, build_controller
from bench.errors import Refused
from bench.faults.catalogue import EVENT_AFTER, Breakage
from bench.lifecycle import CAUSE_TEXT, REFUSAL_TEXT, Answer, Cause, Phase, Reaction, Refusal, Request, State
from bench.loop import Cycles
from bench.simulation.engine import LockstepEngine
from bench.simulation.loads import Loads
from bench.simulation.lockstep import Lockstep
from bench.simulation.safety import RunEnd, SafetyLimits, dangers
from bench.swing.profile import PHASES as SWING_PHASES
from bench.swing.profile import Profile
from sim.driver import hanging_pose
from sim.faults import own_records
from sim.plant import Plant, build_plant

_LATCHED = (State.FAULT, State.ESTOP)
_LONGEST = 40.0
"""s that a case is watched."""
_LONGEST_SEARCH = 10.0
"""s more for a case that begins in the search: it goes on to a swing."""
_CHUNK = 100
_STILL, _STILL_FOR = 0.02, 1.0
"""rad/s; s."""
_ASK_AFTER = 0.2
"""s in hold or standing from the fault to the request that goes on."""
_MATTERS = {"speed": 0.01, "strike": 0.005, "pose": 0.02}
"""Share of the head's speed, m at the ball, rad at the end: what a fault may change without mattering."""


@dataclass(frozen=True)
class Instant:
    """When something breaks: a phase, and ticks from the begin of the swing (or of the search)."""

    phase: str
    tick: int
    label: str = ""

    @property
    def name(self) -> str:
        """Phase and label."""
        return f"{self.phase} {self.label}".strip()


def instants_of(profile: Profile) -> tuple[Instant, ...]:
    """Return the instants of the matrix in order."""
    spans = dict(
        zip(
            SWING_PHASES,
            zip(profile.begins, (*profile.begins[1:], len(profile.angle)), strict=True),
            strict=True,
        )
    )
    impact = round(profile.impact_time / profile.period)

    def at(phase: Phase, *shares: float) -> list[Instant]:
        begin, end = spans[phase]
        name = phase.name.lower().replace("_", "-")
        return [Instant(name, begin + round(s * (end - 1 - begin)), f"{100 * s:.0f} %") for s in shares]

    return (
        Instant("standing", 0),
        *(Instant("homing", tick, f"{tick} ms") for tick in (2500, 3500, 5000)),
        Instant("hold", 0),
        *at(Phase.BACKSWING, 0.1, 0.5, 0.9),
        *at(Phase.TOP, 0.5),
        *at(Phase.DOWNSWING, 0.2, 0.8),
        *at(Phase.COMMITTED, 0.1, 0.6),
        *(Instant("impact", impact + ms, f"{ms:+d} ms") for ms in (-10, 0, 10)),
        *at(Phase.FOLLOW_THROUGH, 0.1, 0.4, 0.8),
        *(Instant("return", len(profile.angle) + ticks, f"{ticks} ms") for ticks in (300, 1200)),
    )


@dataclass(frozen=True)
class CaseOutcome:
    """How one case ended. Shares are of a rating or limit: 1 is the limit. Times are ticks from the fault."""

    breakage: str
    signal: str
    kind: str
    phase: str
    instant: str
    verdict: str
    """safe, harmless, undetected or unsafe."""
    reasons: tuple[str, ...]
    detected_by: str
    detection_ticks: int
    """-1: never."""
    reaction: str
    reaction_ticks: int
    """To the first command at the valve that carries the reaction; -1: none."""
    stop_share: float
    stop: str
    pressure_share: float
    overtravel: float
    """Share of a cushion's travel that was pressed in."""
    stop_head_speed: float
    """Fastest head while a cushion was pressed, m/s."""
    clearance: float
    """Lowest of the head over the ground, m."""
    head_share: float
    """Fastest head, share of the profile's."""
    rest_ticks: int
    """Until all joints rested for good; -1: they did not."""
    operator: str
    record: str
    change: str
    """What became different at the ball or at rest; empty when nothing that matters."""

    def as_json(self) -> dict[str, Any]:
        """Return it as JSON has it."""
        return asdict(self) | {"reasons": list(self.reasons)}


class Workbench:
    """A plant, a profile and settings, from whose undisturbed run each case begins."""

    def __init__(
        self, configuration: Configuration, profile: Profile, *, model_check: bool | None = None
    ) -> None:
        """Build plant and controllers; `model_check` overrules what the configuration says of it."""
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
        self._ends: dict[Instant, _End] = {}
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
        end = self._watched(instant, breakage)
        healthy = self._healthy(instant, without_ball=breakage.event == "no ball")
        return _judged(self, breakage, instant, end, healthy)

    def _healthy(self, instant: Instant, *, without_ball: bool) -> _End:
        key = replace(instant, label=instant.label + (" no ball" if without_ball else ""))
        if key not in self._ends:
            self._ends[key] = self._watched(instant, None, without_ball=without_ball)
        return self._ends[key]

    @cached_property
    def max_head_speed(self) -> float:
        """Fastest head of the undisturbed swing, m/s, with a ball and without one."""
        hold = Instant("hold", 0)
        return max(self._healthy(hold, without_ball=no).loads.peak_head_speed for no in (False, True))

    @property
    def limits(self) -> SafetyLimits:
        """Limits beyond which an end is unsafe."""
        return SafetyLimits(
            frame_radius=self.envelope.frame_radius,
            access_pressure=1.05 * self.configuration.lifecycle.vented_pressure,
        )

    def _watched(self, instant: Instant, breakage: Breakage | None, *, without_ball: bool = False) -> _End:
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
        watch = _Watch(bench)
        ask_at = round(_ASK_AFTER / self.period)
        event_at = round(EVENT_AFTER / self.period)
        event = breakage.event if breakage is not None else ""
        watch.advance(event_at, 0)
        if event == "guard opened":
            state["guard_closed"] = False
        elif event == "emergency stop":
            state["emergency_stop_clear"] = False
        watch.advance(ask_at - event_at, Request.STOP if event == "stop" else 0)
        going_on = {"standing": Request.ARM, "homing": Request.ARM, "hold": Request.SWING}.get(
            instant.phase, 0
        )
        longest = _LONGEST + (_LONGEST_SEARCH if instant.phase == "homing" else 0.0)
        watch.until_rest(round(longest / self.period), going_on, instant.phase)
        return watch.end()


@dataclass
class _End:
    """What came of a run, before it is judged."""

    cycles: Cycles
    angle: NDArray[np.float64]
    """Joint angles at the end, rad."""
    loads: Loads
    control: np.ndarray
    rest_tick: int
    vented_tick: int
    access_pressure: float
    """Greatest chamber pressure when the guard was released, Pa; NaN when it never was."""
    armed_again: bool
    refusals: tuple[str, ...]
    device_passive: int
    """Tick at which the device went passive by itself; -1: it did not."""
    frame_distance: float
    contact: NDArray[np.float64] | None
    """x, y, theta (m, m, rad) and their speeds at the ball."""


class _Watch:
    """Runs a bench chunk by chunk and keeps what a verdict needs."""

    def __init__(self, bench: LockstepEngine) -> None:
        self.bench, self.period = bench, bench.period
        self.ticks = self.rest_tick = 0
        self.vented_tick = -1
        self.access_pressure = float("nan")
        self.armed_again = False
        self.refusals: list[str] = []
        self.device_passive = -1

    @property
    def state(self) -> State:
        return State(int(self.bench.control["state"][0]))

    def advance(self, ticks: int, request: int = 0) -> None:
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
        """Go on, with what goes on from standing and hold, and then with what must be refused, until rest."""
        latched_at, asked, done_at = -1, False, -1
        while self.ticks < longest:
            request = 0
            control = self.bench.control[0]
            if self.state in _LATCHED:
                if latched_at < 0:
                    latched_at = self.ticks
                    request = Request.ARM  # nothing arms before a reset
                else:
                    request = Request.ACCESS
            elif going_on == Request.ARM and not asked and self.state is not State.HOMING:
                asked, request = True, Request.ARM
            elif (
                going_on
                and control["phase"] == Phase.HOLD
                and control["state"] == State.ARMED
                and control["swings"] == (0 if going_on == Request.ARM or phase == "hold" else 1)
            ):
                request = Request.SWING
            self.advance(_CHUNK, request)
            if latched_at >= 0 and self.state in (State.ARMED, State.SWINGING, State.HOMING):
                self.armed_again = True
            still = self.ticks - self.rest_tick >= round(_STILL_FOR / self.period)
            idle = self.state in (State.ACCESS, State.READY, State.SAFE) or (
                self.state is State.ARMED and control["phase"] == Phase.HOLD and not request
            )
            faults = self.bench.stepper.faults
            silent = faults is not None and self.device_passive >= 0 and not faults.device["loop_up"][0]
            if still and (idle or silent):
                if done_at < 0:
                    done_at = self.ticks
                elif self.ticks - done_at >= 3 * _CHUNK:
                    return
            else:
                done_at = -1

    def end(self) -> _End:
        cycles, state = self.bench.record(), self.bench.plant_state
        return _End(
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


def _first(mask: NDArray[np.bool_]) -> int:
    found = np.flatnonzero(mask)
    return int(found[0]) if len(found) else -1


def _judged(w: Workbench, breakage: Breakage, instant: Instant, end: _End, healthy: _End) -> CaseOutcome:
    cycles, loads, control = end.cycles, end.loads, end.control[0]
    pressed = _pressed(w, cycles)
    fastest_at_stop = float(cycles["plant_head_speed"][pressed].max(initial=0.0))
    ran = cycles["tick"] > 0
    tripped = _first(ran & (cycles["trip"] != 0))
    cause = Cause(int(control["cause"]))
    if tripped >= 0:
        detected_by = Cause(int(cycles["trip"][tripped])).name
    else:
        detected_by, tripped = _other_detection(end, healthy)
    reacted = _first(ran & (cycles["reaction"] >= Reaction.COMPLETE)) if detected_by else -1
    reaction = Reaction(int(cycles["reaction"][reacted])).name if reacted >= 0 else ""
    if end.device_passive >= 0 and reacted < 0:
        reaction, reacted = "PASSIVE (valve node)", end.device_passive
    change = _change(end, healthy) if not detected_by else ""
    head_share = loads.peak_head_speed / w.max_head_speed
    reasons = dangers(_run_end(end, head_share), w.limits)
    if reasons and not detected_by:
        reasons.append("the record says healthy")
    if reasons:
        verdict = "unsafe"
    elif detected_by:
        verdict = "safe"
    else:
        verdict = "undetected" if change else "harmless"
    if verdict == "undetected":
        reasons.append(change)
    final = State(int(control["state"]))
    told = CAUSE_TEXT[cause] if cause else "; ".join(end.refusals) or "nothing"
    return CaseOutcome(
        breakage=breakage.name,
        signal=breakage.fault.signal,
        kind=breakage.fault.kind,
        phase=instant.phase,
        instant=instant.name,
        verdict=verdict,
        reasons=tuple(reasons),
        detected_by=detected_by,
        detection_ticks=tripped,
        reaction=reaction,
        reaction_ticks=reacted,
        stop_share=round(loads.stop_share, 4),
        stop=loads.stop,
        pressure_share=round(loads.pressure_share, 4),
        overtravel=round(loads.depth_share, 4),
        stop_head_speed=round(fastest_at_stop, 2),
        clearance=round(loads.lowest_clearance, 4),
        head_share=round(head_share, 4),
        rest_ticks=end.rest_tick if end.rest_tick < len(cycles) - 1 else -1,
        operator=told,
        record=f"{final.name}, trip {cause.name}" + (f", reaction {reaction}" if reaction else ""),
        change=change,
    )


def _pressed(w: Workbench, cycles: Cycles) -> NDArray[np.bool_]:
    """Tell in which ticks a cushion was pressed."""
    r, angle = w.plant.robot[0], cycles["plant_angle"]
    length = np.hypot(r["l62"] + r["l23"] * np.cos(angle[:, 1]), r["l23"] * np.sin(angle[:, 1]))
    position = np.column_stack([angle[:, 0], length - r["l56"], angle[:, 2]])
    lower = [a.lower for a in w.configuration.plant.actuators]
    upper = [a.upper for a in w.configuration.plant.actuators]
    return np.asarray(((position < lower) | (position > upper)).any(axis=1))


def _other_detection(end: _End, healthy: _End) -> tuple[str, int]:
    """Return what noticed the fault though no cause was latched, and when (ticks)."""
    if end.device_passive >= 0:
        return "watchdog of the valve node", end.device_passive
    news = [refusal for refusal in end.refusals if refusal not in healthy.refusals]
    if news:
        at = _first((end.cycles["answer"] == Answer.REFUSED) & (end.cycles["request"] != 0))
        return news[0].partition(":")[0], at
    for name, text in (("lease_held", "disarmed: no lease"), ("support_ready", "disarmed: nothing records")):
        gone = _first((end.cycles["tick"] > 0) & ~end.cycles[name])
        if gone >= 0:
            return text, gone
    left, struck = _ball_left(end.cycles), not _ball_left(healthy.cycles)
    if left and struck:
        return "no ball struck, told of the shot", len(end.cycles) - 1
    ran = np.flatnonzero(end.cycles["tick"] > 0)
    late = end.cycles["measured_step"][ran] > 1.5 * np.median(end.cycles["measured_step"][ran])
    if late.any():
        return "missed ticks, counted with the swing", int(ran[np.flatnonzero(late)[0]])
    return "", -1


def _ball_left(cycles: Cycles) -> bool:
    """Tell whether the ball sensor sees the ball after the blow; no blow leaves none."""
    seen = cycles["ball_present"][cycles["phase"] == Phase.FOLLOW_THROUGH]
    return bool(len(seen) and seen[-1])


def _change(end: _End, healthy: _End) -> str:
    """Return what became different at the ball or at rest."""
    if (end.contact is None) != (healthy.contact is None):
        return "the ball was missed" if end.contact is None else "a ball was struck"
    if end.contact is not None and healthy.contact is not None:
        a, b = end.contact, healthy.contact
        speed, wanted = hypot(a[3], a[4]), hypot(b[3], b[4])
        if abs(speed - wanted) > _MATTERS["speed"] * wanted:
            return f"club speed at the ball {speed:.1f} instead of {wanted:.1f} m/s"
        # Across the club's way: along it the contact is found anyhow.
        off = abs((a[0] - b[0]) * -b[4] + (a[1] - b[1]) * b[3]) / wanted
        if off > _MATTERS["strike"]:
            return f"struck {1e3 * off:.0f} mm off"
    apart = np.abs(end.angle - healthy.angle).max()
    if apart > _MATTERS["pose"] and not np.isnan(apart):
        return f"rests {apart:.2f} rad from where it should"
    return ""


def _run_end(end: _End, head_share: float) -> RunEnd:
    """Return the end as the judge takes it."""
    creep = None
    if end.vented_tick >= 0:
        after = end.cycles["plant_angle"][end.vented_tick :]
        creep = float(np.abs(after - after[0]).max()) if len(after) else 0.0
    return RunEnd(
        loads=end.loads,
        rested=end.rest_tick < len(end.cycles) - 1,
        frame_distance=end.frame_distance,
        head_share=head_share,
        creep=creep,
        access_pressure=None if np.isnan(end.access_pressure) else end.access_pressure,
        armed_again=end.armed_again,
    )
