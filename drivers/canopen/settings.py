"""Settings of a CANopen bench: interface, node and object numbers, wiring, scales."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Annotated

from drivers.base.ranges import Above, AtLeast, AtMost, check_wiring

NodeNumber = Annotated[int, AtLeast(1), AtMost(127)]
Number32 = Annotated[int, AtLeast(0), AtMost(0xFFFFFFFF)]
Bit = Annotated[int, AtLeast(0), AtMost(7)]
OptionalBit = Annotated[int, AtLeast(-1), AtMost(7)]
SubIndex = Annotated[int, AtLeast(1), AtMost(254)]
OptionalSubIndex = Annotated[int, AtLeast(0), AtMost(254)]
Volts = Annotated[float, AtLeast(0.0), AtMost(10.0)]

FULL_SCALE = 32767
"""Full-scale count of an analogue channel."""


@dataclass(frozen=True)
class EncoderSettings:
    """Encoders (CiA 406), joints in the order shoulder, arm, wrist."""

    nodes: tuple[NodeNumber, NodeNumber, NodeNumber] = (1, 2, 3)
    """Node numbers, joints in order."""
    vendor: Number32 = 0
    """Vendor id (1018h:1); 0 accepts any."""
    product: Number32 = 0
    """Product code (1018h:2); 0 accepts any."""
    position: Annotated[int, AtLeast(0x2000), AtMost(0x9FFF)] = 0x6004
    """Position object, 32 bits."""
    position_pdo: Annotated[int, AtLeast(0x1800), AtMost(0x19FF)] = 0x1801
    """Communication object of the PDO that sends the position with SYNC, its mapping 200h above; 0x1802 for
    devices of version 2 of DS 406."""


@dataclass(frozen=True)
class InputSettings:
    """Bits of 6000h:1 at the valve node; 1 means contact closed."""

    emergency_stop_clear: Bit = 0
    """Bit of the emergency-stop circuit: whole."""
    guard_closed: Bit = 1
    """Bit of the guard: closed."""
    guard_locked: Bit = 2
    """Bit of the guard: locked."""
    local_reset: Bit = 3
    """Bit of the local reset."""
    ball_present: Bit = 4
    """Bit of the ball on the tee."""
    vent_1_open: OptionalBit = 5
    """Bit of the first vent's position switch: open; -1 if not fitted."""
    vent_2_open: OptionalBit = 6
    """Bit of the second vent's position switch: open; -1 if not fitted."""
    shut_off_open: OptionalBit = 7
    """Bit of the shut-off valve's position switch: open; -1 if not fitted, which a real robot may not be."""


@dataclass(frozen=True)
class OutputSettings:
    """Bits of 6200h:1 at the valve node; 1 means energised."""

    supply_enable: Bit = 0
    """Bit of the soft-start valve."""
    exhaust_closed: Bit = 1
    """Bit that shuts the vents."""
    guard_release: Bit = 2
    """Releases the spring-locked guard lock."""
    beacon: Bit = 3
    """Bit of the beacon."""
    tee: Bit = 4
    """Bit that raises the next ball."""


@dataclass(frozen=True)
class ValveNodeSettings:
    """The node of valves and interlocks (CiA 401)."""

    node: NodeNumber = 10
    """Node number."""
    vendor: Number32 = 0
    """Vendor id (1018h:1); 0 accepts any."""
    product: Number32 = 0
    """Product code (1018h:2); 0 accepts any."""
    valves: tuple[SubIndex, SubIndex, SubIndex] = (1, 2, 3)
    """Sub-indices of 6411h, in the order of the actuators."""
    centre: tuple[Volts, Volts, Volts] = (5.0, 5.0, 5.0)
    """Spool-centre voltage and fallback value of the node, V."""
    span: Annotated[float, Above(0.0), AtMost(10.0)] = 5.0
    """Voltage from centre to full stroke, V."""
    full_scale: Annotated[float, Above(0.0), AtMost(20.0)] = 10.0
    """Analogue output voltage at count 32767, V."""
    error_value_shift: Annotated[int, AtLeast(0), AtMost(16)] = 16
    """Left shift (bits) of the value in object 6444h if that has 32 bits, not 16."""
    supply_pressure: OptionalSubIndex = 1
    """Sub-index of 6401h; 0 if not fitted."""
    chamber_pressures: tuple[
        OptionalSubIndex,
        OptionalSubIndex,
        OptionalSubIndex,
        OptionalSubIndex,
        OptionalSubIndex,
        OptionalSubIndex,
    ] = (2, 3, 4, 5, 6, 7)
    """Sub-indices of 6401h, in the order of the chambers; 0 if not fitted."""
    pressure_at_zero: Annotated[float, AtLeast(-1e6), AtMost(1e6)] = 0.0
    """Pressure at count 0, Pa absolute; below zero for a sensor with a live zero (0.5 V, 4 mA)."""
    pressure_at_full_scale: Annotated[float, Above(0.0), AtMost(1e8)] = 1.6e6
    """Pressure at count 32767, Pa absolute."""
    lowest_pressure: Annotated[float, AtLeast(1e3), AtMost(9e4)] = 0.3e5
    """Lowest believable pressure, Pa absolute: less is a cut cable."""
    highest_pressure: Annotated[float, Above(1e5), AtMost(1e8)] = 1.55e6
    """Highest believable pressure, Pa absolute: more is a short circuit."""
    spool_positions: tuple[OptionalSubIndex, OptionalSubIndex, OptionalSubIndex] = (0, 0, 0)
    """Sub-indices of 6401h with the spools' positions, in the order of the actuators; 0 if not fitted."""
    spool_at_zero: Annotated[float, AtLeast(-3.0), AtMost(0.0)] = -1.0
    """Spool position at count 0, share of the full opening."""
    spool_at_full_scale: Annotated[float, AtLeast(1.0), AtMost(3.0)] = 1.0
    """Spool position at count 32767, share of the full opening."""
    vent_proof: str = ""
    """Pressure switches on the manifold and on each actuator's exhaust that prove outside the bench, in the
    guard's circuit, that the air has gone. Needed if the manifold or a chamber has no sensor."""
    watchdog_relay: str = ""
    """Name of an external relay that centres the valves when the bench is silent; if empty, a node without a
    fallback of its own is refused."""
    inputs: InputSettings = field(default_factory=InputSettings)
    outputs: OutputSettings = field(default_factory=OutputSettings)

    @property
    def pressure_inputs(self) -> tuple[int, ...]:
        """Fitted sub-indices of 6401h with pressures: supply, then chambers."""
        return tuple(channel for channel in (self.supply_pressure, *self.chamber_pressures) if channel)

    @property
    def spool_inputs(self) -> tuple[int, ...]:
        """Fitted sub-indices of 6401h with the spools' positions."""
        return tuple(channel for channel in self.spool_positions if channel)

    @property
    def analogue_inputs(self) -> tuple[int, ...]:
        """Fitted sub-indices of 6401h."""
        return self.pressure_inputs + self.spool_inputs


@dataclass(frozen=True)
class CanopenSettings:
    """The bus and its nodes."""

    interface: str = "socketcan"
    """python-can interface name; `local_socket` is a bus between processes of this machine."""
    channel: str = "can0"
    """Channel as the interface names it; of "local_socket" a name, or the path of a folder."""
    bitrate: Annotated[int, AtLeast(10_000), AtMost(1_000_000)] = 1_000_000
    """Bit rate (bit/s); with SocketCAN it must equal the bit rate set for the link."""
    master: NodeNumber = 127
    """Node number of the bench, used in its heartbeat."""
    sync_timeout: Annotated[float, Above(0.0), AtMost(0.01)] = 0.0006
    """Time-out of a tick for the encoders' answers to SYNC, s."""
    sdo_timeout: Annotated[float, Above(0.0), AtMost(2.0)] = 0.1
    """SDO time-out, s."""
    heartbeat: Annotated[float, AtLeast(0.005), AtMost(1.0)] = 0.05
    """Heartbeat period of a node, s; a node is lost after three missing heartbeats."""
    interlock_period: Annotated[float, AtLeast(0.005), AtMost(1.0)] = 0.02
    """Period at which unchanged interlocks are repeated (s); three missing frames count as lost."""
    pressure_ticks: Annotated[int, AtLeast(1), AtMost(240)] = 10
    """Ticks between two pressure readings."""
    encoders: EncoderSettings = field(default_factory=EncoderSettings)
    valve_node: ValveNodeSettings = field(default_factory=ValveNodeSettings)

    def __post_init__(self) -> None:
        """Raise ValueError if numbers or bits repeat, or a valve's stroke exceeds its output range."""
        for name, numbers in self._distinct():
            if len(set(numbers)) != len(numbers):
                raise ValueError(f"{name}: different numbers, not {', '.join(map(str, numbers))}")
        check_wiring(self.valve_node, "valve_node.", self.valve_node.full_scale)

    def _distinct(self) -> Iterator[tuple[str, list[int]]]:
        node = self.valve_node
        yield "node numbers", [self.master, *self.encoders.nodes, node.node]
        yield "valve_node.valves", list(node.valves)
        yield "valve_node.inputs", [bit for bit in vars(node.inputs).values() if bit >= 0]
        yield "valve_node.outputs", list(vars(node.outputs).values())
        yield "valve_node pressures and spool positions", list(node.analogue_inputs)
