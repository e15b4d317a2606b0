"""The package `nidaqmx`, and the card's watchdog: fallback states of the outputs of a silent bench."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from types import ModuleType
from typing import Any

from drivers.base import DriverError


def load_nidaqmx() -> ModuleType:
    """Return the package `nidaqmx`.

    Raises:
        DriverError: it is not installed.
    """
    try:
        import nidaqmx
        import nidaqmx.constants
        import nidaqmx.stream_readers
        import nidaqmx.stream_writers
        import nidaqmx.system
        import nidaqmx.system.watchdog
        import nidaqmx.types
    except ImportError as error:
        raise DriverError(
            f"daq driver: package nidaqmx is not installed ({error}); install the extra: "
            'pip install "golfbench[daq]"'
        ) from error
    return nidaqmx  # type: ignore[no-any-return]


def error_text(error: BaseException) -> str:
    """Return the message of NI's driver in one line, with its error code."""
    text: str = " ".join(str(error).split("\n\n")[0].split())
    code: Any = getattr(error, "error_code", None)
    return text if code is None else f"{text} ({code})"


VOLTAGE_TOLERANCE = 0.02
"""Tolerance of a fallback voltage read back, V: one step at 10 bits."""
_MARGIN = 0.5
"""Tolerated delay of the watchdog in its test, s."""
_POLL = 0.002
"""Polling period in the test, s."""


class CardWatchdog:
    """A watchdog timer task with the fallback states of all outputs, tested once before use.

    Create it before the tasks of the outputs: a card whose outputs are in use refuses to set up its watchdog.
    The task stays committed, so that `start` takes no time.
    """

    def __init__(
        self,
        nidaqmx: Any,
        device: str,
        timeout: float,
        valves: Sequence[tuple[str, float]],
        lines: Sequence[str],
    ) -> None:
        """Set the fallback: `valves` to their voltages, `lines` low, after `timeout` (s).

        Raises:
            nidaqmx.errors.Error: the card has no such watchdog.
            DriverError: a setting reads back differently.
        """
        self._timeout, self.running = timeout, False
        self._task = nidaqmx.system.watchdog.WatchdogTask(device, timeout=timeout)
        constants, types = nidaqmx.constants, nidaqmx.types
        try:
            volts = constants.WatchdogAOExpirState.VOLTAGE
            self._task.cfg_watchdog_ao_expir_states(
                [types.AOExpirationState(channel, centre, volts) for channel, centre in valves]
            )
            self._task.cfg_watchdog_do_expir_states(
                [types.DOExpirationState(line, constants.Level.LOW) for line in lines]
            )
            self._check(constants, valves, lines)
            self._task.control(constants.TaskMode.TASK_COMMIT)
        except BaseException:
            self._task.close()
            raise

    def _check(self, constants: Any, valves: Sequence[tuple[str, float]], lines: Sequence[str]) -> None:
        states = self._task.expiration_states
        for channel, centre in valves:
            kind, volts = states[channel].ao_output_type, states[channel].ao_state
            if kind != constants.WatchdogAOExpirState.VOLTAGE or abs(volts - centre) > VOLTAGE_TOLERANCE:
                raise DriverError(
                    f"daq: {channel}: found a fallback of {volts:g} V ({kind.name}), expected {centre:g} V "
                    "(spool centre); use another channel or card, or fit an external watchdog relay and "
                    "name it in daq.watchdog_relay"
                )
        for line in lines:
            level = states[line].do_state
            if level != constants.Level.LOW:
                raise DriverError(
                    f"daq: {line}: found a fallback {level.name}, expected LOW (de-energised); use "
                    "another line"
                )
        if abs(self._task.timeout - self._timeout) > 0.5 * self._timeout:
            raise DriverError(
                f"daq: watchdog: found {self._task.timeout:g} s, expected {self._timeout:g} s; set "
                "driver.watchdog to a time that the card supports"
            )

    def prove(self, clock: Callable[[], float], sleep: Callable[[float], None]) -> None:
        """Let the watchdog trip once, which leaves the outputs at their fallback.

        Raises:
            DriverError: it does not trip.
        """
        self._task.start()
        end = clock() + self._timeout + _MARGIN
        while not self._task.expired:
            if clock() > end:
                raise DriverError(
                    f"daq: watchdog: not tripped after {self._timeout + _MARGIN:g} s without a command, "
                    f"expected it to trip after {self._timeout:g} s; use another card or fit an external "
                    "watchdog relay"
                )
            sleep(_POLL)
        self._task.clear_expiration()
        self._task.stop()

    def feed(self) -> bool:
        """Reset the watchdog timer; return False if it has tripped. The first call starts the timer."""
        if not self.running:
            self._task.start()
            self.running = True
        elif self._task.expired:
            return False
        else:
            self._task.reset_timer()
        return True

    def await_strike(self, clock: Callable[[], float], sleep: Callable[[float], None]) -> None:
        """Wait until a running watchdog has tripped: used when the outputs cannot be set passive."""
        end = clock() + self._timeout + _MARGIN
        while self.running and not self._task.expired and clock() < end:
            sleep(_POLL)

    def close(self) -> None:
        """Release the watchdog. The outputs keep their state."""
        self.running = False
        self._task.close()
