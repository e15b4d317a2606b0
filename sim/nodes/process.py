"""Process of the simulated CANopen nodes around the plant, in real time, on any CAN bus.

Three encoders (CiA 406) and a node of valves and interlocks (CiA 401) as described by their EDS files. A SYNC
samples the shafts at that instant: the plant's last tick, extrapolated with its speed. Frames that waited
while this process stood still are taken at their own time, the plant's ticks in between. Operator actions and
faults come from `sim.exchange`; the plant reports as in `sim.exchange`.

`python -m sim.nodes.process` takes a pickled NodesPlan on stdin and reports "ready", "failed" or "stopped"
as a JSON line on stdout. It ends on SIGTERM, or when its parent is gone.
"""

from __future__ import annotations

import ctypes
import errno
import gc
import json
import os
import pickle
import signal
import sys
import time
from collections.abc import Callable
from contextlib import closing, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any

import can
import numpy as np

from drivers.base import Command
from drivers.base.clocks import WallOffset
from drivers.base.compiled import new_record
from drivers.base.records import unpack_readings
from drivers.base.shared_memory import SharedMemoryError
from sim.exchange import PLANT_SURROUNDINGS, PlantFiles, undisturbed
from sim.nodes._device import OPERATIONAL, SYNC, CanopenDevice
from sim.nodes._profile_nodes import EncoderNode, ValveNode401
from sim.nodes.wall_plant import NodesPlan, WallGrid, WallPlant

EDS = Path(__file__).resolve().parents[2] / "drivers" / "canopen"
"""Folder of the EDS files."""

_POLL_PERIOD = 0.02
"""Polling period of signals, parent and files, s."""
_RETRY_PERIOD = 0.5
"""Time between two attempts to reopen an interface, s."""
_MAX_EXTRAPOLATION = 0.005
"""Max extrapolation of a stalled plant, s."""
_MAX_AGE = 0.1
"""Max age of a frame by its time stamp, s; more is a system clock that was set."""
_LEAD, _PULL, _MAX_PULL = 0.3, 0.05, 20e-6
"""Synchronisation of the plant's ticks to shortly before the SYNCs, so that little is extrapolated: lead as a
share of a tick, correction per SYNC as a share of the deviation, and max correction per SYNC (s)."""
_FRAMES_AT_ONCE = 64
"""Max frames processed between two ticks of the plant: a babbling participant does not stop it."""
_MCL_CURRENT, _MCL_FUTURE = 1, 2
_PR_SET_TIMERSLACK, _PR_SET_THP_DISABLE = 29, 41
_GONE = frozenset({errno.ENODEV, errno.ENXIO, errno.EBADF})


class NodeBus:
    """Bus access of the nodes: unsendable frames are dropped, a lost interface is reopened."""

    def __init__(self, plan: NodesPlan) -> None:
        """Open the interface.

        Raises:
            OSError, can.CanError: the interface cannot be opened.
        """
        self._settings = {"interface": plan.interface, "channel": plan.channel, "bitrate": plan.bitrate}
        self._bus: can.BusABC | None = self._open()
        self._closed_at = 0.0
        self.unsent = 0

    def _open(self) -> can.BusABC:
        return can.Bus(**self._settings)  # type: ignore[arg-type]

    def send(self, identifier: int, data: bytes) -> None:
        """Send a data frame, or count it as unsent."""
        try:
            if self._bus is None:
                self.unsent += 1
            else:
                self._bus.send(can.Message(arbitration_id=identifier, is_extended_id=False, data=data))
        except can.CanError as error:
            self.unsent += 1
            self._note(error)

    def receive(self, timeout: float) -> can.Message | None:
        """Return the next frame, or None after `timeout` s."""
        if self._bus is None:
            time.sleep(min(timeout, _POLL_PERIOD))
            return None
        try:
            return self._bus.recv(timeout)
        except can.CanError as error:
            self._note(error)
            return None

    def reopen_if_closed(self, now: float) -> None:
        """Try to reopen a lost interface, every _RETRY_PERIOD."""
        if self._bus is None and now - self._closed_at > _RETRY_PERIOD:
            self._closed_at = now
            with suppress(OSError, can.CanError):
                self._bus = self._open()

    def close(self) -> None:
        """Close the interface. May be called twice."""
        if self._bus is not None:
            self._bus.shutdown()
            self._bus = None

    def _note(self, error: can.CanError) -> None:
        if error.error_code in _GONE:
            self.close()


class BenchNodes:
    """The devices around the plant, without clock and bus."""

    def __init__(self, plan: NodesPlan, send: Callable[[int, bytes], None]) -> None:
        """Start vented and unpowered; ValueError if the plan is invalid."""
        # A SYNC latches the count at its own time, without the latency and jitter of a polled encoder.
        encoders = replace(plan.plant.encoders, latency=0.0, jitter=0.0)
        self.plant = plant = WallPlant(replace(plan, plant=replace(plan.plant, encoders=encoders)))

        def speak(identifier: int, data: bytes) -> None:
            if plant.link_up:
                send(identifier, data)

        self._tick, resolution = plan.plant.tick, encoders.counts_per_revolution
        self._now = self.instant = 0.0
        """`instant` is the end of the plant's last tick, s."""
        self._frozen = False
        self._scale: list[float] = self.plant.plant.plant["encoder_scale"][0].tolist()
        self._speed = [0.0, 0.0, 0.0]
        self._acceleration = [0.0, 0.0, 0.0]
        self.readings = unpack_readings(plant.report["readings"])
        self.encoders = [
            EncoderNode(
                number,
                EDS / "encoder.eds",
                speak,
                resolution,
                partial(self._count, joint),
                plan.encoder_personality,
            )
            for joint, number in enumerate(plan.encoders)
        ]
        self.valve_node = ValveNode401(
            plan.valve_node, EDS / "valve_node.eds", speak, self._obey, plan.io_personality
        )
        self.devices: list[CanopenDevice] = [*self.encoders, self.valve_node]

    def boot(self, now: float) -> None:
        """Power up all devices at `now` (s)."""
        self._now = self.instant = now
        for device in self.devices:
            device.boot(now)
        self.valve_node.sense(self.readings)

    def receive(self, identifier: int, data: bytes, now: float) -> None:
        """Pass a frame to all devices."""
        self._now = now
        if not self.plant.link_up:
            return
        for device in self.devices:
            device.receive(identifier, data, now)

    def set_surroundings(self, record: np.ndarray[Any, Any]) -> None:
        """Apply a PLANT_SURROUNDINGS record."""
        self.plant.set_surroundings(record)
        self._frozen = bool(record["frozen"][0])

    def move(self, instant: float) -> None:
        """Advance the plant by one tick, which ends at `instant` (s)."""
        contacts, before = self.plant.contacts, self._speed
        self.plant.move(instant)
        self.instant, self._speed = instant, self.plant.state["speed"][0].tolist()
        # Over a blow the change of speed is no acceleration that lasts.
        period = self._tick if self.plant.contacts == contacts else np.inf
        self._acceleration = [(now - then) / period for now, then in zip(self._speed, before, strict=True)]

    def catch_up(self, grid: WallGrid, offset: float, now: float) -> None:
        """Advance the plant by the ticks of `grid` (later by `offset`, s) that are due at `now` (s)."""
        if due := grid.take_due(now - offset):
            for _ in range(due):
                self.move(grid.instant + offset)
                grid.line += 1
            self.update_report()

    def update_report(self) -> None:
        """Update the devices and the plant's report from the plant."""
        plant = self.plant
        plant.operational = self.valve_node.state == OPERATIONAL
        if plant.trips != self.valve_node.errors:
            plant.trips, plant.passive_tick = self.valve_node.errors, plant.ticks
        plant.update_report()
        self.readings = unpack_readings(plant.report["readings"])
        for encoder, valid in zip(self.encoders, self.readings.encoder_valid, strict=True):
            encoder.set_health(valid)
        self.valve_node.sense(self.readings)

    def run_timers(self, now: float) -> None:
        """Run the due timers of all devices."""
        for device in self.devices:
            if now >= device.next_due:
                device.run_timers(now)

    def _obey(self, command: Command) -> None:
        self.plant.applied = command
        if self.valve_node.state == OPERATIONAL:
            self.plant.command_tick = self.plant.ticks

    def _count(self, joint: int) -> int | None:
        """Return the joint's present count: the last tick's, extrapolated with speed and acceleration."""
        if self._frozen:
            return None
        count = self.readings.encoder_count[joint]
        if not self.readings.encoder_valid[joint]:
            return count
        limit = _MAX_EXTRAPOLATION
        ahead = max(-limit, min(limit, self._now - self.instant))
        turned = ahead * (self._speed[joint] + 0.5 * ahead * self._acceleration[joint])
        return count + round(turned * self._scale[joint])


# The process -----------------------------------------------------------------------------------------


def run_nodes(plan: NodesPlan, ready: Callable[[str], None], stop_requested: Callable[[], bool]) -> None:
    """Run the simulated nodes until `stop_requested`, polled every 20 ms; `ready` gets the scheduling.

    Raises:
        OSError, can.CanError: the bus cannot be opened.
        SharedMemoryError, ValueError: the plant's files cannot be created, or the plan is invalid.
    """
    _warm_up(plan)
    with PlantFiles(plan.folder) as files, closing(NodeBus(plan)) as bus:
        nodes = BenchNodes(plan, bus.send)
        scheduling = _ask_for_scheduling(plan)
        gc.collect()
        gc.freeze()
        gc.disable()
        try:
            nodes.boot(time.monotonic())
            ready(scheduling)
            _live(plan, nodes, bus, files, stop_requested)
        finally:
            gc.enable()
            gc.unfreeze()


def _ask_for_scheduling(plan: NodesPlan) -> str:
    """Request the plan's core and priority; return the granted ones as text."""
    ctypes.CDLL(None).prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0)  # 1 ns; by default a sleep may last 50 us longer
    granted = []
    if plan.cpu >= 0:
        with suppress(OSError):
            os.sched_setaffinity(0, {plan.cpu})
    if plan.priority > 0:
        with suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(plan.priority))
    is_fifo = os.sched_getscheduler(0) == os.SCHED_FIFO
    granted.append(f"SCHED_FIFO {os.sched_getparam(0).sched_priority}" if is_fifo else "SCHED_OTHER")
    # Lock all memory: a page fault from disk stalls a tick for milliseconds, collapsing small pages into a
    # huge one for one millisecond.
    ctypes.CDLL(None).prctl(_PR_SET_THP_DISABLE, 1, 0, 0, 0)
    locked = ctypes.CDLL(None).mlockall(_MCL_CURRENT | _MCL_FUTURE) == 0
    granted.append("memory locked" if locked else "memory not locked")
    granted.append("cpu " + ",".join(map(str, sorted(os.sched_getaffinity(0)))))
    return ", ".join(granted)


def _warm_up(plan: NodesPlan) -> None:
    """Call every function of a tick once, on nodes without a bus."""
    nodes = BenchNodes(plan, lambda identifier, data: None)
    nodes.boot(0.0)
    nodes.set_surroundings(undisturbed())
    for tick in (1, 2):
        nodes.move(tick * plan.plant.tick)
        nodes.update_report()


def _live(
    plan: NodesPlan, nodes: BenchNodes, bus: NodeBus, files: PlantFiles, stop_requested: Callable[[], bool]
) -> None:
    """Run plant and devices in wall-clock time."""
    surroundings, report, clock = new_record(PLANT_SURROUNDINGS), nodes.plant.report, time.monotonic
    looked, surrounded, tick = 0.0, 0, plan.plant.tick
    grid, offset, wall = WallGrid(tick, clock(), plan.max_catch_up), 0.0, WallOffset()
    while True:
        left = _FRAMES_AT_ONCE
        while left and (message := bus.receive(max(0.0, grid.instant + offset - clock()))) is not None:
            left -= 1
            if not (message.is_error_frame or message.is_remote_frame or message.is_extended_id):
                # A device latches its shaft at the bus time stamp of the SYNC, not when this process runs.
                received, now = message.timestamp - 1e-9 * wall.read(), clock()
                if not now - _MAX_AGE < received < now:
                    received = now
                nodes.catch_up(grid, offset, received)
                nodes.receive(message.arbitration_id, bytes(message.data), received)
                if message.arbitration_id == SYNC:
                    apart = (received - nodes.instant - _LEAD * tick + tick / 2) % tick - tick / 2
                    offset += max(-_MAX_PULL, min(_MAX_PULL, _PULL * apart))
        now = clock()
        late = now - offset - grid.instant
        if late < 0.0:
            continue
        if (version := files.surroundings.read(surroundings)) != surrounded:
            surrounded = version
            nodes.set_surroundings(surroundings)
        nodes.catch_up(grid, offset, now)
        nodes.run_timers(now)
        report["lateness"] = late
        report["max_lateness"] = max(report["max_lateness"][0], late)
        report["plant_slips"], report["slipped_ticks"] = grid.slips, grid.slipped_ticks
        files.report.write(report)
        if now - looked > _POLL_PERIOD:
            looked = now
            bus.reopen_if_closed(now)
            if stop_requested() or not files.are_there:
                return


def _send_event(event: str, **fields: object) -> None:
    """Send an event to the parent, if it still reads."""
    with suppress(OSError):
        sys.stdout.write(json.dumps({"event": event, **fields}) + "\n")
        sys.stdout.flush()


class StopRequest:
    """Stop request: by a signal, or by the parent's death."""

    def __init__(self, *signals: int) -> None:
        self._parent, self._signalled = os.getppid(), False
        for number in signals:
            signal.signal(number, self._note)

    def __call__(self) -> bool:
        """Return whether a stop was requested."""
        return self._signalled or os.getppid() != self._parent

    def _note(self, number: int, frame: FrameType | None) -> None:
        self._signalled = True


_DEVICE = 69
"""Exit code of a device that fails (`bench.base.errors.ExitCode`, which sim does not import)."""


def main() -> int:
    """Run the simulated nodes of the plan on stdin; return the exit code."""
    stop = StopRequest(signal.SIGTERM)
    for number in (signal.SIGINT, signal.SIGABRT):  # sent to the whole process group; the parent decides
        signal.signal(number, signal.SIG_IGN)
    try:
        plan = pickle.load(sys.stdin.buffer)  # noqa: S301 - the parent's own data
        if not isinstance(plan, NodesPlan):
            raise TypeError(f"plan: found {type(plan).__name__}, expected a NodesPlan")
        run_nodes(plan, lambda scheduling: _send_event("ready", pid=os.getpid(), scheduling=scheduling), stop)
        _send_event("stopped", reason="SIGTERM, or the parent or the plant's files are gone")
        return 0
    except (
        ValueError,
        TypeError,
        pickle.UnpicklingError,
        EOFError,
        OSError,
        can.CanError,
        SharedMemoryError,
    ) as error:
        expected, action = "a plan that can run", "Correct the plan or the interface."
        _send_event(
            "failed", location="nodes", found=f"{error}", expected=expected, action=action, exit_code=_DEVICE
        )
    return 1


if __name__ == "__main__":
    sys.exit(main())
