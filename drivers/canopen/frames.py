"""Every frame of the bench's bus: identifiers, lengths, contents and rates, and the resulting bus load."""

from __future__ import annotations

import struct
from typing import NamedTuple

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

COMMAND = struct.Struct("=IB3x3hBx")
"""The command as a whole frame (`drivers.can_bus.FRAME`): three valves, then the outputs."""
COMMAND_LENGTH = 7
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


class Traffic(NamedTuple):
    """One kind of frame and its rate."""

    name: str
    identifier: int
    length: int
    rate: float
    """Frames per second."""

    @property
    def load(self) -> float:
        """Maximum bits per second."""
        return self.rate * worst_bits(self.length)


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


def traffic(settings: CanopenSettings, period: float, watchdog: float) -> list[Traffic]:
    """Return all traffic of a running bench with a tick of `period` (s)."""
    ticks, node = 1.0 / period, settings.valve_node.node
    numbers = (*settings.encoders.nodes, node)
    sent = [Traffic("SYNC", SYNC, 0, ticks)]
    sent += [
        Traffic(f"position {joint}", TPDO2 + number, POSITION_LENGTH, ticks)
        for joint, number in zip(("shoulder", "arm", "wrist"), settings.encoders.nodes, strict=True)
    ]
    sent += [Traffic("command", RPDO1 + node, COMMAND_LENGTH, ticks)]
    sent += [Traffic("inputs", TPDO1 + node, INPUTS_LENGTH, 1.0 / settings.interlock_period)]
    sent += [
        Traffic(group.name, group.base + node, 2 * len(group.channels), ticks / group.ticks)
        for group in analogue_groups(settings)
    ]
    sent += [
        Traffic(f"heartbeat {number}", HEARTBEAT + number, 1, 1.0 / settings.heartbeat) for number in numbers
    ]
    own = Traffic("heartbeat of the bench", HEARTBEAT + settings.master, 1, 1.0 / beat_period(watchdog))
    return [*sent, own]


def beat_period(watchdog: float) -> float:
    """Return the heartbeat period of the bench (s): a third of the node's watchdog time."""
    return watchdog / 3.0


def bus_load(settings: CanopenSettings, period: float, watchdog: float) -> float:
    """Return the maximum bus load as a share; above 1 the bus is overloaded."""
    return sum(one.load for one in traffic(settings, period, watchdog)) / settings.bitrate


def max_rate(settings: CanopenSettings, watchdog: float) -> float:
    """Return the tick rate (Hz) at which the bus load reaches MAX_LOAD."""
    slow = bus_load(settings, 1e9, watchdog)
    return max(0.0, MAX_LOAD - slow) / (bus_load(settings, 1.0, watchdog) - slow)


def valve_counts(volts: float, node: ValveNodeSettings) -> int:
    """Return the analogue output count nearest to `volts`."""
    return max(0, min(FULL_SCALE, round(volts / node.full_scale * FULL_SCALE)))
