"""The valve node: what takes the commands of a loop, and lets go of the valves when they stop coming.

It behaves as a CANopen node with a watchdog on its commands. After power-up it is passive. START with the
number of the next session sets it operational; its watchdog runs from the first command of that session on.
When no new command comes for the watchdog's time the node goes passive by itself and stays so until it is
started again: a later command alone does not revive it. Commands of another session, such as those of a loop
that was stopped and runs on after its successor took over, are not heard at all.
"""

from __future__ import annotations

from enum import IntEnum

from drivers.base import PASSIVE, Command, device_limited


class Mode(IntEnum):
    """What the node is to do with a command."""

    STOP = 0
    """Go passive, and obey nothing more in this session."""
    OPERATE = 1
    """Apply it."""
    START = 2
    """Begin the next session, passive at first."""


class ValveNode:
    """One node on the plant's own clock, which counts ticks."""

    def __init__(self, watchdog_ticks: int) -> None:
        self.watchdog_ticks = watchdog_ticks
        self.applied = PASSIVE
        """The command in force."""
        self.session = 0
        self.operational = False
        self.passive_by_watchdog = False
        self.trips = 0
        self.counter = 0
        """Of the command heard last."""
        self.command_tick = 0
        """When a command was obeyed last."""
        self.passive_tick = 0
        """When the watchdog struck last."""
        self._watched = False

    def hear(self, tick: int, counter: int, session: int, mode: int, command: Command) -> None:
        """Take what stands in the loop's record at `tick`; the same `counter` again is no new command."""
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
        """Go passive at `tick` when no command was heard for too long."""
        if self.operational and self._watched and tick - self.command_tick >= self.watchdog_ticks:
            self.operational, self.passive_by_watchdog = False, True
            self.applied, self.passive_tick = PASSIVE, tick
            self.trips += 1
