"""A driver plug-in: valves that open half their stroke at most. A start for hardware of your own.

    .venv/bin/pip install --no-deps tests/examples/driver_plugin     # pyproject.toml names the entry point
    .venv/bin/golfbench run --driver half_stroke

Replace `self._device`, a robot without mass or air, by your hardware's library, and add the driver to
DRIVERS in tests/drivers/test_contract.py: that suite checks every promise of the contract.
"""

from __future__ import annotations

from drivers.base import PASSIVE, Command, Readings, device_limited
from drivers.mock import MockDriver

STROKE = 0.5
"""Largest valve opening that the device applies."""


class HalfStrokeDriver:
    """Driver of a device with half the stroke; implements `drivers.base.Driver`."""

    def __init__(self) -> None:
        self._device = MockDriver()

    @property
    def operational(self) -> bool:
        """False once the device has become passive automatically."""
        return self._device.operational

    def open(self) -> None:
        """Connect, and read back that the device centres its spools when the bench is silent."""
        self._device.open()

    def read(self, time: float) -> Readings:
        """Return the readings at `time` (s); a lost encoder is marked invalid, with its age."""
        return self._device.read(time)

    def write(self, command: Command) -> Command:
        """Send `command` within the device's limits and return the applied command."""
        limited = device_limited(command)  # PASSIVE if an opening is not finite
        a, b, c = (max(-STROKE, min(STROKE, opening)) for opening in limited.valve)
        return self._device.write(limited._replace(valve=(a, b, c)))

    def make_passive(self) -> None:
        """Centre the spools, shut the supply, open the vents. Never raises."""
        try:
            self._device.write(PASSIVE)
        except Exception:
            self._device.make_passive()  # the device's own way, when it does not answer

    def close(self) -> None:
        """Disconnect; allowed in any state, also twice."""
        self._device.close()
