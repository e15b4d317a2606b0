"""A DBC file of every frame on the bench's bus, for candump, SavvyCAN, cantools and the like."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from drivers.base import ACTUATORS, CHAMBERS, JOINTS
from drivers.canopen.frames import (
    COMMAND_LENGTH,
    EMERGENCY,
    EMERGENCY_LENGTH,
    HEARTBEAT,
    INPUTS_LENGTH,
    NMT,
    POSITION_LENGTH,
    RPDO1,
    SDO_REQUEST,
    SDO_RESPONSE,
    SPOOLS,
    SYNC,
    TPDO1,
    TPDO2,
    analogue_groups,
    beat_period,
)
from drivers.canopen.settings import FULL_SCALE, CanopenSettings

_MASTER = "BENCH"
_NMT_COMMANDS = {1: "start", 2: "stop", 128: "enter pre-operational", 129: "reset node", 130: "reset bus"}
_STATES = {0: "boot-up", 4: "stopped", 5: "operational", 127: "pre-operational"}


class Signal(NamedTuple):
    """One value in a frame: little-endian, `value = offset + factor * count`."""

    name: str
    start: int
    """First bit."""
    length: int
    """Number of bits."""
    signed: bool = False
    factor: float = 1.0
    offset: float = 0.0
    unit: str = ""
    words: dict[int, str] | None = None
    counts: tuple[int, int] | None = None
    """Lowest and highest valid count; None for all that the bits can hold."""

    @property
    def limits(self) -> tuple[float, float]:
        """Lowest and highest valid value, in units of the signal."""
        whole = 1 << self.length
        low, high = self.counts or ((-whole // 2, whole // 2 - 1) if self.signed else (0, whole - 1))
        return self.offset + self.factor * low, self.offset + self.factor * high


class Frame(NamedTuple):
    """One kind of frame."""

    identifier: int
    name: str
    length: int
    sender: str
    signals: tuple[Signal, ...]
    comment: str
    cycle: float = 0.0
    """Period (s); 0 if event-driven."""


def frames(settings: CanopenSettings, period: float, watchdog: float) -> Iterator[Frame]:
    """Yield every frame on the bus for a tick of `period` (s) and a device `watchdog` (s)."""
    node = settings.valve_node
    yield Frame(
        NMT,
        "NMT",
        2,
        _MASTER,
        (Signal("command", 0, 8, words=_NMT_COMMANDS), Signal("node", 8, 8, counts=(0, 127))),
        "States of the nodes; node 0: all",
    )
    yield Frame(SYNC, "SYNC", 0, _MASTER, (), "All encoders sample now", period)
    for joint, number in zip(JOINTS, settings.encoders.nodes, strict=True):
        position = Signal("position", 0, 32, unit="counts")
        name = f"POSITION_{joint.upper()}"
        yield Frame(
            TPDO2 + number,
            name,
            POSITION_LENGTH,
            sender(number),
            (position,),
            f"Encoder of the {joint}",
            period,
        )
    factor = node.full_scale / FULL_SCALE
    valves = [
        Signal(
            f"valve_{_word(actuator)}",
            16 * n,
            16,
            signed=True,
            factor=factor,
            unit="V",
            counts=(0, FULL_SCALE),
        )
        for n, actuator in enumerate(ACTUATORS)
    ]
    switches = [Signal(name, 48 + bit, 1) for name, bit in vars(node.outputs).items()]
    yield Frame(
        RPDO1 + node.node,
        "COMMAND",
        COMMAND_LENGTH,
        _MASTER,
        (*valves, *switches),
        "Valves (centred at canopen.valve_node.centre) and switches",
        period,
    )
    contacts = tuple(Signal(name, bit, 1) for name, bit in vars(node.inputs).items() if bit >= 0)
    yield Frame(
        TPDO1 + node.node,
        "INPUTS",
        INPUTS_LENGTH,
        sender(node.node),
        contacts,
        "Interlocks, on change and at least once per period",
        settings.interlock_period,
    )
    yield from _analogue(settings, period)
    yield from _services(settings, watchdog)


def _analogue(settings: CanopenSettings, period: float) -> Iterator[Frame]:
    node = settings.valve_node
    channels = (node.supply_pressure, *node.chamber_pressures, *node.spool_positions)
    words = ("pressure_supply", *(f"pressure_{_word(c)}" for c in CHAMBERS))
    names = dict(zip(channels, (*words, *(f"spool_{_word(a)}" for a in ACTUATORS)), strict=True))
    for group in analogue_groups(settings):
        low, high, unit, text = (
            (node.spool_at_zero, node.spool_at_full_scale, "", "Spool positions, share of the full opening")
            if group.number == SPOOLS
            else (node.pressure_at_zero, node.pressure_at_full_scale, "Pa", "Absolute pressures")
        )
        factor = (high - low) / FULL_SCALE
        signals = tuple(
            Signal(names[channel], 16 * k, 16, True, factor, low, unit, counts=(0, FULL_SCALE))
            for k, channel in enumerate(group.channels)
        )
        yield Frame(
            group.base + node.node,
            group.name.upper().replace(" ", "_"),
            2 * len(signals),
            sender(node.node),
            signals,
            text,
            group.ticks * period,
        )


def _services(settings: CanopenSettings, watchdog: float) -> Iterator[Frame]:
    """Yield the frames that every node has: emergency, heartbeat and SDO."""
    object_signals = (
        Signal("specifier", 0, 8),
        Signal("object_index", 8, 16),
        Signal("sub_index", 24, 8),
        Signal("content", 32, 32),
    )
    state = (Signal("state", 0, 8, words=_STATES, counts=(0, 127)),)
    for number in (*settings.encoders.nodes, settings.valve_node.node):
        error = (Signal("error_code", 0, 16), Signal("error_register", 16, 8))
        yield Frame(
            EMERGENCY + number,
            f"EMERGENCY_{number}",
            EMERGENCY_LENGTH,
            sender(number),
            error,
            "Code 0: error reset",
        )
        yield Frame(
            HEARTBEAT + number,
            f"HEARTBEAT_{number}",
            1,
            sender(number),
            state,
            "Heartbeat of a node",
            settings.heartbeat,
        )
        yield Frame(SDO_REQUEST + number, f"QUESTION_{number}", 8, _MASTER, object_signals, "SDO request")
        yield Frame(
            SDO_RESPONSE + number, f"ANSWER_{number}", 8, sender(number), object_signals, "SDO response"
        )
    own = HEARTBEAT + settings.master
    yield Frame(own, "HEARTBEAT_BENCH", 1, _MASTER, state, "Heartbeat of the bench", beat_period(watchdog))


def sender(number: int) -> str:
    """Return the DBC name of node `number`."""
    return f"NODE_{number}"


def describe(settings: CanopenSettings, period: float, watchdog: float) -> str:
    """Return the text of the DBC file."""
    described = list(frames(settings, period, watchdog))
    senders = list(dict.fromkeys(frame.sender for frame in described))
    lines = ['VERSION "1"', "", "NS_ :", "", "BS_:", "", f"BU_: {' '.join(senders)}", ""]
    for frame in described:
        lines.append(f"BO_ {frame.identifier} {frame.name}: {frame.length} {frame.sender}")
        lines += [f" SG_ {_signal(signal, frame.sender)}" for signal in frame.signals]
        lines.append("")
    lines += [f'CM_ BO_ {frame.identifier} "{frame.comment}";' for frame in described]
    lines += ['BA_DEF_ BO_ "GenMsgCycleTime" INT 0 65535;', 'BA_DEF_DEF_ "GenMsgCycleTime" 0;']
    for frame in described:
        if frame.cycle:
            lines.append(f'BA_ "GenMsgCycleTime" BO_ {frame.identifier} {max(1, round(1e3 * frame.cycle))};')
    for frame in described:
        for signal in frame.signals:
            if signal.words:
                words = " ".join(f'{value} "{word}"' for value, word in signal.words.items())
                lines.append(f"VAL_ {frame.identifier} {signal.name} {words} ;")
    return "\n".join(lines) + "\n"


def _signal(signal: Signal, sent_by: str) -> str:
    sign = "-" if signal.signed else "+"
    receiver = "Vector__XXX" if sent_by == _MASTER else _MASTER
    low, high = signal.limits
    return (
        f"{signal.name} : {signal.start}|{signal.length}@1{sign} ({signal.factor!r},{signal.offset!r}) "
        f'[{low:.12g}|{high:.12g}] "{signal.unit}" {receiver}'
    )


def _word(name: str) -> str:
    return name.lower().replace(" ", "_")
