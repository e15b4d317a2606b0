"""What differs from one card to the next: device, channels, lines, scales."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Annotated, Literal

from annotated_types import Ge, Gt, Le

Volts = Annotated[float, Ge(0.0), Le(10.0)]


@dataclass(frozen=True)
class InputLines:
    """Digital lines that are high when a contact is closed; without energy they must read low."""

    emergency_stop_clear: str = "port0/line0"
    """Line of the emergency-stop circuit: whole."""
    guard_closed: str = "port0/line1"
    """Line of the guard: closed."""
    guard_locked: str = "port0/line2"
    """Line of the guard: locked."""
    local_reset: str = "port0/line3"
    """Line of the button beside the robot."""
    ball_present: str = "port0/line4"
    """Line of the ball on the tee."""


@dataclass(frozen=True)
class OutputLines:
    """Digital lines, high: energised."""

    supply_enable: str = "port0/line8"
    """Line of the soft-start valve."""
    exhaust_closed: str = "port0/line9"
    """Line that shuts the vents."""
    guard_release: str = "port0/line10"
    """Lets go of the guard's lock, which is shut by a spring."""
    beacon: str = "port0/line11"
    """Line of the beacon."""
    tee: str = "port0/line12"
    """Line that raises the next ball."""


@dataclass(frozen=True)
class DaqSettings:
    """One card and everything on it; channels are named as NI MAX does, without the device's name."""

    device: str = "Dev1"
    """Name of the card in NI MAX."""
    serial: Annotated[int, Ge(0), Le(0xFFFFFFFF)] = 0
    """Serial number; 0 takes any."""
    counters: tuple[str, str, str] = ("ctr0", "ctr1", "ctr2")
    """Quadrature inputs A, B, Z at their usual terminals, joints in the order shoulder, arm, wrist."""
    index_phase: Literal["high high", "high low", "low high", "low low"] = "high high"
    """A and B when the index counts."""
    valves: tuple[str, str, str] = ("ao0", "ao1", "ao2")
    """Actuators in their usual order."""
    centre: tuple[Volts, Volts, Volts] = (5.0, 5.0, 5.0)
    """V that centre the spool: what the card falls back to."""
    span: Annotated[float, Gt(0.0), Le(10.0)] = 5.0
    """V from the centre to full stroke."""
    inputs: InputLines = field(default_factory=InputLines)
    outputs: OutputLines = field(default_factory=OutputLines)
    supply_pressure: str = ""
    """Analogue input; empty: not fitted."""
    chamber_pressures: tuple[str, str, str, str, str, str] = ("", "", "", "", "", "")
    """Analogue inputs, chambers in their usual order; empty: not fitted."""
    vent_proof: str = ""
    """What proves outside the bench that chambers are empty before the guard opens, such as pressure switches
    in the guard's circuit; needed without chamber sensors."""
    pressure_at_zero: Annotated[float, Ge(-1e6), Le(1e6)] = 0.0
    """Pa absolute at 0 V."""
    pressure_at_full_scale: Annotated[float, Gt(0.0), Le(1e8)] = 1.6e6
    """Pa absolute at 10 V."""
    pressure_ticks: Annotated[int, Ge(1), Le(240)] = 10
    """Ticks between two pressures."""
    answer_time: Annotated[float, Gt(0.0), Le(0.01)] = 0.001
    """s that the card may take to read or write."""
    sync_line: str = ""
    """Digital output that rises in each tick and is wired to `sync_terminal`: one edge latches all three
    counters (hardware-timed single point); empty, or a card that cannot: read one after the other."""
    sync_terminal: str = "PFI12"
    """Clock input of the counters, with `sync_line`."""
    watchdog_relay: str = ""
    """Name of an external relay that centres the valves when `watchdog_line` stops changing; empty: there is
    none, and a card that cannot fall back by itself is refused."""
    watchdog_line: str = ""
    """Digital output that changes with every command, for the external relay."""

    def __post_init__(self) -> None:
        """Raise ValueError when a channel is given twice, a relay is not fed, or a stroke cannot be had."""
        for name, used in self._distinct():
            if len(set(used)) != len(used):
                raise ValueError(f"{name}: each another channel, not {', '.join(used)}")
        for centre in self.centre:
            if not self.span <= centre <= 10.0 - self.span:
                raise ValueError(
                    f"centre: the full stroke, {centre:g} V -+ {self.span:g} V, within 0 to 10 V"
                )
        if self.pressure_at_full_scale <= self.pressure_at_zero:
            raise ValueError("pressure_at_full_scale: more than pressure_at_zero")
        if bool(self.watchdog_relay) != bool(self.watchdog_line):
            raise ValueError("watchdog_relay and watchdog_line: both or none; the line feeds the relay")

    @property
    def output_lines(self) -> tuple[str, ...]:
        """All digital outputs: those of the bench, then sync and watchdog where there are such."""
        return (*vars(self.outputs).values(), *filter(None, (self.sync_line, self.watchdog_line)))

    @property
    def analogue_inputs(self) -> tuple[str, ...]:
        """Analogue inputs that are fitted: supply, then chambers."""
        return tuple(filter(None, (self.supply_pressure, *self.chamber_pressures)))

    def _distinct(self) -> Iterator[tuple[str, list[str]]]:
        yield "counters", list(self.counters)
        yield "valves", list(self.valves)
        yield "inputs and outputs", [*vars(self.inputs).values(), *self.output_lines]
        yield "supply_pressure and chamber_pressures", list(self.analogue_inputs)
