"""Settings of a data-acquisition card: device, channels, lines, scales."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Annotated, Literal

from drivers.base.ranges import Above, AtLeast, AtMost, check_wiring

Volts = Annotated[float, AtLeast(0.0), AtMost(10.0)]


@dataclass(frozen=True)
class InputLines:
    """Digital inputs, high when the contact is closed; they must read low when de-energised."""

    emergency_stop_clear: str = "port0/line0"
    """Line of the emergency-stop circuit: whole."""
    guard_closed: str = "port0/line1"
    """Line of the guard: closed."""
    guard_locked: str = "port0/line2"
    """Line of the guard: locked."""
    local_reset: str = "port0/line3"
    """Line of the local reset."""
    ball_present: str = "port0/line4"
    """Line of the ball on the tee."""


@dataclass(frozen=True)
class OutputLines:
    """Digital outputs, high when energised."""

    supply_enable: str = "port0/line8"
    """Line of the soft-start valve."""
    exhaust_closed: str = "port0/line9"
    """Line that shuts the vents."""
    guard_release: str = "port0/line10"
    """Releases the spring-locked guard lock."""
    beacon: str = "port0/line11"
    """Line of the beacon."""
    tee: str = "port0/line12"
    """Line that raises the next ball."""


@dataclass(frozen=True)
class DaqSettings:
    """One card and its channels, named as in NI MAX without the device name."""

    device: str = "Dev1"
    """Name of the card in NI MAX."""
    serial: Annotated[int, AtLeast(0), AtMost(0xFFFFFFFF)] = 0
    """Serial number; 0 accepts any."""
    counters: tuple[str, str, str] = ("ctr0", "ctr1", "ctr2")
    """Quadrature inputs A, B, Z at their usual terminals, joints in the order shoulder, arm, wrist."""
    index_phase: Literal["high high", "high low", "low high", "low low"] = "high high"
    """Levels of A and B at which the index is valid."""
    valves: tuple[str, str, str] = ("ao0", "ao1", "ao2")
    """Analogue outputs of the valves, in the order of the actuators."""
    centre: tuple[Volts, Volts, Volts] = (5.0, 5.0, 5.0)
    """Spool-centre voltage and fallback value of the card, V."""
    span: Annotated[float, Above(0.0), AtMost(10.0)] = 5.0
    """Voltage from centre to full stroke, V."""
    inputs: InputLines = field(default_factory=InputLines)
    outputs: OutputLines = field(default_factory=OutputLines)
    supply_pressure: str = ""
    """Analogue input; empty if not fitted."""
    chamber_pressures: tuple[str, str, str, str, str, str] = ("", "", "", "", "", "")
    """Analogue inputs, in the order of the chambers; empty if not fitted."""
    spool_positions: tuple[str, str, str] = ("", "", "")
    """Analogue inputs of the spools' positions, in the order of the actuators; empty if not fitted. With one
    all analogue inputs are read in each tick."""
    spool_at_zero: Annotated[float, AtLeast(-3.0), AtMost(0.0)] = -1.0
    """Spool position at 0 V, share of the full opening."""
    spool_at_full_scale: Annotated[float, AtLeast(1.0), AtMost(3.0)] = 1.0
    """Spool position at 10 V, share of the full opening."""
    vent_feedback: tuple[str, str] = ("", "")
    """Digital inputs of the two vents' position switches, high when open; empty if not fitted."""
    shut_off_feedback: str = ""
    """Digital input of the shut-off valve's position switch, high when open; a real robot needs it."""
    vent_proof: str = ""
    """Pressure switches on the manifold and on each actuator's exhaust that prove outside the bench, in the
    guard's circuit, that the air has gone. Needed if the manifold or a chamber has no sensor."""
    pressure_at_zero: Annotated[float, AtLeast(-1e6), AtMost(1e6)] = 0.0
    """Pressure at 0 V, Pa absolute; below zero for a sensor with a live zero (0.5 V, 4 mA)."""
    pressure_at_full_scale: Annotated[float, Above(0.0), AtMost(1e8)] = 1.6e6
    """Pressure at 10 V, Pa absolute."""
    lowest_pressure: Annotated[float, AtLeast(1e3), AtMost(9e4)] = 0.3e5
    """Lowest believable pressure, Pa absolute: less is a cut cable."""
    highest_pressure: Annotated[float, Above(1e5), AtMost(1e8)] = 1.55e6
    """Highest believable pressure, Pa absolute: more is a short circuit."""
    pressure_ticks: Annotated[int, AtLeast(1), AtMost(240)] = 10
    """Ticks between two pressure readings."""
    sync_timeout: Annotated[float, Above(0.0), AtMost(0.01)] = 0.001
    """Time-out of the card for reading or writing, s."""
    sync_line: str = ""
    """Digital output that rises in each tick and is wired to `sync_terminal`: one edge latches all three
    counters (hardware-timed single point). If empty or unsupported, the counters are read in sequence."""
    sync_terminal: str = "PFI12"
    """Clock input of the counters, with `sync_line`."""
    watchdog_relay: str = ""
    """Name of an external relay that centres the valves when `watchdog_line` stops changing; if empty, a card
    without a fallback of its own is refused."""
    watchdog_line: str = ""
    """Digital output that changes with every command, for the external relay."""

    def __post_init__(self) -> None:
        """Raise ValueError if a channel repeats, a relay has no line, or a stroke exceeds its range."""
        for name, used in self._distinct():
            if len(set(used)) != len(used):
                raise ValueError(f"{name}: different channels, not {', '.join(used)}")
        check_wiring(self, "", 10.0)
        if bool(self.watchdog_relay) != bool(self.watchdog_line):
            raise ValueError("watchdog_relay and watchdog_line: both or none; the line feeds the relay")

    @property
    def output_lines(self) -> tuple[str, ...]:
        """All digital outputs: those of the bench, then sync and watchdog lines if used."""
        return (*vars(self.outputs).values(), *filter(None, (self.sync_line, self.watchdog_line)))

    @property
    def input_lines(self) -> tuple[str, ...]:
        """All digital inputs: those of the bench, then the fitted feedback of vents and shut-off valve."""
        return (*vars(self.inputs).values(), *filter(None, (*self.vent_feedback, self.shut_off_feedback)))

    @property
    def analogue_inputs(self) -> tuple[str, ...]:
        """Fitted analogue inputs: supply, chambers, then spools."""
        return tuple(filter(None, (self.supply_pressure, *self.chamber_pressures, *self.spool_positions)))

    def _distinct(self) -> Iterator[tuple[str, list[str]]]:
        yield "counters", list(self.counters)
        yield "valves", list(self.valves)
        yield "inputs and outputs", [*self.input_lines, *self.output_lines]
        yield "supply_pressure, chamber_pressures and spool_positions", list(self.analogue_inputs)
