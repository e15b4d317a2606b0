"""The breakages of the matrix, their instants, and the rules by which one cannot matter in a phase."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import nan
from typing import Literal, get_args

from bench.base.lifecycle import Phase
from bench.swing.profile import PHASES, Profile
from drivers.base import CHAMBERS, JOINTS
from sim.faults import Fault, Kind, sort_of

Event = Literal["", "stop", "guard opened", "emergency stop", "no ball"]
"""Event added to the fault: a stop that needs the part, or the event that a stuck switch should report."""

EVENT_AFTER = 0.05
"""Lead time of a fault before the combined event (s)."""

Family = Literal["one fault", "during a stop", "from the start", "latent pair", "access"]
"""When the faults come: alone at any instant; while a stop is under way; before the bench is switched on; one
that shows nothing before the one that it should have shown; around the released guard."""
FAMILIES: tuple[Family, ...] = get_args(Family)


@dataclass(frozen=True)
class Breakage:
    """One row of the matrix: a fault, or two of which the first hides the second, and an event."""

    fault: Fault
    event: Event = ""
    family: Family = "one fault"
    hidden_by: Fault | None = None

    @property
    def name(self) -> str:
        """Signal, kind, value, event and the other fault."""
        if self.family == "during a stop":
            return f"{self.fault.name}, during {_DURING[self.event]}"
        if self.family == "from the start":
            return f"{self.fault.name}, from the start"
        if self.family == "access":
            return f"{self.fault.name}, around access"
        first = f"{self.hidden_by.name}, then " if self.hidden_by is not None else ""
        return first + self.fault.name + (f", then {self.event}" if self.event else "")

    @property
    def event_after(self) -> float:
        """Time from the instant of the case to the event, s."""
        return 0.0 if self.family == "during a stop" else EVENT_AFTER

    @property
    def faults(self) -> tuple[Fault, ...]:
        """The faults in the order in which they come."""
        return (self.fault,) if self.hidden_by is None else (self.hidden_by, self.fault)


_DURING: dict[Event, str] = {
    "stop": "an operator's stop",
    "emergency stop": "an emergency stop",
    "guard opened": "a stop by the guard",
}


def new_fault(signal: str, kind: Kind, value: float = nan, text: str = "") -> Fault:
    """Return a fault; its name is `text`, or signal and kind."""
    return Fault(text or f"{signal} {kind}", signal, kind, value)


def _broken(signal: str, kind: Kind, value: float = nan, text: str = "", event: Event = "") -> Breakage:
    return Breakage(new_fault(signal, kind, value, text), event)


def _encoder(joint: str) -> tuple[Breakage, ...]:
    signal = f"{joint} encoder"
    return (
        _broken(signal, "off"),
        _broken(signal, "stuck"),
        _broken(signal, "garbage"),
        _broken(signal, "offset", 0.01, f"{signal} +0.01 rad"),
        _broken(signal, "offset", 0.1, f"{signal} +0.1 rad"),
        _broken(signal, "scale", 0.9, f"{signal} × 0.9"),
        _broken(signal, "slow", 0.01, f"{signal} slow 10 ms"),
        _broken(signal, "delayed", 0.003, f"{signal} delayed 3 ms"),
        _broken(signal, "delayed", 0.02, f"{signal} delayed 20 ms"),
        _broken(signal, "intermittent", 0.2, f"{signal} intermittent 20 %"),
        _broken(signal, "drifting", 0.1, f"{signal} drifting 0.1 rad/s"),
        _broken(signal, "drifting", 1.0, f"{signal} drifting 1 rad/s"),
    )


def _valve(joint: str) -> tuple[Breakage, ...]:
    signal = f"{joint} valve"
    return (
        _broken(signal, "off", text=f"{signal} without energy"),
        _broken(signal, "stuck", 1.0, f"{signal} stuck open"),
        _broken(signal, "stuck", -1.0, f"{signal} stuck open in reverse"),
        _broken(signal, "stuck", 0.0, f"{signal} stuck shut"),
        _broken(signal, "stuck", text=f"{signal} stuck where it stands"),
        _broken(signal, "garbage"),
        _broken(signal, "offset", 0.1, f"{signal} +10 %"),
        _broken(signal, "scale", 0.5, f"{signal} half as far"),
        _broken(signal, "slow", 0.02, f"{signal} slow 20 ms"),
        _broken(signal, "delayed", 0.01, f"{signal} delayed 10 ms"),
        _broken(signal, "intermittent", 0.3, f"{signal} intermittent 30 %"),
        _broken(signal, "drifting", 0.2, f"{signal} drifting 20 %/s"),
        _broken(signal, "leaking", 0.05, f"{signal} leaking 5 %"),
    )


def _vent(signal: str) -> tuple[Breakage, ...]:
    return (
        _broken(signal, "stuck", 1.0, f"{signal} stuck shut", "stop"),
        _broken(signal, "stuck", 0.0, f"{signal} stuck open"),
        _broken(f"{signal} feedback", "stuck", event="stop"),
        _broken(f"{signal} feedback", "off"),
    )


def _relief(valve: str) -> tuple[Breakage, ...]:
    return (
        _broken(f"{valve} relief", "stuck", 0.0, f"{valve} relief stuck open"),
        _broken(f"{valve} relief", "leaking", 0.05, f"{valve} relief leaking 5 %"),
    )


def _switch(signal: str, event: Event) -> tuple[Breakage, ...]:
    return (
        _broken(signal, "off"),
        _broken(signal, "stuck", event=event),
        _broken(signal, "garbage"),
        _broken(signal, "delayed", 0.02, f"{signal} delayed 20 ms", event),
        _broken(signal, "intermittent", 0.05, f"{signal} intermittent 5 %"),
    )


def _pressure(signal: str, event: Event) -> tuple[Breakage, ...]:
    return (
        _broken(signal, "off", event=event),
        _broken(signal, "stuck", event=event),
        _broken(signal, "stuck", 1.0e5, f"{signal} stuck at 1 bar", event),
        _broken(signal, "garbage", event=event),
        _broken(signal, "offset", -2.0e5, f"{signal} -2 bar", event),
        _broken(signal, "scale", 0.7, f"{signal} × 0.7", event),
        _broken(signal, "slow", 0.5, f"{signal} slow 0.5 s", event),
        _broken(signal, "delayed", 0.05, f"{signal} delayed 50 ms", event),
        _broken(signal, "intermittent", 0.3, f"{signal} intermittent 30 %", event),
        _broken(signal, "drifting", -2.0e5, f"{signal} drifting -2 bar/s", event),
    )


THROTTLED: tuple[Fault, ...] = tuple(
    Fault(f"{signal} at {100 * share:g} %", signal, "scale", share)
    for signal, shares in {
        **{f"{part} exhaust": (0.1, 0.0) for part in (*CHAMBERS, "manifold", *JOINTS)},
        "exhausts": (0.3, 0.1, 0.03, 0.01, 0.003, 0.0),
    }.items()
    for share in shares
)
"""Clogged silencers and kinked hoses, of one exhaust and of all: the vents report open."""

SINGLE: tuple[Breakage, ...] = (
    *(breakage for joint in JOINTS for breakage in _encoder(joint)),
    *(breakage for joint in JOINTS for breakage in _valve(joint)),
    _broken("supply", "off", text="supply lost"),
    _broken("supply", "scale", 0.7, "supply sagging to 70 %"),
    _broken("supply", "scale", 1.4, "supply surging to 140 %"),
    _broken("supply", "drifting", -2.0e5, "supply sagging 2 bar/s"),
    _broken("supply", "stuck", 1.0, "supply valve stuck open", "stop"),
    _broken("supply", "stuck", 0.0, "supply valve stuck shut"),
    _broken("supply", "intermittent", 0.3, "supply valve intermittent 30 %"),
    _broken("vents", "stuck", 1.0, "vents stuck shut", "stop"),
    _broken("vents", "off", text="vents without energy"),
    *_vent("vent 1"),
    *_vent("vent 2"),
    _broken("shut-off", "stuck", 1.0, "shut-off valve stuck open", "stop"),
    _broken("shut-off", "stuck", 0.0, "shut-off valve stuck shut"),
    _broken("shut-off feedback", "stuck", event="stop"),
    _broken("shut-off feedback", "off"),
    *(Breakage(throttled, "stop") for throttled in THROTTLED),
    *(breakage for valve in (*CHAMBERS, "manifold") for breakage in _relief(valve)),
    _broken("safety relay", "stuck", 0.0, "safety relay fallen open"),
    _broken("safety relay", "stuck", 1.0, "safety relay welded shut", "emergency stop"),
    _broken("safety relay", "stuck", 1.0, "safety relay welded shut", "guard opened"),
    *_switch("emergency stop", "emergency stop"),
    *_switch("guard closed", "guard opened"),
    *_switch("guard locked", "guard opened"),
    _broken("local reset", "stuck", 1.0, "local reset stuck pressed"),
    _broken("local reset", "garbage"),
    _broken("ball sensor", "off"),
    _broken("ball sensor", "stuck", 1.0, "ball sensor stuck on", "no ball"),
    _broken("tee", "off", text="no ball on the tee", event="no ball"),
    *_pressure("supply sensor", ""),
    *(breakage for chamber in CHAMBERS for breakage in _pressure(f"{chamber} sensor", "stop")),
    _broken("shoulder encoder", "swapped", 2.0, "shoulder and wrist encoders swapped"),
    _broken("shoulder valve", "swapped", 1.0, "shoulder and arm valves swapped"),
    _broken("club head", "off", text="club head lost"),
    _broken("link", "off", text="link cut"),
    Breakage(Fault("link cut for 3 ms", "link", "off", duration=0.003)),
    Breakage(Fault("link cut for 100 ms", "link", "off", duration=0.1)),
    _broken("link", "stuck", text="link: inputs stand still"),
    _broken("link", "delayed", 0.003, "link delayed 3 ms"),
    _broken("link", "delayed", 0.01, "link delayed 10 ms"),
    _broken("link", "intermittent", 0.2, "link intermittent 20 %"),
    _broken("clock", "off", text="clock gives no number"),
    Breakage(Fault("clock gives no number for a tick", "clock", "off", duration=0.001)),
    _broken("clock", "stuck", text="clock stands still"),
    _broken("clock", "offset", 0.5, "clock jumps 0.5 s ahead"),
    _broken("clock", "offset", -0.5, "clock jumps 0.5 s back"),
    _broken("clock", "scale", 1.05, "clock 5 % fast"),
    _broken("clock", "scale", 0.95, "clock 5 % slow"),
    _broken("clock", "garbage"),
    _broken("loop", "off", text="loop dead"),
    _broken("loop", "delayed", 0.008, "loop stalls 8 ms"),
    _broken("loop", "delayed", 0.05, "loop stalls 50 ms"),
    _broken("loop", "intermittent", 0.2, "loop misses 20 % of its ticks"),
    _broken("supervisor", "off", text="supervisor dead"),
    _broken("recorder", "off", text="recorder dead"),
    _broken("lease", "off", text="lease lost"),
    _broken("launch monitor", "off"),
    _broken("launch monitor", "stuck"),
    _broken("launch monitor", "garbage"),
    _broken("launch monitor", "offset", 5.0),
    _broken("launch monitor", "scale", 1.1),
    _broken("launch monitor", "delayed", 20.0),
    _broken("launch monitor", "intermittent", 0.3),
)
"""Faults that come alone."""

MOVING: frozenset[str] = frozenset(
    {"homing", "backswing", "top", "downswing", "committed", "impact", "follow-through", "return"}
)


def irrelevant(breakage: Breakage, phase: str, *, model_check: bool) -> str:
    """Return the rule by which `breakage` cannot matter in `phase`; empty if it can."""
    signal, sort = breakage.fault.signal, sort_of(breakage.fault.signal)
    if breakage.family != "one fault":
        return ""
    if sort == "launch monitor":
        return "the loop does not read the launch monitor; its data are judged after the swing"
    if signal == "local reset":
        return "the button is read during a reset only, and a reset needs an edge, not a level"
    if signal == "ball sensor" and not breakage.event:
        return "the loop makes no decision from the ball sensor"
    if breakage.event == "no ball" and phase != "hold":
        return "the ball is present or absent from the start of the swing"
    if signal == "vents" and phase == "standing":
        return "the vents are open and the supply is shut while the robot stands"
    if sort == "exhaust" and phase == "standing":
        return "there is no air to let out while the robot stands"
    if signal == "supply" and breakage.event == "stop" and phase == "standing":
        return "there is nothing to stop while the robot stands"
    if sort == "pressure" and signal != "supply sensor" and phase == "standing":
        return "the chambers are empty; later effects of the sensor are tried from the other phases"
    if signal == "supply sensor" and phase in ("homing", "committed", "impact", "follow-through"):
        return "" if model_check else "the supply pressure is not checked in this phase"
    return ""


@dataclass(frozen=True)
class Instant:
    """Instant of a fault: a phase, and ticks from the start of the swing (or of homing)."""

    phase: str
    tick: int
    label: str = ""
    delay: float = 0.0
    """Time from the stop, which comes at the instant, to the fault, s."""

    @property
    def name(self) -> str:
        """Phase, label and delay."""
        later = f" +{1e3 * self.delay:.0f} ms" if self.delay else ""
        return f"{self.phase} {self.label}".strip() + later


INTO_A_STOP = (0.01, 0.03, 0.06, 0.1, 0.2)
"""Time from a stop to a fault during it, s."""
_DENSE = 12
"""Ticks between the dense instants."""

START = (Instant("start", 0, "absolute"), Instant("start", 0, "index"))
"""The bench is switched on with the fault, and homes by either method."""
ACCESS = (Instant("access", 0, "before"), Instant("access", 0, "inside"))
"""The fault comes while the robot is armed, before it vents for access; or when the guard is released."""


def phase_name(phase: Phase) -> str:
    """Return the name of `phase` in fault matrices."""
    return phase.name.lower().replace("_", "-")


def _spans(profile: Profile) -> dict[Phase, tuple[int, int]]:
    ends = (*profile.begins[1:], len(profile.angle))
    return dict(zip(PHASES, zip(profile.begins, ends, strict=True), strict=True))


def dense_instants(profile: Profile) -> tuple[Instant, ...]:
    """Return instants 12 ms apart from downswing to follow-through, where stops are hit."""
    return tuple(
        Instant(phase_name(phase), tick, f"at {tick} ms")
        for phase, (begin, end) in _spans(profile).items()
        if Phase.DOWNSWING <= phase <= Phase.FOLLOW_THROUGH
        for tick in range(begin + (-begin) % _DENSE, end, _DENSE)
    )


def stopped_instants(profile: Profile, delays: Sequence[float] = INTO_A_STOP) -> tuple[Instant, ...]:
    """Return the instants of the moving swing, each with all `delays` (s) after its stop begins."""
    return tuple(
        replace(instant, delay=delay)
        for instant in instants_of(profile)
        if instant.phase not in ("standing", "homing", "hold", "return")
        for delay in delays
    )


def instants_of(profile: Profile) -> tuple[Instant, ...]:
    """Return the instants of a fault that comes alone, in order."""
    spans = _spans(profile)
    impact = round(profile.impact_time / profile.period)

    def at(phase: Phase, *shares: float) -> list[Instant]:
        begin, end = spans[phase]
        name = phase_name(phase)
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


HARDWARE: tuple[tuple[str, str], ...] = (
    ("emergency stop", "a hard-wired emergency stop, two channels, that cuts the supply directly"),
    ("guard closed", "guard switches of two channels, wired into the same circuit"),
    ("guard locked", "guard switches of two channels, wired into the same circuit"),
    (
        "supply",
        "the manifold's relief valve; the shut-off valve in series keeps it empty while people are inside",
    ),
    ("shut-off", "the supply valve; the position switch names one that sticks, and access is refused"),
    ("vents", "each vent's coil on a separate output, both through the safety relay; a gauge"),
    ("exhaust", "a gauge next to the guard that a person reads; silencers are changed before they clog"),
    ("relief", "a proof test: one that stays shut shows only when it is needed"),
    ("safety relay", "two relays with forcibly guided contacts, each read back before a reset"),
    ("vent", "the other vent; the position switch names the one that sticks"),
    ("vent 1 feedback", "not needed: a wrong position shows as a vent that does not follow its command"),
    ("vent 2 feedback", "not needed: a wrong position shows as a vent that does not follow its command"),
    ("valve", "absorbers for the whole swing's energy; a valve in series acts only from the detection on"),
    ("encoder", "a second encoder on the joint; absorbers for the whole swing's energy"),
    ("pressure", "a gauge next to the guard that a person reads; the lock's own pressure switch"),
    ("club head", "a fence that stops a head of 0.2 kg at 50 m/s; inspection of the club"),
    ("link", "a watchdog in the valve electronics (20 ms)"),
    ("clock", "the watchdog's own oscillator in the valve electronics"),
    ("loop", "a watchdog in the valve electronics (20 ms)"),
    ("process", "not needed: software stops it"),
    ("tee", "not needed: the follow-through without a ball is within the ratings"),
    ("switch", "not needed"),
    ("launch monitor", "not needed: it moves nothing"),
)
"""Protection that only hardware can give, by signal or sort."""
