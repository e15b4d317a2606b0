"""The process that has the machine while it is commissioned: driver and ticks, and orders from a pipe.

`python -m bench.commissioning.machine.machine_process` takes a pickled MachinePlan on stdin. Orders come
numbered on the plan's connection, and each is answered with its number, whether it was done, and its answer
or exception. JSON lines on stdout:

`ready`   `real_time`
`failed`  `location`, `found`, `expected`, `action`, `exit_code`: it cannot work
`say`     `text`: a person is to do something

Whatever runs ends once another order waits, on SIGTERM, or when its parent is gone; the robot is then brought
to rest, and the machine passive.
"""

from __future__ import annotations

import pickle
import select
import sys
from contextlib import ExitStack
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from bench.base.clock import GridClock, PacedClock
from bench.base.errors import BenchError, Refused
from bench.commissioning.machine.machine_server import MachineServer, Order
from bench.config import Configuration
from bench.supervisor.child_process import Parent, read_plan, send_event, send_failure
from bench.supervisor.loop_process import configured_driver
from bench.supervisor.ownership import adopt
from bench.supervisor.real_time import real_time
from drivers.base import DriverError
from drivers.base.shared_memory import SharedMemoryError
from drivers.canopen.frames import MAX_LOAD, bus_load

_PRESSURE_TICKS = 2
"""Least ticks between two readings of the pressures; three missed ones are a lost sensor."""
_PIECE = 32 << 10
"""Bytes of an answer sent at once: a socket that is writable takes them without waiting."""


@dataclass(frozen=True)
class MachinePlan:
    """Parameters of the process."""

    configuration: Configuration
    folder: Path
    """Shared-memory folder of the bench."""
    lock: int
    """Inherited descriptor of its locked file."""
    connection: int
    """Inherited descriptor of the connection."""
    truth: Configuration
    """Has the robot that really moves, with its faults, where it is simulated."""
    inputs_only: bool = False
    """Whether only its inputs are watched."""


class _Interruption:
    """Whether what runs shall end: another order waits, or the process shall end."""

    def __init__(self, connection: Connection, parent: Parent) -> None:
        self._connection, self._parent = connection, parent

    def __call__(self) -> bool:
        return self.ends or self._connection.poll()

    @property
    def ends(self) -> bool:
        """Whether the process shall end."""
        return self._parent.gone or self._parent.stop_requested


def serve(plan: MachinePlan, parent: Parent) -> None:
    """Obey orders until the connection ends or the parent is gone.

    Raises:
        BenchError: real time is required and not granted, or the machine may not move.
        DriverError: the device is unsuitable.
    """
    c = with_quick_pressures(plan.configuration)
    with ExitStack() as stack:
        stack.enter_context(adopt(plan.lock))
        connection = stack.enter_context(Connection(plan.connection))
        moving = replace(c, plant=plan.truth.plant, faults=plan.truth.faults)
        driver = configured_driver(moving, plan.folder)
        granted = stack.enter_context(real_time(c.loop.realtime, priority=c.loop.priority, cpu=c.loop.cpu))
        period = 1.0 / c.loop.rate
        clock = PacedClock(period) if c.driver.paced else GridClock(round(1e9 * period))
        interrupted = _Interruption(connection, parent)
        server = MachineServer(
            driver,
            c,
            clock,
            stop=interrupted,
            say=lambda text: send_event("say", text=text),
            inputs_only=plan.inputs_only,
        )
        stack.callback(server.close)
        send_event("ready", real_time=granted.as_json())
        while not interrupted.ends:
            if not connection.poll():
                server.hold()
                continue
            try:
                number, order = connection.recv()
            except EOFError:
                return
            _send(connection, (number, *_answer(server, order)), server, interrupted)


def _send(
    connection: Connection, message: tuple[int, bool, Any], server: MachineServer, interrupted: _Interruption
) -> None:
    """Send number, success and answer of an order as their reader takes them, ticks of `server` in between.

    The reader has no real-time priority: a tick that waits for it stops the robot.
    """
    data = pickle.dumps(message)
    pieces = range(0, len(data), _PIECE)
    connection.send(len(pieces))
    for begin in pieces:
        while not select.select((), (connection,), (), 0.0)[1]:
            if interrupted.ends:
                return
            server.hold()
        connection.send_bytes(data[begin : begin + _PIECE])
        server.hold()


def with_quick_pressures(c: Configuration) -> Configuration:
    """Return `c` with pressures read in every second tick, or as often as the bus carries.

    The air's answers to steps are over in milliseconds.
    """
    if c.driver.name != "canopen":
        return c
    for ticks in range(_PRESSURE_TICKS, c.canopen.pressure_ticks):
        canopen = replace(c.canopen, pressure_ticks=ticks)
        if bus_load(canopen, 1.0 / c.loop.rate, c.driver.watchdog) <= MAX_LOAD:
            return replace(c, canopen=canopen)
    return c


def _answer(server: MachineServer, order: Order) -> tuple[bool, Any]:
    """Return whether `order` was done, and its answer or error."""
    try:
        return True, server.obey(order)
    except BenchError as error:
        return False, error
    except DriverError as error:
        action = "Look at the device and its link, then continue with --resume."
        return False, Refused("driver", str(error), "a device that works", action)


def main() -> int:
    """Serve the machine of the plan on stdin; return the exit code."""
    parent = Parent()
    plan: Any = read_plan()
    parent.listen()
    try:
        serve(plan, parent)
    except (BenchError, SharedMemoryError, DriverError) as error:
        return send_failure(error)
    except (BrokenPipeError, ConnectionResetError):
        return 0  # the parent is gone; the machine is passive
    return 0


if __name__ == "__main__":
    sys.exit(main())
