"""A tick of the CANopen driver on a packet socket: compiled beside in Python, with real frames and waits.

Nodes in a process of their own answer each SYNC on a pair of packet sockets, which stand for SocketCAN: a
system call a frame and a wait for the answers, but no controller. Blocks of both ways in turn, at 1 kHz.
Processor time of the driver's thread counts; "system calls" is that of the calls alone, made from Python
without any driver.
"""

from __future__ import annotations

import gc
import os
import select
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from statistics import median

from drivers.base import Command
from drivers.canopen.driver import CanopenDriver
from drivers.canopen.frames import frame
from drivers.canopen.link import SocketcanLink
from drivers.canopen.settings import CanopenSettings
from tests.benchmarks.native_caller import NativeCaller
from tests.benchmarks.row import Row

PERIOD, BLOCK, ROUNDS = 0.001, 500, 6
COMMAND = Command((0.1, -0.1, 0.2), beacon=True)
PROMISED = 10.0
"""us of Python in a tick."""
_TITLE = "a tick on a packet socket"
_NODES = """
import os, socket, sys
from contextlib import suppress
from drivers.canopen.frames import frame
ours = socket.socket(fileno=int(sys.argv[1]))
answers = [frame(0x280 + node, bytes([7, node, 1, 0])) for node in (1, 2, 3)]
kept = [frame(0x700 + node, b"\\x05") for node in (1, 2, 3, 10)] + [frame(0x18A, b"\\x0f")]
number = 0
with suppress(PermissionError):
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(79))
while whole := ours.recv(16):
    if whole[:2] == b"\\x80\\x00":
        for answer in answers:
            ours.send(answer)
        number += 1
        if number % 20 == 0:
            for one in kept:
                ours.send(one)
"""


class _Started(CanopenDriver):
    """The driver with nodes that need no setting up."""

    def _begin(self) -> None:
        self._listening, self._states = True, [5] * 4
        self._pressures_received = [float("-inf")] * len(self._pressure_groups)


class _Bus:
    def __init__(self, end: socket.socket) -> None:
        self.socket = end

    def shutdown(self) -> None:
        self.socket.close()


@contextmanager
def _nodes() -> Iterator[socket.socket]:
    """Yield the driver's end of a pair of sockets with answering nodes behind the other."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    process = subprocess.Popen(
        [sys.executable, "-c", _NODES, str(theirs.fileno())], pass_fds=[theirs.fileno()]
    )
    theirs.close()
    try:
        ours.send(frame(0x80))
        ours.settimeout(30.0)
        for _ in range(3):
            ours.recv(16)
        ours.settimeout(None)
        yield ours
    finally:
        ours.close()
        process.wait(10.0)


def _driver(end: socket.socket) -> CanopenDriver:
    settings = CanopenSettings(answer_time=0.005)
    link = SocketcanLink(_Bus(end))  # type: ignore[arg-type]
    driver = _Started(settings, period=PERIOD, watchdog=0.1, open_bus=lambda *_: link)
    driver.open()
    return driver


def _bare(end: socket.socket) -> Callable[[float], None]:
    """Return the system calls of a tick in Python, without a driver."""
    sync, command = frame(0x80), frame(0x20A, bytes(7))

    def tick(_: float) -> None:
        try:
            end.recv(16, socket.MSG_DONTWAIT)
        except BlockingIOError:
            pass
        end.send(sync, socket.MSG_DONTWAIT)
        for _ in range(3):
            select.select([end], (), (), 0.005)
            end.recv(16, socket.MSG_DONTWAIT)
        end.send(command, socket.MSG_DONTWAIT)

    return tick


def run() -> list[Row]:
    """Measure; about fifteen seconds."""
    with ExitStack() as stack:
        python = _driver(stack.enter_context(_nodes()))
        compiled = _driver(stack.enter_context(_nodes()))
        caller = NativeCaller(compiled)

        def in_python(now: float) -> None:
            python.read(now)
            python.write(COMMAND)

        def in_compiled_code(now: float) -> None:
            if caller.read_record(now) is None:
                compiled.read(now)
                caller.declined += 1
            caller.write(COMMAND)

        ways = {"in Python": in_python, "compiled": in_compiled_code}
        times = _measure(ways)
        declined, missing = caller.declined, compiled.counters.missing + python.counters.missing
        for driver in (python, compiled):
            if driver.trouble:
                raise RuntimeError(driver.trouble)
            driver.close()
        times |= _measure({"system calls": _bare(stack.enter_context(_nodes()))})
    rows = [
        Row(
            _TITLE, f"{name}, processor", median(spent), "us", f"{len(spent)} ticks at 1 kHz, a call each way"
        )
        for name, spent in times.items()
    ]
    ratio = median(times["compiled"]) / median(times["in Python"])
    share = median(times["compiled"]) - median(times["system calls"])
    rows.append(Row(_TITLE, "compiled over Python", ratio, "", "same run, blocks in turn"))
    rows.append(Row(_TITLE, "calls left to Python", declined, f"of {2 * (BLOCK * ROUNDS + 50)}"))
    rows.append(Row(_TITLE, "samples missing", missing, f"of {6 * (BLOCK * ROUNDS + 50)}"))
    note = "the calls' own and ctypes' included; in the loop the tick is one call"
    rows.append(Row(_TITLE, "compiled, beyond system calls", share, "us", note, at_most=PROMISED))
    return rows


def _measure(ways: Mapping[str, Callable[[float], None]]) -> dict[str, list[float]]:
    """Return the processor times (us) of the ticks of each way, in blocks in turn."""
    times: dict[str, list[float]] = {name: [] for name in ways}
    policy, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(80))
    except PermissionError:
        pass
    gc.collect()
    gc.disable()
    try:
        for round_ in range(ROUNDS + 1):
            for name, tick in ways.items():
                start = time.monotonic() + PERIOD
                for k in range(BLOCK if round_ else 50):
                    while (early := start + k * PERIOD - time.monotonic()) > 0.0:
                        time.sleep(early)
                    used = time.thread_time_ns()
                    tick(time.monotonic())
                    if round_:
                        times[name].append(1e-3 * (time.thread_time_ns() - used))
    finally:
        gc.enable()
        os.sched_setscheduler(0, policy, parameters)
    return times
