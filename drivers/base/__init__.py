"""The driver contract and the values that cross it; below, what drivers and the plant share.

Every Boolean is False when the wire is de-energised, except the guard lock: it is locked by its
spring, so `guard_lock = True` is the de-energised state and False energises the release.
A 0-10 V valve has its centre at 5 V: zero volts is full stroke, and no driver treats it as safe.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, runtime_checkable

if TYPE_CHECKING:
    import numpy as np

JOINTS = ("shoulder", "arm", "wrist")
"""Joint order everywhere: theta1 (shoulder), theta2 (left arm, moved by the right arm), theta3 (wrist)."""

ACTUATORS = ("shoulder vane", "right arm", "wrist cylinder")
"""Actuator order everywhere; actuator i moves joint i."""

CHAMBERS = tuple(f"{actuator} {side}" for actuator in ACTUATORS for side in ("A", "B"))
"""Chamber order everywhere; pressure in A drives the actuator coordinate up."""

ABSENT = float("nan")
"""A channel that is not fitted. Never zero: zero is a value."""

INVALID = float("inf")
"""A channel that is fitted and gives no believable value: cable cut, short circuit, device silent. It is no
smaller than any limit: code that only compares takes a chamber for full, not for empty."""

SPOOL_RANGE = -1.2, 1.2
"""Lowest and highest believable spool position; a cut cable reads less where the sensor has a live zero."""

Triple = tuple[float, float, float]


class Readings(NamedTuple):
    """One reading of all inputs, with validity and age travelling with the data.

    Encoder order is `JOINTS`. Times are seconds on the loop's clock.
    """

    time: float
    encoder_count: tuple[int, int, int]
    encoder_time: Triple
    encoder_valid: tuple[bool, bool, bool]
    encoder_age: Triple
    emergency_stop_clear: bool
    guard_closed: bool
    guard_locked: bool
    supply_pressure: float
    """Supply pressure (Pa absolute); ABSENT when not fitted, INVALID when not believable."""
    local_reset: bool
    ball_present: bool
    chamber_pressure: tuple[float, float, float, float, float, float]
    """Pressures in the order of CHAMBERS (Pa absolute); ABSENT when not fitted, INVALID when not
    believable."""
    encoder_indexed: tuple[bool, bool, bool] = (True, True, True)
    """The count is absolute. An incremental encoder's is once its index has passed, which zeroes it, until
    `Command.search_index` rises."""
    vent_open: tuple[float, float] = (ABSENT, ABSENT)
    """Feedback of the two vents: 1 open, 0 shut; ABSENT when not fitted, INVALID when not believable."""
    shut_off_open: float = ABSENT
    """Feedback of the shut-off valve before the manifold, as of a vent; shut it exhausts the manifold."""
    spool_position: Triple = (ABSENT, ABSENT, ABSENT)
    """Feedback of the spools, -1..1 with the sign of the command; ABSENT when not fitted, INVALID when not
    believable."""


class Command(NamedTuple):
    """One set of outputs. The default is the passive command: everything without energy."""

    valve: Triple = (0.0, 0.0, 0.0)
    """Valve commands -1..1; 0 is the centre (closed), +1 fills chamber A and exhausts B."""
    supply_enable: bool = False
    """True opens the soft-start supply valve, and the shut-off valve unless the guard's lock is released;
    False shuts both and exhausts the manifold."""
    exhaust_closed: bool = False
    """True closes both of the normally open chamber vents."""
    guard_lock: bool = True
    """True leaves the guard to its locking spring; False energises the release."""
    beacon: bool = False
    tee: bool = False
    """True raises the next ball onto the tee (rising edge)."""
    search_index: bool = False
    """True lets incremental encoders forget an index that has passed and wait for the next one (rising edge);
    one that has none yet continues to count."""


PASSIVE = Command()


class Launch(NamedTuple):
    """Start of a ball's flight, as a launch monitor measures it.

    `speed` m/s, `launch_angle` rad above the horizontal, `direction` rad (positive to the right of
    the target line), `spin` rad/s (total, >= 0), `spin_axis` rad (tilt of the spin axis from the
    horizontal; positive bends the ball to the right).
    """

    speed: float
    launch_angle: float
    direction: float = 0.0
    spin: float = 0.0
    spin_axis: float = 0.0


def believed(value: float, lowest: float, highest: float) -> float:
    """Return `value` if it lies between the two, else INVALID; NaN is INVALID."""
    return value if lowest <= value <= highest else INVALID


def device_limited(command: Command) -> Command:
    """Return `command` as a device applies it: valve commands within -1..1; PASSIVE if one is not finite."""
    if not all(map(math.isfinite, command.valve)):
        return PASSIVE
    a, b, c = command.valve
    return command._replace(valve=(max(-1.0, min(1.0, a)), max(-1.0, min(1.0, b)), max(-1.0, min(1.0, c))))


@runtime_checkable
class Driver(Protocol):
    """Interface between the loop and any hardware or its stand-in.

    Time is given: `read` and `write` get the loop's time and never read a clock.
    """

    @property
    def operational(self) -> bool:
        """False once the device has gone passive without a command; `close` and `open` restart it."""

    def open(self) -> None:
        """Make ready, read back the device's own fallback on silence; raise DriverError when unfit."""

    def read(self, time: float) -> Readings:
        """Return the newest readings at `time` (s); a lost channel is invalid, not an exception."""

    def write(self, command: Command) -> Command:
        """Apply `command` and return the one truly applied, after the device's limits."""

    def make_passive(self) -> None:
        """Centre the spools, shut the supply, open the vents. Never raises, allowed in any state."""

    def close(self) -> None:
        """Release the device. Allowed in any state, also twice."""


@runtime_checkable
class RecordReader(Protocol):
    """A driver whose readings are a record already; the loop takes them as such."""

    def read_record(self, time: float, record: np.ndarray[Any, Any]) -> None:
        """Write what `Driver.read` returns at `time` (s) into a READINGS record (a one-element array)."""


class DriverError(RuntimeError):
    """A driver cannot do its work; the text states device, finding, expectation and action."""


def check_open(is_open: bool, driver: str, call: str) -> None:
    """Raise DriverError if `driver` is not open at a `call` that needs it."""
    if not is_open:
        raise DriverError(f"{driver} driver: {call}() while closed; call open() first")


def check_time(time: float, earliest: float, driver: str) -> None:
    """Raise DriverError if the `time` (s) of a reading is not finite, or before the `earliest`."""
    if not (math.isfinite(time) and time >= earliest):
        raise invalid_time(time, earliest, driver)


def invalid_time(time: float, earliest: float, driver: str) -> DriverError:
    """Return the refusal of a reading of `driver` at `time` (s)."""
    return DriverError(
        f"{driver} driver: read() at invalid time {time} s, expected finite and at least {earliest} s; "
        "pass the loop's CLOCK_MONOTONIC"
    )
