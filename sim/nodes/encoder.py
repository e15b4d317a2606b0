"""An absolute single-turn encoder (CiA 406) on a joint of the plant."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from sim.nodes.device import NO_ERROR, CanopenDevice, Send
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
    """Encoder node; `count` returns the shaft position in counts, or None while the device hangs."""

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
