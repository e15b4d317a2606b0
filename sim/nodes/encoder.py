"""An absolute single-turn encoder (CiA 406) on a joint of the plant."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from sim.nodes.device import NO_ERROR, CanopenDevice, Send

_PRESET, _POSITION, _RESOLUTION, _REVOLUTIONS, _ALARMS, _OFFSET = (
    0x6003,
    0x6004,
    0x6501,
    0x6502,
    0x6503,
    0x6509,
)
_POSITION_ERROR = 0x0001
"""Alarm bit."""
_HARDWARE_ERROR = 0x5000
"""Emergency error code."""


class EncoderNode(CanopenDevice):
    """Encoder node; `count` returns the shaft position in counts, or None while the device hangs."""

    def __init__(
        self, number: int, eds: Path, send: Send, resolution: int, count: Callable[[], int | None]
    ) -> None:
        """Create the node; `resolution` in counts per revolution."""
        super().__init__(number, eds, send)
        self._resolution, self._count = resolution, count
        self._offset = 0
        self._healthy = True

    def boot(self, now: float) -> None:
        """Power up with the built-in resolution and the preset of the EDS."""
        self._offset, self._healthy = 0, True
        super().boot(now)
        self.put(_RESOLUTION, 0, self._resolution)
        self.sampled()

    def sampled(self) -> bool:
        """Sample the shaft."""
        count = self._count()
        if count is None:
            return False
        revolutions = self.number_at(_REVOLUTIONS)
        self.put(_POSITION, 0, (count + self._offset) % (self._resolution * revolutions))
        return True

    def written(self, index: int) -> None:
        """Shift the position to the preset value."""
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
