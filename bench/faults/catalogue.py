"""The breakages of `catalogue.toml`, their instants, and the rules by which one cannot matter in a phase."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from math import nan
from pathlib import Path
from typing import Any, Literal, cast, get_args

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


_TABLES: dict[str, Any] = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
_PARTS: dict[str, Sequence[tuple[object, ...]]] = {
    "": [()],
    "joint": [(joint,) for joint in JOINTS],
    "chamber": [(chamber, JOINTS[k // 2]) for k, chamber in enumerate(CHAMBERS)],
    "sensor": [("supply", ""), *((chamber, "stop") for chamber in CHAMBERS)],
    "exhaust": [(part,) for part in (*CHAMBERS, "manifold", *JOINTS)],
    "switch": [
        ("emergency stop", "emergency stop"),
        ("guard closed", "guard opened"),
        ("guard locked", "guard opened"),
    ],
    "pair": [("shoulder", "arm", 1), ("shoulder", "wrist", 2), ("arm", "wrist", 2)],
}
"""Texts of an entry of the catalogue by its `each`."""


_SWING = ("backswing", "downswing", "follow_through")
"""Phases of the first swing in which the second fault of a latent pair comes."""


def _fault(part: tuple[object, ...], signal: str, kind: Kind, value: Any = "", words: str = "") -> Fault:
    """Return the fault of a row of the catalogue for `part`."""
    signal = signal.format(*part)
    number = float(str(value).format(*part)) if value != "" else nan
    return Fault(f"{signal} {words or kind}", signal, kind, number)


def _breakages(table: str, family: Family = "one fault") -> Iterator[Breakage]:
    """Yield the rows of a `table` of the catalogue, in its order."""
    for entry in _TABLES[table]:
        if isinstance(entry, str):
            yield from _breakages(entry, family)
            continue
        for part, row in product(_PARTS[entry.get("each", "")], entry["rows"]):
            event = cast("Event", (row[3:] or [entry.get("event", "")])[0].format(*part))
            first = _fault(part, *entry["first"]) if "first" in entry else None
            fault = _fault(part, entry["signal"], *row[:3])
            name = entry.get("name", fault.name).format(*part)
            fault = replace(fault, name=name, duration=entry.get("duration", 0.0))
            if not entry.get("swing"):
                yield Breakage(fault, event, family, first)
                continue
            for phase in _SWING:
                later = f"{name} in the {phase.replace('_', '-')}"
                yield Breakage(replace(fault, name=later, phase=phase, after=0.05), event, family, first)


CATALOGUE: tuple[Breakage, ...] = (
    *_breakages("single"),
    *(replace(one, event=event) for one in _breakages("during_a_stop", "during a stop") for event in _DURING),
    *_breakages("from_the_start", "from the start"),
    *_breakages("latent_pairs", "latent pair"),
    *(replace(one, event="") for one in _breakages("around_access", "access")),
)
"""All rows of the matrix."""


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


HARDWARE: dict[str, str] = _TABLES["hardware"]
"""Protection that only hardware can give, by signal or sort."""
