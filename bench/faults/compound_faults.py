"""Compound faults: during a stop, from the start, one after another, around access."""

from __future__ import annotations

from dataclasses import replace
from math import pi

from bench.faults.single_faults import SINGLE, THROTTLED, Breakage, Event, new_fault
from drivers.base import CHAMBERS, JOINTS
from sim.faults import Fault

_STOPS: tuple[Event, ...] = ("stop", "emergency stop", "guard opened")


def _valves() -> tuple[Fault, ...]:
    return tuple(
        fault
        for joint in JOINTS
        for fault in (
            new_fault(f"{joint} valve", "off", text=f"{joint} valve without energy"),
            new_fault(f"{joint} valve", "stuck", 1.0, f"{joint} valve stuck open"),
            new_fault(f"{joint} valve", "stuck", -1.0, f"{joint} valve stuck open in reverse"),
            new_fault(f"{joint} valve", "stuck", text=f"{joint} valve stuck where it stands"),
            new_fault(f"{joint} valve", "offset", 0.3, f"{joint} valve +30 %"),
        )
    )


def _encoders() -> tuple[Fault, ...]:
    return tuple(
        fault
        for joint in JOINTS
        for fault in (
            new_fault(f"{joint} encoder", "off"),
            new_fault(f"{joint} encoder", "stuck"),
            new_fault(f"{joint} encoder", "garbage"),
            new_fault(f"{joint} encoder", "offset", 0.1, f"{joint} encoder +0.1 rad"),
        )
    )


_AIR = (
    new_fault("supply", "off", text="supply lost"),
    new_fault("supply", "stuck", 1.0, "supply valve stuck open"),
    new_fault("supply", "stuck", 0.0, "supply valve stuck shut"),
    new_fault("vents", "stuck", 1.0, "vents stuck shut"),
)

DURING_A_STOP: tuple[Breakage, ...] = tuple(
    Breakage(fault, event, "during a stop")
    for fault in (
        *_valves(),
        *_encoders(),
        *_AIR,
        *(
            new_fault(f"{chamber} sensor", "stuck", 1.0e5, f"{chamber} sensor stuck at 1 bar")
            for chamber in CHAMBERS
        ),
        new_fault("supply sensor", "off"),
        new_fault("link", "off", text="link cut"),
        new_fault("clock", "stuck", text="clock stands still"),
        new_fault("loop", "off", text="loop dead"),
        new_fault("supervisor", "off", text="supervisor dead"),
    )
    for event in _STOPS
)
"""Faults that come while a stop is under way: a stop must not blind."""


def _mounted_wrong(joint: str) -> tuple[Fault, ...]:
    signal = f"{joint} encoder"
    return (
        *(
            new_fault(signal, "offset", value, f"{signal} {value:+g} rad")
            for value in (0.02, 0.05, 0.1, 0.15, 0.3, -0.05, -0.15)
        ),
        new_fault(signal, "offset", 2.0 * pi, f"{signal} +1 turn"),
        new_fault(signal, "offset", -4.0 * pi, f"{signal} -2 turns"),
        new_fault(signal, "scale", 0.9, f"{signal} × 0.9"),
        new_fault(signal, "scale", -1.0, f"{signal} reversed"),
        new_fault(signal, "stuck"),
    )


_PAIRS = (("shoulder", "arm", 1.0), ("shoulder", "wrist", 2.0), ("arm", "wrist", 2.0))

FROM_THE_START: tuple[Breakage, ...] = tuple(
    Breakage(fault, family="from the start")
    for fault in (
        *(fault for joint in JOINTS for fault in _mounted_wrong(joint)),
        *(
            new_fault(f"{a} encoder", "swapped", b_number, f"{a} and {b} encoders swapped")
            for a, b, b_number in _PAIRS
        ),
        *(
            new_fault(f"{a} valve", "swapped", b_number, f"{a} and {b} valves swapped")
            for a, b, b_number in _PAIRS
        ),
        *(new_fault(f"{joint} valve", "scale", -1.0, f"{joint} valve reversed") for joint in JOINTS),
        *(new_fault(f"{joint} valve", "leaking", 0.05, f"{joint} valve leaking 5 %") for joint in JOINTS),
        *(new_fault(f"{chamber} sensor", "off") for chamber in CHAMBERS),
        *(new_fault(f"{chamber} sensor", "scale", 0.7, f"{chamber} sensor × 0.7") for chamber in CHAMBERS),
        new_fault("supply sensor", "off"),
        new_fault("supply sensor", "scale", 0.7, "supply sensor × 0.7"),
        new_fault("supply", "scale", 0.7, "supply sagging to 70 %"),
        new_fault("supply", "scale", 1.4, "supply surging to 140 %"),
        new_fault("vents", "stuck", 1.0, "vents stuck shut"),
        new_fault("shut-off", "stuck", 1.0, "shut-off valve stuck open"),
        *(
            new_fault(f"{chamber} relief", "leaking", 0.05, f"{chamber} relief leaking 5 %")
            for chamber in CHAMBERS
        ),
        new_fault("manifold relief", "stuck", 0.0, "manifold relief stuck open"),
        new_fault("manifold relief", "leaking", 0.05, "manifold relief leaking 5 %"),
        new_fault("guard locked", "stuck", 1.0, "guard locked stuck on"),
        new_fault("local reset", "stuck", 1.0, "local reset stuck pressed"),
        new_fault("clock", "scale", 1.05, "clock 5 % fast"),
    )
)
"""Machines that were built or mounted wrong: homed, armed and swung once, where the bench lets them."""


def _behind(first: Fault, then: tuple[Fault, ...], event: Event = "") -> tuple[Breakage, ...]:
    return tuple(Breakage(fault, event, "latent pair", first) for fault in then)


def _in_the_swing(fault: Fault) -> tuple[Fault, ...]:
    """Return `fault` in three phases of the first swing."""
    return tuple(
        replace(fault, name=f"{fault.name} in the {phase.replace('_', '-')}", phase=phase, after=0.05)
        for phase in ("backswing", "downswing", "follow_through")
    )


LATENT_PAIRS: tuple[Breakage, ...] = (
    *(
        breakage
        for joint in JOINTS
        for chamber in CHAMBERS
        if joint in chamber.split()
        for opening, text in ((1.0, "open"), (-1.0, "open in reverse"))
        for breakage in _behind(
            new_fault(f"{chamber} sensor", "off"),
            _in_the_swing(new_fault(f"{joint} valve", "stuck", opening, f"{joint} valve stuck {text}")),
        )
    ),
    *_behind(
        new_fault("supply sensor", "off"),
        (new_fault("supply", "stuck", 1.0, "supply valve stuck open"),),
        "stop",
    ),
    *_behind(
        new_fault("supply sensor", "stuck", 1.0e5, "supply sensor stuck at 1 bar"),
        (new_fault("supply", "stuck", 1.0, "supply valve stuck open"),),
        "stop",
    ),
    *_behind(
        new_fault("shut-off", "stuck", 1.0, "shut-off valve stuck open"),
        (new_fault("supply", "stuck", 1.0, "supply valve stuck open"),),
        "stop",
    ),
    *_behind(
        new_fault("shut-off feedback", "stuck", 0.0, "shut-off feedback stuck at shut"),
        (new_fault("shut-off", "stuck", 1.0, "shut-off valve stuck open"),),
        "stop",
    ),
    *_behind(
        new_fault("supply sensor", "off"),
        _in_the_swing(new_fault("supply", "scale", 0.7, "supply sagging to 70 %")),
    ),
    *_behind(
        new_fault("manifold relief", "stuck", 1.0, "manifold relief stuck shut"),
        _in_the_swing(new_fault("supply", "scale", 1.4, "supply surging to 140 %")),
    ),
    *(
        breakage
        for joint in JOINTS
        for chamber in CHAMBERS
        if joint in chamber.split()
        for breakage in _behind(
            new_fault(f"{chamber} relief", "stuck", 1.0, f"{chamber} relief stuck shut"),
            _in_the_swing(new_fault(f"{joint} valve", "stuck", 0.0, f"{joint} valve stuck shut")),
        )
    ),
    *_behind(
        new_fault("safety relay", "stuck", 1.0, "safety relay welded shut"),
        (new_fault("vents", "stuck", 1.0, "vents stuck shut"),),
        "emergency stop",
    ),
    *(
        breakage
        for chamber in CHAMBERS
        for breakage in _behind(
            new_fault(f"{chamber} sensor", "stuck", 1.0e5, f"{chamber} sensor stuck at 1 bar"),
            (new_fault("vents", "stuck", 1.0, "vents stuck shut"),),
            "stop",
        )
    ),
    *_behind(
        new_fault("guard locked", "stuck", 1.0, "guard locked stuck on"),
        (new_fault("guard closed", "stuck", 1.0),),
        "guard opened",
    ),
    *_behind(
        new_fault("ball sensor", "stuck", 1.0, "ball sensor stuck on"),
        (new_fault("tee", "off", text="no ball rises"),),
    ),
    *_behind(
        new_fault("local reset", "stuck", 1.0, "local reset stuck pressed"),
        _in_the_swing(Fault("link cut for 100 ms", "link", "off", duration=0.1)),
    ),
)
"""Pairs of which the first shows nothing until the second needs it."""

AROUND_ACCESS: tuple[Breakage, ...] = tuple(
    Breakage(fault, family="access")
    for fault in (
        *_AIR,
        *THROTTLED,
        new_fault("supply", "drifting", -2.0e5, "supply sagging 2 bar/s"),
        new_fault("vents", "off", text="vents without energy"),
        new_fault("shut-off", "stuck", 1.0, "shut-off valve stuck open"),
        new_fault("safety relay", "stuck", 1.0, "safety relay welded shut"),
        new_fault("shut-off feedback", "off"),
        *(new_fault(f"{chamber} sensor", "off") for chamber in CHAMBERS),
        *(
            new_fault(f"{chamber} sensor", "stuck", 1.0e5, f"{chamber} sensor stuck at 1 bar")
            for chamber in CHAMBERS
        ),
        new_fault("supply sensor", "off"),
        new_fault("supply sensor", "stuck", 1.0e5, "supply sensor stuck at 1 bar"),
        *(new_fault(f"{joint} valve", "garbage") for joint in JOINTS),
        *(new_fault(f"{joint} valve", "stuck", 1.0, f"{joint} valve stuck open") for joint in JOINTS),
        *(new_fault(f"{joint} encoder", "off") for joint in JOINTS),
        *(new_fault(f"{joint} encoder", "garbage") for joint in JOINTS),
        new_fault("guard closed", "stuck", 1.0, "guard closed stuck on"),
        new_fault("guard locked", "stuck", 1.0, "guard locked stuck on"),
        new_fault("local reset", "stuck", 1.0, "local reset stuck pressed"),
        new_fault("local reset", "garbage"),
        new_fault("link", "off", text="link cut"),
        Fault("link cut for 100 ms", "link", "off", duration=0.1),
        new_fault("clock", "stuck", text="clock stands still"),
        new_fault("supervisor", "off", text="supervisor dead"),
        new_fault("lease", "off", text="lease lost"),
    )
)
"""Faults before and while the guard is released: no release with pressure anywhere, no motion inside."""

CATALOGUE: tuple[Breakage, ...] = (*SINGLE, *DURING_A_STOP, *FROM_THE_START, *LATENT_PAIRS, *AROUND_ACCESS)
"""All rows of the matrix."""
