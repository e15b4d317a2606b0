"""A CANopen driver on a pair of packet sockets in place of SocketCAN, with nodes of a few lines behind it."""

from __future__ import annotations

import ctypes
import socket
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np

from drivers.base import Command, Readings
from drivers.base.compiled import new_record
from drivers.base.native import DECLINED, NativeCall
from drivers.base.records import COMMAND, READINGS, pack_command, unpack_command, unpack_readings
from drivers.can_bus import FRAME
from drivers.canopen._link import SocketcanLink
from drivers.canopen.driver import CanopenDriver
from drivers.canopen.settings import CanopenSettings

PERIOD = 0.001
TIMEOUT = 20.0
SETTINGS = CanopenSettings(sync_timeout=0.15)
NODE = SETTINGS.valve_node.node
MOVING = Command((0.3, -0.2, 0.1), supply_enable=True, exhaust_closed=True, guard_lock=False, beacon=True)

Frames = Sequence[tuple[int, bytes] | bytes]
"""Identifiers with data, or frames as they are on the socket."""


class PairBus:
    """One end of a pair of sockets as the bus that python-can would open."""

    def __init__(self, end: socket.socket) -> None:
        self.socket = end

    def shutdown(self) -> None:
        self.socket.close()


class Nodes:
    """Answers every SYNC with `script` of its number, from 0 on; records all received frames."""

    def __init__(self, script: Callable[[int], Frames]) -> None:
        self.ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.bus, self._script = PairBus(theirs), script
        self.heard: list[bytes] = []
        self.answered = 0
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        with suppress(ConnectionResetError):  # closed with answers that nobody has read
            self._answer_all()

    def _answer_all(self) -> None:
        syncs = 0
        while whole := self.ours.recv(FRAME.size):
            self.heard.append(whole)
            if FRAME.unpack(whole)[0] == 0x80:
                for one in self._script(syncs):
                    self.ours.send(
                        one if isinstance(one, bytes) else FRAME.pack(one[0], len(one[1]), one[1][:8])
                    )
                syncs += 1
            self.answered += 1

    def wait_for_command(self, before: int) -> None:
        """Wait until a command follows the first `before` frames, and all frames are answered."""
        deadline = time.monotonic() + TIMEOUT
        while True:
            heard = list(self.heard)
            commanded = any(FRAME.unpack(whole)[0] == 0x200 + NODE for whole in heard[before:])
            if commanded and self.answered >= len(heard):
                return
            assert time.monotonic() < deadline, f"{heard[before:]} received, {self.answered} answered"
            time.sleep(0.0001)

    def end(self) -> None:
        self.ours.shutdown(socket.SHUT_RDWR)
        self._thread.join(TIMEOUT)
        self.ours.close()


class Started(CanopenDriver):
    """The driver with nodes that need no setting up."""

    def _begin(self) -> None:
        self._listening = True
        self._state["analogue_received"] = 0.0


def call(native: NativeCall, first: np.ndarray, second: np.ndarray | None, now: float) -> int:
    words = [ctypes.c_int64] * 4
    function = ctypes.CFUNCTYPE(*words, ctypes.c_double)(native.function)
    return int(function(native.block, first.ctypes.data, 0 if second is None else second.ctypes.data, now))


class Rig:
    """A driver on nodes; `native`: its ticks are compiled wherever they can be."""

    def __init__(
        self, script: Callable[[int], Frames], *, native: bool, settings: CanopenSettings = SETTINGS
    ) -> None:
        self.nodes = Nodes(script)
        self.driver = Started(
            settings,
            period=PERIOD,
            watchdog=0.1,
            open_bus=lambda *_: SocketcanLink(self.nodes.bus),  # type: ignore[arg-type]
        )
        self.calls = self.driver.native_calls() if native else None
        self.declined: list[tuple[int, str]] = []
        self.readings: list[Readings] = []
        self.applied: list[Command] = []
        self.ticks = self.sent = 0
        self.driver.open()

    def tick(self, command: Command = MOVING) -> None:
        now = 1000.0 + PERIOD * self.ticks
        self.readings.append(self._read(now))
        self.applied.append(self._write(command, now))
        self.ticks += 1

    def _read(self, now: float) -> Readings:
        record = new_record(READINGS)
        if self.calls and call(self.calls.read, record, None, now) != DECLINED:
            return unpack_readings(record)
        self.declined.append((self.ticks, "read"))
        return self.driver.read(now)

    def _write(self, command: Command, now: float) -> Command:
        given, applied = new_record(COMMAND), new_record(COMMAND)
        pack_command(command, given)
        if self.calls and call(self.calls.write, given, applied, now) != DECLINED:
            return unpack_command(applied)
        self.declined.append((self.ticks, "write"))
        return self.driver.write(command)

    def run(self, ticks: int, command: Callable[[int], Command] = lambda _: MOVING) -> None:
        """Run ticks, each after the nodes have received all frames of the previous one."""
        for _ in range(ticks):
            before = len(self.nodes.heard)
            self.tick(command(self.ticks))
            self.nodes.wait_for_command(before)

    def end(self) -> None:
        self.driver.close()
        self.nodes.end()


class Found(NamedTuple):
    """All that must be alike."""

    frames: list[bytes]
    readings: list[tuple[Any, ...]]
    applied: list[Command]
    counters: dict[str, int]
    fault: str


def found(rig: Rig) -> Found:
    readings = [
        one._replace(encoder_time=(0.0,) * 3, encoder_age=(0.0,) * 3)[0:]
        for one in map(canonical, rig.readings)
    ]
    return Found(list(rig.nodes.heard), readings, rig.applied, rig.driver.counters.counts(), rig.driver.fault)


def canonical(readings: Readings) -> Readings:
    """Return the readings with NaN as text, which equals itself."""
    parts = (readings.chamber_pressure, readings.vent_open, readings.spool_position)
    text: Any = [tuple(map(repr, part)) for part in parts]
    supply: Any = repr(readings.supply_pressure)
    shut_off: Any = repr(readings.shut_off_open)
    return readings._replace(
        chamber_pressure=text[0],
        vent_open=text[1],
        spool_position=text[2],
        shut_off_open=shut_off,
        supply_pressure=supply,
    )
