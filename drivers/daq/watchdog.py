"""The card's own watchdog: what the outputs become when the bench falls silent."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from drivers.base import DriverError

VOLTAGE_TOLERANCE = 0.02
"""V by which a fallback voltage may differ when it is read back: a step of 10 bits."""
_PATIENCE = 0.5
"""s that the watchdog may strike late in its trial."""
_POLL = 0.002
"""s."""


class CardWatchdog:
    """A watchdog timer task with the fallback states of all outputs, tried once before it is trusted.

    It must be made before the tasks of the outputs: a card whose outputs are in use gives its watchdog away
    no more. It stays committed, so that `start` takes no time.
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
            DriverError: it reads back other than set.
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
                    f"daq: {channel}: found a fallback of {volts:g} V ({kind.name}), expected {centre:g} V, "
                    "the spool's centre; use another channel or card, or fit an external watchdog relay and "
                    "name it in daq.watchdog_relay"
                )
        for line in lines:
            level = states[line].do_state
            if level != constants.Level.LOW:
                raise DriverError(
                    f"daq: {line}: found a fallback {level.name}, expected LOW, without energy; use "
                    "another line"
                )
        if abs(self._task.timeout - self._timeout) > 0.5 * self._timeout:
            raise DriverError(
                f"daq: watchdog: found {self._task.timeout:g} s, expected {self._timeout:g} s; change "
                "driver.watchdog to what the card can do"
            )

    def prove(self, clock: Callable[[], float], sleep: Callable[[float], None]) -> None:
        """Let the watchdog strike once, which leaves the outputs at their fallback.

        Raises:
            DriverError: it does not strike.
        """
        self._task.start()
        end = clock() + self._timeout + _PATIENCE
        while not self._task.expired:
            if clock() > end:
                raise DriverError(
                    f"daq: watchdog: found it asleep after {self._timeout + _PATIENCE:g} s of silence, "
                    f"expected it to strike after {self._timeout:g} s; use another card or fit an external "
                    "watchdog relay"
                )
            sleep(_POLL)
        self._task.clear_expiration()
        self._task.stop()

    def feed(self) -> bool:
        """Tell it that the bench lives; False when it has struck. The first call starts it."""
        if not self.running:
            self._task.start()
            self.running = True
        elif self._task.expired:
            return False
        else:
            self._task.reset_timer()
        return True

    def await_strike(self, clock: Callable[[], float], sleep: Callable[[float], None]) -> None:
        """Wait until it has struck, if it runs: when the outputs cannot be set passive by hand."""
        end = clock() + self._timeout + _PATIENCE
        while self.running and not self._task.expired and clock() < end:
            sleep(_POLL)

    def close(self) -> None:
        """Take it off the card. The outputs keep what they have."""
        self.running = False
        self._task.close()
