"""Faults of signals and parts as data: what fails, how, and when.

One vocabulary for all signals between plant and bench, and for parts of the plant. `Fault` defines a fault,
`new_faults` turns faults into records, and compiled pure functions apply them, tick by tick: `notice_onsets`,
`deliver_readings`, `faulty_time`, `deliver_command`, `break_parts`, in this order around `sense`, the
bench's step and `advance`. Without faults none of them is called. The same seed gives the same faults, bit
for bit.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import isfinite, isnan, nan, pi
from typing import Annotated, Any, Literal, NamedTuple, get_args

import numpy as np

from drivers.base import CHAMBERS, INVALID, JOINTS
from drivers.base.compiled import compiled, compiled_with_arrays, fields, new_record
from drivers.base.native import rest_command
from drivers.base.ranges import Range
from drivers.base.records import COMMAND, READINGS
from sim.plant import EXHAUSTS, OPEN, RELIEFS, SHUT, Plant
from sim.sensors import sense, uniform

Kind = Literal[
    "off",
    "stuck",
    "garbage",
    "offset",
    "scale",
    "slow",
    "delayed",
    "intermittent",
    "drifting",
    "leaking",
    "swapped",
]
KINDS: tuple[Kind, ...] = get_args(Kind)

_SORTS: dict[str, str] = {
    **dict.fromkeys((f"{joint} encoder" for joint in JOINTS), "encoder"),
    **dict.fromkeys((f"{joint} valve" for joint in JOINTS), "valve"),
    "supply": "supply",
    "vents": "vents",
    **dict.fromkeys(("emergency stop", "guard closed", "guard locked"), "switch"),
    **dict.fromkeys(("local reset", "ball sensor"), "switch"),
    "tee": "tee",
    **dict.fromkeys(("supply sensor", *(f"{chamber} sensor" for chamber in CHAMBERS)), "pressure"),
    **{signal: signal for signal in ("club head", "link", "clock", "loop")},
    **dict.fromkeys(("supervisor", "recorder", "lease"), "process"),
    "launch monitor": "launch monitor",
    **dict.fromkeys(("vent 1", "vent 2"), "vent"),
    **dict.fromkeys(("vent 1 feedback", "vent 2 feedback"), "switch"),
    "shut-off": "shut-off",
    "shut-off feedback": "switch",
    **dict.fromkeys((*(f"{chamber} relief" for chamber in CHAMBERS), "manifold relief"), "relief"),
    "safety relay": "safety relay",
    **dict.fromkeys((*(f"{chamber} exhaust" for chamber in CHAMBERS), "manifold exhaust"), "exhaust"),
    **dict.fromkeys((*(f"{joint} exhaust" for joint in JOINTS), "exhausts"), "exhaust"),
    **dict.fromkeys((f"{joint} spool feedback" for joint in JOINTS), "spool feedback"),
}
SIGNALS = tuple(_SORTS)
"""Signals and parts that can fail."""
SWITCHES = tuple(signal for signal, sort in _SORTS.items() if sort == "switch")
"""Inputs that are on or off, by their numbers for "swapped"."""

PHASES = (
    "standing",
    "homing",
    "hold",
    "backswing",
    "top",
    "downswing",
    "committed",
    "impact",
    "follow_through",
    "return",
)
"""Names of the phases for onsets, by number; a test keeps them equal to the bench's."""

MEANINGS: dict[str, dict[Kind, str]] = {
    "encoder": {
        "off": "no valid reading",
        "stuck": "the count freezes, its time stamp advances",
        "garbage": "any count",
        "offset": "`value` rad too much",
        "scale": "from the onset on, `value` times the true change",
        "slow": "follows with a time constant of `value` s",
        "delayed": "`value` s late, with a wrong time stamp",
        "intermittent": "no valid reading in the share `value` of ticks",
        "drifting": "`value` rad/s away from the truth",
        "swapped": "exchanged with that of joint `value` (0 shoulder, 1 arm, 2 wrist)",
    },
    "valve": {
        "off": "de-energised: the spring centres the spool",
        "stuck": "the spool stays at `value`, or where it stands",
        "garbage": "a random valve command in each tick",
        "offset": "opens by `value` too much",
        "scale": "opens `value` times as far",
        "slow": "follows with a time constant of `value` s",
        "delayed": "follows `value` s late",
        "intermittent": "centred in the fraction `value` of ticks",
        "drifting": "opens by `value` a second too much",
        "leaking": "closed edges leak the fraction `value` of the fully open flow",
        "swapped": "exchanged with that of joint `value` (0 shoulder, 1 arm, 2 wrist)",
    },
    "supply": {
        "off": "nothing comes from upstream",
        "stuck": "the soft-start valve stays open (`value` 1) or shut (0)",
        "scale": "regulates to `value` times its pressure",
        "drifting": "its pressure changes by `value` Pa/s",
        "delayed": "the soft-start valve responds `value` s late",
        "intermittent": "shut in the share `value` of ticks",
    },
    "vents": {
        "off": "de-energised: they open after their delay",
        "stuck": "stay shut (`value` 1) or open (0)",
    },
    "vent": {"stuck": "this one of the two stays shut (`value` 1) or open (0)"},
    "shut-off": {"stuck": "stays open (`value` 1), or shut with the manifold exhausted (0)"},
    "relief": {
        "stuck": "stays shut (`value` 1) or fully open (0)",
        "offset": "opens `value` Pa too high",
        "leaking": "leaks the fraction `value` of the fully open flow",
    },
    "exhaust": {"scale": "passes the share `value` of its area, as with a clogged silencer or a kinked hose"},
    "safety relay": {"stuck": "its contacts stay closed (`value` 1) or open (0)"},
    "switch": {
        "off": "reads as de-energised",
        "stuck": "stays as it is, or at `value` (1 or 0)",
        "garbage": "on or off at random",
        "delayed": "`value` s late",
        "intermittent": "off in the share `value` of ticks",
        "swapped": "exchanged with number `value` of SWITCHES",
    },
    "tee": {"off": "no ball rises"},
    "pressure": {
        "off": "no reading",
        "stuck": "stays where it is",
        "garbage": "a random value up to twice the supply pressure",
        "offset": "`value` Pa too much",
        "scale": "`value` times the truth",
        "slow": "follows with a time constant of `value` s",
        "delayed": "`value` s late",
        "intermittent": "no reading in the fraction `value` of ticks",
        "drifting": "`value` Pa/s away from the truth",
    },
    "spool feedback": {
        "off": "no reading",
        "stuck": "stays at `value`, or where it is",
        "offset": "`value` too much, as a fraction of full stroke",
    },
    "club head": {"off": "comes off"},
    "link": {
        "off": "nothing passes",
        "stuck": "inputs freeze with their time stamps, outputs pass",
        "delayed": "everything passes `value` s late",
        "intermittent": "nothing passes in the share `value` of ticks",
    },
    "clock": {
        "off": "gives NaN",
        "stuck": "stands still",
        "offset": "jumps by `value` s",
        "scale": "runs `value` times as fast",
        "garbage": "jumps by up to 20 ms either way in each tick",
    },
    "loop": {
        "off": "stops for good",
        "delayed": "stalls for `value` s",
        "intermittent": "misses the share `value` of ticks",
    },
    "process": {"off": "is gone"},
    "launch monitor": {
        "off": "reports nothing",
        "stuck": "repeats the last shot",
        "garbage": "reports random figures",
        "offset": "speeds `value` m/s too high",
        "scale": "speeds `value` times the truth",
        "delayed": "reports `value` s late",
        "intermittent": "misses the share `value` of shots",
    },
}
"""Meaning of each kind, by sort of signal; a missing pair is invalid."""


def sort_of(signal: str) -> str:
    """Return the sort of `signal`, a key of MEANINGS."""
    return _SORTS.get(signal, signal)


MAX_DELAY = 63
"""Maximum delay in ticks."""
_STUCK_AT_AN_END = frozenset({"supply", "vents", "vent", "shut-off", "relief", "safety relay"})
_NEEDS_VALUE = frozenset(
    {"offset", "scale", "slow", "delayed", "intermittent", "drifting", "leaking", "swapped"}
)


@dataclass(frozen=True)
class Fault:
    """One fault. Its onset: `after` s after all given conditions are met."""

    name: str
    signal: str
    """One of SIGNALS."""
    kind: Kind
    value: float = field(default=nan, metadata={"optional": True})
    """Value as described in `MEANINGS`; NaN for the present value."""
    time: Annotated[float, Range(0.0, 1e6, "s")] = field(default=0.0, metadata={"optional": True})
    """Earliest onset since the plant's start, s."""
    phase: str = field(default="any", metadata={"optional": True})
    """Phase of the onset, one of PHASES; only in lock-step or paced time."""
    joint: Literal["none", "shoulder", "arm", "wrist"] = field(default="none", metadata={"optional": True})
    angle: Annotated[float, Range(-7.0, 7.0, "rad")] = field(default=0.0, metadata={"optional": True})
    """Angle that `joint` must pass in either direction, rad."""
    after: Annotated[float, Range(0.0, 1e6, "s")] = field(default=0.0, metadata={"optional": True})
    duration: Annotated[float, Range(0.0, 1e6, "s")] = field(default=0.0, metadata={"optional": True})
    """Duration of the fault, s; 0 is unlimited."""

    def __post_init__(self) -> None:
        """Raise ValueError if signal, phase, kind or value is invalid."""
        if self.signal not in SIGNALS:
            raise ValueError(f"signal: one of {', '.join(SIGNALS)}")
        kinds = MEANINGS[sort_of(self.signal)]
        if self.kind not in kinds:
            raise ValueError(f"kind: of {self.signal} one of {', '.join(kinds)}")
        if self.phase not in ("any", *PHASES):
            raise ValueError(f"phase: any, or one of {', '.join(PHASES)}")
        if self.kind in _NEEDS_VALUE and not isfinite(self.value):
            raise ValueError(f"value: a number, as {self.signal} {kinds[self.kind]}")
        others = SWITCHES if sort_of(self.signal) == "switch" else JOINTS
        if self.kind == "swapped" and self.value not in range(len(others)):
            raise ValueError(f"value: 0 to {len(others) - 1}, for {', '.join(others)}")
        if self.kind == "intermittent" and not 0.0 <= self.value <= 1.0:
            raise ValueError("value: a share, 0 to 1")
        if self.kind in ("slow", "delayed") and not self.value >= 0.0:
            raise ValueError("value: at least 0 s")
        if sort_of(self.signal) == "exhaust" and not 0.0 <= self.value <= 1.0:
            raise ValueError("value: a share, 0 to 1")
        if sort_of(self.signal) in _STUCK_AT_AN_END and self.kind == "stuck" and isnan(self.value):
            raise ValueError("value: 1 or 0")

    @property
    def meaning(self) -> str:
        """Effect on the signal as text."""
        return MEANINGS[sort_of(self.signal)][self.kind]


FAULT = np.dtype(
    [
        *fields("i8", "signal kind"),
        *fields("f8", "value time"),
        *fields("i8", "phase joint"),
        *fields("f8", "angle after duration"),
    ],
    align=True,
)

FAULT_MEMORY = np.dtype(
    [
        ("side", "i8"),
        ("met", "?"),
        ("met_since", "f8"),
        *fields("?", "active started over"),
        ("since", "f8"),
        ("begun", "?"),
        *fields("f8", "held filtered"),
        ("unwrapped", "i8"),
        ("ring", "f8", (MAX_DELAY + 1,)),
        *fields("i8", "ring_index filled"),
        ("random", "u8"),
    ],
    align=True,
)
"""State of a fault: the side of its angle on which the joint was, since when its conditions are met and it
acts; whether it has seen the signal (`begun`), the signal then, filtered, unwrapped and its last values;
its stream of random numbers."""

DEVICE = np.dtype(
    [
        *fields("f8", "elapsed watchdog silence deafness"),
        *fields("?", "passive commanded link_up inputs_up loop_up"),
        *fields("i8", "delay index filled"),
    ],
    align=True,
)
"""State of valve electronics and link: time since the start (s); watchdog time (s), silence so far, time
without inputs (s); whether it went passive, whether a command has been received; whether link, inputs and
loop are up in this tick; the link's delay (ticks) and the newest of its `late` records."""

_OFF, _STUCK, _GARBAGE, _OFFSET, _SCALE, _SLOW, _DELAYED, _INTERMITTENT, _DRIFTING, _LEAKING, _SWAPPED = (
    range(11)
)
_VALVE = 3
_SUPPLY, _VENTS, _E_STOP, _GUARD_CLOSED, _GUARD_LOCKED, _LOCAL_RESET, _BALL, _TEE, _SUPPLY_SENSOR = range(
    6, 15
)
_CHAMBER = 15
_HEAD, _LINK, _CLOCK, _LOOP = 21, 22, 23, 24
SUPERVISOR, RECORDER, LEASE = 25, 26, 27
"""Numbers of the signals whose faults the bench applies."""
_VENT, _VENT_FEEDBACK, _SHUT_OFF, _SHUT_OFF_FEEDBACK, _RELIEF = 29, 31, 33, 34, 35
_RELAY = _RELIEF + RELIEFS
_EXHAUST = _RELAY + 1
_SPOOL = _EXHAUST + EXHAUSTS + 4

_INTERLOCKS_LOST = 0.06
"""Time without inputs after which switches read as de-energised, s: three messages of the valve node."""
_CLOCK_JUMP = 0.02


class Faults(NamedTuple):
    """Faults of one plant with their state, as records changed in place."""

    faults: Any
    memory: Any
    device: Any
    healthy_robot: Any
    healthy_plant: Any
    sensed: Any
    received: Any
    """COMMAND that the device obeys."""
    sent: Any
    """COMMAND that reaches the plant, with the faults of its parts."""
    late_readings: Any
    late_commands: Any


def new_faults(faults: tuple[Fault, ...], plant: Plant, *, watchdog: float = 0.02, seed: int = 1) -> Faults:
    """Return `faults` of `plant` at its start; `watchdog` is the device's watchdog time (s).

    Faults of parts change the plant's records of robot and parameters: pass a plant with its own records.

    Raises:
        ValueError: a delay is longer than MAX_DELAY.
    """
    made, memory = new_record(FAULT, len(faults)), new_record(FAULT_MEMORY, len(faults))
    for k, fault in enumerate(faults):
        if fault.kind == "delayed" and fault.signal != "loop":
            longest = MAX_DELAY * plant.parameters.tick
            if fault.value > longest:
                raise ValueError(f"{fault.name}: found a delay of {fault.value:g} s, at most {longest:g} s")
        made[k] = (
            SIGNALS.index(fault.signal),
            KINDS.index(fault.kind),
            fault.value,
            fault.time,
            PHASES.index(fault.phase) if fault.phase != "any" else -1,
            JOINTS.index(fault.joint) if fault.joint != "none" else -1,
            fault.angle,
            fault.after,
            fault.duration or np.inf,
        )
        drawn = np.random.SeedSequence([seed, k]).generate_state(1, np.uint64)
        memory["random"][k] = drawn[0] | np.uint64(1)
    device = new_record(DEVICE)
    device["watchdog"], device["elapsed"] = watchdog, -plant.parameters.tick
    device["link_up"] = device["inputs_up"] = device["loop_up"] = True
    received = new_record(COMMAND)
    received["guard_lock"] = True
    late = MAX_DELAY + 1
    return Faults(
        made,
        memory,
        device,
        plant.robot.copy(),
        plant.plant.copy(),
        new_record(READINGS),
        received,
        received.copy(),
        new_record(READINGS, late),
        new_record(COMMAND, late),
    )


def own_records(plant: Plant) -> Plant:
    """Return `plant` with its own copies of the records, for faults of parts."""
    return Plant(plant.parameters, plant.robot.copy(), plant.plant.copy(), plant.impact.copy())


def turn_regulator(plant: Plant, faults: Faults | None, pressure: float) -> None:
    """Turn the regulator of `plant` to `pressure`, Pa absolute, at most its parameters'; 0: back to that.

    Any other number is ignored. A fault of the supply refers to the pressure of the fault-free regulator.
    """
    full = plant.parameters.supply.pressure
    if not pressure >= 0.0:
        return
    regulated = min(pressure, full) if pressure > 0.0 else full
    plant.plant["regulated"] = regulated
    if faults is not None:
        faults.healthy_plant["regulated"] = regulated


@compiled
def notice_onsets(faults: Faults, plant: Any, state: Any, phase: int) -> None:
    """Begin a tick: determine the active faults from the bench's `phase` (-1: unknown) and PLANT_STATE."""
    d, s = faults.device[0], state[0]
    d.elapsed += plant[0].tick
    now = d.elapsed + 1e-9
    d.link_up = d.inputs_up = d.loop_up = True
    d.delay = 0
    for k in range(len(faults.faults)):
        f, m = faults.faults[k], faults.memory[k]
        passed = f.joint < 0
        if f.joint >= 0:
            side = 1 if s.angle[f.joint] >= f.angle else -1
            passed = m.side not in (0, side)
            m.side = side
        if not m.met and now >= f.time and (f.phase < 0 or f.phase == phase) and passed:
            m.met, m.met_since = True, now
        m.active = m.met and not m.over and now >= m.met_since + f.after
        if m.active and not m.started:
            m.started, m.since = True, now
        if m.active and now >= m.since + f.duration:
            m.active, m.over = False, True
        if f.signal == _LINK and m.active:
            if f.kind == _OFF or (f.kind == _INTERMITTENT and uniform(m) < f.value):
                d.link_up = d.inputs_up = False
            elif f.kind == _STUCK:
                d.inputs_up = False
            elif f.kind == _DELAYED:
                d.delay = int(f.value / plant[0].tick + 0.5)
        elif f.signal == _LOOP and m.active:
            if f.kind == _OFF or (f.kind == _DELAYED and now < m.since + f.value):
                d.loop_up = False
            elif f.kind == _INTERMITTENT and uniform(m) < f.value:
                d.loop_up = False


@compiled
def is_broken(faults: Faults, signal: int) -> int:
    """Return 1 if a fault of `signal` is active, 0 if inactive, -1 if there is none."""
    found = -1
    for k in range(len(faults.faults)):
        if faults.faults[k].signal == signal:
            found = max(found, 1 if faults.memory[k].active else 0)
    return found


@compiled
def _wrong(
    f: Any, m: Any, true: float, low: float, high: float, about_onset: bool, now: float, tick: float
) -> float:
    """Return the faulty value of the analogue value `true`; call in each tick, as the history matters.

    Garbage lies between `low` and `high`. A scale refers to the value at the onset, or to zero.
    """
    m.ring_index = (m.ring_index + 1) % (MAX_DELAY + 1)
    m.ring[m.ring_index] = true
    m.filled = min(m.filled + 1, MAX_DELAY + 1)
    if not m.active:
        return true
    if not m.begun:
        m.begun, m.held, m.filtered = True, true, true
    wrong = true
    if f.kind == _STUCK:
        wrong = m.held if np.isnan(f.value) else f.value
    elif f.kind == _GARBAGE:
        wrong = low + (high - low) * uniform(m)
    elif f.kind == _OFFSET:
        wrong = true + f.value
    elif f.kind == _SCALE:
        about = m.held if about_onset else 0.0
        wrong = about + f.value * (true - about)
    elif f.kind == _SLOW:
        m.filtered += (true - m.filtered) * tick / (f.value + tick)
        wrong = m.filtered
    elif f.kind == _DELAYED:
        back = min(int(f.value / tick + 0.5), m.filled - 1)
        wrong = m.ring[(m.ring_index - back + MAX_DELAY + 1) % (MAX_DELAY + 1)]
    elif f.kind == _DRIFTING:
        wrong = true + f.value * (now - m.since)
    return wrong


@compiled
def _is_out(f: Any, m: Any) -> bool:
    """Return whether the signal is missing in this tick."""
    return bool(m.active and (f.kind == _OFF or (f.kind == _INTERMITTENT and uniform(m) < f.value)))


@compiled
def _measured(f: Any, m: Any, true: float, low: float, high: float, now: float, tick: float) -> float:
    """Return the faulty reading of a sensor; only a fitted one can fail."""
    wrong = _wrong(f, m, true, low, high, False, now, tick)
    if not np.isfinite(true):
        return true
    return INVALID if _is_out(f, m) else wrong


@compiled
def _switched(f: Any, m: Any, true: bool, now: float, tick: float) -> bool:
    """Return the faulty value of a switch."""
    out = _is_out(f, m)
    wrong = _wrong(f, m, 1.0 if true else 0.0, 0.0, 1.0, False, now, tick)
    return bool(wrong > 0.5 and not out)


@compiled
def _spoil_encoder(f: Any, m: Any, p: Any, out: Any, i: int, now: float) -> None:
    """Apply the fault to encoder `i`."""
    if f.kind == _SWAPPED:
        j = int(f.value)
        if m.active and i != j:
            a, b = out.encoder_count[i], out.encoder_count[j]
            out.encoder_count[i], out.encoder_count[j] = b, a
        return
    span = p.encoder_counts
    if m.filled == 0:
        m.unwrapped = out.encoder_count[i]
    m.unwrapped += (out.encoder_count[i] - m.unwrapped + span // 2) % span - span // 2
    per_radian = span / (2.0 * pi)
    if f.kind in (_OFFSET, _DRIFTING):
        # In rad of the joint, whichever way the encoder counts.
        turned = _wrong(f, m, m.unwrapped / p.encoder_scale[i], 0.0, 0.0, True, now, p.tick)
        count = int(np.floor(turned * p.encoder_scale[i] + 0.5))
    else:
        wrong = _wrong(f, m, float(m.unwrapped), 0.0, float(span), True, now, p.tick)
        count = int(np.floor(wrong + 0.5))
    if m.active:
        out.encoder_count[i] = count % span
    if _is_out(f, m) or per_radian <= 0.0:
        out.encoder_valid[i] = 0


@compiled
def _switch_number(signal: int) -> int:
    """Return the number in SWITCHES of a switch that is not a valve."""
    if signal <= _BALL:
        return signal - _E_STOP
    return 7 if signal == _SHUT_OFF_FEEDBACK else signal - _VENT_FEEDBACK + 5


@compiled_with_arrays
def _exchange_switches(r: Any, a: int, b: int) -> None:
    """Exchange the switches with numbers `a` and `b` of SWITCHES; one that is not fitted reads off."""
    on = np.empty(8, np.bool_)
    on[0], on[1], on[2], on[3] = r.emergency_stop_clear, r.guard_closed, r.guard_locked, r.local_reset
    on[4], on[5], on[6], on[7] = (
        r.ball_present,
        r.vent_open[0] > 0.5,
        r.vent_open[1] > 0.5,
        r.shut_off_open > 0.5,
    )
    on[a], on[b] = on[b], on[a]
    r.emergency_stop_clear, r.guard_closed, r.guard_locked, r.local_reset = on[0], on[1], on[2], on[3]
    r.ball_present = on[4]
    for k in range(2):
        if np.isfinite(r.vent_open[k]):
            r.vent_open[k] = 1.0 if on[5 + k] else 0.0
    if np.isfinite(r.shut_off_open):
        r.shut_off_open = 1.0 if on[7] else 0.0


@compiled
def spoil_readings(faults: Faults, plant: Any, out: Any) -> None:
    """Apply the sensors' faults to the READINGS record `out`."""
    p, now, r = plant[0], faults.device[0].elapsed, out[0]
    for k in range(len(faults.faults)):
        f, m = faults.faults[k], faults.memory[k]
        if f.signal < _VALVE:
            _spoil_encoder(f, m, p, r, f.signal, now)
        elif f.kind == _SWAPPED:
            if m.active and (_E_STOP <= f.signal <= _BALL or f.signal >= _VENT_FEEDBACK):
                _exchange_switches(r, _switch_number(f.signal), int(f.value))
        elif f.signal == _E_STOP:
            r.emergency_stop_clear = _switched(f, m, r.emergency_stop_clear, now, p.tick)
        elif f.signal == _GUARD_CLOSED:
            r.guard_closed = _switched(f, m, r.guard_closed, now, p.tick)
        elif f.signal == _GUARD_LOCKED:
            r.guard_locked = _switched(f, m, r.guard_locked, now, p.tick)
        elif f.signal == _LOCAL_RESET:
            r.local_reset = _switched(f, m, r.local_reset, now, p.tick)
        elif f.signal == _BALL:
            r.ball_present = _switched(f, m, r.ball_present, now, p.tick)
        elif f.signal == _SUPPLY_SENSOR:
            r.supply_pressure = _measured(f, m, r.supply_pressure, 0.0, 2.0 * p.regulated, now, p.tick)
        elif _CHAMBER <= f.signal < _CHAMBER + 6:
            i = f.signal - _CHAMBER
            r.chamber_pressure[i] = _measured(
                f, m, r.chamber_pressure[i], 0.0, 2.0 * p.regulated, now, p.tick
            )
        elif _VENT_FEEDBACK <= f.signal < _VENT_FEEDBACK + 2:
            i = f.signal - _VENT_FEEDBACK
            if np.isfinite(r.vent_open[i]):
                r.vent_open[i] = 1.0 if _switched(f, m, r.vent_open[i] > 0.5, now, p.tick) else 0.0
        elif f.signal == _SHUT_OFF_FEEDBACK and np.isfinite(r.shut_off_open):
            r.shut_off_open = 1.0 if _switched(f, m, r.shut_off_open > 0.5, now, p.tick) else 0.0
        elif f.signal >= _SPOOL:
            i = f.signal - _SPOOL
            r.spool_position[i] = _measured(f, m, r.spool_position[i], -1.0, 1.0, now, p.tick)


@compiled
def deliver_readings(faults: Faults, plant: Any, state: Any, readings: Any) -> None:
    """Sense PLANT_STATE `state`, apply faults, and transmit it over the link into the bench's `readings`.

    Missing inputs keep their last values and time stamps; after a while switches read off.
    """
    d = faults.device[0]
    sense(plant, state, faults.sensed)
    spoil_readings(faults, plant, faults.sensed)
    d.index = (d.index + 1) % (MAX_DELAY + 1)
    d.filled = min(d.filled + 1, MAX_DELAY + 1)
    faults.late_readings[d.index] = faults.sensed[0]
    if d.inputs_up:
        back = min(d.delay, d.filled - 1)
        readings[0] = faults.late_readings[(d.index - back + MAX_DELAY + 1) % (MAX_DELAY + 1)]
        d.deafness = 0.0
    else:
        d.deafness += plant[0].tick
        if d.deafness >= _INTERLOCKS_LOST:
            r = readings[0]
            r.emergency_stop_clear = r.guard_closed = r.guard_locked = r.local_reset = r.ball_present = False


@compiled
def faulty_time(faults: Faults, time: float) -> float:
    """Return the faulty clock reading at `time` (s)."""
    reading = time
    for k in range(len(faults.faults)):
        f, m = faults.faults[k], faults.memory[k]
        if f.signal == _CLOCK and m.active:
            wrong = _wrong(f, m, time, time - _CLOCK_JUMP, time + _CLOCK_JUMP, True, time, 1e-3)
            reading = np.nan if f.kind == _OFF else wrong
    return reading


@compiled
def deliver_command(faults: Faults, plant: Any, command: Any, spoken: bool) -> None:
    """Transmit the bench's `command` (COMMAND; `spoken`: sent in this tick) to the device, into `sent`.

    Without a command for the watchdog time the device goes passive and stays so until `revive`.
    """
    d, sent, p = faults.device[0], faults.sent[0], plant[0]
    arrives = spoken and d.link_up
    faults.late_commands[d.index] = command[0]
    if d.passive:
        rest_command(faults.received)
    elif arrives:
        d.commanded, d.silence = True, 0.0
        back = min(d.delay, max(d.filled - 1, 0))
        faults.received[0] = faults.late_commands[(d.index - back + MAX_DELAY + 1) % (MAX_DELAY + 1)]
    elif d.commanded:
        d.silence += p.tick
        if d.silence >= d.watchdog - 1e-9:
            d.passive = True
            rest_command(faults.received)
    faults.sent[0] = faults.received[0]
    for k in range(len(faults.faults)):
        f, m = faults.faults[k], faults.memory[k]
        if _VALVE <= f.signal < _SUPPLY:
            i = f.signal - _VALVE
            if f.kind == _SWAPPED:
                j = int(f.value)
                if m.active and i != j:
                    a, b = sent.valve[i], sent.valve[j]
                    sent.valve[i], sent.valve[j] = b, a
                continue
            wrong = _wrong(f, m, sent.valve[i], -1.0, 1.0, False, d.elapsed, p.tick)
            sent.valve[i] = 0.0 if _is_out(f, m) else min(max(wrong, -1.0), 1.0)
        elif f.signal == _SUPPLY and f.kind not in (_OFF, _SCALE, _DRIFTING):
            sent.supply_enable = _switched(f, m, sent.supply_enable, d.elapsed, p.tick)
        elif f.signal == _VENTS:
            sent.exhaust_closed = _switched(f, m, sent.exhaust_closed, d.elapsed, p.tick)
        elif f.signal == _TEE:
            sent.tee = sent.tee and not m.active


@compiled
def revive(faults: Faults) -> None:
    """Reactivate a device that went passive by its watchdog, as a reset of the bench does."""
    d = faults.device[0]
    d.passive, d.commanded, d.silence = False, False, 0.0


@compiled
def break_parts(faults: Faults, robot: Any, plant: Any, state: Any) -> None:
    """Apply the faults of parts to the plant's records (in place)."""
    r, p, s, h = robot[0], plant[0], state[0], faults.healthy_plant[0]
    for i in range(EXHAUSTS):
        p.exhaust[i] = h.exhaust[i]
    for k in range(len(faults.faults)):
        f, m = faults.faults[k], faults.memory[k]
        if _RELIEF <= f.signal < _RELIEF + RELIEFS:
            _break_relief(p, h, f.signal - _RELIEF, f, m.active)
        elif f.signal == _RELAY:
            p.relay_stuck = 0 if not m.active else SHUT if f.value > 0.5 else OPEN
        elif _EXHAUST <= f.signal < _SPOOL:
            _throttle(p, f.signal - _EXHAUST, f.value if m.active else 1.0)
        elif f.kind == _LEAKING:
            i = f.signal - _VALVE
            p.leakage[i] = f.value if m.active else h.leakage[i]
        elif _VENT <= f.signal < _VENT + 2:
            p.vent_stuck[f.signal - _VENT] = 0 if not m.active else SHUT if f.value > 0.5 else OPEN
        elif f.signal == _SHUT_OFF:
            p.shut_off_stuck = 0 if not m.active else OPEN if f.value > 0.5 else SHUT
        elif f.signal == _SUPPLY and f.kind == _OFF:
            p.regulated = h.atmosphere if m.active else h.regulated
        elif f.signal == _SUPPLY and f.kind == _SCALE:
            p.regulated = f.value * h.regulated if m.active else h.regulated
        elif f.signal == _SUPPLY and f.kind == _DRIFTING:
            change = f.value * (faults.device[0].elapsed - m.since) if m.active else 0.0
            p.regulated = max(h.regulated + change, h.atmosphere)
        elif f.signal == _HEAD and m.active and not m.begun:
            m.begun = True
            _take_head(r, p, faults.healthy_robot[0])
        if f.signal == _HEAD and m.active:
            s.ball_present = False  # no head is left to meet it


@compiled
def _break_relief(p: Any, h: Any, k: int, f: Any, active: bool) -> None:
    """Apply the fault of relief valve `k` to the plant's parameters `p`; `h` are the healthy ones."""
    pressure, conductance, leakage = h.relief_pressure[k], h.relief_conductance[k], h.relief_leakage[k]
    if active and f.kind == _OFFSET:
        pressure += f.value
    elif active and f.kind == _LEAKING:
        leakage = f.value * conductance
    elif active and f.value > 0.5:
        conductance = 0.0
    elif active:
        pressure = 0.0
    p.relief_pressure[k], p.relief_conductance[k], p.relief_leakage[k] = pressure, conductance, leakage


@compiled
def _throttle(p: Any, k: int, share: float) -> None:
    """Multiply the area of exhaust `k` by `share`: a chamber's, the manifold's, both of a joint, or all."""
    for i in range(EXHAUSTS):
        joint = k - EXHAUSTS  # 3: all
        if i == k or joint == 3 or (joint >= 0 and i // 2 == joint):
            p.exhaust[i] *= share


@compiled
def _take_head(r: Any, p: Any, h: Any) -> None:
    """Remove the head's point mass from the club (body C), or from the end of the flexible shaft."""
    if p.flexible:
        p.head_mass, p.head_stiffness, p.head_damping = 1e-6, 1e-6 * p.head_stiffness / p.head_mass, 0.0
        return
    mass = h.mass_c - p.head_mass
    centre = (h.mass_c * h.com_c - p.head_mass * p.head_distance) / mass
    # Steiner, to the wrist and from it.
    about_wrist = h.inertia_c + h.mass_c * h.com_c * h.com_c - p.head_mass * p.head_distance * p.head_distance
    r.mass_c, r.com_c, r.inertia_c = mass, centre, about_wrist - mass * centre * centre
