"""The node of valves and interlocks (CiA 401): valve voltages, contacts, pressures and spools on the bus."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import isfinite
from pathlib import Path

from drivers.base import Command, Readings, device_limited
from sim.nodes.device import CanopenDevice, Send
from sim.nodes.personality import Personality

_INPUTS, _OUTPUTS, _OUTPUT_ERROR_MODE, _OUTPUT_ERROR_VALUE = 0x6000, 0x6200, 0x6206, 0x6207
_INPUT_POLARITY, _OUTPUT_POLARITY, _OUTPUT_MASK = (0x6002, 0x6102), (0x6202, 0x6302), (0x6208, 0x6308)
"""Objects in groups of 8 and of 16."""
_GROUPS_OF_16 = {_OUTPUT_ERROR_MODE: 0x6306, _OUTPUT_ERROR_VALUE: 0x6307}
_VOLTAGE_IN, _VOLTAGE_OUT, _VOLTAGE_ERROR_MODE, _VOLTAGE_ERROR_VALUE = 0x6401, 0x6411, 0x6443, 0x6444
_VOLTS = 10.0 / 32767
"""Voltage per count of inputs and outputs, V."""
_CENTRE = 5.0
"""Spool-centre voltage, V; 0 V and twice this voltage are full stroke."""
_PRESSURE_PER_VOLT = 1.6e5
"""Sensitivity of the pressure sensors, Pa absolute per V."""
_FIRST_SPOOL = 8
"""Analogue input of the first spool's position: 0 to 10 V for -1 to 1, as the outputs."""


class ValveNode401(CanopenDevice):
    """Valve node; `obey` applies the command given by its outputs.

    Wiring. Digital inputs from bit 0: emergency stop clear, guard closed, guard locked, local reset, ball
    present, vents 1 and 2 open, shut-off valve open. Digital outputs from bit 0: supply, exhaust closed,
    release of the guard's lock, beacon, tee. Analogue outputs: the valves; inputs: supply pressure, then the
    chambers, then the spools' positions.
    """

    def __init__(
        self,
        number: int,
        eds: Path,
        send: Send,
        obey: Callable[[Command], None],
        personality: Personality | None = None,
    ) -> None:
        super().__init__(number, eds, send, personality)
        self._obey_outputs = obey
        self._latched = 0
        """Outputs as commanded; a masked output keeps its last state."""

    def written(self, index: int) -> None:
        """Apply the outputs."""
        if index in {_OUTPUTS, _VOLTAGE_OUT, *_OUTPUT_POLARITY, *_OUTPUT_MASK}:
            self._drive()

    def fall_back(self) -> None:
        """Set each output to its error value if its error mode requires that."""
        before = self.number_at(_OUTPUTS, 1)
        chosen, value = self._of_outputs(_OUTPUT_ERROR_MODE), self._of_outputs(_OUTPUT_ERROR_VALUE)
        self.put(_OUTPUTS, 1, before & ~chosen | value & chosen)
        for valve in (1, 2, 3):
            if self.number_at(_VOLTAGE_ERROR_MODE, valve) and (_VOLTAGE_ERROR_VALUE, valve) in self:
                shift = 8 * self.size_of(_VOLTAGE_ERROR_VALUE, valve) - 16
                self.put(_VOLTAGE_OUT, valve, self.number_at(_VOLTAGE_ERROR_VALUE, valve) >> shift)
        self._drive()

    def _of_outputs(self, index: int) -> int:
        """Return error modes or values of the eight outputs, from the objects that the device has."""
        return self.number_at(index, 1, self.number_at(_GROUPS_OF_16[index], 1) & 0xFF)

    def sense(self, readings: Readings) -> None:
        """Update contacts, pressures and spool positions from `readings`."""
        contacts = (
            readings.emergency_stop_clear,
            readings.guard_closed,
            readings.guard_locked,
            readings.local_reset,
            readings.ball_present,
            readings.vent_open[0] == 1.0,
            readings.vent_open[1] == 1.0,
            readings.shut_off_open == 1.0,
        )
        inputs = sum(closed << bit for bit, closed in enumerate(contacts))
        for polarity in _INPUT_POLARITY:
            inputs ^= self.number_at(polarity, 1) & 0xFF
        pressures = (readings.supply_pressure, *readings.chamber_pressure)
        self._measure(1, [pressure / _PRESSURE_PER_VOLT for pressure in pressures])
        self._measure(_FIRST_SPOOL, [_CENTRE * (1.0 + position) for position in readings.spool_position])
        if inputs != self.number_at(_INPUTS, 1):
            self.put(_INPUTS, 1, inputs)
            self.send_changed(_INPUTS)

    def _measure(self, first: int, voltages: Sequence[float]) -> None:
        for channel, volts in enumerate(voltages, start=first):
            # A sensor without a cable gives 0 V.
            count = round(volts / _VOLTS) if isfinite(volts) else 0
            self.put(_VOLTAGE_IN, channel, max(0, min(0x7FFF, count)))

    def _drive(self) -> None:
        taking = 0xFF
        for mask in _OUTPUT_MASK:
            taking &= self.number_at(mask, 1, 0xFF)
        outputs = self._latched = self._latched & ~taking | self.number_at(_OUTPUTS, 1) & taking
        for polarity in _OUTPUT_POLARITY:
            outputs ^= self.number_at(polarity, 1) & 0xFF
        a, b, c = (self.number_at(_VOLTAGE_OUT, valve) * _VOLTS / _CENTRE - 1.0 for valve in (1, 2, 3))
        supply, closed, release, beacon, tee = (bool(outputs >> bit & 1) for bit in range(5))
        self._obey_outputs(device_limited(Command((a, b, c), supply, closed, not release, beacon, tee)))
