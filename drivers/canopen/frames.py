"""Every frame of the bench's bus: identifiers, lengths, contents, rates, the resulting load, a DBC file.

The DBC file is for candump, SavvyCAN, cantools and the like.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from drivers.base import ACTUATORS, CHAMBERS, JOINTS
from drivers.can_bus import FRAME
from drivers.canopen.settings import FULL_SCALE, CanopenSettings, ValveNodeSettings

NMT, SYNC, EMERGENCY = 0x000, 0x080, 0x080
TPDO1, TPDO2, TPDO3, TPDO4, RPDO1 = 0x180, 0x280, 0x380, 0x480, 0x200
SDO_RESPONSE, SDO_REQUEST, HEARTBEAT = 0x580, 0x600, 0x700
"""Function codes of CiA 301's predefined connection set; the node's number is added."""

MAX_ECHO_DELAY = 0.005
"""Age from which an echo does not belong to the last SYNC (s)."""

MAX_LOAD = 0.75
"""Maximum bus load (share); above it frames of low priority wait too long."""

COMMAND_LENGTH = 7
"""Bytes of the command: three valves, then the outputs."""
POSITION_LENGTH = 4
INPUTS_LENGTH = 1
ANALOGUE_IN_ONE = 4
"""Analogue inputs per frame."""
EMERGENCY_LENGTH = 8


def frame(identifier: int, data: bytes = b"") -> bytes:
    """Return a whole data frame."""
    return FRAME.pack(identifier, len(data), data)


def worst_bits(length: int) -> int:
    """Return the maximum bits of a frame of `length` data bytes, with stuffing and interframe space.

    Classic base frame: 44 bits plus data, of which 34 bits plus data are stuffed, and 3 bits of interframe
    space.
    """
    return 47 + 8 * length + (33 + 8 * length) // 4


class AnalogueGroup(NamedTuple):
    """Analogue inputs in one PDO of the valve node."""

    name: str
    number: int
    """Number of the PDO after TPDO1: 1 and 2 for pressures, SPOOLS for the spools' positions."""
    channels: tuple[int, ...]
    """Sub-indices of 6401h."""
    ticks: int
    """Ticks between two of its frames."""

    @property
    def base(self) -> int:
        """Function code of the PDO."""
        return (TPDO2, TPDO3, TPDO4)[self.number - 1]


SPOOLS = 3
"""Number of the group with the spools' positions."""


def analogue_groups(settings: CanopenSettings) -> tuple[AnalogueGroup, ...]:
    """Return pressures in TPDO2, in TPDO3 if more than four are fitted, and spool positions in TPDO4."""
    node, ticks = settings.valve_node, settings.pressure_ticks
    fitted = node.pressure_inputs
    split = (fitted[at : at + ANALOGUE_IN_ONE] for at in range(0, len(fitted), ANALOGUE_IN_ONE))
    groups = [AnalogueGroup(f"pressures {n}", n, part, ticks) for n, part in enumerate(split, start=1)]
    if node.spool_inputs:
        groups.append(AnalogueGroup("spools", SPOOLS, node.spool_inputs, 1))
    return tuple(groups)


def beat_period(watchdog: float) -> float:
    """Return the heartbeat period of the bench (s): a third of the node's watchdog time."""
    return watchdog / 3.0


def valve_counts(volts: float, node: ValveNodeSettings) -> int:
    """Return the analogue output count nearest to `volts`."""
    return max(0, min(FULL_SCALE, round(volts / node.full_scale * FULL_SCALE)))


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

    @property
    def load(self) -> float:
        """Maximum bits per second of a periodic frame."""
        return worst_bits(self.length) / self.cycle if self.cycle else 0.0


def traffic(settings: CanopenSettings, period: float, watchdog: float) -> Iterator[Frame]:
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
            _sender(number),
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
        _sender(node.node),
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
            _sender(node.node),
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
            _sender(number),
            error,
            "Code 0: error reset",
        )
        yield Frame(
            HEARTBEAT + number,
            f"HEARTBEAT_{number}",
            1,
            _sender(number),
            state,
            "Heartbeat of a node",
            settings.heartbeat,
        )
        yield Frame(SDO_REQUEST + number, f"QUESTION_{number}", 8, _MASTER, object_signals, "SDO request")
        yield Frame(
            SDO_RESPONSE + number, f"ANSWER_{number}", 8, _sender(number), object_signals, "SDO response"
        )
    own = HEARTBEAT + settings.master
    yield Frame(own, "HEARTBEAT_BENCH", 1, _MASTER, state, "Heartbeat of the bench", beat_period(watchdog))


def bus_load(settings: CanopenSettings, period: float, watchdog: float) -> float:
    """Return the maximum bus load as a fraction; above 1 the bus is overloaded."""
    return sum(one.load for one in traffic(settings, period, watchdog)) / settings.bitrate


def max_rate(settings: CanopenSettings, watchdog: float) -> float:
    """Return the tick rate (Hz) at which the bus load reaches MAX_LOAD."""
    slow = bus_load(settings, 1e9, watchdog)
    return max(0.0, MAX_LOAD - slow) / (bus_load(settings, 1.0, watchdog) - slow)


def _sender(number: int) -> str:
    return f"NODE_{number}"


def dbc_text(settings: CanopenSettings, period: float, watchdog: float) -> str:
    """Return the text of the DBC file."""
    described = list(traffic(settings, period, watchdog))
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
