"""What differs from one CANopen bench to the next: interface, node and object numbers, wiring, scales."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Annotated

from annotated_types import Ge, Gt, Le

NodeNumber = Annotated[int, Ge(1), Le(127)]
Number32 = Annotated[int, Ge(0), Le(0xFFFFFFFF)]
Bit = Annotated[int, Ge(0), Le(7)]
SubIndex = Annotated[int, Ge(1), Le(254)]
OptionalSubIndex = Annotated[int, Ge(0), Le(254)]
Volts = Annotated[float, Ge(0.0), Le(10.0)]

FULL_SCALE = 32767
"""Count of an analogue channel at its upper end."""


@dataclass(frozen=True)
class EncoderSettings:
    """Encoders after CiA 406, joints in the order shoulder, arm, wrist."""

    nodes: tuple[NodeNumber, NodeNumber, NodeNumber] = (1, 2, 3)
    """Node numbers, joints in order."""
    vendor: Number32 = 0
    """1018h:1; 0 takes any."""
    product: Number32 = 0
    """1018h:2; 0 takes any."""
    position: Annotated[int, Ge(0x2000), Le(0x9FFF)] = 0x6004
    """Object of the position, 32 bits."""


@dataclass(frozen=True)
class InputSettings:
    """Bits of 6000h:1 at the valve node; set: contact closed."""

    emergency_stop_clear: Bit = 0
    """Bit of the emergency-stop circuit: whole."""
    guard_closed: Bit = 1
    """Bit of the guard: closed."""
    guard_locked: Bit = 2
    """Bit of the guard: locked."""
    local_reset: Bit = 3
    """Bit of the button beside the robot."""
    ball_present: Bit = 4
    """Bit of the ball on the tee."""


@dataclass(frozen=True)
class OutputSettings:
    """Bits of 6200h:1 at the valve node; set: energised."""

    supply_enable: Bit = 0
    """Bit of the soft-start valve."""
    exhaust_closed: Bit = 1
    """Bit that shuts the vents."""
    guard_release: Bit = 2
    """Lets go of the guard's lock, which is shut by a spring."""
    beacon: Bit = 3
    """Bit of the beacon."""
    tee: Bit = 4
    """Bit that raises the next ball."""


@dataclass(frozen=True)
class ValveNodeSettings:
    """The node of valves and interlocks after CiA 401."""

    node: NodeNumber = 10
    """Node number."""
    vendor: Number32 = 0
    """1018h:1; 0 takes any."""
    product: Number32 = 0
    """1018h:2; 0 takes any."""
    valves: tuple[SubIndex, SubIndex, SubIndex] = (1, 2, 3)
    """Sub-indices of 6411h, actuators in their usual order."""
    centre: tuple[Volts, Volts, Volts] = (5.0, 5.0, 5.0)
    """V that centre the spool: what the node falls back to."""
    span: Annotated[float, Gt(0.0), Le(10.0)] = 5.0
    """V from the centre to full stroke."""
    full_scale: Annotated[float, Gt(0.0), Le(20.0)] = 10.0
    """V of an analogue output at 32767."""
    error_value_shift: Annotated[int, Ge(0), Le(16)] = 16
    """Bits by which the value stands to the left in 6444h, which has 32."""
    supply_pressure: OptionalSubIndex = 1
    """Sub-index of 6401h; 0: not fitted."""
    chamber_pressures: tuple[
        OptionalSubIndex,
        OptionalSubIndex,
        OptionalSubIndex,
        OptionalSubIndex,
        OptionalSubIndex,
        OptionalSubIndex,
    ] = (2, 3, 4, 5, 6, 7)
    """Sub-indices of 6401h, chambers in their usual order; 0: not fitted."""
    pressure_at_zero: Annotated[float, Ge(-1e6), Le(1e6)] = 0.0
    """Pa absolute at count 0."""
    pressure_at_full_scale: Annotated[float, Gt(0.0), Le(1e8)] = 1.6e6
    """Pa absolute at count 32767."""
    watchdog_relay: str = ""
    """Name of an external relay that centres the valves when the bench is silent; empty: there is none, and a
    node that cannot fall back by itself is refused."""
    inputs: InputSettings = field(default_factory=InputSettings)
    outputs: OutputSettings = field(default_factory=OutputSettings)

    @property
    def analogue_inputs(self) -> tuple[int, ...]:
        """Sub-indices of 6401h that are fitted: supply, then chambers."""
        return tuple(channel for channel in (self.supply_pressure, *self.chamber_pressures) if channel)


@dataclass(frozen=True)
class CanopenSettings:
    """The bus and everything on it."""

    interface: str = "socketcan"
    """python-can's name of it; `local_socket` is a bus between processes of this machine."""
    channel: str = "can0"
    """Channel as the interface names it; of "local_socket" a name, or the path of a folder."""
    bitrate: Annotated[int, Ge(10_000), Le(1_000_000)] = 1_000_000
    """bit/s; SocketCAN's own is set with the link, and this one must be the same."""
    master: NodeNumber = 127
    """The bench's own node number, in its heartbeat."""
    answer_time: Annotated[float, Gt(0.0), Le(0.01)] = 0.0006
    """s that a tick waits at most for the encoders' answers to its SYNC."""
    service_time: Annotated[float, Gt(0.0), Le(2.0)] = 0.1
    """s that a node may take to answer a question of the start-up (SDO)."""
    heartbeat: Annotated[float, Ge(0.005), Le(1.0)] = 0.05
    """s between two heartbeats of a node; three missing make it lost."""
    interlock_period: Annotated[float, Ge(0.005), Le(1.0)] = 0.02
    """s after which interlocks are sent though they did not change; three missing make them lost."""
    pressure_ticks: Annotated[int, Ge(1), Le(240)] = 10
    """Ticks between two pressures."""
    encoders: EncoderSettings = field(default_factory=EncoderSettings)
    valve_node: ValveNodeSettings = field(default_factory=ValveNodeSettings)

    def __post_init__(self) -> None:
        """Raise ValueError when numbers or bits are given twice, or a valve's centre leaves its output."""
        for name, numbers in self._distinct():
            if len(set(numbers)) != len(numbers):
                raise ValueError(f"{name}: each another number, not {', '.join(map(str, numbers))}")
        node = self.valve_node
        for centre in node.centre:
            if not node.span <= centre <= node.full_scale - node.span:
                raise ValueError(
                    f"valve_node.centre: the full stroke, {centre:g} V -+ {node.span:g} V, within 0 to "
                    f"{node.full_scale:g} V"
                )
        if node.pressure_at_full_scale <= node.pressure_at_zero:
            raise ValueError("valve_node.pressure_at_full_scale: more than pressure_at_zero")

    def _distinct(self) -> Iterator[tuple[str, list[int]]]:
        node = self.valve_node
        yield "node numbers", [self.master, *self.encoders.nodes, node.node]
        yield "valve_node.valves", list(node.valves)
        yield "valve_node.inputs", list(vars(node.inputs).values())
        yield "valve_node.outputs", list(vars(node.outputs).values())
        yield "valve_node pressures", list(node.analogue_inputs)
