"""The valve node: applies the commands of a loop and goes passive when they stop.

It behaves as a CANopen node with a watchdog on its commands. After power-up it is passive. START with the
number of the next session sets it operational; its watchdog runs from the first command of that session on.
Without a new command for the watchdog time the node goes passive and stays so until it is restarted: a later
command alone does not reactivate it. Commands of another session, such as those of a stopped loop that
resumes after its successor took over, are ignored.
"""

from __future__ import annotations

from enum import IntEnum

from drivers.base import PASSIVE, Command, device_limited


class Mode(IntEnum):
    """Action requested with a command."""

    STOP = 0
    """Go passive and ignore further commands of this session."""
    OPERATE = 1
    """Apply the command."""
    START = 2
    """Start the next session, initially passive."""


class ValveNode:
    """One node on the plant's own clock, which counts ticks."""

    def __init__(self, watchdog_ticks: int) -> None:
        self.watchdog_ticks = watchdog_ticks
        self.applied = PASSIVE
        """Command in force."""
        self.session = 0
        self.operational = False
        self.passive_by_watchdog = False
        self.trips = 0
        self.counter = 0
        """Counter of the last command received."""
        self.command_tick = 0
        """Tick of the last applied command."""
        self.passive_tick = 0
        """Tick of the last watchdog trip."""
        self._watched = False

    def receive(self, tick: int, counter: int, session: int, mode: int, command: Command) -> None:
        """Process the loop's command record at `tick`; an unchanged `counter` is not a new command."""
        if counter == self.counter:
            return
        if mode == Mode.START:
            if session != self.session + 1:
                return
            self.session = session
            self.operational, self.passive_by_watchdog, self._watched = True, False, False
            self.applied = PASSIVE
            self.command_tick = tick
        elif session != self.session:
            return
        elif mode != Mode.OPERATE:
            self.operational, self.applied = False, PASSIVE
        elif self.operational:
            self.applied, self.command_tick, self._watched = device_limited(command), tick, True
        self.counter = counter

    def watch(self, tick: int) -> None:
        """Go passive at `tick` if no command was received within the watchdog time."""
        if self.operational and self._watched and tick - self.command_tick >= self.watchdog_ticks:
            self.operational, self.passive_by_watchdog = False, True
            self.applied, self.passive_tick = PASSIVE, tick
            self.trips += 1
