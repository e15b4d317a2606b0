"""The process that has the machine while it is commissioned, and its client, which the steps see.

`python -m bench.commissioning.machine.machine_process` takes a pickled MachinePlan on stdin. Orders to
MachineServer come numbered on the plan's connection, and each is answered with its number, whether it was
done, and its answer or exception. JSON lines on stdout:

`ready`   `real_time`
`failed`  `location`, `found`, `expected`, `action`, `exit_code`: it cannot work
`say`     `text`: a person is to do something

Whatever runs ends once another order waits, on SIGTERM, or when its parent is gone; the robot is then brought
to rest, and the machine passive.
"""

from __future__ import annotations

import os
import pickle
import select
import signal
import socket
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, cast

from bench.base.clock import GridClock, PacedClock
from bench.base.errors import BenchError, ExitCode, Refused
from bench.commissioning.machine._machine_server import MachineServer
from bench.commissioning.machine.commissioning_step import Mark
from bench.commissioning.machine.inputs import OperatorIO
from bench.commissioning.machine.machine import LoggedMotion, MotionBounds, MotionTrace, Segment
from bench.config import Configuration
from bench.simulation.safety import Loads
from bench.simulation.simulated_bench import Bench, SeriesSwing
from bench.supervisor.child_process import Child, Parent, read_plan, send_event, send_failure
from bench.supervisor.loop_process import configured_driver
from bench.supervisor.ownership import Ownership, adopt
from bench.supervisor.real_time import real_time
from bench.swing.profile import Profile
from drivers.base import Command, DriverError, Readings
from drivers.base.shared_memory import SharedMemoryError
from drivers.canopen.frames import MAX_LOAD, bus_load

_PRESSURE_TICKS = 2
"""Least ticks between two readings of the pressures; three missed ones are a lost sensor."""
_PIECE = 32 << 10
"""Bytes of an answer sent at once: a socket that is writable takes them without waiting."""
_START, _END = 120.0, 20.0
"""Timeouts of the process: ready, and robot at rest at its end (s)."""
_POLL_PERIOD = 0.1
"""Period of polling the process for events, s."""


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

        def ends() -> bool:
            """Whether the process shall end."""
            return parent.wants_end

        server = MachineServer(
            driver,
            c,
            clock,
            stop=lambda: ends() or connection.poll(),  # another order ends what runs
            say=lambda text: send_event("say", text=text),
            inputs_only=plan.inputs_only,
        )
        stack.callback(server.close)
        send_event("ready", real_time=granted)
        while not ends():
            if not connection.poll():
                server.hold()
                continue
            try:
                number, order, given = connection.recv()
            except EOFError:
                return
            _send(connection, (number, *_answer(server, order, given)), server, ends)


def _send(
    connection: Connection, message: tuple[int, bool, Any], server: MachineServer, ends: Callable[[], bool]
) -> None:
    """Send number, success and answer of an order as their reader takes them, ticks of `server` in between.

    The reader has no real-time priority: a tick that waits for it stops the robot.
    """
    data = pickle.dumps(message)
    pieces = range(0, len(data), _PIECE)
    connection.send(len(pieces))
    for begin in pieces:
        while not select.select((), (connection,), (), 0.0)[1]:
            if ends():
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


def _answer(server: MachineServer, order: str, given: tuple[Any, ...]) -> tuple[bool, Any]:
    """Return whether `order` was done with its arguments `given`, and its answer or error."""
    try:
        return True, server.obey(order, *given)
    except BenchError as error:
        return False, error
    except DriverError as error:
        action = "Look at the device and its link, then continue with --resume."
        return False, Refused("driver", str(error), "a device that works", action)


class MachineLost(BenchError):
    """The process that has the machine ended."""

    exit_code = ExitCode.DEVICE


class LiveRobot:
    """A robot in real time: a CommissionedMachine and a SwingSeries."""

    def __init__(self, child: Child, connection: Connection, hands: OperatorIO) -> None:
        """Give orders to `child` by `connection`, with the `hands` of the person next to the robot."""
        self._child, self._connection, self._hands = child, connection, hands
        self._number, self._time = 0, 0.0

    # A CommissionedMachine -----------------------------------------------------------------------------

    @property
    def time(self) -> float:
        """Time of the sequences run so far, s."""
        return self._time

    def set_supply(self, pressure: float) -> None:
        """Have the regulator turned to `pressure` (Pa absolute); infinite: as in service."""
        self._hands.regulator(pressure)

    def run(self, segments: tuple[Segment, ...], bounds: MotionBounds, doing: str = "") -> MotionTrace:
        """Run `segments`; afterwards the last openings stay in force. A line announces `doing`."""
        if doing:
            self._hands.say(f"Moves: {doing}.")
        return self._trace("run_logged", segments, bounds)

    def watch(
        self, command: Command, before: Readings | None, air: float, settled: float, timeout: float
    ) -> Readings:
        """Hold `command` until the switches differ from `before`, and have rested for `settled` (s)."""
        return cast("Readings", self._order("watch", command, before, air, settled, timeout))

    def vent(self, duration: float = 40.0) -> MotionTrace:
        """Be passive until chambers are empty and joints rest."""
        return self._trace("vent_logged", duration)

    def may_move(self) -> bool:
        """Return whether a fitted local reset was pressed since guard or emergency stop last opened."""
        return bool(self._order("may_move"))

    def make_passive(self) -> None:
        """End what runs, and be passive; a process that is gone has left the machine passive."""
        with suppress(BenchError, OSError):
            self._order("make_passive")

    # A SwingSeries -------------------------------------------------------------------------------------

    def series(self, bench: Bench) -> LiveRobot:
        """Arm `bench` on the robot."""
        self._order("arm", bench)
        return self

    def swing(self, profile: Profile, *, ball: bool = True) -> SeriesSwing:
        """Swing `profile`, at a teed ball or without one, and come back to the address."""
        return cast("SeriesSwing", self._order("swing", profile, ball))

    def loads(self) -> Loads | None:
        """Return None: nothing measures them."""
        return None

    def face_mark(self, swing: SeriesSwing) -> Mark | None:
        """Return the mark that the ball of the last swing left on the face; None where it is not read.

        A person who reads it gets access to the club meanwhile, and opens the supply again.
        """
        if self._hands.person is None:
            return self._hands.look()
        self._order("release_guard")
        mark = self._hands.person()
        self._order("lock_guard")
        self._hands.confirm("Unlock and open the supply, turn the regulator to its pressure in service")
        return mark

    # Orders --------------------------------------------------------------------------------------------

    def _trace(self, order: str, *given: object) -> MotionTrace:
        trace = cast("LoggedMotion", self._order(order, *given)).trace()
        if len(trace.time):
            self._time += float(trace.time[-1] - trace.time[0])
        return trace

    def _order(self, order: str, *given: object) -> object:
        """Return the server's answer to `order`, or raise its error.

        Raises:
            MachineLost: the process ended.
        """
        self._number += 1
        try:
            self._connection.send((self._number, order, given))
            done, answer = self._answer()
        except (EOFError, OSError):
            found = self._child.ending or "closed its connection"
            action = "See its output above; the device is passive. Continue with --resume."
            raise MachineLost("the machine's process", f"it {found}", "an answer", action) from None
        if not done:
            raise answer
        return answer

    def _answer(self) -> tuple[bool, Any]:
        """Return whether the last order was done, and its answer or error; EOFError if none comes."""
        while True:
            for event in self._child.take_events():
                if event["event"] == "say":
                    self._hands.say(str(event.get("text", "")))
            if self._connection.poll(_POLL_PERIOD):
                pieces = self._connection.recv()
                data = b"".join(self._connection.recv_bytes() for _ in range(pieces))
                number, done, answer = pickle.loads(data)  # noqa: S301 - of our own process
                if number == self._number:  # an earlier order was interrupted by this one
                    return done, answer
            elif not self._child.alive:
                raise EOFError


@contextmanager
def live_robot(
    configuration: Configuration,
    owner: Ownership,
    hands: OperatorIO,
    truth: Configuration | None = None,
    *,
    inputs_only: bool = False,
) -> Iterator[LiveRobot]:
    """Start the process that has the machine of the bench owned by `owner`; at the end the robot rests.

    `truth` has the robot that really moves, with its faults, where it is simulated. `inputs_only`: its inputs
    are watched, and nothing else is done.

    Raises:
        BenchError: it does not start, and why.
    """
    ours, its = socket.socketpair()
    with ours, its:
        os.set_inheritable(its.fileno(), True)
        plan = MachinePlan(
            configuration, owner.folder, owner.descriptor, its.fileno(), truth or configuration, inputs_only
        )
        child = Child.start(
            "machine",
            "bench.commissioning.machine.machine_process",
            plan,
            pass_fds=(owner.descriptor, its.fileno()),
        )
        its.close()
        try:
            owner.note_loop(child.pid)
            child.wait_until_ready(_START)
            with Connection(os.dup(ours.fileno())) as connection:
                yield LiveRobot(child, connection, hands)
        finally:
            child.end(_END)


def main() -> int:
    """Serve the machine of the plan on stdin; return the exit code."""
    parent = Parent()
    plan: Any = read_plan()
    parent.listen()
    signal.signal(signal.SIGTSTP, signal.SIG_DFL)  # stopped with its parent: the watchdog makes it passive
    try:
        serve(plan, parent)
    except (BenchError, SharedMemoryError, DriverError) as error:
        return send_failure(error)
    except (BrokenPipeError, ConnectionResetError):
        return 0  # the parent is gone; the machine is passive
    return 0


if __name__ == "__main__":
    sys.exit(main())
