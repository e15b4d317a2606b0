"""The node of valves and interlocks (CiA 401): valve voltages, contacts and pressure sensors on the bus."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import isfinite
from pathlib import Path

from drivers.base import Command, Readings, device_limited
from sim.nodes.device import CanopenDevice, Send

_INPUTS, _OUTPUTS, _OUTPUT_ERROR_MODE, _OUTPUT_ERROR_VALUE = 0x6000, 0x6200, 0x6206, 0x6207
_VOLTAGE_IN, _VOLTAGE_OUT, _VOLTAGE_ERROR_MODE, _VOLTAGE_ERROR_VALUE = 0x6401, 0x6411, 0x6443, 0x6444
_CENTRE = 5.0
"""Spool-centre voltage, V; 0 V and twice this voltage are full stroke."""
_PRESSURE_PER_VOLT = 1.6e5
"""Sensitivity of the pressure sensors, Pa absolute per V."""


class ValveNode401(CanopenDevice):
    """Valve node; `obey` applies the command given by its outputs.

    Wiring. Digital inputs from bit 0: emergency stop clear, guard closed, guard locked, local reset, ball
    present, vents 1 and 2 open. Digital outputs from bit 0: supply, exhaust closed, release of the guard's
    lock, beacon, tee. Analogue outputs: the valves; inputs: supply pressure, then the chambers.
    """

    def __init__(self, number: int, eds: Path, send: Send, obey: Callable[[Command], None]) -> None:
        super().__init__(number, eds, send)
        self._obey_outputs = obey
        self._volts = self.factor_of(_VOLTAGE_OUT, 1)
        """Voltage per count, V."""

    def written(self, index: int) -> None:
        """Apply the outputs."""
        if index in (_OUTPUTS, _VOLTAGE_OUT):
            self._drive()

    def fall_back(self) -> None:
        """Set each output to its error value if its error mode requires that."""
        before = self.number_at(_OUTPUTS, 1)
        chosen = self.number_at(_OUTPUT_ERROR_MODE, 1)
        self.put(_OUTPUTS, 1, before & ~chosen | self.number_at(_OUTPUT_ERROR_VALUE, 1) & chosen)
        for valve in (1, 2, 3):
            if self.number_at(_VOLTAGE_ERROR_MODE, valve):
                self.put(_VOLTAGE_OUT, valve, self.number_at(_VOLTAGE_ERROR_VALUE, valve) >> 16)
        self._drive()

    def sense(self, readings: Readings) -> None:
        """Update contacts and pressures from `readings`."""
        contacts = (
            readings.emergency_stop_clear,
            readings.guard_closed,
            readings.guard_locked,
            readings.local_reset,
            readings.ball_present,
            readings.vent_open[0] == 1.0,
            readings.vent_open[1] == 1.0,
        )
        inputs = sum(closed << bit for bit, closed in enumerate(contacts))
        self._measure((readings.supply_pressure, *readings.chamber_pressure))
        if inputs != self.number_at(_INPUTS, 1):
            self.put(_INPUTS, 1, inputs)
            self.send_changed(_INPUTS)

    def _measure(self, pressures: Sequence[float]) -> None:
        for channel, pressure in enumerate(pressures, start=1):
            # A sensor without a cable gives 0 V.
            count = round(pressure / _PRESSURE_PER_VOLT / self._volts) if isfinite(pressure) else 0
            self.put(_VOLTAGE_IN, channel, max(0, min(0x7FFF, count)))

    def _drive(self) -> None:
        outputs = self.number_at(_OUTPUTS, 1)
        a, b, c = (self.number_at(_VOLTAGE_OUT, valve) * self._volts / _CENTRE - 1.0 for valve in (1, 2, 3))
        supply, closed, release, beacon, tee = (bool(outputs >> bit & 1) for bit in range(5))
        self._obey_outputs(device_limited(Command((a, b, c), supply, closed, not release, beacon, tee)))
