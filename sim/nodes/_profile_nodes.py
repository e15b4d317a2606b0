"""The nodes by device profile: encoders (CiA 406), and the node of valves and interlocks (CiA 401)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import isfinite
from pathlib import Path

from drivers.base import Command, Readings, device_limited
from sim.nodes._device import NO_ERROR, CanopenDevice, Send
from sim.nodes.personality import Personality

_OPERATING, _UNITS, _RANGE, _PRESET, _POSITION = 0x6000, 0x6001, 0x6002, 0x6003, 0x6004
_RESOLUTION, _REVOLUTIONS, _ALARMS, _OFFSET = 0x6501, 0x6502, 0x6503, 0x6509
_REVERSED, _SCALED = 1 << 0, 1 << 2
"""Bits of the operating parameters."""
_MAX = 0xFFFFFFFF
_POSITION_ERROR = 0x0001
"""Alarm bit."""
_HARDWARE_ERROR = 0x5000
"""Emergency error code."""


class EncoderNode(CanopenDevice):
    """Absolute encoder on a joint of the plant; `count` returns its counts, None while it hangs."""

    def __init__(
        self,
        number: int,
        eds: Path,
        send: Send,
        resolution: int,
        count: Callable[[], int | None],
        personality: Personality | None = None,
    ) -> None:
        """Create the node; `resolution` in counts per revolution, those that `count` gives."""
        super().__init__(number, eds, send, personality)
        self._plant_counts, self._count = resolution, count
        self._resolution = resolution
        self._revolutions, self._always_scaled, self._range_is_last = 1, False, False
        if personality is not None:
            self._resolution = personality.counts or resolution
            self._revolutions = personality.revolutions
            self._always_scaled = personality.always_scaled
            self._range_is_last = personality.range_is_last
        self._offset = 0
        self._healthy = True

    def boot(self, now: float) -> None:
        """Power up with the built-in resolution, and the preset and offset as stored or delivered."""
        self._healthy = True
        super().boot(now)
        self._offset = self.number_at(_OFFSET)
        changed = () if self.personality is None else self.personality.objects
        delivered = {(one.index, one.subindex) for one in changed if one.value is not None}
        total = self._resolution * max(1, self._revolutions)
        for index, value in (
            (_RESOLUTION, self._resolution),
            (_REVOLUTIONS, self._revolutions),
            (_UNITS, self._resolution),
            (_RANGE, total - self._range_is_last),
        ):
            if (index, 0) not in delivered | self._stored.keys():
                self.put(index, 0, value & _MAX)
        self.sampled()

    def sampled(self) -> bool:
        """Sample the shaft."""
        count = self._count()
        if count is None:
            return False
        self.put(_POSITION, 0, self._positioned(count))
        return True

    def _positioned(self, count: int) -> int:
        """Return the position of a plant's `count`, scaled and directed according to the settings."""
        disc = self._resolution
        operating = self.number_at(_OPERATING)
        if disc != self._plant_counts:
            count = count * disc // self._plant_counts
        if operating & _REVERSED:
            count = -count
        turns = max(1, self.number_at(_REVOLUTIONS, otherwise=self._revolutions))
        if (operating & _SCALED or self._always_scaled) and (units := self.number_at(_UNITS)):
            total = (
                self.number_at(_RANGE, otherwise=units * turns - self._range_is_last) + self._range_is_last
            )
            return (count * units // disc + self._offset) % (total & _MAX or _MAX + 1)
        return (count + self._offset) % (disc * turns)

    def written(self, index: int) -> None:
        """Apply direction and scaling, or shift the position to the preset value."""
        if index in {_OPERATING, _UNITS, _RANGE}:
            self.sampled()
        if index == _PRESET:
            preset = self.number_at(_PRESET)
            self._offset += preset - self.number_at(_POSITION)
            self.put(_OFFSET, 0, self._offset)
            self.put(_POSITION, 0, preset)

    def set_health(self, healthy: bool) -> None:
        """Set whether the disc is readable; if not, freeze the position and report alarm and emergency."""
        if healthy != self._healthy:
            self._healthy = healthy
            self.put(_ALARMS, 0, 0 if healthy else _POSITION_ERROR)
            self.send_emergency(NO_ERROR if healthy else _HARDWARE_ERROR, 0 if healthy else 0x21)


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
