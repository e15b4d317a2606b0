"""The machine in its process, as the steps of commissioning see it: it is measured, and it swings."""

from __future__ import annotations

import os
import pickle
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection
from typing import Any, NamedTuple, cast

from bench.base.errors import BenchError, ExitCode
from bench.commissioning.machine.inputs import Act, Regulator
from bench.commissioning.machine.machine import MotionBounds, MotionTrace, Segment
from bench.commissioning.machine.machine_process import MachinePlan
from bench.commissioning.machine.machine_server import (
    ArmBench,
    LockGuard,
    MakePassive,
    Order,
    ReleaseGuard,
    Run,
    Swing,
    Vent,
    WatchInputs,
)
from bench.commissioning.machine.step import Mark
from bench.config import Configuration
from bench.simulation.loads import Loads
from bench.simulation.series import Bench, SeriesSwing
from bench.supervisor.child import Child
from bench.supervisor.ownership import Ownership
from bench.swing.profile import Profile
from drivers.base import Command, Readings

_START, _END = 120.0, 20.0
"""Timeouts of the process: ready, and robot at rest at its end (s)."""
_LOOK = 0.1
"""Period of polling the process for events, s."""


class MachineLost(BenchError):
    """The process that has the machine ended."""

    exit_code = ExitCode.DEVICE


class OperatorIO(NamedTuple):
    """Work at a robot by hand."""

    regulator: Regulator
    say: Callable[[str], None]
    """Says to a person what to do."""
    person: Callable[[], Mark | None] | None = None
    """Asks a person at the club for the ball's mark; None: no person is there."""
    look: Callable[[], Mark | None] = lambda: None
    """Reads the mark of a simulated ball."""
    act: Callable[[Act], None] = lambda act: None
    """Does something at the inputs, or says to a person what to do."""
    gauge: Callable[[], float] | None = None
    """Returns the reading of the gauge behind the regulator, Pa over the atmosphere; None: no person."""
    timeout: float = 60.0
    """Time for each act at the inputs, s."""


class LiveRobot:
    """A robot in real time: a CommissionedMachine and a SwungRobot."""

    def __init__(self, child: Child, connection: Connection, hands: OperatorIO) -> None:
        """Give orders to `child` by `connection`, with the `hands` of the person next to the robot."""
        self._child, self._connection = child, connection
        self._hands = hands
        self._number, self._time = 0, 0.0

    # A CommissionedMachine -----------------------------------------------------------------------------

    @property
    def time(self) -> float:
        """Time of the sequences run so far, s."""
        return self._time

    def set_supply(self, pressure: float) -> None:
        """Have the regulator turned to `pressure` (Pa absolute); infinite: as in service."""
        self._hands.regulator(pressure)

    def run(self, segments: tuple[Segment, ...], bounds: MotionBounds) -> MotionTrace:
        """Run `segments`; afterwards the last openings stay in force."""
        return self._trace(Run(segments, bounds))

    def watch(
        self, command: Command, before: Readings | None, air: float, settled: float, timeout: float
    ) -> Readings:
        """Hold `command` until the switches differ from `before`, and have rested for `settled` (s)."""
        return cast("Readings", self._order(WatchInputs(command, before, air, settled, timeout)))

    def vent(self, duration: float = 40.0) -> MotionTrace:
        """Be passive until chambers are empty and joints rest."""
        return self._trace(Vent(duration))

    def make_passive(self) -> None:
        """End what runs, and be passive; a process that is gone has left the machine passive."""
        with suppress(BenchError, OSError):
            self._order(MakePassive())

    # A SwungRobot --------------------------------------------------------------------------------------

    def series(self, bench: Bench) -> LiveRobot:
        """Arm `bench` on the robot."""
        self._order(ArmBench(bench))
        return self

    def swing(self, profile: Profile, *, ball: bool = True) -> SeriesSwing:
        """Swing `profile`, at a teed ball or without one, and come back to the address."""
        return cast("SeriesSwing", self._order(Swing(profile, ball)))

    def loads(self) -> Loads | None:
        """Return None: nothing measures them."""
        return None

    def face_mark(self, swing: SeriesSwing) -> Mark | None:
        """Return the mark that the ball of the last swing left on the face; None where it is not read.

        A person who reads it gets access to the club meanwhile.
        """
        if self._hands.person is None:
            return self._hands.look()
        self._order(ReleaseGuard())
        mark = self._hands.person()
        self._order(LockGuard())
        return mark

    # Orders --------------------------------------------------------------------------------------------

    def _trace(self, order: Order) -> MotionTrace:
        trace = cast("MotionTrace", self._order(order))
        if len(trace.time):
            self._time += float(trace.time[-1] - trace.time[0])
        return trace

    def _order(self, order: Order) -> object:
        """Give `order` and return its answer, or raise its error.

        Raises:
            MachineLost: the process ended.
        """
        self._number += 1
        try:
            self._connection.send((self._number, order))
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
            self._hear()
            if self._connection.poll(_LOOK):
                pieces = self._connection.recv()
                data = b"".join(self._connection.recv_bytes() for _ in range(pieces))
                number, done, answer = pickle.loads(data)  # noqa: S301 - of our own process
                if number == self._number:  # an earlier order was interrupted by this one
                    return done, answer
            elif not self._child.alive:
                raise EOFError

    def _hear(self) -> None:
        for event in self._child.take_events():
            if event["event"] == "say":
                self._hands.say(str(event.get("text", "")))


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
