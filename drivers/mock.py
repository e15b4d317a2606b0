"""A driver without a device: the joints' state follows the command at once.

A valve opening is a joint speed, `full_speed` at opening 1, as long as the supply is on and the vents are
closed; the joints stop at their end stops. No mass, no air, no noise: the same calls give the
same readings, bit for bit. It exercises the cycle and the lifecycle, not the control.

The public attributes of `MockDriver` are its surroundings: a test sets them to press the e-stop, open
the guard, press the local reset, disconnect an encoder or remove the ball.
"""

from __future__ import annotations

import math

from drivers.base import (
    ABSENT,
    PASSIVE,
    Command,
    DriverError,
    Readings,
    Triple,
    check_open,
    check_time,
    device_limited,
)

ATMOSPHERE = 101_325.0
"""Atmospheric pressure (Pa)."""

Travel = tuple[tuple[float, float], tuple[float, float], tuple[float, float]]


class MockDriver:
    """Driver without hardware; angles in rad, speeds in rad/s, pressures in Pa absolute."""

    def __init__(
        self,
        *,
        counts_per_revolution: int = 2**17,
        start: Triple = (0.0, 4.0, 6.0),
        travel: Travel = ((-2.5, 2.5), (math.pi, 1.5 * math.pi), (4.8, 2.0 * math.pi)),
        full_speed: Triple = (12.0, 10.0, 30.0),
        supply_pressure: float = 800_000.0,
    ) -> None:
        self.emergency_stop_clear = True
        self.guard_closed = True
        self.local_reset = False
        self.ball_present = False
        self.encoder_valid = (True, True, True)
        self.applied = PASSIVE
        """The command in force."""
        self._counts_per_revolution = counts_per_revolution
        self._angle = start
        self._travel = travel
        self._full_speed = full_speed
        self._supply_pressure = supply_pressure
        self._encoder_time: Triple = (ABSENT, ABSENT, ABSENT)
        self._encoder_count = (0, 0, 0)
        self._time: float | None = None
        self._is_open = False

    @property
    def operational(self) -> bool:
        """Always true: there is no device that could go passive."""
        return True

    def open(self) -> None:
        """Start with the passive command; DriverError if already open."""
        if self._is_open:
            raise DriverError("mock driver: open() while already open; call close() first")
        self.applied = PASSIVE
        self._time = None
        self._is_open = True

    def read(self, time: float) -> Readings:
        """Advance the joints to `time` (s) and return the readings.

        Raises:
            DriverError: not open, or `time` is not finite or earlier than the last.
        """
        check_open(self._is_open, "mock", "read")
        before = time if self._time is None else self._time
        check_time(time, before, "mock")
        self._move(time - before)
        self._time = time
        self._sample(time)
        ages = tuple(time - sampled for sampled in self._encoder_time)
        return Readings(
            time=time,
            encoder_count=self._encoder_count,
            encoder_time=self._encoder_time,
            encoder_valid=self.encoder_valid,
            encoder_age=(ages[0], ages[1], ages[2]),
            emergency_stop_clear=self.emergency_stop_clear,
            guard_closed=self.guard_closed,
            guard_locked=self.guard_closed and self.applied.guard_lock,
            supply_pressure=self._supply_pressure if self.applied.supply_enable else ATMOSPHERE,
            local_reset=self.local_reset,
            ball_present=self.ball_present,
            chamber_pressure=(ABSENT,) * 6,
        )

    def write(self, command: Command) -> Command:
        """Apply `command` within the device's limits and return the applied one.

        Raises:
            DriverError: not open.
        """
        check_open(self._is_open, "mock", "write")
        applied = device_limited(command)
        if applied.tee and not self.applied.tee:
            self.ball_present = True
        self.applied = applied
        return applied

    def make_passive(self) -> None:
        """Apply the passive command, in any state."""
        self.applied = PASSIVE

    def close(self) -> None:
        """Leave the device passive and closed, in any state."""
        self.make_passive()
        self._is_open = False

    def _move(self, duration: float) -> None:
        """Turn the joints for `duration` (s) at the commanded speeds, within their end stops."""
        if not (self.applied.supply_enable and self.applied.exhaust_closed):
            return
        first, second, third = (
            max(low, min(high, angle + duration * opening * speed))
            for angle, opening, speed, (low, high) in zip(
                self._angle, self.applied.valve, self._full_speed, self._travel, strict=True
            )
        )
        self._angle = (first, second, third)

    def _sample(self, time: float) -> None:
        """Sample each valid encoder; an invalid one keeps its last count and time."""
        per_radian = self._counts_per_revolution / (2.0 * math.pi)
        counts = list(self._encoder_count)
        times = list(self._encoder_time)
        for joint, valid in enumerate(self.encoder_valid):
            if valid:
                counts[joint] = round(self._angle[joint] * per_radian) % self._counts_per_revolution
                times[joint] = time
        self._encoder_count = (counts[0], counts[1], counts[2])
        self._encoder_time = (times[0], times[1], times[2])
